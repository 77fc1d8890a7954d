"""The judge: intervals, tables, JSON, files, errors, and that trials are what they claim."""

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import gymnasium
import imageio
import mujoco
import numpy as np
import pytest
import torch

import crane_env
import crane_options
import crane_policies
import crane_runs
import crane_task
import crane_trials
import crane_view
import eval_crane
import export_onnx
import machine
from crane_policies import SHIPPED, FixedPolicy
from eval_crane import Args, judge

ROOT = Path(__file__).parent.parent
CRANE = "ForestryCrane-v0"


def run(*arguments, cwd=ROOT):
    command = [sys.executable, str(ROOT / "eval_crane.py"), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


@pytest.fixture
def run_here(monkeypatch, capsys):
    """run_here(*arguments) gives standard output and standard error of the judge, run here."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["eval_crane.py", *map(str, arguments)])
        monkeypatch.setattr(sys, "path", sys.path[:])
        threads = torch.get_num_threads()
        try:
            eval_crane.main()
        finally:
            torch.set_num_threads(threads)
        return capsys.readouterr()

    return run


def test_wilson_interval():
    # by hand: p = 0.96, n = 100, z = 1.959964
    low, high = eval_crane.wilson_interval(96, 100)
    assert low == pytest.approx(0.9016, abs=1e-4) and high == pytest.approx(0.9843, abs=1e-4)
    assert eval_crane.wilson_interval(0, 10) == (0.0, pytest.approx(0.2775, abs=1e-4))
    assert eval_crane.wilson_interval(10, 10)[1] == pytest.approx(1.0)


def test_first_unmet_condition_is_the_failure():
    end = {"success": False, "time_to_reach": 2.0, "centre_miss": 0.4, "termination": "time_limit"}
    end |= {"not_reached": False, "not_lifted": False, "not_held": True, "off_centre": True}
    care = {name: float(k) for k, name in enumerate(crane_env.CARE)}
    end |= care
    kept = {"success": False, "time_to_reach": 2.0, "centre_miss": 0.4, **care}
    assert eval_crane.trial_record(end) == {**kept, "failure": "not_held"}
    early = {**end, "termination": "overspeed"}
    assert eval_crane.trial_record(early) == {**kept, "failure": "overspeed"}
    good = {**end, "success": True, "not_held": False, "off_centre": False}
    assert eval_crane.trial_record(good) == {**kept, "success": True, "failure": ""}


def test_cells():
    records = [{"diameter": 0.8, "success": True, "failure": "", "gentle": False}]
    records += [{"diameter": 0.8, "success": True, "failure": "", "gentle": True}] * 2
    records += [{"diameter": 0.8, "success": False, "failure": "not_held", "gentle": False}]
    records += [{"diameter": 0.3, "success": False, "failure": "overspeed", "gentle": False}] * 2
    thin, thick = eval_crane.summarize(records)
    assert thin["diameter"] == 0.3 and thick["diameter"] == 0.8
    assert thin["successes"] == 0 and thin["failures"] == {"overspeed": 2}
    assert thin["gentle_rate"] == 0 and thick["gentle_rate"] == 0.5
    assert thick["success_rate"] == 0.75 and thick["failures"] == {"not_held": 1}
    assert thick["trials"] == 4 and thick["interval"] == eval_crane.wilson_interval(3, 4)
    assert thick["gentle_interval"] == eval_crane.wilson_interval(2, 4)


def test_json_and_csv(tmp_path):
    file = tmp_path / "trials.csv"
    arguments = ["--policy", "zero", "--trials", "2", "--diameters", "0.4", "0.8", "--seed", "5"]
    result = run(*arguments, "--json", "--csv", file)
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout)  # standard output holds nothing else
    assert answer["policy"] == "zero" and answer["seed"] == 5 and answer["env_id"] == CRANE
    assert answer["contact"] == "primitive" and answer["pose_noise"] == "none"
    assert [cell["diameter"] for cell in answer["cells"]] == [0.4, 0.8]
    for cell in answer["cells"]:
        assert cell["trials"] == 2 and cell["successes"] == 0 and cell["success_rate"] == 0
        assert cell["failures"] == {"not_reached": 2}
        assert cell["interval"][0] == 0 and 0.6 < cell["interval"][1] < 0.7
    assert answer["mean_success_rate"] == answer["mean_gentle_rate"] == 0
    assert answer["mean_success_interval"] == list(eval_crane.wilson_interval(0, 4))
    assert answer["trials"] == 4 and answer["versions"]["mujoco"] == mujoco.__version__
    costs = answer["costs"]  # without a success only the force on the ground is known
    assert costs["peak [kN]"] == 0 and costs["up [s]"] is costs["oil [l]"] is None
    rows = list(csv.DictReader(file.open()))
    assert [row["diameter"] for row in rows] == ["0.4", "0.4", "0.8", "0.8"]
    assert {row["failure"] for row in rows} == {"not_reached"}
    assert {row["pose_noise"] for row in rows} == {"none"}
    assert [row["trial"] for row in rows] == ["0", "1", "0", "1"]
    assert {row["seed"] for row in rows} == {"5"}


def test_an_interrupted_judge_keeps_its_trials(run_here, tmp_path, monkeypatch):
    """Ctrl-C in the second batch of the second table."""
    monkeypatch.setattr(eval_crane, "CRANES", 2)
    play, batches = eval_crane.run_trials, []

    def interrupted(*args):
        batches.append(args)
        if len(batches) == 4:
            raise KeyboardInterrupt
        return play(*args)

    monkeypatch.setattr(eval_crane, "run_trials", interrupted)
    file = tmp_path / "trials.csv"
    with pytest.raises(KeyboardInterrupt):
        line = ("--policy", "zero", "--trials", "2", "--diameters", "0.4", "0.8", "--csv", file)
        run_here(*line)
    rows = [(row["pose_noise"], row["diameter"]) for row in csv.DictReader(file.open())]
    assert rows == [("none", "0.4")] * 2 + [("none", "0.8")] * 2 + [("step", "0.4")] * 2


def test_both_tables_unless_noise_is_given(run_here, tmp_path):
    file = tmp_path / "trials.csv"
    both = run_here("--policy", "random", "--trials", "1", "--csv", file).out
    assert "Table I, clean" in both and "Table II, pose noise" in both
    assert "| 94 " in both and "| 88 " in both and "96.3" in both
    rows = list(csv.DictReader(file.open()))
    assert [row["pose_noise"] for row in rows] == ["none"] * 6 + ["step"] * 6
    one = run_here("--policy", "random", "--trials", "1", "--pose-noise", "episode").out
    assert one.count("| mean") == 1 and "Pose noise: random" in one


def test_the_papers_figures_stand_beside_the_papers_task_only(run_here, tmp_path):
    """A policy brings its own options: here the machine's drives under the name of the task."""
    saved = torch.load(SHIPPED.with_stem("ppo_crane_hydraulic"), weights_only=True)
    saved["task"]["env_id"] = CRANE
    torch.save(saved, tmp_path / "policy.pt")
    short = ["--trials", "1", "--pose-noise", "none", "--diameters", "0.5"]
    table = run_here(str(tmp_path / "policy.pt"), *short).out
    assert "Trials: ppo" in table and "Table I" not in table and "| 98 " not in table
    both = run_here(str(tmp_path / "policy.pt"), str(SHIPPED), *short).out
    assert "mean of" not in both and f"| {CRANE}, actuators='hydraulic', sensors=True |" in both
    table = run_here(*short, "--env-id", f"crane_env:{CRANE}").out
    assert "Table I, clean" in table and "| 98 " in table


def test_several_policies_are_compared(run_here):
    paths = [str(SHIPPED.with_name(f"{name}.pt")) for name in ("mppo_beta_crane", "ppo_crane")]
    words = [*paths, "--trials", "4", "--diameters", "0.3", "--seed", "60000"]
    output = run_here(*words).out
    assert output.count("Table I, clean") == output.count("Table II, pose noise") == 2
    table = output[output.index("| task |") :]
    for noise in ("none", "step"):
        scores = [
            json.loads(line)
            for line in run_here(*words, "--json", "--pose-noise", noise).out.splitlines()
        ]
        assert [score["policy"] for score in scores] == paths
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
        rows = [row[2:] for row in rows if row[:2] == [CRANE, noise]]
        success, gentle = (
            [100 * s[f"mean_{which}_rate"] for s in scores] for which in ("success", "gentle")
        )
        for row, path, *of in zip(rows, paths, success, gentle):
            assert row == [*(f"{rate:.1f}" for rate in of), path]
        assert rows[2] == [f"{np.mean(success):.1f}", f"{np.mean(gentle):.1f}", "mean of 2"]


def test_means_over_policies(capsys):
    """Only policies on one task have a mean."""
    good, bad = {"success": True, "gentle": True}, {"success": False, "gentle": False}
    rough = {"success": True, "gentle": False}
    tables = {("a", "ideal", "none"): [good, good], ("a", "ideal", "step"): [bad, bad]}
    tables |= {("b", "ideal", "none"): [rough, bad], ("b", "ideal", "step"): [rough, rough]}
    tables |= {("c", "hydraulic", "none"): [good, rough]}
    eval_crane.print_comparison(tables)
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[3:]]
    assert [" ".join(cell.strip() for cell in row) for row in rows] == [
        "ideal none 100.0 100.0 a",
        "ideal none 50.0 0.0 b",
        "ideal none 75.0 50.0 mean of 2",
        "ideal step 0.0 0.0 a",
        "ideal step 100.0 0.0 b",
        "ideal step 50.0 0.0 mean of 2",
        "hydraulic none 100.0 50.0 c",
    ]


