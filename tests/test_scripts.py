"""What the four scripts promise around their updates (tests/test_update.py)."""

import importlib
import io
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from script_runs import ALGORITHMS, ROOT, Recording
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_tasks import Toy

from crane_env import CraneVectorEnv
from crane_utils import runs, trials

SMALL = "--num-envs 4 --num-steps 8 --hidden-sizes 8 --threads 1 --eval-trials 1 --final-trials 2"
TOY = f"--env-id toy_tasks:Toy-v0 {SMALL}"
QUICK = f"--env-id toy_tasks:Quick-v0 {SMALL}"
UPDATE = 4 * 8  # steps


def small(script):
    return "--num-minibatches 2" if script == "recurrent_ppo_crane" else "--minibatch-size 16"


# ---- learning

LEARN = "--num-envs 16 --num-steps 18 --update-epochs 4 --gamma 1 --hidden-sizes 32 --threads 1"
LEARN += " --learning-rate 1e-2 --reward-scale 1 --horizon-growth 1 --final-trials 50"
LEARN += " --eval-every 99"


@pytest.mark.parametrize("script", [name for name in ALGORITHMS if "recurrent" not in name])
def test_learns_to_name_what_it_sees(tmp_path, script):
    run = Recording(tmp_path)
    line = "--env-id toy_tasks:Echo-v0 --minibatch-size 72 --total-timesteps 6000"
    run.run(script, LEARN, line)
    (score,) = run.scalars["eval/episodic_return"].values()
    assert score > -0.05 and run.scalars["charts/episodic_return"][16 * 18] < -1


def test_memory_is_what_solves_recall(tmp_path):
    """-1 is the best that a policy without memory can get."""
    scores = {}
    for script, line in [
        ("recurrent_ppo_crane", "--num-minibatches 4 --lstm-size 8"),
        ("ppo_crane", "--minibatch-size 72"),
    ]:
        run = Recording(tmp_path)
        run.run(script, LEARN, "--env-id toy_tasks:Recall-v0 --total-timesteps 13000", line)
        (scores[script],) = run.scalars["eval/episodic_return"].values()
    assert scores["recurrent_ppo_crane"] > -0.1 and scores["ppo_crane"] < -0.9


# ---- a run on cranes

KEYS = """
charts/episodic_return charts/episodic_length charts/success_rate charts/gentle_rate charts/SPS
charts/learning_rate losses/policy_loss losses/value_loss losses/entropy losses/grad_norm
losses/approx_kl losses/explained_variance schedule/gamma policy/std
reward/distance reward/grapple reward/lift reward/balance reward/ground
termination/time_limit termination/thinnest
eval/episodic_return eval/success_rate eval/gentle_rate
eval/success_rate_0.3m eval/success_rate_0.4m eval/success_rate_0.5m
eval/success_rate_0.6m eval/success_rate_0.7m eval/success_rate_0.8m
""".split()
OWN_KEYS = {
    "mppo_beta_crane": ["losses/clipfrac", "schedule/perturbation"],
    "ppo_crane": ["losses/clipfrac"],
    "trpo_crane": ["trpo/step_fraction"],
    "recurrent_ppo_crane": ["losses/clipfrac"],
}


