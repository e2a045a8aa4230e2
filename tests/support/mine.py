"""A package of a user's own: importing it registers Mine-v0, which can give one NaN in the life of a process."""

import gymnasium as gym
import numpy as np
from small_task import Drift


class Mine(Drift):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    steps = 0  # of all instances

    def __init__(self, length=12, nan_at=None, nan_in="reward", render_mode=None):
        super().__init__(length)
        self.nan_at, self.nan_in, self.render_mode = nan_at, nan_in, render_mode

    def render(self):
        return np.full((16, 16, 3), 10 * self.t, np.uint8)

    def step(self, action):
        Mine.steps += 1
        state, reward, *rest = super().step(action)
        if Mine.steps == self.nan_at:
            reward, state = (np.nan, state) if self.nan_in == "reward" else (reward, state * np.nan)
        return state, reward, *rest


gym.register("Mine-v0", Mine, max_episode_steps=12)
