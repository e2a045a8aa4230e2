"""Checks of what a user gives: each refuses with what was given and what was expected."""

from __future__ import annotations

from typing import Any

import torch as th


def check_same(what: str, before: dict[str, Any], now: dict[str, Any], advice: str) -> None:
    """Compare settings.

    :param what: has them, and how it began, for the error
    :param advice: what to do
    :raises ValueError: naming those that differ
    """
    if differing := [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]:
        changes = "; ".join(f"{key} was {before.get(key)} and is now {now.get(key)}" for key in differing)
        raise ValueError(f"{what} with other settings: {changes}. {advice}")


def float_tensor(name: str, values: th.Tensor, shape: tuple[int | None, ...], device: th.device) -> th.Tensor:
    """Return values in float32 on a device.

    :raises ValueError: for another shape, where ``None`` stands for any size, or no rows
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

    :raises ValueError: as there, and for numbers that are not finite
    """
    values = float_tensor(name, values, shape, device)
    if not values.isfinite().all():
        raise ValueError(f"{name} has entries that are NaN or infinite; find out where they come from first.")
    return values


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

    :raises ValueError: for only one of the two, another shape than (B, D, obs_dim), or entries that mean nothing
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
