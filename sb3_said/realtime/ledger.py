"""A loop's memory, without clock or thread: what was sent, seen and planned, counted in actions.

Actions are numbered from 0 in every episode; action k leads from state k to state k + 1.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_said.delays.space import scale_action
from sb3_said.realtime.statistics import LARGEST_COUNTED


class NoAnswer(RuntimeError):
    """No action was planned for longer than ``hold_steps`` and ``safe_steps`` allow."""


class Request(NamedTuple):
    """What a model is asked, and for which action."""

    era: int
    """the ledger's at that time; an answer of an earlier era is dropped"""
    n_seen: int
    """observations taken when it is asked"""
    n_sent: int
    """actions sent when it is asked"""
    target: int
    """number of the action that its answer begins with"""
    observation: np.ndarray
    """(obs_dim,) float32, the newest"""
    history: np.ndarray
    """(D, act_dim) float32, in [-1, 1], the actions before the target, with those still to be sent until then"""
    age: int
    """how many of these actions do not show in the observation"""


class Step(NamedTuple):
    """What a step sends."""

    action: np.ndarray
    """(act_dim,), in the units of the action space"""
    n_missing: int
    """steps in a row for which no action was planned, this one included; 0 where one was"""


class Ledger:
    """Keeps the books of one episode at a time.

    :param state_space: (obs_dim,)
    :param action_space: (act_dim,)
    :param period: from one action to the next, in the unit of the stamps
    :param max_delay: D, largest age that the model reads
    :param max_age: largest age of an observation to act on
    :param action_delay: from sending an action to its effect, in the same unit
    :param hold_steps: steps in a row to repeat the last action
    :param safe_action: (act_dim,), sent after ``hold_steps``, and until the first answer
    """

    def __init__(
        self,
        state_space: spaces.Box,
        action_space: spaces.Box,
        period: float,
        max_delay: int,
        max_age: int,
        action_delay: float,
        hold_steps: float,
        safe_action: np.ndarray,
    ):
        self.state_space, self.action_space = state_space, action_space
        self.period, self.action_delay = period, action_delay
        self.max_delay, self.max_age = max_delay, max_age
        self.hold_steps, self.safe_action = hold_steps, safe_action
        self.era = -1  # a new one begins with each episode, and when a plan is discarded
        self.start_episode(math.nan)

    def start_episode(self, began: float) -> None:
        """Forget all. Observations captured before ``began`` (NaN if unknown) are of another episode."""
        self.era += 1
        self.n_sent = self.n_missing = self.n_seen = 0
        self.begins_on = 0  # n_seen of the newest answer that begins at action 0
        self.is_answered = False
        self.observation: np.ndarray | None = None
        self.captured, self._n_shown, self._is_stamped = began, 0, True
        self._last = self.safe_action
        self._planned: dict[int, np.ndarray] = {}
        self._history = np.zeros((self.max_delay, *self.safe_action.shape), np.float32)
        # When the newest actions took effect
        self._effects: deque[float] = deque(maxlen=max(LARGEST_COUNTED, self.max_delay + 1))

    @property
    def age(self) -> int:
        """How many of the newest actions do not show in the newest observation."""
        return self.n_sent - self._n_shown

    def observe(
        self, observation: Any, capture_time: float | None, n_executed: int | None, latest: float = math.inf
    ) -> bool:
        """Take an observation, and tell whether it is younger than the one at hand.

        :param observation: (obs_dim,)
        :param capture_time: when it was captured; None if unknown
        :param n_executed: how many actions show in it; by default those that had acted for more than half a period at
            ``capture_time``, so that an age is rounded to the nearest
        :param latest: latest possible time of a capture; NaN if unknown
        :raises ValueError: for what is no state, or for more actions than were sent
        """
        with np.errstate(over="ignore"):  # refused with a reason next
            state = np.array(observation, np.float32)
        if state.shape != self.state_space.shape or not np.isfinite(state).all():
            raise ValueError(
                f"The observation has the shape {state.shape} and entries {state}, expected finite numbers of the "
                f"shape {self.state_space.shape}; drop the reading where a sensor fails."
            )
        if capture_time is not None:
            capture_time = float(capture_time)
            if not math.isfinite(capture_time):
                raise ValueError(f"capture_time is {capture_time}, expected a time; leave it out if it is not known.")
            is_repeated = capture_time == self.captured and self.observation is not None
            if is_repeated or capture_time < self.captured or capture_time > latest:
                return False
        if n_executed is None:
            assert capture_time is not None  # one of the two is given
            shown = capture_time - self.period / 2
            n_executed = self.n_sent - sum(
                1 for _ in takewhile(lambda effect: effect >= shown, reversed(self._effects))
            )
        elif not (0 <= n_executed <= self.n_sent and n_executed == int(n_executed)):
            raise ValueError(
                f"The observation says that {n_executed} actions were executed, but {self.n_sent} were sent since "
                "reset(); reset the robot's count, too, and drop observations of the episode before."
            )
        n_executed = int(n_executed)  # a packet may hold NumPy integers of few bits, which overflow
        if n_executed < self._n_shown and (capture_time is None or not self._is_stamped):
            return False
        if capture_time is not None:
            self.captured = capture_time
        elif n_executed == self._n_shown < self.n_sent and np.array_equal(state, self.observation):  # type: ignore[arg-type]
            return False  # a frozen sensor; once all is executed, a robot may well stand still
        self.observation, self._n_shown, self._is_stamped = state, n_executed, capture_time is not None
        self.n_seen += 1
        return True

    def turn_back(self, now: float, expected: float) -> None:
        """Go on after a clock went back: move all effects to the new time, as long ago as they were.

        :param now: this moment, in the new time
        :param expected: this moment, in the old time; NaN before the first action
        """
        self.captured = now
        self._effects = deque((effect + now - expected for effect in self._effects), self._effects.maxlen)

    def request(self, n_steps: int) -> Request | None:
        """Return the request for the action to send in ``n_steps`` steps; None if no observation is young enough.

        If the age would be larger than the model reads, the request is for an earlier action.
        """
        if self.observation is None or self.age > self.max_age:
            return None
        n_steps = min(n_steps, self.max_delay - self.age)
        history = self._history
        if n_steps > 0:
            coming = np.stack([step.action for step in self._coming(n_steps)])
            scaled = scale_action(coming, self.action_space).astype(np.float32)
            history = np.concatenate([history, scaled])[-self.max_delay :]
        observation, history = self.observation.copy(), history.copy()  # the model may change its copies
        target = self.n_sent + n_steps
        return Request(self.era, self.n_seen, self.n_sent, target, observation, history, self.age + n_steps)

    def splice(self, actions: np.ndarray, target: int) -> int:
        """Plan actions from a number on, in place of all that was planned from there on.

        :param actions: (K, act_dim), in the units of the action space
        :param target: number of the first of them
        :return: how many of them come too late
        """
        self.is_answered = True
        self._planned = {number: action for number, action in self._planned.items() if number < target}
        self._planned |= {target + k: action for k, action in enumerate(actions) if target + k >= self.n_sent}
        n_late = max(self.n_sent - target, 0)
        if n_late >= len(actions):  # all too late, but still newer than what was sent last
            self._last, self.n_missing = actions[-1], n_late - len(actions)
        return n_late

    def is_planned(self, number: int) -> bool:
        """Tell whether an answer covers an action."""
        return number in self._planned

    def next_step(self) -> Step:
        """Return what to send next. If the observation is too old, all that is planned is discarded.

        A request on its way has those actions in its history, so its answer is discarded, too.
        """
        if self._planned and self.observation is not None and self.age > self.max_age:
            self._planned.clear()
            self.era += 1
        return next(self._coming(1))

    def send(self, step: Step, now: float) -> None:
        """Note that a step was sent at the time ``now``."""
        self._planned.pop(self.n_sent, None)
        self._last, self.n_missing = step
        self._history = np.concatenate([self._history, scale_action(step.action, self.action_space)[None]], axis=0)
        self._history = self._history[1:].astype(np.float32)
        self._effects.append(now + self.action_delay)
        self.n_sent += 1

    def _coming(self, n_steps: int) -> Iterator[Step]:
        """Yield what the next steps will send, unless an answer arrives or the observation gets too old before."""
        action, n_missing = self._last, self.n_missing
        for number in range(self.n_sent, self.n_sent + n_steps):
            if number in self._planned:
                action, n_missing = self._planned[number], 0
            else:
                n_missing += 1
                action = self.safe_action if n_missing > self.hold_steps else action
            yield Step(action, n_missing)
