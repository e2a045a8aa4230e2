"""Delay processes: how long the packets of an episode take, for observations and for actions.

A process is an immutable description, so environments can share it and tests can compare it. The iterator that
``sample`` returns holds what changes within an episode; the caller's generator gives the random numbers.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np


class DelayProcess(Protocol):
    """Draws how many control steps the packets of an episode take; see :func:`smallest_age` for ``min_delay``."""

    @property
    def max_delay(self) -> int:
        """Largest age that can occur, in control steps."""

    def sample(self, rng: np.random.Generator) -> int | Iterator[int | None]:
        """Draw the delays of the coming episode, in control steps.

        :return: one integer for all packets of the episode, or an iterator over the delays of the packets sent at
            steps 1, 2, ..., with None for a packet that never arrives
        """


#: Longest delay, in control steps: ten seconds at 1 kHz. Each episode has a buffer as long as its largest delay.
LARGEST_DELAY = 10_000

#: What a user may write where a process is expected; text is read in ``text.py``.
Delay = int | Sequence[int] | DelayProcess


@dataclass(frozen=True)
class BaseProcess:
    """What the processes of this package share: the smallest and the largest age amid an episode."""

    min_delay: int = field(init=False, repr=False, compare=False)
    max_delay: int = field(init=False, repr=False, compare=False)

    def _set(self, **values: Any) -> None:
        """Set fields of the frozen instance, from ``__post_init__`` only.

        :raises ValueError: for a ``max_delay`` above ``LARGEST_DELAY``
        """
        if values.get("max_delay", 0) > LARGEST_DELAY:
            raise ValueError(
                f"Delays are at most {LARGEST_DELAY} control steps, got {values['max_delay']}; use control steps and "
                "not other units, as in_steps(milliseconds, control_period) gives them."
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class FixedDelay(BaseProcess):
    """The same delay in every episode.

    :param delay: in control steps, >= 0
    :raises ValueError: for a negative or fractional delay
    """

    delay: int

    def __post_init__(self) -> None:
        if not (_is_integer(self.delay) and self.delay >= 0):
            raise ValueError(f"A delay is a whole number of control steps >= 0, got {self.delay}.")
        delay = int(self.delay)
        self._set(delay=delay, min_delay=delay, max_delay=delay)

    def sample(self, rng: np.random.Generator) -> int:
        return self.delay


@dataclass(frozen=True)
class _Range(BaseProcess):
    """A process over ``low..high``."""

    low: int
    high: int

    def __post_init__(self) -> None:
        if not (_is_integer(self.low) and _is_integer(self.high) and 0 <= self.low <= self.high):
            raise ValueError(
                f"A delay range is (low, high), whole numbers with 0 <= low <= high, got ({self.low}, {self.high})."
            )
        low, high = int(self.low), int(self.high)
        self._set(low=low, high=high, min_delay=low, max_delay=high)


@dataclass(frozen=True)
class EpisodeDelay(_Range):
    """A delay drawn uniformly from ``low..high`` (both included) at every reset.

    :param low: smallest delay, in control steps, >= 0
    :param high: largest delay, in control steps, >= low
    :raises ValueError: for a negative, fractional or empty range
    """

    def sample(self, rng: np.random.Generator) -> int:
        return int(rng.integers(self.low, self.high + 1))


@dataclass(frozen=True)
class UniformDelay(_Range):
    """A delay drawn uniformly from ``low..high`` (both included) for every packet; else as :class:`EpisodeDelay`."""

    def sample(self, rng: np.random.Generator) -> Iterator[int]:
        while True:
            yield int(rng.integers(self.low, self.high + 1))


@dataclass(frozen=True)
class DistributionDelay(BaseProcess):
    """A delay drawn for every packet from any distribution P(t) over 0..D (the DOMDP of the paper, section 2).

    :param probabilities: P(0), P(1), ..., P(D)
    :raises ValueError: for probabilities that are negative or do not add up to 1

    >>> DistributionDelay((0.5, 0.25, 0.25)).max_delay
    2
    """

    probabilities: tuple[float, ...]

    def __post_init__(self) -> None:
        p = np.asarray(self.probabilities, dtype=np.float64)
        if not (p.ndim == 1 and np.all(p >= 0) and abs(p.sum() - 1.0) < 1e-6):
            raise ValueError(
                f"The probabilities of the delays 0, 1, 2, ... are >= 0 and add up to 1, got {self.probabilities}."
            )
        occurs = np.flatnonzero(p).tolist()
        # A tuple, since a list (from YAML) has no hash.
        self._set(probabilities=tuple(p.tolist()), min_delay=occurs[0], max_delay=occurs[-1])

    @classmethod
    def from_samples(cls, delays: Sequence[int] | np.ndarray) -> DistributionDelay:
        """Take the distribution of measured delays, in control steps (see ``in_steps``).

        :param delays: (n,)
        :raises ValueError: for no delays, for negative, fractional or too large ones, or an array of another shape
        """
        drawn = np.asarray(delays)
        is_counts = drawn.ndim == 1 and drawn.size > 0 and np.issubdtype(drawn.dtype, np.integer)
        if not (is_counts and 0 <= drawn.min() and drawn.max() <= LARGEST_DELAY):
            raise ValueError(
                f"Measured delays are a list of whole numbers of control steps in 0..{LARGEST_DELAY}, got {drawn}; "
                "in_steps(milliseconds, control_period) makes them."
            )
        return cls(tuple(np.bincount(drawn) / len(drawn)))

    def sample(self, rng: np.random.Generator) -> Iterator[int]:
        cumulative = list(itertools.accumulate(self.probabilities[: self.max_delay]))
        while True:
            yield bisect.bisect_right(cumulative, rng.random())


#: 10,000 measured WiFi communications in control steps of 20 ms (Bouteiller et al., Reinforcement Learning with Random
#: Delays, ICLR 2021; the first sampler of its code). It stands for one direction: observations, or actions.
WIFI_20MS = DistributionDelay((0.0, 0.3082, 0.5927, 0.0829, 0.0075, 0.0031, 0.0056))


@dataclass(frozen=True)
class RandomWalkDelay(_Range):
    """A delay that drifts: one step up or down with probability ``move_prob``, starting anywhere in ``low..high``.

    It stays where a move would leave the range, so that all delays are equally frequent in the long run.

    :param low: as of :class:`EpisodeDelay`
    :param high: as of :class:`EpisodeDelay`
    :param move_prob: probability that the delay moves between one packet and the next, half of it upwards
    :raises ValueError: for a negative, fractional or empty range, or a probability outside 0..1
    """

    move_prob: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(move_prob=checked_probability("move_prob", self.move_prob))

    def sample(self, rng: np.random.Generator) -> Iterator[int]:
        delay = int(rng.integers(self.low, self.high + 1))
        while True:
            yield delay
            u = rng.random()
            if u < self.move_prob:
                step = 1 if u < 0.5 * self.move_prob else -1
                delay = min(max(delay + step, self.low), self.high)


def in_steps(milliseconds: float | np.ndarray, control_period: float) -> int | np.ndarray:
    """Convert delays to control steps, rounded up: what arrives between two steps is seen at the later one.

    :param milliseconds: a delay, or an array of them, >= 0
    :param control_period: length of one control step, in milliseconds, > 0
    :raises ValueError: for negative or non-finite delays, a control period that is not positive, and more than
        ``LARGEST_DELAY`` steps

    >>> FixedDelay(in_steps(70, control_period=20))
    FixedDelay(delay=4)
    """
    delays = np.asarray(milliseconds, dtype=np.float64)
    if not (np.all(np.isfinite(delays)) and np.all(delays >= 0) and 0 < control_period < np.inf):
        raise ValueError(
            f"Delays are >= 0 ms and the control period is > 0 ms, got {milliseconds} and {control_period}."
        )
    steps = np.ceil(np.round(delays / control_period, 9))  # 0.3 / 0.1 is a bit above 3
    if np.any(steps > LARGEST_DELAY):
        raise ValueError(
            f"Delays are at most {LARGEST_DELAY} control steps, got {milliseconds} ms with a control period of "
            f"{control_period} ms."
        )
    steps = steps.astype(np.int64)
    return int(steps) if steps.ndim == 0 else steps


def as_process(delay: Delay) -> DelayProcess:
    """Make a process of a number or a pair; return a process as it is.

    :param delay: an integer (fixed), a ``(low, high)`` pair (drawn anew each episode), or a process
    :raises ValueError: for anything else
    """
    if _is_integer(delay):
        return FixedDelay(delay)  # type: ignore[arg-type]  # an integer, which mypy does not follow
    if isinstance(delay, (tuple, list)) and len(delay) == 2 and all(map(_is_integer, delay)):
        return EpisodeDelay(*delay)
    if hasattr(delay, "sample") and hasattr(delay, "max_delay"):
        return delay
    inside = "; inside another process give it as it is, and the whole as text" if isinstance(delay, str) else ""
    raise ValueError(
        "`delay` is an integer, a (low, high) pair of integers, a delay process (with max_delay and sample(rng)), "
        f"or one of these as text, got {delay!r}{inside}."
    )


def smallest_age(process: DelayProcess) -> int:
    """Return the smallest age amid an episode, in control steps: 0 for a user's own process without ``min_delay``."""
    return getattr(process, "min_delay", 0)


