"""Evaluate policies on cranes that they were not trained on.

    python benchmark/robustness.py levels     # results/levels.csv: the other levels
    python benchmark/robustness.py changes    # results/robustness.csv: a hydraulic crane, changed
    python benchmark/robustness.py loading    # results/loading.csv: the scripted crane loads
    python benchmark/robustness.py held       # results/held.csv: ten more seconds without command
    python benchmark/robustness.py changes --trials 1 --folder /tmp/test    # does it work?

The policies are the shipped ones and the scripted crane. Rows that a file has are not measured
again: if a policy has changed, delete the file. `figures.py robustness` draws the changes.
"""

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from tqdm import tqdm

import eval_crane
from benchmark.runs import LABELS, LEVELS, LOADING, METRICS, RESULTS, ROOT, read_rows, write_rows
from crane_env import SERVOS
from crane_utils import runs
from crane_utils import trials as protocol
from crane_utils.scripted_loading import ScriptedLoadingCrane
from crane_utils.trials import REPORT_SEED
from hydraulic_crane import HydraulicCraneVectorEnv
from scripted_crane import ScriptedCrane

METHODS = {label: script for script, label in LABELS.items()} | {"scripted": "scripted"}
CHANGES = {  # attribute of ChangedCranes: what the tables call it, and its values
    "delay": ("more dead time [s]", [0.0, 0.03, 0.06, 0.09, 0.12]),
    "pose_error": ("constant pose error [m]", [0.0, 0.05, 0.1, 0.15, 0.2]),
    "slope": ("slope of the ground [degrees]", [0.0, 1.0, 2.0, 3.0, 4.0]),
    "friction": ("friction, times", [0.4, 0.6, 0.8, 1.0, 1.2]),
    "pump": ("flow of the pump, times", [0.4, 0.6, 0.8, 1.0]),
    "force": ("force limits, times", [0.4, 0.6, 0.8, 1.0]),
}


class ChangedCranes(HydraulicCraneVectorEnv):
    """Hydraulic cranes. A subclass gives one of these attributes another value."""

    delay = 0.0  # s, more dead time of all drives
    pose_error = 0.0  # m, to a side that each crane keeps, of the log's reported place
    pump = 1.0  # factor on its flow
    force = 1.0  # factor on the force limits
    slope = 0.0  # degrees, of a ground that falls along x
    friction = 1.0  # factor

    def __init__(self, num_envs: int = 1, **kwargs: Any):
        super().__init__(num_envs, **kwargs)
        self.drawn["friction"][:] = self.friction
        self.PUMP_FLOW = self.pump * HydraulicCraneVectorEnv.PUMP_FLOW
        side = np.random.default_rng(0).uniform(0, 2 * np.pi, num_envs)
        error = [np.cos(side), np.sin(side), 0 * side]
        self.drawn["pose_error"] = self.pose_error * np.stack(error, axis=-1)

    def make_spec(self) -> mujoco.MjSpec:
        spec = super().make_spec()
        for index in SERVOS:
            joint = spec.joints[index]
            joint.actfrcrange *= self.force
            drive = spec.actuator(f"{joint.name}_integral")
            drive.delay, drive.nsample = drive.delay + self.delay, 2 * drive.nsample
        angle, g = np.radians(self.slope), spec.option.gravity[2]
        spec.option.gravity = [-g * np.sin(angle), 0, g * np.cos(angle)]
        return spec


def policy_of(method: str, level: str) -> tuple[Any, int]:
    """The shipped policy of a method and a level, and the seed of its training."""
    if method == "scripted":
        return ScriptedCrane(), 1
    name = METHODS[method] + f"_{level}" * (level != "ideal")
    path = ROOT / "assets" / "policies" / f"{name}.pt"
    return runs.load_policy(path)[0], runs.load(path)["args"]["seed"]


