"""The queue of trainings behind the tables: what is trained, resumed, evaluated and written."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from benchmark import runs
from crane_utils.runs import write

RUN = runs.Run("levels", "ppo_crane_hydraulic", "ppo_crane", "--gamma 0.9", 21)
LABEL = "levels_ppo_crane_hydraulic"
WHOLE = {"success %": 97.504, "gentle %": 90.0, "failures": "not_lifted 2"}
WHOLE |= dict.fromkeys(runs.METRICS, 1.23456)
TABLE = {"table": {"0.3": {"success %": 95.0}, "all": WHOLE}}


class Processes:
    """Stands for `subprocess.run`. Trainings end after `updates` updates of 16 steps."""

    def __init__(self, folder):
        self.folder, self.updates, self.evaluates, self.commands = folder, 1, True, []

    def __call__(self, command, **kwargs):
        self.commands.append(" ".join(command[1:]))
        if "eval_crane.py" in command[1]:
            return SimpleNamespace(returncode=not self.evaluates, stdout=json.dumps(TABLE))
        folder = self.folder / "runs" / f"Crane-v0__{LABEL}__21__1"
        with SummaryWriter(folder) as writer:
            writer.add_scalar("charts/SPS", 10.0 * self.updates, 16 * self.updates)
        args = {"total_timesteps": 32, "num_envs": 4, "num_steps": 4}
        write(folder / "checkpoint.pt", {"args": args, "iteration": self.updates})
        return SimpleNamespace(returncode=self.updates < 2)


def test_a_run_is_resumed_evaluated_and_written_last(tmp_path, monkeypatch):
    start, results = Processes(tmp_path), tmp_path / "results"
    monkeypatch.setattr(runs, "HERE", tmp_path)
    monkeypatch.setattr(runs, "RESULTS", results)
    monkeypatch.setattr(runs.subprocess, "run", start)
    names = ("levels_kept", "levels_dropped", LABEL)
    old = [{"run": name, "seed": "21", "pose_noise": "none", "success": "1"} for name in names]
    runs.write_rows(results / "evaluations.csv", old)
    runs.write_rows(results / "levels" / "kept_seed21.csv", [{"steps": "16"}])

    assert runs.make(RUN).startswith("stopped")
    assert f"--exp-name {LABEL} --seed 21 --gamma 0.9" in start.commands[0]
    start.updates, start.evaluates = 2, False
    assert "could not be evaluated" in runs.make(RUN)
    assert "--resume" in start.commands[1] and "--gamma" not in start.commands[1]
    assert not (results / f"{RUN}.csv").exists()
    start.evaluates = True
    assert runs.make(RUN).startswith("finished")  # not trained again
    assert [command.split()[0].rpartition("/")[2] for command in start.commands[3:]] == [
        "eval_crane.py",
        "eval_crane.py",
    ]
    rows = runs.read_rows(results / f"{RUN}.csv")
    assert [(row["steps"], row["SPS"]) for row in rows] == [("16", "10"), ("32", "20")]
    found = runs.read_rows(results / "evaluations.csv")
    assert [(row["run"], row["pose_noise"], row["success"]) for row in found] == [
        ("levels_kept", "none", "1"),
        (LABEL, "none", "97.5"),
        (LABEL, "step", "97.5"),
    ]
    assert (found[1]["0.3"], found[1]["oil [l]"], found[1]["failures"]) == (
        "95.0",
        "1.235",
        "not_lifted 2",
    )


def test_minutes_leave_out_that_a_run_was_suspended():
    """Nine updates of 600 steps at 10 a second take 9 minutes; the third one slept."""
    columns = ("steps", "SPS", "eval_success_rate")
    rows = [dict(zip(columns, (str(600 * k), "10", ""))) for k in range(1, 10)]
    rows[2]["SPS"], rows[8]["eval_success_rate"] = "0.01", "0.5"
    curve = runs.curve(rows)
    np.testing.assert_allclose(curve["minutes"], [9.0])
    assert curve["eval_success_rate"] == pytest.approx([0.5])
