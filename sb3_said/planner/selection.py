"""Monte-Carlo sampling with selection (MCSS): what candidates are worth, and which decision that makes."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

#: Maps states (B, N, K, obs_dim) and actions (B, N, K, act_dim), in environment units, to values (B, N, K)
ValueFn = Callable[[th.Tensor, th.Tensor], th.Tensor]


def value_of(value_fn: ValueFn, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Return the value of each step: (B, N, K) float32.

    :raises ValueError: when the function returns another shape
    """
    values = value_fn(states, actions).float()
    if values.shape != states.shape[:-1]:
        raise ValueError(
            f"value_fn returned the shape {tuple(values.shape)}, expected one value per state, "
            f"{tuple(states.shape[:-1])}: drop a last dimension of 1."
        )
    return values


def mean_value(
    value_fn: ValueFn, states: th.Tensor, actions: th.Tensor, first: th.Tensor, end: th.Tensor, skipped: int
) -> th.Tensor:
    """Return the mean value of each candidate's steps ``first`` to ``end - 1``: (B, N).

    :param states: (B, N, L, obs_dim)
    :param actions: (B, N, L, act_dim)
    :param first: (B,) int64, at least ``skipped``
    :param end: (B,) int64
    :param skipped: steps at the beginning that nobody counts and that are not valued
    """
    values = value_of(value_fn, states[:, :, skipped:], actions[:, :, skipped:])  # (B, N, L - skipped)
    steps = th.arange(skipped, states.shape[2], device=states.device)
    scored = ((steps >= first[:, None]) & (steps < end[:, None]))[:, None]  # (B, 1, L - skipped)
    return th.where(scored, values, 0.0).sum(-1) / scored.sum(-1)


def choose(actions: th.Tensor, values: th.Tensor, factor: float | None) -> th.Tensor:
    """Return one action of N: the most valuable, or the mean weighed by exp(factor * z), z the standardised values.

    Where the present is uncertain, the most valuable of many is mostly a lucky one, and acting on luck is jittery.

    :param actions: (B, N, act_dim)
    :param values: (B, N)
    :param factor: None for the most valuable
    :return: (B, act_dim)
    """
    if factor is None:
        return actions[th.arange(len(actions), device=actions.device), values.argmax(1)]
    z = (values - values.mean(1, keepdim=True)) / values.std(1, correction=0, keepdim=True).clamp(min=1e-6)
    return ((factor * z).softmax(1)[..., None] * actions).sum(1)
