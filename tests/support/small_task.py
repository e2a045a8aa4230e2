"""A task small enough to train whole agents on in a test."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_said import DelayedObservationWrapper


class Drift(gym.Env):
    """The state moves with the action; +1 a step for ``length`` steps, then the episode ends or is cut off."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, length=12, truncates=True):
        self.length, self.truncates = length, truncates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.state = 0, self.np_random.normal(size=2).astype(np.float32)
        return self.state.copy(), {}

    def step(self, action):
        self.t += 1
        self.state = (0.9 * self.state + 0.1 * np.array([action[0], self.state[0]])).astype(np.float32)
        end = self.t >= self.length
        return self.state.copy(), 1.0, end and not self.truncates, end and self.truncates, {}


def delayed(delay=2, max_delay=None, **kwargs):
    """Return the task under a delay; ``kwargs`` are those of ``Drift``."""
    return DelayedObservationWrapper(Drift(**kwargs), delay, max_delay=max_delay)


def pendulum(n_steps=15, delay=2, max_delay=None):
    """Return a task that pays each action differently, for as many steps."""
    return DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=n_steps), delay, max_delay=max_delay)


class OwnDelay:
    """A user's own process, which a worker cannot be sent: its class is not where pickle looks for it."""

    __module__ = "nowhere"
    max_delay = 2

    def sample(self, rng):
        return int(rng.integers(3))


class LateDelay(OwnDelay):
    min_delay = 1


class Simulator(Drift):
    """A plain task whose ``process`` is no delay."""

    process = "a program"


class LateSimulator(gym.Env):
    """A task that hands out old observations by itself, under the wrapper's keys."""

    def __init__(self, delay=2):
        self._own = delayed(delay)
        self.observation_space, self.action_space = self._own.observation_space, self._own.action_space

    def reset(self, *, seed=None, options=None):
        return self._own.reset(seed=seed)

    def step(self, action):
        return self._own.step(action)


class TellingSimulator(LateSimulator):
    """The same, and it tells the ages."""

    age_range = (2, 2)
