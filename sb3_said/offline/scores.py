"""D4RL's normalised score: 0 is a random policy's return, 100 an expert's."""

from __future__ import annotations

import numpy as np

#: Random and expert returns by D4RL's name of the task; d4rl/infos.py, REF_MIN_SCORE and REF_MAX_SCORE of the v2 sets.
REFERENCE_RETURNS = {
    "halfcheetah": (-280.178953, 12135.0),
    "walker2d": (1.629008, 4592.3),
    "hopper": (-20.272305, 3234.3),
    "ant": (-325.6, 3879.7),
}


def reference_returns(env_id: str) -> tuple[float, float] | None:
    """Return D4RL's (random, expert) returns of a task, None where D4RL has none.

    They were measured on the tasks of mujoco-py, so compare scores on ``-v5`` tasks only with each other.

    :param env_id: such as ``"Hopper-v5"``
    """
    return REFERENCE_RETURNS.get(env_id.rpartition("-")[0].lower())


def normalized_score(returns: np.ndarray | float, env_id: str) -> np.ndarray | float:
    """Return 100 (R - random) / (expert - random).

    :raises ValueError: for a task without reference returns
    """
    reference = reference_returns(env_id)
    if reference is None:
        raise ValueError(f"D4RL has no reference returns for {env_id}, only for {', '.join(REFERENCE_RETURNS)}.")
    low, high = reference
    return 100.0 * (returns - low) / (high - low)
