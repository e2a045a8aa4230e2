"""SAID: a delay-aware expert collects, a diffusion planner trained on its replay answers."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_said.delays.space import ages_of, has_state_history
from sb3_said.files.archive import PathOrFile
from sb3_said.offline import IQL, ImplicitValues, IQLConfig, OfflineAlgorithm, load_dataset
from sb3_said.offline.learning import listed
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.planner.values import returns_to_go
from sb3_said.sac import StableSAC
from sb3_said.sac.policies import settings_of
from sb3_said.said.callbacks import PlannerTrainingCallback
from sb3_said.said.policies import Answer, SAIDPolicy, Value
from sb3_said.said.student import Distillation, distill
from sb3_said.said.training import PlannerTraining
from sb3_said.said.trial import let_the_best_answer
from sb3_said.said.ways import check_scored, in_way, masks_of, ways_of

HELD_OUT = 0.05  # of the planner's data
HAND_OVER_INTERVAL = 100  # updates of an offline training

SelfSAID = TypeVar("SelfSAID", bound="SAID")


class SAID(OfflineAlgorithm, StableSAC):
    """State-Action Inpainting Diffuser, online (paper, Algorithm 1) and offline (Algorithm 2).

    ``learn`` runs the expert (:class:`~sb3_said.sac.StableSAC`), then trains a diffusion transformer on windows of its
    replay buffer. ``predict`` asks the expert until the planner is trained, and then whoever of the two does better in
    a few episodes, which also tell how the planner decides best. The planner inpaints what the delay hides and the plan
    behind it; at a temperature above 0 many times, and the critics choose. Collection always uses the expert.
    ``learn_offline`` trains the planner on logs instead, without an expert.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of the expert
    :param planner_kwargs: fields of :class:`~sb3_said.planner.PlannerConfig`; the attribute has all of them
    :param planner_gradient_steps: updates of one planner training; the paper makes 1,000,000
    :param planner_train_freq: also train the planner every so many environment steps; the paper only at the end (None)
    :param planner_newest_fraction: train on the newest part of the buffer only. The paper takes all of it (Algorithm 1)
        and finds the newest 20 % as good; here they are better, where policies change fast
    :param planner_terminal_penalty: replaces the reward of a terminating step in the values that weigh windows. The
        paper's Table 3 has -100, for tasks that end by falling, and the presets of such tasks have it too; None keeps
        the reward, for tasks that may end because they are done
    :param planner_trial_episodes: of the training environment, played after the planner's training, a quarter of them
        in each of its ways to decide, the others in the three best, and all with the expert; the best one answers. They
        come on top of ``learn``'s steps. 0: the planner answers, as ``planner_kwargs`` says
    :param planner_ways: names and settings of :meth:`set_planner` to compare with those of ``planner_kwargs``, or a
        ``mask``, for which a second planner is trained; by default :data:`~sb3_said.said.ways.WAYS`, or none where
        ``planner_kwargs`` has settings of ``set_planner``. A planner of ``mask="own"`` is left out where not every age
        was trained on, and on logs
    :param value: who scores the planner's candidates: ``"critics"``, the expert's, by min Q(s, a); or ``"iql"``, a
        V(s) that is learned beside the planner by implicit Q-learning, which is what offline learning has
    :param iql_kwargs: fields of :class:`~sb3_said.offline.IQLConfig`, how that V(s) is learned, such as
        ``{"expectile": 0.9}``; the attribute has all of them
    :param student_width: of the hidden layers of the student that :meth:`distill` trains; None before
    :param sac_kwargs: every other argument of :class:`~sb3_said.sac.StableSAC`, the expert, and of SB3's ``SAC``
    :raises ValueError: as ``DelayedSAC`` does, for settings of planner or V(s) outside their range, and for a
        ``state_history`` in the observations that the planner is not trained to read or that ``VecNormalize`` leaves
        unscaled
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": SAIDPolicy, "MultiInputPolicy": SAIDPolicy}
    counters = (*OfflineAlgorithm.counters, "_planner_trained_at")
    settings_arguments = ("planner_kwargs", "iql_kwargs")
    learns_online = True
    policy: SAIDPolicy

    def __init__(
        self,
        policy: str | type[SAIDPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        planner_kwargs: dict[str, Any] | None = None,
        planner_gradient_steps: int = 4_000,
        planner_train_freq: int | None = None,
        planner_newest_fraction: float = 0.2,
        planner_terminal_penalty: float | None = None,
        planner_trial_episodes: int = 20,
        planner_ways: dict[str, dict[str, Any]] | None = None,
        value: Value = "critics",
        iql_kwargs: dict[str, Any] | None = None,
        student_width: int | None = None,
        **sac_kwargs: Any,
    ):
        if not 0.0 < planner_newest_fraction <= 1.0:
            raise ValueError(
                f"planner_newest_fraction is a part of the buffer in (0, 1], got {planner_newest_fraction}."
            )
        self._given_planner_kwargs = planner_kwargs or {}
        self.planner_gradient_steps = _count("planner_gradient_steps", planner_gradient_steps)
        self.planner_train_freq = (
            None if planner_train_freq is None else _count("planner_train_freq", planner_train_freq)
        )
        self.planner_newest_fraction = planner_newest_fraction
        self.planner_terminal_penalty = planner_terminal_penalty
        self.planner_trial_episodes = _count("planner_trial_episodes", planner_trial_episodes, least=0)
        self.planner_ways = ways_of(planner_ways, self._given_planner_kwargs, value)
        self.value = value
        self.iql_kwargs = asdict(settings_of(IQLConfig, iql_kwargs, "IQL"))
        self.student_width = student_width
        self._planner_trained_at = 0  # num_timesteps of the last planner training
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    @property
    def planner_kwargs(self) -> dict[str, Any]:
        """Every setting of the planner, which keeps them: see :meth:`set_planner`."""
        policy = getattr(self, "policy", None)
        return self._given_planner_kwargs if policy is None else policy.planner.config.to_dict()

    def _check_env(self, env: GymEnv) -> None:
        super()._check_env(env)
        vec_normalize = unwrap_vec_normalize(env)  # type: ignore[arg-type]  # None for one that is no VecEnv
        if has_state_history(env.observation_space) and vec_normalize is not None and vec_normalize.norm_obs:
            raise ValueError(
                "VecNormalize scales the observation and not the state_history, which must have the same units; use "
                "VecNormalize(..., norm_obs=False), or leave state_history=False in DelayedObservationWrapper."
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.trained_ages is None and self.env is not None:  # else it was loaded, and check_ages says it
            try:
                self.policy.planner.check_ages(ages_of(self.env))
            except ValueError as error:  # no error yet: the expert may learn under another delay
                warnings.warn(str(error), stacklevel=3)

    def _policy_flags(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("planner_kwargs", "value", "iql_kwargs", "student_width")}
        return {**super()._policy_flags(), **own}

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Keep this agent's own planner where the given one was never trained and has other settings."""
        given, own = params.get("policy", {}), self.policy.state_dict()
        shapes = [
            {name: value.shape for name, value in state.items() if name.startswith("planner.")}
            for state in (given, own)
        ]
        if given.get("planner_updates") == 0 and shapes[0] != shapes[1]:
            kept = {name: value for name, value in given.items() if not name.startswith("planner.")}
            params = {**params, "policy": kept | {name: own[name] for name in shapes[1]}}
        return params

    def learn(
        self: SelfSAID,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SAID",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSAID:
        """Run the expert for ``total_timesteps``, then train the planner on what it stored.

        A :class:`PlannerTrainingCallback` among the callbacks trains the planner, and otherwise one that is added. The
        expert answers all callbacks, such as ``EvalCallback``, also when the planner has been trained before.
        """
        # After the user's own it has nothing to do
        callbacks = [*listed(callback), PlannerTrainingCallback(progress_bar=progress_bar)]
        with self.policy.answering("expert"):
            return super().learn(
                total_timesteps,
                callbacks,
                log_interval,
                tb_log_name,
                reset_num_timesteps,
                progress_bar,
            )

    def save(self, path: PathOrFile, compact: bool = False) -> None:  # type: ignore[override]  # no exclude, include
        """Write the agent to a file, which answers as the agent does now; amid ``learn`` that is the expert.

        The arguments are those of :meth:`DelayedSAC.save`.
        """
        with self.policy.preferring_who_answers():
            super().save(path, compact)

    @classmethod
    def load(  # type: ignore[override]  # of files, too, that are open
        cls: type[SelfSAID], path: PathOrFile, *args: Any, **kwargs: Any
    ) -> SelfSAID:
        """Build an agent from a file, as :meth:`DelayedSAC.load` does.

        As in the constructor, ``planner_kwargs`` that say how to decide leave a later ``learn`` no ways to try.
        """
        if set(SAMPLING_SETTINGS) & set(kwargs.get("planner_kwargs") or {}):
            kwargs = {"planner_ways": {}, **kwargs}
        return super().load(path, *args, **kwargs)

    def set_planner(self, **settings: Any) -> None:
        """Change how the planner answers, also after training or loading; ``save`` keeps the change.

        ``model.set_planner(temperature=0.3, n_candidates=50)``

        :param settings: ``sampling_steps``, ``n_candidates``, ``temperature``, ``scored_states``, ``choice_factor``,
            ``present`` or ``decided_by`` of :class:`~sb3_said.planner.PlannerConfig`
        :raises ValueError: for other settings, which the weights depend on, for values outside their range, for
            ``scored_states="decision"`` where V(s) scores, in which no action shows, and for ``decided_by="actor"``
            where no expert has learned
        """
        if others := sorted(set(settings) - set(SAMPLING_SETTINGS)):
            raise ValueError(
                f"Only {', '.join(SAMPLING_SETTINGS)} can be changed, got {', '.join(others)}; "
                "give it as planner_kwargs of a new agent."
            )
        check_scored(settings, self.policy.values is not None)
        if settings.get("decided_by") == "actor" and not self.has_expert:
            raise ValueError("decided_by='actor' lets the expert's actor decide, which this agent has not trained.")
        self.policy.planner.config = replace(self.policy.planner.config, **settings)

    def set_answer(self, who: Answer, expert_up_to: int | None = None, expert_from: int | None = None) -> None:
        """Let one of them answer ``predict`` from now on, or two: see :meth:`SAIDPolicy.set_answer`.

        :raises ValueError: as it does, and for an expert that has learned nothing, where the planner has
        """
        if who in ("expert", "both") and not self.has_expert and self.policy.planner_is_trained:
            raise ValueError(
                f"The expert has learned nothing, as after logs alone or within learning_starts steps: got {who!r}."
            )
        self.policy.set_answer(who, expert_up_to, expert_from)

    def _acts_at(self, ages: list[int]) -> list[int]:
        """Return the ages that the expert's actor meets; of the others, refuse those that the planner cannot plan at.

        :raises ValueError: as :meth:`InpaintingPlanner.check_ages`
        """
        who = self.policy.who_answers
        if who != "expert":  # masks were drawn from all of 0..D, so it has met every age
            self.policy.planner.check_ages(ages)
        acts_at = [age for age in ages if who == "expert" or (who == "both" and age in self.policy.expert_ages)]
        if who in ("planner", "both") and self.policy.planner.config.decided_by == "actor":
            acts_at.append(0)  # on the present, as if it saw it
        return acts_at

    def distill(self, width: int = 256, progress_bar: bool = False, **settings: Any) -> float:
        """Train a student: a plain network that answers as the planner does at temperature 0, much faster.

        It learns from the planner's answers to observations of the replay, at every age, and to those that it visits
        itself in the training environment, within ten minutes on one core. ``save`` keeps it. To use it,
        ``set_answer("student")``. It does not change where the planner is trained again.

        :param width: of its two hidden layers
        :param progress_bar: show one
        :param settings: fields of :class:`~sb3_said.said.student.Distillation`, such as ``n_labels`` or ``q_weight``
        :return: root mean square of its error over held-out answers of the planner, in actions in [-1, 1]
        :raises ValueError: without a trained planner, or without both a replay and an environment
        """
        config = Distillation(**settings)
        self.policy._check_answer("planner")
        if self.env is None and (self.replay_buffer is None or self.replay_buffer.size() == 0):
            raise ValueError("Nothing to learn from: the replay is empty, as after load(); give load(..., env=env).")
        before = self.policy.student
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(self.seed or 0)
            self.policy.make_student(width)
            try:
                error = distill(self, config, progress_bar)
            except BaseException:
                self.policy.student = before
                raise
        assert self.policy.student is not None  # just made
        self.policy.student.requires_grad_(False)
        if before is not None:
            self.policy.student.preferred.copy_(before.preferred)
        self.student_width = width
        return error

    def predict_plan(self, observation: Any, deterministic: bool = False) -> np.ndarray:
        """Return the action to execute and those planned after it: see :meth:`SAIDPolicy.predict_plan`."""
        return self.policy.predict_plan(observation, deterministic)

    def warmup(self, batch_size: int = 1) -> None:
        """Run a few dummy predictions: see :meth:`SAIDPolicy.warmup`. A control loop calls it once before it starts.

        :param batch_size: observations of a later ``predict``
        """
        self.policy.warmup(batch_size)

    def make_planner_trainer(
        self, gradient_steps: int | None = None, planner: InpaintingPlanner | None = None
    ) -> PlannerTrainer:
        """Return a trainer of this agent's planner on its replay buffer.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :param planner: in place of the agent's own, one of the same sizes
        :raises ValueError: when the buffer is empty, as it is after ``load``
        """
        steps = self.planner_gradient_steps if gradient_steps is None else _count("gradient_steps", gradient_steps)
        replay, newest, env = self.replay_buffer, self.newest_fraction, self._vec_normalize_env
        source = replay.window_source(newest, env)
        has_older = len(source) < replay.size() * replay.n_envs  # a log's replay has one, whatever the agent has
        bootstrap = self._stored_values if self.has_expert else None  # offline there are no critics
        values = returns_to_go(source, self.gamma, self.planner_terminal_penalty, bootstrap)
        return PlannerTrainer(
            planner or self.policy.planner,
            replace(source, values=values),
            steps,
            held_out=HELD_OUT if len(source) > 1 else 0.0,
            seed=self.seed or 0,
            older=replay.window_source(newest, env, older=True) if has_older else None,
        )

    @property
    def has_expert(self) -> bool:
        """Whether actor and critics have learned, here or where ``set_parameters`` has them from."""
        return self._n_updates > 0 or len(self.actor.optimizer.state) > 0

    @property
    def newest_fraction(self) -> float:
        """The part of the replay that is imitated: all of a log, no step of which is newer than another."""
        return 1.0 if self.replay_buffer.holds_logs else self.planner_newest_fraction

    @th.no_grad()
    def _stored_values(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return values as the environment's rewards would sum up, of states as windows have them: (B,)."""
        self.critic.set_training_mode(False)  # until the next update; batch norm must not learn from this
        values = self.policy.q_value(states.to(self.device), actions.to(self.device)).cpu()
        env = self._vec_normalize_env
        return values if env is None else th.from_numpy(env.unnormalize_reward(values.numpy()))

    def train_planner(
        self,
        gradient_steps: int | None = None,
        folder: str | Path | None = None,
        progress_bar: bool = False,
        log_interval: int = 500,
        eval_interval: int = 2_000,
        save_interval: int | None = None,
        trial_episodes: int | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> None:
        """Train the planner anew on the replay buffer, without running the expert; then see who answers better.

        Where a trial follows, each other ``mask`` that ``planner_ways`` names has a planner too, of as many updates.
        The agent keeps the one that does best.

        Interrupting (Ctrl-C) ends the training early and keeps the planner as far as it got. Until the training ends,
        and where it fails, the planner answers as before. Without ``verbose`` and a bar, one line says that it begins.

        A row of the log is written at ``num_timesteps`` plus the updates made; with ``planner_train_freq`` at
        ``num_timesteps`` alone, since the expert's rows go on from there.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :param folder: keep a checkpoint there, and continue from it if it is of the same training
        :param progress_bar: show one
        :param log_interval: updates between two rows of losses in the log
        :param eval_interval: updates between two measurements of the held-out errors, beside the regression's
        :param save_interval: updates between two checkpoints; by default ten minutes, and longer where they are large
        :param trial_episodes: ``planner_trial_episodes`` by default; none are played where there is no environment, or
            no expert to compare with
        :param should_stop: asked after every update; where it says so, a checkpoint is written and the training ends
        :raises KeyboardInterrupt: when ``should_stop`` has ended the training
        :raises ValueError: when the buffer is empty, or the checkpoint is of a training with other settings
        :raises FloatingPointError: when an update was not finite
        """
        learned_online = not self.replay_buffer.holds_logs  # of logs num_timesteps counts updates
        if learned_online and not self.has_expert and 0 < self.num_timesteps <= self.learning_starts:
            warnings.warn(
                f"The expert has not learned yet: after {self.num_timesteps} steps, of which the first learning_starts="
                f"{self.learning_starts} are random actions, the planner imitates those. Learn for longer.",
                stacklevel=2,
            )
        if not hasattr(self, "_logger"):  # not set_logger: learn() makes its own
            self._logger = configure_logger(self.verbose, self.tensorboard_log, "SAID", reset_num_timesteps=False)

        n_episodes = self.planner_trial_episodes if trial_episodes is None else trial_episodes
        is_tried = n_episodes > 0 and self._can_be_tried()

        def train(planner: InpaintingPlanner, *before: InpaintingPlanner) -> tuple[PlannerTraining, str]:
            def row(n_updates: int) -> int:
                n_made = len(before) * trainer.gradient_steps + n_updates
                return self.num_timesteps + (n_made if self.planner_train_freq is None else 0)

            trainer, intervals = self.make_planner_trainer(gradient_steps, planner), (log_interval, eval_interval)
            values = None if before else self._make_value_trainer()
            training = PlannerTraining(self, trainer, values, row, folder, *intervals, save_interval)
            if before:
                trainer.take_first_guess(before[0])  # of the same data
            if trainer.n_updates < trainer.gradient_steps and not progress_bar and self.verbose == 0:
                print(
                    f"Training the {training.name}: {trainer.gradient_steps} updates. progress_bar=True or verbose=1 "
                    "shows how far it is.",
                    flush=True,
                )
            return training, training.run(progress_bar, should_stop)

        training, outcome = train(self.policy.planner)
        if training.trainer.n_updates > 0:
            self.set_answer("planner")
        planners = [self.policy.planner]
        for mask in masks_of(self)[1:] if is_tried else []:
            if outcome == "done":
                planner = self.policy.new_planner(in_way(self.policy.planner.config, {"mask": mask}))
                training, outcome = train(planner, *planners)
                planners.append(planner)
        if is_tried and outcome == "done":
            training.log(let_the_best_answer(self, n_episodes, progress_bar, should_stop, planners[1:]))
        if outcome == "stopped":
            raise KeyboardInterrupt
        self._planner_trained_at = self.num_timesteps

    def _can_be_tried(self) -> bool:
        """Tell whether planner and expert can be played. Warn where episodes might never end."""
        if self.env is None or not self.has_expert:
            return False
        if self.replay_buffer.dones[: self.replay_buffer.size()].any():
            return True
        warnings.warn(
            "No episode has ended in what the agent has stored, so a trial might never end: the planner answers as it "
            "is. train_planner() plays one later; set_answer() and set_planner() choose.",
            stacklevel=3,
        )
        return False

    def _make_value_trainer(self) -> IQL | None:
        """Return a trainer of V(s) on the replay buffer, where that is who values plans."""
        if self.policy.values is None:
            return None
        data, env = load_dataset(self.replay_buffer, self.observation_space, self.action_space), self._vec_normalize_env
        if env is not None:  # V reads states as the planner has them
            normalized = self.replay_buffer.normalized
            data = replace(data, states=normalized(data.states, env), finals=normalized(data.finals, env))
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(self.seed or 0)
            sizes = data.states.shape[1], data.actions.shape[1]
            values = ImplicitValues(*sizes, self.policy.iql_config).to(self.device)
        return IQL(values, data, self.gamma, self.seed or 0)

    def learn_offline(  # type: ignore[override]
        self: SelfSAID,
        dataset: Any,
        gradient_steps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int = 500,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        folder: str | Path | None = None,
        eval_interval: int = 2_000,
        save_interval: int | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> SelfSAID:
        """Train the planner, and V(s) beside it, on logs of a task without delay (paper, Algorithm 2).

        No environment is stepped and no expert is trained; the planner serves every delay 0..D. Callbacks are called
        after each update, and meet a planner that is at most 100 updates old. ``num_timesteps`` counts updates.

        :param dataset: whatever :func:`~sb3_said.offline.load_dataset` reads; None for what ``take_dataset`` took
        :param gradient_steps: ``planner_gradient_steps`` by default
        :param callback: SB3 callbacks, such as ``EvalCallback``
        :param log_interval: updates between two rows of losses in the log
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: has no effect: each training of a planner begins anew
        :param progress_bar: show one
        :param folder: keep a checkpoint there, and continue from it if it is of the same training
        :param eval_interval: updates between two measurements of the held-out errors
        :param save_interval: updates between two checkpoints; by default ten minutes, and longer where they are large
        :param should_stop: as of :meth:`train_planner`
        :raises KeyboardInterrupt: when ``should_stop`` has ended the training
        :raises ValueError: as ``load_dataset`` and :meth:`train_planner` do
        """
        total = self.planner_gradient_steps if gradient_steps is None else _count("gradient_steps", gradient_steps)
        with self._as_before_if_it_fails():
            ways_of(self.planner_ways, self.planner_kwargs, "iql")  # refuses what V(s) cannot score
            watcher = self._begin_offline(dataset, total, callback, tb_log_name, True, progress_bar)
            self.value = "iql"
            self.policy.set_value("iql")
            trainer, values = self.make_planner_trainer(total), self._make_value_trainer()
            intervals = log_interval, eval_interval, save_interval
            training = PlannerTraining(self, trainer, values, lambda n_updates: n_updates, folder, *intervals, watcher)
            self.num_timesteps = trainer.n_updates
            if not trainer.make_first_guess(progress_bar, should_stop):
                raise KeyboardInterrupt
            watcher.on_training_start(locals() | {"total_timesteps": total, "callback": watcher}, globals())

        is_new = True

        def on_step(n_updates: int) -> bool:
            nonlocal is_new
            self.num_timesteps = n_updates
            if is_new or n_updates % HAND_OVER_INTERVAL == 0:  # else an expert that learns nothing would answer
                training.hand_over()
                is_new = False
            return self._goes_on(watcher)

        outcome = training.run(should_stop=should_stop, on_step=on_step)
        if trainer.n_updates > 0:
            self.set_answer("planner")
        if outcome == "stopped":
            raise KeyboardInterrupt
        watcher.on_training_end()
        return self

    @contextmanager
    def _as_before_if_it_fails(self) -> Iterator[None]:
        """Take back what a training from logs changes before its first update, if it gets no further."""
        names = "replay_buffer", "num_timesteps", "value"
        before, policy = {name: getattr(self, name) for name in names}, self.policy
        values, config = policy.values, policy.planner.config
        try:
            yield
        except BaseException:
            for name, value in before.items():
                setattr(self, name, value)
            policy.values, policy.planner.config = values, config
            raise


def _count(name: str, given: float, least: int = 1) -> int:
    """Return a count; 1e4 is a float in YAML and in -params.

    :raises ValueError: for one below the least, or no whole number
    """
    if given < least or given % 1 != 0:
        raise ValueError(f"{name} must be a whole number, at least {least}, got {given}.")
    return int(given)
