"""The memory of recurrent_ppo_crane.py (what all scripts share: test_scripts.py)."""

import numpy as np
import torch

from recurrent_ppo_crane import Agent, Args


def make_agent():
    torch.manual_seed(0)
    agent = Agent(18, np.full(6, -1.0), np.full(6, 1.0), Args(hidden_sizes=(16,), lstm_size=8))
    agent.update_normalizer(3 * torch.randn(50, 18) + 1)
    return agent


def sequence():
    torch.manual_seed(1)
    obs = torch.randn(12, 3, 18)
    starts = torch.zeros(12, 3)
    starts[0, 0] = starts[4, 1] = starts[5, 1] = starts[7, 2] = 1
    state = (torch.randn(3, 8), torch.randn(3, 8))
    return obs, state, starts


def test_sequence_is_step_by_step_with_resets_inside():
    agent, (obs, first_state, starts) = make_agent(), sequence()
    features, last_state = agent.remember(obs, first_state, starts)
    assert features.shape == (12, 3, 18 + 8)
    state = first_state
    for t in range(12):
        step, state = agent.remember(obs[t : t + 1], state, starts[t : t + 1])
        torch.testing.assert_close(step[0], features[t], rtol=0, atol=1e-6)
    for ours, theirs in zip(state, last_state):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6)


def test_memory_starts_empty_with_an_episode_and_lasts_until_its_end():
    agent, (obs, state, starts) = make_agent(), sequence()
    features, _ = agent.remember(obs, state, starts)
    fresh, _ = agent.remember(obs[7:], agent.initial_state(3), torch.zeros(5, 3))
    torch.testing.assert_close(features[7:, 2], fresh[:, 2])  # crane 2 began anew at step 7
    assert (features[7:, 0] - fresh[:, 0]).abs().max() > 1e-3  # crane 0 did not
    changed = obs.clone()
    changed[3] += 1
    other, _ = agent.remember(changed, state, starts)
    difference = (other - features).abs().amax(dim=-1)
    assert (difference[:3] == 0).all()
    assert (difference[4:, 0] > 0).all()  # remembered to the end
    assert (difference[4:, 1] == 0).all()  # forgotten when the episode ended at step 4


def test_looking_ahead_leaves_the_state_alone():
    agent, (obs, state, starts) = make_agent(), sequence()
    before = [part.clone() for part in state]
    agent.remember(obs, state, starts)
    assert all(torch.equal(a, b) for a, b in zip(before, state))


def test_cranes_do_not_share_memory():
    agent, (obs, state, starts) = make_agent(), sequence()
    features, _ = agent.remember(obs, state, starts)
    alone, _ = agent.remember(obs[:, 1:2], tuple(part[1:2] for part in state), starts[:, 1:2])
    torch.testing.assert_close(features[:, 1:2], alone, rtol=0, atol=1e-6)


def test_gradient_flows_through_time():
    agent, (obs, state, _) = make_agent(), sequence()
    obs.requires_grad_(True)
    features, _ = agent.remember(obs, state, torch.zeros(12, 3))
    agent.get_value(features)[-1].sum().backward()
    assert (obs.grad[0].abs().amax(dim=-1) > 0).all()


def test_acting_step_by_step_is_acting_on_the_sequence():
    agent, (obs, _, _) = make_agent(), sequence()
    with torch.no_grad():
        agent.actor[-1].weight.mul_(100)
        features, _ = agent.remember(
            agent.normalize(obs), agent.initial_state(3), torch.zeros(12, 3)
        )
        expected = agent.to_env(agent.get_distribution(features).mean)
    state = None
    for t in range(12):
        actions, state = agent.predict(obs[t].numpy(), state)
        np.testing.assert_allclose(actions, expected[t], rtol=0, atol=1e-5)
    fresh, _ = agent.predict(obs[11].numpy())
    assert np.abs(fresh - expected[11]).max() > 1e-2  # the memory mattered
