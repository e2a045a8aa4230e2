"""Soft actor-critic for delayed observations."""

from __future__ import annotations

import io
import pathlib
from typing import Any, ClassVar

from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_said.common.buffers import DelayedReplayBuffer
from sb3_said.common.save_util import PickleRefusedError, SafeSaveMixin, load_tree, save_tree
from sb3_said.sac.policies import DelayedSACPolicy


class DelayedSAC(SafeSaveMixin, SAC):
    """SAC whose actor knows the actions sent since and whose critics know the true state (SADR).

    Two flags span the baselines of "Addressing Signal Delay in Deep RL" (Wang et al., ICLR 2024):

    ============= ============= =======================
    name          augment_state delay_reconciled_critic
    ============= ============= =======================
    SAC           False         False
    SA            True          False
    DR            False         True
    SADR          True          True
    ============= ============= =======================

    The critics' true states come from replay (they arrive a few steps later on a real system too); acting needs none.
    On a task without ``DelayedObservationWrapper`` this is SB3's SAC, update for update.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of actor, critics and entropy coefficient; a number or a schedule
    :param augment_state: the actor reads [observation, action history, age]
    :param delay_reconciled_critic: the critics read the true state
    :param sac_kwargs: every other argument of :class:`stable_baselines3.SAC`
    :raises ValueError: for spaces that are neither, a ``VecNormalize`` of more than the observation, or options that
        need another replay buffer (``n_steps`` > 1) or policy
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": DelayedSACPolicy,
        "MultiInputPolicy": DelayedSACPolicy,
    }
    policy: DelayedSACPolicy
    replay_buffer: DelayedReplayBuffer

    def __init__(
        self,
        policy: str | type[DelayedSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        augment_state: bool = True,
        delay_reconciled_critic: bool = True,
        **sac_kwargs: Any,
    ):
        if sac_kwargs.get("n_steps", 1) != 1:
            raise ValueError(
                f"DelayedSAC learns from one-step targets, got n_steps={sac_kwargs['n_steps']}; leave it 1."
            )
        self.augment_state = augment_state
        self.delay_reconciled_critic = delay_reconciled_critic
        if isinstance(policy, str):  # SB3 would refuse one of the two names, by the kind of space
            policy = self.policy_aliases.get(policy, policy)  # type: ignore[assignment]
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    def _setup_model(self) -> None:
        self._check_parts()
        user_kwargs = self.policy_kwargs
        self.policy_kwargs = {**user_kwargs, **self._policy_flags()}
        super()._setup_model()
        self.policy_kwargs = user_kwargs

    def _check_parts(self) -> None:
        """:raises ValueError: for a policy, a replay buffer or a normalisation that does not go with delays"""
        name, policy_class = type(self).__name__, self.policy_aliases["MlpPolicy"]
        if not issubclass(self.policy_class, policy_class):
            raise ValueError(
                f"{name} needs a {policy_class.__name__}, got {self.policy_class.__name__}; "
                "load a file with the class that saved it."
            )
        self.replay_buffer_class = self.replay_buffer_class or DelayedReplayBuffer
        if not issubclass(self.replay_buffer_class, DelayedReplayBuffer):
            raise ValueError(
                f"{name} learns from a DelayedReplayBuffer, got {self.replay_buffer_class.__name__}; "
                "leave replay_buffer_class out."
            )
        if twice := sorted(self._policy_flags().keys() & self.policy_kwargs.keys()):
            raise ValueError(f"Give {', '.join(twice)} to {name} itself, not in policy_kwargs.")
        vec_normalize = self.get_vec_normalize_env()
        if isinstance(self.observation_space, spaces.Dict) and vec_normalize is not None and vec_normalize.norm_obs:
            keys = vec_normalize.norm_obs_keys or []
            if not set(keys) <= {"observation"}:
                raise ValueError(
                    f"VecNormalize must leave actions and ages as they are, but normalises {', '.join(sorted(keys))}; "
                    "use VecNormalize(..., norm_obs_keys=['observation'])."
                )

    def _policy_flags(self) -> dict[str, Any]:
        """Return what the policy's constructor needs of this algorithm's own arguments."""
        return {"augment_state": self.augment_state, "delay_reconciled_critic": self.delay_reconciled_critic}

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write the replay buffer to a file without pickle.

        :param path: of the file, or a binary file object
        """
        save_tree(path, self.replay_buffer.state_dict())  # type: ignore[arg-type]

    def load_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        truncate_last_traj: bool = True,
        allow_pickle: bool = False,
    ) -> None:
        """Read what ``save_replay_buffer`` wrote into this agent's buffer, running no code from the file.

        :param path: of the file, or a binary file object
        :param truncate_last_traj: of SB3's ``HerReplayBuffer``, without effect here
        :param allow_pickle: also load files of SB3's own method, which can run any code: only for files you trust
        :raises ValueError: when the file is no replay, was made with another task, ``buffer_size`` or ``n_envs``, or
            holds a pickle
        """
        try:
            state = load_tree(path)  # type: ignore[arg-type]
        except PickleRefusedError as error:
            if not allow_pickle:
                raise PickleRefusedError(
                    f"{error} Unpickling runs whatever code the file's author put there. If you trust the author, use "
                    "load_replay_buffer(path, allow_pickle=True), and save it again to get a file without pickle."
                ) from error
            super().load_replay_buffer(path, truncate_last_traj)
            return
        self.replay_buffer.load_state_dict(state)