def test_table_of_costs(capsys):
    """Medians and the mean time above 20 kN; of the successes, but for the force on the ground."""
    trial = {name: 0.0 for name in crane_env.CARE} | {"diameter": 0.5, "failure": ""}
    good = trial | {"success": True, "gentle": True, "time_up": 4.0, "ground_peak": 1e3}
    rough = trial | {"success": True, "gentle": False, "time_up": 5.0, "ground_peak": 30e3}
    rough["ground_time"] = 0.3
    bad = trial | {"success": False, "gentle": False, "time_up": np.inf, "ground_peak": 2e3}
    records = [good | {"litres": 3.0}, rough | {"litres": 5.0}, bad | {"litres": 1.0}]
    eval_crane.print_care(records, eval_crane.summarize(records))
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if "|" in line]
    interval = "{:5.1f} - {:5.1f}".format(*(100 * x for x in eval_crane.wilson_interval(1, 3)))
    expected = ["33.3", interval.strip(), *"2 0 0.1 4 0 0 4.5 0 0".split()]
    assert [cell.strip() for cell in rows[2]] == ["0.5", *expected]
    assert [cell.strip() for cell in rows[3]] == ["all", *expected]


@pytest.mark.parametrize("algorithm", crane_policies.ALGORITHMS)
def test_shipped_policies_are_of_this_revision(algorithm, capsys):
    path = SHIPPED.with_name(f"{algorithm}_crane.pt")
    _, task, name = crane_policies.load_policy(path)
    assert name == algorithm and task["env_id"] == CRANE
    assert task["revision"] == crane_env.REVISION and capsys.readouterr().err == ""
    # what a policy is trained on is what is registered, but for its training's own options
    own = {"difficulty", "retry"}
    trained = {name: task[name] for name in crane_options.DEFAULTS.keys() - own}
    assert trained.items() <= crane_options.DEFAULTS.items()


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(SHIPPED.parent.iterdir()), ids=lambda p: p.stem)
def test_shipped_policies_lift_logs(path, run_here):
    """Four trials of three diameters each, on the level that the policy was made for."""
    line = ("--json", "--trials", "4", "--diameters", "0.4", "0.5", "0.6", "--seed", "77")
    answer = json.loads(run_here(path, *line).out)
    assert answer["mean_success_rate"] >= 0.5 and answer["changed"] == {}
    level = path.stem.partition("crane")[2].strip("_").title()
    assert answer["env_id"] == f"ForestryCrane{level}-v0"


