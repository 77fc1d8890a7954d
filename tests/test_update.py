"""Updates of the four scripts, recomputed by tests/reference_update.py."""

import importlib

import gymnasium
import numpy as np
import pytest
import torch
from reference_update import CLIPPED, SETTINGS, Reference, flags
from script_runs import ALGORITHMS, Recording

OWN = {
    "mppo_beta_crane": CLIPPED | {
        "minibatch_size": 16, "log_excess_init": 0.3, "perturbation": 0.2,
    },
    "ppo_crane": CLIPPED | {"minibatch_size": 16, "log_std_init": -0.5},
    "trpo_crane": {
        "minibatch_size": 16, "target_kl": 0.02, "cg_iters": 200, "cg_damping": 0.05,
        "fisher_samples": 20, "backtrack_iters": 5, "backtrack_coeff": 0.7, "log_std_init": -0.5,
    },
    "recurrent_ppo_crane": CLIPPED | {"lstm_size": 3, "num_minibatches": 2, "log_std_init": -0.5},
}  # fmt: skip
ITERATIONS = 3


@pytest.mark.parametrize("script", ALGORITHMS)
def test_updates(tmp_path, script):
    """Three updates in a row, on episodes that end, that are cut, and both at once."""
    settings = {"num_envs": 4} | SETTINGS | OWN[script]
    n, steps, epochs = (settings[name] for name in ("num_envs", "num_steps", "update_epochs"))
    run = Recording(tmp_path)
    run.run(
        script,
        "--env-id toy_tasks:Toy-v0 --hidden-sizes 5 4 --eval-trials 1 --final-trials 1 --threads 1",
        f"--total-timesteps {ITERATIONS * n * steps}",
        flags(settings),
    )
    assert len(run.updates) == ITERATIONS and len(run.steps) == ITERATIONS * steps
    settings |= {"hidden_sizes": (5, 4), "iterations": ITERATIONS}
    reference = Reference(settings, run.first[0])
    obs, permutations = run.starts[0], run.permutations
    check_start(run.first[0], "log_std" not in run.first[0])
    kinds, epochs_done, all_stats = set(), [], []
    for k, update in enumerate(run.updates):
        records = run.steps[k * steps : (k + 1) * steps]
        check_actions(script, k, settings, update["actions"], records, run.samples[k * steps :])
        for record in records:
            kinds |= set(zip(record["terminated"].tolist(), record["truncated"].tolist()))
        obs = reference.rollout(obs, records, update["actions"])
        if script == "trpo_crane":
            sample = [divmod(b, n) for b in permutations.pop(0)[: settings["fisher_samples"]]]
            stats = reference.trpo(sample, batches(permutations[:epochs], settings))
            epochs_done.append(epochs)
        else:
            stats = reference.ppo(batches(permutations[:epochs], settings))
            epochs_done.append(reference.epochs_done)
        del permutations[: epochs_done[-1]]
        for name, weight in reference.w.items():
            close(update["weights"][name], weight, f"{name} after update {k + 1}")
        spreads = [spread(values) for values in (reference.advantages, reference.returns)]
        all_stats.append(stats)
        for name, expected in {
            **{name: np.mean(values) for name, values in stats.items()},
            "losses/explained_variance": 1 - spreads[0] / spreads[1],
            "schedule/gamma": reference.gamma,
            "charts/learning_rate": reference.lr,
        }.items():
            close(run.scalars[name][(k + 1) * n * steps], expected, name)
        assert update["step"] == (k + 1) * n * steps
        assert update["difficulty"] == min(1, (k + 1) / ITERATIONS / 0.5)
    # all that can happen did happen
    assert not permutations and len(kinds) == 4
    norms = sum((stats["losses/grad_norm"] for stats in all_stats), [])
    assert min(norms) < settings["max_grad_norm"] < max(norms)
    if script == "trpo_crane":
        assert [stats["trpo/step_fraction"] for stats in all_stats] == [[0.7], [1.0], [1.0]]
    else:
        assert min(epochs_done) < max(epochs_done) == epochs
        assert max(max(stats["losses/clipfrac"]) for stats in all_stats) > 0.2


def spread(values):
    return np.var(list(map(float, values.values())), ddof=1)


