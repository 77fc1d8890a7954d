"""The Beta policy, its perturbation and its flags (what all scripts share: test_scripts.py)."""

import math
import runpy
import sys

import numpy as np
import pytest
import torch
from script_runs import ROOT, one_minibatch, only_run, run, scalars, small
from torch.distributions import Beta

import crane_env
import mppo_beta_crane
from mppo_beta_crane import A_MIN, Agent, Args, shift_mean

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
    torch.testing.assert_close(agent.predict(obs), -2 + 5 * alpha / (alpha + beta))
    samples = torch.cat([agent.predict(obs, deterministic=False) for _ in range(200)])
    assert samples.min() >= -2 and samples.max() <= 3 and samples.std() > 0.5


def test_rpo_shifts_the_mean_and_keeps_the_concentration():
    before = Beta(torch.tensor([3.0, 1.2, 30.0]), torch.tensor([5.0, 8.0, 1.1]))
    after = shift_mean(before, torch.tensor([0.1, -0.1, 0.1]))
    concentration = before.concentration1 + before.concentration0
    torch.testing.assert_close(after.concentration1 + after.concentration0, concentration)
    assert after.mean[0].item() == pytest.approx(3 / 8 + 0.1)
    assert after.concentration1.min() > 1 and after.concentration0.min() > 1


def test_saved_policy_acts_alike(tmp_path):
    agent = make_agent()
    agent.update_normalizer(10 * torch.randn(50, 18) + 4)
    mppo_beta_crane.save_atomically({"weights": agent.state_dict()}, tmp_path / "policy.pt")
    assert [p.name for p in tmp_path.iterdir()] == ["policy.pt"]
    copy = make_agent(seed=1)
    copy.load_state_dict(torch.load(tmp_path / "policy.pt", weights_only=True)["weights"])
    obs = torch.randn(9, 18)
    assert torch.equal(agent.predict(obs), copy.predict(obs))


def test_ratio_is_one_on_the_first_minibatch_without_perturbation(tmp_path):
    run(ALGORITHM, tmp_path, *one_minibatch(ALGORITHM), "--perturb", "none")
    values = scalars(only_run(tmp_path))
    assert abs(values["losses/approx_kl"][0]) < 1e-6 and values["losses/clipfrac"][0] == 0


def test_rpo_ratio_is_not_one(tmp_path):
    run(ALGORITHM, tmp_path, *one_minibatch(ALGORITHM), "--perturb", "rpo")
    assert scalars(only_run(tmp_path))["losses/approx_kl"][0] > 1e-4


def test_curriculum_rises_with_success(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    advance = crane_env.CraneVectorEnv.advance

    def lucky_advance(self, actions):
        *step, info = advance(self, actions)
        return *step, info | {"success": np.ones(self.num_envs, bool)}

    monkeypatch.setattr(crane_env.CraneVectorEnv, "advance", lucky_advance)
    arguments = "--curriculum --num-envs 64 --num-steps 64 --total-timesteps 24576 --eval-every 0"
    arguments += " --update-epochs 1 --hidden-sizes 16 --final-trials 0"
    monkeypatch.setattr(sys, "argv", ["mppo_beta_crane.py", *arguments.split()])
    runpy.run_path(str(ROOT / "mppo_beta_crane.py"), run_name="__main__")
    difficulty = scalars(only_run(tmp_path))["charts/difficulty"]
    # 0.05 for every 200 episodes that succeeded; six rollouts of 64 cranes end more than 200
    assert difficulty[0] == 0 and difficulty[-1] >= 0.05 - 1e-6
    steps = np.diff(difficulty)
    assert np.all(np.isclose(steps, 0) | np.isclose(steps, 0.05, atol=1e-6))
    checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    assert checkpoint["difficulty"] >= difficulty[-1] - 1e-6


def test_needs_bounded_actions(tmp_path):
    result = run(ALGORITHM, tmp_path, "--env-id", "recall_env:Unbounded-v0", check=False)
    assert result.returncode == 1 and "a Beta needs bounds" in result.stderr


@pytest.mark.parametrize(
    "variant",
    [["--contact", "sdf", "--pose-noise", "step"], ["--no-signed-yaw", "--offset", "minus"]],
)
def test_variants_of_the_task_train(tmp_path, variant):
    arguments = [*variant, "--total-timesteps", "128", "--eval-every", "2"]
    run(ALGORITHM, tmp_path, *small(ALGORITHM), *arguments)
    assert len(scalars(only_run(tmp_path))["losses/policy_loss"]) == 2