def test_shipped_policy_in_plain_gymnasium():
    """gymnasium.make without any option observes what the policy was trained to observe."""
    policy, _, _ = crane_policies.load_policy(SHIPPED)
    env, wins = gymnasium.make(CRANE), 0
    for seed in range(4):
        obs, _ = env.reset(seed=seed)
        state, ended = None, False
        while not ended:
            actions, state = policy.predict(obs[None], state)
            obs, _, terminated, truncated, info = env.step(actions[0])
            ended = terminated or truncated
        wins += info["success"]
    assert wins >= 3


@pytest.mark.slow
def test_scripted_crane_is_judged_like_a_policy(run_here):
    """Environment and script must mean the same angle."""
    for yaw in ("--signed-yaw", "--no-signed-yaw"):
        line = ("--policy", "scripted", yaw, "--json", "--trials", "1", "--diameters", "0.5")
        assert json.loads(run_here(*line).out)["mean_success_rate"] == 1


MINE = "crane_env:ForestryCrane-v0"


def options_of(*, policy="file", trained_on=None, **args):
    arguments = Args(policy=policy, **args)
    return eval_crane.task_of(arguments, trained_on or {"env_id": CRANE})


def test_task_to_judge_on(capsys):
    other = {"offset": "minus", "axes": "world", "signed_yaw": False, "frame_skip": 10}
    trained_on = {"env_id": MINE, "revision": 6, **crane_options.complete(other)}
    trained_on |= {"difficulty": 0.0, "retry": 0.25}
    own = ("difficulty", "retry")  # of the training alone
    options = {name: trained_on[name] for name in crane_options.DEFAULTS if name not in own}
    assert options_of(trained_on=trained_on) == (MINE, options)
    changed = (MINE, options | {"contact": "sdf"})
    assert options_of(trained_on=trained_on, contact="sdf") == changed
    assert capsys.readouterr().err == ""
    # another task is taken as it is registered, and what the policy does not know is said
    assert options_of(trained_on=trained_on, env_id=CRANE) == (CRANE, {"sensors": False})
    said = capsys.readouterr().err.splitlines()
    assert sorted(line.split("=")[0] for line in said) == [
        f"the policy knows {name}" for name in ("axes", "frame_skip", "offset", "signed_yaw")
    ]
    assert "the policy knows axes='world'; ForestryCrane-v0 has 'crane'" in said
    hydraulic = "ForestryCraneHydraulic-v0"
    seeing = {"env_id": hydraulic, **crane_options.complete({"sensors": True})}
    assert options_of(trained_on=seeing, env_id=CRANE) == (CRANE, {"sensors": True})
    said = capsys.readouterr().err.splitlines()
    assert said[0] == f"the policy was trained on {hydraulic}"
    assert said[1] == "the policy knows sensors=True; ForestryCrane-v0 has False"
    scripted = {"axes": "crane", "offset": "plus", "signed_yaw": False}
    paper = "ForestryCranePaper-v0"
    assert options_of(policy="scripted", env_id=paper, signed_yaw=False) == (paper, scripted)
    assert options_of(policy="zero", env_id=paper, contact="sdf") == (paper, {"contact": "sdf"})


