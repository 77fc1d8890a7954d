"""Our scripts compared with Stable-Baselines3 (SB3) and sb3-contrib on two well-known tasks.

Both sides have the same number of decisions, networks, batches, epochs, gamma, lambda and bounds.
The learning rate starts at the same value and falls linearly to 0 on both sides, update by update.
For TRPO this is the learning rate of the critic. Both sides normalize the observations, or neither
does. Both multiply the reward by the same constant. Each final policy is judged by its mean action
in 20 episodes, whose seeds are the same for all policies.

Each finished run adds one row to benchmark/compare_sb3.csv or to the file of --results. Runs that
have a row when the script starts are skipped. Remove the rows of other settings first: the file
does not say which schedule a run had. Two processes can write to the same file side by side if
their --seeds differ. At the end the script prints mean and standard deviation over the seeds.

    pip install -r benchmark/requirements.txt
    python benchmark/compare_sb3.py --help
    python benchmark/compare_sb3.py --tasks Pendulum-v1 --algorithms ppo --seeds 1 2 3 \
        --results pendulum.csv
"""

import csv
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent))

import crane_options
import crane_policies
import crane_runs
import crane_trials
import gymnasium
import numpy as np
import torch
import tyro
from crane_options import Seed

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "compare_sb3.csv"
COLUMNS = ["task", "algorithm", "library", "seed", "steps", "mean_return", "std_over_episodes"]
EPISODES, EVAL_SEED = 20, 10_000


@dataclass(frozen=True)
class Task:
    """Settings close to those of rl-baselines3-zoo (Pendulum) and CleanRL (HalfCheetah).

    The zoo's gSDE is left out, and so are CleanRL's clipped value loss and its running reward
    normalization. TRPO has the defaults of sb3-contrib, except the batch of its critic and the
    falling learning rate.
    """

    steps: int  # whole rollouts
    num_envs: int
    num_steps: int
    minibatch_size: int
    gamma: float
    learning_rate: float
    reward_scale: float
    normalize_obs: bool


TASKS = {
    "Pendulum-v1": Task(102_400, 4, 1024, 64, 0.9, 1e-3, 0.1, False),
    "HalfCheetah-v5": Task(100_352, 1, 2048, 64, 0.99, 3e-4, 0.1, True),
}
HIDDEN = (64, 64)
EPOCHS, GAE_LAMBDA, CLIP = 10, 0.95, 0.2
MAX_KL, CG_DAMPING, CG_ITERATIONS, CRITIC_LEARNING_RATE = 0.01, 0.1, 15, 1e-3  # TRPO


@dataclass
class Args:
    tasks: tuple[Literal[*TASKS], ...] = tuple(TASKS)
    """Gymnasium tasks"""
    algorithms: tuple[Literal["ppo", "mppo_beta", "trpo"], ...] = ("ppo", "mppo_beta", "trpo")
    """our scripts; SB3 has no Beta policy, and its PPO is the one to compare mppo_beta with"""
    seeds: tuple[Seed, ...] = (1, 2, 3)
    """one run each"""
    results: Path = RESULTS
    """CSV file that gets a row from each run"""

    def __post_init__(self) -> None:
        crane_options.check(vars(self), Args)


def judge(task: str, policy: Any) -> tuple[float, float]:
    """Mean and standard deviation of the return over EPISODES of a policy for `run_trials`."""
    envs = crane_trials.make_envs(task, EPISODES)
    returns = crane_trials.run_trials(policy, envs, EVAL_SEED)["episodic_return"]
    envs.close()
    return float(returns.mean()), float(returns.std())


def train_ours(task: str, algorithm: str, seed: int) -> Any:
    """Our agent after its training."""
    t = TASKS[task]
    flags = {
        "env-id": task,
        "seed": seed,
        "total-timesteps": t.steps,
        "num-envs": t.num_envs,
        "num-steps": t.num_steps,
        "minibatch-size": t.minibatch_size,
        "update-epochs": EPOCHS,
        "gamma": t.gamma,
        "gae-lambda": GAE_LAMBDA,
        "reward-scale": t.reward_scale,
        "learning-rate": CRITIC_LEARNING_RATE if algorithm == "trpo" else t.learning_rate,
        "torch-threads": 1,
        "eval-every": 0,
        "final-trials": 0,
    }
    if algorithm == "trpo":
        # sb3-contrib takes the mean of the KL divergence over the action's components, we the sum
        components = gymnasium.make(task).action_space.shape[0]
        flags |= {"max-kl": MAX_KL * components, "cg-damping": CG_DAMPING * components}
        flags |= {"cg-iterations": CG_ITERATIONS, "max-grad-norm": 1e6}
        flags["fisher-samples"] = t.num_envs * t.num_steps  # the whole rollout, as sb3-contrib
    else:
        flags |= {"clip-coef": CLIP, "target-kl": None}
    # The learning rate falls, and mPPO's perturbation too. All else stays as it is at the start.
    # Our Gaussian begins as wide as SB3's, and the Beta with alpha = beta = 2.
    flags |= {"narrowing": 0.0, "horizon-growth": 1.0}
    flags["log-excess-init" if algorithm == "mppo_beta" else "log-std-init"] = 0.0
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    words += ["--hidden-sizes", *map(str, HIDDEN)]
    words += [] if t.normalize_obs else ["--no-normalize-obs"]
    with tempfile.TemporaryDirectory() as folder:
        script = str(ROOT / f"{algorithm}_crane.py")
        command = [sys.executable, script, *words]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        (path,) = Path(folder).glob("runs/*/policy.pt")
        saved = torch.load(path, weights_only=True)
    script, env = crane_policies.ALGORITHMS[algorithm], gymnasium.make(task)
    low, high = env.action_space.low, env.action_space.high
    args = script.Args(**saved["args"])
    agent = script.Agent(env.observation_space.shape[0], low, high, args)
    # policy.pt has no critic, and acting needs none
    agent.load_state_dict({**agent.critic.state_dict(prefix="critic."), **saved["weights"]})
    return agent


