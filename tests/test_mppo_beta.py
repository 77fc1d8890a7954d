"""The algorithm's formulas against hand-computed values, and the script end to end."""

import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.distributions import Beta

import mppo_beta_crane
from mppo_beta_crane import A_MIN, Agent, Args, compute_gae, shift_mean

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "mppo_beta_crane.py"
SMALL = ["--num-envs", "4", "--num-steps", "16", "--minibatch-size", "32", "--update-epochs", "2"]
SMALL += ["--hidden-sizes", "16", "16", "--eval-trials", "1", "--final-trials", "0"]
SMALL += ["--env-threads", "1", "--torch-threads", "1"]


def make_agent(seed=0):
    torch.manual_seed(seed)
    return Agent(18, np.full(6, -2.0), np.full(6, 3.0), Args(hidden_sizes=(32, 32)))


def run(cwd, *arguments, check=True):
    command = [sys.executable, str(SCRIPT), *arguments]
    result = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert not check or result.returncode == 0, result.stderr[-2000:]
    return result


def only_run(cwd):
    (run_dir,) = (Path(cwd) / "runs").iterdir()
    return run_dir


def scalars(run_dir):
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [e.value for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_gae_with_a_termination_and_a_truncation():
    """gamma = 0.5, lambda = 0.5; step 1 ends by termination, step 2 by truncation with V = 4."""
    rewards = torch.tensor([[1.0], [2.0], [3.0], [4.0]])
    values = torch.tensor([[1.0], [1.0], [2.0], [2.0]])
    next_values = torch.tensor([[1.0], [0.0], [4.0], [6.0]])
    dones = torch.tensor([[0.0], [1.0], [1.0], [0.0]])
    # deltas: 1 + .5 - 1, 2 + 0 - 1, 3 + 2 - 2, 4 + 3 - 2; only step 0 looks past itself
    advantages = compute_gae(rewards, values, next_values, dones, 0.5, 0.5)
    torch.testing.assert_close(advantages, torch.tensor([[0.75], [1.0], [3.0], [5.0]]))


def test_bootstrap_values():
    values = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    last_value = torch.tensor([4.0, 40.0])
    terminations = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    cut_at, cut_values = [(0, 1), (2, 0)], torch.tensor([-7.0, -8.0])
    expected = torch.tensor([[2.0, -7.0], [0.0, 30.0], [-8.0, 0.0]])
    result = mppo_beta_crane.bootstrap_values(values, last_value, terminations, cut_at, cut_values)
    torch.testing.assert_close(result, expected)
    result = mppo_beta_crane.bootstrap_values(values, last_value, 0 * terminations, [], None)
    torch.testing.assert_close(result, torch.cat([values[1:], last_value[None]]))


def test_perturbed_actions():
    torch.manual_seed(0)
    middle = torch.full((20_000,), 0.5)
    noise = mppo_beta_crane.perturb_actions(middle, 0.1) - middle
    assert noise.min() >= -0.1 and noise.max() <= 0.1 and abs(noise.mean()) < 2e-3
    assert noise.std().item() == pytest.approx(0.2 / math.sqrt(12), rel=0.02)
    ends = mppo_beta_crane.perturb_actions(torch.tensor([0.0, 1.0] * 50), 0.1)
    assert ends.min() >= A_MIN and ends.max() <= 1 - A_MIN
    assert torch.equal(mppo_beta_crane.perturb_actions(middle, 0.0), middle)


def test_gae_without_ends_is_the_discounted_sum_of_deltas():
    torch.manual_seed(0)
    rewards, values = torch.randn(6, 3), torch.randn(7, 3)
    advantages = compute_gae(rewards, values[:-1], values[1:], torch.zeros(6, 3), 0.9, 0.8)
    deltas = rewards + 0.9 * values[1:] - values[:-1]
    expected = sum(0.72**k * deltas[k] for k in range(6))
    torch.testing.assert_close(advantages[0], expected)


def test_alpha_and_beta_exceed_one_even_for_absurd_observations():
    agent = make_agent()
    with torch.no_grad():
        agent.actor[-1].weight.mul_(1e6)
    distribution = agent.get_distribution(1e6 * torch.randn(64, 18))
    for concentration in (distribution.concentration1, distribution.concentration0):
        assert concentration.min() > 1 and concentration.max() <= 1 + math.exp(3.5) + 1e-3
        assert concentration.max() > 30


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
            assert torch.isfinite(logprob).all() and logprob.abs().max() < 350


def test_log_probability_is_the_beta_density():
    agent = make_agent()
    set_head(agent, 1.0, -0.5)  # alpha = 1 + exp(3.5 tanh(1 / 3.5)), beta likewise
    alpha = 1 + math.exp(3.5 * math.tanh(1 / 3.5))
    beta = 1 + math.exp(3.5 * math.tanh(-0.5 / 3.5))
    a = 0.3
    normalizer = math.gamma(alpha + beta) / (math.gamma(alpha) * math.gamma(beta))
    expected = 6 * math.log(normalizer * a ** (alpha - 1) * (1 - a) ** (beta - 1))
    distribution = agent.get_distribution(torch.zeros(1, 18))
    logprob = distribution.log_prob(torch.full((1, 6), a)).sum(-1)
    assert logprob.item() == pytest.approx(expected, rel=1e-4)


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


def test_normalizer_is_the_mean_and_variance_of_all_it_saw():
    agent = make_agent()
    batches = [5 + 3 * torch.randn(100, 18), -2 + torch.randn(37, 18)]
    for batch in batches:
        agent.update_normalizer(batch)
    everything = torch.cat(batches).double()
    torch.testing.assert_close(agent.obs_mean, everything.mean(0), atol=1e-4, rtol=1e-4)
    variance = everything.var(0, unbiased=False)
    torch.testing.assert_close(agent.obs_var, variance, atol=1e-3, rtol=1e-3)


def test_saved_policy_acts_alike(tmp_path):
    agent = make_agent()
    agent.update_normalizer(10 * torch.randn(50, 18) + 4)
    mppo_beta_crane.save_atomically({"weights": agent.state_dict()}, tmp_path / "policy.pt")
    assert [p.name for p in tmp_path.iterdir()] == ["policy.pt"]
    copy = make_agent(seed=1)
    copy.load_state_dict(torch.load(tmp_path / "policy.pt", weights_only=True)["weights"])
    obs = torch.randn(9, 18)
    assert torch.equal(agent.predict(obs), copy.predict(obs))


@pytest.mark.parametrize("perturb", ["none", "action"])
def test_ratio_is_one_on_the_first_minibatch(tmp_path, perturb):
    arguments = ["--update-epochs", "1", "--minibatch-size", "64", "--total-timesteps", "64"]
    run(tmp_path, *SMALL, *arguments, "--perturb", perturb)
    values = scalars(only_run(tmp_path))
    assert abs(values["losses/old_approx_kl"][0]) < 1e-6
    assert abs(values["losses/approx_kl"][0]) < 1e-6
    assert values["losses/clipfrac"][0] == 0


def test_rpo_ratio_is_not_one(tmp_path):
    arguments = ["--update-epochs", "1", "--minibatch-size", "64", "--total-timesteps", "64"]
    run(tmp_path, *SMALL, *arguments, "--perturb", "rpo")
    assert scalars(only_run(tmp_path))["losses/approx_kl"][0] > 1e-4


KEYS = """
charts/SPS charts/simulation_SPS charts/learning_rate charts/updates charts/episodic_return
charts/episodic_length charts/success_rate losses/value_loss losses/policy_loss losses/entropy
losses/old_approx_kl losses/approx_kl losses/clipfrac losses/explained_variance losses/grad_norm
reward/distance reward/grapple reward/lift reward/balance termination/joint_limit time/rollout
time/update eval/success_rate eval/success_rate_0.3m policy/alpha policy/beta policy/boundary_frac
""".split()


def test_two_updates_on_the_crane_same_seed_same_weights(tmp_path):
    arguments = [*SMALL, "--num-steps", "96", "--total-timesteps", "768", "--eval-every", "2"]
    weights = []
    for i, seed in enumerate(["3", "3", "4"]):
        folder = tmp_path / str(i)
        folder.mkdir()
        run(folder, *arguments, "--seed", seed)
        policy = torch.load(only_run(folder) / "policy.pt", weights_only=True)
        assert policy["algorithm"] == "mppo_beta" and policy["global_step"] == 768
        weights.append(policy["weights"])
    assert all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])
    assert not torch.equal(weights[0]["actor.0.weight"], weights[2]["actor.0.weight"])
    values = scalars(only_run(tmp_path / "0"))
    assert not set(KEYS) - set(values)
    assert all(np.isfinite(v).all() for v in values.values())
    assert max(values["losses/entropy"]) <= 0  # a Beta on [0, 1] has no positive entropy
    assert values["losses/grad_norm"][0] > 0


