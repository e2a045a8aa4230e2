"""A robot in another process: a MuJoCo task that keeps its own time, and a model that can be loaded there."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np

PERIOD = 0.02


def make_task() -> gym.Env[Any, Any]:
    return gym.make("InvertedPendulum-v5", frame_skip=1)  # of 20 ms


def live(pipe: Any, latency: float) -> None:
    """Execute the newest action every 20 ms, and send observations that arrive late.

    Sends (state, number of the action executed last, stamp); at the end what was executed, by number.

    :param pipe: brings (number, action), and None at the end
    :param latency: seconds that an observation takes, plus up to as much again
    """
    task, rng = make_task(), np.random.default_rng(0)
    state, (number, action) = task.reset(seed=0)[0], (0, np.zeros(1, np.float32))
    on_the_way: deque[tuple[float, Any]] = deque()
    executed, due = [], time.monotonic()
    pipe.send("ready")
    pipe.recv()
    while True:
        now = time.monotonic()
        on_the_way.append((now + latency * (1 + rng.random()), (state, number, now)))
        while on_the_way and on_the_way[0][0] <= now:
            pipe.send(on_the_way.popleft()[1])
        while pipe.poll():
            if (arrived := pipe.recv()) is None:
                pipe.send(executed)
                return
            number, action = arrived
        executed.append(number)
        state = task.step(action)[0]
        due += PERIOD
        time.sleep(max(due - time.monotonic(), 0))


class Sum:
    """Answers with the sum of the observation, plus what it was made with."""

    def __init__(self, offset: float):
        task = make_task()
        self.observation_space, self.action_space, self.offset = task.observation_space, task.action_space, offset

    def predict(self, observation: np.ndarray, deterministic: bool = False) -> tuple[np.ndarray, None]:
        if observation[0, 0] == 9:
            raise ValueError("nine is too much")
        if observation[0, 0] == 99:
            raise SystemExit(3)
        return np.float32(observation.sum(1, keepdims=True) + self.offset), None


class Normalized(Sum):
    """Says that its observations are normalised."""

    reads_normalized = True


class Cold(Sum):
    """Takes a second for its first answer, as one does that compiles or reads from a disk."""

    is_warm = False

    def predict(self, observation: np.ndarray, deterministic: bool = False) -> tuple[np.ndarray, None]:
        time.sleep(0 if self.is_warm else 1)
        self.is_warm = True
        return super().predict(observation)


def fail() -> None:
    raise FileNotFoundError("no such agent")
