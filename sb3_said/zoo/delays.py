"""Delays on the command line."""

from __future__ import annotations

import argparse

from sb3_said.delays.processes import age_range, make_process

#: A delay as YAML has it: control steps, [low, high], or a process as text; None for a task without the wrapper.
Delay = int | list[int] | str | None

DELAY_HELP = (
    "age of observations in control steps; LOW HIGH: drawn anew each episode; or a process of docs/delays.md, such as "
    "'DroppedPackets(4, p=0.1)'"
)


def add_delay(parser: argparse.ArgumentParser, default: str, name: str = "--delay", help: str = DELAY_HELP) -> None:
    """Give a command line an option of a delay, to be read by ``read_delay``.

    :param default: what leaving it out means
    """
    parser.add_argument(name, nargs="+", default=[], metavar="STEPS", help=f"{help} (default: {default})")


def read_delay(words: list[str]) -> Delay:
    """Return what was given to ``--delay`` in the form that YAML and the wrapper take.

    :raises ValueError: for anything but N, LOW HIGH or one process
    """
    if not words:
        return None
    numbers = [int(word) for word in words if word.removeprefix("-").isdigit()]
    if len(words) > 2 or len(numbers) not in (0, len(words)) or (not numbers and len(words) > 1):
        raise ValueError(f"--delay takes N, or LOW HIGH, or one process in quotes, got {' '.join(words)}.")
    delay: int | list[int] | str = words[0] if not numbers else numbers[0] if len(numbers) == 1 else numbers
    make_process(delay)
    return delay


def largest_delay(delay: Delay) -> int:
    """Return the largest age that a delay can bring, 0 without one."""
    return 0 if delay is None else make_process(delay).max_delay


def is_always(delay: Delay, age: int) -> bool:
    """Say whether a delay makes all observations amid an episode as old as this."""
    return age_range(0 if delay is None else delay) == (age, age)
