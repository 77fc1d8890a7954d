"""What a user would pick instead, on the same cranes: mPPO and other libraries, 10 minutes each.

    pip install -r benchmark/requirements.txt
    python benchmark/rivals.py                                  # all, 6 hours on two cores
    python benchmark/rivals.py --rivals sb3_ppo sac --seeds 21  # some
    python benchmark/rivals.py --minutes 1.5 --results /tmp/rivals.csv    # does it work?

Each run is a process, whose start counts. Every minute its clock stops, and the mean action is
evaluated in 120 trials of seed 10000. A finished run adds its rows to benchmark/results/rivals.csv
and is not made again. A killed run leaves none.

`published` settings were made for other tasks: rl-baselines3-zoo's for PyBullet's HalfCheetah (PPO
of sbx without gSDE), and the example of sbx's README (its SAC). `ours` is one try, chosen before
any result, with mPPO's reward scale, easy starts and repeated failures. mPPO has its defaults.
"""

import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

sys.path.insert(0, str(Path(__file__).parent.parent))

import gymnasium
import numpy as np
import torch
import tyro
from pydantic.dataclasses import dataclass
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from tqdm import tqdm

from benchmark.runs import RESULTS, ROOT, read_rows, write_rows
from crane_utils import runs, trials
from crane_utils.sb3 import CraneVecEnv

TASK, TRIALS, EVERY = "ForestryCrane-v0", 20, 60.0  # trials per log diameter; s between evaluations
ENDLESS = 10**9  # steps or updates: the clock ends the training
STARTED = "RIVALS_STARTED"  # environment variable of a run: time.monotonic() before its process


class Setting(NamedTuple):
    options: dict[str, Any]  # the library's own
    cranes: int = 64
    like_mppo: bool = False  # easy starts first, repeated failures, scaled reward
    normalize: dict[str, Any] | None = None  # options of SB3's VecNormalize
    falling: bool = False  # the learning rate falls linearly to 0


class TimeUp(Exception):
    """The minutes are over."""


class Clock:
    """Wall-clock time since the process was started, without the time of evaluations.

    A training function sets predict, as `trials.run_trials` wants it.
    """

    def __init__(self, minutes: float, threads: int):
        self.started, self.limit, self.threads = float(os.environ[STARTED]), 60 * minutes, threads
        self.next, self.evaluating, self.steps, self.rows = EVERY, 0.0, 0, []  # s
        self.predict: Callable[..., tuple] | None = None

    def seconds(self) -> float:
        return time.monotonic() - self.started - self.evaluating

    def share(self) -> float:
        return min(1.0, self.seconds() / self.limit)

    def evaluate(self, minutes: float, steps: int) -> None:
        start = time.monotonic()
        scores = trials.evaluate(self, TASK, TRIALS, threads=self.threads)
        rates = {name: round(100 * scores[f"{name}_rate"], 1) for name in ("success", "gentle")}
        self.rows.append({"minutes": round(minutes, 2), "steps": steps, **rates})
        tqdm.write(str(self.rows[-1]))
        self.evaluating += time.monotonic() - start


