"""Delay processes written as text, for command lines and YAML: no code is run to read one."""

from __future__ import annotations

import ast
from typing import Any

from sb3_said.delays import combined, processes
from sb3_said.delays.processes import DelayProcess

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


def parse_process(text: str) -> int | tuple[int, int] | DelayProcess:
    """Read a delay as Python would write it: a number, a pair, or a process. A process's ``repr`` reads back.

    :param text: such as ``"4"``, ``"WIFI_20MS"`` or ``"DroppedPackets(UniformDelay(0, 8), p=0.1)"``
    :raises ValueError: for anything but these names, calls of them, and numbers

    >>> parse_process("DroppedPackets(4, p=0.1)")
    DroppedPackets(process=4, p=0.1, max_losses=4)
    """
    try:
        return _evaluate(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, TypeError) as error:
        raise ValueError(
            f"{text!r} is no delay: {error}. Write it as in docs/delays.md, such as {_EXAMPLE}."
        ) from error


_EXAMPLE = '"DroppedPackets(UniformDelay(0, 8), p=0.1)"'


def _evaluate(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CLASSES:
        keywords = {str(k.arg): _evaluate(k.value) for k in node.keywords}
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
        f"{ast.unparse(node)!r} is no delay: expected numbers, {', '.join([*CONSTANTS, *CLASSES])}, such as {_EXAMPLE}."
    )
