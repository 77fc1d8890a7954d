"""What all four algorithm scripts promise, each run as a user would."""

import inspect
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
    command,
    module,
    one_minibatch,
    only_run,
    run,
    scalars,
    small,
)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gae_with_a_termination_and_a_truncation(algorithm):
    """gamma = 0.5, lambda = 0.5; step 1 ends by termination, step 2 by truncation with V = 4."""
    rewards = torch.tensor([[1.0], [2.0], [3.0], [4.0]])
    values = torch.tensor([[1.0], [1.0], [2.0], [2.0]])
    next_values = torch.tensor([[1.0], [0.0], [4.0], [6.0]])
    dones = torch.tensor([[0.0], [1.0], [1.0], [0.0]])
    # deltas: 1 + .5 - 1, 2 + 0 - 1, 3 + 2 - 2, 4 + 3 - 2; only step 0 looks past itself
    advantages = module(algorithm).compute_gae(rewards, values, next_values, dones, 0.5, 0.5)
    torch.testing.assert_close(advantages, torch.tensor([[0.75], [1.0], [3.0], [5.0]]))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gae_without_ends_is_the_discounted_sum_of_deltas(algorithm):
    torch.manual_seed(0)
    rewards, values, no_ends = torch.randn(6, 3), torch.randn(7, 3), torch.zeros(6, 3)
    compute_gae = module(algorithm).compute_gae
    advantages = compute_gae(rewards, values[:-1], values[1:], no_ends, 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    expected = sum(0.72**k * deltas[k] for k in range(6))
    torch.testing.assert_close(advantages[0], expected)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_bootstrap_values(algorithm):
    bootstrap_values = module(algorithm).bootstrap_values
    values = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    last_value = torch.tensor([4.0, 40.0])
    terminations = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    cut_at, cut_values = [(0, 1), (2, 0)], torch.tensor([-7.0, -8.0])
    expected = torch.tensor([[2.0, -7.0], [0.0, 30.0], [-8.0, 0.0]])
    result = bootstrap_values(values, last_value, terminations, cut_at, cut_values)
    torch.testing.assert_close(result, expected)
    result = bootstrap_values(values, last_value, 0 * terminations, [], None)
    torch.testing.assert_close(result, torch.cat([values[1:], last_value[None]]))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_normalizer_is_the_mean_and_variance_of_all_it_saw(algorithm):
    torch.manual_seed(0)
    scripts = module(algorithm)
    agent = scripts.Agent(18, np.full(6, -1.0), np.full(6, 1.0), scripts.Args(hidden_sizes=(8,)))
    batches = [5 + 3 * torch.randn(100, 18), -2 + torch.randn(37, 18)]
    for batch in batches:
        agent.update_normalizer(batch)
    everything = torch.cat(batches).double()
    torch.testing.assert_close(agent.obs_mean, everything.mean(0), atol=1e-4, rtol=1e-4)
    variance = everything.var(0, unbiased=False)
    torch.testing.assert_close(agent.obs_var, variance, atol=1e-3, rtol=1e-3)


SHARED = "layer_init bootstrap_values compute_gae crane_kwargs is_crane make_envs save_atomically"


@pytest.mark.parametrize("algorithm", ALGORITHMS[1:])
def test_what_the_scripts_share_is_the_same(algorithm):
    for name in SHARED.split():
        ours, theirs = (
            inspect.getsource(getattr(module(a), name)) for a in ("mppo_beta", algorithm)
        )
        assert ours == theirs, name
    assert "import mppo" not in (ROOT / f"{algorithm}_crane.py").read_text()


@pytest.mark.parametrize("algorithm", ["mppo_beta", "ppo", "recurrent_ppo"])
def test_ratio_is_one_on_the_first_minibatch(tmp_path, algorithm):
    run(algorithm, tmp_path, *one_minibatch(algorithm))
    values = scalars(only_run(tmp_path))
    assert abs(values["losses/old_approx_kl"][0]) < 1e-6
    assert abs(values["losses/approx_kl"][0]) < 1e-6
    assert values["losses/clipfrac"][0] == 0


KEYS = """
charts/SPS charts/simulation_SPS charts/learning_rate charts/updates charts/episodic_return
charts/episodic_length charts/success_rate losses/value_loss losses/policy_loss losses/entropy
losses/explained_variance losses/grad_norm reward/distance reward/grapple reward/lift reward/balance
termination/joint_limit time/rollout time/update eval/success_rate eval/success_rate_0.3m
""".split()
CLIPPED = ["losses/old_approx_kl", "losses/approx_kl", "losses/clipfrac"]
OWN_KEYS = {
    "mppo_beta": [*CLIPPED, "policy/alpha", "policy/beta", "policy/boundary_frac"],
    "ppo": [*CLIPPED, "policy/std"],
    "recurrent_ppo": [*CLIPPED, "policy/std"],
    "trpo": """policy/std trpo/kl trpo/step_fraction trpo/line_search_ok trpo/cg_residual
        trpo/expected_improvement trpo/improvement""".split(),
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_two_updates_on_the_crane_same_seed_same_weights(tmp_path, algorithm):
    arguments = [*small(algorithm), *"--num-steps 96 --total-timesteps 768 --eval-every 2".split()]
    weights = []
    for i, seed in enumerate(["3", "3", "4"]):
        folder = tmp_path / str(i)
        folder.mkdir()
        run(algorithm, folder, *arguments, "--seed", seed)
        policy = torch.load(only_run(folder) / "policy.pt", weights_only=True)
        assert policy["algorithm"] == algorithm and policy["global_step"] == 768
        weights.append(policy["weights"])
    assert all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])
    assert not torch.equal(weights[0]["actor.0.weight"], weights[2]["actor.0.weight"])
    values = scalars(only_run(tmp_path / "0"))
    assert not set(KEYS + OWN_KEYS[algorithm]) - set(values)
    assert all(np.isfinite(v).all() for v in values.values())
    assert values["losses/grad_norm"][0] > 0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_any_box_task(tmp_path, algorithm):
    arguments = "--env-id Pendulum-v1 --total-timesteps 128 --eval-every 1".split()
    run(algorithm, tmp_path, *small(algorithm), *arguments)
    values = scalars(only_run(tmp_path))
    assert values["eval/episodic_return"][0] < 0 and "charts/success_rate" not in values


