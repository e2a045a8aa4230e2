"""A task that keeps what was really done, to compare with what the delayed world shows of it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 8.0], np.float32)


class LoggedTask(gym.Env):
    """Random states and lop-sided action bounds; logs what it was really in and given, an episode a list."""

    def __init__(self, length=12, low=LOW, high=HIGH, dtype=np.float64):
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), dtype)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self.length = length
        self.states, self.actions = [], []
        self.buffer = np.zeros(3, dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.states.append([])
        self.actions.append([])
        return self._state(), {"options": options}

    def step(self, action):
        self.actions[-1].append(np.array(action))
        ended = len(self.actions[-1]) == self.length
        return self._state(), float(action[0]), ended, False, {"t": len(self.actions[-1])}

    def _state(self):
        self.buffer[:] = self.np_random.normal(size=3)  # in place, as some simulators do
        self.states[-1].append(self.buffer.astype(np.float32))  # a copy
        return self.buffer


def delay_of_episode(receiver):
    """Of a process that draws one delay for all packets of an episode."""
    return next(receiver._delays)