def test_trials_are_of_the_full_task(tmp_path, run_here):
    """A task that starts easy is judged as its training judges it."""
    gymnasium.register(
        "EasyCrane-v0", vector_entry_point=crane_env.CraneVectorEnv, kwargs={"difficulty": 0.0}
    )
    rows = []
    for env_id in ("EasyCrane-v0", CRANE):
        words = f"--policy scripted --env-id {env_id} --trials 2 --diameters 0.5 --pose-noise none"
        run_here(*words.split(), "--csv", str(tmp_path / "trials.csv"))
        rows.append((tmp_path / "trials.csv").read_text())
    assert rows[0] == rows[1]
    del gymnasium.registry["EasyCrane-v0"]


def test_options_of_the_training_are_said(run_here, monkeypatch):
    """A score under other options than the task's own does not stand beside the paper's."""
    policy, task, name = crane_policies.load_policy(SHIPPED)
    words = "--trials 1 --diameters 0.5 --pose-noise none".split()
    assert "Table I, clean" in run_here(*words).out
    assert json.loads(run_here(*words, "--json").out)["changed"] == {}
    task |= {"speed": "mjcf", "retry": 0.5}
    monkeypatch.setattr(eval_crane, "load_policy", lambda path: (policy, task, name))
    told = run_here(*words).out
    assert "speed='mjcf', seed" in told and "Table I" not in told
    assert json.loads(run_here(*words, "--json").out)["changed"] == {"speed": "mjcf"}


def test_the_shipped_policy_knows_the_registered_task(capsys):
    _, task, _ = crane_policies.load_policy(SHIPPED)
    eval_crane.task_of(Args(env_id=CRANE), task)
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_the_papers_task_is_another_than_the_shipped_policys():
    line = "--env-id ForestryCranePaper-v0 --contact primitive --trials 1 --diameters 0.5 --json"
    result = run(*line.split())
    assert result.returncode == 0, result.stderr
    for known in ("signed_yaw=True", "axes='crane'", "offset='plus'", "frame_skip=20"):
        assert f"the policy knows {known}; ForestryCranePaper-v0 has " in result.stderr
    answer = json.loads(result.stdout)
    assert answer["env_id"] == "ForestryCranePaper-v0" and answer["contact"] == "primitive"
    assert answer["mean_success_rate"] < 1  # it cannot know where the log is


@pytest.mark.slow
def test_the_contact_model_reported_is_the_one_judged(run_here, monkeypatch):
    judged = []

    def one_failure(policy, env_id, options, args):
        envs = crane_trials.make_envs(env_id, 1, **options)
        judged.append(envs.unwrapped.options["contact"])
        record = {name: 0.0 for name in crane_env.CARE} | {"success": False}
        record |= {"time_to_reach": 1.0, "centre_miss": 0.0}
        return [{"diameter": 0.5, "failure": "overspeed", **record}]

    monkeypatch.setattr(eval_crane, "judge", one_failure)
    for contact in ([], ["--contact", "primitive"], ["--contact", "sdf"]):
        for env_id in (CRANE, "ForestryCranePaper-v0"):
            line = ("--policy", "zero", "--json", "--env-id", env_id, *contact)
            assert json.loads(run_here(*line).out)["contact"] == judged[-1]
    assert judged == ["primitive", "sdf"] + ["primitive"] * 2 + ["sdf"] * 2


def test_viewer_needs_a_display(run_here, monkeypatch):
    monkeypatch.setattr(crane_env, "HEADLESS", True)
    with pytest.raises(SystemExit, match="needs a display"):
        run_here("--viewer")