def add_row(path: Path, key: dict, policy: Any, trained_on: str, env_id: str) -> None:
    """Success and metrics of a policy, in trials of seed 60000. A row that is there stays."""
    trials = key["per_diameter"]
    key |= {"trial_seed": REPORT_SEED, "trials": 6 * trials}
    key = {name: str(value) for name, value in key.items()}
    known, options = read_rows(path), protocol.task_options(env_id)
    if any(key.items() <= row.items() for row in known):
        return
    if trained_on == "ideal" and hasattr(options, "sensors"):
        options = replace(options, sensors=False)
    args = eval_crane.Args(seed=REPORT_SEED, trials=trials)
    line = eval_crane.summarize([*eval_crane.play(policy, env_id, options, args)], {})
    line |= {"success": line["success %"], "gentle": line["gentle %"]}
    for name in ("success", "gentle", *METRICS):
        key[name] = line[name] if line[name] == "" else f"{line[name]:.4g}"
    write_rows(path, [*known, key])


def levels(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write levels.csv: policies on the other levels, with so many trials per log diameter."""
    for method, trained_on, level in tqdm([*product(METHODS, LEVELS, LEVELS)], unit="row"):
        if level == "ideal" and trained_on != "ideal":
            continue  # too few sensors
        policy, seed = policy_of(method, trained_on)
        key = {"method": method, "trained_on": trained_on, "seed": seed, "evaluated_on": level}
        key["per_diameter"] = trials
        add_row(folder / "levels.csv", key, policy, trained_on, LEVELS[level])


def loading(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write loading.csv: the scripted crane on the loading tasks."""
    for level, env_id in LOADING.items():
        key = {"method": "scripted", "level": level, "per_diameter": trials}
        add_row(folder / "loading.csv", key, ScriptedLoadingCrane(), level, env_id)


def changes(trials: int = 25, folder: Path = RESULTS) -> None:
    """Write robustness.csv: policies on hydraulic cranes with one of CHANGES."""
    policies = {method: policy_of(method, "hydraulic")[0] for method in ("mPPO", "scripted")}
    policies["mPPO, trained on randomized"], _ = policy_of("mPPO", "randomized")
    points = [(name, label, x) for name, (label, xs) in CHANGES.items() for x in xs]
    for attribute, label, value in tqdm(points, unit="change"):
        env_id = f"Changed-{attribute}-{str(value).replace('.', '-')}-v0"
        cranes = type("Cranes", (ChangedCranes,), {attribute: value})
        gymnasium.register(env_id, vector_entry_point=cranes)
        for method, policy in policies.items():
            key = {"method": method, "changed": label, "value": value, "per_diameter": trials}
            add_row(folder / "robustness.csv", key, policy, "hydraulic", env_id)


def then_still(policy: Any) -> SimpleNamespace:
    """A policy for 9 s, and then no command."""

    def predict(obs: np.ndarray, state: tuple | None, deterministic: bool = True) -> tuple:
        step, memory = state or (0, None)
        actions, memory = policy.predict(obs, memory, deterministic=deterministic)
        return actions * (step < 90), (step + 1, memory)

    return SimpleNamespace(predict=predict)


def held(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write held.csv: success after 9 s, and after ten more seconds without command."""
    diameters, seeds = protocol.monte_carlo_trials(REPORT_SEED, trials)
    for task in LEVELS.values():
        longer = type("Longer", (protocol.crane_class(task),), {"TIME_LIMIT": 19.0})
        kwargs = gymnasium.spec(task).kwargs
        gymnasium.register(f"Held{task}", vector_entry_point=longer, kwargs=kwargs)
    for method, (level, task) in tqdm([*product(METHODS, LEVELS.items())], unit="row"):
        known, (policy, _), good = read_rows(folder / "held.csv"), policy_of(method, level), True
        key = dict(method=method, level=level, trial_seed=str(REPORT_SEED), trials=str(len(seeds)))
        if any(key.items() <= row.items() for row in known):
            continue
        still = then_still(policy)
        for name, acting, env_id in ("success", policy, task), ("held", still, f"Held{task}"):
            envs = protocol.make_envs(env_id, len(seeds), diameter=diameters)
            good &= protocol.run_trials(acting, envs, seeds)["success"]
            key[name] = f"{100 * good.mean():.4g}"
        write_rows(folder / "held.csv", [*known, key])


if __name__ == "__main__":
    torch.set_num_threads(1)
    commands = {"levels": levels, "changes": changes, "loading": loading, "held": held}
    tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
