"""Small tasks that show one thing each. Their ids are registered below."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from crane_env import CraneEnv, CraneVectorEnv


class Toy(gymnasium.Env):
    """Episodes of 2 to 6 steps under a time limit of 4: some end, some are cut, some are both."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float32)
    action_space = Box(np.float32([-2, 0]), np.float32([1, 3]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.steps = self.np_random.uniform([-1, 2, -5], [1, 4, 5]), 0
        self.life = self.np_random.integers(2, 7)
        return self.state.astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        x, y, z = self.state
        a, b = action
        self.state = np.array([0.7 * x + 0.3 * a, 0.8 * y + 0.2 * b, 0.9 * z + x * a])
        reward = 2.0 + x - 0.3 * (a - 0.5) ** 2 - 0.1 * (b - y) ** 2
        return self.state.astype(np.float32), reward, self.steps == self.life, False, {}


class Recall(gymnasium.Env):
    """Name the cue of the first step at the end: this takes a memory if there are more steps.

    Observation: cue (-1 or 1, 0 after the first step) and whether the answer is due. The last step
    pays -(action - cue)^2: 0 for who remembers, -1 at best for who does not.
    """

    observation_space = Box(-1, 1, (2,), np.float32)
    action_space = Box(-2, 2, (1,), np.float32)

    def __init__(self, length=5):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cue, self.steps = float(self.np_random.choice([-1, 1])), 0
        return np.array([self.cue, self.length == 1], np.float32), {}

    def step(self, action):
        self.steps += 1
        last = self.steps == self.length
        reward = -((float(action[0]) - self.cue) ** 2) if last else 0.0
        return np.array([0, self.steps == self.length - 1], np.float32), reward, last, False, {}


class Odd(gymnasium.Env):
    """Step `at` (0: the start) gives an observation or a reward that is not finite. No end."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, at=-1, obs=0.0, reward=1.0, bound=1.0):
        self.at, self.odd = at, (obs, reward)
        self.action_space = Box(-bound, bound, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.array([self.odd[0] if self.at == 0 else 0.0, 0.0], np.float32), {}

    def step(self, action):
        self.steps += 1
        obs, reward = self.odd if self.steps == self.at else (0.0, 1.0)
        return np.array([obs, 0.1 * self.steps], np.float32), reward, False, False, {}


class Quick(CraneVectorEnv):
    """Trials of half a second. They succeed with logs above 0.55 m, and the others fail as `thin`.

    Those with logs below 0.35 m end after 2 steps. Those with logs above 0.65 m are not gentle.
    """

    TIME_LIMIT, HOLD_TIME, REVISION = 0.5, 0.1, 3

    def rules(self, state, info):
        return {"thinnest": (state.diameter < 0.35) & (self.steps == 2)}

    def measure(self, state):
        self.ground_peak[state.diameter > 0.65] = 30e3
        return super().measure(state)

    def conditions(self, state, info):
        return {"thin": info["diameter"] > 0.55}


def bonus_crane():
    """A crane with a changed reward, as one might write it for another task."""
    return gymnasium.wrappers.TransformReward(CraneEnv(), lambda reward: reward + 1)


gymnasium.register("Toy-v0", Toy, max_episode_steps=4)
gymnasium.register("Recall-v0", Recall)
gymnasium.register("Echo-v0", Recall, kwargs={"length": 1})
gymnasium.register("Endless-v0", Odd, max_episode_steps=5)
gymnasium.register("NoEnd-v0", Odd)
gymnasium.register("Unbounded-v0", Odd, max_episode_steps=5, kwargs={"bound": np.inf})
gymnasium.register("NanReward-v0", Odd, max_episode_steps=5, kwargs={"at": 3, "reward": np.nan})
gymnasium.register("InfStart-v0", Odd, max_episode_steps=5, kwargs={"at": 0, "obs": np.inf})
gymnasium.register("InfObs-v0", Odd, max_episode_steps=5, kwargs={"at": 3, "obs": np.inf})
gymnasium.register("InfEnd-v0", Odd, max_episode_steps=3, kwargs={"at": 3, "obs": np.inf})
gymnasium.register("Quick-v0", vector_entry_point=Quick)
gymnasium.register("BonusCrane-v0", bonus_crane)
