"""Behaviour cloning on the augmented state."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from torch.nn import functional as F

from sb3_said.offline.learning import OfflineAlgorithm
from sb3_said.sac.policies import DelayedSACPolicy


class BCPolicy(DelayedSACPolicy):
    """Always answers with the mean, since the spread of the actions is not trained."""

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return super()._predict(observation, deterministic=True)


class BC(OfflineAlgorithm):
    """Imitate the actions of a dataset from what is seen under delay: [observation, action history, age].

    The plainest answer to a delay, and the bar for every other. Least squares fit the mean of ``DelayedSAC``'s actor to
    the logged actions. Neither the critics nor the spread of the actions is trained, so BC answers with the mean.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of the actor (CORL's BC: 3e-4)
    :param normalise_states: read z-scores of states, with mean and deviation of the dataset (CORL's BC: ``normalize``)
    :param sac_kwargs: every other argument of :class:`~sb3_said.sac.DelayedSAC`; those of its critics have no effect
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": BCPolicy, "MultiInputPolicy": BCPolicy}

    def __init__(
        self,
        policy: str | type[DelayedSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        normalise_states: bool = True,
        **sac_kwargs: Any,
    ):
        self.normalise_states = normalise_states
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    def _policy_flags(self) -> dict[str, Any]:
        return {**super()._policy_flags(), "normalise_states": self.normalise_states}

    def take_dataset(self, dataset: Any, progress_bar: bool = False) -> None:
        """Replace the replay buffer by a dataset, and fit the scale of states to it.

        Once weights have learned with a scale, that scale stays.
        """
        super().take_dataset(dataset, progress_bar)
        if self.policy.state_normalizer is not None and not self.has_learned:
            states = self.replay_buffer.window_source(env=self._vec_normalize_env).start_states()  # (N, obs_dim)
            self.policy.state_normalizer.fit(states.to(self.device), 0)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Make gradient steps on batches of the replay buffer."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer])
        losses = []
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            action = self.actor(batch.observations, deterministic=True)  # (B, act_dim), in (-1, 1)
            loss = F.mse_loss(action, batch.actions)
            self.actor.optimizer.zero_grad()
            loss.backward()
            self.actor.optimizer.step()
            losses.append(loss.item())
        self._n_updates += gradient_steps
        self.policy.forget_graph()
        self.policy.set_training_mode(False)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record_mean("train/action_error", float(np.mean(losses)))
