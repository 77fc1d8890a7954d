"""Nothing silently wrong, nothing lost: NaN, full disks, damaged files, kills and resumes."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
import torch
from filelock import FileLock
from script_runs import ALGORITHMS, TWO, command, environment, module, only_run, run, scalars, small

import crane_env
import crane_options
import crane_policies
import crane_runs
import crane_trials
import eval_crane
from crane_options import Range

ECHO = "--env-id recall_env:Echo-v0 --env.retry 0".split()  # a quick task


def test_check_reads_annotations():
    class Kinds:
        whole: Annotated[int, Range(1, 9)]
        share: Annotated[float, Range(0, 1)] | None
        sizes: tuple[Annotated[int, Range(1, 9)], ...]
        colour: Literal["red", "blue"]
        shade: Literal["dark"] | None
        switch: bool
        path: Path

    good = {"whole": [1, 9, np.int64(4)], "share": [0, 0.5, None, np.float32(1)], "path": [3]}
    good |= {"sizes": [(), (1, 9)], "colour": ["red"], "shade": [None, "dark"], "switch": [False]}
    bad = {"whole": [0, 10, 2.0, "3", None, float("nan"), 10**18], "share": [-0.1, 1.1, "x"]}
    bad["share"] += [float("nan"), float("inf"), -float("inf")]
    bad |= {"sizes": [(1, 0), (2.5,)], "colour": ["green", None], "shade": ["red"], "switch": [3]}
    for name, values in good.items():
        for value in values:
            crane_options.check({name: value}, Kinds)
    for name, values in bad.items():
        for value in values:
            with pytest.raises(ValueError, match=f"{name} must be .*got {re.escape(repr(value))}"):
                crane_options.check({name: value}, Kinds)
    with pytest.raises(ValueError, match="no option 'size', only .*whole"):
        crane_options.check({"size": 3}, Kinds)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_number_has_a_range_and_every_default_lies_in_it(algorithm):
    args = module(algorithm).Args()
    for name, value in vars(args).items():
        if isinstance(value, (int, float, tuple)) and not isinstance(value, bool):
            for wrong in (float("nan"), float("inf"), 1e18, -1e18):
                wrong = (wrong,) if isinstance(value, tuple) else wrong
                with pytest.raises(ValueError, match=f"{name} must be a "):
                    module(algorithm).Args(**{name: wrong})


def spoil(monkeypatch, update, kind):
    """Adam's steps from this one on end in NaN weights; or its gradients are NaN already."""
    step, count = torch.optim.Adam.step, []

    def spoiled(self, *args):
        count.append(1)
        weight = self.param_groups[0]["params"][-1]
        if kind == "gradient" and len(count) >= update:
            weight.grad[:] = torch.nan
        step(self, *args)
        if kind == "weights" and len(count) >= update:
            with torch.no_grad():
                weight[0] = torch.inf

    monkeypatch.setattr(torch.optim.Adam, "step", spoiled)