def test_any_box_task(tmp_path):
    run(
        tmp_path, *SMALL, "--env-id", "Pendulum-v1", "--total-timesteps", "128", "--eval-every", "1"
    )
    values = scalars(only_run(tmp_path))
    assert values["eval/episodic_return"][0] < 0 and "charts/success_rate" not in values


def test_curriculum_starts_easy(tmp_path):
    run(tmp_path, *SMALL, "--curriculum", "--total-timesteps", "128", "--eval-every", "0")
    assert scalars(only_run(tmp_path))["charts/difficulty"] == [0.0, 0.0]


@pytest.mark.parametrize(
    "variant", [["--contact", "sdf", "--pose-noise", "step"], ["--signed-yaw", "--offset", "plus"]]
)
def test_variants_of_the_task_train(tmp_path, variant):
    run(tmp_path, *SMALL, *variant, "--total-timesteps", "128", "--eval-every", "2")
    assert len(scalars(only_run(tmp_path))["losses/policy_loss"]) == 2


def test_paper_protocol(tmp_path):
    """Its defaults, under explicit arguments that make two updates short."""
    small = [
        "--num-envs",
        "2",
        "--num-steps",
        "20",
        "--minibatch-size",
        "20",
        "--final-trials",
        "0",
    ]
    small += ["--update-epochs", "1", "--eval-every", "0", "--total-timesteps", "80"]
    result = run(tmp_path, "--paper", *small)
    assert "guessed" in result.stdout and "estimated hours" in result.stdout + result.stderr
    args = torch.load(only_run(tmp_path) / "policy.pt", weights_only=True)["args"]
    assert args["hidden_sizes"] == (256, 256, 256, 256) and args["learning_rate"] == 3e-4
    assert args["frame_skip"] == 1 and args["contact"] == "sdf" and args["reward"] == "paper"
    assert args["integrator"] == "implicit" and args["solver"] == "CG" and args["num_envs"] == 2
    assert mppo_beta_crane.PAPER.num_envs == 42 and mppo_beta_crane.PAPER.num_steps == 1000
    assert mppo_beta_crane.PAPER.update_epochs == 30