def test_stochastic_trials_from_the_command_line(run_here, tmp_path):
    """They differ from the mean action's. --seed repeats them, whatever torch drew before."""

    def misses(*arguments):
        torch.rand(len(arguments))
        line = ("--trials", "2", "--diameters", "0.5", "--pose-noise", "none", "--env-threads", "1")
        run_here(*line, "--csv", tmp_path / "trials.csv", *arguments)
        with open(tmp_path / "trials.csv") as file:
            return [row["centre_miss"] for row in csv.DictReader(file)]

    drawn = misses("--stochastic", "--seed", "3")
    assert drawn == misses("--stochastic", "--seed", "3")
    assert set(drawn) & set(misses("--seed", "3")) == set()


@pytest.mark.slow
def test_sdf_trials():
    policy, _, _ = crane_policies.load_policy(SHIPPED)
    args = Args(trials=2, diameters=(0.5,), seed=3, env_threads=1)
    records = list(judge(policy, CRANE, {"contact": "sdf"}, args))
    assert len(records) == 2 and any(record["success"] for record in records)


@pytest.mark.parametrize("named", [True, False])  # older files do not name their script
@pytest.mark.parametrize("script", crane_policies.SCRIPTS)
def test_acts_as_the_agent_of_any_algorithm(tmp_path, script, named):
    torch.manual_seed(0)
    args = script.Args(hidden_sizes=(16,))
    agent = script.Agent(18, np.full(6, -1.0), np.full(6, 1.0), args)
    agent.update_normalizer(3 * torch.randn(40, 18) + 1)
    with torch.no_grad():
        agent.actor[-1].weight.mul_(100)
    weights = {k: v for k, v in agent.state_dict().items() if not k.startswith("critic.")}
    task = {"env_id": CRANE, "revision": crane_env.REVISION, **crane_options.DEFAULTS}
    low, high = agent.action_low, agent.action_high
    policy = {
        "algorithm": script.ALGORITHM,
        "args": asdict(args),
        "weights": weights,
        "task": task,
        "spaces": {"obs_dim": 18, "low": low, "high": high},
        "fingerprint": crane_runs.fingerprint(agent, 18),
    }
    policy |= {"script": Path(script.__file__).name} if named else {}
    torch.save(policy, tmp_path / "policy.pt")
    loaded, trained_on, name = crane_policies.load_policy(tmp_path)  # the run's folder or the file
    assert name == script.ALGORITHM and trained_on == task
    obs = torch.randn(3, 5, 18)  # three decisions of five cranes
    with torch.no_grad():
        seen = agent.normalize(obs)
        if name == "recurrent_ppo":
            seen, _ = agent.remember(seen, agent.initial_state(5), torch.zeros(3, 5))
        expected = agent.to_env(agent.get_distribution(seen).mean)
    state = None
    for decision, action in zip(obs, expected):
        acted, state = loaded.predict(decision.numpy(), state)
        np.testing.assert_allclose(acted, action, rtol=0, atol=1e-5)
    assert expected.std() > 0.05


def test_fixed_policies():
    obs = np.zeros((4, 18))
    actions, _ = FixedPolicy("zero").predict(obs)
    np.testing.assert_array_equal(actions, np.zeros((4, 6)))
    torch.manual_seed(1)
    policy = FixedPolicy("random")
    actions, later = policy.predict(obs)[0], policy.predict(obs)[0]
    assert np.abs(actions).max() <= 1 and actions.min() < -0.3 and actions.std() > 0.3
    assert np.abs(actions - later).max() > 0.1
    torch.manual_seed(1)  # as each table does
    np.testing.assert_array_equal(actions, policy.predict(obs)[0])


def test_same_trial_in_any_batch(monkeypatch):
    """A trial does not depend on which trials are simulated beside it.

    With fixed actions to the bit; a network's rounding may change with the size of its batch.
    """
    args = Args(trials=4, diameters=(0.3, 0.7), seed=3, env_threads=1)
    together = list(judge(FixedPolicy("zero"), CRANE, {}, args))
    assert [record["diameter"] for record in together] == [0.3] * 4 + [0.7] * 4
    assert len({record["centre_miss"] for record in together}) == 8
    monkeypatch.setattr(eval_crane, "CRANES", 3)
    assert list(judge(FixedPolicy("zero"), CRANE, {}, args)) == together


@pytest.fixture
def open_gl():
    try:
        mujoco.Renderer(machine.load_model(), 8, 8).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_video(tmp_path, run_here, monkeypatch, open_gl, kind):
    monkeypatch.setattr(crane_task, "REACH_TIME", 0.4)  # an idle crane fails then
    film, seeds = tmp_path / f"film.{kind}", []

    class Trial(crane_view.Trial):
        def __init__(self, crane, seed, diameter):
            seeds.append(seed.spawn_key)
            super().__init__(crane, seed, diameter)

    monkeypatch.setattr(crane_view, "Trial", Trial)
    line = ("--policy", "zero", "--diameters", "0.5", "0.7", "--video", film, "--width", "128")
    assert f"2 trials filmed in {film}, 0 succeeded" in run_here(*line, "--trial", "3").out
    assert seeds == [(500, 3), (700, 3)]  # as the fourth trials of monte_carlo_trials
    frames = imageio.mimread(film, memtest=False)
    assert frames[0].shape[:2] == (72, 128) and np.std(frames[0]) > 10
    # 20 frames a second and ten of the end; a .gif leaves out frames that are as the one before
    assert len(frames) == 2 * (8 + 10) if kind == "mp4" else 2 <= len(frames) <= 36
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50  # of another trial
    assert [path.name for path in tmp_path.iterdir()] == [film.name]


