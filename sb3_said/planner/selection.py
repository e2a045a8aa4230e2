"""Monte-Carlo sampling with selection (MCSS): score the candidates, and choose the decision."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

from sb3_said.planner.config import PlannerConfig

#: Maps states (B, N, K, obs_dim) and actions (B, N, K, act_dim), in environment units, to values (B, N, K)
ValueFn = Callable[[th.Tensor, th.Tensor], th.Tensor]


def score(
    value_fn: ValueFn, config: PlannerConfig, states: th.Tensor, actions: th.Tensor, delay: th.Tensor, shortest: int
) -> th.Tensor:
    """Return the mean value of each candidate over the steps that ``config.scored_states`` names: (B, N).

    :param states: (B, N, L, obs_dim)
    :param actions: (B, N, L, act_dim)
    :param delay: (B,) int64, the indices of the decisions
    :param shortest: a lower bound of the delays; for ``"future"`` no step up to it is valued
    """
    if config.scored_states == "decision":
        rows = th.arange(len(states), device=states.device)
        present, decisions = states[rows, :, delay].mean(1, keepdim=True), actions[rows, :, delay]  # (B, 1 or N, dim)
        return _value_of(value_fn, present.expand(-1, states.shape[1], -1)[:, :, None], decisions[:, :, None])[..., 0]
    before, first = (delay, shortest + 1) if config.scored_states == "future" else (0 * delay, 1)
    values = _value_of(value_fn, states[:, :, first:], actions[:, :, first:])  # (B, N, L - first)
    steps = th.arange(first, states.shape[2], device=states.device)
    scored = ((steps > before[:, None]) & (steps < delay[:, None] + config.horizon))[:, None]  # (B, 1, L - first)
    return th.where(scored, values, 0.0).sum(-1) / scored.sum(-1)


def _value_of(value_fn: ValueFn, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
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


def choose(actions: th.Tensor, values: th.Tensor, factor: float | None) -> th.Tensor:
    """Return one action of N: the most valuable, or the mean weighed by exp(factor * z), z the standardised values.

    Where the present is uncertain, the most valuable of many candidates mostly owes its value to luck.

    :param actions: (B, N, act_dim)
    :param values: (B, N), -inf for a candidate that is not to be taken
    :param factor: None for the most valuable
    :return: (B, act_dim)
    """
    if factor is None:
        return actions[th.arange(len(actions), device=actions.device), values.argmax(1)]
    is_allowed = values > -th.inf
    n = is_allowed.sum(1, keepdim=True)
    allowed = th.where(is_allowed, values, 0.0)
    mean = allowed.sum(1, keepdim=True) / n
    off = th.where(is_allowed, values - mean, 0.0)
    rounding = 1e-6 * allowed.abs().amax(1, keepdim=True)  # alike values have z = 0
    deviation = (off.square().sum(1, keepdim=True) / n).sqrt()
    z = th.where(deviation > rounding, off / deviation, 0.0)
    weights = th.where(is_allowed, factor * z, -th.inf).softmax(1)
    return (weights[..., None] * actions).sum(1)
