"""How cheap may MuJoCo's search for SDF contacts be? One policy, 120 trials, several settings.

The reference is MuJoCo's default, 40 starts with 10 iterations each. A setting agrees with it in a
trial if both succeed or both fail. miss_change_m is how much the distance from the grip to the
log's centre changes, on average over the trials in which both succeed.

touches_missed is the share of contacts that the search did not find. After 8.5 s the last action is
held for 0.5 s, in single physics steps. Logs that hang before and after these 0.5 s are gripped
firmly all the time. A jaw without a touch on such a log is a contact that was missed. The reference
takes too long for this figure.

Writes benchmark/sdf_search.csv.

    python benchmark/sdf_search.py [policy.pt]
"""

import csv
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_policies
import crane_runs
import crane_trials
import machine
import numpy as np
import torch
import tyro
from crane_task import MAX_MISS, MIN_CLEARANCE
from tyro.conf import Positional

import crane_env
import eval_crane

RESULTS = Path(__file__).parent / "sdf_search.csv"
SETTINGS = [(40, 10), (16, 5), (8, 5), (4, 5)]
SEED, TRIALS = 30_000, 20  # trials per diameter


def touches_missed(policy: Any, envs: crane_env.CraneVectorEnv, seeds: list) -> float:
    """Share of jaws without a touch, over the physics steps of the last 0.5 s and hanging logs."""
    obs, _ = envs.reset(seed=seeds)
    memory, going = None, np.ones(len(seeds), bool)
    for _ in range(round(8.5 / envs.dt)):
        actions, memory = policy.predict(obs, memory)
        obs, _, terminated, _, info = envs.advance(actions)
        going &= ~terminated
    hanging = going & (info["clearance"] > MIN_CLEARANCE) & (info["centre_miss"] < MAX_MISS)
    envs.frame_skip = 1  # 85 decisions are made: every fifth step clamps the servos' integrators
    touching = []
    for _ in range(100):
        *_, info = envs.advance(actions)
        touching.append(envs.state().touching)
    hanging &= (info["clearance"] > MIN_CLEARANCE) & (info["centre_miss"] < MAX_MISS)
    return 1 - float(np.mean(np.array(touching)[:, hanging]))


def main(path: Positional[Path] = crane_policies.SHIPPED) -> None:
    """path: policy.pt of a run."""
    torch.set_num_threads(1)
    policy, task, _ = crane_policies.load_policy(path)
    env_id, options = eval_crane.task_of(eval_crane.Args(contact="sdf"), task)
    diameters, seeds = crane_trials.monte_carlo_trials(SEED, TRIALS)
    rows, reference = [], None
    for initpoints, iterations in SETTINGS:
        # `load_model` reads these constants
        machine.SDF_INITPOINTS, machine.SDF_ITERATIONS = initpoints, iterations
        start = time.perf_counter()
        envs = crane_trials.make_envs(env_id, len(seeds), diameter=diameters, **options)
        results = crane_trials.run_trials(policy, envs, seeds)
        seconds = time.perf_counter() - start
        success, miss = results["success"], results["centre_miss"]
        missed = np.nan  # of the slow reference
        if reference is not None:
            missed = touches_missed(policy, envs.unwrapped, seeds)
        envs.close()
        reference = (success, miss) if reference is None else reference
        both = success & reference[0]
        row = {
            "sdf_initpoints": initpoints,
            "sdf_iterations": iterations,
            "success_rate": round(float(success.mean()), 4),
            "agreement": round(float((success == reference[0]).mean()), 4),
            "miss_change_m": round(float(np.abs(miss - reference[1])[both].mean()), 4),
            "touches_missed": round(missed, 5),
            "seconds": round(seconds, 1),
        }
        rows.append(row)
        print(row, flush=True)
    with open(RESULTS, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
