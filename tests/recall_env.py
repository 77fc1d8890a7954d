"""Small tasks that show one thing each.

`Recall-v0` asks for a memory: name the cue of the first step four steps later. `Echo-v0` is its
first step alone, which needs no memory. `Endless-v0` pays 1 for ever, under a time limit of 5
steps; `Unbounded-v0` is the same without bounds on the action. `Stuck-v0` never finishes a step.
"""

import time
from pathlib import Path

import gymnasium
import numpy as np


class Recall(gymnasium.Env):
    """Observation: cue (-1 or 1, 0 after the first step) and whether the answer is due.

    The last step pays -(action - cue)^2: 0 for who remembers, -1 at best for who does not.
    """

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, length: int = 5):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cue, self.time = float(self.np_random.choice([-1, 1])), 0
        return np.array([self.cue, 0], np.float32), {}

    def step(self, action):
        self.time += 1
        last = self.time == self.length
        reward = -((float(action[0]) - self.cue) ** 2) if last else 0.0
        return np.array([0, self.time == self.length - 1], np.float32), reward, last, False, {}


class Endless(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, bound: float = 1.0):
        self.action_space = gymnasium.spaces.Box(-bound, bound, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 1.0, False, False, {}


class Stuck(Endless):
    """Leaves a file `stuck` in the working folder and sleeps a minute."""

    def step(self, action):
        Path("stuck").touch()
        time.sleep(60)
        return super().step(action)


gymnasium.register("Recall-v0", entry_point=Recall)
gymnasium.register("Echo-v0", entry_point=Recall, kwargs={"length": 1})
gymnasium.register("Endless-v0", entry_point=Endless, max_episode_steps=5)
gymnasium.register("Unbounded-v0", entry_point=Endless, kwargs={"bound": np.inf})
gymnasium.register("Stuck-v0", entry_point=Stuck)