def test_a_film_counts_its_successes(tmp_path, run_here, monkeypatch, open_gl):
    """The scripted crane lifts one log and is too late for another."""
    monkeypatch.setattr(crane_view, "FPS", 1)
    film, late = tmp_path / "film.mp4", crane_task.REACH_TIME

    class Trial(crane_view.Trial):
        def __init__(self, crane, seed, diameter):
            monkeypatch.setattr(crane_task, "REACH_TIME", 0.4 if diameter == 0.5 else late)
            super().__init__(crane, seed, diameter)

    monkeypatch.setattr(crane_view, "Trial", Trial)
    line = ("--policy", "scripted", "--diameters", "0.4", "0.5", "--width", "128")
    assert f"2 trials filmed in {film}, 1 succeeded" in run_here(*line, "--video", film).out


def test_clear_errors(tmp_path, run_here, capsys):
    def error_of(*arguments):
        """One line, or the words in the box that shows a wrong argument."""
        with pytest.raises(SystemExit) as error:
            run_here(*arguments)
        box = re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().err)
        return " ".join(box.split()) if error.value.code == 2 else str(error.value)

    assert "no file nowhere.pt; train one first" in error_of("nowhere.pt")
    assert "no file scripted; --policy scripted" in error_of("scripted")
    for run in ("old", "new"):
        (tmp_path / "runs" / run).mkdir(parents=True)
        (tmp_path / "runs" / run / "policy.pt").touch()
    os.utime(tmp_path / "runs" / "old" / "policy.pt", (0, 0))
    assert f"the newest run there is {tmp_path}/runs/new" in error_of(tmp_path / "runs")
    assert f"the newest run there is {tmp_path}/runs/new" in error_of(tmp_path / "runs" / "typo")
    assert str(ROOT / "tests" / "policy.pt") in error_of(str(ROOT / "tests"))  # a run's folder
    assert "at least one number" in error_of("--diameters")
    assert "names a diameter twice" in error_of("--diameters", "0.5", "0.5")
    assert "mean action only" in error_of("policy.onnx", "--stochastic")
    assert "must end in .mp4 or .gif" in error_of("--video", "film.avi")
    assert "brings its own" in error_of("--no-signed-yaw")
    assert "--trial and --camera are for --video" in error_of("--trial", "3")
    assert "--trial and --camera are for --video" in error_of("--camera", "side")
    assert "--width is for --video" in error_of("--width", "320")
    assert "drop --trials" in error_of("--video", "lift.mp4", "--trials", "2")
    wide = error_of("--video", "lift.mp4", "--width", "4000")
    assert "width must be a whole number in [64, 1,920], got 4000" in wide
    assert "--width must be even" in error_of("--video", "lift.mp4", "--width", "321")
    assert "choose --video or --viewer" in error_of("--video", "lift.mp4", "--viewer")
    assert "no folder nowhere" in error_of("--csv", "nowhere/trials.csv")
    assert "each of diameters must be a number in [0.3, 0.8]" in error_of("--diameters", "0.2")
    assert "trials must be a whole number in [1, 10,000], got 0" in error_of("--trials", "0")
    assert "seed must be a whole number in [0, " in error_of("--seed", "-1")
    assert "env_threads must be a whole number in [0, 256]" in error_of("--env-threads", "-1")
    assert "PATH goes with" in error_of(tmp_path / "junk.pt", "--policy", "zero")
    assert "PATH names a policy twice" in error_of(SHIPPED, SHIPPED)
    two = [SHIPPED, SHIPPED.with_name("ppo_crane.pt")]
    assert "take one policy" in error_of(*two, "--csv", "trials.csv")
    assert "--stochastic goes with" in error_of("--policy", "random", "--stochastic")
    assert "judge nothing" in error_of("--video", tmp_path / "lift.mp4", "--json")
    assert "is no file" in error_of("--csv", tmp_path)
    assert "is no file" in error_of("--csv", "/dev/full")  # renaming would replace it
    slow = error_of("--policy", "scripted", "--env-id", "ForestryCranePaper-v0")
    assert slow == "the scripted crane decides every 0.1 s, not every 0.005 s"
    gymnasium.register(
        "FastCrane-v0", vector_entry_point=crane_env.CraneVectorEnv, kwargs={"speed": "mjcf"}
    )
    fast = error_of("--policy", "scripted", "--env-id", "FastCrane-v0")
    assert fast == "the scripted crane knows the speed limits of the real machine only"