@pytest.mark.parametrize("script", ALGORITHMS)
def test_a_run_on_cranes(tmp_path, monkeypatch, script):
    """What it shows, on what it trains and evaluates, and that a seed gives it again to the bit."""
    evaluations, evaluate, resets, reset = [], trials.evaluate, [], CraneVectorEnv.reset

    def watched(agent, *args, **kwargs):
        scores = evaluate(agent, *args, **kwargs)
        evaluations.append((agent.state_dict()["actor.0.weight"].clone(), args, kwargs, scores))
        return scores

    def watched_reset(envs, **kwargs):
        resets.append((envs.difficulty, envs.retry, envs.physics_steps, kwargs["seed"]))
        return reset(envs, **kwargs)

    monkeypatch.setattr(trials, "evaluate", watched)
    monkeypatch.setattr(CraneVectorEnv, "reset", watched_reset)
    line = f"{QUICK} {small(script)} --total-timesteps {5 * UPDATE} --eval-every 2"
    line += " --curriculum 1 --retry 0.3 --env.frame-skip 15"
    run = Recording(tmp_path)
    left = run.run(script, line)

    assert {*run.scalars} == {*KEYS, *OWN_KEYS[script]}
    check_charts(run)

    # an evaluation is of the full task, as the last update left the policy
    assert {*run.scalars["eval/success_rate"]} == {2 * UPDATE, 4 * UPDATE, 5 * UPDATE}
    assert [args[1] for _, args, _, _ in evaluations] == [1, 1, 2]
    for (weights, args, kwargs, scores), k in zip(evaluations, (2, 4, 5)):
        assert torch.equal(weights, run.updates[k - 1]["weights"]["actor.0.weight"])
        assert args[0] == "toy_tasks:Quick-v0" and kwargs["options"]["frame_skip"] == 15
        for name, score in scores.items():
            assert run.scalars[f"eval/{name}"][k * UPDATE] == score
    (first, *of_evaluations) = resets
    assert first[:3] == (0.2, 0.3, 8)  # difficulty, retry, physics steps of 10 ms at most
    assert len(of_evaluations) == 3 and {r[:3] for r in of_evaluations} == {(1.0, 0.0, 15)}
    assert of_evaluations[0][3][0].entropy == trials.EVAL_SEED

    # the folder
    (folder,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(rf"toy_tasks-Quick-v0__{script}__1__\d+_\w+", folder.name)
    files = {"policy.pt", "checkpoint.pt", f"{script}.py", "toy_tasks.py"}
    assert {file.name for file in folder.iterdir()} == files
    assert (folder / f"{script}.py").read_bytes() == (ROOT / f"{script}.py").read_bytes()
    agent, task, name = runs.load_policy(folder)
    assert task == {"env_id": "toy_tasks:Quick-v0", **left["envs"].unwrapped.task}
    assert task["revision"] == 3 and task["options"]["frame_skip"] == 15 and name == f"{script}.py"
    obs = np.random.default_rng(0).normal(size=(3, 18))
    np.testing.assert_array_equal(agent.predict(obs)[0], left["agent"].predict(obs)[0])
    assert not any(name.startswith("critic") for name in runs.load(folder / "policy.pt")["weights"])

    # the same seed and another
    again, other = Recording(tmp_path), Recording(tmp_path)
    again.run(script, line)
    other.run(script, f"{QUICK} {small(script)} --total-timesteps {UPDATE} --seed 2")
    for name, weight in left["agent"].state_dict().items():
        assert torch.equal(weight, again.updates[-1]["weights"][name]), name
    assert not torch.equal(run.first[0]["actor.0.weight"], other.first[0]["actor.0.weight"])
    assert not np.isin(run.starts[0], other.starts[0]).all(axis=1).any()


def check_charts(run):
    """The means that TensorBoard shows, from the steps of each update."""
    outcomes, returns, lengths = [[] for _ in range(4)], np.zeros(4), np.zeros(4)
    for k in range(5):
        ends, terms = [], []
        for step in run.steps[8 * k : 8 * k + 8]:
            info = step["info"]
            returns += step["reward"]
            lengths += 1
            terms.append(info["r_lift"].mean())
            for i in np.flatnonzero(step["terminated"] | step["truncated"]):
                outcomes[i].append(info["success"][i])
                cut = info["termination"][i] == "time_limit"
                ends.append((returns[i], lengths[i], cut, info["gentle"][i]))
                returns[i] = lengths[i] = 0
        names = ["charts/episodic_return", "charts/episodic_length"]
        names += ["termination/time_limit", "charts/gentle_rate"]
        expected = dict(zip(names, np.mean(ends, axis=0))) | {"reward/lift": np.mean(terms)}
        recent = [outcome for crane in outcomes for outcome in crane[-10:]]
        expected["charts/success_rate"] = np.mean(recent)
        for name, value in expected.items():
            assert run.scalars[name][(k + 1) * UPDATE] == pytest.approx(value, rel=1e-5), name


# ---- stop and resume


@pytest.mark.parametrize(
    "script, number",
    [*zip(ALGORITHMS, [signal.SIGINT, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])],
)
def test_a_signal_stops_after_the_update_and_resume_goes_on(tmp_path, monkeypatch, script, number):
    """On new episodes, with new samples, in the schedule of the run."""
    run, step, count = Recording(tmp_path), Toy.step, []
    (terminal := io.StringIO()).close()  # writing to it fails

    def signalled(env, action):
        count.append(1)
        if len(count) in (2 * UPDATE + 5, 8 * UPDATE - 2):  # in the third, and in the last
            if number == signal.SIGHUP:
                monkeypatch.setattr(sys, "stdout", terminal)
            os.kill(os.getpid(), number)
        return step(env, action)

    monkeypatch.setattr(Toy, "step", signalled)
    line = f"{TOY} {small(script)} --update-epochs 2 --target-kl 0.5 --reward-scale 0.123"
    with pytest.raises(SystemExit, match=r"stopped after update 3; go on with --resume runs/\S+$"):
        run.run(script, f"{line} --total-timesteps {6 * UPDATE} --eval-every 3")
    (folder,) = (tmp_path / "runs").iterdir()
    assert torch.load(folder / "checkpoint.pt", weights_only=True)["iteration"] == 3
    assert len(run.steps) == 3 * 8
    assert run.scalars["eval/episodic_return"].keys() == {3 * UPDATE}  # was due

    done = len(run.permutations)
    left = run.run(script, f"--resume {folder} --total-timesteps {8 * UPDATE} --eval-every 9")
    assert run.scalars["eval/episodic_return"].keys() == {3 * UPDATE, 8 * UPDATE}
    assert [*(tmp_path / "runs").iterdir()] == [folder] and len(run.updates) == 8
    assert run.purge_steps == [1, 3 * UPDATE + 1]
    assert {*run.scalars["losses/value_loss"]} == {k * UPDATE for k in range(1, 9)}
    for name, weight in run.first[1].items():
        assert torch.equal(weight, run.updates[2]["weights"][name]), name
    rates = np.array([1, 5 / 6, 4 / 6, 5 / 8, 4 / 8, 3 / 8, 2 / 8, 1 / 8])
    rates *= left["args"].learning_rate
    np.testing.assert_allclose([*run.scalars["charts/learning_rate"].values()], rates)
    assert left["args"].reward_scale == 0.123 and left["args"].num_envs == 4
    assert left["agent"].obs_count == 8 * UPDATE
    updates = {state["step"].item() for state in left["optimizer"].state_dict()["state"].values()}
    assert updates == {8 * 2 * 2.0}  # updates, epochs, minibatches
    first, second = run.starts
    assert not np.isin(first, second).all(axis=1).any()
    assert run.permutations[:8] != run.permutations[done : done + 8]

    other = "ppo_crane" if script != "ppo_crane" else "trpo_crane"
    for name, line, said in [
        (script, f"--resume {folder}", f"{8 * UPDATE} steps are done; give more --total-timesteps"),
        (script, f"--resume {folder} --num-envs 8", "--num-envs must stay 4"),
        (script, f"--resume {folder} --hidden-sizes 9", r"--hidden-sizes must stay \(8,\)"),
        (script, "--resume nowhere", "no checkpoint.pt in nowhere"),
        (other, f"--resume {folder}", f"{script}.py wrote .*, not {other}.py"),
    ]:
        with pytest.raises(SystemExit, match=f"^--resume: {said}"):
            run.run(name, line)
    assert len(run.updates) == 8


PROGRAM = """
import os, signal, sys
sys.path[:0] = {paths}
import runpy, toy_tasks
step, count = toy_tasks.Toy.step, []
def deadly(env, action):
    count.append(1)
    if len(count) == {last}:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(env, action)
toy_tasks.Toy.step = deadly
sys.argv = {argv}
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_a_killed_run_goes_on(tmp_path):
    """In another process."""

    def start(last, words):
        argv = [str(ROOT / "mppo_beta_crane.py"), *words.split()]
        paths = [str(ROOT), str(ROOT / "tests")]
        program = PROGRAM.format(paths=paths, argv=argv, last=last)
        line = [sys.executable, "-c", program]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)

    killed = 12 * UPDATE + 5  # steps
    line = f"{TOY} --minibatch-size 16 --total-timesteps {15 * UPDATE}"
    assert start(killed, line).returncode == -signal.SIGKILL
    (folder,) = (tmp_path / "runs").iterdir()
    assert runs.load(folder / "checkpoint.pt")["iteration"] == 10
    ended = start(0, f"--resume {folder}")
    assert ended.returncode == 0, ended.stderr
    assert runs.load(folder / "checkpoint.pt")["iteration"] == 15
    events = EventAccumulator(str(folder))
    events.Reload()
    steps = [event.step for event in events.Scalars("losses/value_loss")]
    assert steps == [k * UPDATE for k in range(1, 16)]
    assert "gamma: 0.97" in str(events.Tensors("hyperparameters/text_summary"))


@pytest.mark.parametrize("script", ALGORITHMS[1:])  # the killed run was mPPO's
def test_every_tenth_update_is_kept(tmp_path, monkeypatch, script):
    step, count = Toy.step, []

    def deadly(env, action):
        count.append(1)
        if len(count) == 12 * UPDATE + 5:
            raise MemoryError
        return step(env, action)

    monkeypatch.setattr(Toy, "step", deadly)
    with pytest.raises(MemoryError):
        Recording(tmp_path).run(script, f"{TOY} {small(script)} --total-timesteps {15 * UPDATE}")
    (path,) = tmp_path.glob("runs/*/checkpoint.pt")
    assert runs.load(path)["iteration"] == 10


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    runs.write(tmp_path / "policy.pt", {"good": 1})
    with pytest.raises(pickle.UnpicklingError):  # now, and not when the run is resumed
        runs.write(tmp_path / "policy.pt", {"good": np.float64(2)})
    save = torch.save

    def full_disk(contents, path):
        save(contents, path)
        os.truncate(path, 100)
        raise OSError("no space left")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError):
        runs.write(tmp_path / "policy.pt", {"good": 2})
    assert runs.load(tmp_path / "policy.pt") == {"good": 1}


def test_an_edited_script_joins_a_resumed_run_with_its_first_weights(tmp_path, monkeypatch):
    (folder := tmp_path / "run").mkdir()
    (copy := folder / "mine.py").write_text("old", encoding="utf-8")
    (script := tmp_path / "mine.py").write_text("edited", encoding="utf-8")
    monkeypatch.setattr(sys, "argv", [str(script)])
    args, agent = importlib.import_module("ppo_crane").Args(resume=folder), torch.nn.Linear(1, 1)
    assert runs.make_folder(args) == folder and copy.read_text(encoding="utf-8") == "old"
    envs, optimizer = SimpleNamespace(unwrapped=None), torch.optim.Adam(agent.parameters())
    runs.save(folder, args, envs, agent, optimizer, 1)
    assert copy.read_text(encoding="utf-8") == "edited"


def test_a_second_ctrl_c_stops_at_once_and_nohup_is_respected():
    kept = {n: signal.signal(n, signal.SIG_DFL) for n in (signal.SIGINT, signal.SIGTERM)}
    kept[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        stop = runs.StopSignal()
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.received is None
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.received == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


def test_two_runs_never_share_a_folder(tmp_path, monkeypatch):
    """They begin together, with one clock and one process number, as containers may have."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "time", lambda: 1.7e9)
    monkeypatch.setattr(os, "getpid", lambda: 7)
    monkeypatch.setattr(runs, "task_file", lambda env_id: None)
    monkeypatch.setattr(sys, "argv", [str(ROOT / "ppo_crane.py")])
    args = SimpleNamespace(env_id="my/task:Crane-v0", exp_name="a:b/c", seed=3, resume=None)
    folders = {runs.make_folder(args) for _ in range(2)}
    assert len(folders) == 2 and all(folder.is_dir() for folder in folders)
    assert {folder.parent.name for folder in folders} == {"runs"}
    assert not any(set(":/") & set(folder.name) for folder in folders)


def test_a_resumed_run_keeps_the_task_that_it_goes_on_with(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(ROOT / "ppo_crane.py")])
    (tmp_path / "toy_tasks.py").write_text("# before", encoding="utf-8")
    runs.make_folder(SimpleNamespace(env_id="toy_tasks:Quick-v0", resume=tmp_path))
    assert (tmp_path / "toy_tasks.py").read_bytes() == (ROOT / "tests/toy_tasks.py").read_bytes()


