"""The judge: intervals, tables, JSON, files, errors, and that trials are what they claim."""

import csv
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

import crane_env
import eval_crane

ROOT = Path(__file__).parent.parent


def run(*arguments, cwd=ROOT):
    command = [sys.executable, str(ROOT / "eval_crane.py"), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def test_wilson_interval():
    # by hand: p = 0.96, n = 100, z = 1.959964
    low, high = eval_crane.wilson_interval(96, 100)
    assert low == pytest.approx(0.9016, abs=1e-4) and high == pytest.approx(0.9843, abs=1e-4)
    assert eval_crane.wilson_interval(0, 10) == (0.0, pytest.approx(0.2775, abs=1e-4))
    assert eval_crane.wilson_interval(10, 10)[1] == pytest.approx(1.0)


def test_first_unmet_condition_is_the_failure():
    info = {"success": False, "time_to_reach": 2.0, "centre_miss": 0.4, "termination": "time_limit"}
    info |= {"not_reached": False, "not_lifted": False, "not_held": True, "off_centre": True}
    assert eval_crane.trial_record(0.5, info)["failure"] == "not_held"
    assert (
        eval_crane.trial_record(0.5, {**info, "termination": "overspeed"})["failure"] == "overspeed"
    )
    good = {**info, "success": True, "not_held": False, "off_centre": False}
    assert eval_crane.trial_record(0.5, good)["failure"] == ""


def test_json_and_csv(tmp_path):
    file = tmp_path / "trials.csv"
    arguments = ["--policy", "zero", "--trials", "2", "--diameters", "0.4", "0.8", "--seed", "5"]
    result = run(*arguments, "--json", "--csv", file)
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)  # standard output holds nothing else
    assert answer["policy"] == "zero" and answer["seed"] == 5
    assert answer["contact"] == "primitive" and answer["pose_noise"] == "none"
    assert [cell["diameter"] for cell in answer["cells"]] == [0.4, 0.8]
    for cell in answer["cells"]:
        assert cell["trials"] == 2 and cell["successes"] == 0 and cell["success_rate"] == 0
        assert cell["failures"] == {"not_reached": 2}
        assert cell["interval"][0] == 0 and 0.6 < cell["interval"][1] < 0.7
    assert answer["mean_success_rate"] == 0
    rows = list(csv.DictReader(file.open()))
    assert len(rows) == 4 and rows[0]["failure"] == "not_reached"


def test_both_tables_unless_noise_is_given():
    both = run("--policy", "random", "--trials", "1")
    assert both.returncode == 0, both.stderr
    assert "Table I, clean" in both.stdout and "Table II, pose noise" in both.stdout
    assert "| 94 " in both.stdout and "| 88 " in both.stdout and "96.3" in both.stdout
    one = run("--policy", "random", "--trials", "1", "--pose-noise", "episode")
    assert one.stdout.count("| mean") == 1


@pytest.mark.parametrize("algorithm", eval_crane.ALGORITHMS)
def test_shipped_policies_are_of_this_revision(algorithm, capsys):
    path = eval_crane.SHIPPED.with_name(f"{algorithm}_crane.pt")
    assert eval_crane.load_policy(path, stochastic=False)[2] == algorithm
    assert capsys.readouterr().err == ""


def test_shipped_policy_lifts_logs():
    result = run("--json", "--trials", "4", "--diameters", "0.4", "0.6", "--seed", "77")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["mean_success_rate"] >= 0.75


def test_scripted_crane_is_judged_like_a_policy():
    for signed in (True, False):  # environment and script must mean the same angle
        make_act, kwargs, _ = eval_crane.fixed_policy("scripted", 0, signed)
        assert kwargs["signed_yaw"] is signed and make_act().signed_yaw is signed
    for yaw in ("--signed-yaw", "--no-signed-yaw"):
        result = run("--policy", "scripted", yaw, "--json", "--trials", "1", "--diameters", "0.5")
        assert result.returncode == 0, result.stderr
        assert json.loads(result.stdout)["mean_success_rate"] == 1


def test_viewer_needs_a_display(monkeypatch):
    monkeypatch.setattr(eval_crane.sys, "platform", "linux")
    monkeypatch.setattr(eval_crane.sys, "argv", ["eval_crane.py", "--viewer"])
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SystemExit, match="needs a display"):
        eval_crane.main()


def test_stochastic_and_sdf(monkeypatch):
    """Sampling changes the trials and the seed makes it repeatable; SDF contact runs."""
    diameters, seeds = crane_env.monte_carlo_trials(3, 2, (0.5,))
    times = []
    for stochastic in (False, True, True):
        make_act, kwargs, _ = eval_crane.load_policy(eval_crane.SHIPPED, stochastic)
        torch.manual_seed(1)
        records = eval_crane.run_trials(make_act, kwargs, diameters, seeds)
        times.append([record["centre_miss"] for record in records])
    assert times[0] != times[1] and times[1] == times[2]
    sdf = eval_crane.run_trials(make_act, {**kwargs, "contact": "sdf"}, diameters, seeds)
    assert len(sdf) == 2


