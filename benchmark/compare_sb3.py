"""Our scripts beside Stable-Baselines3 and sb3-contrib on two well-known tasks.

The same steps, networks, batch, epochs, step size, gamma, lambda and bounds on both sides,
observations normalised on both or on neither, rewards by the same constant; final policies judged
by the mean action in 20 episodes of the same seeds. Appends to benchmark/compare_sb3.csv and skips
the rows it finds there: remove those of other settings first. Prints mean and standard deviation
over the seeds.

    pip install -r benchmark/requirements.txt
    python benchmark/compare_sb3.py --help
"""

import csv
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np
import torch
import tyro

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).parent / "compare_sb3.csv"
COLUMNS = ["task", "algorithm", "library", "seed", "steps", "mean_return", "std_over_episodes"]
EPISODES, EVAL_SEED = 20, 10_000


@dataclass(frozen=True)
class Task:
    """Close to rl-baselines3-zoo (Pendulum, without gSDE) and CleanRL (HalfCheetah).

    Without CleanRL's annealing, value clipping and running reward normalisation; TRPO by
    sb3-contrib's defaults but for the batch of its critic.
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
    """ours; SB3 has no Beta policy: its PPO stands there"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """one run each"""


def judge(task: str, act) -> tuple[float, float]:
    """Mean and standard deviation of the return over EPISODES; act maps obs (n,) to an action."""
    env, returns = gymnasium.make(task), []
    for k in range(EPISODES):
        obs, _ = env.reset(seed=EVAL_SEED + k)
        total, done = 0.0, False
        while not done:
            obs, reward, terminated, truncated, _ = env.step(act(obs))
            total, done = total + reward, terminated or truncated
        returns.append(total)
    return float(np.mean(returns)), float(np.std(returns))


def train_ours(task: str, algorithm: str, seed: int):
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
        # sb3-contrib averages the KL divergence over the action's components, ours sums it
        components = gymnasium.make(task).action_space.shape[0]
        flags |= {"max-kl": MAX_KL * components, "cg-damping": CG_DAMPING * components}
        flags |= {"cg-iterations": CG_ITERATIONS, "max-grad-norm": "inf"}
        flags["fisher-samples"] = t.num_envs * t.num_steps  # all, as there
    else:
        flags |= {"clip-coef": CLIP, "target-kl": None}
    # no schedules but mPPO's fading perturbation; Gaussians as wide at the start as SB3's, the Beta
    # begins at alpha = beta = 2
    flags |= {"narrowing": 0.0, "horizon-growth": 1.0}
    flags["log-excess-init" if algorithm == "mppo_beta" else "log-std-init"] = 0.0
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    words += ["--no-anneal-lr", "--hidden-sizes", *map(str, HIDDEN)]
    words += [] if t.normalize_obs else ["--no-normalize-obs"]
    with tempfile.TemporaryDirectory() as folder:
        script = str(ROOT / f"{algorithm}_crane.py")
        command = [sys.executable, script, *words]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        (path,) = Path(folder).glob("runs/*/policy.pt")
        sys.path.insert(0, str(ROOT))
        import eval_crane

        saved = torch.load(path, weights_only=True)
        module = eval_crane.ALGORITHMS[algorithm]
        env = gymnasium.make(task)
        low, high = env.action_space.low, env.action_space.high
        agent = module.Agent(
            env.observation_space.shape[0], low, high, module.Args(**saved["args"])
        )
        # policy.pt has no critic, and acting needs none
        agent.load_state_dict({**agent.critic.state_dict(prefix="critic."), **saved["weights"]})

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        return agent.predict(torch.as_tensor(obs, dtype=torch.float32)[None])[0].numpy()

    return act


def train_sb3(task: str, algorithm: str, seed: int):
    from sb3_contrib import TRPO
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    t = TASKS[task]
    torch.set_num_threads(1)
    envs = make_vec_env(
        task,
        t.num_envs,
        seed=seed,
        wrapper_class=gymnasium.wrappers.TransformReward,
        wrapper_kwargs={"func": lambda reward: reward * t.reward_scale},
    )
    envs = VecNormalize(envs, norm_obs=t.normalize_obs, norm_reward=False)
    common = dict(
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
        own |= dict(learning_rate=CRITIC_LEARNING_RATE, n_critic_updates=EPOCHS)
        model = TRPO("MlpPolicy", envs, **own, **common)
    else:
        own = dict(n_epochs=EPOCHS, clip_range=CLIP)
        model = PPO("MlpPolicy", envs, learning_rate=t.learning_rate, **own, **common)
    model.learn(t.steps)

    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(obs), deterministic=True)[0]

    return act


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    rows = list(csv.DictReader(open(RESULTS))) if RESULTS.exists() else []
    done = {
        (r["task"], r["algorithm"], r["library"], int(r["seed"]), int(r["steps"])) for r in rows
    }
    for task in args.tasks:
        for seed in args.seeds:
            for algorithm in args.algorithms:
                for library, train in (("ours", train_ours), ("sb3", train_sb3)):
                    if library == "sb3" and algorithm == "mppo_beta":
                        continue
                    if (task, algorithm, library, seed, TASKS[task].steps) in done:
                        continue
                    mean, std = judge(task, train(task, algorithm, seed))
                    row = [task, algorithm, library, seed, TASKS[task].steps]
                    row += [round(mean, 1), round(std, 1)]
                    new = not RESULTS.exists()
                    with open(RESULTS, "a", newline="") as file:
                        writer = csv.writer(file)
                        writer.writerows([COLUMNS, row] if new else [row])
                    print(*row, flush=True)

    results = defaultdict(list)
    for row in csv.DictReader(open(RESULTS)):
        cell = row["task"], row["algorithm"], row["library"]
        results[cell].append(float(row["mean_return"]))
    for cell, returns in sorted(results.items()):
        spread = np.std(returns, ddof=1) if len(returns) > 1 else np.nan
        print(*cell, f"{np.mean(returns):.0f} +- {spread:.0f} over {len(returns)} seeds")
