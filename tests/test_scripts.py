"""What all four algorithm scripts promise."""

import ast
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from script_runs import (
    ALGORITHMS,
    ROOT,
    TWO,
    command,
    environment,
    make_agent,
    module,
    one_minibatch,
    only_run,
    run,
    scalars,
    small,
)

import crane_env
import crane_options
import crane_task
import crane_trials


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gae_with_ends(algorithm):
    """gamma = 0.5, lambda = 0.5; crane 0: step 1 ends by termination, step 2 by truncation, V = 4.

    Its 0.5 * 4 has been added to the reward of step 2. Crane 1 goes on.
    """
    rewards = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0 + 2.0, 3.0], [4.0, 4.0]])
    values = torch.tensor([[1.0, 10.0], [1.0, 10.0], [2.0, 20.0], [2.0, 20.0]])
    last_value = torch.tensor([6.0, 60.0])
    dones = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    advantages = module(algorithm).compute_gae(rewards, values, last_value, dones, 0.5, 0.5)
    # deltas: 1 + .5 - 1, 2 + 0 - 1, 3 + 2 - 2, 4 + 3 - 2; only step 0 looks past itself
    torch.testing.assert_close(advantages[:, 0], torch.tensor([0.75, 1.0, 3.0, 5.0]))
    # deltas: 1 + 5 - 10, 2 + 10 - 10, 3 + 10 - 20, 4 + 30 - 20, each and a quarter of the next
    expected = [-4 + (2 + (-7 + 14 / 4) / 4) / 4, 2 + (-7 + 14 / 4) / 4, -7 + 14 / 4, 14.0]
    torch.testing.assert_close(advantages[:, 1], torch.tensor(expected))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gae_without_ends_is_the_discounted_sum_of_deltas(algorithm):
    torch.manual_seed(0)
    rewards, values, no_ends = torch.randn(6, 3), torch.randn(7, 3), torch.zeros(6, 3)
    compute_gae = module(algorithm).compute_gae
    advantages = compute_gae(rewards, values[:-1], values[-1], no_ends, 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    expected = sum(0.72**k * deltas[k] for k in range(6))
    torch.testing.assert_close(advantages[0], expected)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_normalizer_is_the_mean_and_variance_of_all_it_saw(algorithm):
    torch.manual_seed(0)
    agent = make_agent(algorithm)
    batches = [5 + 3 * torch.randn(100, 18), -2 + torch.randn(37, 18)]
    for batch in batches:
        agent.update_normalizer(batch)
    everything = torch.cat(batches).double()
    mean, variance = everything.mean(0), everything.var(0, unbiased=False)
    torch.testing.assert_close(agent.obs_mean, mean, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(agent.obs_var, variance, atol=1e-3, rtol=1e-3)
    obs = torch.randn(9, 18)
    expected = ((obs - mean) / variance.sqrt()).float()
    torch.testing.assert_close(agent.normalize(obs), expected, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_normalized_observations_are_bounded_and_raw_ones_are_not(algorithm):
    obs = torch.linspace(-500, 500, 36).view(2, 18)
    for normalize, expected in [(True, obs.clamp(-10, 10)), (False, obs)]:
        agent = make_agent(algorithm, normalize_obs=normalize)
        torch.testing.assert_close(agent.normalize(obs), expected)
        agent.update_normalizer(7 + torch.randn(50, 18))
        assert torch.equal(agent.normalize(obs), expected) != normalize


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_predict_takes_raw_observations_and_the_networks_normalized_ones(algorithm):
    torch.manual_seed(0)
    agent = make_agent(algorithm)
    torch.nn.init.orthogonal_(agent.actor[-1].weight)
    obs = 5 + 3 * torch.randn(100, 18)
    agent.update_normalizer(obs)

    def mean_action(seen):
        if algorithm == "recurrent_ppo":
            starts, state = torch.zeros(1, 100), agent.initial_state(100)
            seen = agent.remember(seen[None], state, starts)[0][0]
        with torch.no_grad():
            return agent.to_env(agent.get_distribution(seen).mean)

    actions, _ = agent.predict(obs.double().numpy(), None)  # as Pendulum's tasks may give them
    assert isinstance(actions, np.ndarray) and actions.shape == (100, 6)
    np.testing.assert_allclose(actions, mean_action(agent.normalize(obs)), atol=1e-5)
    assert np.abs(actions - mean_action(obs)).max() > 0.1
    sampled = [agent.predict(obs.numpy(), None, deterministic=False)[0] for _ in range(2)]
    assert np.abs(sampled[0] - sampled[1]).max() > 0.1


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_networks_are_tanh_layers_with_orthogonal_weights(algorithm):
    torch.manual_seed(0)
    network = module(algorithm).mlp(5, (7, 6), 3, std=0.01)
    first, second, last = network[0], network[2], network[4]
    widths = [layer.out_features for layer in (first, second, last)]
    assert len(network) == 5 and widths == [7, 6, 3]
    for layer, scale in ((first, 2), (second, 2), (last, 1e-4)):
        weight = layer.weight if len(layer.weight) <= layer.in_features else layer.weight.T
        torch.testing.assert_close(weight @ weight.T, scale * torch.eye(len(weight)))
        assert (layer.bias == 0).all()
    x = torch.randn(4, 5)
    expected = last(torch.tanh(second(torch.tanh(first(x)))))
    torch.testing.assert_close(network(x), expected)


def test_what_the_scripts_share_gives_the_same_numbers():
    """GAE, networks and normalizer: to the bit, from equal inputs."""
    results = []
    for algorithm in ALGORITHMS:
        torch.manual_seed(0)
        script, agent = module(algorithm), make_agent(algorithm)
        torch.manual_seed(1)
        rewards, values = torch.randn(2, 9, 5)
        dones, next_value = (torch.rand(9, 5) < 0.3).float(), torch.randn(5)
        obs = 3 + 5 * torch.randn(3, 40, 18)
        advantages = script.compute_gae(rewards, values, next_value, dones, 0.93, 0.8)
        network = script.mlp(18, (7, 6), 4, 0.5)
        for batch in obs:
            agent.update_normalizer(batch)
        statistics = [agent.obs_mean, agent.obs_var, agent.obs_count]
        normalized = [agent.normalize(batch) for batch in (obs[0], 100 * obs[1])]
        results.append([advantages, network(obs[0]), *statistics, *normalized])
    for theirs in results[1:]:
        assert all(map(torch.equal, results[0], theirs))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_each_script_stands_alone(algorithm):
    """It imports none of the other scripts."""
    imported = set()
    for node in ast.walk(ast.parse((ROOT / f"{algorithm}_crane.py").read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    assert "crane_env" in imported
    assert not imported & {f"{other}_crane" for other in ALGORITHMS}


@pytest.mark.parametrize("algorithm", ["mppo_beta", "ppo", "recurrent_ppo"])
def test_update_sees_the_policy_that_acted(monkeypatch, run_here, algorithm):
    """The log-probabilities of the rollout, taken when it acted, are those that the update uses.

    Third rollout on Recall: the normalizer has moved, memories are carried over the rollout's
    start (7 steps, episodes of 5) and emptied inside it.
    """
    arguments = "--env-id recall_env:Recall-v0 --num-steps 7 --total-timesteps 84 --eval-every 0"
    arguments = [*small(algorithm), *arguments.split(), "--learning-rate", "0.01"]
    arguments += ["--env.retry", "0"]
    arguments += ["--perturbation", "0"] if algorithm == "mppo_beta" else []
    family = torch.distributions.Beta if algorithm == "mppo_beta" else torch.distributions.Normal
    sample, acted = family.sample, []

    def recording_sample(self, *shape):
        action = sample(self, *shape)
        acted.append(
            self.log_prob(action.clamp(1e-4, 1 - 1e-4) if family.__name__ == "Beta" else action)
        )
        return action

    monkeypatch.setattr(family, "sample", recording_sample)
    script = run_here(algorithm, *arguments)
    logprobs = script.get("logprobs", script.get("b_logprobs")).reshape(7, 4)
    assert len(acted) == 3 * 7
    torch.testing.assert_close(logprobs, torch.stack(acted[-7:]).sum(-1), rtol=0, atol=1e-4)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_values_of_what_follows_a_rollout(run_here, algorithm):
    """V(final_obs) where the time limit cuts, V of the next observation where an episode goes on.

    Pendulum's episodes last 200 steps. The critic learns nothing, so we can ask it afterwards.
    """
    still = "--env-id Pendulum-v1 --env.retry 0 --eval-every 0 --learning-rate 1e-30".split()

    def value(left, obs, begins):
        agent = left["agent"]
        obs = agent.normalize(torch.as_tensor(np.stack(obs), dtype=torch.float32))
        if algorithm == "recurrent_ppo":
            _, state = agent.remember(left["obs"], left["first_state"], left["starts"])
            obs = agent.remember(obs[None], state, torch.full((1, 4), float(begins)))[0][0]
        return agent.get_value(obs).detach()

    for steps, updates in [(200, 1), (7, 2)]:
        size = f"--num-steps {steps} --total-timesteps {4 * steps * updates}".split()
        left = run_here(algorithm, *small(algorithm), *still, *size)
        ended = steps == 200
        assert left["dones"].any() == ended
        torch.testing.assert_close(left["next_value"], value(left, left["next_obs"], ended))
        if ended:
            final = left["gamma"] * value(left, left["infos"][-1]["final_obs"], False)
            paid = left["reward_scale"] * torch.as_tensor(left["infos"][-1]["episode"]["r"])
            sums = left["rewards"].double().sum(0)
            torch.testing.assert_close(sums, paid + final, rtol=0, atol=1e-4)
            assert (final.abs() > 1e-3).all()


@pytest.mark.parametrize("algorithm", ["mppo_beta", "ppo", "recurrent_ppo"])
def test_ratio_is_one_in_every_update_of_one_minibatch(tmp_path, run_here, algorithm):
    """On Recall, whose episodes of 5 steps cross the ends of rollouts of 6: memories go on."""
    task = "--env-id recall_env:Recall-v0 --env.retry 0 --num-steps 6 --learning-rate 0.01"
    arguments = [*small(algorithm), *task.split(), "--update-epochs", "1", "--eval-every", "0"]
    arguments += ["--num-minibatches", "1"] if algorithm == "recurrent_ppo" else []
    run_here(algorithm, *arguments, "--total-timesteps", "240")
    values = scalars(only_run(tmp_path))
    assert len(values["losses/approx_kl"]) == 10
    np.testing.assert_allclose(values["losses/approx_kl"], 0, atol=1e-6)
    np.testing.assert_allclose(values["losses/old_approx_kl"], 0, atol=1e-6)


@pytest.mark.parametrize("algorithm", ["mppo_beta", "ppo", "recurrent_ppo"])
def test_an_update_stops_after_the_first_epoch_beyond_target_kl(tmp_path, run_here, algorithm):
    """Two minibatches an epoch: 5 epochs without a bound, 1 with one that none can keep."""
    arguments = "--env-id recall_env:Recall-v0 --env.retry 0 --eval-every 0 --update-epochs 5"
    arguments = [*small(algorithm), *arguments.split(), "--learning-rate", "0.01"]
    arguments += ["--total-timesteps", "64"]
    for bound, epochs in [("None", 5), ("1e-9", 1), ("1000", 5)]:
        folder = tmp_path / bound
        folder.mkdir()
        left = run_here(algorithm, *arguments, "--target-kl", bound, cwd=folder)
        assert len(left["stats"]["losses/approx_kl"]) == 2 * epochs
        checkpoint = torch.load(only_run(folder) / "checkpoint.pt", weights_only=True)
        steps = {state["step"].item() for state in checkpoint["optimizer"]["state"].values()}
        assert steps == {2.0 * epochs}


KEYS = """
time/SPS time/simulation_SPS schedule/learning_rate schedule/gamma time/updates schedule/difficulty
charts/episodic_return charts/episodic_length charts/success_rate charts/gentle_rate
losses/value_loss losses/policy_loss losses/entropy losses/explained_variance losses/grad_norm
reward/distance reward/grapple reward/lift reward/balance reward/ground
termination/diverged termination/joint_limit termination/overspeed termination/log_too_far
termination/not_reached termination/time_limit time/rollout time/update
eval/episodic_return eval/success_rate eval/gentle_rate
eval/success_rate_0.3m eval/success_rate_0.4m eval/success_rate_0.5m
eval/success_rate_0.6m eval/success_rate_0.7m eval/success_rate_0.8m
""".split()
CLIPPED = ["losses/old_approx_kl", "losses/approx_kl", "losses/clipfrac"]
OWN_KEYS = {
    "mppo_beta": [
        *CLIPPED,
        *"policy/alpha policy/beta policy/boundary_frac schedule/perturbation".split(),
    ],
    "ppo": [*CLIPPED, "policy/std"],
    "recurrent_ppo": [*CLIPPED, "policy/std"],
    "trpo": """policy/std trpo/kl trpo/step_fraction trpo/line_search_ok trpo/cg_residual
        trpo/expected_improvement trpo/improvement""".split(),
}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_two_updates_on_the_crane_same_seed_same_weights(tmp_path, run_here, algorithm):
    """In a process of its own and in this one."""
    arguments = [*small(algorithm), *"--num-steps 96 --total-timesteps 768 --eval-every 2".split()]
    weights = []
    for i, seed in enumerate(["3", "3", "4"]):
        folder = tmp_path / str(i)
        folder.mkdir()
        if i == 0:
            run(algorithm, folder, *arguments, "--seed", seed)
        else:
            run_here(algorithm, *arguments, "--seed", seed, cwd=folder)
        policy = torch.load(only_run(folder) / "policy.pt", weights_only=True)
        assert policy["algorithm"] == algorithm and policy["global_step"] == 768
        checkpoint = torch.load(only_run(folder) / "checkpoint.pt", weights_only=True)
        assert not any(k.startswith("critic.") for k in policy["weights"])
        assert "critic.0.weight" in checkpoint["weights"]
        weights.append(checkpoint["weights"])
        script = module(algorithm)
        options = crane_options.complete(script.Args().env)
        task = {"env_id": "ForestryCrane-v0", "revision": crane_env.REVISION, **options}
        assert policy["task"] == checkpoint["task"] == task
        assert script.Args(**policy["args"]).seed == int(seed)
    assert all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])
    assert not torch.equal(weights[0]["actor.0.weight"], weights[2]["actor.0.weight"])
    values = scalars(only_run(tmp_path / "0"))
    assert set(values) == {*KEYS, *OWN_KEYS[algorithm]}
    assert all(np.isfinite(v).all() for v in values.values())
    assert values["losses/grad_norm"][0] > 0
    assert len(values["eval/success_rate"]) == 1 and len(values["schedule/gamma"]) == 2


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_any_box_task(tmp_path, run_here, capsys, algorithm):
    arguments = "--env-id Pendulum-v1 --total-timesteps 832 --eval-every 13 --no-normalize-obs"
    left = run_here(algorithm, *small(algorithm), *arguments.split(), "--final-trials", "2")
    values = scalars(only_run(tmp_path))
    of_crane = "charts/[gs]|schedule/diff|reward|termin|eval/[gs]"
    crane = [key for key in KEYS if re.match(of_crane, key)]
    final = {"final/episodic_return"}
    assert set(values) == {*KEYS, *OWN_KEYS[algorithm]} - set(crane) | final
    assert values["charts/episodic_length"] == [200.0]  # all end in the 13th rollout
    assert -1700 * 1.6 < values["eval/episodic_return"][0] < 0
    score = values["final/episodic_return"][0]
    (printed,) = re.findall("final/episodic_return: (.+)", capsys.readouterr().out)
    assert float(printed) == pytest.approx(score, abs=1e-3)  # TensorBoard has 32 bits
    policy = torch.load(only_run(tmp_path) / "policy.pt", weights_only=True)
    assert policy["task"] == {"env_id": "Pendulum-v1"}
    # the rollout stored what the environment gave: cos, sin and a velocity of up to 8
    obs = left["obs"].flatten(0, 1)
    assert obs[:, 2].abs().max() > 1.5
    torch.testing.assert_close(obs[:, :2].norm(dim=-1), torch.ones(len(obs)))


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_papers_task_trains(tmp_path, run_here, algorithm):
    """Discount, lambda and reward scale hold per 0.1 s: 20 decisions here."""
    arguments = "--env-id ForestryCranePaper-v0 --num-envs 2 --num-steps 20 --update-epochs 1"
    arguments += " --total-timesteps 80 --eval-every 0 --gamma 0.9 --gae-lambda 0.8"
    arguments += " --num-minibatches 2" if algorithm == "recurrent_ppo" else " --minibatch-size 20"
    left = run_here(algorithm, *small(algorithm), *arguments.split(), "--env.retry", "0")
    task = torch.load(only_run(tmp_path) / "policy.pt", weights_only=True)["task"]
    assert task == {
        "env_id": "ForestryCranePaper-v0",
        "revision": crane_env.REVISION,
        **crane_options.complete(crane_options.PAPER),
    }
    values = scalars(only_run(tmp_path))
    growth = 3 ** (1 - 0.5 / 0.75)  # in the second half of the run
    gamma = [0.9**0.05, (1 - 0.1 / growth) ** 0.05]
    assert values["schedule/gamma"] == pytest.approx(gamma, abs=1e-7)
    scale = 0.06 * 0.05 / growth
    paid = np.mean([sum(info[term] for term in crane_task.TERMS) for info in left["infos"]])
    assert left["rewards"].mean().item() == pytest.approx(scale * paid, rel=1e-5)
    rates = np.array(values["time/simulation_SPS"]) / values["time/SPS"]
    np.testing.assert_allclose(rates, 1, rtol=1e-5)
    again = left["compute_gae"](
        left["rewards"],
        left["values"],
        left["next_value"],
        left["dones"],
        gamma[1],
        0.8**0.05,
    )
    torch.testing.assert_close(left["advantages"], again)


def start(algorithm, cwd, *arguments, wait_for="runs/*/checkpoint.pt", ignored=()):
    """A run in a process and a session of its own, once a file like wait_for is there."""

    def handlers():  # where the tests run in the background, some are ignored, and this inherited
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(signum, signal.SIG_IGN if signum in ignored else signal.SIG_DFL)

    process = subprocess.Popen(
        command(algorithm, *small(algorithm), "--eval-every", "0", *arguments),
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=handlers,
    )
    for _ in range(6000):
        if list(Path(cwd).glob(wait_for)):
            return process
        assert process.poll() is None, process.stderr.read()[-2000:]
        time.sleep(0.05)
    process.kill()
    raise AssertionError(f"no {wait_for} after five minutes")


def outcome(process):
    """What it printed until its end, which must come within two minutes."""
    try:
        return process.communicate(timeout=120)
    finally:
        process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", TWO)
def test_a_signal_in_the_final_trials_ends_the_run(tmp_path, algorithm):
    process = start(algorithm, tmp_path, "--total-timesteps", "64", "--final-trials", "300")
    time.sleep(2)  # 1,800 trials take much longer
    process.send_signal(signal.SIGTERM)
    outcome(process)
    assert process.returncode == -signal.SIGTERM


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_killed_run_goes_on(tmp_path, run_here, algorithm):
    bound = [] if algorithm == "trpo" else ["--target-kl", "None"]
    process = start(algorithm, tmp_path, "--total-timesteps", "3200", *bound)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    run_dir = only_run(tmp_path)
    before = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert 10 <= before["iteration"] < 50
    for _ in range(2):  # the second time all updates are done
        run_here(algorithm, "--resume", run_dir, "--torch-threads", "1", "--env-threads", "1")
        after = torch.load(run_dir / "checkpoint.pt", weights_only=True)
        assert after["iteration"] == 50 and only_run(tmp_path) == run_dir
        steps = [s["step"].item() for s in after["optimizer"]["state"].values()]
        assert set(steps) == {50 * 4.0}  # 2 epochs of 2 minibatches each: Adam's count went on
        values = scalars(run_dir)
        assert values["time/updates"] == list(range(1, 51))  # none twice, none missing
        lr = after["args"]["learning_rate"]
        assert values["schedule/learning_rate"] == pytest.approx(lr * (1 - np.arange(50) / 50))
        assert after["weights"]["obs_count"] == pytest.approx(3200, abs=1)
        assert {p.name for p in run_dir.glob("*.*") if "tfevents" not in p.name} == {
            "policy.pt",
            "checkpoint.pt",
        }


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_difficulty_rises_in_the_warm_up(tmp_path, run_here, monkeypatch, algorithm):
    """To that of the options, which the rest of the run has, also when it is resumed.

    The first starts are easy too.
    """
    first, reset = [], crane_env.CraneVectorEnv.reset

    def watched(envs, **kwargs):
        first.append(envs.difficulty)
        return reset(envs, **kwargs)

    monkeypatch.setattr(crane_env.CraneVectorEnv, "reset", watched)
    arguments = [*small(algorithm), "--eval-every", "0", "--total-timesteps", "512"]
    arguments += ["--warm-up", "0.5", "--env.difficulty", "0.8", "--final-trials", "0"]
    run_here(algorithm, *arguments)
    folder = only_run(tmp_path)
    difficulties = scalars(folder)["schedule/difficulty"]
    expected = [0.2, 0.4, 0.6, 0.8, 0.8, 0.8, 0.8, 0.8]
    np.testing.assert_allclose(difficulties, expected, rtol=1e-6)
    path = folder / "checkpoint.pt"
    torch.save(torch.load(path, weights_only=True) | {"iteration": 2}, path)
    left = run_here(algorithm, "--resume", folder)
    assert left["run"].first_iteration == 3 and left["envs"].unwrapped.difficulty == 0.8
    np.testing.assert_allclose(scalars(folder)["schedule/difficulty"], expected, rtol=1e-6)
    np.testing.assert_allclose(first, [expected[0], expected[2]], rtol=1e-6)


@pytest.mark.parametrize(
    "algorithm, signum, code",
    [
        ("mppo_beta", signal.SIGINT, 130),
        ("ppo", signal.SIGTERM, 143),
        ("trpo", signal.SIGINT, 130),
        ("recurrent_ppo", signal.SIGHUP, 129),
    ],
)
@pytest.mark.slow
def test_a_stopped_run_ends_with_its_update(tmp_path, run_here, algorithm, signum, code):
    bound = [] if algorithm == "trpo" else ["--target-kl", "None"]
    process = start(algorithm, tmp_path, "--total-timesteps", "640000", *bound)
    run_dir = only_run(tmp_path)
    for file in run_dir.glob("*.pt"):
        file.unlink()  # what is there afterwards was written on the way out
    process.send_signal(signum)
    output, errors = outcome(process)
    assert process.returncode == code, errors[-2000:]
    said = re.search(r"^stopped after update (\d+); go on with --resume (.*)$", output, re.M)
    iteration = int(said[1])
    assert iteration >= 10 and tmp_path / said[2] == run_dir
    policy = torch.load(run_dir / "policy.pt", weights_only=True)
    checkpoint = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert checkpoint["iteration"] == iteration == scalars(run_dir)["time/updates"][-1]
    assert checkpoint["global_step"] == policy["global_step"] == iteration * 64
    updates = {s["step"].item() for s in checkpoint["optimizer"]["state"].values()}
    assert updates == {4.0 * iteration}  # the update under way was finished
    checkpoint["args"]["total_timesteps"] = (iteration + 1) * 64
    torch.save(checkpoint, run_dir / "checkpoint.pt")
    run_here(algorithm, "--resume", said[2])
    assert scalars(run_dir)["time/updates"] == list(range(1, iteration + 2))


def test_a_second_ctrl_c_stops_at_once_and_nohup_is_respected(tmp_path):
    """In a step that takes a minute."""
    arguments = "--env-id recall_env:Stuck-v0 --env.retry 0".split()
    hup = [signal.SIGHUP]
    process = start("mppo_beta", tmp_path, *arguments, wait_for="stuck", ignored=hup)
    for signum in (signal.SIGHUP, signal.SIGHUP, signal.SIGINT):
        process.send_signal(signum)
        time.sleep(0.5)
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    outcome(process)
    assert process.returncode == -signal.SIGINT


@pytest.mark.parametrize("algorithm", TWO)
def test_a_stop_during_an_evaluation_keeps_the_update(
    tmp_path, monkeypatch, run_here, capsys, algorithm
):
    evaluate = crane_trials.evaluate

    def interrupted(*args, **kwargs):
        os.kill(os.getpid(), signal.SIGINT)
        return evaluate(*args, **kwargs)

    monkeypatch.setattr(crane_trials, "evaluate", interrupted)
    arguments = "--env-id recall_env:Echo-v0 --env.retry 0 --eval-every 1 --total-timesteps 320"
    with pytest.raises(SystemExit) as end:
        run_here(algorithm, *small(algorithm), *arguments.split())
    assert end.value.code == 130
    assert "stopped after update 1" in capsys.readouterr().out
    checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    assert checkpoint["iteration"] == 1


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_changed_network_does_not_resume(tmp_path, run_here, monkeypatch, algorithm):
    run_here(algorithm, *small(algorithm), "--total-timesteps", "128")
    tanh, script = torch.tanh, module(algorithm)
    monkeypatch.setattr(script.nn.Tanh, "forward", lambda self, x: tanh(2 * x))
    with pytest.raises(SystemExit, match="--resume: the Agent of this script acts otherwise"):
        run_here(algorithm, "--resume", only_run(tmp_path), "--total-timesteps", "256")


def test_a_network_of_another_shape_does_not_resume(tmp_path, run_here):
    run_here("ppo", *small("ppo"), "--total-timesteps", "128")
    path = only_run(tmp_path) / "checkpoint.pt"
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["weights"]["critic.0.bias"] = torch.zeros(5)
    torch.save(checkpoint, path)
    with pytest.raises(SystemExit, match="--resume: the run has another Agent or task: size mism"):
        run_here("ppo", "--resume", path.parent, "--total-timesteps", "256")


ONE_DECISION = {
    "mppo_beta": ("--num-envs 1 --num-steps 1025", "no standard deviation"),
    "ppo": ("--num-envs 3 --num-steps 3 --minibatch-size 4", "no standard deviation"),
    "trpo": ("--num-envs 1 --num-steps 1", "must be at least 2"),
    "recurrent_ppo": ("--num-envs 4 --num-minibatches 4 --num-steps 1", "--num-steps above 1"),
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_clear_errors(tmp_path, run_here, capsys, algorithm):
    def error_of(*arguments):
        """One line, or the words in the box that shows a wrong argument."""
        with pytest.raises(SystemExit) as error:
            run_here(algorithm, *arguments)
        box = re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().err)
        return " ".join(box.split()) if error.value.code == 2 else str(error.value)

    args = vars(module(algorithm).Args())
    task = {"env_id": "ForestryCrane-v0", "revision": crane_env.REVISION, **crane_options.DEFAULTS}
    ours = {"algorithm": algorithm, "task": task, "args": args}
    (tmp_path / "policy").mkdir()
    torch.save({**ours, "weights": {}, "global_step": 64}, tmp_path / "policy" / "checkpoint.pt")
    ours |= {"weights": {}, "optimizer": {}, "iteration": 1}
    (tmp_path / "unmarked").mkdir()
    torch.save(ours, tmp_path / "unmarked" / "checkpoint.pt")
    ours |= {"fingerprint": torch.zeros(1)}
    for name, change in {
        "other": {"algorithm": "other"},
        "task": {"task": task | {"revision": crane_env.REVISION - 1}},
        "more": {"args": {**args, "warp": 9}},
        "range": {"args": {**args, "gamma": 2.0}},
        "old": {"task": crane_env.REVISION},
    }.items():
        (tmp_path / name).mkdir()
        torch.save({**ours, **change}, tmp_path / name / "checkpoint.pt")
    for name in ("text", "empty"):
        (tmp_path / name).mkdir()
    (tmp_path / "text" / "checkpoint.pt").write_text("no checkpoint")
    here = f"; this is {algorithm}, task revision {crane_env.REVISION}"
    for name, reason in [
        ("other", f"is of other, task revision {crane_env.REVISION}{here}"),
        ("task", f"is of {algorithm}, task revision {crane_env.REVISION - 1}{here}"),
        ("more", "is damaged or not of this script"),
        ("policy", "lacks what a checkpoint has, as a policy.pt does"),
        ("unmarked", "lacks what a checkpoint has, as a policy.pt does"),
        ("old", "is damaged or not of this script"),
        ("text", "is damaged or not of this script"),
    ]:
        assert error_of("--resume", name) == f"--resume: {name}/checkpoint.pt {reason}"
    assert error_of("--resume", "range").endswith("gamma must be a number in [0, 1], got 2.0")
    mend = "give the folder of a run"
    for name in ("empty", "nowhere", "text/checkpoint.pt"):
        assert error_of("--resume", name) == f"--resume: there is no {name}/checkpoint.pt; {mend}"
    batches = "num_minibatches" if algorithm == "recurrent_ppo" else "minibatch_size"
    arguments, message = ONE_DECISION[algorithm]
    assert message in error_of(*arguments.split())
    for arguments, message in [
        ("--env-id nowhere:X-v0", "nowhere:X-v0: No module named 'nowhere'"),
        ("--env-id Pendulum-v77", "Pendulum-v77: "),
        ("--env-id CartPole-v1 --env.retry 0", "CartPole-v1: its observations or actions are no"),
        ("--env-id Pendulum-v1 --env.contact sdf", "Pendulum-v1 is not the crane and has no opti"),
        ("--env.frame-skip 0", "ForestryCrane-v0: frame_skip must be a whole number in [1, 1,800]"),
        ("--env.difficulty 2", "ForestryCrane-v0: difficulty must be a number in [0, 1], got 2.0"),
        ("--num-steps 1000000000", "num_steps must be a whole number in [1, 16,384], got 1000000"),
        ("--num-envs 16384 --num-steps 65", "--num-envs times --num-steps must be at most 1,048,"),
        (f"--{batches} 0", f"{batches} must be a whole number in ["),
        (
            "--hidden-sizes 64 0",
            "each of hidden_sizes must be a whole number in [1, 4,096], got (64, 0)",
        ),
        ("--eval-trials 0", "eval_trials must be a whole number in [1, 1,000], got 0"),
        ("--seed -1", "seed must be a whole number in [0, 4,294,967,295], got -1"),
        ("--gamma 1.01", "gamma must be a number in [0, 1], got 1.01"),
        ("--reward-scale nan", "reward_scale must be a number in [0, 1,000,000], got nan"),
        ("--learning-rate inf", "learning_rate must be a number in [0, 1,000,000], got inf"),
    ]:
        assert message in error_of(*arguments.split())
    assert not (tmp_path / "runs").exists()  # no wrong call leaves a folder


def test_recurrent_ppo_splits_cranes_evenly(run_here):
    with pytest.raises(SystemExit, match="--num-envs must be a multiple of --num-minibatches"):
        run_here("recurrent_ppo", "--num-envs", "6", "--num-minibatches", "4")


def test_an_error_is_one_line_on_stderr(tmp_path):
    line = command("ppo", "--env.difficulty", "2")
    result = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1 and result.stdout == ""
    assert result.stderr == "ForestryCrane-v0: difficulty must be a number in [0, 1], got 2.0\n"


@pytest.mark.slow
def test_two_runs_begun_at_once_have_folders_of_their_own(tmp_path):
    line = command("ppo", *one_minibatch("ppo"), "--eval-every", "0")
    both = [subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE) for _ in range(2)]
    errors = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    assert len(list(tmp_path.glob("runs/*/policy.pt"))) == 2


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_help_explains_every_argument(run_here, capsys, algorithm):
    with pytest.raises(SystemExit) as end:
        run_here(algorithm, "--help")
    assert end.value.code == 0
    text = re.sub(r"[│╭╮╰╯─]|--+(?=\s|$)", " ", capsys.readouterr().out)  # frames
    text = " ".join(text.split())
    text = re.sub(r", --(env\.)?no-\S+", "", text)  # of a switch
    told = dict(part.split(" ", 1) for part in re.split(r" (?=--)", text)[1:])
    arguments = [name for name in module(algorithm).Args.__dataclass_fields__ if name != "env"]
    arguments += [f"env.{name}" for name in crane_options.DEFAULTS]
    flags = ["--" + name.replace("_", "-") for name in arguments]
    assert set(told) == {"--help", *flags}
    for flag in flags:  # values in capitals or braces, then words, then the default
        words = " " + told[flag]
        assert re.search(r" [A-Za-z][A-Za-z']*[a-z].*\((default: |unset by default\))", words), flag


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_time_limit_is_not_the_end_of_the_world(tmp_path, run_here, algorithm):
    """1 for ever, cut every 5 steps: V = 1 / (1 - 0.9) = 10; 4.1 or less if a cut is an end.

    It stays 10 while the horizon grows to 30 steps, for the reward falls to 1 / 3.
    """
    arguments = "--env-id recall_env:Endless-v0 --num-envs 16 --num-steps 18 --gamma 0.9"
    arguments += " --hidden-sizes 16 --reward-scale 1 --eval-every 0"
    arguments += " --final-trials 0 --torch-threads 1 --max-grad-norm 10 --env.retry 0"
    updates, own = 60, " --learning-rate 3e-2"
    if algorithm == "recurrent_ppo":
        updates, own = 150, " --learning-rate 1e-2 --lstm-size 4"
    arguments += f" --total-timesteps {288 * updates} {own}"
    agent = run_here(algorithm, *arguments.split())["agent"]
    gamma = scalars(only_run(tmp_path))["schedule/gamma"]
    assert len(gamma) == updates and gamma[updates // 4] == pytest.approx(0.9)
    assert gamma[updates // 4 + 2] > 0.9001
    assert gamma[-1] == pytest.approx(1 - 0.1 / 3 ** (1 - 1 / (0.75 * updates)))
    obs = torch.zeros(1, 1)
    if algorithm == "recurrent_ppo":
        obs = agent.remember(obs[None], agent.initial_state(1), torch.ones(1, 1))[0][0]
    value = agent.get_value(obs).item()
    # seeds 1 to 3 of recurrent PPO end between 9.5 and 9.8, those of the others at 10.0
    assert value == pytest.approx(10, abs=1 if algorithm == "recurrent_ppo" else 0.1)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_schedules_along_the_run(tmp_path, run_here, algorithm):
    """Where nothing is learned, the width ends at its start and the whole of narrowing."""
    nothing = "--learning-rate 1e-30" + (" --max-kl 1e-12" if algorithm == "trpo" else "")
    arguments = f"--total-timesteps 256 --narrowing 0.6 --eval-every 0 {nothing}"
    run_here(algorithm, *small(algorithm), *arguments.split())
    saved = torch.load(only_run(tmp_path) / "policy.pt", weights_only=True)
    values = scalars(only_run(tmp_path))
    if algorithm == "mppo_beta":
        width, expected = saved["weights"]["actor.4.bias"], saved["args"]["log_excess_init"] + 0.6
        assert (np.diff(values["policy/alpha"]) > 0.1).all()
        assert values["schedule/perturbation"] == pytest.approx([0.1, 0.0375, 0, 0])
    else:
        width, expected = saved["weights"]["log_std"], saved["args"]["log_std_init"] - 0.6
        assert values["policy/std"] == pytest.approx(np.exp([-1.2, -1.35, -1.5, -1.65]), rel=1e-3)
    torch.testing.assert_close(width, torch.full_like(width, expected), rtol=0, atol=1e-4)
    rates = np.array(values["schedule/learning_rate"]) / 1e-30
    np.testing.assert_allclose(rates, [1, 0.75, 0.5, 0.25], rtol=1e-5)
    growth = 3 ** np.array([0, 0, 1 / 3, 2 / 3])  # from a quarter of the run on
    assert values["schedule/gamma"] == pytest.approx(1 - 0.03 / growth)


RECALL = "--env-id recall_env:Recall-v0 --num-envs 16 --num-steps 18 --update-epochs 4 --gamma 1"
RECALL += " --hidden-sizes 32 --learning-rate 3e-3 --reward-scale 1 --horizon-growth 1"
RECALL += " --eval-every 0 --final-trials 50 --torch-threads 1 --total-timesteps 25600"
RECALL += " --env.retry 0"


@pytest.mark.slow
def test_memory_is_what_solves_recall(tmp_path, run_here):
    """-1 is the best that a policy without memory can get."""
    returns = {}
    for algorithm, arguments in [
        ("recurrent_ppo", "--num-minibatches 4 --lstm-size 16"),
        ("ppo", "--minibatch-size 72"),
    ]:
        (tmp_path / algorithm).mkdir()
        run_here(algorithm, *RECALL.split(), *arguments.split(), cwd=tmp_path / algorithm)
        returns[algorithm] = scalars(only_run(tmp_path / algorithm))["final/episodic_return"][0]
    assert returns["recurrent_ppo"] > -0.1 and returns["ppo"] < -0.9


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["mppo_beta", "trpo"])
def test_learns_the_seen_cue(tmp_path, run_here, algorithm):
    run_here(algorithm, *RECALL.split(), "--env-id", "recall_env:Echo-v0")
    assert scalars(only_run(tmp_path))["final/episodic_return"][0] > -0.1