class NormalizedPolicy:
    """A model of SB3 that takes raw observations."""

    def __init__(self, model: Any, envs: Any):
        self.model, self.envs = model, envs

    def predict(self, obs: np.ndarray, state: Any = None, deterministic: bool = True) -> tuple:
        return self.model.predict(self.envs.normalize_obs(obs), state, deterministic=deterministic)


def train_sb3(task: str, algorithm: str, seed: int) -> NormalizedPolicy:
    """The policy of SB3 or sb3-contrib after its training."""
    from sb3_contrib import TRPO
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    t = TASKS[task]
    envs = make_vec_env(
        task,
        t.num_envs,
        seed=seed,
        wrapper_class=gymnasium.wrappers.TransformReward,
        wrapper_kwargs={"func": lambda reward: reward * t.reward_scale},
    )
    envs = VecNormalize(envs, norm_obs=t.normalize_obs, norm_reward=False)
    start = CRITIC_LEARNING_RATE if algorithm == "trpo" else t.learning_rate
    # SB3 passes the share of the run that is left after the rollout. Our scripts use the share that
    # was left before it.
    rollout = t.num_envs * t.num_steps / t.steps
    common = dict(
        learning_rate=lambda left: (left + rollout) * start,
        n_steps=t.num_steps,
        batch_size=t.minibatch_size,
        gamma=t.gamma,
        gae_lambda=GAE_LAMBDA,
        seed=seed,
        device="cpu",
        policy_kwargs={"net_arch": list(HIDDEN)},
    )
    if algorithm == "trpo":
        own = dict(cg_max_steps=CG_ITERATIONS, cg_damping=CG_DAMPING, target_kl=MAX_KL)
        model = TRPO("MlpPolicy", envs, n_critic_updates=EPOCHS, **own, **common)
    else:
        model = PPO("MlpPolicy", envs, n_epochs=EPOCHS, clip_range=CLIP, **common)
    model.learn(t.steps)
    return NormalizedPolicy(model, envs)


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def main() -> None:
    crane_runs.one_line_errors()
    args = tyro.cli(Args, description=__doc__)
    if not args.results.parent.is_dir():
        raise SystemExit(f"--results: no folder {args.results.parent}; make it first")
    torch.set_num_threads(1)
    try:
        with open(args.results, "x", newline="") as file:
            csv.writer(file).writerow(COLUMNS)
    except FileExistsError:
        pass
    run_columns = ("task", "algorithm", "library", "seed", "steps")
    done = {tuple(row[name] for name in run_columns) for row in read(args.results)}
    for task, seed, algorithm in product(args.tasks, args.seeds, args.algorithms):
        for library, train in (("ours", train_ours), ("sb3", train_sb3)):
            run = (task, algorithm, library, str(seed), str(TASKS[task].steps))
            if run in done or (library == "sb3" and algorithm == "mppo_beta"):
                continue
            mean, std = judge(task, train(task, algorithm, seed))
            row = [*run, round(mean, 1), round(std, 1)]
            with open(args.results, "a", newline="") as file:
                csv.writer(file).writerow(row)  # one write: rows of two processes do not mix
            print(*row, flush=True)

    results = defaultdict(list)
    for row in read(args.results):
        cell = row["task"], row["algorithm"], row["library"]
        results[cell].append(float(row["mean_return"]))
    for cell, returns in sorted(results.items()):
        spread = np.std(returns, ddof=1) if len(returns) > 1 else np.nan
        print(*cell, f"{np.mean(returns):.0f} +- {spread:.0f} over {len(returns)} seeds")


if __name__ == "__main__":
    main()
