"""TRPO's linear algebra against explicit matrices (what all scripts share: test_scripts.py)."""

import math

import numpy as np
import pytest
import torch
from script_runs import one_minibatch, only_run, scalars
from torch.distributions import Normal

import trpo_crane
from trpo_crane import (
    Agent,
    Args,
    conjugate_gradient,
    fisher_vector_product,
    flat,
    line_search,
)


def make_agent(seed=0):
    torch.manual_seed(seed)
    agent = Agent(3, np.full(2, -1.0), np.full(2, 1.0), Args(hidden_sizes=(4, 5))).double()
    with torch.no_grad():  # at the small weights of the start F is nearly that of the last layer
        agent.actor[-1].weight.mul_(100)
        agent.log_std.copy_(torch.tensor([-1.2, 0.4]))
    return agent


def explicit_fisher(agent, obs):
    """Hessian of the mean KL divergence from the agent as it is, row by row."""
    parameters = agent.policy_parameters()
    new = agent.get_distribution(obs)
    old = Normal(new.loc.detach(), new.scale.detach())
    kl = torch.distributions.kl_divergence(old, new).sum(-1).mean()
    gradient = flat(torch.autograd.grad(kl, parameters, create_graph=True))
    assert gradient.abs().max() < 1e-12  # pi is pi_old
    rows = [torch.autograd.grad(g, parameters, retain_graph=True) for g in gradient]
    return torch.stack([flat(row) for row in rows])


def test_fisher_vector_product():
    agent = make_agent()
    obs = torch.randn(7, 3, dtype=torch.float64)
    fisher = explicit_fisher(agent, obs)
    assert fisher[:-2, :-2].abs().max() > 0.1
    for _ in range(5):
        vector = torch.randn(len(fisher), dtype=torch.float64)
        product = fisher_vector_product(agent, obs, 0.3)(vector)
        torch.testing.assert_close(product, fisher @ vector + 0.3 * vector, rtol=1e-6, atol=1e-6)


def test_conjugate_gradient():
    torch.manual_seed(1)
    root = torch.randn(12, 12, dtype=torch.float64)
    matrix, b = root @ root.T + torch.eye(12), torch.randn(12, dtype=torch.float64)
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, iterations=50)
    np.testing.assert_allclose(x, np.linalg.solve(matrix.numpy(), b.numpy()), rtol=1e-6)
    assert residual < 1e-9
    x, residual = conjugate_gradient(lambda v: matrix @ v, b, iterations=2)
    assert (
        residual == pytest.approx(((matrix @ x - b).norm() / b.norm()).item()) and residual > 1e-3
    )
    x, residual = conjugate_gradient(lambda v: matrix @ v, 0 * b, iterations=5)
    assert torch.equal(x, 0 * b) and residual == 0


def make_batch(agent):
    obs = torch.randn(64, 3, dtype=torch.float64)
    with torch.no_grad():
        old = agent.get_distribution(obs)
        actions = old.sample()
    advantages = actions[:, 0] - actions[:, 0].mean()
    return obs, actions, advantages, old


def ascent(agent, batch):
    surrogate, _ = trpo_crane.surrogate_and_kl(agent, *batch)
    return flat(torch.autograd.grad(surrogate, agent.policy_parameters()))


def test_surrogate_and_kl():
    agent = make_agent()
    batch = make_batch(agent)
    surrogate, kl = trpo_crane.surrogate_and_kl(agent, *batch)
    assert surrogate.item() == pytest.approx(0, abs=1e-12) and kl.item() == pytest.approx(0)
    old = Normal(batch[3].loc - 0.1, batch[3].scale / 2)
    _, kl = trpo_crane.surrogate_and_kl(agent, *batch[:3], old)
    # log(s2 / s1) + (s1^2 + d^2) / (2 s2^2) - 1/2, for both actions
    sigma = agent.log_std.detach().exp()
    expected = math.log(2) + ((sigma / 2) ** 2 + 0.01) / (2 * sigma**2) - 0.5
    assert kl.item() == pytest.approx(expected.sum().item())


def test_line_search_shortens_until_the_divergence_permits():
    agent = make_agent()
    batch, before = make_batch(agent), flat(p.detach() for p in agent.policy_parameters())
    step = 10 * ascent(agent, batch)
    args = Args(max_kl=0.01, line_search_steps=40, line_search_decay=0.5)
    fraction, kl, improvement = line_search(agent, step, batch, args)
    assert fraction == 0.5 ** round(math.log2(1 / fraction)) and fraction < 1
    assert 0 < kl <= 0.01 and improvement > 0
    after = flat(p.detach() for p in agent.policy_parameters())
    torch.testing.assert_close(after - before, fraction * step)
    surrogate, new_kl = trpo_crane.surrogate_and_kl(agent, *batch)
    assert new_kl.item() == pytest.approx(kl) and surrogate.item() == pytest.approx(improvement)


@pytest.mark.parametrize("failure", ["downhill", "too far", "not finite"])
def test_line_search_restores_exactly_on_failure(failure):
    agent = make_agent()
    batch, before = make_batch(agent), [p.clone() for p in agent.policy_parameters()]
    step = {"downhill": -1e-3, "too far": 1e6, "not finite": float("nan")}[failure]
    result = line_search(agent, step * ascent(agent, batch), batch, Args(max_kl=0.01))
    assert result == (0.0, 0.0, 0.0)
    assert all(torch.equal(a, b) for a, b in zip(before, agent.policy_parameters()))


def test_natural_step_spends_the_divergence_it_is_given():
    """For a small delta the quadratic model holds: KL(s) is delta, the gain g^T s."""
    agent = make_agent()
    batch = make_batch(agent)
    gradient = ascent(agent, batch)

    matvec = fisher_vector_product(agent, batch[0], 1e-6)
    direction, _ = conjugate_gradient(matvec, gradient, 100)
    step = torch.sqrt(2 * 1e-6 / (direction @ matvec(direction))) * direction
    fraction, kl, improvement = line_search(agent, step, batch, Args(max_kl=1.01e-6))
    assert fraction == 1 and kl == pytest.approx(1e-6, rel=0.01)
    assert improvement == pytest.approx((gradient @ step).item(), rel=0.01)


@pytest.mark.parametrize("decay", [0, 1, 1.5])
def test_line_search_must_shorten(decay):
    with pytest.raises(ValueError, match=r"line_search_decay must be a number in \[0.01, 0.99\]"):
        Args(line_search_decay=decay)


def test_direction_from_a_sample_length_from_all(tmp_path, run_here):
    weights = {}
    for samples in (8, 64, 1024):
        folder = tmp_path / str(samples)
        folder.mkdir()
        arguments = [*one_minibatch("trpo"), "--eval-every", "0", "--fisher-samples", samples]
        run_here("trpo", *arguments, cwd=folder)
        policy = torch.load(only_run(folder) / "policy.pt", weights_only=True)
        weights[samples] = policy["weights"]["actor.0.weight"]
        values = scalars(only_run(folder))
        assert values["trpo/line_search_ok"] == [1]
        # the length is that of all 64's curvature, so the line search need not shorten it
        assert values["trpo/step_fraction"] == [1]
        assert 0.02 < values["trpo/kl"][0] <= 0.04
    assert not torch.equal(weights[8], weights[64])
    assert torch.equal(weights[64], weights[1024])  # there are no more than 64