def test_clear_errors_of_damaged_policies(tmp_path, capsys):
    path = tmp_path / "policy.pt"

    def error_of(**change):
        torch.save(saved | change, path)
        with pytest.raises(SystemExit) as error:
            crane_policies.load_policy(path)
        return str(error.value).removeprefix(str(path))

    saved = torch.load(SHIPPED, weights_only=True)
    known = "mppo_beta, ppo, trpo, recurrent_ppo"
    gone = f": unknown algorithm 'sac'; known: {known}; its script sac.py is not in this folder"
    assert error_of(algorithm="sac", script="sac.py") == gone
    older = {"algorithm": "sac", "script": ""}  # files that do not name their script
    assert error_of(**older) == f": unknown algorithm 'sac'; known: {known}"
    for change in [
        {"args": saved["args"] | {"hidden_sizes": (8, 8)}},
        {"args": saved["args"] | {"warp": 9}},
        {"weights": 3},
    ]:
        said = error_of(**change)
        assert said.startswith(" does not fit mppo_beta_crane.py: ")
        assert said.endswith("; undo the change of mppo_beta_crane.py or train again")
    assert "acts otherwise" in error_of(fingerprint=saved["fingerprint"][:-1])
    # the first files had a number as task
    for change in ({"args": 3}, {"task": 6}, {"script": None}, {"fingerprint": None}):
        assert error_of(**change) == " is no policy.pt of this repository"
    pendulum = {"task": {"env_id": "Pendulum-v1"}, "algorithm": "sac", "script": "sac.py"}
    assert error_of(**pendulum) == " was trained on Pendulum-v1, not on the crane"
    for name in saved:  # each is needed, but for the name of the script and the decisions so far
        torch.save({key: value for key, value in saved.items() if key != name}, path)
        if name not in ("script", "global_step"):
            with pytest.raises(SystemExit, match="policy.pt "):
                crane_policies.load_policy(path)
    path.write_bytes(b"junk")
    with pytest.raises(SystemExit, match="is no policy.pt of this repository"):
        crane_policies.load_policy(path)
    assert capsys.readouterr().err == ""
    torch.save(saved | {"task": saved["task"] | {"revision": -1}}, path)
    crane_policies.load_policy(path)
    assert "was trained on task revision -1" in capsys.readouterr().err


def test_an_edited_copy_of_a_script_is_judged_with_its_own_network(tmp_path, monkeypatch, run_here):
    copy = tmp_path / "my_ppo_crane.py"
    copy.write_text((ROOT / "ppo_crane.py").read_text().replace("nn.Tanh()", "nn.ReLU()"))
    line = "--num-envs 2 --num-steps 8 --minibatch-size 8 --total-timesteps 16 --eval-every 0"
    command = [sys.executable, str(copy), *line.split(), "--final-trials", "0"]
    paths = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run(command, cwd=tmp_path, env=paths, check=True, capture_output=True)
    (path,) = tmp_path.glob("runs/*/policy.pt")
    monkeypatch.chdir(tmp_path)
    agent, _, name = crane_policies.load_policy(path)
    assert isinstance(agent.actor[1], torch.nn.ReLU) and name == "my_ppo_crane.py"
    export_onnx.main(path, tmp_path / "policy.onnx")
    assert crane_policies.load_policy(tmp_path / "policy.onnx")[2] == "my_ppo_crane.py"
    printed = run_here(path, "--trials", "1", "--pose-noise", "none").out
    assert "my_ppo_crane.py (" in printed and "| 0.8 " in printed
    scores = printed[printed.index("| task |") :]
    assert str(path) in scores and "mean of" not in scores
    copy.write_text(copy.read_text().replace("nn.ReLU()", "nn.SiLU()"))
    with pytest.raises(SystemExit, match="undo the change of my_ppo_crane.py or train"):
        crane_policies.load_policy(path)
    copy.rename(tmp_path / "gone.py")
    said = (
        "/ppo_crane.py acts otherwise than in the training; my_ppo_crane.py wrote it; copy my_ppo"
    )
    with pytest.raises(SystemExit, match=said):
        crane_policies.load_policy(path)
    saved = torch.load(path, weights_only=True)
    torch.save({key: value for key, value in saved.items() if key != "script"}, path)
    with pytest.raises(SystemExit, match="otherwise than in the training; undo the change of ppo_"):
        crane_policies.load_policy(path)
    torch.save(saved | {"algorithm": "my_ppo"}, path)
    with pytest.raises(SystemExit, match="its script my_ppo_crane.py is not in this folder"):
        crane_policies.load_policy(path)