@pytest.mark.parametrize("script", eval_crane.SCRIPTS)
def test_acts_as_the_agent_of_any_algorithm(tmp_path, script):
    torch.manual_seed(0)
    args = script.Args(hidden_sizes=(16,))
    agent = script.Agent(18, np.full(6, -1.0), np.full(6, 1.0), args)
    with torch.no_grad():
        agent.actor[-1].weight.mul_(100)
    weights = {k: v for k, v in agent.state_dict().items() if not k.startswith("critic.")}
    policy = {"algorithm": script.ALGORITHM, "args": asdict(args), "weights": weights}
    torch.save(policy, tmp_path / "policy.pt")
    make_act, _, name = eval_crane.load_policy(tmp_path / "policy.pt", stochastic=False)
    assert name == script.ALGORITHM
    obs = torch.randn(3, 5, 18)  # three decisions of five cranes
    act, again = make_act(), make_act()
    acted = torch.stack([torch.as_tensor(act(o.numpy())) for o in obs])
    if name == "recurrent_ppo":
        features, _ = agent.remember(obs, agent.initial_state(5), torch.zeros(3, 5))
        expected = agent.to_env(agent.get_distribution(features).mean)
        fresh = again(obs[2].numpy())
        assert np.abs(fresh - acted[2].numpy()).max() > 1e-3  # it remembered the first two
    else:
        expected = torch.stack([agent.predict(o) for o in obs])
    torch.testing.assert_close(acted, expected.detach(), rtol=0, atol=1e-6)


def test_same_trial_in_any_batch(monkeypatch):
    """A trial does not depend on which trials are simulated beside it.

    With fixed actions to the bit; a network's rounding may change with the size of its batch.
    """
    make_act, kwargs, _ = eval_crane.fixed_policy("zero", 0)
    diameters, seeds = crane_env.monte_carlo_trials(3, 4, (0.3, 0.7))
    together = eval_crane.run_trials(make_act, kwargs, diameters, seeds)
    monkeypatch.setattr(eval_crane, "CRANES", 3)
    assert eval_crane.run_trials(make_act, kwargs, diameters, seeds) == together


def test_video(tmp_path):
    try:
        crane_env.mujoco.Renderer(crane_env.load_model(), 8, 8).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")
    film = tmp_path / "film.mp4"
    # an idle crane fails after 6 s: 120 frames
    result = run("--policy", "zero", "--diameters", "0.5", "--video", film)
    assert result.returncode == 0, result.stderr
    import imageio

    frames = imageio.mimread(film, memtest=False)
    assert len(frames) == 120 and frames[0].shape == (720, 1280, 3)
    assert np.std(frames[0]) > 10


def test_clear_errors(tmp_path, monkeypatch):
    def error_of(*arguments):
        monkeypatch.setattr(sys, "argv", ["eval_crane.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as error:
            eval_crane.main()
        return str(error.value)

    assert "no file nowhere.pt" in error_of("nowhere.pt")
    assert str(ROOT / "tests" / "policy.pt") in error_of(str(ROOT / "tests"))  # a run's folder
    assert "at least one number" in error_of("--diameters")
    assert "must end in .mp4 or .gif" in error_of("--video", "film.avi")
    assert "brings its own" in error_of("--no-signed-yaw")
    assert "--width must be even and lie in" in error_of("--video", "lift.mp4", "--width", "4000")
    assert "no folder nowhere" in error_of("--csv", "nowhere/trials.csv")
    (tmp_path / "junk.pt").write_bytes(b"junk")
    assert "is no policy.pt of this repository" in error_of(tmp_path / "junk.pt")
    saved = torch.load(eval_crane.SHIPPED, weights_only=True)
    torch.save({**saved, "algorithm": "sac"}, tmp_path / "sac.pt")
    assert "unknown algorithm 'sac'; known: mppo_beta, ppo" in error_of(tmp_path / "sac.pt")
    args = {**saved["args"], "hidden_sizes": (8, 8)}
    torch.save({**saved, "args": args}, tmp_path / "shape.pt")
    assert "does not fit a mppo_beta policy" in error_of(tmp_path / "shape.pt")
    torch.save({**saved, "weights": 3}, tmp_path / "weights.pt")
    assert "does not fit a mppo_beta policy" in error_of(tmp_path / "weights.pt")
    torch.save({**saved, "args": 3}, tmp_path / "args.pt")
    assert "is no policy.pt" in error_of(tmp_path / "args.pt")
    args = {**saved["args"], "env_id": "Pendulum-v1"}
    torch.save({**saved, "args": args}, tmp_path / "pendulum.pt")
    assert "trained on Pendulum-v1" in error_of(tmp_path / "pendulum.pt")
    assert "must lie in [0.3, 0.8]" in error_of("--diameters", "0.2", "--policy", "zero")
    assert "--trials must be at least 1" in error_of("--trials", "0")
    assert "--seed must be at least 0" in error_of("--seed", "-1")
    assert "--width must be even" in error_of("--video", "lift.mp4", "--width", "321")
    assert "PATH goes with" in error_of(tmp_path / "junk.pt", "--policy", "zero")
    assert "--stochastic goes with" in error_of("--policy", "random", "--stochastic")
    assert "judge nothing" in error_of("--video", tmp_path / "lift.mp4", "--json")
    assert "is a folder" in error_of("--csv", tmp_path)


def test_policy_of_another_revision_is_called_so(tmp_path, capsys):
    saved = torch.load(eval_crane.SHIPPED, weights_only=True)
    torch.save({**saved, "task": -1}, tmp_path / "old.pt")
    eval_crane.load_policy(tmp_path / "old.pt", stochastic=False)
    assert "old.pt is of another revision" in capsys.readouterr().err