def packet_delays(delay: Delay, rng: np.random.Generator) -> Iterator[int | None]:
    """Draw an episode: the delays of the packets sent at steps 1, 2, ...; None for one that is lost.

    :return: an ``itertools.repeat`` where all packets of the episode take equally long
    :raises ValueError: for anything but integers in 0..max_delay, or when the delays end; the iterator raises it, too
    """
    process = as_process(delay)
    drawn = process.sample(rng)
    if isinstance(drawn, Iterator):
        return _checked(process, drawn)
    return itertools.repeat(_checked_draw(process, drawn))


def _checked(process: DelayProcess, delays: Iterator[int | None]) -> Iterator[int | None]:
    for delay in delays:
        yield None if delay is None else _checked_draw(process, delay)
    raise ValueError(f"{process!r} ran out of delays amid an episode; its iterator must have no end.")


def _checked_draw(process: DelayProcess, delay: int) -> int:
    if not (_is_integer(delay) and 0 <= delay <= process.max_delay):
        raise ValueError(f"{process!r} drew a delay of {delay}, expected a whole number in 0..{process.max_delay}.")
    return int(delay)


def checked_probability(name: str, p: float) -> float:
    """Return a number as a ``float``; refuse one outside 0..1 with a ``ValueError``."""
    if not 0.0 <= p <= 1.0:
        raise ValueError(f"{name} is a probability in 0..1, got {p}.")
    return float(p)


def checked_count(name: str, n: int, smallest: int, largest: int = 10**9) -> int:
    """Return a whole number as an ``int``; refuse anything else, and numbers out of range, with a ``ValueError``."""
    if not (_is_integer(n) and n >= smallest):
        raise ValueError(f"{name} is a whole number >= {smallest}, got {n}.")
    if n > largest:
        raise ValueError(f"{name} is at most {largest}, got {n}.")
    return int(n)


def _is_integer(x: object) -> bool:
    return isinstance(x, (int, np.integer)) and not isinstance(x, bool)
