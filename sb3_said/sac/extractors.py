"""What an actor or a critic reads of a delayed observation."""

from __future__ import annotations

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor


class StateAugmentedExtractor(BaseFeaturesExtractor):
    """Concatenate [delayed observation, actions sent since, age / D], which make the process Markov (Theorem 2.1).

    Actions older than the observation are shown as zeros: it holds all that they did, and one actor for many ages would
    have to learn to look away. A ``state_history`` is not read.

    :param observation_space: that of ``DelayedObservationWrapper``
    """

    def __init__(self, observation_space: spaces.Dict):
        history = observation_space["action_history"]
        obs_dim, (max_delay, act_dim) = observation_space["observation"].shape[0], history.shape  # type: ignore
        super().__init__(observation_space, features_dim=obs_dim + max_delay * act_dim + 1)
        self.max_delay = max_delay

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        age = observations["delay"]  # (B, 1)
        since = th.arange(self.max_delay, 0, -1, device=age.device) <= age  # (B, D): a_{t-k} came after s_{t-age}
        history = observations["action_history"] * since[..., None]  # (B, D, act_dim)
        return th.cat([observations["observation"], history.flatten(1), age / max(self.max_delay, 1)], dim=1)


class KeyExtractor(BaseFeaturesExtractor):
    """Read one key of a dict observation and nothing else.

    :param observation_space: with a 1-D Box under ``key``
    :param key: e.g. ``"undelayed_observation"`` for a delay-reconciled critic
    """

    def __init__(self, observation_space: spaces.Dict, key: str):
        super().__init__(observation_space, features_dim=observation_space[key].shape[0])  # type: ignore[index]
        self.key = key

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return observations[self.key]
