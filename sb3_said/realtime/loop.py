"""A control loop that counts its own delay: old observations and slow answers both add to it."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_said.delays.processes import checked_count
from sb3_said.delays.space import check_spaces, unscale_action, within_bounds
from sb3_said.realtime.asking import Asking
from sb3_said.realtime.ledger import Ledger, NoAnswer, Request
from sb3_said.realtime.statistics import LoopStatistics

#: How many answers are remembered, and the part of them that the expected number of steps covers.
ANSWERS_REMEMBERED, ANSWERS_COVERED = 100, 0.95
#: A stamp more than AHEAD periods ahead of now is refused. One more than FAR periods away is of another clock.
AHEAD, FAR = 2, 100


class ControlLoop:
    """Runs a model against a robot: observations come in from any thread, an action goes out every period.

    :meth:`act` never blocks. A worker thread asks the model whenever an observation arrives, and once a period if none
    does. If the observation has age a and the answer is expected n steps later, the model plans at age a + n. Its
    action history then ends with the n actions that will be sent meanwhile. Answers are placed by counting actions,
    never by time: an answer begins at the action that it was planned for. If that action has been sent already, the
    plan's later actions are used. A model with ``predict_plan``, such as :class:`~sb3_said.SAID`, plans later actions;
    any other model answers with one action.

    Where no action is planned, the last one is held for ``hold_steps``, then ``safe_action`` is sent for
    ``safe_steps``, then ``act`` raises :class:`NoAnswer`. Once the observation is older than ``max_age``, all
    that is planned is discarded. Until an episode's first answer, the safe action is sent for up to ``hold_steps`` plus
    ``safe_steps`` steps.

    Python runs one thread at a time. Where ``act`` must not wait for the few milliseconds that a model computes in
    Python, give the model a process of its own: :class:`~sb3_said.realtime.ModelProcess`.

    :param model: anything with ``predict``, ``observation_space`` and ``action_space`` of Stable-Baselines3, without a
        memory between its answers
    :param period: of ``act``, in seconds; with ``simulate`` in the unit of ``now``
    :param answer_steps: n, steps that an answer will take; by default as many as cover 95 % of the newest 100
    :param action_delay: from ``act`` to the moment that the action takes effect, in the unit of ``now``
    :param max_age: largest age of an observation to act on, in steps; the model's largest delay by default
    :param hold_steps: steps in a row to repeat the last action, >= 0; None for no limit
    :param safe_action: (act_dim,), in the units of the action space; the middle of its bounds by default
    :param safe_steps: steps in a row to send the safe action, >= 0; None for no limit
    :param deterministic: handed to the model
    :param normalize: applied to batched observations before the model, such as ``VecNormalize.normalize_obs``
    :param count_latency: False for a loop to compare with, which ignores how long answers take: it plans for the step
        at which it asks, and sends one action when the answer arrives
    :param simulate: runs the loop without a thread, so that it can be deterministic. ``act`` asks the model whenever it
        is not busy. An answer that took ``seconds`` keeps it busy for ``simulate(seconds)`` steps; with
        ``lambda seconds: 0`` answers take no time
    :raises ValueError: for a model or a setting that does not fit

    >>> loop = ControlLoop(model, period=0.02)  # doctest: +SKIP
    >>> loop.reset()  # doctest: +SKIP
    >>> loop.observe(observation, capture_time)  # from any thread  # doctest: +SKIP
    >>> action = loop.act()  # every 20 ms  # doctest: +SKIP
    """

    def __init__(
        self,
        model: Any,
        period: float,
        *,
        answer_steps: int | None = None,
        action_delay: float = 0.0,
        max_age: int | None = None,
        hold_steps: int | None = 5,
        safe_action: Any = None,
        safe_steps: int | None = None,
        deterministic: bool = True,
        normalize: Callable[[Any], Any] | None = None,
        count_latency: bool = True,
        simulate: Callable[[float], int] | None = None,
    ):
        state_space, space, max_delay = check_spaces(model.observation_space, model.action_space)
        if normalize is None and getattr(model, "reads_normalized", False):
            raise ValueError(
                "The model reads observations that VecNormalize has normalised: give normalize=venv.normalize_obs, or "
                "normalize=lambda obs: obs where they are so already."
            )
        self._asking = Asking(model, max_delay, deterministic, normalize)
        period, action_delay = float(period), float(action_delay)  # a float32 period would round the times of a clock
        if not (period > 0 and action_delay >= 0):
            raise ValueError(f"period is {period} and action_delay {action_delay}, expected above 0 and at least 0.")
        counts = {"answer_steps": answer_steps, "max_age": max_age, "hold_steps": hold_steps, "safe_steps": safe_steps}
        answer_steps, max_age, hold_steps, safe_steps = (
            None if n is None else checked_count(name, n, 0) for name, n in counts.items()
        )
        if max_age is not None and max_age > max_delay:
            raise ValueError(
                f"max_age is {max_age}, but the model reads ages 0..{max_delay}; train it with a larger max_delay."
            )
        safe = unscale_action(np.zeros(space.shape), space) if safe_action is None else np.asarray(safe_action)
        # Checked before a cast to whole numbers, in which 300 may become 44
        if safe.shape != space.shape or not np.all((space.low <= safe) & (safe <= space.high)):
            raise ValueError(f"safe_action is {safe_action}, expected an action of {space}.")
        safe = within_bounds(safe, space)
        self.period, self.count_latency, self._simulate = period, count_latency, simulate
        self._max_missing = math.inf if hold_steps is None or safe_steps is None else hold_steps + safe_steps
        #: n, steps that the next answer is expected to take.
        self.answer_steps = answer_steps or 0
        self._answer_steps_given = answer_steps is not None
        self._took: deque[int] = deque(maxlen=ANSWERS_REMEMBERED)

        # All that follows is read and written under this lock. Nobody holds it while a model computes, except in a
        # simulation.
        self._changed = threading.Condition(threading.Lock())
        hold = math.inf if hold_steps is None else hold_steps
        max_age = max_delay if max_age is None else max_age
        self._ledger = Ledger(state_space, space, period, max_delay, max_age, action_delay, hold, safe)
        self._statistics = LoopStatistics()
        self._acted = self._offset = math.nan  # time of the last act, and its clock's lead over the monotonic one
        self._is_closing = self._has_heard = self._has_warned = False  # has heard: of an observation since the last act
        self._is_busy, self._n_answers = True, 0  # a simulation has no worker that becomes idle
        self._is_due = False  # whether to ask a busy worker once it has answered
        self._asked: Request | None = None  # what an idle worker is asked
        self._stands = False  # whether the robot stands still until an answer comes
        self._error: BaseException | None = None
        self._in_flight: tuple[Request, np.ndarray, int] | None = None  # a simulation's answer, and its arrival
        if simulate is not None:
            self._warm_up()
            return
        self._worker = threading.Thread(target=self._work, name="ControlLoop", daemon=True)
        self._worker.start()
        self.wait()

    def __enter__(self) -> ControlLoop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_sent(self) -> int:
        """Actions sent in this episode, and so the number of the newest, which a robot returns as ``n_executed``."""
        return self._ledger.n_sent

    @property
    def safe_action(self) -> np.ndarray:
        """The action that is sent where no better one is known: (act_dim,), in the units of the action space."""
        return self._ledger.safe_action.copy()

    def statistics(self) -> LoopStatistics:
        """Return a copy of what was counted so far."""
        with self._changed:
            return self._statistics.copy()

    def reset(self, now: float | None = None) -> None:
        """Begin an episode: nothing has been sent, seen or planned.

        :param now: observations captured before it are of another episode, and are dropped. ``time.monotonic()`` by
            default; in a simulation nothing is dropped by default
        :raises ValueError: for what is no time
        """
        with self._changed:
            clock = time.monotonic()
            began = math.nan if now is None and self._simulate is not None else _time(now, clock)
            self._ledger.start_episode(began)
            self._is_due, self._has_heard, self._asked, self._in_flight = False, False, None, None
            self._stands = False
            self._note(began, clock)
            self._changed.notify_all()

    def observe(self, observation: Any, capture_time: float | None = None, n_executed: int | None = None) -> None:
        """Take an observation, from any thread; one that is no younger than the one at hand is dropped.

        Its age is the number of the newest actions that do not show in it: those that had acted for half a period or
        less at its capture. Stamps and ``now`` must be of one clock. An observation stamped more than two periods ahead
        of now is dropped, too, since it would make all later ones look old. The first stamp that is so far ahead, or
        far behind, is warned of.

        :param observation: (obs_dim,), in the units of the task; copied
        :param capture_time: when it was captured. A repeated stamp means a frozen sensor, whose observation ages. By
            default ``time.monotonic()``, unless ``n_executed`` is given
        :param n_executed: number of the newest action that shows in it, 0 before the first. A robot that reads its
            sensors before it executes a command gives the number of the command before. This number is better than a
            stamp, since nobody needs to know how long a command is on its way
        :raises ValueError: for what is no finite observation, or for more actions than were sent
        """
        if capture_time is None and n_executed is None:
            capture_time = time.monotonic()
        with self._changed:
            now = time.monotonic() + self._offset
            latest, oldest = now + AHEAD * self.period, now - FAR * self.period
            if self._ledger.observe(observation, capture_time, n_executed, latest):
                self._has_heard = True
                self._ask()
            else:
                self._statistics.stale_observations += 1
            is_odd = capture_time is not None and (capture_time > latest or capture_time < oldest)
            warn, self._has_warned = is_odd and not self._has_warned, is_odd or self._has_warned
        if warn:
            warnings.warn(
                f"An observation was captured at {capture_time:.3f}, but now it is {now:.3f}: a sensor that froze, "
                "another clock than that of act(now) and reset(now), or a now that was taken long before act(now): "
                "leave it out. This is said once; stale_observations counts on.",
                stacklevel=2,
            )

    def act(self, now: float | None = None) -> np.ndarray:
        """Return the action to send now, and count it as sent.

        :param now: ``time.monotonic()`` at this call by default; or a count of steps, which makes a simulation
            independent of clocks
        :return: (act_dim,), in the units of the action space
        :raises NoAnswer: where no action has been planned for too long; nothing counts as sent
        :raises RuntimeError: where the model has failed, or the loop is closed
        :raises ValueError: for what is no time, or where stamps and the first ``now`` are of different clocks
        """
        with self._changed:
            clock = time.monotonic()  # only now: another thread may have held the lock for a while
            now = _time(now, clock)
            self._check()
            if (ahead := (self._ledger.captured - now) / self.period) > AHEAD:
                if ahead > FAR and math.isnan(self._acted):
                    raise ValueError(
                        f"An observation was captured at {self._ledger.captured}, but now it is {now}; take both from "
                        "one clock, and the period in its unit."
                    )
                self._ledger.turn_back(now, self._acted + self.period)
            if self._simulate is not None:
                self._pretend(self._simulate)
            step = self._ledger.next_step()
            if step.n_missing > self._max_missing:
                self._stands = True  # until the next action is sent, with which answers are to begin
                self._ask()
                raise NoAnswer(f"No action was planned for {step.n_missing} steps. Counted so far: {self._statistics}")
            self._count(step.n_missing, now)
            self._ledger.send(step, now)
            is_planned = self._ledger.is_planned(self.n_sent + self.answer_steps)
            if not (self._has_heard and (self._is_busy or self._asked or is_planned)):
                self._ask()  # again, as the same observation is a step older now
            self._has_heard = self._stands = False
            self._note(now, clock)
            return step.action.copy()

    def wait(self, timeout: float | None = None) -> bool:
        """Block until the model has answered what has come so far, and tell whether it has.

        Before the first action of an episode the robot stands still and no action is sent meanwhile. So the answer to
        the newest observation begins with that first action.

        :param timeout: in seconds; None for no limit
        :raises RuntimeError: where the model has failed, or the loop is closed
        """
        ends = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            if self._simulate is not None:
                self._check()
                self._stands = self.n_sent == 0
                self._pretend(self._simulate, waits=True)
                self._stands = False
                return True
            is_answered = self._wait(ends)
            if is_answered and self.n_sent == 0 and self._ledger.begins_on < self._ledger.n_seen:
                self._stands = True
                self._ask()
                is_answered = self._wait(ends)
                self._stands = False
            return is_answered

    def close(self, timeout: float | None = 5.0) -> None:
        """Stop the worker, after the answer that it is making.

        :param timeout: seconds to wait for it; a model that hangs longer is left alone, and ends with the program
        """
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._simulate is None and self._worker is not threading.current_thread():
            self._worker.join(timeout)

    def _wait(self, ends: float | None) -> bool:
        enough = self._n_answers + 2  # a worker that is never idle begins its second answer from now after this call

        def is_over() -> bool:
            has_stopped = self._is_closing or self._error is not None
            return has_stopped or self._n_answers >= enough or not (self._is_busy or self._asked)

        is_answered = self._changed.wait_for(is_over, None if ends is None else ends - time.monotonic())
        self._check()
        return is_answered

    def _note(self, now: float, clock: float) -> None:
        self._acted = now
        if self._simulate is None:  # in a simulation time passes in act alone
            self._offset = now - clock

    def _ask(self) -> None:
        """Say what an idle worker is asked; a busy one will be asked when it has answered.

        The request is made here and not when the worker wakes: by then an action may have been sent, and the
        observation be a step too old.
        """
        self._is_due = self._is_busy
        if not self._is_busy:
            self._asked = self._next_request() or self._asked
            self._changed.notify_all()

    def _next_request(self) -> Request | None:
        return self._ledger.request(self.answer_steps if self.count_latency and not self._stands else 0)

    def _check(self) -> None:
        if self._error is not None:
            raise RuntimeError(f"The model failed: {self._error}") from self._error
        if self._is_closing:
            raise RuntimeError("The loop is closed; make another one.")

    def _count(self, n_missing: int, now: float) -> None:
        ledger, counted = self._ledger, self._statistics
        counted.steps += 1
        if ledger.observation is not None:
            counted.count_age(ledger.age)
        if n_missing > 0:
            counted.waiting_steps += not ledger.is_answered
            is_held = n_missing <= ledger.hold_steps
            counted.held_steps += ledger.is_answered and is_held
            counted.safe_steps += ledger.is_answered and not is_held
        if ledger.n_sent > 0:
            counted.count_gap((now - self._acted) / self.period)

    def _work(self) -> None:
        """Answer until the loop is closed, in the worker's thread."""
        try:
            self._warm_up()
            while True:
                with self._changed:
                    self._is_busy = False
                    if self._is_due:
                        self._ask()
                    self._changed.notify_all()
                    self._changed.wait_for(lambda: self._is_closing or self._asked)
                    request, self._asked = self._asked, None
                    if self._is_closing or request is None:
                        return
                    self._is_busy = True
                actions, _ = self._asking.answer(request)
                with self._changed:
                    self._take(request, actions)
                    self._n_answers += 1
        except BaseException as error:  # act raises it, in the thread of the robot
            with self._changed:
                self._error, self._is_busy = error, False
                self._changed.notify_all()

    def _pretend(self, busy_steps: Callable[[float], int], waits: bool = False) -> None:
        """Do what a worker that is busy for some steps would have done before the next action is sent.

        :param waits: whether the robot stands still and waits for the answer
        """
        for may_ask in (True, False):
            # While the robot stands still, no steps are counted: the answer arrives at once
            is_there = waits or self._stands
            if self._in_flight is not None and (is_there or self._in_flight[2] <= self.n_sent):
                request, actions, _ = self._in_flight
                self._in_flight = None
                self._take(request, actions)
            if may_ask and self._in_flight is None and (self._has_heard or not waits):
                asked = self._next_request()
                if asked is not None:
                    actions, seconds = self._asking.answer(asked)
                    self._in_flight = asked, actions, self.n_sent + int(busy_steps(seconds))

    def _take(self, request: Request, actions: np.ndarray) -> None:
        """Splice an answer in, unless its episode has ended or the plan in its history was discarded."""
        ledger = self._ledger
        if request.era != ledger.era:
            return
        if ledger.n_sent > 0 and not self._stands:  # else no steps are counted, however long an answer takes
            took = ledger.n_sent - request.n_sent
            self._statistics.count_answer(took)
            self._took.append(took)
            self._expect(sorted(self._took)[math.ceil(ANSWERS_COVERED * len(self._took)) - 1])
        if self.count_latency:
            self._statistics.late_answers += ledger.splice(actions, request.target) > 0
        else:
            ledger.splice(actions[:1], ledger.n_sent)
        if request.target == 0:
            ledger.begins_on = request.n_seen

    def _expect(self, answer_steps: int) -> None:
        if not self._answer_steps_given:
            self.answer_steps = answer_steps

    def _warm_up(self) -> None:
        """Warm the model up, and expect its first answer to take as long as a warm one."""
        seconds = self._asking.warm_up()
        self._expect(math.ceil(seconds / self.period) if self._simulate is None else int(self._simulate(seconds)))


def _time(now: float | None, clock: float) -> float:
    """Return ``now``, which is the clock's time by default."""
    now = clock if now is None else float(now)
    if not math.isfinite(now):
        raise ValueError(f"now is {now}, expected a finite time.")
    return now
