"""README's recipe for a robot gives what the wrapper gives, where commands take time on their way, too."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_said.delays import DelayedObservationWrapper

README = Path(__file__).resolve().parents[2] / "README.md"
START, STEP = README.read_text().partition("from collections import deque")[2].partition("```")[0].split("# in each ")


class Robot:
    """A task whose commands queue up on their way to it, and whose observations queue up on their way back."""

    def __init__(self, name: str, n_there: int, n_back: int) -> None:
        self.env = gym.make(name)
        self.there: deque[Any] = deque([None] * n_there)
        self.back = deque([(self.env.reset(seed=0)[0], 0)] * (n_back + 1))

    def read(self) -> tuple[np.ndarray, int]:
        return self.back[0]

    def send(self, action: np.ndarray, number: int) -> None:
        """One control step passes; the task starts when the first action arrives."""
        self.there.append((action, number))
        if (arrived := self.there.popleft()) is not None:
            self.back.append((self.env.step(arrived[0])[0], arrived[1]))
        else:
            self.back.append(self.back[-1])
        self.back.popleft()


@pytest.mark.parametrize(("n_there", "n_back"), [(0, 3), (3, 0), (2, 2)])
@pytest.mark.parametrize("name", ["Pendulum-v1", "Hopper-v5"])  # actions to 2, and to 1
def test_a_robot_observes_what_the_wrapper_hands_out(name: str, n_there: int, n_back: int) -> None:
    env = DelayedObservationWrapper(gym.make(name), n_back, n_there, max_delay=6)
    wanted = [env.reset(seed=0)[0]]

    def predict(obs: dict[str, np.ndarray], deterministic: bool) -> tuple[np.ndarray, None]:
        """In closed loop, so that a difference would grow."""
        for key, value in wanted[-1].items():
            np.testing.assert_array_equal(np.asarray(obs[key], np.float32), value)
        action = np.sin(5 * obs["observation"][: env.action_space.shape[0]] + len(wanted)).astype(np.float32)
        action *= env.action_space.high
        wanted.append(env.step(action)[0])
        return action, None

    names: dict[str, Any] = {"act_dim": env.action_space.shape[0], "robot": Robot(name, n_there, n_back)}
    policy = SimpleNamespace(max_delay=6)
    names["model"] = SimpleNamespace(warmup=lambda: None, predict=predict, action_space=env.action_space, policy=policy)
    exec("from collections import deque" + START, names)
    for _ in range(12):
        exec("# " + STEP, names)
    assert len(wanted) == 13 and wanted[-1]["delay"] == n_there + n_back
