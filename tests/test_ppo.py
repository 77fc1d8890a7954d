"""The Gaussian policy of ppo_crane.py (what all scripts share: test_scripts.py)."""

import math

import numpy as np
import pytest
import torch

from ppo_crane import Agent, Args


def make_agent():
    torch.manual_seed(0)
    args = Args(hidden_sizes=(32, 32), log_std_init=math.log(0.5))
    return Agent(18, np.full(6, -2.0), np.full(6, 0.1), args)


def test_log_probability_is_the_gaussian_density():
    agent = make_agent()
    with torch.no_grad():
        agent.actor[-1].weight.zero_()
        agent.actor[-1].bias.fill_(0.3)
    logprob = agent.get_distribution(torch.zeros(1, 18)).log_prob(torch.full((1, 6), 1.3)).sum(-1)
    expected = 6 * (-0.5 * (1.0 / 0.5) ** 2 - math.log(0.5 * math.sqrt(2 * math.pi)))
    assert logprob.item() == pytest.approx(expected, rel=1e-5)


def test_environment_gets_clipped_actions_and_the_mean_when_evaluated():
    agent = make_agent()
    obs = np.random.default_rng(0).normal(size=(200, 18)).astype(np.float32)
    samples, state = agent.predict(obs, deterministic=False)
    assert samples.min() >= -2 and samples.max() == pytest.approx(0.1) and state is None
    assert 0.3 < (samples == samples.max()).mean() < 0.6  # P(a > 0.1) is 0.42 about 0
    with torch.no_grad():
        agent.actor[-1].weight.mul_(300)
        mean = agent.get_distribution(torch.as_tensor(obs)).mean
    assert mean.min() < -2 and mean.max() > 0.1
    np.testing.assert_allclose(agent.predict(obs)[0], mean.clamp(-2, 0.1), rtol=1e-6)


def test_spread_does_not_depend_on_the_state():
    agent = make_agent()
    spread = agent.get_distribution(100 * torch.randn(50, 18)).stddev
    torch.testing.assert_close(spread, torch.full((50, 6), 0.5))
