"""The observations that a model accepts: as the wrapper gives them, checked before they are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_said.delays.space import STATE_KEYS


def checked_observation(
    observation: Any, space: spaces.Space[Any], as_array: Callable[[Any], np.ndarray] = np.asarray
) -> tuple[dict[str, np.ndarray], bool]:
    """Check observations, and copy them into float32 arrays.

    :param observation: one observation or a batch of them, of any numbers
    :param space: that the model was built for: a Box, or the dict of a delayed task
    :param as_array: turns a part of an observation into an array
    :return: arrays (B, ...) by key, "observation" alone without delay, and whether ``observation`` was a batch
    :raises ValueError: for entries that are no numbers or not finite in float32, another shape, an empty batch,
        other keys, an age outside 0..max_delay, or a ``state_known`` other than 0 and 1
    """
    is_delayed = isinstance(space, spaces.Dict)
    boxes = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    is_dict = isinstance(observation, dict)
    if is_dict and not is_delayed:
        raise ValueError(
            f"The agent was built for a task without delay, got a dict with the keys {list(observation)}; "
            "leave DelayedObservationWrapper out."
        )
    if is_delayed and not (is_dict and set(observation) == set(boxes)):
        given = f"the keys {list(observation)}" if is_dict else type(observation).__name__
        wrapper = "DelayedObservationWrapper"
        if is_dict and set(observation) ^ set(boxes) == set(STATE_KEYS):
            wrapper += f"(..., state_history={'state_history' in boxes})"
        raise ValueError(
            f"The agent was built for dict observations with the keys {sorted(boxes)}, got {given}; "
            f"wrap the task in {wrapper}."
        )
    parts = observation if is_dict else {"observation": observation}
    arrays = {key: _as_float32(key, parts[key], box, as_array) for key, box in boxes.items()}
    batches = {key: None if x.shape == boxes[key].shape else len(x) for key, x in arrays.items()}
    if len(set(batches.values())) > 1:
        raise ValueError(f"The parts of an observation differ in how many there are: {batches}.")
    if is_delayed:
        _check_delayed(arrays, max_delay=(boxes["action_history"].shape or (0,))[0])
    is_batch = batches["observation"] is not None
    return arrays if is_batch else {key: x[None] for key, x in arrays.items()}, is_batch


def _as_float32(name: str, given: Any, space: spaces.Space[Any], as_array: Callable[[Any], np.ndarray]) -> np.ndarray:
    """Copy one element of a space, or a batch, to float32, as the networks read it. The space's bounds are ignored.

    The checks follow the copy, since 1e300 is infinite in float32. Noise that is drawn from an observation is then the
    same for every dtype.

    :raises ValueError: for what is no array of real numbers, another shape, an empty batch, or entries not finite
    """
    try:
        array = as_array(given)
    except ValueError as error:
        raise ValueError(f"{name} cannot be made an array: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, expected real numbers.")
    with np.errstate(over="ignore"):  # refused with a reason next
        values = array.astype(np.float32)
    if values.shape != space.shape and values.shape[1:] != space.shape:
        raise ValueError(
            f"{name} has the shape {values.shape}, expected {space.shape}, or (n_envs, *{space.shape}) for a batch; "
            "the agent was built for another task, or for another largest delay, which "
            "DelayedObservationWrapper(..., max_delay=...) gives."
        )
    if values.shape != space.shape and len(values) == 0:
        raise ValueError(f"{name} is an empty batch, of shape {values.shape}; there is nothing to answer.")
    if not np.isfinite(values).all():
        raise ValueError(
            f"{name} has entries that are NaN or infinite, in float32; find out where they come from first."
        )
    return values


def _check_delayed(arrays: dict[str, np.ndarray], max_delay: int) -> None:
    """Refuse ages, actions and flags that no ``DelayedObservationWrapper`` of this ``max_delay`` hands out."""
    delay, action_history = arrays["delay"], arrays["action_history"]
    if not ((delay >= 0) & (delay <= max_delay) & (delay % 1 == 0)).all():
        raise ValueError(
            f"delay runs from {delay.min():g} to {delay.max():g}, expected whole numbers in 0..{max_delay}: "
            f"the agent was built for max_delay={max_delay}."
        )
    if (np.abs(action_history) > 1.0 + 1e-4).any():
        raise ValueError(
            f"action_history has entries of size {np.abs(action_history).max():g}, expected actions scaled to [-1, 1], "
            "as DelayedObservationWrapper gives them."
        )
    known = arrays.get("state_known")
    if known is not None and ((known != 0) & (known != 1)).any():
        raise ValueError(
            f"state_known runs from {known.min():g} to {known.max():g}, expected 1 where a state of state_history is "
            "known and 0 elsewhere."
        )
