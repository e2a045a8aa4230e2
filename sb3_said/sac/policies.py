"""Actor and critics of ``DelayedSAC``: SB3's own, told what to read."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor, ContinuousCritic, SACPolicy

from sb3_said.common.buffers import UNDELAYED, check_spaces
from sb3_said.common.extractors import KeyExtractor, StateAugmentedExtractor
from sb3_said.common.save_util import register_class


@register_class
class DelayedSACPolicy(SACPolicy):
    """SAC's policy for delayed observations; for a plain 1-D Box it is SB3's ``SACPolicy``.

    :param augment_state: the actor reads [observation, action history, age] instead of the observation alone
    :param delay_reconciled_critic: the critics read the true state, which only replay knows, instead of what the actor
        reads
    :param policy_kwargs: of ``SACPolicy``
    :raises ValueError: for other spaces, or when a features extractor is given for a delayed task
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        augment_state: bool = True,
        delay_reconciled_critic: bool = True,
        **policy_kwargs: Any,
    ):
        state_space, self.max_delay = check_spaces(observation_space, action_space)
        self.augment_state = augment_state
        self.delay_reconciled_critic = delay_reconciled_critic
        self.replay_space: spaces.Dict | None = None
        if isinstance(observation_space, spaces.Dict):
            if policy_kwargs.get("features_extractor_class", FlattenExtractor) is not FlattenExtractor:
                raise ValueError(
                    "What actor and critics read of a delayed observation is set by augment_state and "
                    "delay_reconciled_critic; leave features_extractor_class out."
                )
            self.replay_space = spaces.Dict({**observation_space.spaces, UNDELAYED: state_space})
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)

    def _actor_extractor(self) -> BaseFeaturesExtractor | None:
        if self.replay_space is None:
            return None
        if self.augment_state:
            return StateAugmentedExtractor(self.replay_space)
        return KeyExtractor(self.replay_space, "observation")

    def _critic_extractor(self) -> BaseFeaturesExtractor | None:
        if self.replay_space is not None and self.delay_reconciled_critic:
            return KeyExtractor(self.replay_space, UNDELAYED)
        return self._actor_extractor()

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        if self.replay_space is not None:
            self.actor_kwargs["observation_space"] = self.replay_space
        return super().make_actor(features_extractor or self._actor_extractor())

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        if self.replay_space is not None:
            self.critic_kwargs["observation_space"] = self.replay_space
        return super().make_critic(features_extractor or self._critic_extractor())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "augment_state": self.augment_state,
            "delay_reconciled_critic": self.delay_reconciled_critic,
        }
