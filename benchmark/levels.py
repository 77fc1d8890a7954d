"""Policies on the three levels, what their trials cost, and how robust they are.

    python benchmark/levels.py table     # shipped policies and the scripted crane, on every level
    python benchmark/levels.py sweeps    # the same on a hydraulic crane with one thing changed
    python benchmark/levels.py draw      # assets/figures/robustness.svg from the sweeps

The levels are ideal (ForestryCrane-v0), hydraulic (ForestryCraneHydraulic-v0) and randomized
(ForestryCraneRandomized-v0). Policies come from the finished runs of `make_runs.py curves` and
`make_runs.py levels`. Where there is no run with seed 1, the shipped policy stands for it:
assets/policies/<script>.pt of the first level, <script>_<level>.pt of the others. `table` writes
benchmark/levels.csv, `sweeps` writes benchmark/robustness.csv, half an hour each. Rows that a file
has already are not measured again: delete the file when a policy has changed.
"""

import csv
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import matplotlib

matplotlib.use("Agg")
import crane_options
import crane_policies
import crane_runs
import crane_trials
import crane_view
import machine
import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro
from crane_options import Range, Seed
from leaderboard import LEVELS
from mujoco import MjModel
from tqdm import tqdm
from tyro.conf import Positional

import eval_crane
from crane_env import CraneVectorEnv
from scripted_crane import HYDRAULIC, IDEAL, ScriptedCrane

HERE = Path(__file__).parent
POLICIES = HERE.parent / "assets" / "policies"
FIGURE = HERE.parent / "assets" / "figures" / "robustness.svg"
METHODS = {
    "mPPO": "mppo_beta_crane",
    "PPO": "ppo_crane",
    "TRPO": "trpo_crane",
    "recurrent PPO": "recurrent_ppo_crane",
    "scripted": None,
}
SWEPT = {method: (method, "hydraulic") for method in METHODS}  # whose policies, made for what
SWEPT["mPPO, made for randomized"] = ("mPPO", "randomized")
SWEEPS = {  # what is changed, and to what
    "more dead time [s]": [0.0, 0.03, 0.06, 0.09, 0.12],
    "constant pose error [m]": [0.0, 0.05, 0.1, 0.15, 0.2, 0.3],
    "passive damping, times": [0.25, 0.5, 1.0, 2.0, 5.0, 10.0],
    "pump, times": [0.4, 0.6, 0.8, 1.0, 1.5],
    "force limits, times": [0.4, 0.6, 0.8, 1.0],
}


def policy_of(method: str, level: str, seed: int = 1) -> tuple[Any, dict[str, Any]] | None:
    """A trained policy and the task it was trained on, None if there is none."""
    if METHODS[method] is None:
        settings = {"ideal": IDEAL, "hydraulic": HYDRAULIC}  # a random machine is hydraulic too
        if level not in settings or seed > 1:
            return None
        return ScriptedCrane(settings=settings[level]), {"sensors": False}
    script = METHODS[method]
    folder, run = ("curves", script) if level == "ideal" else ("levels", f"{script}_{level}")
    if (HERE / folder / f"{run}_seed{seed}.csv").exists():  # finished
        if runs := sorted(HERE.glob(f"runs/*__{folder}_{run}__{seed}__*/policy.pt")):
            return crane_policies.load_policy(runs[-1])[:2]
    shipped = POLICIES / f"{script if level == 'ideal' else run}.pt"
    return crane_policies.load_policy(shipped)[:2] if seed == 1 and shipped.is_file() else None


def judge(
    policy: Any, task: dict[str, Any], level: str, trials: int, seed: int
) -> dict[str, float]:
    """Success in % and what eval_crane.py prints of the costs, in trials per diameter."""
    diameters, seeds = crane_trials.monte_carlo_trials(seed, trials)
    options = {"diameter": diameters, "sensors": task["sensors"]}
    envs = crane_trials.make_envs(LEVELS[level], len(seeds), **options)
    results = crane_trials.run_trials(policy, envs, seeds)
    envs.close()
    row = {"trials": len(seeds), "success": 100 * results["success"].mean()}
    row["gentle"] = 100 * results["gentle"].mean()
    trials = [dict(zip(results, values)) for values in zip(*results.values())]
    return row | eval_crane.mean_costs(trials)