# ---- arguments and tasks


def refusal(tmp_path, script, *line):
    """The line, or the words in the box, with which a script refuses its arguments."""
    errors = io.StringIO()
    with redirect_stderr(errors), pytest.raises(SystemExit) as end:
        Recording(tmp_path).run(script, *line)
    if end.value.code != 2:
        assert "\n" not in str(end.value)
        return str(end.value)
    assert errors.getvalue().count("╭") == errors.getvalue().count("╰") == 1
    return " ".join(re.sub("[│╭╮╰╯─]", " ", errors.getvalue()).split())


@pytest.mark.parametrize("script", ALGORITHMS)
def test_wrong_arguments_are_refused_in_a_line_or_a_box(tmp_path, script):
    for line, *words in [
        ("--gamma 1.5", "gamma", "less than or equal to 1"),
        ("--learning-rate nan", "learning", "finite"),
        ("--env-id CartPole-v1", "CartPole-v1", "flat Box"),
        ("--env-id Nope-v0", "Nope"),
        ("--env-id nowhere:Crane-v0", "nowhere"),
        ("--env-id toy_tasks:BonusCrane-v0", "BonusCrane-v0 wraps a crane", "hook"),
        ("--env-id toy_tasks:Toy-v0 --env.contact sdf", "Toy-v0 is not the crane"),
    ]:
        said = refusal(tmp_path, script, f"{SMALL} --total-timesteps 32", line)
        assert all(word in said for word in words), said
    assert not (tmp_path / "runs").exists()


