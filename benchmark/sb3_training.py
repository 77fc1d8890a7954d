"""Timed trainings of Stable-Baselines3 (SB3) and sb3-contrib on the crane, for throughput.py."""

import sys
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from plain_crane import PlainCrane
from sb3_crane import CraneVecEnv
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

# of both sides
SEED = 1
CRANES, THREADS = 64, 2  # of CraneVectorEnv
NETWORK, LSTM, EPOCHS, MINIBATCHES = (256, 256), 64, 8, 4
FISHER_SAMPLES = 1024  # of TRPO, for its direction
LOG_STD = -1.2  # as ours start: wilder ones end more episodes

ARRANGEMENTS = [("Dummy", 16), ("Dummy", 64), ("Subproc", 8), ("Subproc", 16)]
START = "fork" if sys.platform == "linux" else None  # workers that start fast and share memory


class Iteration(NamedTuple):
    rate: float  # decisions/s
    update: float  # s, what follows the rollout
    threads: int  # of torch


def with_better_threads(iterations: list[Iteration]) -> list[Iteration]:
    """Those of the number of threads that was faster in the median."""
    groups = {i.threads: [j for j in iterations if j.threads == i.threads] for i in iterations}
    return max(groups.values(), key=lambda group: np.median([i.rate for i in group]))


class Stopwatch(BaseCallback):
    """Times SB3's iterations after one to warm up, with 2 and with 1 threads by turns."""

    def __init__(self, rollout: int) -> None:
        super().__init__()
        self.rollout, self.count = rollout, 0
        self.iterations: list[Iteration] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._on_training_end()
        torch.set_num_threads(1 + self.count % 2)
        self.count += 1
        self.start = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self.update_start = time.perf_counter()

    def _on_training_end(self) -> None:
        if self.count > 1:
            now = time.perf_counter()
            rate, update = self.rollout / (now - self.start), now - self.update_start
            self.iterations.append(Iteration(rate, update, torch.get_num_threads()))


class CollectOnly(stable_baselines3.PPO):
    def train(self) -> None:
        pass


def train_sb3(algorithm: str, kind: str, n: int, frame_skip: int, rollout: int) -> list[Iteration]:
    """Four iterations of SB3 on n cranes."""
    makers = [partial(PlainCrane, frame_skip)] * n
    if kind == "Subproc":
        envs = SubprocVecEnv(makers, start_method=START)
    elif kind == "Dummy":
        envs = DummyVecEnv(makers)
    else:
        envs = CraneVecEnv(CRANES, env_threads=THREADS, frame_skip=frame_skip)
    policy = {"net_arch": list(NETWORK), "log_std_init": LOG_STD}
    options = {"n_steps": rollout // n, "batch_size": rollout // MINIBATCHES, "device": "cpu"}
    options |= {"n_epochs": EPOCHS, "policy_kwargs": policy, "seed": SEED}
    maker, network = stable_baselines3.PPO, "MlpPolicy"
    if algorithm == "collect":
        maker = CollectOnly
    elif algorithm == "TRPO":  # the step as in trpo_crane.py, the critic as above
        maker = sb3_contrib.TRPO
        options |= {"n_critic_updates": options.pop("n_epochs")}
        # SB3 averages the KL divergence over the action's 6 components, ours sums it
        options |= {"target_kl": 0.04 / 6, "cg_damping": 0.1 / 6}
        # theirs takes gradient and line search over the sample too
        options |= {"sub_sampling_factor": max(1, rollout // FISHER_SAMPLES)}
    elif algorithm == "RecurrentPPO":  # one memory, as ours; its networks do not see obs beside it
        maker, network = sb3_contrib.RecurrentPPO, "MlpLstmPolicy"
        policy |= {"lstm_hidden_size": LSTM, "shared_lstm": True, "enable_critic_lstm": False}
    stopwatch = Stopwatch(rollout)
    maker(network, envs, **options).learn(5 * rollout, stopwatch)
    envs.close()
    return stopwatch.iterations


def try_arrangements(frame_skip: int, rollout: int) -> list[list[Iteration]]:
    """SB3's PPO that only collects, in each of ARRANGEMENTS."""
    return [train_sb3("collect", *how, frame_skip, rollout) for how in ARRANGEMENTS]
