"""Evaluate policies on cranes that they were not trained on.

    python benchmark/robustness.py levels     # results/levels.csv: the other levels
    python benchmark/robustness.py changes    # results/robustness.csv: a hydraulic crane, changed
    python benchmark/robustness.py loading    # results/loading.csv: the scripted crane loads
    python benchmark/robustness.py held       # results/held.csv: ten more seconds without command
    python benchmark/robustness.py contacts   # results/contacts.csv: the paper's SDF contacts
    python benchmark/robustness.py changes --trials 1 --folder /tmp/test    # does it work?

The policies are the shipped ones and the scripted crane. Rows with the task's present revision
are not measured again: if a policy has changed, delete the file. `figures.py robustness` draws the
changes.
"""

import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
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
from crane_env import INTEGRATORS, SERVOS, CraneVectorEnv
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
            drive = spec.actuator(f"{joint.name}_integral")
            drive.delay += self.delay
        angle, g = np.radians(self.slope), spec.option.gravity[2]
        spec.option.gravity = [-g * np.sin(angle), 0, g * np.cos(angle)]
        if self.slope:
            spec.geom("ground").friction[2] = 0.03  # m: else logs roll down from 1.4 degrees on
        return spec

    def limit_forces(self, ids: np.ndarray) -> None:
        super().limit_forces(ids)
        self.force_limit[:, ids] *= self.force
        limits = np.moveaxis(self.force_limit[:, ids], 0, -1)
        self.engine["actuator_forcerange"][ids, INTEGRATORS] = limits


def policy_of(method: str, level: str) -> Any:
    """The shipped policy of a method and a level."""
    if method == "scripted":
        return ScriptedCrane()
    name = METHODS[method] + f"_{level}" * (level != "ideal")
    return runs.load_policy(ROOT / "assets" / "policies" / f"{name}.pt")[0]


def add_row(path: Path, key: dict, policy: Any, env_id: str, sensors: bool, then: str = "") -> None:
    """Success and metrics of a policy, in trials of seed 60000. A row of this revision stays.

    then: the same task, and what follows the trial. `held` is success in both.
    """
    trials = key["per_diameter"]
    key |= {"trial_seed": REPORT_SEED, "trials": 6 * trials}
    key = {name: str(value) for name, value in key.items()}
    options = protocol.task_options(env_id)
    row = key | {"revision": str(protocol.crane_class(env_id).REVISION)}
    if any(row.items() <= known.items() for known in read_rows(path)):
        return
    if hasattr(options, "sensors"):
        options = replace(options, sensors=sensors)
    args = eval_crane.Args(seed=REPORT_SEED, trials=trials)
    rows = [*eval_crane.play(policy, env_id, options, args)]
    line = eval_crane.summarize(rows, {})
    line |= {"success": line["success %"], "gentle": line["gentle %"]}
    if then:
        later = eval_crane.play(policy, then, options, args)
        line["held"] = 100 * np.mean([a["success"] and b["success"] for a, b in zip(rows, later)])
    for name in ("success", *(["held"] if then else []), "gentle", *METRICS):
        row[name] = line[name] if line[name] == "" else f"{line[name]:.4g}"
    # one row of a policy on a crane, however many trials it has
    of_policy = {name: key[name] for name in key if name not in ("per_diameter", "trials")}
    others = [known for known in read_rows(path) if not of_policy.items() <= known.items()]
    write_rows(path, [*others, row | {"failures": line["failures"]}])


def levels(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write levels.csv: policies on the other levels, with so many trials per log diameter."""
    for method, trained_on, level in tqdm([*product(METHODS, LEVELS, LEVELS)], unit="row"):
        if level == "ideal" and trained_on != "ideal":
            continue  # too few sensors
        key = {"method": method, "trained_on": trained_on, "evaluated_on": level}
        key["per_diameter"] = trials
        policy = policy_of(method, trained_on)
        add_row(folder / "levels.csv", key, policy, LEVELS[level], trained_on != "ideal")


def loading(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write loading.csv: the scripted crane on the loading tasks."""
    for level, env_id in LOADING.items():
        key = {"method": "scripted", "level": level, "per_diameter": trials}
        add_row(folder / "loading.csv", key, ScriptedLoadingCrane(), env_id, True)


def changes(trials: int = 25, folder: Path = RESULTS) -> None:
    """Write robustness.csv: policies on hydraulic cranes with one of CHANGES."""
    policies = {method: policy_of(method, "hydraulic") for method in ("mPPO", "scripted")}
    policies["mPPO, trained on randomized"] = policy_of("mPPO", "randomized")
    points = [(name, label, x) for name, (label, xs) in CHANGES.items() for x in xs]
    for attribute, label, value in tqdm(points, unit="change"):
        env_id = f"Changed-{attribute}-{str(value).replace('.', '-')}-v0"
        cranes = type("Cranes", (ChangedCranes,), {attribute: value})
        gymnasium.register(env_id, vector_entry_point=cranes)
        for method, policy in policies.items():
            key = {"method": method, "changed": label, "value": value, "per_diameter": trials}
            add_row(folder / "robustness.csv", key, policy, env_id, True)


def held(trials: int = 100, folder: Path = RESULTS) -> None:
    """Write held.csv: success after 9 s, and after ten more seconds without command."""
    for method, (level, task) in tqdm([*product(METHODS, LEVELS.items())], unit="row"):

        class ThenStill(protocol.crane_class(task)):
            TIME_LIMIT = 19.0

            def step(self, actions: np.ndarray) -> tuple:
                return super().step(actions * (self.steps[:, None] < 90))

        then, kwargs = f"Held{method.replace(' ', '')}{task}", gymnasium.spec(task).kwargs
        gymnasium.register(then, vector_entry_point=ThenStill, kwargs=kwargs)
        key = {"method": method, "level": level, "per_diameter": trials}
        add_row(folder / "held.csv", key, policy_of(method, level), task, True, then)


def contacts(trials: int = 25, folder: Path = RESULTS) -> None:
    """Write contacts.csv: policies of the ideal level in the paper's SDF contacts."""
    task = "CraneWithSDFContacts-v0"
    gymnasium.register(task, vector_entry_point=CraneVectorEnv, kwargs={"contact": "sdf"})
    for method in tqdm(METHODS, unit="row"):
        key = {"method": method, "per_diameter": trials}
        add_row(folder / "contacts.csv", key, policy_of(method, "ideal"), task, False)


if __name__ == "__main__":
    torch.set_num_threads(1)
    commands = (levels, changes, loading, held, contacts)
    tyro.extras.subcommand_cli_from_dict(
        {command.__name__: command for command in commands}, description=__doc__
    )
