"""SAID's policy: an expert that collects and a planner that answers, behind one ``predict``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import product
from operator import itemgetter
from typing import Any, Literal, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_said.delays.space import KEYS, STATE_KEYS, UNDELAYED, check_spaces, has_state_history
from sb3_said.files.archive import PathOrFile
from sb3_said.offline.iql import ImplicitValues, IQLConfig
from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.graphs import EAGER_CALLS
from sb3_said.planner.planner import Plan
from sb3_said.planner.selection import choose
from sb3_said.sac.policies import DelayedSACPolicy, each_part, rows_of, seed_of, settings_of
from sb3_said.said.student import Student, as_delayed

Answer = Literal["planner", "expert", "both", "student"]
Value = Literal["critics", "iql"]


class SAIDPolicy(DelayedSACPolicy):
    """The expert's policy with an inpainting planner on top.

    Until the planner is trained the expert answers. A training lets the planner answer, and :meth:`set_answer` whoever
    it names. At a temperature above 0 the expert's critics, or V(s), score the planner's candidates.

    :param planner_kwargs: fields of :class:`~sb3_said.planner.PlannerConfig`
    :param value: who values planned states: ``"critics"``, the expert's, by min Q(s, a); or ``"iql"``, a V(s) of its
        own (see :class:`~sb3_said.offline.ImplicitValues`). Where ``scored_states`` is ``"decision"``, V(s) scores the
        states after the decision: at the present, which all candidates share, it tells no action from another
    :param iql_kwargs: fields of :class:`~sb3_said.offline.IQLConfig`, of that V(s)
    :param student_width: of the hidden layers of a :class:`~sb3_said.said.student.Student`; None for none
    :param policy_kwargs: of :class:`~sb3_said.sac.DelayedSACPolicy`
    :raises ValueError: for an unknown setting of planner or V(s), a delayed task whose critics do not read the true
        state, or a ``state_history`` that the planner is not trained to read
    """

    planner_updates: th.Tensor
    expert_preferred: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        planner_kwargs: dict[str, Any] | None = None,
        value: Value = "critics",
        iql_kwargs: dict[str, Any] | None = None,
        student_width: int | None = None,
        **policy_kwargs: Any,
    ):
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)
        if self.replay_space is not None and not self.delay_reconciled_critic:
            raise ValueError(
                "SAID scores planned states with the expert's critics, which must read true states; "
                "leave delay_reconciled_critic=True."
            )
        config = settings_of(PlannerConfig, planner_kwargs, "The planner")
        self.iql_config: IQLConfig = settings_of(IQLConfig, iql_kwargs, "IQL")
        self.register_buffer("planner_updates", th.zeros(()))
        self.register_buffer("expert_preferred", th.zeros(()))  # part of the ages that it has, see expert_ages
        self.values: ImplicitValues | None = None
        with th.random.fork_rng(devices=[]):  # the expert learns as it would without a planner
            self.make_planner(config)
            self.set_value(value)
            self.make_student(student_width)
        if has_state_history(observation_space) and self.planner.config.extra_state_probability == 0:
            raise ValueError(
                "Observations have a state_history, but the planner is not trained with extra known states; give "
                "planner_kwargs={'extra_state_probability': 0.5}, or leave state_history=False in "
                "DelayedObservationWrapper."
            )
        self._answer: Answer | None = None
        self._at_once = False

    def make_planner(self, config: PlannerConfig) -> None:
        """Take a new, untrained planner of these settings."""
        self.planner = self.new_planner(config)
        self.planner_updates.zero_()
        self.expert_preferred.zero_()

    def take_planner(self, planner: InpaintingPlanner, config: PlannerConfig) -> None:
        """Let a planner decide from now on, in the way that these settings say."""
        planner.config = config
        self.planner = planner

    def new_planner(self, config: PlannerConfig) -> InpaintingPlanner:
        """Return an untrained planner of these settings, for this policy's spaces."""
        state_space, action_space, max_delay = check_spaces(self.observation_space, self.action_space)
        sizes = state_space.shape[0], action_space.shape[0], max_delay
        return InpaintingPlanner(*sizes, self._scored(config)).to(self.device).requires_grad_(False)

    def set_value(self, value: Value) -> None:
        """Value planned states by the expert's critics, or by a new, untrained V(s).

        :raises ValueError: for another name
        """
        if value not in get_args(Value):
            raise ValueError(f"value is {value!r}, expected one of {', '.join(get_args(Value))}.")
        self.values = None
        if value == "iql":
            sizes = self.planner.obs_dim, self.planner.act_dim
            self.values = ImplicitValues(*sizes, self.iql_config).to(self.device)
            self.planner.config = self._scored(self.planner.config)

    def _scored(self, config: PlannerConfig) -> PlannerConfig:
        """Return settings with which V(s), where there is one, tells candidates apart."""
        is_blind = self.values is not None and config.scored_states == "decision"
        return replace(config, scored_states="future") if is_blind else config

    def make_student(self, width: int | None) -> None:
        """Take a new, untrained student, or none."""
        student = None if width is None else Student(self.observation_space, self.action_space, width).to(self.device)
        self.student: Student | None = student

    @property
    def planner_is_trained(self) -> bool:
        """Whether the planner has been trained, and so can answer."""
        return bool(self.planner_updates > 0)

    @property
    def who_answers(self) -> Answer:
        """Who answers ``predict``."""
        if self._answer is not None:
            return self._answer
        if self.student is not None and self.student.preferred:
            return "student"
        if not self.planner_is_trained or len(self.expert_ages) == self.max_delay + 1:
            return "expert"
        return "both" if self.expert_ages else "planner"

    @property
    def answers(self) -> list[Answer]:
        """Who can answer ``predict``."""
        has_student = self.student is not None and self.student.has_learned
        can = {"planner": self.planner_is_trained, "expert": True, "student": has_student}
        can["both"] = self.planner_is_trained and self._ages_are_shared
        return [who for who in get_args(Answer) if can[who]]

    @property
    def expert_ages(self) -> range:
        """The ages at which the expert answers: none for the planner alone, 0..D for the expert alone, in steps."""
        n_ages = self.max_delay + 1
        n = round(float(self.expert_preferred) * n_ages)
        return range(n) if n >= 0 else range(n_ages + n, n_ages)

    @property
    def _ages_are_shared(self) -> bool:
        return 0 < len(self.expert_ages) <= self.max_delay

    def set_answer(self, who: Answer, expert_up_to: int | None = None, expert_from: int | None = None) -> None:
        """Set who answers ``predict`` from now on; a file keeps it.

        With ``"both"``, the one that answers at age D begins each episode, until an observation arrives that an action
        has led to.

        :param who: ``"planner"``, ``"expert"``, ``"student"``, or ``"both"``: planner and expert, each at its own ages
        :param expert_up_to: with ``"both"``, the largest age at which the expert answers, in control steps; the planner
            answers beyond
        :param expert_from: in its place, the smallest age at which the expert answers; the planner answers below
        :raises ValueError: for another name, for a planner that is not trained, for no student, or for ages that leave
            planner or expert without any
        """
        n_ages, part = self.max_delay + 1, float(who == "expert")
        if who == "both":
            n = 0  # how many ages the expert has, below 0 where they are the largest
            if expert_up_to is not None and expert_from is None and expert_up_to in range(self.max_delay):
                n = int(expert_up_to) + 1
            elif expert_from is not None and expert_up_to is None and expert_from in range(1, n_ages):
                n = int(expert_from) - n_ages
            if self.max_delay == 0:
                raise ValueError("Without delay there is no age but 0, at which one answers: 'planner' or 'expert'.")
            if n == 0:
                raise ValueError(
                    f"expert_up_to is {expert_up_to} and expert_from {expert_from}, expected one of them: the expert "
                    f"answers up to an age in 0..{self.max_delay - 1}, or from one in 1..{self.max_delay} on, and the "
                    "planner at the others."
                )
            part = n / n_ages
        elif (expert_up_to, expert_from) != (None, None):
            raise ValueError(
                f"expert_up_to={expert_up_to} and expert_from={expert_from} need set_answer('both'), got {who!r}."
            )
        self._check_answer("planner" if who == "both" else who)
        self.expert_preferred.fill_(part)
        if self.student is not None:
            self.student.preferred.fill_(float(who == "student"))

    @contextmanager
    def answering(self, who: Answer, at_once: bool = False) -> Iterator[None]:
        """Set who answers ``predict`` inside the context, whatever :meth:`set_answer` said.

        :param who: as of :meth:`set_answer`
        :param at_once: answer the rows of a batch together: several times as fast, but an answer then differs by
            rounding from that to the row alone
        :raises ValueError: for another name, for a planner that is not trained, for no student, or for ``"both"`` where
            no age was set
        """
        self._check_answer(who)
        before = self._answer, self._at_once
        self._answer, self._at_once = who, at_once
        try:
            yield
        finally:
            self._answer, self._at_once = before

    @contextmanager
    def preferring_who_answers(self) -> Iterator[None]:
        """Let the buffers that a file keeps say who answers now, as :meth:`answering` set it; restore them after."""
        parts = [self.expert_preferred] if self.student is None else [self.expert_preferred, self.student.preferred]
        before = [part.clone() for part in parts]
        if self._answer == "both" and self.student is not None:
            self.student.preferred.fill_(0.0)  # expert_preferred has the ages already
        elif self._answer is not None and self._answer != "both":
            self.set_answer(self._answer)
        try:
            yield
        finally:
            for part, value in zip(parts, before, strict=True):
                part.copy_(value)

    def _check_answer(self, who: Answer) -> None:
        if who not in get_args(Answer):
            raise ValueError(f"Only the 'planner', the 'expert', 'both' or a 'student' can answer, got {who!r}.")
        if who == "both" and not self._ages_are_shared:
            raise ValueError(
                "Up to which age is the expert to answer? Call set_answer('both', expert_up_to=...) first, or sb3-said "
                "decide --answer both --expert-up-to AGE."
            )
        if who in ("planner", "both") and not self.planner_is_trained:
            raise ValueError("The planner is not trained yet; call learn() or train_planner() first.")
        if who == "student" and "student" not in self.answers:
            raise ValueError("There is no student yet; call distill() first.")

    def value(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return V(s), or min over the critics of Q(s, a), which scores candidates (MCSS).

        :param states: (..., obs_dim)
        :param actions: (..., act_dim) in [-1, 1]; V(s) does not read them
        :return: (...)
        """
        return self.q_value(states, actions) if self.values is None else self.values.value(states)

    def q_value(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return min over the critics of Q(s, a), in units of the rewards that they learn from: (...)."""
        if self.critic.training:  # as SB3 leaves it; Dropout would then draw, and BatchNorm learn from plans
            self.critic.set_training_mode(False)
        flat = states.flatten(0, -2)
        observation: PyTorchObs = flat if self.replay_space is None else {UNDELAYED: flat}
        values = th.cat(self.critic(observation, actions.flatten(0, -2)), dim=1).amin(1).view(states.shape[:-1])
        return values if self.return_scale is None else values * self.return_scale.value

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        if self.who_answers != "student":
            return super().predict(observation, state, episode_start, deterministic)
        assert self.student is not None
        arrays, is_batch = self.obs_to_arrays(observation)  # SB3's predict would set the mode of every module first
        rows = ({key: x[i : i + 1] for key, x in arrays.items()} for i in range(len(arrays["observation"])))
        answers = np.concatenate([self.student.react(row) for row in rows])
        actions = self._checked(self.unscale_action(answers), observation)
        return actions if is_batch else actions[0], state

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        who = self.who_answers
        if not deterministic and who != "both":
            return self._decide(observation, who == "expert", deterministic)
        is_experts = self._is_experts(observation, who)  # (B,)
        if not self._at_once:
            # Each row alone: products of another batch size round differently, and can change the candidate chosen
            rows = zip(rows_of(observation), is_experts, strict=True)
            return th.cat([self._decide(row, bool(is_one), deterministic) for row, is_one in rows])
        actions = th.empty(len(is_experts), self.planner.act_dim, device=self.device)
        for is_one in (True, False):
            if (of_one := is_experts == is_one).any():
                actions[of_one] = self._decide(each_part(itemgetter(of_one), observation), is_one, deterministic)
        return actions

    def _decide(self, observation: PyTorchObs, is_experts: bool, deterministic: bool) -> th.Tensor:
        """Let the expert or the planner decide for all rows: (B, act_dim)."""
        if not is_experts and self.planner.config.decided_by == "plan":
            return self._plan(observation, repeats=deterministic).action
        return super()._predict(observation if is_experts else self._as_if_seen(observation), deterministic)

    def answer_without_noise(self, observation: dict[str, th.Tensor]) -> th.Tensor:
        """Return what the planner decides at temperature 0: (B, act_dim). With ``decided_by="actor"``, ask the actor.

        :param observation: (B, ...) by key, as of a delayed task; without delay its history has no steps
        """
        if self.planner.config.decided_by == "actor":
            is_delayed = isinstance(self.observation_space, spaces.Dict)
            seen = self._as_if_seen(observation) if is_delayed else observation["observation"]
            return super()._predict(seen, deterministic=True)
        known, extra = _known(observation)
        return self.planner.plan(*known, **extra, temperature=0.0).action

    def _as_if_seen(self, observation: PyTorchObs) -> PyTorchObs:
        """Return the present that the planner's first guess has for each row, as an observation of age 0."""
        if not isinstance(observation, dict):
            return observation
        known, extra = _known(observation)
        present, _ = self.planner.guess(*known, **extra)
        return {**observation, "observation": present, "delay": th.zeros_like(observation["delay"])}

    def _is_experts(self, observation: PyTorchObs, who: Answer) -> th.Tensor:
        """Tell for which observations the expert decides: (B,) bool.

        Where both do, the one that decides at age D begins the episode. While s_0 is all that has arrived, the age
        still grows, and a planner that takes over from the expert amid the first steps falls (measured,
        results/agents_before.md).
        """
        if who == "both" and isinstance(observation, dict):
            history, age = observation["action_history"], observation["delay"][:, 0].long()  # (B, D, act_dim), (B,)
            n_before = self.max_delay - age[:, None]  # how many actions a_{t-D..t-d-1}; zeros where s_{t-d} is s_0
            has_led_there = history.ne(0).any(2) & (th.arange(self.max_delay, device=age.device) < n_before)  # (B, D)
            begins, ages = ~has_led_there.any(1), self.expert_ages
            is_its_age = (age >= ages.start) & (age < ages.stop)
            return th.where(begins, self.max_delay in ages, is_its_age)
        n = len(observation["observation"] if isinstance(observation, dict) else observation)
        return th.full((n,), who == "expert", device=self.device)

    @th.no_grad()
    def predict_plan(self, observation: np.ndarray | dict[str, np.ndarray], deterministic: bool = False) -> np.ndarray:
        """Return the action that :meth:`predict` returns, and those planned for the steps after it.

        The later ones are the best candidate's, or with ``choice_factor`` the weighed mean. Where the expert decides
        (with ``"both"``), or its actor on the guessed present, the planner still plans what follows.

        :param observation: (B, ...), as of ``predict``; one alone is a batch of one
        :return: (B, K, act_dim), in the units of the action space. K is the planner's ``horizon``; 1 where the planner
            does not answer
        :raises ValueError: as ``predict``
        """
        who = self.who_answers
        if who not in ("planner", "both"):
            return np.atleast_2d(self.predict(observation, deterministic=deterministic)[0])[:, None]
        self.set_training_mode(False)
        config, planned = self.planner.config, []
        for row in rows_of(self.obs_to_tensor(observation)[0]):
            plan = self._plan(row, repeats=deterministic)
            later = plan.actions[:, :, -config.horizon :]  # (1, N, K, act_dim)
            chosen = choose(later.flatten(2), plan.values, config.choice_factor).view(1, *later.shape[2:])
            is_experts, is_plans = bool(self._is_experts(row, who)), config.decided_by == "plan"
            first = plan.action if is_plans and not is_experts else self._decide(row, is_experts, deterministic)
            planned.append(th.cat([first[:, None], chosen[:, 1:]], dim=1))
        return self._checked(self.unscale_action(th.cat(planned).cpu().numpy()), observation)

    def _plan(self, observation: PyTorchObs, repeats: bool = False) -> Plan:
        """Plan for each row.

        :param repeats: derive the noise of each row from the row alone
        """
        known, extra = _known(as_delayed(observation, self.planner.act_dim))
        chooses = self.planner.config.temperature > 0  # else there is no noise and one candidate
        return self.planner.plan(
            *known,
            value_fn=self.value if chooses else None,
            noise=th.stack([*map(self._noise_of, rows_of(observation))]) if chooses and repeats else None,
            **extra,
        )

    def _noise_of(self, row: PyTorchObs) -> th.Tensor:
        """Return noise that the observation alone decides: (N, L, obs_dim + act_dim).

        It repeats where the observation does, and the global random state stays as it is. One noise for all
        observations would favour the same few candidates at every step, and their errors would add up.
        """
        planner = self.planner
        shape = (planner.config.n_candidates, planner.window_length, planner.obs_dim + planner.act_dim)
        return th.randn(shape, generator=th.Generator().manual_seed(seed_of(row)))

    def warmup(self, batch_size: int = 1) -> None:
        """Run a few dummy predictions, so that the next decision takes no longer than any later one.

        The first calls choose a CPU's kernels and record a GPU's graph.

        :param batch_size: number of observations in a later ``predict``
        :raises ValueError: for a batch_size below 1
        """
        if batch_size < 1:
            raise ValueError(f"batch_size is {batch_size}, expected at least 1.")
        space = self.observation_space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        arrays = {key: np.zeros((batch_size, *(part.shape or ())), np.float32) for key, part in parts.items()}
        on_gpu = self.device.type == "cuda"
        calls = range(EAGER_CALLS + 1 if on_gpu else 1)
        players: tuple[Answer, ...] = ("expert", "planner") if self.who_answers == "both" else (self.who_answers,)
        with th.random.fork_rng(devices=[self.device] if on_gpu else []):  # later draws stay the same
            for who, delay, deterministic, _ in product(players, (0, self.max_delay), (True, False), calls):
                if "delay" in arrays:
                    arrays["delay"][:] = delay
                obs = arrays if isinstance(space, spaces.Dict) else arrays["observation"]
                with self.answering(who):
                    self.predict(obs, deterministic=deterministic)

    def save(self, path: PathOrFile) -> None:
        """Write all that ``predict`` needs to a file. Who answers now will answer there: amid ``learn`` the expert.

        :param path: where to write, as it is. Or a binary file object.
        :raises ValueError: if a constructor argument cannot be written without pickle
        """
        with self.preferring_who_answers():
            super().save(path)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "planner_kwargs": self.planner.config.to_dict(),
            "value": "critics" if self.values is None else "iql",
            "iql_kwargs": asdict(self.iql_config),
            "student_width": None if self.student is None else self.student.width,
        }


def _known(parts: dict[str, th.Tensor]) -> tuple[tuple[th.Tensor, th.Tensor, th.Tensor], dict[str, Any]]:
    """Return what :class:`~sb3_said.planner.InpaintingPlanner` is told of delayed observations (B, ...).

    :return: state, action history and age; and the states of a state history by name, where there is one
    """
    state, history, delay = (parts[key] for key in KEYS)
    return (state, history, delay[:, 0].long()), {key: parts[key] for key in STATE_KEYS if key in parts}
