"""What a replay refuses to store: entries that networks would learn from in silence and never recover from."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_said.delays.space import UNDELAYED, WRAPPER_ORDER

OWN_ENVIRONMENT = (
    "If a callback or evaluate_policy steps the training environment during learn(), give it an environment of its own."
)


def check_finite(parts: dict[str, np.ndarray], n_envs: int) -> None:
    """Refuse NaN, and what is infinite in float32.

    :param parts: of one step, each (n_envs, ...), under the name that the message gives it
    :raises ValueError: naming part and environment
    """
    for name, values in parts.items():
        with np.errstate(over="ignore"):  # refused with a reason next
            rows = np.asarray(values, np.float32).reshape(n_envs, -1)
        if not (finite := np.isfinite(rows)).all():
            env = np.argmin(finite.all(axis=1))
            raise ValueError(
                f"The {name} of environment {env} is not finite: {rows[env]}. Nothing of this step was stored; find "
                "out where it comes from, with stable_baselines3.common.vec_env.VecCheckNan around the environments."
            )


def true_states(infos: list[dict[str, Any]], shape: tuple[int, ...]) -> np.ndarray:
    """Return the true state of each environment after its step: (n_envs, obs_dim).

    :param shape: (obs_dim,) of observations
    :raises ValueError: where one is missing, or has another shape
    """
    for env, info in enumerate(infos):
        if UNDELAYED not in info:
            raise ValueError(
                f"The info of environment {env} has no '{UNDELAYED}', without which the true state is unknown; wrap "
                "the task in sb3_said.DelayedObservationWrapper."
            )
        if (given := np.shape(info[UNDELAYED])) != shape:
            raise ValueError(
                f"The true state of environment {env} has the shape {given}, its observation {shape}. {WRAPPER_ORDER}"
            )
    return np.stack([info[UNDELAYED] for info in infos])


def check_order(
    obs: dict[str, np.ndarray], next_obs: dict[str, np.ndarray], continues: np.ndarray, starts: np.ndarray
) -> None:
    """Refuse a transition whose history or age shows that it is out of order.

    :param continues: (n_envs,) bool, whether ``obs`` goes on from the newest row
    :param starts: (n_envs,) bool, whether ``obs`` can be the first of an episode
    :raises ValueError: naming the environment
    """
    history = obs["action_history"]
    if (joined := np.flatnonzero(~continues & ~starts)).size:
        env = joined[0]
        raise ValueError(
            f"The first observation of an episode must have age 0 and an empty past, but that of environment {env} "
            f"has {np.any(history[env] != 0, axis=-1).sum()} actions sent before it and is "
            f"{obs['delay'][env, 0]:.0f} steps old: transitions must be added in the order they happened. Empty or "
            "replace a replay between two calls of learn(), which then starts new episodes, not during one."
        )
    differs = next_obs["action_history"][:, :-1] != history[:, 1:]
    if differs.any():  # a step between the two was not added
        raise ValueError(
            f"The observation after the action of environment {np.argwhere(differs)[0, 0]} does not follow the one "
            "before it: its action_history is not the same with one action more. Transitions must be added in the "
            f"order they happened, and each of them. {OWN_ENVIRONMENT} {WRAPPER_ORDER}"
        )