def start(algorithm, cwd, *arguments):
    arguments = [*small(algorithm), "--eval-every", "0", *arguments]
    process = subprocess.Popen(
        command(algorithm, *arguments),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    for _ in range(1200):
        if list(Path(cwd).glob("runs/*/checkpoint.pt")):
            return process
        assert process.poll() is None, process.stderr.read()[-2000:]
        time.sleep(0.05)
    raise AssertionError("no checkpoint after a minute")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_killed_run_goes_on(tmp_path, algorithm):
    process = start(algorithm, tmp_path, "--total-timesteps", "3200")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    run_dir = only_run(tmp_path)
    before = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert 10 <= before["iteration"] < 50
    run(algorithm, tmp_path, "--resume", str(run_dir / "checkpoint.pt"))
    after = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert after["iteration"] == 50 and only_run(tmp_path) == run_dir
    steps = [s["step"].item() for s in after["optimizer"]["state"].values()]
    assert set(steps) == {50 * 4.0}  # 2 epochs of 2 minibatches each update: Adam's count went on
    assert after["weights"]["obs_count"] == pytest.approx(3200, abs=1)
    assert not list(run_dir.glob("*.tmp"))


@pytest.mark.parametrize("algorithm", ["mppo_beta", "trpo"])
def test_ctrl_c_leaves_both_files(tmp_path, algorithm):
    process = start(algorithm, tmp_path, "--total-timesteps", "640000")
    for file in only_run(tmp_path).glob("*.pt"):
        file.unlink()  # what is there afterwards was written on the way out
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors[-2000:]
    names = {p.name for p in only_run(tmp_path).glob("*.pt")}
    assert names == {"checkpoint.pt", "policy.pt"}
    checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    iteration = checkpoint["iteration"]
    assert iteration >= 10 and checkpoint["global_step"] == iteration * 64
    updates = {s["step"].item() for s in checkpoint["optimizer"]["state"].values()}
    assert 4 * iteration <= max(updates) <= 4 * iteration + 4


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_clear_errors(tmp_path, algorithm):
    torch.save({"algorithm": "other"}, tmp_path / "other.pt")
    for arguments, message in [
        ("--resume nowhere.pt", "--resume: no file nowhere.pt"),
        ("--resume other.pt", f"is no checkpoint.pt of {algorithm}"),
        ("--num-envs 0", "must be at least 1"),
        ("--env-id CartPole-v1", "no flat Box"),
        ("--env-id Pendulum-v77", "Pendulum-v77"),
    ][: 5 if algorithm == "mppo_beta" else 3]:
        result = run(algorithm, tmp_path, *arguments.split(), check=False)
        assert result.returncode == 1 and "Traceback" not in result.stderr
        assert message in result.stderr


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_help_explains_every_argument(tmp_path, algorithm):
    text = run(algorithm, tmp_path, "--help").stdout
    arguments = module(algorithm).Args.__dataclass_fields__
    for name in arguments:
        assert "--" + name.replace("_", "-") in text, name
    assert len(re.findall(r"\(default:", " ".join(text.split()))) == len(arguments)
    assert "MuJoCo integrator" in text


RECALL = "--env-id recall_env:Recall-v0 --num-envs 16 --num-steps 20 --update-epochs 4 --gamma 1"
RECALL += " --hidden-sizes 32 --learning-rate 3e-3 --reward-scale 1 --eval-every 0"
RECALL += " --final-trials 50 --torch-threads 1 --total-timesteps 25600"


def recalled(algorithm, cwd, *arguments):
    run(algorithm, cwd, *RECALL.split(), *arguments)
    return scalars(only_run(cwd))["final/episodic_return"][0]


def test_memory_is_what_solves_recall(tmp_path):
    """-1 is the best that a policy without memory can get."""
    (tmp_path / "with").mkdir(), (tmp_path / "without").mkdir()
    arguments = ["--num-minibatches", "4", "--lstm-size", "16"]
    assert recalled("recurrent_ppo", tmp_path / "with", *arguments) > -0.1
    assert recalled("ppo", tmp_path / "without", "--minibatch-size", "80") < -0.9


@pytest.mark.parametrize("algorithm", ["mppo_beta", "trpo"])
def test_learns_the_seen_cue(tmp_path, algorithm):
    run(algorithm, tmp_path, *RECALL.split(), "--env-id", "recall_env:Echo-v0")
    assert scalars(only_run(tmp_path))["final/episodic_return"][0] > -0.1
