"""Environments to train on, and the trials that evaluate a policy.

docs/compare.md has the protocol: log diameters 0.3 ... 0.8 m, seeds that belong to the trial alone,
success as the task says.
"""

import importlib
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from numpy import ndarray as Array
from numpy.random import SeedSequence

from crane_env import CraneEnv, CraneVectorEnv

DIAMETERS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # m, of the paper's tables
MAX_STEPS = 10_000  # of an evaluation; a task may have no end
EVAL_SEED = 10_000  # of trials while settings are chosen
REPORT_SEED = 60_000  # of the trials behind the scores of levels and leaderboard


def crane_class(env_id: str) -> type[CraneVectorEnv] | None:
    """The task's subclass of `CraneVectorEnv`, None if it is another task."""
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        creator = gymnasium.spec(name).vector_entry_point
    except (ModuleNotFoundError, gymnasium.error.Error) as error:
        if getattr(error, "name", module) != module:  # the user's module lacks another one
            raise
        raise SystemExit(f"--env-id {env_id}: {error}") from None
    creator = load_env_creator(creator) if isinstance(creator, str) else creator
    is_crane = isinstance(creator, type) and issubclass(creator, CraneVectorEnv)
    return creator if is_crane else None


def task_options(env_id: str) -> Any:
    """The registered task's `Options`, None if it is not the crane."""
    if (cranes := crane_class(env_id)) is None:
        return None
    registered = gymnasium.spec(env_id.rpartition(":")[2]).kwargs
    names = {field.name for field in fields(cranes.Options)}
    return cranes.Options(**{name: registered[name] for name in names & registered.keys()})


def make_envs(
    env_id: str, num_envs: int, threads: int = 0, options: dict | None = None, **crane_only: Any
) -> gymnasium.vector.VectorEnv:
    """N environments of any Gymnasium task, with SAME_STEP autoreset and `info["episode"]`.

    threads (0 for all cores), options and crane_only are the crane's. Other tasks ignore them.
    """
    if crane_class(env_id):
        options = {**(options or {}), **crane_only}
        envs = gymnasium.make_vec(env_id, num_envs, env_threads=threads, **options)
    else:
        autoreset = {"autoreset_mode": AutoresetMode.SAME_STEP}
        envs = gymnasium.make_vec(env_id, num_envs, "sync", vector_kwargs=autoreset)
        if isinstance(envs.envs[0].unwrapped, CraneEnv):
            raise SystemExit(
                f"{env_id} wraps a crane, which hides its curriculum and its success. Override a "
                "hook of CraneVectorEnv instead and register that class as vector_entry_point "
                "(docs/tutorial.md)."
            )
    for space in (envs.single_observation_space, envs.single_action_space):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise SystemExit(f"{env_id}: observations and actions must be flat Boxes, not {space}")
    if envs.single_action_space.dtype.kind != "f":
        raise SystemExit(f"{env_id}: actions must be floats, not {envs.single_action_space}")
    return RecordEpisodeStatistics(CheckFinite(envs))


class CheckFinite(gymnasium.vector.VectorWrapper):
    """SystemExit names an observation or a reward of the task that is not finite."""

    def check(self, name: str, values: Array) -> None:
        for env, *_ in np.argwhere(~np.isfinite(values)):
            raise SystemExit(f"the {name} of environment {env} is not finite: {values[env]}")

    def reset(self, **kwargs: Any) -> tuple:
        obs, info = super().reset(**kwargs)
        self.check("observation", obs)
        return obs, info

    def step(self, actions: Array) -> tuple:
        obs, reward, *rest, info = super().step(actions)
        self.check("observation", obs)
        self.check("reward", reward)
        if "final_obs" in info:
            ends = [row if end is None else end for row, end in zip(obs, info["final_obs"])]
            self.check("last observation", np.stack(ends))
        return obs, reward, *rest, info


