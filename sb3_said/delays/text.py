"""Delays as users write them on command lines and in YAML, also as text; reading a text runs no code."""

from __future__ import annotations

import ast
from typing import Any

from sb3_said.delays import combined, processes
from sb3_said.delays.processes import Delay, DelayProcess, as_process, smallest_age

#: What a text may call, and the names it may use.
CLASSES: dict[str, type[Any]] = {
    cls.__name__: cls
    for cls in (
        processes.FixedDelay,
        processes.EpisodeDelay,
        processes.UniformDelay,
        processes.DistributionDelay,
        processes.RandomWalkDelay,
        combined.HeldDelay,
        combined.PeriodicPackets,
        combined.DroppedPackets,
        combined.TotalDelay,
    )
}
CONSTANTS: dict[str, DelayProcess] = {"WIFI_20MS": processes.WIFI_20MS}
_EXAMPLE = '"DroppedPackets(UniformDelay(0, 8), p=0.1)"'


def make_process(delay: Delay | str) -> DelayProcess:
    """Turn what a user writes as ``delay`` into a process.

    :param delay: an integer (fixed), a ``(low, high)`` pair (drawn anew each episode), a process, or any of these as
        text (:func:`parse_process`)
    :raises ValueError: for anything else
    """
    return as_process(parse_process(delay) if isinstance(delay, str) else delay)


def age_range(delay: Delay | str) -> tuple[int, int]:
    """Return the smallest and the largest age amid an episode, in control steps.

    At an episode's start ages are smaller. A user's own process without ``min_delay`` may have any up to ``max_delay``.

    :param delay: as :func:`make_process` takes it
    """
    process = make_process(delay)
    return smallest_age(process), process.max_delay


def parse_process(text: str) -> int | tuple[int, int] | DelayProcess:
    """Read a delay as Python would write it: a number, a pair, or a process. A process's ``repr`` reads back.

    :param text: such as ``"4"``, ``"WIFI_20MS"`` or ``"DroppedPackets(UniformDelay(0, 8), p=0.1)"``
    :raises ValueError: for anything but these names, calls of them, and numbers

    >>> parse_process("DroppedPackets((0, 4), p=0.1)")
    DroppedPackets(process=EpisodeDelay(low=0, high=4), p=0.1, max_losses=4)
    """
    try:
        return _evaluate(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, TypeError, RecursionError, MemoryError) as error:  # the last two are of deep nesting
        raise ValueError(
            f"{text!r:.200} is no delay: {error!s:.200}. Write it as in docs/delays.md, such as {_EXAMPLE}."
        ) from error


def as_text(delay: Delay | str) -> Delay | str:
    """Return a delay as JSON can hold it and :func:`make_process` reads it; a user's own process is returned unchanged.

    :param delay: as :func:`make_process` takes it
    """
    if isinstance(delay, (int, str)):
        return delay
    process = make_process(delay)
    try:
        return repr(process) if parse_process(repr(process)) == process else delay
    except ValueError:
        return delay


def _evaluate(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CLASSES:
        keywords: dict[str, Any] = {}
        for keyword in node.keywords:
            if (name := str(keyword.arg)) in keywords:  # Python's compiler refuses this, its parser does not
                raise SyntaxError(f"{name} is given twice")
            keywords[name] = _evaluate(keyword.value)
        return CLASSES[node.func.id](*(_evaluate(arg) for arg in node.args), **keywords)
    if isinstance(node, ast.Name) and node.id in CONSTANTS:
        return CONSTANTS[node.id]
    if isinstance(node, (ast.Tuple, ast.List)):
        return tuple(_evaluate(element) for element in node.elts)
    if isinstance(node, (ast.Constant, ast.UnaryOp)):
        value = ast.literal_eval(node)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return value
    raise ValueError(
        f"{ast.unparse(node)!r:.200} is no delay: expected numbers, {', '.join([*CONSTANTS, *CLASSES])}, "
        f"such as {_EXAMPLE}."
    )
