"""How cheap may MuJoCo's search for SDF contacts be? One policy, 120 trials, several settings.

A setting agrees with MuJoCo's default (40 starts, 10 iterations) in a trial when both succeed
or both fail; miss_change_m is by how much the grip's place along the log differs, on average over
trials that both succeed. touches_missed: after 8.5 s the last action is held for 0.5 s, in single
physics steps; of the jaws of logs that hang before and after, the share without a touch, mean over
these steps. The grip is firm, so they are contacts that the search did not find. Not of the
reference, which takes too long. Writes benchmark/sdf_search.csv.

    python benchmark/sdf_search.py [policy.pt]
"""

import csv
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np  # noqa: E402
import torch  # noqa: E402
import tyro  # noqa: E402
from tyro.conf import Positional  # noqa: E402

import eval_crane  # noqa: E402
from crane_env import MAX_MISS, MIN_CLEARANCE, CraneVectorEnv, monte_carlo_trials  # noqa: E402

SETTINGS = [(40, 10), (16, 5), (8, 5), (4, 5)]
SEED, TRIALS = 30_000, 20  # trials per diameter


def touches_missed(make_act: Callable, kwargs: dict, diameters: np.ndarray, seeds: list) -> float:
    """Share of jaws without a touch, over the physics steps of the last 0.5 s and hanging logs."""
    envs = CraneVectorEnv(len(seeds), diameter=diameters, **kwargs)
    obs, _ = envs.reset(seed=seeds)
    act, going = make_act(), np.ones(len(seeds), bool)
    for _ in range(round(8.5 / envs.dt)):
        actions = act(obs)
        obs, _, terminated, _, info = envs.advance(actions)
        going &= ~terminated
    hanging = going & (info["clearance"] > MIN_CLEARANCE) & (info["centre_miss"] < MAX_MISS)
    envs.frame_skip = 1  # 85 decisions are made: every fifth step clamps the servos' integrators
    touching = []
    for _ in range(100):
        *_, info = envs.advance(actions)
        touching.append(envs._state().touching)
    hanging &= (info["clearance"] > MIN_CLEARANCE) & (info["centre_miss"] < MAX_MISS)
    return 1 - float(np.mean(np.array(touching)[:, hanging]))


def main(path: Positional[Path] = eval_crane.SHIPPED) -> None:
    """path: policy.pt of a run."""
    torch.set_num_threads(1)
    make_act, kwargs, _ = eval_crane.load_policy(path, stochastic=False)
    diameters, seeds = monte_carlo_trials(SEED, TRIALS)
    rows, reference = [], None
    for initpoints, iterations in SETTINGS:
        options = {"contact": "sdf", "sdf_initpoints": initpoints, "sdf_iterations": iterations}
        options["env_threads"] = 0
        start = time.perf_counter()
        records = eval_crane.run_trials(make_act, {**kwargs, **options}, diameters, seeds)
        seconds = time.perf_counter() - start
        success = np.array([record["success"] for record in records])
        miss = np.array([record["centre_miss"] for record in records])
        missed = np.nan  # of the slow reference
        if reference is not None:
            missed = touches_missed(make_act, {**kwargs, **options}, diameters, seeds)
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
    with open(Path(__file__).parent / "sdf_search.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
