"""A student for small computers: a plain network that answers as the planner does, without denoising."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_said.delays.space import check_spaces
from sb3_said.planner.checks import whole
from sb3_said.planner.plain import ZScored, plain_network
from sb3_said.sac.extractors import StateAugmentedExtractor
from sb3_said.sac.policies import as_array


class Student(ZScored):
    """Reads what the expert's actor reads, [newest observation, actions since, age / D], but z-scored.

    :param observation_space: of the agent
    :param action_space: (act_dim,)
    :param width: of the two hidden layers
    :raises ValueError: for a width below 1
    """

    preferred: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], width: int):
        width = whole("student_width", width)
        state_space, action_box, max_delay = check_spaces(observation_space, action_space)
        reader = StateAugmentedExtractor(observation_space) if isinstance(observation_space, spaces.Dict) else None
        n_inputs, act_dim = reader.features_dim if reader else state_space.shape[0], action_box.shape[0]
        super().__init__(n_inputs)
        self.width, self.max_delay, self.reader = width, max_delay, reader
        self.register_buffer("preferred", th.zeros(()))  # 1 where it answers
        self.network = nn.Sequential(*plain_network(n_inputs, act_dim, width), nn.Tanh())

    def read(self, observation: PyTorchObs) -> th.Tensor:
        """Return what the student reads of observations: (B, n_inputs)."""
        if self.reader is None:
            assert isinstance(observation, th.Tensor)
            return observation
        return self.reader(observation)

    def answer(self, inputs: th.Tensor) -> th.Tensor:
        """Return actions in [-1, 1] for inputs of :meth:`read`: (B, act_dim)."""
        return self.network(self._z(inputs))

    def react(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Answer one observation as :meth:`answer` does, in NumPy: (1, act_dim).

        PyTorch's sixteen calls would take five times as long as the computation itself (results/student.md).

        :param observation: arrays (1, ...) by key; without delay "observation" alone
        """
        x = observation["observation"]
        if self.reader is not None:
            history, age = observation["action_history"], observation["delay"]
            since = np.arange(self.max_delay, 0, -1) <= age  # (1, D)
            x = np.concatenate(
                [x, (history * since[..., None]).reshape(1, -1), age / max(self.max_delay, 1)], axis=1, dtype=np.float32
            )
        x = (x - as_array(self.mean)) / as_array(self.std)
        *hidden, last = (layer for layer in self.network if isinstance(layer, nn.Linear))
        for layer in hidden:
            x = np.maximum(x @ as_array(layer.weight).T + as_array(layer.bias), 0.0)
        return np.tanh(x @ as_array(last.weight).T + as_array(last.bias))


def as_delayed(observation: PyTorchObs, act_dim: int) -> dict[str, th.Tensor]:
    """Return observations as a delayed task has them; those without delay get the age 0 and an empty history."""
    if isinstance(observation, dict):
        return observation
    n = len(observation)
    history, delay = observation.new_zeros(n, 0, act_dim), observation.new_zeros(n, 1)
    return {"observation": observation, "action_history": history, "delay": delay}
