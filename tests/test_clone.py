"""benchmark/clone_scripted.py: demonstrations, and a network that imitates them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmark"))

import clone_scripted  # noqa: E402

import mppo_beta_crane as mppo  # noqa: E402

ENDS = {"perturbation": 0.3}  # a wild crane: some trials end before their time


def make_agent(args: mppo.Args, obs_dim: int = 18) -> mppo.Agent:
    torch.manual_seed(0)
    return mppo.Agent(obs_dim, -np.ones(6, np.float32), np.ones(6, np.float32), args)


@pytest.fixture(scope="module")
def demonstrations():
    args = mppo.Args(env_threads=1, **ENDS)
    return clone_scripted.demonstrate(make_agent(args), args, trials=32)


def test_demonstrations_are_trials_of_the_scripted_crane(demonstrations):
    obs, next_obs = demonstrations["obs"], demonstrations["next_obs"]
    alive, terminated = demonstrations["alive"], demonstrations["terminated"]
    assert obs.shape == (90, 32, 18) and demonstrations["actions"].shape == (90, 32, 6)
    assert (alive[0] == 1).all() and (alive.diff(dim=0) <= 0).all()
    assert 0 < (alive[-1] == 0).sum() < 32  # else the next lines test nothing
    goes_on = alive[1:] == 1
    assert torch.equal(obs[1:][goes_on], next_obs[:-1][goes_on])
    last = (alive[:-1] == 1) & ~goes_on
    assert (terminated[:-1][last] == 1).all()
    assert (obs[1:][last] != next_obs[:-1][last]).any(-1).all()  # a new start is not what followed
    share = demonstrations["actions"]
    margin = clone_scripted.MARGIN
    assert share.min() >= margin - 1e-6 and share.max() <= 1 - margin + 1e-6
    without_noise = clone_scripted.demonstrate(
        make_agent(mppo.Args()), mppo.Args(env_threads=1, perturbation=0.0), trials=32
    )["actions"]
    assert (share[0] - without_noise[0]).abs().max() <= 0.3 + 1e-6
    assert (share[0] - without_noise[0]).abs().mean() > 0.05


def test_the_network_imitates_what_was_shown_before_a_trials_end(demonstrations):
    """Actions after the end are nonsense here: who learns from them is far from the others."""
    shown = dict(demonstrations)
    ended = shown["alive"] == 0
    target = 0.5 + 0.3 * torch.tanh(shown["obs"][..., :6])
    shown["actions"] = torch.where(ended[..., None], torch.full_like(target, 0.99), target)
    args = clone_scripted.Args(clone_epochs=30, run=mppo.Args(minibatch_size=256))
    agent = make_agent(args.run)
    clone_scripted.clone(agent, shown, args)
    with torch.no_grad():
        mean = agent.get_distribution(agent.normalize(shown["obs"])).mean
    kept = ~ended
    assert (mean[kept] - target[kept]).abs().mean() < 0.03
    seen = shown["obs"][kept].double()
    torch.testing.assert_close(agent.obs_mean, seen.mean(0), atol=1e-3, rtol=1e-3)


def test_the_critic_knows_what_follows():
    """Reward 1 a decision: 1 / (1 - gamma) where the time limit cuts, the sum where it ends."""
    steps, cranes = 40, 64
    obs = torch.zeros(steps + 1, cranes, 18)
    obs[:, cranes // 2 :, 0] = torch.linspace(-1, 1, steps + 1)[:, None]  # this half terminates
    obs[:, cranes // 2 :, 1] = 1.0
    terminated = torch.zeros(steps, cranes)
    terminated[-1, cranes // 2 :] = 1
    shown = {"obs": obs[:-1], "next_obs": obs[1:], "terminated": terminated}
    shown |= {"rewards": torch.ones(steps, cranes) * 0.1, "alive": torch.ones(steps, cranes)}
    shown["actions"] = torch.full((steps, cranes, 6), 0.5)
    run = mppo.Args(minibatch_size=256, gamma=0.9, hidden_sizes=(64, 64))
    args = clone_scripted.Args(clone_epochs=150, run=run)
    agent = make_agent(run)
    clone_scripted.clone(agent, shown, args)
    with torch.no_grad():
        values = agent.get_value(agent.normalize(obs[:-1]))
    assert values[0, 0] == pytest.approx(0.1 / 0.1, rel=0.1)
    decisions_left = torch.arange(steps, 0, -1)
    expected = 0.1 * (1 - 0.9**decisions_left) / (1 - 0.9)
    assert (values[:, -1] - expected).abs().mean() < 0.08


def test_mppo_goes_on_from_the_clone(run_here, tmp_path):
    flags = "--num-envs 2 --num-steps 8 --minibatch-size 16 --total-timesteps 16 --eval-trials 1"
    flags += " --final-trials 0 --env-threads 1 --torch-threads 1"
    flags = flags.replace("--", "--run.") + " --trials 4 --clone-epochs 1"
    command = [sys.executable, str(ROOT / "benchmark" / "clone_scripted.py"), *flags.split()]
    printed = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    assert "go on with: python mppo_beta_crane.py --resume runs/" in printed.stdout
    (folder,) = (tmp_path / "runs").glob("*__cloned__*")
    before = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert before["iteration"] == 0
    run_here("mppo_beta", "--resume", str(folder))
    after = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert after["iteration"] == 1 and after["args"]["exp_name"] == "cloned"
    name = "actor.0.weight"
    step = (after["weights"][name] - before["weights"][name]).abs().max()
    assert 0 < step < 0.05


def test_other_tasks_are_refused(run_here):
    with pytest.raises(SystemExit, match="Pendulum-v1 is not the crane"):
        clone_scripted.main(clone_scripted.Args(run=mppo.Args(env_id="Pendulum-v1")))