class TimedCranes(gymnasium.vector.VectorWrapper):
    """Cranes that look at the clock before each step, whatever library makes it."""

    def __init__(self, setting: Setting, clock: Clock):
        self.clock, self.like_mppo = clock, setting.like_mppo
        options = {"env_threads": clock.threads, "retry": 0.5 if self.like_mppo else 0.0}
        super().__init__(gymnasium.make_vec(TASK, setting.cranes, **options))

    def step(self, actions: np.ndarray) -> tuple:
        clock, seconds = self.clock, self.clock.seconds()
        if seconds >= min(clock.next, clock.limit):
            clock.evaluate(seconds / 60, clock.steps)
            clock.next = EVERY * (seconds // EVERY + 1)
        if seconds >= clock.limit:
            raise TimeUp
        if self.like_mppo:
            self.unwrapped.difficulty = min(1.0, clock.share() / 0.4)
        obs, reward, *rest = self.env.step(actions)
        clock.steps += self.num_envs
        return obs, reward * (0.06 if self.like_mppo else 1.0), *rest


# ---- trainings


def train_sb3(algorithm: str, setting: Setting, seed: int, clock: Clock) -> None:
    """algorithm: module and class, of Stable-Baselines3, sb3-contrib or sbx."""
    (module, name), options = algorithm.split(":"), deepcopy(setting.options)
    if setting.falling:
        start = options["learning_rate"]
        options["learning_rate"] = lambda _: start * (1 - clock.share())
    if module == "sbx" and "activation_fn" in options.get("policy_kwargs", {}):
        options["policy_kwargs"]["activation_fn"] = importlib.import_module("jax").nn.relu
    envs = CraneVecEnv(setting.cranes, env_threads=1)
    envs.envs = TimedCranes(setting, clock)
    envs = VecNormalize(envs, **setting.normalize or dict(norm_obs=False, norm_reward=False))
    maker = getattr(importlib.import_module(module), name)
    model = maker("MlpPolicy", envs, seed=seed, device="cpu", **options)
    clock.predict = lambda obs, *_, **how: model.predict(envs.normalize_obs(obs), **how)
    model.learn(ENDLESS)


def train_mppo(_: str, setting: Setting, seed: int, clock: Clock) -> None:
    """mppo_beta_crane.py in a process of its own. Copies of its policy are evaluated afterwards."""
    command = [sys.executable, str(ROOT / "mppo_beta_crane.py"), "--seed", str(seed)]
    command += ["--threads", str(clock.threads), "--eval-every", str(ENDLESS)]
    copies: list[tuple[float, int]] = []
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        for due in [*np.arange(EVERY, clock.limit, EVERY), clock.limit]:
            while process.poll() is None and clock.seconds() < due:
                time.sleep(0.1)
            for path in Path().glob("runs/*/checkpoint.pt"):
                copies.append((clock.seconds() / 60, 64 * 64 * runs.load(path)["iteration"]))
                Path(f"{len(copies)}.pt").write_bytes(path.with_name("policy.pt").read_bytes())
        process.kill()
    for number, (minutes, steps) in enumerate(copies, 1):
        clock.predict = runs.load_policy(Path(f"{number}.pt"))[0].predict
        clock.evaluate(minutes, steps)


# ---- all of them

ZOO_PPO = dict(
    n_steps=512, batch_size=128, n_epochs=20, learning_rate=3e-5, gamma=0.99, gae_lambda=0.9,
    clip_range=0.4, policy_kwargs=dict(log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU,
                                       net_arch=[256, 256]))  # fmt: skip
ZOO_SAC = dict(
    learning_rate=7.3e-4, buffer_size=300_000, gamma=0.98, tau=0.02, train_freq=8, gradient_steps=8,
    learning_starts=10_000, use_sde=True,
    policy_kwargs=dict(log_std_init=-3, net_arch=[400, 300]))  # fmt: skip
OUR_PPO = dict(
    n_steps=64, batch_size=1024, n_epochs=8, learning_rate=1e-3, gamma=0.97,
    policy_kwargs=dict(log_std_init=-1.2, net_arch=[256, 256]))  # fmt: skip
# With 32 cranes this is one gradient step for four steps: more would leave few steps. An entropy
# weight that starts at 1 would outweigh the scaled reward.
OUR_SAC = dict(
    learning_rate=1e-3, buffer_size=500_000, gamma=0.97, tau=0.01, gradient_steps=8,
    learning_starts=5000, ent_coef="auto_0.1", policy_kwargs=dict(net_arch=[256, 256]))  # fmt: skip
SDE, ALL_STEPS = dict(use_sde=True, sde_sample_freq=4), dict(train_freq=64, gradient_steps=64)
SBX_SAC = dict(learning_starts=10_000, train_freq=4, gradient_steps=4)
ZOO_NORMALIZE, ONLY_OBS = dict(norm_reward=True, gamma=0.99), dict(norm_reward=False)
OFF_POLICY = Setting(OUR_SAC, 32, True, ONLY_OBS)
RIVALS = {  # how to train, module and class, and the settings
    "mppo_beta": (train_mppo, "", {"published": Setting({})}),
    "sb3_ppo": (train_sb3, "stable_baselines3:PPO", {
        "published": Setting(ZOO_PPO | SDE, 16, normalize=ZOO_NORMALIZE),
        "ours": Setting(OUR_PPO | dict(target_kl=0.04), 64, True, ONLY_OBS, falling=True)}),
    "sac": (train_sb3, "stable_baselines3:SAC",
            {"published": Setting(ZOO_SAC, 1), "ours": OFF_POLICY}),
    "tqc": (train_sb3, "sb3_contrib:TQC",
            {"published": Setting(ZOO_SAC | ALL_STEPS, 1), "ours": OFF_POLICY}),
    "sbx_ppo": (train_sb3, "sbx:PPO", {  # its target_kl sets the learning rate
        "published": Setting(ZOO_PPO, 16, normalize=ZOO_NORMALIZE),
        "ours": Setting(OUR_PPO, 64, True, ONLY_OBS, falling=True)}),
    "sbx_sac": (train_sb3, "sbx:SAC", {"published": Setting(SBX_SAC, 1), "ours": OFF_POLICY}),
}  # fmt: skip


@dataclass
class Args:
    rivals: tuple[Literal[*RIVALS], ...] = tuple(RIVALS)  # who runs
    settings: tuple[Literal["published", "ours"], ...] = ("published", "ours")  # mPPO has no second
    seeds: tuple[int, ...] = (21, 22, 23)  # one run each
    minutes: float = 10.0  # wall-clock time of a run
    threads: int = 2  # cores of a run, and threads of the physics and of torch
    results: Path = RESULTS / "rivals.csv"  # CSV file that gets the rows of finished runs


def run_here(args: Args) -> None:
    """The one run that this process was started for."""
    (name,), (setting,), (seed,) = args.rivals, args.settings, args.seeds
    torch.set_num_threads(args.threads)
    clock, (train, algorithm, settings) = Clock(args.minutes, args.threads), RIVALS[name]
    with suppress(TimeUp):
        train(algorithm, settings[setting], seed, clock)
    key = {"rival": name, "setting": setting, "seed": seed, "budget": args.minutes}
    write_rows(args.results, read_rows(args.results) + [key | row for row in clock.rows])


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    if STARTED in os.environ:
        return run_here(args)
    if hasattr(os, "sched_setaffinity"):  # jax takes all cores that it finds
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: args.threads])
    extra = {"OMP_NUM_THREADS": str(args.threads), "JAX_PLATFORMS": "cpu", "GOMP_SPINCOUNT": "5000"}
    for seed, name, setting in tqdm([*product(args.seeds, args.rivals, args.settings)]):
        run = [name, setting, str(seed), str(args.minutes)]
        done = [[*row.values()][:4] for row in read_rows(args.results)]
        if run in done or setting not in RIVALS[name][2]:
            continue
        tqdm.write(" ".join(run))
        words = ["--rivals", name, "--settings", setting, "--seeds", str(seed), "--minutes", run[3]]
        words += ["--threads", str(args.threads), "--results", str(args.results.resolve())]
        environment = os.environ | extra | {STARTED: str(time.monotonic())}
        with tempfile.TemporaryDirectory() as folder:  # for what they write
            subprocess.run([sys.executable, __file__, *words], cwd=folder, env=environment)
    ends: dict[str, dict] = defaultdict(dict)
    for row in read_rows(args.results):
        if float(row["budget"]) == args.minutes:
            ends[f"{row['rival']}, {row['setting']}"][row["seed"]] = float(row["success"])
    for name, of_seed in ends.items():
        low, high = min(of_seed.values()), max(of_seed.values())
        print(f"{name:24}{np.mean([*of_seed.values()]):5.1f} % ({low}–{high})")


if __name__ == "__main__":
    main()
