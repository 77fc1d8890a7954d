"""The cranes as a vectorized environment of Stable-Baselines3 (SB3), for its algorithms.

from crane_utils import trials
from crane_utils.sb3 import CraneVecEnv
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecMonitor

model = SAC("MlpPolicy", VecMonitor(CraneVecEnv(16)), verbose=1)
model.learn(100_000)
print(trials.evaluate(model, "ForestryCrane-v0", trials=100))

In so few steps of the full task it lifts no log: docs/compare.md begins with easy starts.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

import crane_env  # noqa: F401  registers the tasks


class CraneVecEnv(VecEnv):
    """N cranes of a registered task; env_threads and options are those of `CraneVectorEnv`.

    `infos[i]` is empty until crane i ends an episode. Then it holds all that the crane's `info`
    holds, with SB3's `is_success`, `terminal_observation` and `TimeLimit.truncated`.
    """

    def __init__(self, num_envs: int, env_id: str = "ForestryCrane-v0", **options: Any):
        self.envs = envs = gymnasium.make_vec(env_id, num_envs, **options).unwrapped
        super().__init__(num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        # SB3 gives crane i the seed s + i, so the cranes of seeds 1 and 2 would share most starts.
        # From the first seed alone each crane draws random numbers of its own.
        obs, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        obs, reward, terminated, truncated, info = self.envs.step(self.actions)
        done, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            end = info["final_info"].items()
            infos[i] = {key: values[i] for key, values in end if not key.startswith("_")}
            infos[i]["terminal_observation"] = info["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return obs, reward.astype(np.float32), done, infos

    def get_images(self) -> Sequence[np.ndarray]:
        return self.envs.render()

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.envs, attr_name, value)  # all cranes share it

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> None:
        raise NotImplementedError(f"the cranes are one object: call envs.{method_name} instead")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
