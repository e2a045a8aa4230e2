"""The policy of ``DelayedSAC``: SAC's actor and critics, told what to read."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_said.delays.space import UNDELAYED, check_spaces
from sb3_said.files.agents import SafePolicyMixin
from sb3_said.sac.extractors import KeyExtractor, StateAugmentedExtractor


class DelayedSACPolicy(SafePolicyMixin, SACPolicy):
    """SAC's policy for delayed observations; for a plain 1-D Box it computes what SB3's ``SACPolicy`` does.

    :param augment_state: the actor reads [observation, action history, age] instead of the observation alone
    :param delay_reconciled_critic: the critics read the true state, which only replay knows, instead of what the actor
        reads
    :param policy_kwargs: of ``SACPolicy``
    :raises ValueError: for other spaces, or when a features extractor is given or shared in a delayed task
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
            if policy_kwargs.get("share_features_extractor", False):
                raise ValueError(
                    "Actor and critics read different things of a delayed observation; leave "
                    "share_features_extractor=False."
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

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """Turn what ``predict`` was given into float32 tensors of their own memory, after checking it.

        :param observation: one observation or a batch of them, of any numbers
        :return: tensors with a batch dimension, and whether they had one before
        :raises ValueError: for entries that are no numbers or not finite in float32, another shape, an empty batch,
            other keys, an age outside 0..max_delay, or a ``state_known`` other than 0 and 1
        """
        space = self.observation_space
        if not isinstance(space, spaces.Dict):
            if isinstance(observation, dict):
                raise ValueError(
                    f"The agent was built for a task without delay, got a dict with the keys {list(observation)}; "
                    "leave DelayedObservationWrapper out."
                )
            values = _as_float32("observation", observation)
            is_batch = _check_array("observation", values, space) is not None
            return th.as_tensor(values if is_batch else values[None], device=self.device), is_batch
        if not isinstance(observation, dict) or set(observation) != set(space.keys()):
            given = f"the keys {list(observation)}" if isinstance(observation, dict) else type(observation).__name__
            raise ValueError(
                f"The agent was built for dict observations with the keys {sorted(space.keys())}, got {given}; "
                "wrap the task in DelayedObservationWrapper."
            )
        arrays = {key: _as_float32(key, observation[key]) for key in space.keys()}
        batches = {key: _check_array(key, values, space[key]) for key, values in arrays.items()}
        if len(set(batches.values())) > 1:
            raise ValueError(f"The parts of an observation differ in how many there are: {batches}.")
        _check_delayed(arrays, self.max_delay)
        # SB3's own method cannot reshape an action history of no actions, that of max_delay 0.
        is_batch = batches["delay"] is not None
        tensors = {
            key: th.as_tensor(values if is_batch else values[None], device=self.device)
            for key, values in arrays.items()
        }
        return tensors, is_batch

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "augment_state": self.augment_state,
            "delay_reconciled_critic": self.delay_reconciled_critic,
        }


def _as_float32(name: str, values: Any) -> np.ndarray:
    """Copy numbers to what the networks compute in, before they are looked at.

    1e300 is infinite there, and noise that an observation decides must not depend on the dtype it came in.

    :raises ValueError: for strings and objects, or nested lists that are no array
    """
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} cannot be made an array: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, expected real numbers.")
    with np.errstate(over="ignore"):  # refused with a reason next
        return array.astype(np.float32)


def _check_array(name: str, values: np.ndarray, space: spaces.Space[Any]) -> int | None:
    """Refuse an array of another shape, an empty batch or one that is not finite. The space's bounds are not read.

    :return: size of the batch, None for a single element
    """
    if values.shape != space.shape and values.shape[1:] != space.shape:
        raise ValueError(
            f"{name} has the shape {values.shape}, expected {space.shape}, or (n_envs, *{space.shape}) for a batch; "
            "the agent was built for another task or max_delay."
        )
    if values.shape != space.shape and len(values) == 0:
        raise ValueError(f"{name} is an empty batch, of shape {values.shape}; there is nothing to answer.")
    if not np.isfinite(values).all():
        raise ValueError(
            f"{name} has entries that are NaN or infinite, in float32; find out where they come from first."
        )
    return None if values.shape == space.shape else len(values)


def _check_delayed(arrays: dict[str, np.ndarray], max_delay: int) -> None:
    """Refuse ages, actions and flags that no ``DelayedObservationWrapper`` of this ``max_delay`` hands out."""
    delay, action_history = arrays["delay"], arrays["action_history"]
    if np.any(delay != np.round(delay)) or np.any(delay < 0) or np.any(delay > max_delay):
        raise ValueError(
            f"delay runs from {delay.min():g} to {delay.max():g}, expected whole numbers in 0..{max_delay}: "
            f"the agent was built for max_delay={max_delay}."
        )
    if np.any(np.abs(action_history) > 1.0 + 1e-4):
        raise ValueError(
            f"action_history has entries of size {np.abs(action_history).max():g}, expected actions scaled to [-1, 1], "
            "as DelayedObservationWrapper gives them."
        )
    known = arrays.get("state_known", np.zeros(0))
    if np.any((known != 0) & (known != 1)):
        raise ValueError(
            f"state_known runs from {known.min():g} to {known.max():g}, expected 1 where a state of state_history is "
            "known and 0 elsewhere."
        )