@contextmanager
def changed(what: str, value: float) -> Iterator[None]:
    """The hydraulic crane with one thing changed, for cranes made here."""
    load_model, start_episodes = machine.load_model, CraneVectorEnv.start_episodes
    dead_time, max_delay, pump = machine.DEAD_TIME, machine.MAX_DELAY, machine.PUMP_FLOW

    def changed_model(*args: Any, **kwargs: Any) -> MjModel:
        model = load_model(*args, **kwargs)
        if what.startswith("passive"):
            for name in ("q5", "q6"):
                model.dof_damping[model.joint(name).dofadr] *= value
        if what.startswith("force"):
            model.jnt_actfrcrange *= value
        return model

    def with_pose_error(envs: CraneVectorEnv, ids: np.ndarray) -> tuple:
        angle = np.random.default_rng(0).uniform(0, 2 * np.pi, envs.num_envs)
        error = [np.cos(angle), np.sin(angle), 0 * angle]
        envs.drawn["pose_error"] = value * np.stack(error, axis=-1)
        return start_episodes(envs, ids)

    machine.load_model = changed_model
    if what.startswith("more"):
        machine.DEAD_TIME, machine.MAX_DELAY = dead_time + value, 2 * max_delay
    if what.startswith("pump"):
        machine.PUMP_FLOW = pump * value
    if what.startswith("constant"):
        CraneVectorEnv.start_episodes = with_pose_error
    try:
        yield
    finally:
        machine.load_model, CraneVectorEnv.start_episodes = load_model, start_episodes
        machine.DEAD_TIME, machine.MAX_DELAY, machine.PUMP_FLOW = dead_time, max_delay, pump


def append(path: Path, jobs: list[dict], measure: Callable) -> None:
    """Measure the jobs that have no row in a CSV file yet, and write each row as it comes."""
    rows = []
    if path.is_file():
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
    done = [{key: row[key] for key in jobs[0]} for row in rows]
    for job in tqdm(jobs, unit="cell"):
        if {key: str(value) for key, value in job.items()} in done:
            continue
        results = measure(job)
        if results is None:
            continue
        rows.append(job | {name: f"{value:.4g}" for name, value in results.items()})
        with crane_view.whole_file(path) as part, open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, rows[-1].keys())
            writer.writeheader()
            writer.writerows(rows)


def draw(rows: list[dict[str, str]]) -> None:
    """One panel for each thing that is changed, one line for each method."""
    protocol = str(crane_trials.REPORT_SEED), "25"  # trial seed, and trials per log diameter
    rows = [r for r in rows if (r["trial_seed"], r["per_diameter"]) == protocol]
    figure, panels = plt.subplots(1, len(SWEEPS), figsize=(16, 3.4), sharey=True)
    for what, panel in zip(SWEEPS, panels):
        for method in SWEPT:
            points = [r for r in rows if r["changed"] == what and r["method"] == method]
            if points:
                x, y = ([float(r[key]) for r in points] for key in ("value", "success"))
                panel.plot(x, y, "o-", markersize=4, label=method)
        panel.set_xlabel(what)
        panel.set_ylim(0, 102)
        panel.grid(alpha=0.3)
        if what.startswith("passive"):
            panel.set_xscale("log")
    panels[0].set_ylabel("success [%]")
    panels[-1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(FIGURE)
    print(f"written to {FIGURE}")


def main(
    what: Positional[Literal["table", "sweeps", "draw"]],
    trials: Annotated[int, Range(1, 10_000)] = 100,
    seed: Seed = crane_trials.REPORT_SEED,
) -> None:
    """Measure or draw.

    Args:
        what: the matrix of levels, the sweeps, or the figure of the sweeps
        trials: trials per log diameter
        seed: seed of the trials
    """
    crane_options.check({"trials": trials, "seed": seed}, main)
    torch.set_num_threads(1)
    protocol = {"per_diameter": trials, "trial_seed": seed}
    if what == "table":
        jobs = [
            {"method": method, "trained_on": level, "seed": k, "judged_on": judged_on, **protocol}
            for k in (1, 2, 3)
            for method in METHODS
            for level in LEVELS
            for judged_on in LEVELS
        ]

        def measure(job: dict) -> dict[str, float] | None:
            found = policy_of(job["method"], job["trained_on"], job["seed"])
            return None if found is None else judge(*found, job["judged_on"], trials, seed)

        append(HERE / "levels.csv", jobs, measure)
    elif what == "sweeps":
        jobs = [
            {"method": method, "changed": thing, "value": value, **protocol}
            for thing, values in SWEEPS.items()
            for value in values
            for method in SWEPT
        ]

        def measure(job: dict) -> dict[str, float] | None:
            found = policy_of(*SWEPT[job["method"]])
            with changed(job["changed"], job["value"]):
                return None if found is None else judge(*found, "hydraulic", trials, seed)

        append(HERE / "robustness.csv", jobs, measure)
    else:
        with open(HERE / "robustness.csv", newline="") as file:
            draw(list(csv.DictReader(file)))


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