@pytest.mark.parametrize("kind", ["weights", "gradient"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_ends_at_the_first_weight_that_is_not_finite(
    tmp_path, run_here, monkeypatch, algorithm, kind
):
    """Update 12 spoils the weights: they are not saved, and the checkpoint of update 10 stays.

    The gradients are NaN in its first step, the weights after its last, so that no loss shows it.
    """
    spoil(monkeypatch, 4 * 11 + 1 if kind == "gradient" else 4 * 12, kind)
    bound = [] if algorithm == "trpo" else ["--target-kl", "None"]
    arguments = [*small(algorithm), *ECHO, "--eval-every", "0", *bound]
    with pytest.raises(SystemExit) as end:
        run_here(algorithm, *arguments, "--total-timesteps", "1280")
    said = str(end.value)
    assert said.startswith("update 12: ") and "not finite; lower --learning-rate" in said
    assert "\n" not in said
    for name in ("policy", "checkpoint"):
        saved = torch.load(only_run(tmp_path) / f"{name}.pt", weights_only=True)
        assert saved["global_step"] == 640
        assert all(tensor.isfinite().all() for tensor in saved["weights"].values())
    assert scalars(only_run(tmp_path))["time/updates"][-1] <= 11


@pytest.mark.filterwarnings("ignore:.*reward is a NaN")
def test_a_reward_that_is_not_finite_ends_the_run(tmp_path, run_here, monkeypatch):
    import recall_env

    step = recall_env.Recall.step

    def spoiled(self, action):
        obs, reward, *rest = step(self, action)
        return obs, np.nan, *rest

    monkeypatch.setattr(recall_env.Recall, "step", spoiled)
    with pytest.raises(SystemExit, match="update 1: .*losses/value_loss.* not finite"):
        run_here("ppo", *small("ppo"), *ECHO, "--eval-every", "0")
    assert not list(tmp_path.glob("runs/*/*.pt"))


# ---- files


def ended(line, cwd, **how):
    """Exit status and messages of a command."""
    result = subprocess.run(line, cwd=cwd, env=environment(), capture_output=True, text=True, **how)
    return result.returncode, messages(result.stderr)


def messages(errors):
    """Lines of standard error without progress bars."""
    lines = re.split("[\r\n]+", errors)
    return [text for text in lines if text.strip() and not re.search(r"%\||\[\d\d:\d\d", text)]


LONG = [*ECHO, "--eval-every", "0", "--total-timesteps", "640000"]


def test_runs_is_no_folder(tmp_path):
    (tmp_path / "runs").write_text("something else")
    status, lines = ended(command("trpo", *small("trpo"), *LONG), tmp_path)
    assert status == 1 and len(lines) == 1 and lines[0].startswith("NotADirectoryError: ")
    assert "runs/" in lines[0]


@pytest.mark.slow
def test_a_full_disk_ends_a_run_in_one_line_and_it_goes_on_afterwards(tmp_path):
    """A limit on the size of files stands for the disk: TensorBoard's file reaches it first."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    line = command("trpo", *small("trpo"), *LONG)
    status, lines = ended(line, tmp_path, preexec_fn=limit, timeout=300)
    run_dir = only_run(tmp_path)
    assert status == 1 and len(lines) == 1
    assert "File too large" in lines[0] and f"go on with --resume runs/{run_dir.name}" in lines[0]
    before = torch.load(run_dir / "checkpoint.pt", weights_only=True)["iteration"]
    assert before >= 10
    total = str(64 * (before + 20))
    run("trpo", tmp_path, "--resume", run_dir, "--total-timesteps", total)
    assert scalars(run_dir)["time/updates"] == list(range(1, before + 21))


def begun(algorithm, cwd, *arguments, **how):
    """A run that has saved its first checkpoint, and its folder."""
    line = command(algorithm, *small(algorithm), *LONG, *arguments)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | how
    process = subprocess.Popen(line, cwd=cwd, env=environment(), **pipes)
    deadline = time.time() + 120
    while not list(Path(cwd).glob("runs/*/checkpoint.pt")):
        assert process.poll() is None and time.time() < deadline
        time.sleep(0.05)
    return process, only_run(cwd)


@pytest.mark.slow
def test_a_run_whose_folder_vanishes_ends_in_one_line(tmp_path):
    process, run_dir = begun("ppo", tmp_path)
    shutil.rmtree(run_dir, ignore_errors=True)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and len(messages(errors)) == 1
    assert messages(errors)[0].startswith("FileNotFoundError: ")


@pytest.mark.slow
@pytest.mark.parametrize("signum, code", [(signal.SIGHUP, 129), (signal.SIGTERM, 143)])
def test_a_closed_terminal_changes_no_exit_status(tmp_path, signum, code):
    """Nothing can be printed any more. The update is saved."""
    master, terminal = os.openpty()
    streams = {"stdin": terminal, "stdout": terminal, "stderr": terminal, "start_new_session": True}

    def default_handlers():
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(each, signal.SIG_DFL)

    process, run_dir = begun("ppo", tmp_path, preexec_fn=default_handlers, **streams)
    (run_dir / "checkpoint.pt").unlink()
    os.close(terminal)
    os.close(master)
    process.send_signal(signum)
    assert process.wait(timeout=120) == code
    assert torch.load(run_dir / "checkpoint.pt", weights_only=True)["iteration"] > 0


@pytest.mark.parametrize(
    "error, said",
    [
        (
            FileNotFoundError(2, "No such file", "x"),
            "FileNotFoundError: [Errno 2] No such file: 'x'",
        ),
        (KeyboardInterrupt(), "interrupted"),
    ],
)
def test_errors_that_need_one_line(capsys, monkeypatch, error, said):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    crane_runs.one_line_errors(" hint")
    sys.excepthook(type(error), error, None)
    hint = " hint" if isinstance(error, OSError) else ""
    assert capsys.readouterr().err == f"\n{said}{hint}\n"
    sys.excepthook(ValueError, ValueError("a mistake in the code"), None)
    assert "a mistake in the code" in capsys.readouterr().err


def test_a_closed_pipe_ends_the_judge_in_one_line(tmp_path):
    line = [
        sys.executable,
        "-c",
        "import eval_crane, sys; sys.argv = ['eval_crane.py', '--policy',",
    ]
    line[-1] += (
        "'zero', '--trials', '1', '--diameters', '0.5', '--csv', 'trials.csv']; eval_crane.main()"
    )
    reader, writer = os.pipe()
    os.close(reader)
    here = {**os.environ, "PYTHONPATH": str(Path(eval_crane.__file__).parent)}
    result = subprocess.run(
        line, stdout=writer, stderr=subprocess.PIPE, text=True, env=here, cwd=tmp_path
    )
    os.close(writer)
    assert messages(result.stderr) == ["BrokenPipeError: [Errno 32] Broken pipe"]
    assert result.returncode == 1
    assert len((tmp_path / "trials.csv").read_text().splitlines()) == 1 + 1


# ---- what comes from a file is data, never code


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("code ran",)


@pytest.mark.parametrize("algorithm", TWO)
def test_no_code_of_a_checkpoint_runs(tmp_path, run_here, algorithm):
    task = {"env_id": "ForestryCrane-v0", "revision": crane_env.REVISION, **crane_options.DEFAULTS}
    saved = {"algorithm": algorithm, "task": task, "args": vars(module(algorithm).Args())}
    saved |= {"weights": Harmful(), "optimizer": {}, "iteration": 1}
    torch.save(saved, tmp_path / "checkpoint.pt")
    torch.save(saved, tmp_path / "policy.pt")
    with pytest.raises(SystemExit, match="checkpoint.pt is damaged or not of this script"):
        run_here(algorithm, "--resume", ".")
    with pytest.raises(SystemExit, match="is no policy.pt"):
        crane_policies.load_policy(tmp_path / "policy.pt")
    assert not (tmp_path / "code ran").exists()


# ---- resume


@pytest.fixture(params=TWO)
def finished(request, tmp_path, run_here):
    """Algorithm and folder of a run of two updates."""
    arguments = [*small(request.param), *ECHO, "--total-timesteps", "128", "--eval-every", "1"]
    run_here(request.param, *arguments, "--final-trials", "2")
    return request.param, only_run(tmp_path)


def test_a_truncated_checkpoint_is_named(finished, run_here):
    algorithm, run_dir = finished
    path = run_dir / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(SystemExit, match=rf"--resume: {path} is damaged"):
        run_here(algorithm, "--resume", run_dir)


def test_resume_extends_a_run(finished, run_here):
    algorithm, run_dir = finished
    left = run_here(algorithm, "--resume", run_dir, "--total-timesteps", "256")
    values = scalars(run_dir)
    assert values["time/updates"] == [1, 2, 3, 4] and left["args"].total_timesteps == 256
    # half of the longer run lay behind, and the schedule went on from there
    rate = left["args"].learning_rate
    assert values["schedule/learning_rate"] == pytest.approx([rate, rate / 2, rate / 2, rate / 4])
    assert len(values["eval/episodic_return"]) == 4 and len(values["final/episodic_return"]) == 2
    assert torch.load(run_dir / "checkpoint.pt", weights_only=True)["args"]["resume"] is None


def test_resume_cannot_shorten_a_run(finished, run_here):
    algorithm, run_dir = finished
    before = {file: file.read_bytes() for file in run_dir.iterdir()}
    with pytest.raises(
        SystemExit, match="--resume: 128 decisions are done; give --total-timesteps 192 or more"
    ):
        run_here(algorithm, "--resume", run_dir, "--total-timesteps", "64")
    assert {file: file.read_bytes() for file in run_dir.iterdir()} == before


def test_resume_of_a_finished_run_changes_nothing(finished, run_here, capsys):
    algorithm, run_dir = finished
    before = (run_dir / "checkpoint.pt").read_bytes()
    run_here(algorithm, "--resume", run_dir)
    values = scalars(run_dir)
    assert len(values["final/episodic_return"]) == 1 and values["time/updates"] == [1, 2]
    assert (run_dir / "checkpoint.pt").read_bytes() == before
    again = capsys.readouterr().out
    assert "all 2 updates are done; more --total-timesteps extend the run" in again
    assert f"final/episodic_return: {values['final/episodic_return'][0]:.3f}" in again


def test_resume_refuses_other_changes_by_name(finished, run_here):
    algorithm, run_dir = finished
    gamma = module(algorithm).Args().gamma
    no_change = ["--gamma", gamma, "--env.retry", 0, "--torch-threads", 2]
    run_here(algorithm, "--resume", run_dir, *no_change)
    for arguments, said in [
        ("--gamma 0.5", f"this run has gamma {gamma}; leave the argument out"),
        ("--num-envs 8", "this run has num_envs 4"),
        ("--total-timesteps 256 --seed 7", "this run has seed 1"),
        ("--env-id Pendulum-v1", "this run has env_id recall_env:Echo-v0"),
        ("--env.retry 0.5", "this run has retry 0.0"),
    ]:
        with pytest.raises(SystemExit, match=f"^--resume: {said}"):
            run_here(algorithm, "--resume", run_dir, *arguments.split())
    assert scalars(run_dir)["time/updates"] == [1, 2]


def test_options_of_the_crane_stay_as_they_were(tmp_path, run_here, monkeypatch):
    """Also those whose default has changed since."""
    arguments = [*small("ppo"), "--total-timesteps", "64", "--eval-every", "0"]
    run_here("ppo", *arguments, "--env.frame-skip", "4")
    monkeypatch.setitem(crane_options.DEFAULTS, "reward", "paper")
    left = run_here("ppo", "--resume", only_run(tmp_path), "--total-timesteps", "128")
    assert left["envs"].unwrapped.options["reward"] == "staged"
    with pytest.raises(SystemExit, match="--resume: this run has frame_skip 4; leave"):
        run_here("ppo", "--resume", only_run(tmp_path), "--env.frame-skip", "5")


def test_an_argument_added_later_takes_its_default(finished, run_here):
    algorithm, run_dir = finished
    path = run_dir / "checkpoint.pt"
    saved = torch.load(path, weights_only=True)
    for name in ("horizon_growth", "eval_seed"):
        del saved["args"][name]
    del saved["final_scores"]
    torch.save(saved, path)
    left = run_here(algorithm, "--resume", run_dir, "--total-timesteps", "192")
    assert left["args"].horizon_growth == module(algorithm).Args().horizon_growth
    assert left["iteration"] == 3


@pytest.mark.slow
def test_a_second_resume_of_the_same_run_is_refused(finished, run_here):
    algorithm, run_dir = finished
    torch.save({}, run_dir / "checkpoint.pt")  # so that nobody can have read it before the lock
    with FileLock(run_dir / "lock"):
        line = command(algorithm, "--resume", run_dir, "--total-timesteps", "6400")
        assert ended(line, run_dir) == (1, [f"another process trains in {run_dir}"])


@pytest.mark.parametrize("algorithm", TWO)
def test_an_interrupted_evaluation_is_made_on_resume(tmp_path, run_here, monkeypatch, algorithm):
    """A kill in the evaluation of update 15, and one in the final trials."""
    evaluate, calls = crane_trials.evaluate, []

    def killed_at(call):
        def killed(*args, **kwargs):
            calls.append(1)
            if len(calls) == call:
                raise MemoryError
            return evaluate(*args, **kwargs)

        monkeypatch.setattr(crane_trials, "evaluate", killed)

    arguments = [*small(algorithm), *ECHO, "--eval-every", "5", "--total-timesteps", "1280"]
    killed_at(3)
    with pytest.raises(MemoryError):
        run_here(algorithm, *arguments, "--final-trials", "1")
    run_dir = only_run(tmp_path)
    assert torch.load(run_dir / "checkpoint.pt", weights_only=True)["iteration"] == 10
    killed_at(6)
    with pytest.raises(MemoryError):
        run_here(algorithm, "--resume", run_dir)
    run_here(algorithm, "--resume", run_dir)
    values = scalars(run_dir)
    assert values["time/updates"] == list(range(1, 21))
    assert len(values["eval/episodic_return"]) == 4 and len(values["final/episodic_return"]) == 1
    assert len(calls) == 7


@pytest.mark.parametrize("algorithm", TWO)
def test_a_signal_saves_before_an_evaluation(tmp_path, run_here, monkeypatch, algorithm):
    """What sent the signal may not wait for an evaluation: here it ends in the middle."""
    report = crane_trials.rollout_report

    def signalled(*args):
        signal.raise_signal(signal.SIGTERM)
        return report(*args)

    def killed(*args, **kwargs):
        raise MemoryError

    monkeypatch.setattr(crane_trials, "rollout_report", signalled)
    monkeypatch.setattr(crane_trials, "evaluate", killed)
    arguments = [*small(algorithm), *ECHO, "--eval-every", "1", "--total-timesteps", "1280"]
    with pytest.raises(MemoryError):
        run_here(algorithm, *arguments)
    saved = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    assert saved["iteration"] == 1


# ---- signals of the judge


@pytest.mark.slow
@pytest.mark.parametrize("job", ["--csv trials.csv --trials 2000", "--video film.mp4"])
def test_ctrl_c_in_the_judge_is_one_line(tmp_path, job):
    file = Path(eval_crane.__file__)
    process = subprocess.Popen(
        [sys.executable, "-u", str(file), "--policy", "zero", *job.split()],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    shown = ""
    while "trial" not in shown and "frame" not in shown:  # the progress bar
        shown += process.stderr.read(1)
        assert process.poll() is None, shown
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert messages(errors) == ["interrupted"] and process.returncode == -signal.SIGINT
    assert not list(tmp_path.iterdir())
