"""What an actor or a critic reads of a delayed observation."""

from __future__ import annotations

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_said.sac.scaling import StateNormalizer


class StateAugmentedExtractor(BaseFeaturesExtractor):
    """Concatenate [delayed observation, actions sent since, age / D], which make the process Markov (Theorem 2.1).

    Actions older than the observation are shown as zeros: the observation holds all that they did, and one actor for
    many ages would have to learn to ignore them. A ``state_history`` is not read.

    :param observation_space: that of ``DelayedObservationWrapper``
    :param normalizer: of the observation, None for none
    """

    def __init__(self, observation_space: spaces.Dict, normalizer: StateNormalizer | None = None):
        history = observation_space["action_history"]
        obs_dim, (max_delay, act_dim) = observation_space["observation"].shape[0], history.shape  # type: ignore
        super().__init__(observation_space, features_dim=obs_dim + max_delay * act_dim + 1)
        self.max_delay = max_delay
        self.register_buffer("steps_ago", th.arange(max_delay, 0, -1), persistent=False)  # (D,): k of a_{t-k}
        self.normalizer = normalizer or nn.Identity()

    steps_ago: th.Tensor

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        age = observations["delay"]  # (B, 1)
        since = self.steps_ago <= age  # (B, D): a_{t-k} came after s_{t-age}
        history = observations["action_history"] * since[..., None]  # (B, D, act_dim)
        state = self.normalizer(observations["observation"])  # (B, obs_dim)
        return th.cat([state, history.flatten(1), age / max(self.max_delay, 1)], dim=1)


class KeyExtractor(BaseFeaturesExtractor):
    """Read one key of a dict observation and nothing else.

    :param observation_space: with a 1-D Box under ``key``
    :param key: e.g. ``"undelayed_observation"`` for a delay-reconciled critic
    :param normalizer: of what is read, None for none
    """

    def __init__(self, observation_space: spaces.Dict, key: str, normalizer: StateNormalizer | None = None):
        super().__init__(observation_space, features_dim=observation_space[key].shape[0])  # type: ignore[index]
        self.key = key
        self.normalizer = normalizer or nn.Identity()

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return self.normalizer(observations[self.key])


class NormalizedExtractor(BaseFeaturesExtractor):
    """Hand z-scores of a 1-D Box observation, that of a task without delay, to another extractor.

    :param extractor: that reads them
    :param normalizer: of the observation
    """

    def __init__(self, extractor: BaseFeaturesExtractor, normalizer: StateNormalizer):
        super().__init__(extractor._observation_space, extractor.features_dim)
        self.extractor, self.normalizer = extractor, normalizer

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.extractor(self.normalizer(observations))
