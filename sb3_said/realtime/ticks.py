"""The beat of a control loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator


def ticks(
    period: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
) -> Iterator[float]:
    """Yield the time now, once a period, without drift.

    The time that the loop's body takes is part of the period. If the body takes longer, the next tick comes at once and
    the beat goes on from there: missed ticks are not made up for.

    :param period: in seconds
    :param clock: steady, in seconds
    :param sleep: waits for some seconds
    :raises ValueError: for a period that is not above 0

    >>> for _ in ticks(0.02):  # doctest: +SKIP
    ...     send(loop.act())
    """
    if not period > 0:
        raise ValueError(f"period is {period}, expected seconds above 0.")
    period, due = float(period), clock()
    while True:
        yield clock()
        due += period
        if (left := due - clock()) > 0:
            sleep(left)
        else:
            due = clock()
