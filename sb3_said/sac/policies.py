"""The policy of ``DelayedSAC``: SAC's actor and critics, told what to read."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from operator import itemgetter
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_said.delays.observations import checked_observation
from sb3_said.delays.space import UNDELAYED, check_spaces, holds_whole_numbers, scale_action, unscale_action
from sb3_said.files.agents import SafePolicyMixin
from sb3_said.files.arguments import instead_of
from sb3_said.sac.episodes import TrainingEpisodes
from sb3_said.sac.extractors import KeyExtractor, NormalizedExtractor, StateAugmentedExtractor
from sb3_said.sac.scaling import ReturnScale, StateNormalizer

NOT_FINITE = (
    "The action is not finite: the observation is far larger than those of training, or the agent's weights are "
    "damaged, or its training diverged."
)

#: Arguments of the policy that the algorithm must serve in training; only ``StableSAC`` serves them all
SERVED = ("normalise_states", "scale_rewards", "average_actor")
OWN_ARGUMENTS = ("augment_state", "delay_reconciled_critic", "critic_layer_norm", *SERVED)


class DelayedSACPolicy(SafePolicyMixin, SACPolicy):
    """SAC's policy for delayed observations; for a plain 1-D Box it computes what SB3's ``SACPolicy`` does.

    :param augment_state: the actor reads [observation, action history, age] instead of the observation alone
    :param delay_reconciled_critic: the critics read the true state, which only replay knows, instead of what the actor
        reads
    :param normalise_states: actor and critics read z-scores of states
        (see :class:`~sb3_said.sac.scaling.StateNormalizer`)
    :param scale_rewards: the critics' values are in units of a :class:`~sb3_said.sac.scaling.ReturnScale`
    :param average_actor: an average of the actor's weights answers, see :meth:`without_average`
    :param critic_layer_norm: a LayerNorm follows each hidden layer of the critics, before its activation
    :param policy_kwargs: of ``SACPolicy``
    :raises ValueError: for other spaces, or when a features extractor is given or shared in a delayed task
    """

    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        augment_state: bool = True,
        delay_reconciled_critic: bool = True,
        normalise_states: bool = False,
        scale_rewards: bool = False,
        average_actor: bool = False,
        critic_layer_norm: bool = False,
        **policy_kwargs: Any,
    ):
        state_space, _, self.max_delay = check_spaces(observation_space, action_space)
        self.augment_state = augment_state
        self.delay_reconciled_critic = delay_reconciled_critic
        self.normalise_states = normalise_states
        self.scale_rewards = scale_rewards
        self.average_actor = average_actor
        self.critic_layer_norm = critic_layer_norm
        self.replay_space: spaces.Dict | None = None
        if isinstance(observation_space, spaces.Dict):
            own = {name: policy_kwargs.get(name) for name in ("share_features_extractor", "features_extractor_kwargs")}
            if (
                any(own.values())
                or policy_kwargs.get("features_extractor_class", FlattenExtractor) is not FlattenExtractor
            ):
                raise ValueError(
                    "augment_state and delay_reconciled_critic set what actor and critics each read of a delayed "
                    f"observation; leave features_extractor_class, {' and '.join(own)} out."
                )
            self.replay_space = spaces.Dict({**observation_space.spaces, UNDELAYED: state_space})
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.return_scale = ReturnScale() if self.scale_rewards else None
        self.state_normalizer: StateNormalizer | None = None
        if self.normalise_states:
            state_space = check_spaces(self.observation_space, self.action_space).state
            self.state_normalizer = StateNormalizer(state_space.shape[0])
        if self.replay_space is not None:  # actor and critics read what replay samples
            self.actor_kwargs["observation_space"] = self.critic_kwargs["observation_space"] = self.replay_space
        super()._build(lr_schedule)
        self.averaged_actor: Actor | None = None
        self.training_episodes: TrainingEpisodes | None = None
        if self.average_actor:
            self.training_episodes = TrainingEpisodes()
            self.averaged_actor = self.make_actor().requires_grad_(False)
            self.averaged_actor.load_state_dict(self.actor.state_dict())
            self.averaged_actor.set_training_mode(False)
        self._answers_as_average = self.average_actor

    @contextmanager
    def without_average(self) -> Iterator[None]:
        """Let the actor that learns answer ``predict`` for a while, where its average would."""
        before, self._answers_as_average = self._answers_as_average, False
        try:
            yield
        finally:
            self._answers_as_average = before

    def forget_graph(self) -> None:
        """Drop the distribution of the actor's last batch, since ``copy.deepcopy`` cannot copy its graph.

        With gSDE the distribution also holds the noise, and stays.
        """
        if not self.actor.use_sde:
            fresh = SquashedDiagGaussianDistribution(get_action_dim(self.action_space))
            self.actor.action_dist = fresh  # type: ignore[assignment]  # SB3 declares gSDE's, and has this

    def reset_noise(self, batch_size: int = 1) -> None:
        super().reset_noise(batch_size)
        if self.averaged_actor is not None:
            self.averaged_actor.reset_noise(batch_size)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        return super().make_actor(features_extractor or self._extractor("observation"))

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        key = UNDELAYED if self.delay_reconciled_critic else "observation"
        critic = super().make_critic(features_extractor or self._extractor(key))
        if self.critic_layer_norm:
            for network in critic.q_networks:
                assert isinstance(network, nn.Sequential)  # as SB3 makes them
                for hidden in [layer for layer in network if isinstance(layer, nn.Linear)][:-1]:
                    norm = nn.LayerNorm(hidden.out_features, device=hidden.weight.device)
                    network.insert([*network].index(hidden) + 1, norm)
        return critic

    def _extractor(self, key: str) -> BaseFeaturesExtractor | None:
        """Return an extractor of one key of delayed observations, or of a plain one; None for SB3's own."""
        if self.replay_space is None:
            if self.state_normalizer is None:
                return None
            return NormalizedExtractor(self.make_features_extractor(), self.state_normalizer)
        if self.augment_state and key != UNDELAYED:
            return StateAugmentedExtractor(self.replay_space, self.state_normalizer)
        return KeyExtractor(self.replay_space, key, self.state_normalizer)

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """Check what ``predict`` was given, and copy it into float32 tensors.

        :param observation: one observation or a batch of them, of any numbers
        :return: tensors with a batch dimension, and whether they had one before
        :raises ValueError: as :func:`~sb3_said.delays.observations.checked_observation`
        """
        arrays, is_batch = self.obs_to_arrays(observation)
        # SB3's own method cannot reshape an action history of no actions, that of max_delay 0.
        device = self.device  # read once: SB3 looks for it among all parameters
        tensors = {key: th.as_tensor(x, device=device) for key, x in arrays.items()}
        return tensors if isinstance(self.observation_space, spaces.Dict) else tensors["observation"], is_batch

    def obs_to_arrays(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], bool]:
        """Check arrays or tensors as :func:`~sb3_said.delays.observations.checked_observation`."""
        return checked_observation(observation, self.observation_space, as_array)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Answer as SB3 does, and only with actions of the action space: every answer passes here.

        :raises ValueError: as :meth:`obs_to_tensor`, and for an action that is not finite
        """
        actions, state = super().predict(observation, state, episode_start, deterministic)
        return self._checked(actions, observation), state

    def _checked(self, actions: np.ndarray, observation: np.ndarray | dict[str, np.ndarray]) -> np.ndarray:
        """Return an answer, (..., act_dim) in the units of the action space, within its bounds.

        :raises ValueError: for an action that is not finite
        """
        if not np.isfinite(actions).all():
            parts = observation.values() if isinstance(observation, dict) else [observation]
            largest = max(float(np.abs(part).max(initial=0.0)) for part in parts)
            raise ValueError(f"{NOT_FINITE} The largest entry of the observation is {largest:.3g}.")
        space = self.action_space
        return np.clip(actions, space.low, space.high)  # scaling to the bounds may round beyond them

    def scale_action(self, action: np.ndarray) -> np.ndarray:
        space = self.action_space
        return scale_action(action, space) if holds_whole_numbers(space) else super().scale_action(action)

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        space = self.action_space
        is_whole = holds_whole_numbers(space)  # SB3 leaves fractions, in a type that may not hold the range
        return unscale_action(scaled_action, space) if is_whole else super().unscale_action(scaled_action)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        actor = self.averaged_actor if self._answers_as_average else self.actor
        assert actor is not None
        try:
            return actor(observation, deterministic)
        except ValueError as error:  # of torch's distributions, about a NaN
            raise ValueError(NOT_FINITE) from error

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {name: getattr(self, name) for name in OWN_ARGUMENTS}


def each_part(change: Callable[[th.Tensor], th.Tensor], observation: PyTorchObs) -> PyTorchObs:
    """Change an observation, or each part of one that is a dict."""
    if isinstance(observation, dict):
        return {key: change(part) for key, part in observation.items()}
    return change(observation)


def rows_of(observation: PyTorchObs) -> Iterator[PyTorchObs]:
    """Yield each row of a batch as a batch of one."""
    n = len(observation["delay"] if isinstance(observation, dict) else observation)
    for i in range(n):
        yield each_part(itemgetter(slice(i, i + 1)), observation)


def seed_of(row: PyTorchObs) -> int:
    """Return a seed that depends on the observation alone, so that equal observations get equal draws."""
    entries = [row[key] for key in sorted(row)] if isinstance(row, dict) else [row]
    return zlib.crc32(b"".join((entry.cpu().numpy() + 0.0).tobytes() for entry in entries))  # -0.0 is 0.0


def as_array(given: Any) -> np.ndarray:
    """Return numbers as an array, those of a tensor from any device, with or without a gradient."""
    if isinstance(given, th.Tensor):
        given = given.detach().cpu()
        given = given.float() if given.is_floating_point() else given  # NumPy has no bfloat16
    return np.asarray(given)


def settings_of(cls: Any, given: dict[str, Any] | None, whose: str) -> Any:
    """Return settings from the keyword arguments that a constructor was given for them.

    :param cls: a dataclass
    :param given: some of its fields; None for none
    :param whose: owner of the settings, for the error
    :raises ValueError: for anything but a dict, for a field that the class lacks, and as the class does
    """
    names = [field.name for field in fields(cls)]
    if not isinstance(given, dict | None):
        raise ValueError(f'{whose}\'s settings are a dict, such as {{"{names[0]}": ...}}, got {given!r}.')
    given = given or {}
    if unknown := sorted(set(given) - set(names)):
        raise ValueError(f"{whose} has no setting {', '.join(unknown)}; {instead_of(unknown[0], names)}")
    return cls(**given)
