"""benchmark/make_runs.py: how a run begins and goes on, and the rows that judge it."""

import csv
import json
import subprocess
import sys

import pytest
from script_runs import ROOT

sys.path.insert(0, str(ROOT / "benchmark"))
import make_runs


@pytest.fixture
def commands(tmp_path, monkeypatch):
    """The commands that make_runs starts in an empty folder. None of them runs."""
    started = []

    def run(command, **kwargs):
        started.append(command)
        noise = command[command.index("--pose-noise") + 1] if "--json" in command else ""
        answer = {
            "seed": int(command[command.index("--seed") + 1]) if noise else 0,
            "cells": [{"diameter": 0.3, "success_rate": 0.9 if noise == "none" else 0.8}],
            "mean_success_rate": 0.91234,
            "mean_gentle_rate": 0.5,
            "costs": {"peak [kN]": 12.34567, "up [s]": None},
        }
        return subprocess.CompletedProcess(command, run.code, json.dumps(answer))

    run.code = 0
    monkeypatch.setattr(make_runs, "HERE", tmp_path)
    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(make_runs, "export", lambda run, path: path.write_text(run.name))
    return started, run


def test_a_policy_is_judged_on_the_seed_of_the_reports(commands, tmp_path):
    header = "run,seed,pose_noise,trial_seed,0.3 m,success,gentle,peak [kN],up [s]\n"
    old = "other,1,none,40000,50,50,50,1,1\nmine,2,none,40000,50,50,50,1,1\n"
    (tmp_path / "evaluations.csv").write_text(header + old)
    make_runs.evaluate("mine", 2, tmp_path / "run")
    for command in commands[0]:
        assert str(tmp_path / "run") in command
        assert command[command.index("--seed") + 1] == "60000"
    with open(tmp_path / "evaluations.csv", newline="") as file:
        rows = [list(row.values()) for row in csv.DictReader(file)]
    assert rows == [
        ["mine", "2", "none", "60000", "90.0", "91.23", "50.0", "12.35", ""],
        ["mine", "2", "step", "60000", "80.0", "91.23", "50.0", "12.35", ""],
        ["other", "1", "none", "40000", "50", "50", "50", "1", "1"],
    ]


def test_a_run_begins_or_goes_on_and_counts_when_it_is_finished(commands, tmp_path):
    started, run = commands
    job = ("ablations", "ppo_crane", "gaussian", 2, ["--learning-rate", "1e-3"], 1)
    csv_path = tmp_path / "ablations" / "gaussian_seed2.csv"
    run.code = 130  # Ctrl-C
    assert "stopped, see" in make_runs.make(*job)
    assert not csv_path.exists() and (tmp_path / "ablations_gaussian_seed2.log").exists()
    assert "--exp-name ablations_gaussian --seed 2 --learning-rate 1e-3" in " ".join(started[-1])
    folder = tmp_path / "runs" / "Crane__ablations_gaussian__2__5"
    folder.mkdir(parents=True)
    (folder / "checkpoint.pt").touch()
    run.code = 0
    assert make_runs.make(*job) == "gaussian_seed2.csv written"
    assert started[-1][-2:] == ["--resume", str(folder)]
    assert csv_path.read_text() == folder.name
    assert not (tmp_path / "ablations_gaussian_seed2.log").exists()