def test_minibatches_must_divide_the_cranes(tmp_path):
    said = refusal(tmp_path, "recurrent_ppo_crane", f"{TOY} --num-minibatches 3")
    assert "must divide" in said and not (tmp_path / "runs").exists()


def test_help_shows_the_options_of_the_task(tmp_path):
    printed = io.StringIO()
    with redirect_stdout(printed), pytest.raises(SystemExit) as end:
        Recording(tmp_path).run("ppo_crane", "--env-id ForestryCraneRandomized-v0 --help")
    assert end.value.code == 0
    text = " ".join(re.sub("[│╭╮╰╯─]", " ", printed.getvalue()).split())
    assert re.search(r"--env\.randomize FLOAT .*?\(default: ([\d.]+)\)", text)[1] == "1.0"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("task", ["NanReward-v0", "InfObs-v0", "InfStart-v0", "InfEnd-v0"])
def test_what_is_not_finite_is_named(tmp_path, task):
    line = f"{SMALL} --env-id toy_tasks:{task} --minibatch-size 16 --total-timesteps {UPDATE}"
    run, name = Recording(tmp_path), "reward" if "Reward" in task else "observation"
    name = "last observation" if "End" in task else name
    with pytest.raises(SystemExit, match=f"the {name} of environment 0 is not finite: .*(nan|inf)"):
        run.run("ppo_crane", line)
    assert len(run.steps) == (0 if "Start" in task else 2)  # at once
    assert not list(tmp_path.glob("runs/*/policy.pt"))


@pytest.mark.parametrize("script", ALGORITHMS)
def test_weights_that_are_not_finite_end_the_run(tmp_path, script):
    line = f"{TOY} {small(script)} --total-timesteps {12 * UPDATE} --learning-rate 1e38"
    said = refusal(tmp_path, script, line, "--max-grad-norm 1e30")
    assert re.match(r"update \d+: .* not finite; try a lower --learning-rate", said)
    assert not list(tmp_path.glob("runs/*/policy.pt"))


def test_a_weight_that_is_lost_in_the_last_step_is_seen():
    """After the last loss."""
    lost = torch.nn.Linear(1, 1)
    lost.bias.data[:] = torch.nan
    with pytest.raises(SystemExit, match="update 7: bias not finite"):  # after the last loss
        runs.check_finite(7, {"losses/value_loss": 1.0}, lost)
