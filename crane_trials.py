"""Cranes to train a policy and to judge it on, and the trials that judge it.

docs/compare.md has the protocol of the trials: log diameters 0.3 ... 0.8 m, seeds that belong to
the trial alone, success as `CraneVectorEnv` says.
"""

import importlib
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from numpy import ndarray as Array
from numpy.random import SeedSequence

from crane_env import CARE, CraneVectorEnv
from crane_options import OptionError
from crane_task import CONDITIONS, DIAMETERS, TERMINATIONS, TERMS

REPORT_SEED = 60_000  # of the trials behind every reported score
RESULTS = {"episodic_return", "success", "termination", "time_to_reach", "centre_miss"}
RESULTS |= {*CONDITIONS, *CARE}


def is_crane(env_id: str) -> bool:
    """Whether the task is this crane or a subclass of it: `CraneVectorEnv` steps it.

    gymnasium.error.Error if there is no such task, ModuleNotFoundError if no such module.
    """
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    creator = gymnasium.spec(name).vector_entry_point
    creator = load_env_creator(creator) if isinstance(creator, str) else creator
    return isinstance(creator, type) and issubclass(creator, CraneVectorEnv)


def make_envs(
    env_id: str, num_envs: int, env_threads: int = 0, **options: Any
) -> gymnasium.vector.VectorEnv:
    """N environments of any Gymnasium task, with SAME_STEP autoreset and `info["episode"]`.

    env_threads and options are the crane's. Other tasks ignore env_threads, and retry, which the
    training scripts set. They refuse other options.
    """
    if is_crane(env_id):
        envs = gymnasium.make_vec(env_id, num_envs, env_threads=env_threads, **options)
    elif unknown := options.keys() - {"retry"}:
        raise OptionError(f"{env_id} is not the crane and has no option {', '.join(unknown)}")
    else:
        autoreset = {"autoreset_mode": AutoresetMode.SAME_STEP}
        envs = gymnasium.make_vec(env_id, num_envs, "sync", vector_kwargs=autoreset)
    for space in (envs.single_observation_space, envs.single_action_space):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise OptionError("its observations or actions are no flat Box")
    return RecordEpisodeStatistics(envs)


def rollout_report(envs: gymnasium.vector.VectorEnv, infos: list[dict]) -> dict[str, float]:
    """What TensorBoard shows of a rollout of `make_envs`, from the `info` of each of its steps."""
    report, crane = {}, envs.unwrapped
    ends = [(info, i) for info in infos if "episode" in info for i in info["_episode"].nonzero()[0]]
    if ends:
        report["charts/episodic_return"] = np.mean([info["episode"]["r"][i] for info, i in ends])
        report["charts/episodic_length"] = np.mean([info["episode"]["l"][i] for info, i in ends])
    if isinstance(crane, CraneVectorEnv):
        if recent := [success for outcomes in crane.recent_success for success in outcomes]:
            report["charts/success_rate"] = np.mean(recent)
        report["schedule/difficulty"] = crane.difficulty
        for term in TERMS:
            name = f"reward/{term.removeprefix('r_')}"
            report[name] = np.mean([info[term] for info in infos])
        if ends:
            report["charts/gentle_rate"] = np.mean([info["gentle"][i] for info, i in ends])
            endings = [info["termination"][i] for info, i in ends]
            for name in TERMINATIONS:
                report[f"termination/{name}"] = endings.count(name) / len(ends)
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
    policy: Any, envs: gymnasium.vector.VectorEnv, seeds: Any, deterministic: bool = True
) -> dict[str, Array]:
    """One whole episode in each environment of `make_envs`: RESULTS, (N,) each.

    policy.predict(obs (N, obs_dim), state, deterministic=...) returns actions (N, act_dim) and the
    next state. The first state is None. Stable-Baselines3's models have this method too.
    """
    names = RESULTS if isinstance(envs.unwrapped, CraneVectorEnv) else {"episodic_return"}
    obs, _ = envs.reset(seed=seeds)
    results, state, ended = {}, None, np.zeros(envs.num_envs, bool)
    while not ended.all():
        actions, state = policy.predict(obs, state, deterministic=deterministic)
        obs, _, terminated, truncated, info = envs.step(actions)
        first = (terminated | truncated) & ~ended  # later ends belong to other episodes
        if first.any():
            info["episodic_return"] = info["episode"]["r"]
            for name in names:
                results[name] = np.where(first, info[name], results.get(name, info[name]))
        ended |= first
    return results


def evaluate(
    policy: Any, env_id: str, trials: int, seed: int, env_threads: int = 0, **options: Any
) -> dict[str, float]:
    """Mean return and success rates in trials per diameter (other tasks: trials in all).

    These are trials of the full task: `evaluate` sets diameter, difficulty and retry, whatever the
    options say. Rates are shares in [0, 1].
    """
    crane = is_crane(env_id)
    if crane:
        diameters, seeds = monte_carlo_trials(seed, trials)
        options |= {"diameter": diameters, "retry": 0.0, "difficulty": 1.0}
        envs = make_envs(env_id, len(seeds), env_threads, **options)
    else:
        envs, seeds = make_envs(env_id, trials, **options), seed
    results = run_trials(policy, envs, seeds)
    envs.close()
    scores = {"episodic_return": results["episodic_return"].mean().item()}
    if crane:
        scores["success_rate"] = results["success"].mean().item()
        scores["gentle_rate"] = results["gentle"].mean().item()
        for d in DIAMETERS:
            scores[f"success_rate_{d}m"] = results["success"][diameters == d].mean().item()
    return scores
