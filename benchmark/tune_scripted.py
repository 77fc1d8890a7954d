"""Search settings of the scripted crane for a level: benchmark/tune_scripted.csv.

    python benchmark/tune_scripted.py hydraulic     # half an hour on one core
    python benchmark/tune_scripted.py randomized

The search starts from a set of `scripted_crane.py`. Each candidate is the best set so far with
about half of its numbers multiplied by exp(N(0, 0.2^2)). It is judged in trials of seed 10000, the
same for all. The score is success plus gentle success. Every candidate is a row of the file. At
the end the best set is printed, to be copied into scripted_crane.py.
"""

import csv
import sys
from pathlib import Path
from typing import Annotated, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_options
import crane_runs
import crane_trials
import numpy as np
import tyro
from crane_options import Range, Seed
from leaderboard import LEVELS
from tqdm import trange
from tyro.conf import Positional

from scripted_crane import HYDRAULIC, IDEAL, ScriptedCrane, Settings

FILE = Path(__file__).with_suffix(".csv")
SPREAD = 0.2  # standard deviation of the logarithm of a changed number
LARGEST = {"jaw_speed": 1.0, "meeting_speed": 1.0, "squeeze": 1.0}  # commands of the jaws


def neighbour(settings: Settings, rng: np.random.Generator) -> Settings:
    """The settings with about half of the numbers changed."""
    numbers = {}
    for name, value in settings._asdict().items():
        factor = np.exp(SPREAD * rng.standard_normal()) if rng.random() < 0.5 else 1.0
        numbers[name] = float(f"{min(value * factor, LARGEST.get(name, np.inf)):.3g}")
    return Settings(**numbers)


def main(
    level: Positional[Literal["ideal", "hydraulic", "randomized"]],
    candidates: Annotated[int, Range(1, 100_000)] = 300,
    trials: Annotated[int, Range(1, 10_000)] = 12,
    seed: Seed = 1,
) -> None:
    """candidates: how many to judge; trials: per log diameter; seed: of the search."""
    crane_options.check({"candidates": candidates, "trials": trials, "seed": seed}, main)
    rng = np.random.default_rng(seed)
    diameters, seeds = crane_trials.monte_carlo_trials(10_000, trials)
    envs = crane_trials.make_envs(LEVELS[level], len(seeds), 1, diameter=diameters, sensors=False)
    best, best_score = IDEAL if level == "ideal" else HYDRAULIC, -1.0
    new = not FILE.exists()
    with open(FILE, "a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(["task", "seed", "candidate", "success", "gentle", *Settings._fields])
        progress = trange(candidates, unit="set")
        for candidate in progress:
            settings = neighbour(best, rng) if candidate else best
            results = crane_trials.run_trials(ScriptedCrane(settings=settings), envs, seeds)
            success, gentle = (100 * results[name].mean() for name in ("success", "gentle"))
            row = [level, seed, candidate, f"{success:.1f}", f"{gentle:.1f}", *settings]
            writer.writerow(row)
            file.flush()
            if success + gentle > best_score:
                best, best_score = settings, success + gentle
                progress.set_postfix(success=success, gentle=gentle)
    print(best)


if __name__ == "__main__":
    crane_runs.one_line_errors()
    tyro.cli(main, description=__doc__)