def batches(permutations, settings):
    """Minibatches of (step, crane) of each epoch."""
    n, steps = settings["num_envs"], settings["num_steps"]
    epochs = []
    for permutation in permutations:
        if "num_minibatches" in settings:  # of whole cranes
            assert sorted(permutation) == list(range(n))
            size = n // settings["num_minibatches"]
            pairs = [[(t, i) for i in [permutation[j]] for t in range(steps)] for j in range(n)]
            groups = [sum(pairs[j : j + size], []) for j in range(0, n, size)]
        else:
            assert sorted(permutation) == list(range(n * steps))
            size, pairs = settings["minibatch_size"], [divmod(b, n) for b in permutation]
            groups = [pairs[j : j + size] for j in range(0, len(pairs), size)]
        epochs.append(groups)
    return epochs


def check_start(weights, of_beta):
    """The first weights: orthogonal ones, and a policy as wide as asked."""
    for layer, scale in [("actor.0", 2), ("critic.2", 2), ("actor.4", 1e-4), ("critic.4", 1)]:
        weight = weights[f"{layer}.weight"]
        weight = weight if len(weight) <= len(weight.T) else weight.T
        close(weight @ weight.T, scale * torch.eye(len(weight)), layer)
        if (layer, of_beta) != ("actor.4", True):
            assert not weights[f"{layer}.bias"].any()
    width = weights["actor.4.bias"] - 0.3 if of_beta else weights["log_std"] + 0.5
    close(width, torch.zeros_like(width), "width")


def check_actions(script, k, settings, actions, records, samples):
    """The actions of an update were drawn from the policy, perhaps perturbed, and executed."""
    drawn = torch.stack(samples[: len(records)])
    executed = np.stack([record["actions"] for record in records])
    low, high = np.array([-2, 0]), np.array([1, 3])
    if script == "mppo_beta_crane":
        epsilon = settings["perturbation"] * max(0, 1 - k / ITERATIONS / 0.4)
        noise = (actions - drawn)[(actions > 2e-4) & (actions < 1 - 2e-4)]
        assert noise.abs().max() <= epsilon + 1e-6
        if epsilon:
            assert noise.min() < -0.8 * epsilon and noise.max() > 0.8 * epsilon
            assert 0.4 < noise.std() / epsilon < 0.75  # 0.58 of uniform noise
        assert actions.min() >= 1e-4 - 1e-9 and actions.max() <= 1 - 1e-4 + 1e-7
        expected = low + (high - low) * actions.numpy()
    else:
        torch.testing.assert_close(actions, drawn, rtol=0, atol=0)
        expected = low + (high - low) * (np.clip(actions.numpy(), -1, 1) + 1) / 2
    np.testing.assert_allclose(executed, expected, atol=1e-6)
    assert executed.dtype == np.float32  # as the task's


def close(ours, theirs, what=""):
    ours, theirs = (torch.as_tensor(x).detach().double() for x in (ours, theirs))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5, msg=lambda m: f"{what}: {m}")


# ---- what an update does not show


def make_agent(script, low=(-2.0, 0.0), high=(1.0, 3.0), **args):
    """An agent of 3 numbers observed, whose actions depend much on them."""
    torch.manual_seed(0)
    module = importlib.import_module(script)
    args = module.Args(hidden_sizes=(5, 4), **args)
    agent = module.Agent(3, np.array(low), np.array(high), args)
    torch.nn.init.orthogonal_(agent.actor[-1].weight)
    return agent


@pytest.mark.parametrize("script", ALGORITHMS)
def test_predict(script):
    """The mean action, from memory too; of large numbers that differ little."""
    agent = make_agent(script, **({"lstm_size": 3} if script == "recurrent_ppo_crane" else {}))
    args = {"hidden_sizes": (5, 4), "lstm_size": 3}
    reference = Reference(args, agent.state_dict())
    obs = 5.3e6 + np.random.default_rng(0).normal(size=(4, 6, 3)) * [1, 3, 0.1]
    for batch in obs:
        agent.update_normalizer(torch.as_tensor(batch))
        reference.observe(batch)
    obs[3, 0] += 1000  # beyond 10 standard deviations
    state, memories = None, [None] * 6
    for batch in obs:
        actions, state = agent.predict(batch, state)
        for i in range(6):
            seen, memories[i] = reference.look(reference.normalized(batch[i]), memories[i])
            a, b = (x.detach().numpy() for x in reference.policy(seen))
            share = a / (a + b) if script == "mppo_beta_crane" else (np.clip(a, -1, 1) + 1) / 2
            np.testing.assert_allclose(actions[i], np.array([-2, 0]) + 3 * share, atol=1e-4)
    assert np.ptp(actions, axis=0).min() > 0.1
    drawn, again = (agent.predict(obs[0], None, deterministic=False)[0] for _ in range(2))
    assert np.abs(drawn - again).max() > 0.1
    assert (drawn >= [-2, 0]).all() and (drawn <= [1, 3]).all()


