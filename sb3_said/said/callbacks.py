"""Decides when SAID's planner is trained."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_said.planner.checks import check_intervals
from sb3_said.said.learning import PlannerLearner
from sb3_said.said.trial import MakeEnv


class PlannerTrainingCallback(BaseCallback):
    """Train SAID's planner when learning ends, and every ``planner_train_freq`` steps where the agent asks for it.

    The agent's own arguments set the number of updates and the data (``planner_gradient_steps``,
    ``planner_newest_fraction``).

    :param folder: keep a checkpoint of the planner's training there, and continue from it
    :param progress_bar: show one
    :param should_stop: asked after every update; a training that it ends writes its checkpoint and raises
        ``KeyboardInterrupt``
    :param make_trial_env: as of :meth:`~sb3_said.said.SAID.train_planner`
    :param intervals: in updates, ``log_interval``, ``eval_interval`` or ``save_interval`` of
        :meth:`~sb3_said.said.SAID.train_planner`
    :raises TypeError: for another name; and when learning begins, for another algorithm
    :raises ValueError: for an interval below 1
    """

    model: PlannerLearner

    def __init__(
        self,
        folder: str | Path | None = None,
        progress_bar: bool = False,
        verbose: int = 0,
        should_stop: Callable[[], bool] | None = None,
        make_trial_env: MakeEnv | None = None,
        **intervals: int | None,
    ):
        super().__init__(verbose)
        if unknown := sorted(set(intervals) - {"log_interval", "eval_interval", "save_interval"}):
            raise TypeError(f"PlannerTrainingCallback has no argument {', '.join(unknown)}.")
        check_intervals(**intervals)  # here, since the planner is trained only after all of learn()'s steps
        how = {"progress_bar": progress_bar, "should_stop": should_stop, "make_trial_env": make_trial_env}
        self.how: dict[str, Any] = {"folder": folder, **how, **intervals}

    def _init_callback(self) -> None:
        if not isinstance(self.model, PlannerLearner):
            raise TypeError(
                f"PlannerTrainingCallback trains SAID's planner, got {type(self.model).__name__}: leave it out."
            )

    def _on_training_start(self) -> None:
        if self.model.num_timesteps < self.model._planner_trained_at:  # counting began anew
            self.model._planner_trained_at = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # Here, and not in on_step, the replay buffer holds every step taken.
        freq, now = self.model.planner_train_freq, self.model.num_timesteps
        is_due = freq is not None and now // freq > self.model._planner_trained_at // freq
        is_due &= self.model.replay_buffer.size() > 0  # an agent saved amid learn() is loaded with an empty one
        if is_due and self.model.has_expert and now > self.model.learning_starts:  # else it imitates random actions
            self.model.train_planner(**self.how, trial_episodes=0)  # the expert goes on collecting, so none is tried

    def _on_training_end(self) -> None:
        # Without a step since the planner's last training there is nothing new to learn from.
        is_new = self.model._planner_trained_at != self.model.num_timesteps
        if is_new and self.model.replay_buffer.size() > 0:
            self.model.train_planner(**self.how)
