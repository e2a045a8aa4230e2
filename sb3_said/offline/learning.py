"""Learning from a replay that is already full: a gradient step takes the place of the environment step."""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.delays.receivers import Actuator, NewestPacket
from sb3_said.delays.space import ages_of, has_attribute
from sb3_said.offline.datasets import Dataset, load_dataset
from sb3_said.planner.checks import check_intervals, whole
from sb3_said.sac import DelayedSAC

SelfOffline = TypeVar("SelfOffline", bound="OfflineAlgorithm")


class GradientStepBar(ProgressBarCallback):
    """SB3's progress bar, counting gradient steps instead of environment steps."""

    def _on_step(self) -> bool:
        self.pbar.update()
        return True


class OfflineAlgorithm(DelayedSAC):
    """An SB3 algorithm that learns from logs; a subclass says in ``train`` what one gradient step is.

    The environment gives the spaces and the delay, and is neither reset nor stepped.
    """

    learns_from_logs: ClassVar[bool] = True
    learns_online: ClassVar[bool] = False

    @property
    def has_learned(self) -> bool:
        """Whether the weights have learned, here or in the agent that ``set_parameters`` took them from."""
        return self._n_updates > 0 or len(self.actor.optimizer.state) > 0

    def learn(self: SelfOffline, *args: Any, **kwargs: Any) -> SelfOffline:
        """Learn from the environment, if the subclass can.

        :raises ValueError: if the subclass learns from logs alone
        """
        if not self.learns_online:
            raise ValueError(
                f"{type(self).__name__} learns from logs: call learn_offline(dataset, gradient_steps), with logs such "
                "as sb3-said collect makes."
            )
        if self.replay_buffer.holds_logs:
            warnings.warn(
                "The agent collects steps of its own now: its replay no longer holds the dataset.", stacklevel=3
            )
            self.replay_buffer = self._new_replay_buffer()
            self.num_timesteps = 0  # it counted updates of learn_offline
        elif self.trained_ages is None and self.replay_buffer.size() == 0:  # loaded: a file has no replay
            self.num_timesteps = 0
        return super().learn(*args, **kwargs)

    def learn_offline(
        self: SelfOffline,
        dataset: Any,
        gradient_steps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1_000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOffline:
        """Learn from a dataset. ``num_timesteps`` counts gradient steps, and callbacks are called after each.

        Callbacks see each gradient step as a rollout of one step, so a ``TrainingCheckpointCallback`` works as online.

        :param dataset: whatever :func:`~sb3_said.offline.load_dataset` reads; None for what :meth:`take_dataset` took
        :param gradient_steps: to make
        :param callback: SB3 callbacks, such as ``EvalCallback``
        :param log_interval: gradient steps between two rows of the log, with a last row at the end; None for no log
        :param tb_log_name: name of the run in TensorBoard, the class's by default
        :param reset_num_timesteps: count from 0
        :param progress_bar: show one
        :raises ValueError: as ``load_dataset`` does; for steps that are no count; for a delayed agent without the
            wrapper that gives its ages
        """
        check_intervals(log_interval=log_interval)
        if isinstance(self.observation_space, spaces.Dict) and self._draw_ages() is None:
            raise ValueError(
                f"{type(self).__name__} learns at the ages that a DelayedObservationWrapper gives, and has none: give "
                "it the environment, with load(..., env=env) or set_env(env). It is not stepped."
            )
        if self.env is not None:
            self.trained_ages = ages_of(self.env)
        watcher = self._begin_offline(dataset, gradient_steps, callback, tb_log_name, reset_num_timesteps, progress_bar)
        watcher.on_training_start(locals() | {"total_timesteps": self._total_timesteps, "callback": watcher}, globals())
        while self.num_timesteps < self._total_timesteps:
            watcher.on_rollout_start()
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)  # a rate may fall
            self.train(1, self.batch_size)
            self.num_timesteps += 1
            if log_interval is not None and self.num_timesteps % log_interval == 0:
                self.logger.dump(self.num_timesteps)
            if not self._goes_on(watcher):
                break
            watcher.on_rollout_end()
        if log_interval is not None and self.logger.name_to_value:  # recorded since the last row
            self.logger.dump(self.num_timesteps)
        watcher.on_training_end()
        return self

    def _begin_offline(
        self,
        dataset: Any,
        gradient_steps: int,
        callback: MaybeCallback,
        tb_log_name: str | None,
        reset_num_timesteps: bool,
        progress_bar: bool,
    ) -> BaseCallback:
        """Do what SB3's ``_setup_learn`` does, without an environment; return the callbacks, not yet started."""
        gradient_steps = whole("gradient_steps", gradient_steps, least=0)
        if dataset is not None:
            self.take_dataset(dataset, progress_bar)
        self.start_time = time.time_ns()
        if reset_num_timesteps:
            self.num_timesteps = 0
        self._num_timesteps_at_start = self.num_timesteps
        self._total_timesteps = self.num_timesteps + gradient_steps
        self.ep_info_buffer, self.ep_success_buffer = (deque(maxlen=self._stats_window_size) for _ in range(2))
        if not self._custom_logger:
            name = tb_log_name or type(self).__name__
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name, reset_num_timesteps)
        return self._init_callback([*listed(callback), *([GradientStepBar()] if progress_bar else [])])

    def _goes_on(self, watcher: BaseCallback) -> bool:
        """Call the callbacks after a gradient step; return whether learning goes on."""
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        return watcher.on_step()

    def take_dataset(self, dataset: Any, progress_bar: bool = False) -> None:
        """Replace the replay buffer by a dataset, at ages drawn as the environment's delay would give them.

        A ``VecNormalize`` in training takes mean and variance of observations and the size of returns from the dataset.

        :param dataset: whatever :func:`~sb3_said.offline.load_dataset` reads
        :param progress_bar: show one
        :raises ValueError: as ``load_dataset`` does
        """
        data = load_dataset(dataset, self.observation_space, self.action_space, self.task, progress_bar)
        if self._vec_normalize_env is not None and self._vec_normalize_env.training:
            take_statistics(self._vec_normalize_env, data)
        self.replay_buffer = data.to_replay(
            self.observation_space,
            self.action_space,
            self._draw_ages(),
            self.replay_buffer_class,  # type: ignore[arg-type]  # as _setup_model saw to
            device=self.device,
            relabelled_ages=self.relabelled_ages,
            **self.replay_buffer_kwargs,
        )

    def _draw_ages(self) -> Callable[[int], np.ndarray] | None:
        """Return a function that draws an episode's ages as its receivers would in play; None without the wrapper."""
        is_delayed = isinstance(self.observation_space, spaces.Dict)
        if self.env is None or not is_delayed or not has_attribute(self.env, "make_receivers"):
            return None
        made = self.env.env_method("make_receivers")  # one for each environment; their delays may differ
        rng = np.random.default_rng(self.seed)

        def step(receiver: NewestPacket, actuator: Actuator | None) -> int:
            if actuator is not None:
                actuator.execute(np.zeros(()))
            age = receiver.step()
            return age if actuator is None else age + actuator.lag(age)

        def draw(n_steps: int) -> np.ndarray:
            receiver, actuator = made[int(rng.integers(len(made))) if len(made) > 1 else 0]
            if actuator is not None:
                actuator.reset(rng.spawn(1)[0])
            receiver.reset(rng)
            return np.array([0, *(step(receiver, actuator) for _ in range(n_steps))])

        return draw


def take_statistics(vec_normalize: VecNormalize, data: Dataset) -> None:
    """Update a ``VecNormalize`` as if it had seen the logged episodes in play, one after the other."""
    if vec_normalize.norm_obs:
        rms = vec_normalize.obs_rms
        (rms["observation"] if isinstance(rms, dict) else rms).update(data.states.astype(np.float64))
    if vec_normalize.norm_reward:
        returns, value = np.zeros(len(data)), 0.0
        for i, (reward, ends) in enumerate(zip(data.rewards, data.ends, strict=True)):
            returns[i] = value = vec_normalize.gamma * value + reward
            value = 0.0 if ends else value
        vec_normalize.ret_rms.update(returns)


def listed(callback: MaybeCallback | tuple[BaseCallback, ...]) -> list[BaseCallback]:
    """Return callbacks, in any form that SB3 takes, as a list."""
    if callback is None:
        return []
    given = callback if isinstance(callback, (list, tuple)) else [callback]
    return [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in given]
