"""SAID: a delay-aware expert collects, a diffusion planner trained on its replay answers."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_said.delays.space import ages_of, has_state_history
from sb3_said.files.archive import PathOrFile
from sb3_said.files.arguments import instead_of
from sb3_said.offline import IQLConfig, OfflineAlgorithm
from sb3_said.offline.learning import listed
from sb3_said.planner.checks import whole
from sb3_said.planner.config import SAMPLING_SETTINGS, WEIGHT_SETTINGS, PlannerConfig
from sb3_said.planner.trainer import seeded
from sb3_said.sac import StableSAC
from sb3_said.sac.policies import settings_of
from sb3_said.said.callbacks import PlannerTrainingCallback
from sb3_said.said.distillation import Distillation, distill
from sb3_said.said.learning import PlannerLearner
from sb3_said.said.policies import Answer, SAIDPolicy, Value
from sb3_said.said.ways import WAY_SETTINGS, check_scored, ways_of

SelfSAID = TypeVar("SelfSAID", bound="SAID")


class SAID(PlannerLearner, StableSAC):
    """State-Action Inpainting Diffuser, online (paper, Algorithm 1) and offline (Algorithm 2).

    ``learn`` runs the expert (:class:`~sb3_said.sac.StableSAC`), then trains a diffusion transformer on windows of its
    replay buffer. ``predict`` asks the expert until the planner is trained. Then a trial of a few episodes chooses who
    answers, and how the planner decides. The planner inpaints what the delay hides and the plan after it. At a
    temperature above 0 it draws many candidates, and the critics choose. Collection always uses the expert.
    ``learn_offline`` trains the planner on logs instead, without an expert.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of the expert
    :param planner_kwargs: fields of :class:`~sb3_said.planner.PlannerConfig`; the attribute has all of them
    :param planner_gradient_steps: updates of one planner training; the paper makes 1,000,000
    :param planner_train_freq: also train the planner every so many environment steps, once the expert learns; None, as
        in the paper, only at the end
    :param planner_newest_fraction: train on the newest part of the buffer only. The paper takes all of it (Algorithm 1)
        and finds the newest 20 % as good; here these are better, as policies change fast
    :param planner_terminal_penalty: replaces the reward of a terminating step in the values that weigh windows. The
        paper's Table 3 has -100, for tasks that end by falling, and the presets of such tasks have it too; None keeps
        the reward, for tasks that may end because they are done
    :param planner_trial_episodes: episodes of the trial, played in the training environment after the planner's
        training, on top of ``learn``'s steps. Each of the planner's ways to decide plays a quarter of them (at least
        one in each environment), the three best and the expert play all, and the best one answers. With 0 the planner
        answers as ``planner_kwargs`` says
    :param planner_ways: the ways to decide that are compared with ``planner_kwargs``, by name: settings of
        :meth:`set_planner`, or a ``mask``, for which a second planner is trained. By default
        :data:`~sb3_said.said.ways.WAYS`, or none where ``planner_kwargs`` has settings of ``set_planner``. A planner of
        ``mask="own"`` is left out where not every age was trained on, and on logs. What a way does not name is as the
        planner has it when the trial begins, ``mask`` and ``present`` as it had them first
    :param value: who scores the planner's candidates: ``"critics"``, the expert's, by min Q(s, a); or ``"iql"``, a
        V(s) that implicit Q-learning learns beside the planner, as offline learning always does
    :param iql_kwargs: fields of :class:`~sb3_said.offline.IQLConfig` for learning that V(s), such as
        ``{"expectile": 0.9}``; the attribute has all of them
    :param student_width: of the hidden layers of the student that :meth:`distill` trains; None for its default
    :param sac_kwargs: every other argument of :class:`~sb3_said.sac.StableSAC`, the expert, and of SB3's ``SAC``
    :raises ValueError: as ``DelayedSAC`` does, for settings of planner or V(s) outside their range, and for a
        ``state_history`` in the observations that the planner is not trained to read or that ``VecNormalize`` leaves
        unscaled
    :raises TypeError: for an unknown argument, such as a setting of the planner outside ``planner_kwargs``
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
        self.planner_gradient_steps = whole("planner_gradient_steps", planner_gradient_steps)
        self.planner_train_freq = (
            None if planner_train_freq is None else whole("planner_train_freq", planner_train_freq)
        )
        self.planner_newest_fraction = planner_newest_fraction
        penalty = planner_terminal_penalty
        if penalty is not None and not math.isfinite(penalty):
            raise ValueError(f"planner_terminal_penalty is a reward, got {penalty}; None keeps the task's own.")
        self.planner_terminal_penalty = None if penalty is None else float(penalty)
        self.planner_trial_episodes = whole("planner_trial_episodes", planner_trial_episodes, least=0)
        self.planner_ways = ways_of(planner_ways, self._given_planner_kwargs, value)
        self.value = value
        self.iql_kwargs = asdict(settings_of(IQLConfig, iql_kwargs, "IQL"))
        self.student_width = student_width
        self._planner_trained_at = 0
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    @property
    def planner_kwargs(self) -> dict[str, Any]:
        """Every setting of the planner, which keeps them: see :meth:`set_planner`."""
        policy = getattr(self, "policy", None)
        return self._given_planner_kwargs if policy is None else policy.planner.config.to_dict()

    def _check_env(self, env: VecEnv) -> None:
        super()._check_env(env)
        vec_normalize = unwrap_vec_normalize(env)
        if has_state_history(env.observation_space) and vec_normalize is not None and vec_normalize.norm_obs:
            raise ValueError(
                "VecNormalize scales the observation and not the state_history, which must have the same units; use "
                "VecNormalize(..., norm_obs=False), or leave state_history=False in DelayedObservationWrapper."
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.trained_ages is None and self.env is not None:  # else it was loaded, and set_env checks the ages
            try:
                self.policy.planner.check_ages(ages_of(self.env))
            except ValueError as error:  # no error yet: the expert may learn under another delay
                warnings.warn(str(error), stacklevel=3)

    def _policy_flags(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("planner_kwargs", "value", "iql_kwargs", "student_width")}
        return {**super()._policy_flags(), **own}

    @classmethod
    def _refuse_unknown(cls, given: Iterable[str], known: set[str]) -> None:
        given = set(given)
        if ours := sorted(given & {field.name for field in fields(PlannerConfig)} - known):
            raise TypeError(
                f"{', '.join(ours)}: of the planner, whose settings are planner_kwargs={{{ours[0]!r}: ...}}, on the "
                f'command line -params "planner_kwargs:{{{ours[0]!r}: ...}}".'
            )
        super()._refuse_unknown(given, known)

    def _check_file(self, saved: dict[str, Any]) -> None:
        """Refuse a trained planner of other settings than this agent's, with which its weights mean something else.

        Refuse a student, too, where this agent has none, or one of another width.
        """
        super()._check_file(saved)
        policy = saved["parameters"]["policy"]
        width, own = len(policy.get("student.network.0.bias", ())), self.student_width or 0
        if width and width != own:
            raise ValueError(
                f"it has a student of width {width}, and this agent {f'one of {own}' if own else 'none'}. Make this "
                f"agent with student_width={width}, or take load() in place of set_parameters()"
            )
        if policy.get("planner_updates", 0) > 0:
            self._check_weights(self._settings_in(saved, "planner_kwargs"), WEIGHT_SETTINGS)

    def _check_weights(self, given: dict[str, Any], names: Iterable[str]) -> None:
        """:raises ValueError: where a trained planner has other settings than this agent's, of those named"""
        own = self.planner_kwargs
        others = {name: given[name] for name in names if name in given and given[name] != own[name]}
        if others:
            raise ValueError(
                f"its planner was trained with {', '.join(f'{name}={value!r}' for name, value in others.items())}, and "
                f"is asked for with {', '.join(f'{name}={own[name]!r}' for name in others)}. Make this agent with "
                f"planner_kwargs={others}, take load() in place of set_parameters(), or train anew"
            )

    def _take_settings(self, saved: dict[str, Any]) -> None:
        """Decide as the planner of a checkpoint does: its trial may have chosen another way than the arguments."""
        super()._take_settings(saved)
        if not saved["parameters"]["policy"].get("planner_updates", 0):
            return
        given = self._settings_in(saved, "planner_kwargs")
        self._check_weights(given, [name for name in WEIGHT_SETTINGS if name != "mask"])
        ways = {name: given[name] for name in WAY_SETTINGS if name in given}
        config = settings_of(PlannerConfig, self.planner_kwargs | ways, "The planner")
        if config != self.policy.planner.config:
            self.policy.take_planner(self.policy.new_planner(config), config)

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Keep this agent's own planner where the given one was never trained and has other settings."""
        params = super()._adapt_parameters(params)
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

        A :class:`PlannerTrainingCallback` trains the planner: one among the callbacks, else one that is added. The
        expert answers in all callbacks, such as ``EvalCallback``, also when the planner has been trained before.
        """
        if self.policy.planner_is_trained and self.replay_buffer.size() == 0:
            warnings.warn(
                "The replay is empty, as after load(), so the planner that the file has will be replaced by one of the "
                "new steps alone. load_replay_buffer() before learn() brings back what it learned from.",
                stacklevel=2,
            )
        # If the user has given one, it trains the planner first, and this one has nothing to do
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
        """Write the agent to a file. Who answers now will answer there: amid ``learn`` the expert.

        The arguments are those of :meth:`DelayedSAC.save`.
        """
        with self.policy.preferring_who_answers():
            super().save(path, compact)

    @classmethod
    def load(  # type: ignore[override]  # of files, too, that are open
        cls: type[SelfSAID], path: PathOrFile, *args: Any, **kwargs: Any
    ) -> SelfSAID:
        """Build an agent from a file, as :meth:`DelayedSAC.load` does.

        As in the constructor, a later ``learn`` tries no other ways where ``planner_kwargs`` say how to decide.

        :raises ValueError: as it does, and for ``decided_by="actor"`` where a planner has learned and no expert
        """
        given = kwargs.get("planner_kwargs") or {}
        if set(SAMPLING_SETTINGS) & set(given):
            kwargs = {"planner_ways": {}, **kwargs}
        model = super().load(path, *args, **kwargs)
        if model.policy.planner_is_trained:
            model._check_decider(model.planner_kwargs["decided_by"])
        return model

    def set_planner(self, **settings: Any) -> None:
        """Change how the planner answers, also after training or loading; ``save`` keeps the change.

        ``model.set_planner(temperature=0.3, n_candidates=50)``

        :param settings: ``sampling_steps``, ``n_candidates``, ``temperature``, ``scored_states``, ``choice_factor``,
            ``present`` or ``decided_by`` of :class:`~sb3_said.planner.PlannerConfig`
        :raises ValueError: for other settings, on which the weights depend; for values outside their range; for
            ``scored_states="decision"`` where V(s) scores, which sees no action; and for ``decided_by="actor"`` where
            no expert has learned
        """
        for name in sorted(set(settings) - set(SAMPLING_SETTINGS)):
            is_one = name in self.planner_kwargs
            remedy = "give it as planner_kwargs of a new agent" if is_one else instead_of(name, SAMPLING_SETTINGS)
            raise ValueError(f"Only {', '.join(SAMPLING_SETTINGS)} can be changed, got {name}; {remedy}.")
        check_scored(settings, self.policy.values is not None)
        self._check_decider(settings.get("decided_by"))
        self.policy.planner.config = replace(self.policy.planner.config, **settings)

    def set_answer(self, who: Answer, expert_up_to: int | None = None, expert_from: int | None = None) -> None:
        """Set who answers ``predict`` from now on: see :meth:`SAIDPolicy.set_answer`.

        :raises ValueError: as it does, and for an expert that has learned nothing where the planner has
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
        acts_at = [age for age in ages if who == "expert" or (who == "both" and age in self.policy.expert_ages)]
        if who != "expert":  # the planner's masks were drawn from all of 0..D, whatever the ages in training
            self.policy.planner.check_ages([age for age in ages if age not in acts_at])
        if who in ("planner", "both") and self.policy.planner.config.decided_by == "actor":
            acts_at.append(0)  # the guessed present, as if it were seen
        return acts_at

    def distill(self, width: int | None = None, progress_bar: bool = False, **settings: Any) -> float:
        """Train a student: a plain network that answers as the planner does at temperature 0, much faster.

        The student learns from the planner's answers to observations of the replay, at every age, and to those that the
        student visits in the training environment. This takes less than ten minutes on one core. ``save`` keeps the
        student, and ``set_answer("student")`` lets it answer. A later training of the planner does not change it.

        :param width: of its two hidden layers; by default ``student_width``, or 256 where that is None
        :param progress_bar: show one
        :param settings: of :class:`~sb3_said.said.distillation.Distillation`, such as ``n_labels``
        :return: root mean square of its error over held-out answers of the planner, in actions in [-1, 1]
        :raises ValueError: without a trained planner, with neither a replay nor an environment, or where the scale of
            the replay's states is missing
        """
        config, width = Distillation(**settings), (self.student_width or 256) if width is None else width
        self.policy._check_answer("planner")
        self._check_scale()
        if self.env is None and (self.replay_buffer is None or self.replay_buffer.size() == 0):
            raise ValueError("Nothing to learn from: the replay is empty, as after load(); give load(..., env=env).")
        before = self.policy.student
        with seeded(self.seed or 0):
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

        :param batch_size: number of observations in a later ``predict``
        """
        self.policy.warmup(batch_size)