@pytest.mark.parametrize("script", ALGORITHMS)
def test_actions_lie_within_any_bounds(script):
    low, high = np.array([-0.1, 1000.0]), np.array([0.1, 2000.0])
    ends = torch.tensor([[0.0, 0.0], [1.0, 1.0]] if "beta" in script else [[-7.0, -1], [1, 7]])
    actions = make_agent(script, low, high).to_env(ends)
    np.testing.assert_array_equal(actions, [low, high])
    assert gymnasium.spaces.Box(low, high, dtype=np.float64).contains(actions[0])


@pytest.mark.parametrize("script", ALGORITHMS)
def test_unbounded_actions(tmp_path, script):
    run = Recording(tmp_path)
    line = "--env-id toy_tasks:Unbounded-v0 --num-envs 2 --num-steps 6 --hidden-sizes 4 --threads 1"
    line += " --total-timesteps 12 --final-trials 1 --log-std-init 2"
    if script == "mppo_beta_crane":
        with pytest.raises(SystemExit, match="a Beta policy needs bounded actions"):
            run.run(script, line.replace("--log-std-init 2", ""))
        return
    line += " --num-minibatches 1" if script == "recurrent_ppo_crane" else ""
    run.run(script, line)
    executed = np.stack([step["actions"] for step in run.steps])
    np.testing.assert_allclose(executed, run.updates[0]["actions"])
    assert np.abs(executed).max() > 3


def test_a_beta_of_absurd_outputs():
    """alpha, beta > 1, and a finite log-probability wherever an action may lie."""
    module, agent = importlib.import_module("mppo_beta_crane"), make_agent("mppo_beta_crane")
    with torch.no_grad():
        agent.actor[-1].weight.mul_(1e6)
    distribution = agent.get_distribution(1e6 * torch.randn(64, 3))
    for concentration in (distribution.concentration1, distribution.concentration0):
        assert 1 < concentration.min() < 1.1 and 140 < concentration.max() < 150
    for end in (module.A_MIN, 1 - module.A_MIN):
        assert distribution.log_prob(torch.full((64, 2), end)).isfinite().all()
    assert distribution.entropy().max() <= 0


def test_conjugate_gradient():
    """As many products as iterations, each of which removes one eigenvalue."""
    conjugate_gradient = importlib.import_module("trpo_crane").conjugate_gradient
    torch.manual_seed(0)
    basis, _ = torch.linalg.qr(torch.randn(6, 6, dtype=torch.float64))
    matrix = basis @ torch.diag(torch.tensor([1.0, 1, 5, 5, 5, 20]).double()) @ basis.T
    b, products = torch.randn(6, dtype=torch.float64), []

    def product(v):
        products.append(v)
        return matrix @ v

    exact = torch.linalg.solve(matrix, b)
    torch.testing.assert_close(conjugate_gradient(product, b, 3), exact)
    assert len(products) == 3
    assert (conjugate_gradient(product, b, 2) - exact).norm() > 1e-2 * exact.norm()
    assert conjugate_gradient(product, 0 * b, 5).equal(0 * b)


@pytest.mark.parametrize("factor", [-1e-3, 1e6, float("nan")])
def test_line_search_restores_exactly_what_it_cannot_improve(factor):
    """Downhill, too far, nowhere."""
    module, agent = importlib.import_module("trpo_crane"), make_agent("trpo_crane")
    with torch.no_grad():
        obs = torch.randn(50, 3)
        old = agent.get_distribution(obs)
        batch = obs, old.sample(), torch.randn(50), old
    surrogate, _ = module.surrogate_and_kl(agent, *batch)
    gradient = module.flat(torch.autograd.grad(surrogate, agent.policy_parameters()))
    before = module.flat(agent.policy_parameters()).detach()
    step, args = factor * gradient, module.Args()
    assert module.line_search(agent, step, batch, 0.01, args) == (0.0, 0.0, surrogate.item())
    assert torch.equal(before, module.flat(agent.policy_parameters()))
