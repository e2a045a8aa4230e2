"""Checks of what a user gives. Each error says what was given and what was expected."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import fields
from numbers import Integral, Real
from typing import Any

import torch as th


def check_settings(
    config: Any,
    at_least: Mapping[str, float],
    at_most: Mapping[str, float] | None = None,
    choices: Mapping[str, Collection[str]] | None = None,
    may_lack: Collection[str] = (),
) -> None:
    """Check that the settings of a dataclass have the types of their defaults, and lie in their ranges.

    :param at_least: the smallest value of some settings
    :param at_most: the largest value of some settings
    :param choices: the texts that a setting may be; it may also be None where that is its default
    :param may_lack: numbers that may be None
    :raises ValueError: for a value of another type, a number that is not finite or out of range, or another text
    """
    choices, at_most = choices or {}, at_most or {}
    for field in fields(config):
        name, value, default = field.name, getattr(config, field.name), field.default
        if isinstance(default, bool):
            fits, expected = isinstance(value, bool), "True or False"
        elif isinstance(default, int):
            fits, expected = isinstance(value, Integral) and not isinstance(value, bool), "a whole number"
        elif isinstance(default, tuple):
            fits = isinstance(value, (tuple, list)) and len(value) == 2
            fits, expected = fits and all(_is_number(x) and 0 <= x < 1 for x in value), "two numbers in [0, 1)"
        elif name in choices:
            fits, expected = value in choices[name] or value is default is None, f"one of {choices[name]}"
        else:
            fits, expected = _is_number(value) or (name in may_lack and value is None), "a finite number"
        if not fits:
            raise ValueError(f"{name} is {value!r:.50}, expected {expected}.")
        if name in at_least and value is not None and value < at_least[name]:
            raise ValueError(f"{name} is {value}, expected at least {at_least[name]}.")
        if name in at_most and value > at_most[name]:
            raise ValueError(f"{name} is {value}, expected at most {at_most[name]}.")


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def check_intervals(**intervals: int | None) -> None:
    """:raises ValueError: for an interval that is below 1, or no whole number; None is allowed"""
    for name, interval in intervals.items():
        if interval is not None:
            whole(name, interval)


def whole(name: str, given: float, least: int = 1) -> int:
    """Return a count as an int; YAML and ``-params`` may give it as a float.

    :raises ValueError: for a number below ``least``, or no whole number
    """
    if given < least or given % 1 != 0:
        raise ValueError(f"{name} must be a whole number, at least {least}, got {given}.")
    return int(given)


def check_same(what: str, before: dict[str, Any], now: dict[str, Any], advice: str) -> None:
    """Compare settings.

    :param what: how the error begins; it goes on "with other settings"
    :param advice: how the error ends
    :raises ValueError: naming the settings that differ
    """
    if differing := [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]:
        changes = "; ".join(f"{key} was {before.get(key)} and is now {now.get(key)}" for key in differing)
        raise ValueError(f"{what} with other settings: {changes}. {advice}")


def float_tensor(name: str, values: th.Tensor, shape: tuple[int | None, ...], device: th.device) -> th.Tensor:
    """Return values in float32 on a device.

    :raises ValueError: for another shape (``None`` stands for any size), or no rows
    """
    values = th.as_tensor(values, dtype=th.float32, device=device)
    fits = values.dim() == len(shape)
    if not fits or any(want not in (None, have) for have, want in zip(values.shape, shape, strict=True)):
        expected = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(f"{name} has the shape {tuple(values.shape)}, expected ({expected}).")
    if len(values) == 0:
        raise ValueError(f"{name} is empty, expected at least one row.")
    return values


def finite_tensor(name: str, values: th.Tensor, shape: tuple[int | None, ...], device: th.device) -> th.Tensor:
    """Return values as :func:`float_tensor` does.

    :raises ValueError: as it does, and for numbers that are not finite
    """
    values = float_tensor(name, values, shape, device)
    if not values.isfinite().all():
        raise ValueError(f"{name} has entries that are NaN or infinite; find out where they come from first.")
    return values


def check_stored(state: dict[str, Any]) -> None:
    """:raises ValueError: where a training's stored state, nested dicts and lists, has numbers that are not finite"""
    if not _all_finite(state):
        raise ValueError("The stored training holds NaN or infinite numbers; start a new one.")


def _all_finite(tree: Any) -> bool:
    if isinstance(tree, (dict, list, tuple)):
        return all(map(_all_finite, tree.values() if isinstance(tree, dict) else tree))
    if isinstance(tree, th.Tensor):
        return bool(tree.isfinite().all())
    return not isinstance(tree, float) or math.isfinite(tree)


def checked_delay(delay: th.Tensor, batch_size: int, max_delay: int) -> th.Tensor:
    """Return delays as (B,) int64.

    :raises ValueError: for another shape, fractions, or delays outside 0..max_delay
    """
    delay = th.as_tensor(delay)
    if delay.shape != (batch_size,) or delay.is_floating_point():
        raise ValueError(
            f"delay is {delay.dtype} of the shape {tuple(delay.shape)}, expected integers of the shape "
            f"({batch_size},), one per decision or window."
        )
    if not 0 <= int(delay.min()) <= int(delay.max()) <= max_delay:
        raise ValueError(
            f"delay runs from {int(delay.min())} to {int(delay.max())}, expected 0..{max_delay}: build the planner "
            "with a larger max_delay."
        )
    return delay.to(th.int64)


def checked_extra_states(
    history: th.Tensor | None, known: th.Tensor | None, shape: tuple[int, int, int], device: th.device
) -> tuple[th.Tensor, th.Tensor]:
    """Return extra states and which of them are known: (B, D, obs_dim) float32 and (B, D) bool.

    :raises ValueError: for only one of the two, another shape, entries that are not finite, or flags beside 0 and 1
    """
    if history is None and known is None:  # zeros, so that a recorded graph always has these inputs
        return th.zeros(shape, dtype=th.float32, device=device), th.zeros(shape[:2], dtype=th.bool, device=device)
    if history is None or known is None:
        raise ValueError("Only one of state_history and state_known is given; give both or neither.")
    history = finite_tensor("state_history", history, shape, device)
    known = finite_tensor("state_known", known, shape[:2], device)
    if not ((known == 0) | (known == 1)).all():
        raise ValueError("state_known has entries other than 0 and 1, expected 1 where a state is known.")
    return history, known.bool()
