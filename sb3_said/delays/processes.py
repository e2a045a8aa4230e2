"""How old the newest observation is: delay processes, seeded by the wrapper that owns them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class DelayProcess(Protocol):
    """Draws the observation delay of an episode."""

    @property
    def max_delay(self) -> int:
        """Largest delay that can be drawn, in control steps."""

    def sample(self, rng: np.random.Generator) -> int:
        """Draw the delay of the coming episode, in control steps."""


@dataclass(frozen=True)
class FixedDelay:
    """The same delay in every episode.

    :param delay: age of the newest observation, in control steps, >= 0
    :raises ValueError: for a negative delay
    """

    delay: int

    def __post_init__(self) -> None:
        if self.delay < 0:
            raise ValueError(f"A delay is a number of control steps >= 0, got {self.delay}.")

    @property
    def max_delay(self) -> int:
        return self.delay

    def sample(self, rng: np.random.Generator) -> int:
        return self.delay


@dataclass(frozen=True)
class EpisodeDelay:
    """A delay drawn uniformly from ``low..high`` (both included) at every reset.

    :param low: smallest delay, in control steps, >= 0
    :param high: largest delay, in control steps, >= low
    :raises ValueError: for a negative or empty range
    """

    low: int
    high: int

    def __post_init__(self) -> None:
        if not 0 <= self.low <= self.high:
            raise ValueError(f"A delay range is (low, high) with 0 <= low <= high, got ({self.low}, {self.high}).")

    @property
    def max_delay(self) -> int:
        return self.high

    def sample(self, rng: np.random.Generator) -> int:
        return int(rng.integers(self.low, self.high + 1))


def make_process(delay: int | tuple[int, int] | DelayProcess) -> DelayProcess:
    """Turn what a user writes as ``delay`` into a process.

    :param delay: an integer (fixed), a ``(low, high)`` pair (drawn anew each episode) or a process
    :raises ValueError: for anything else
    """
    if _is_integer(delay):
        return FixedDelay(int(delay))  # type: ignore[arg-type]
    if isinstance(delay, (tuple, list)) and len(delay) == 2 and all(_is_integer(x) for x in delay):
        return EpisodeDelay(int(delay[0]), int(delay[1]))
    if hasattr(delay, "sample") and hasattr(delay, "max_delay"):
        return delay  # type: ignore[return-value]  # a protocol with a property cannot be narrowed to by hasattr
    raise ValueError(f"`delay` is an integer, a (low, high) pair of integers or a delay process, got {delay!r}.")


def _is_integer(x: object) -> bool:
    return isinstance(x, (int, np.integer)) and not isinstance(x, bool)
