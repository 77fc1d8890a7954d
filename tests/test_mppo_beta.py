"""The Beta policy, its perturbation and its flags (what all scripts share: test_scripts.py)."""

import math

import numpy as np
import pytest
import torch
from script_runs import one_minibatch, only_run, scalars, small

import crane_env
import mppo_beta_crane
from mppo_beta_crane import A_MIN, Agent, Args

ALGORITHM = "mppo_beta"


def make_agent(seed=0):
    torch.manual_seed(seed)
    return Agent(18, np.full(6, -2.0), np.full(6, 3.0), Args(hidden_sizes=(32, 32)))


def test_perturbed_actions():
    torch.manual_seed(0)
    middle = torch.full((20_000,), 0.5)
    noise = mppo_beta_crane.perturb_actions(middle, 0.1) - middle
    assert noise.min() >= -0.1 and noise.max() <= 0.1 and abs(noise.mean()) < 2e-3
    assert noise.std().item() == pytest.approx(0.2 / math.sqrt(12), rel=0.02)
    ends = mppo_beta_crane.perturb_actions(torch.tensor([0.0, 1.0] * 50), 0.1)
    assert ends.min() >= A_MIN and ends.max() <= 1 - A_MIN
    assert torch.equal(mppo_beta_crane.perturb_actions(middle, 0.0), middle)


def test_alpha_and_beta_exceed_one_even_for_absurd_observations():
    agent = make_agent()
    with torch.no_grad():
        agent.actor[-1].weight.mul_(1e6)
    distribution = agent.get_distribution(1e6 * torch.randn(64, 18))
    for concentration in (distribution.concentration1, distribution.concentration0):
        assert concentration.min() > 1 and concentration.max() <= 1 + math.exp(5) + 1e-2
        assert concentration.max() > 140


def set_head(agent, alpha_outputs, beta_outputs):
    """Make the actor's outputs these, whatever it observes."""
    with torch.no_grad():
        agent.actor[-1].weight.zero_()
        agent.actor[-1].bias[:6], agent.actor[-1].bias[6:] = alpha_outputs, beta_outputs


def test_log_probability_is_finite_at_the_clamps():
    agent = make_agent()
    for alpha, beta in [(0.0, 0.0), (50.0, -50.0), (-50.0, 50.0), (50.0, 50.0)]:
        set_head(agent, alpha, beta)
        for bound in (A_MIN, 1 - A_MIN):
            logprob = agent.get_distribution(torch.zeros(1, 18)).log_prob(torch.full((1, 6), bound))
            assert torch.isfinite(logprob).all() and logprob.abs().max() < 1400


def test_log_probability_is_the_beta_density():
    agent = make_agent()
    set_head(agent, 1.0, -0.5)  # alpha = 1 + exp(5 tanh(1 / 5)), beta likewise
    alpha = 1 + math.exp(5 * math.tanh(1 / 5))
    beta = 1 + math.exp(5 * math.tanh(-0.5 / 5))
    a = 0.3
    normalizer = math.gamma(alpha + beta) / (math.gamma(alpha) * math.gamma(beta))
    expected = 6 * math.log(normalizer * a ** (alpha - 1) * (1 - a) ** (beta - 1))
    distribution = agent.get_distribution(torch.zeros(1, 18))
    logprob = distribution.log_prob(torch.full((1, 6), a)).sum(-1)
    assert logprob.item() == pytest.approx(expected, rel=1e-4)


def test_untrained_policy_is_as_wide_as_asked():
    torch.manual_seed(0)
    agent = Agent(18, np.zeros(6), np.ones(6), Args(log_excess_init=1.5))
    distribution = agent.get_distribution(torch.randn(100, 18))
    alpha = 1 + math.exp(5 * math.tanh(1.5 / 5))
    std = torch.full((100, 6), math.sqrt(1 / (4 * (2 * alpha + 1))))  # of a Beta with beta = alpha
    torch.testing.assert_close(distribution.stddev, std, atol=5e-3, rtol=0)


def test_mean_action_on_the_admissible_range():
    agent = make_agent()
    obs = torch.randn(5, 18)
    distribution = agent.get_distribution(obs)
    alpha, beta = distribution.concentration1, distribution.concentration0
    expected = -2 + 5 * alpha / (alpha + beta)
    actions, state = agent.predict(obs.numpy())
    assert state is None
    np.testing.assert_allclose(actions, expected.detach(), rtol=1e-5)
    many = np.repeat(obs.numpy(), 200, axis=0)
    samples, _ = agent.predict(many, deterministic=False)
    assert samples.min() >= -2 and samples.max() <= 3 and samples.std() > 0.5


def test_saved_policy_acts_alike(tmp_path):
    agent = make_agent()
    agent.update_normalizer(10 * torch.randn(50, 18) + 4)
    torch.save({"weights": agent.state_dict()}, tmp_path / "policy.pt")
    copy = make_agent(seed=1)
    copy.load_state_dict(torch.load(tmp_path / "policy.pt", weights_only=True)["weights"])
    obs = np.random.default_rng(0).normal(size=(9, 18))
    np.testing.assert_array_equal(agent.predict(obs)[0], copy.predict(obs)[0])


def test_what_is_executed_is_perturbed(monkeypatch, run_here):
    """alpha = beta = 1 + e^4.997: a_n has a deviation of 0.029, and with g one of 0.065."""
    spread, executed, step = {}, [], crane_env.CraneVectorEnv.step

    def recording_step(self, actions):
        executed.append(actions.copy())
        return step(self, actions)

    monkeypatch.setattr(crane_env.CraneVectorEnv, "step", recording_step)
    for epsilon in ("0", "0.1"):
        arguments = [*one_minibatch(ALGORITHM), "--log-excess-init", "20", "--eval-every", "0"]
        left = run_here(ALGORITHM, *arguments, "--perturbation", epsilon)
        spread[epsilon] = left["b_actions"].std().item()
        last_rollout = torch.as_tensor(np.concatenate(executed[-16:]))
        torch.testing.assert_close(last_rollout, 2 * left["b_actions"] - 1)
    alpha = 1 + math.exp(5 * math.tanh(20 / 5))
    own = 1 / (4 * (2 * alpha + 1))  # variance of a Beta with beta = alpha
    assert spread["0"] == pytest.approx(math.sqrt(own), rel=0.15)  # 384 numbers
    assert spread["0.1"] == pytest.approx(math.sqrt(own + 0.2**2 / 12), rel=0.15)


def test_needs_bounded_actions(run_here):
    with pytest.raises(SystemExit, match="a Beta needs bounds"):
        run_here(ALGORITHM, "--env-id", "recall_env:Unbounded-v0")


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant, options",
    [
        ("--env.contact sdf --env.pose-noise step", {"contact": "sdf", "pose_noise": "step"}),
        ("--env.no-signed-yaw --env.offset minus", {"signed_yaw": False, "offset": "minus"}),
    ],
)
def test_variants_of_the_task_train(tmp_path, run_here, variant, options):
    arguments = [*variant.split(), "--total-timesteps", "128", "--eval-every", "2"]
    left = run_here(ALGORITHM, *small(ALGORITHM), *arguments)
    assert len(scalars(only_run(tmp_path))["losses/policy_loss"]) == 2
    options = options | {"retry": 0.5}  # the script's own default stays
    task = torch.load(only_run(tmp_path) / "policy.pt", weights_only=True)["task"]
    for where in (left["envs"].unwrapped.options, task):
        assert options.items() <= where.items()
