"""A task whose every state can be told apart, played as SB3's collection loop plays it, with whole transitions kept."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said.delays import DelayedObservationWrapper, DelayProcess

OBS_DIM, ACT_DIM = 3, 2


class CountingTask(gym.Env[np.ndarray, np.ndarray]):
    """The first state component is a counter that no two states of the tasks sharing it have in common.

    Episodes have random lengths up to ``max_length`` and end by termination or by time limit.
    """

    def __init__(self, counter: itertools.count[int], max_length: int):
        self.observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
        self.action_space = spaces.Box(np.array([-2, 0], np.float32), np.array([2, 8], np.float32))
        self.counter, self.max_length = counter, max_length
        self.state = np.zeros(OBS_DIM, np.float32)
        self.before_and_after = self.state, self.state  # of the newest step

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, self.max_length + 1))
        self.state = self._new_state()
        return self.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.before_and_after = self.state, self._new_state()
        self.state = self.before_and_after[1]
        self.left -= 1
        terminated = bool(self.np_random.random() < 0.5)
        return self.state, self.np_random.normal(), self.left == 0 and terminated, self.left == 0 and not terminated, {}

    def _new_state(self) -> np.ndarray:
        return np.array([next(self.counter), *self.np_random.normal(size=OBS_DIM - 1)], np.float32)


@dataclass
class Row:
    """One step of every environment: what ``add`` is given, the true states from the tasks, and if a reset followed."""

    obs: Any
    next_obs: Any
    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    infos: list[dict[str, Any]]
    states: np.ndarray
    next_states: np.ndarray
    interrupted: bool = False

    def added(self) -> tuple[Any, ...]:
        return self.obs, self.next_obs, self.action, self.reward, self.done, self.infos

    @property
    def terminated(self) -> np.ndarray:
        return self.done & ~np.array([info["TimeLimit.truncated"] for info in self.infos])


@dataclass
class Player:
    """Plays random actions in parallel tasks.

    :param delay: of the wrapper, or None for the tasks as they are
    :param action_delay: of the wrapper
    :param receiver: of the wrapper
    :param interruption: probability of a reset after a step, as when a run is resumed
    """

    n_envs: int = 2
    delay: int | tuple[int, int] | DelayProcess | None = 2
    max_delay: int | None = None
    action_delay: int | DelayProcess = 0
    receiver: str = "newest"
    max_length: int = 9
    interruption: float = 0.0
    seed: int = 0
    vec: DummyVecEnv = field(init=False)

    def __post_init__(self) -> None:
        counter = itertools.count(1)

        def make() -> gym.Env:
            task = CountingTask(counter, self.max_length)
            if self.delay is None:
                return task
            return DelayedObservationWrapper(
                task, self.delay, self.action_delay, max_delay=self.max_delay, receiver=self.receiver
            )

        self.vec = DummyVecEnv([make] * self.n_envs)
        self.vec.seed(self.seed)
        self.rng = np.random.default_rng(self.seed)
        self.obs: Any = self.vec.reset()

    def play(self, n_steps: int) -> list[Row]:
        return [self._step() for _ in range(n_steps)]

    def _step(self) -> Row:
        obs = self.obs
        action = self.rng.uniform(-1, 1, (self.n_envs, ACT_DIM)).astype(np.float32)
        low, high = self.vec.action_space.low, self.vec.action_space.high
        self.obs, reward, done, infos = self.vec.step(low + 0.5 * (action + 1.0) * (high - low))
        next_obs = _copy(self.obs)
        for i in np.flatnonzero(done):  # as in OffPolicyAlgorithm._store_transition
            last = infos[i]["terminal_observation"]
            if isinstance(next_obs, dict):
                for key in next_obs:
                    next_obs[key][i] = last[key]
            else:
                next_obs[i] = last
        states = [task.unwrapped.before_and_after for task in self.vec.envs]
        before, after = (np.stack(x) for x in zip(*states, strict=True))
        row = Row(_copy(obs), next_obs, action, reward, done, infos, before, after)
        if self.rng.random() < self.interruption:
            self.obs, row.interrupted = self.vec.reset(), True
        return row


def _copy(obs: Any) -> Any:
    return {key: x.copy() for key, x in obs.items()} if isinstance(obs, dict) else obs.copy()
