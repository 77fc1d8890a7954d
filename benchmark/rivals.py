"""What a user would pick instead, on the same cranes: other libraries, 10 minutes each.

    pip install -r benchmark/requirements.txt
    python benchmark/rivals.py                                  # all, over 3 hours on two cores
    python benchmark/rivals.py --rivals sb3_ppo sac --seeds 21  # some
    python benchmark/rivals.py --minutes 1.5 --results /tmp/rivals.csv    # does it work?

Each run is a process, whose start counts. At the end the mean action is evaluated in 120 trials of
seed 10000. A finished run adds a row to rivals.csv and is not made again. The rows in
benchmark/results/rivals.csv are of commit fd1bad9, with physics steps of 5 ms.

`published` settings were made for other tasks: rl-baselines3-zoo's for PyBullet's HalfCheetah.
`ours` is one try, chosen before any result, with mPPO's reward scale, easy starts, repeated
failures and physics steps of 10 ms.
"""

import importlib
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

sys.path.insert(0, str(Path(__file__).parent.parent))

import torch
import tyro
from gymnasium.wrappers.vector import TransformReward
from pydantic.dataclasses import dataclass
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from tqdm import tqdm

from benchmark.runs import read_rows, write_rows
from crane_utils import trials
from crane_utils.sb3 import CraneVecEnv

TASK, TRIALS = "ForestryCrane-v0", 20  # trials per log diameter


class Setting(NamedTuple):
    options: dict[str, Any]  # the library's own
    cranes: int = 64
    like_mppo: bool = False  # easy starts first, repeated failures, scaled reward, coarse physics
    normalize: dict[str, Any] | None = None  # options of SB3's VecNormalize
    falling: bool = False  # the learning rate falls linearly to 0


class Clock(BaseCallback):
    """Ends the training after so many seconds since the process was started."""

    def __init__(self, cranes: Any, like_mppo: bool, started: float, seconds: float):
        super().__init__()
        self.cranes, self.like_mppo = cranes, like_mppo
        self.started, self.limit = started, seconds

    def share(self) -> float:
        return min(1.0, (time.monotonic() - self.started) / self.limit)

    def predict(self, obs: Any, state: None, **how: Any) -> tuple:
        return self.model.predict(self.training_env.normalize_obs(obs), **how)

    def _on_step(self) -> bool:
        self.cranes.difficulty = min(1.0, self.share() / 0.4) if self.like_mppo else 1.0
        return self.share() < 1


def train(rival: str, how: str, seed: int, started: float, minutes: float, threads: int) -> dict:
    """In a process of its own: steps and success rates of a run."""
    torch.set_num_threads(threads)
    algorithm, settings = RIVALS[rival]
    (module, name), setting = algorithm.split(":"), settings[how]
    options = dict(setting.options)
    task = {"difficulty": 0.0, "retry": 0.5, "physics_step": 0.01} if setting.like_mppo else {}
    envs = CraneVecEnv(setting.cranes, TASK, env_threads=threads, **task)
    clock = Clock(envs.envs, setting.like_mppo, started, 60 * minutes)
    if setting.like_mppo:
        envs.envs = TransformReward(envs.envs, lambda reward: 0.06 * reward)
    if setting.falling:
        start = options["learning_rate"]
        options["learning_rate"] = lambda _: start * (1 - clock.share())
    envs = VecNormalize(envs, **setting.normalize or dict(norm_obs=False, norm_reward=False))
    maker = getattr(importlib.import_module(module), name)
    maker("MlpPolicy", envs, seed=seed, device="cpu", **options).learn(10**9, clock)
    scores = trials.evaluate(clock, TASK, TRIALS, threads=threads)
    rates = {name: round(100 * scores[f"{name}_rate"], 1) for name in ("success", "gentle")}
    return {"steps": clock.num_timesteps, **rates}


# ---- all of them

ZOO_PPO = dict(
    n_steps=512, batch_size=128, n_epochs=20, learning_rate=3e-5, gamma=0.99, gae_lambda=0.9,
    clip_range=0.4, use_sde=True, sde_sample_freq=4,
    policy_kwargs=dict(log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU,
                       net_arch=[256, 256]))  # fmt: skip
ZOO_SAC = dict(
    learning_rate=7.3e-4, buffer_size=300_000, gamma=0.98, tau=0.02, train_freq=8, gradient_steps=8,
    learning_starts=10_000, use_sde=True,
    policy_kwargs=dict(log_std_init=-3, net_arch=[400, 300]))  # fmt: skip
OUR_PPO = dict(
    n_steps=64, batch_size=1024, n_epochs=8, learning_rate=1e-3, gamma=0.97, target_kl=0.04,
    policy_kwargs=dict(log_std_init=-1.2, net_arch=[256, 256]))  # fmt: skip
# With 32 cranes this is one gradient step for four steps: more would leave few steps. An entropy
# weight that starts at 1 would outweigh the scaled reward.
OUR_SAC = dict(
    learning_rate=1e-3, buffer_size=500_000, gamma=0.97, tau=0.01, gradient_steps=8,
    learning_starts=5000, ent_coef="auto_0.1", policy_kwargs=dict(net_arch=[256, 256]))  # fmt: skip
ONLY_OBS = dict(norm_reward=False)
OFF_POLICY = Setting(OUR_SAC, 32, True, ONLY_OBS)
RIVALS = {  # module and class, and the settings
    "sb3_ppo": ("stable_baselines3:PPO", {
        "published": Setting(ZOO_PPO, 16, normalize=dict(norm_reward=True, gamma=0.99)),
        "ours": Setting(OUR_PPO, 64, True, ONLY_OBS, falling=True)}),
    "sac": ("stable_baselines3:SAC", {"published": Setting(ZOO_SAC, 1), "ours": OFF_POLICY}),
    "tqc": ("sb3_contrib:TQC", {
        "published": Setting(ZOO_SAC | dict(train_freq=64, gradient_steps=64), 1),
        "ours": OFF_POLICY}),
}  # fmt: skip


@dataclass
class Args:
    rivals: tuple[Literal[*RIVALS], ...] = tuple(RIVALS)  # who runs
    settings: tuple[Literal["published", "ours"], ...] = ("published", "ours")
    seeds: tuple[int, ...] = (21, 22, 23)  # one run each
    minutes: float = 10.0  # wall-clock time of a run
    threads: int = 2  # threads of the physics and of torch
    results: Path = Path("rivals.csv")  # CSV file that gets the rows of finished runs


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    os.environ |= {"OMP_NUM_THREADS": str(args.threads), "GOMP_SPINCOUNT": "5000"}
    for seed, name, setting in tqdm([*product(args.seeds, args.rivals, args.settings)]):
        key = {"rival": name, "setting": setting, "seed": seed, "budget": args.minutes}
        key = {name: str(value) for name, value in key.items()}
        if any(key.items() <= row.items() for row in read_rows(args.results)):
            continue
        tqdm.write(" ".join(key.values()))
        clock = time.monotonic(), args.minutes, args.threads
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            row = pool.submit(train, name, setting, seed, *clock).result()
        write_rows(args.results, [*read_rows(args.results), key | row])


if __name__ == "__main__":
    main()
