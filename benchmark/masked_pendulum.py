"""What memory is for: Pendulum-v1 without its velocity, by PPO and by recurrent PPO.

The observation keeps the cosine and the sine of the angle. A policy has to remember them to know
how fast the pendulum turns. Both scripts get the same number of decisions, batches of the same size
and the same learning rate, which falls linearly to 0. They do not normalize the observations.

benchmark/masked_pendulum.csv has a row for each evaluation, during the runs and at their ends: the
mean return of the mean action in 20 episodes. A run that is already there and long enough is
skipped.

    python benchmark/masked_pendulum.py --help
"""

import csv
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_options
import crane_runs
import gymnasium
import numpy as np
import tyro
from crane_options import Count, Seed
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.wrappers import TransformObservation

HERE = Path(__file__).parent
RESULTS = HERE / "masked_pendulum.csv"
COLUMNS = ["algorithm", "seed", "steps", "mean_return"]
EPISODES = 20
NUM_ENVS, NUM_STEPS = 32, 128
BATCH = NUM_ENVS * NUM_STEPS
COMMON = f"""--env-id masked_pendulum:MaskedPendulum-v1
--num-envs {NUM_ENVS} --num-steps {NUM_STEPS} --gamma 0.9 --reward-scale 0.1 --learning-rate 1e-3
--update-epochs 10 --hidden-sizes 64 64 --log-std-init 0 --horizon-growth 1 --narrowing 0
--no-normalize-obs --target-kl None --eval-every 5 --torch-threads 1"""
OWN = {"ppo": "--minibatch-size 512", "recurrent_ppo": "--num-minibatches 8"}


def masked_pendulum() -> gymnasium.Env:
    """Pendulum-v1 whose observation is (cos, sin) of the angle."""
    space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return TransformObservation(PendulumEnv(), lambda obs: obs[:2], space)


gymnasium.register("MaskedPendulum-v1", entry_point=masked_pendulum, max_episode_steps=200)


@dataclass
class Args:
    steps: Count = 300_000  # decisions of each run, in whole rollouts
    seeds: tuple[Seed, ...] = (1, 2, 3)  # one run each of either script

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def train(algorithm: str, seed: int, steps: int) -> list[tuple[int, float]]:
    """Decisions and mean return of every evaluation of one run."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    words = [*COMMON.split(), *OWN[algorithm].split(), "--seed", str(seed)]
    words += ["--total-timesteps", str(steps), "--eval-trials", str(EPISODES)]
    words += ["--final-trials", "0"]
    with tempfile.TemporaryDirectory() as folder:
        script = HERE.parent / f"{algorithm}_crane.py"
        paths = [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        subprocess.run([sys.executable, script, *words], cwd=folder, env=environment, check=True)
        events = EventAccumulator(str(next(Path(folder).glob("runs/*"))))
        events.Reload()
        return [(e.step, e.value) for e in events.Scalars("eval/episodic_return")]


if __name__ == "__main__":
    crane_runs.one_line_errors()
    args = tyro.cli(Args, description=__doc__)
    rows = list(csv.reader(open(RESULTS)))[1:] if RESULTS.exists() else []
    for seed in args.seeds:
        for algorithm in OWN:
            old = [row for row in rows if row[:2] == [algorithm, str(seed)]]
            if max((int(row[2]) for row in old), default=0) > args.steps - BATCH:
                continue
            curve = train(algorithm, seed, args.steps)
            rows = [row for row in rows if row not in old]
            rows += [[algorithm, str(seed), step, round(value, 1)] for step, value in curve]
            print(f"{algorithm}, seed {seed}: {curve[-1][1]:.0f} after {curve[-1][0]} decisions")
            with open(RESULTS.with_suffix(".tmp"), "w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
            os.replace(RESULTS.with_suffix(".tmp"), RESULTS)
