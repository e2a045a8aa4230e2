"""How SAID's planner learns: from the expert's replay (paper, Algorithm 1), or from logs (Algorithm 2)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from sb3_said.delays.space import ages_of
from sb3_said.files.normalization import get_statistics, set_statistics
from sb3_said.offline import IQL, ImplicitValues, load_dataset
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.checks import check_intervals, whole
from sb3_said.planner.trainer import PlannerTrainer, seeded
from sb3_said.planner.values import returns_to_go
from sb3_said.said.agent import PlannerAgent
from sb3_said.said.training import PlannerTraining
from sb3_said.said.trial import MakeEnv, let_the_best_answer, stopped_alone
from sb3_said.said.ways import other_planners, untried, ways_of

HELD_OUT = 0.05  # of the planner's data
HAND_OVER_INTERVAL = 100  # updates of an offline training

SelfLearner = TypeVar("SelfLearner", bound="PlannerLearner")


class PlannerLearner(PlannerAgent):
    """An agent that trains its planner."""

    def make_planner_trainer(
        self, gradient_steps: int | None = None, planner: InpaintingPlanner | None = None
    ) -> PlannerTrainer:
        """Return a trainer of this agent's planner on its replay buffer.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :param planner: in place of the agent's own, one of the same sizes
        :raises ValueError: when the buffer is empty, as it is after ``load``, or the scale of its states is missing
        """
        steps = self.planner_gradient_steps if gradient_steps is None else whole("gradient_steps", gradient_steps)
        self._check_scale()
        replay, newest, env = self.replay_buffer, self.newest_fraction, self._vec_normalize_env
        source = replay.window_source(newest, env)
        has_older = len(source) < replay.size() * replay.n_envs  # not the agent's n_envs: a log's replay has 1
        bootstrap = self._stored_values if self.has_expert and not replay.holds_logs else None  # critics know no logs
        values = returns_to_go(source, self.gamma, self.planner_terminal_penalty, bootstrap)
        return PlannerTrainer(
            planner or self.policy.planner,
            replace(source, values=values),
            steps,
            held_out=HELD_OUT if len(source) > 1 else 0.0,
            seed=self.seed or 0,
            older=replay.window_source(newest, env, older=True) if has_older else None,
            # On HalfCheetah-v5's log many steps at once cost four fifths of the return (results/first_guess.md)
            guess_steps=1 if replay.holds_logs else max(1, self.policy.max_delay),
        )

    def train_planner(
        self,
        gradient_steps: int | None = None,
        folder: str | Path | None = None,
        progress_bar: bool = False,
        log_interval: int | None = 500,
        eval_interval: int | None = 2_000,
        save_interval: int | None = None,
        trial_episodes: int | None = None,
        should_stop: Callable[[], bool] | None = None,
        make_trial_env: MakeEnv | None = None,
    ) -> None:
        """Train the planner anew on the replay buffer, without running the expert; then play a trial of who is better.

        Where a trial follows, another planner is trained for each other ``mask`` that ``planner_ways`` names, with as
        many updates. The agent keeps the best one.

        Interrupting (Ctrl-C) ends the training, or the trial, early and keeps the planner as far as it got. Until the
        training ends, and where it fails, the planner answers as before. Without ``verbose`` and a bar, one line says
        that the training begins.

        A row of the log is written at ``num_timesteps`` plus the updates made. With ``planner_train_freq`` it is
        written at ``num_timesteps`` alone, since the expert's rows go on from there.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :param folder: keep a checkpoint there, and continue from it if it is of the same training
        :param progress_bar: show one
        :param log_interval: updates between two rows of losses in the log; None for one, at the end
        :param eval_interval: updates between two measurements of the held-out errors, the planner's and the
            regression's; they are measured only where ``log_interval`` has a row, too. None for one, at the end
        :param save_interval: updates between two checkpoints; by default ten minutes, and longer where they are large
        :param trial_episodes: ``planner_trial_episodes`` by default; none are played where there is no environment, or
            no expert to compare with
        :param should_stop: asked after every update; if it returns True, a checkpoint is written and the training ends
        :param make_trial_env: makes a number of environments like the training's, as ``lambda n: make_vec_env(make,
            n)``. The trial plays in them at once, which is faster (results/settings.md); without it, or where it fails,
            in the training's own
        :raises KeyboardInterrupt: when ``should_stop`` has ended it
        :raises ValueError: for an interval below 1, when the buffer is empty, or the checkpoint is of a training with
            other settings
        :raises FloatingPointError: when an update was not finite
        """
        check_intervals(log_interval=log_interval, eval_interval=eval_interval, save_interval=save_interval)
        n_episodes = self.planner_trial_episodes if trial_episodes is None else trial_episodes
        n_episodes = whole("trial_episodes", n_episodes, least=0)
        learned_online = not self.replay_buffer.holds_logs  # else num_timesteps counts updates
        if learned_online and 0 < self.num_timesteps <= self.learning_starts:
            go_on = ", or with reset_num_timesteps=False" if self.has_expert else ""
            warnings.warn(
                f"The planner imitates random actions, which the newest {self.num_timesteps} steps are: learn() begins "
                f"with learning_starts={self.learning_starts} of them. Learn for longer{go_on}.",
                stacklevel=2,
            )
        if not self.has_expert and self.policy.planner.config.decided_by == "actor":
            told = "No expert has learned whose actor could decide: the planner decides by its plan."
            warnings.warn(told, stacklevel=2)
            self.policy.planner.config = replace(self.policy.planner.config, decided_by="plan")
        if not hasattr(self, "_logger"):  # not set_logger: learn() makes its own
            self._logger = configure_logger(self.verbose, self.tensorboard_log, "SAID", reset_num_timesteps=False)

        is_tried = n_episodes > 0 and self._can_be_tried()
        planners = [self.policy.planner]
        planners += [self.policy.new_planner(config) for config in (other_planners(self) if is_tried else [])]
        for k, planner in enumerate(planners):
            trainer = self.make_planner_trainer(gradient_steps, planner)
            values = self._make_value_trainer() if k == 0 else None
            row = partial(self._planner_row, k * trainer.gradient_steps)
            training = PlannerTraining(self, trainer, values, row, folder, log_interval, eval_interval, save_interval)
            if k > 0:
                trainer.take_first_guess(planners[0])  # of the same data
            if trainer.n_updates < trainer.gradient_steps and not progress_bar and self.verbose == 0:
                print(
                    f"Training the {training.name}: {trainer.gradient_steps} updates. progress_bar=True or verbose=1 "
                    "shows how far it is.",
                    flush=True,
                )
            outcome = training.run(progress_bar, should_stop)
            if outcome != "done":
                break
        if is_tried and outcome == "done":
            with stopped_alone():
                training.log(
                    let_the_best_answer(self, n_episodes, progress_bar, should_stop, planners[1:], make_trial_env)
                )
        # A stop that was asked for amid the trial leaves the outcome "done"
        if outcome == "stopped" or (should_stop is not None and should_stop()):
            raise KeyboardInterrupt
        self._planner_trained_at = self.num_timesteps

    def learn_offline(  # the planner has its own number of updates, logs and checkpoints
        self: SelfLearner,
        dataset: Any,
        gradient_steps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 500,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        folder: str | Path | None = None,
        eval_interval: int | None = 2_000,
        save_interval: int | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> SelfLearner:
        """Train the planner, and V(s) beside it, on logs of a task without delay (paper, Algorithm 2).

        No environment is stepped and no expert is trained. The planner serves every delay 0..D, with ``mask="fixed"`` D
        alone. Callbacks are called after each update. They meet a planner that is at most 100 updates behind, and after
        the last update the final one. ``num_timesteps`` counts updates.

        From the first update on the planner answers, by plans. If a trial has chosen one of ``planner_ways``, the
        default way takes its place, as no trial is played on logs. V(s) scores candidates from then on
        (``value="iql"``), also where ``learn`` goes on.

        :param dataset: whatever :func:`~sb3_said.offline.load_dataset` reads; None for what ``take_dataset`` took
        :param gradient_steps: ``planner_gradient_steps`` by default
        :param callback: SB3 callbacks, such as ``EvalCallback``
        :param log_interval: updates between two rows of losses in the log; None for one, at the end
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: has no effect: each training of a planner begins anew
        :param progress_bar: show one
        :param folder: keep a checkpoint there, and continue from it if it is of the same training
        :param eval_interval: as of :meth:`train_planner`
        :param save_interval: updates between two checkpoints; by default ten minutes, and longer where they are large
        :param should_stop: as of :meth:`train_planner`
        :raises KeyboardInterrupt: when ``should_stop`` has ended the training
        :raises ValueError: as ``load_dataset`` and :meth:`train_planner` do, and for ``decided_by="actor"`` where no
            expert has learned
        """
        total = self.planner_gradient_steps if gradient_steps is None else whole("gradient_steps", gradient_steps)
        check_intervals(log_interval=log_interval, eval_interval=eval_interval, save_interval=save_interval)
        with self._as_before_if_it_fails() as take_back:
            ways_of(self.planner_ways, self.policy.planner.config.to_dict(), "iql")  # refuses what V(s) cannot score
            watcher = self._begin_offline(dataset, total, callback, tb_log_name, True, progress_bar)
            self._check_decider(self.policy.planner.config.decided_by)
            # An actor would decide as it learned in earlier steps, whatever is learned here
            config = replace(self.policy.planner.config, decided_by="plan")
            if self.planner_ways and self._planner_trained_at > 0:
                config = untried(config, self.planner_ways.values())
            is_another = config.mask != self.policy.planner.config.mask
            self.policy.take_planner(self.policy.new_planner(config) if is_another else self.policy.planner, config)
            self.value = "iql"
            self.policy.set_value("iql")
            trainer, values = self.make_planner_trainer(total), self._make_value_trainer()
            intervals = log_interval, eval_interval, save_interval
            training = PlannerTraining(self, trainer, values, lambda n_updates: n_updates, folder, *intervals, watcher)
            self.num_timesteps = trainer.n_updates
            if not trainer.make_first_guess(progress_bar, should_stop):
                raise KeyboardInterrupt
            watcher.on_training_start(locals() | {"total_timesteps": total, "callback": watcher}, globals())

        self._planner_trained_at = 0  # a trial's choice was undone above; what is set from now on stays
        first = trainer.n_updates + 1

        def on_step(n_updates: int) -> bool:
            self.num_timesteps = n_updates
            # After the first update, too: until then the expert answers, and it learns nothing here
            if n_updates in (first, total) or n_updates % HAND_OVER_INTERVAL == 0:
                training.hand_over()
            return self._goes_on(watcher)

        try:
            outcome = training.run(should_stop=should_stop, on_step=on_step)
        finally:
            if not training.has_handed_over:
                take_back()
        if outcome == "stopped":
            raise KeyboardInterrupt
        watcher.on_training_end()
        return self

    def _planner_row(self, n_before: int, n_updates: int) -> int:
        """Return where a planner's row stands in the log, by the updates of earlier planners and by its own."""
        return self.num_timesteps + (n_before + n_updates if self.planner_train_freq is None else 0)

    def _check_decider(self, decided_by: str | None) -> None:
        """:raises ValueError: for the actor, where no expert has learned"""
        if decided_by == "actor" and not self.has_expert:
            raise ValueError("decided_by='actor' lets the expert's actor decide, which this agent has not trained.")

    @th.no_grad()
    def _stored_values(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return Q(s, a) in units of the environment's rewards, for states and actions of windows: (B,)."""
        self.critic.set_training_mode(False)  # until the next update; batch norm must not learn from this
        values = self.policy.q_value(states.to(self.device), actions.to(self.device)).cpu()
        env = self._vec_normalize_env
        return values if env is None else th.from_numpy(env.unnormalize_reward(values.numpy()))

    def _make_value_trainer(self) -> IQL | None:
        """Return a trainer of V(s) on the replay buffer; None where V(s) values no plans."""
        if self.policy.values is None:
            return None
        data, env = load_dataset(self.replay_buffer, self.observation_space, self.action_space), self._vec_normalize_env
        if env is not None:  # V reads states as the planner does
            normalized = self.replay_buffer.normalized
            data = replace(data, states=normalized(data.states, env), finals=normalized(data.finals, env))
        with seeded(self.seed or 0):
            sizes = data.states.shape[1], data.actions.shape[1]
            values = ImplicitValues(*sizes, self.policy.iql_config).to(self.device)
        return IQL(values, data, self.gamma, self.seed or 0)

    def _check_scale(self) -> None:
        """:raises ValueError: where the agent reads normalised states, and nothing normalises those of its replay"""
        if self.reads_normalized and self._vec_normalize_env is None:
            raise ValueError(
                "This agent reads observations that VecNormalize has normalised, and its replay has them as they are: "
                "give load(..., env=...) what load_normalization(path, venv) or SB3's VecNormalize.load returns."
            )

    def _can_be_tried(self) -> bool:
        """Tell whether planner and expert can be played. Warn where the planner cannot, or episodes might never end."""
        if self.env is None or not self.has_expert:
            return False
        try:
            self.policy.planner.check_ages(ages_of(self.env))
        except ValueError as error:
            warnings.warn(f"No trial is played, and the planner answers: {error}", stacklevel=3)
            return False
        n_stored = self.replay_buffer.size()
        if n_stored == 0 or self.replay_buffer.dones[:n_stored].any():  # the training itself refuses an empty one
            return True
        warnings.warn(
            "No episode has ended in what the agent has stored, so a trial might never end: the planner answers as it "
            "is. train_planner() plays one later; set_answer() and set_planner() choose.",
            stacklevel=3,
        )
        return False

    @contextmanager
    def _as_before_if_it_fails(self) -> Iterator[Callable[[], None]]:
        """Take back what a training from logs has changed, if it fails inside the context.

        The context gives the function that takes it back, for a training that fails later, before its planner is handed
        over.
        """
        names = "replay_buffer", "num_timesteps", "value", "_planner_trained_at"
        before, policy = {name: getattr(self, name) for name in names}, self.policy
        values, planner, scale = policy.values, policy.planner, get_statistics(self._vec_normalize_env)
        config = planner.config

        def take_back() -> None:
            for name, value in before.items():
                setattr(self, name, value)
            policy.values = values
            policy.take_planner(planner, config)
            set_statistics(self._vec_normalize_env, scale)

        try:
            yield take_back
        except BaseException:
            take_back()
            raise
