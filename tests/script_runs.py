"""Running the algorithm scripts as a user would, at a small size."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parent.parent
ALGORITHMS = ["mppo_beta", "ppo", "trpo", "recurrent_ppo"]
TWO = ["mppo_beta", "trpo"]  # for what crane_runs.py does in the same way for all
SMALL = "--num-envs 4 --num-steps 16 --update-epochs 2 --hidden-sizes 16 16 --eval-trials 1"
SMALL = [*SMALL.split(), "--final-trials", "0", "--env-threads", "1", "--torch-threads", "1"]


def small(algorithm):
    """Two minibatches of 32 decisions."""
    if algorithm == "recurrent_ppo":
        return [*SMALL, "--num-minibatches", "2", "--lstm-size", "8"]
    return [*SMALL, "--minibatch-size", "32"]


def one_minibatch(algorithm):
    flag = "--num-minibatches 1" if algorithm == "recurrent_ppo" else "--minibatch-size 64"
    return [*small(algorithm), *flag.split(), "--update-epochs", "1", "--total-timesteps", "64"]


def module(algorithm):
    return importlib.import_module(f"{algorithm}_crane")


def make_agent(algorithm, obs_dim=18, act_dim=6, **args):
    script = module(algorithm)
    bound = np.ones(act_dim)
    return script.Agent(obs_dim, -bound, bound, script.Args(**{"hidden_sizes": (8,)} | args))


def command(algorithm, *arguments):
    return [sys.executable, str(ROOT / f"{algorithm}_crane.py"), *map(str, arguments)]


def environment():
    return {**os.environ, "PYTHONPATH": str(ROOT / "tests")}


def run(algorithm, cwd, *arguments):
    line = command(algorithm, *arguments)
    result = subprocess.run(line, cwd=cwd, env=environment(), capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    return result


def only_run(cwd):
    (run_dir,) = (Path(cwd) / "runs").iterdir()
    return run_dir


def scalars(run_dir):
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [e.value for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