def start(cwd, *arguments):
    command = [sys.executable, str(SCRIPT), *SMALL, "--eval-every", "0", *arguments]
    process = subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    )
    for _ in range(1200):
        if list(Path(cwd).glob("runs/*/checkpoint.pt")):
            return process
        assert process.poll() is None, process.stderr.read()[-2000:]
        time.sleep(0.05)
    raise AssertionError("no checkpoint after a minute")


def test_killed_run_goes_on(tmp_path):
    process = start(tmp_path, "--total-timesteps", "3200")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    run_dir = only_run(tmp_path)
    before = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert 10 <= before["iteration"] < 50
    run(tmp_path, "--resume", str(run_dir / "checkpoint.pt"))
    after = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    assert after["iteration"] == 50 and only_run(tmp_path) == run_dir
    steps = [s["step"].item() for s in after["optimizer"]["state"].values()]
    assert set(steps) == {50 * 4.0}  # 2 epochs of 2 minibatches each update: Adam's count went on
    assert after["weights"]["obs_count"] == pytest.approx(3200, abs=1)
    assert not list(run_dir.glob("*.tmp"))


def test_ctrl_c_leaves_both_files(tmp_path):
    process = start(tmp_path, "--total-timesteps", "640000")
    for file in only_run(tmp_path).glob("*.pt"):
        file.unlink()  # what is there afterwards was written on the way out
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors[-2000:]
    names = {p.name for p in only_run(tmp_path).glob("*.pt")}
    assert names == {"checkpoint.pt", "policy.pt"}
    checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    assert (
        checkpoint["iteration"] >= 10 and checkpoint["global_step"] == checkpoint["iteration"] * 64
    )
    updates = {s["step"].item() for s in checkpoint["optimizer"]["state"].values()}
    assert 4 * checkpoint["iteration"] <= max(updates) <= 4 * checkpoint["iteration"] + 4


def test_clear_errors(tmp_path):
    result = run(tmp_path, "--resume", "nowhere.pt", check=False)
    assert result.returncode == 1 and result.stderr.strip().startswith(
        "--resume: no file nowhere.pt"
    )
    torch.save({"algorithm": "other"}, tmp_path / "other.pt")
    result = run(tmp_path, "--resume", "other.pt", check=False)
    assert result.returncode == 1 and "no checkpoint.pt of mppo_beta" in result.stderr
    result = run(tmp_path, "--env-id", "Pendulum-v77", check=False)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    result = run(tmp_path, "--num-envs", "0", check=False)
    assert result.returncode == 1 and result.stderr.strip().endswith("must be at least 1")
    result = run(tmp_path, "--env-id", "CartPole-v1", check=False)
    assert result.returncode == 1 and "no flat Box" in result.stderr


def test_help_explains_every_argument(tmp_path):
    text = run(tmp_path, "--help").stdout
    for name in Args.__dataclass_fields__:
        assert "--" + name.replace("_", "-") in text, name
    assert len(re.findall(r"\(default:", " ".join(text.split()))) == len(Args.__dataclass_fields__)
    assert "MuJoCo integrator" in text and "what eps moves" in text