def rollout_report(envs: gymnasium.vector.VectorEnv, infos: list[dict]) -> dict[str, float]:
    """What TensorBoard shows of a rollout of `make_envs`, from the `info` of each of its steps.

    The success rate is of each crane's last ten episodes, all else of the rollout.
    """
    report, crane = {}, envs.unwrapped
    ends = [(info, i) for info in infos if "episode" in info for i in info["_episode"].nonzero()[0]]
    if ends:
        report["charts/episodic_return"] = np.mean([info["episode"]["r"][i] for info, i in ends])
        report["charts/episodic_length"] = np.mean([info["episode"]["l"][i] for info, i in ends])
    if isinstance(crane, CraneVectorEnv):
        if recent := [success for outcomes in crane.recent_success for success in outcomes]:
            report["charts/success_rate"] = np.mean(recent)
        for term in (name for name in infos[0] if name.startswith("r_")):
            report[f"reward/{term.removeprefix('r_')}"] = np.mean([info[term] for info in infos])
        if ends:
            report["charts/gentle_rate"] = np.mean([info["gentle"][i] for info, i in ends])
            endings = Counter(str(info["termination"][i]) for info, i in ends)
            report |= {f"termination/{name}": n / len(ends) for name, n in endings.items()}
    return report


def monte_carlo_trials(
    seed: int, trials: int, diameters: Sequence[float] = DIAMETERS
) -> tuple[Array, list[SeedSequence]]:
    """Diameters (m) and seeds of trials per diameter, for `CraneVectorEnv` and its `reset`.

    Trial k at a diameter is the same whatever the number of trials and the other diameters.
    """
    keys = [(round(1000 * d), k) for d in diameters for k in range(trials)]
    return np.repeat(diameters, trials), [SeedSequence(seed, spawn_key=key) for key in keys]


def run_trials(
    policy: Any, envs: gymnasium.vector.VectorEnv, seeds: Any,
    deterministic: bool = True, metrics: Any = None,
) -> dict[str, Array]:  # fmt: skip
    """One whole episode in each environment of `make_envs`: results at its end, (N,) each.

    policy.predict(obs (N, obs_dim), state, deterministic=...) returns actions (N, act_dim) and the
    next state. The first state is None. Stable-Baselines3's models have this method too. metrics: a
    `crane_utils.metrics.Metrics` of these cranes, whose values join the results.
    """
    obs, _ = envs.reset(seed=seeds)
    results, state, ended = {}, None, np.zeros(envs.num_envs, bool)
    for step in range(MAX_STEPS):
        actions, state = policy.predict(obs, state, deterministic=deterministic)
        obs, reward, terminated, truncated, info = envs.step(actions)
        values = {} if metrics is None else metrics.after_step(info)
        done = terminated | truncated
        first = done & ~ended  # later ends belong to other episodes
        if step == MAX_STEPS - 1 and (endless := ~done & ~ended).any():
            print(f"{endless.sum()} episodes have no end in {step + 1:,} steps", file=sys.stderr)
            first = ~ended
        if first.any():
            numbers = {k: v for k, v in info.items() if isinstance(v, Array) and v.ndim == 1}
            values |= {k: v for k, v in numbers.items() if k[0] != "_" and v.dtype != object}
            finished = info["episode"]["r"] if done.any() else 0.0
            values["episodic_return"] = np.where(done, finished, envs.episode_returns)
            for name, value in values.items():
                results[name] = np.where(first, value, results.get(name, value))
        ended |= first
        if ended.all():
            break
    return results


def evaluate(
    policy: Any, env_id: str, trials: int, seed: int = EVAL_SEED,
    threads: int = 0, options: dict | None = None,
) -> dict[str, float]:  # fmt: skip
    """Mean return and success rates in trials per diameter (other tasks: trials in all).

    Cranes are evaluated on the full task, without curriculum. Rates are shares in [0, 1].
    """
    if not crane_class(env_id):
        envs = make_envs(env_id, trials)
        results = run_trials(policy, envs, seed)
        envs.close()
        return {"episodic_return": results["episodic_return"].mean().item()}
    diameters, seeds = monte_carlo_trials(seed, trials)
    envs = make_envs(env_id, len(seeds), threads, options, diameter=diameters)
    results = run_trials(policy, envs, seeds)
    envs.close()
    scores = {"episodic_return": results["episodic_return"].mean().item()}
    scores["success_rate"] = results["success"].mean().item()
    scores["gentle_rate"] = results["gentle"].mean().item()
    for d in DIAMETERS:
        scores[f"success_rate_{d}m"] = results["success"][diameters == d].mean().item()
    return scores