@pytest.mark.parametrize("script", ["mppo_beta_crane.py", "mppo_beta_torchrun.py"])
def test_our_scripts_are_no_edited_copies(tmp_path, script):
    torch.save(torch.load(SHIPPED, weights_only=True) | {"script": script}, tmp_path / "policy.pt")
    assert crane_policies.load_policy(tmp_path)[2] == "mppo_beta"


def test_a_missing_policy_is_met_before_the_first_trial(tmp_path, run_here, capsys):
    with pytest.raises(SystemExit, match="no file"):
        run_here(SHIPPED, tmp_path / "nowhere.pt", "--trials", "1")
    assert capsys.readouterr().out == ""


def test_a_policy_of_the_users_own(tmp_path, monkeypatch, run_here):
    """It is made anew for each batch of trials, and may remember what it saw in that batch."""
    (tmp_path / "my_module.py").write_text(
        "import numpy as np, torch\n"
        "class Counter:\n"
        "    made = 0\n"
        "    def __init__(self): self.steps, Counter.made = 0, Counter.made + 1\n"
        "    def __call__(self, obs):\n"
        "        self.steps += 1\n"
        "        assert self.steps <= 90\n"
        "        return np.zeros((len(obs), 6))\n"
        "class Model:\n"
        "    def predict(self, obs, state, deterministic): return torch.zeros(len(obs), 6), 1\n"
        "def wide(): return lambda obs: np.zeros((len(obs), 7))\n"
        "def lost(): return lambda obs: np.full((len(obs), 6), np.nan)\n"
        "def needy(gain): pass\n"
        "def dumb(): return 5\n"
        "def empty(): return lambda obs: None\n"
        "def words(): return lambda obs: [['left'] * 6] * len(obs)\n"
        "def ragged(): return lambda obs: [[0.0] * 6, [0.0]]\n"
        "def listed(): return lambda obs: [[0.0] * 6] * len(obs)\n"
        "def backward(): return lambda obs: obs[:, 5::-1]\n"
        "class Bare:\n"
        "    def predict(self, obs, state, deterministic): return np.zeros((len(obs), 6))\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(eval_crane, "CRANES", 4)
    out = run_here("--policy", "my_module:Counter", "--trials", "1", "--pose-noise", "none").out
    assert "mine (my_module:Counter)" in out
    assert sys.modules["my_module"].Counter.made == 2  # six trials, four at a time
    for policy in ("Model", "listed", "backward"):
        line = ("--policy", f"my_module:{policy}", "--trials", "1", "--pose-noise", "none")
        assert f"mine (my_module:{policy})" in run_here(*line).out
    for policy, said in [
        ("my_module:lost", "actions contain NaN or infinity"),
        ("my_module:needy", "missing a required argument: 'gain'; needy must be a class or"),
        ("my_module:dumb", "5 is no function"),
        ("my_module:empty", r"numbers \(4, 6\) for observations \(4, 18\), got object \(\)"),
        ("my_module:words", "got <U4"),
        ("my_module:ragged", "actions are no array"),
        ("my_module:Bare", "predict must return actions and a state"),
        ("my_module:wide", r"actions must be numbers \(4, 6\) .* got float64 \(4, 7\)"),
        ("my_module:nothing", "my_module.py has no nothing"),
        ("no_package.module:Policy", "No module named 'no_package'"),
        (":Policy", "or my_module:MyPolicy, got ':Policy'"),
        ("no_module:Policy", "--policy no_module:Policy: No module named 'no_module'"),
        ("scripetd", "--policy must be file, scripted, zero, random or my_module:MyPolicy"),
    ]:
        with pytest.raises(SystemExit, match=said):
            run_here("--policy", policy, "--trials", "1")


def test_errors_of_the_users_code_keep_their_traceback(tmp_path, monkeypatch, run_here):
    (tmp_path / "broken.py").write_text("import numpy\nnumpy.flot32\n")
    (tmp_path / "importer.py").write_text("import missing_library\n")
    monkeypatch.chdir(tmp_path)
    for words, error in [
        (("--policy", "broken:Policy"), AttributeError),
        (("--policy", "importer:Policy"), ModuleNotFoundError),
        (("--policy", "zero", "--env-id", "broken:Crane-v0"), AttributeError),
        (("--policy", "zero", "--env-id", "importer:Crane-v0"), ModuleNotFoundError),
    ]:
        with pytest.raises(error):
            run_here(*words, "--trials", "1")


@pytest.mark.parametrize("policy", ["file", "zero"])
@pytest.mark.parametrize(
    "env_id", ["Nowhere-v0", "nowhere:Crane-v0", "nowhere.crane:Crane-v0", "Pendulum-v1"]
)
def test_clear_errors_of_tasks(run_here, policy, env_id):
    with pytest.raises(SystemExit, match=env_id):
        run_here("--policy", policy, "--env-id", env_id, "--trials", "1")
