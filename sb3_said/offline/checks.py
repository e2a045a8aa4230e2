"""What a log must be like before anything learns from it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_said.delays.space import center_and_half, scale_action

ACTION_TOLERANCE = 1e-3  # of half the range: rounding in float32 or a tanh may exceed the bounds by so much

#: observations, actions, rewards, terminated, ends and next_observations of N rows
Columns = dict[str, np.ndarray]


def check_task(name: str, given: str | None, changes: str, env_id: str | None) -> None:
    """Refuse data of another task; warn of data of another version of the task, or of a changed one.

    :param given: id of the data's task, None where the data does not say
    :param changes: how the data's task was changed, empty where it was not
    :param env_id: id of the task to learn, None where it has none
    :raises ValueError: for another task; the message names both
    """
    if changes:
        warnings.warn(f"{name} is of a task changed by {changes}: learn for one that is changed alike.", stacklevel=3)
    if given is None or env_id is None or given == env_id:
        return
    message = f"{name} is of {given}, and the task is {env_id}"
    if len({task.rpartition("-v")[0] or task for task in (given, env_id)}) > 1:
        raise ValueError(f"{message}; give a dataset of that task.")
    warnings.warn(f"{message}: versions may differ in rewards and observations.", stacklevel=3)


def check_lengths(name: str, columns: Mapping[str, np.ndarray]) -> None:
    """:raises ValueError: for columns of different lengths, and for empty ones"""
    sizes = {key: value.shape[:1] for key, value in columns.items()}
    if len(set(sizes.values())) > 1 or sizes["rewards"] in ((), (0,)):
        raise ValueError(f"The columns of {name} differ in length, or are empty: {sizes}.")


def flags(name: str, key: str, values: Any) -> np.ndarray:
    """Return a column of flags: (N,) bool.

    :raises ValueError: for rows of several numbers; for a number other than 0 and 1, such as NaN, naming its row
    """
    column = _one_a_row(name, key, values)
    _refuse(name, (column != 0) & (column != 1), f"{key} must be 0 or 1", column)
    return column.astype(bool)


def checked(name: str, columns: Columns, state_space: spaces.Box, box: spaces.Box) -> dict[str, np.ndarray]:
    """Return the columns of a ``Dataset``, with actions scaled to [-1, 1].

    :param name: of the source, for errors
    :param box: space of the actions as the log has them
    :raises ValueError: for what is no log of the task; if one row is at fault, the message names it
    """
    columns = {**columns, "rewards": _one_a_row(name, "rewards", columns["rewards"])}
    shapes = {"observations": state_space.shape, "actions": box.shape, "rewards": ()}
    floats = {}
    for key, expected in (shapes | {"next_observations": state_space.shape}).items():
        values = numbers(name, key, columns[key])
        values = values[:, None] if values.ndim == 1 and expected == (1,) else values
        if values.shape[1:] != expected:
            raise ValueError(
                f"{name} has {key} of shape {values.shape[1:]}, and the task {expected}: it is of another task."
            )
        with np.errstate(over="ignore"):  # the check below refuses it with a reason
            floats[key] = np.asarray(values, np.float32)
        is_finite = np.isfinite(floats[key]).reshape(len(values), -1).all(axis=1)
        _refuse(name, ~is_finite, f"{key} must be finite", values)
    states, next_states, actions = (floats[key] for key in ("observations", "next_observations", "actions"))
    ends, terminated = columns["ends"], columns["terminated"]
    center, half = center_and_half(box)
    outside = np.any(np.abs(actions - center) > half * (1 + ACTION_TOLERANCE), axis=1)
    _refuse(name, outside, f"the action is outside the bounds {box}", actions)
    _refuse(name, terminated & ~ends, "the task ended, and the trajectory goes on", terminated)
    follows = continues(states, next_states) | ends[:-1]
    _refuse(name, ~follows, "its next observation is not that of the next row, and no flag ends it", next_states)
    return {
        "states": states,
        "actions": scale_action(actions, box).astype(np.float32),
        "rewards": floats["rewards"],
        "terminated": terminated,
        "ends": ends,
        "finals": next_states[ends],
    }


def continues(states: np.ndarray, next_states: np.ndarray) -> np.ndarray:
    """Tell, for each row but the first, whether the row before led to its state: (N - 1,) bool.

    Logs may round. So an entry may be off by a thousandth of its standard deviation, or by float32's rounding.
    """
    before, after = next_states[:-1].astype(np.float64), states[1:].astype(np.float64)
    is_close = np.abs(before - after) <= 1e-3 * states.std(axis=0, dtype=np.float64) + 1e-6 * np.abs(after)
    return is_close.all(axis=tuple(range(1, is_close.ndim)))


def numbers(name: str, key: str, values: Any) -> np.ndarray:
    """:raises ValueError: for a column that holds no numbers"""
    column = np.asarray(values)
    if column.dtype.kind not in "biuf":
        raise ValueError(f"{name} has {key} of type {column.dtype}, expected numbers.")
    return column


def _one_a_row(name: str, key: str, values: Any) -> np.ndarray:
    """Return a column (N,) or (N, 1) as (N,)."""
    column = numbers(name, key, values)
    if column.size != len(column):
        raise ValueError(f"{name} has {key} of shape {column.shape[1:]}, expected one number in each row.")
    return column.reshape(-1)


def _refuse(name: str, bad: Any, why: str, values: np.ndarray) -> None:
    """:raises ValueError: if any row is bad; the message names the first, and counts them"""
    if (rows := np.flatnonzero(bad)).size:
        more = f" ({rows.size} rows like this)" if rows.size > 1 else ""
        raise ValueError(f"Row {rows[0]} of {name}: {why}, got {values[rows[0]]}{more}.")
