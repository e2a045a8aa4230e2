"""The ages that an environment's observations have."""

from __future__ import annotations

from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv


def ages_of(env: GymEnv | None) -> list[int]:
    """Return the ages that observations can have amid the episodes of an environment, [0] where nothing is delayed.

    :param env: one environment, or several that may have other delays
    """
    # Asked for first: a missing attribute ends the workers of a SubprocVecEnv. A plain task may have one of its own.
    if env is None or not isinstance(env.observation_space, spaces.Dict):
        return [0]
    if isinstance(env, VecEnv):
        ranges = env.get_attr("age_range") if env.has_attr("age_range") else [(0, 0)]
    else:
        ranges = [env.get_wrapper_attr("age_range") if env.has_wrapper_attr("age_range") else (0, 0)]
    return sorted({age for low, high in ranges for age in range(low, high + 1)})


def written_ages(ages: list[int]) -> str:
    """Write ages as a reader would, ``0..8`` or ``2, 5``."""
    is_range = len(ages) > 2 and ages == list(range(ages[0], ages[-1] + 1))
    return f"{ages[0]}..{ages[-1]}" if is_range else ", ".join(map(str, ages))
