"""The observation space of a delayed task: its keys, what fits it, and the ages that come with it."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces

#: Key of the true state in ``info`` and in sampled observations; never part of an environment's observation space.
UNDELAYED = "undelayed_observation"
#: Key in ``info`` of what the task was given, where that is not the action sent last.
EXECUTED = "executed_action"


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> tuple[spaces.Box, int]:
    """Return the space of true states and the largest delay D of a task.

    :param observation_space: a 1-D Box, or that of ``DelayedObservationWrapper``
    :param action_space: a bounded 1-D Box
    :raises ValueError: for anything else
    """
    if not (isinstance(action_space, spaces.Box) and len(action_space.shape) == 1 and action_space.is_bounded()):
        raise ValueError(f"Expected a bounded 1-D Box action space, got {action_space}; use gymnasium's RescaleAction.")
    state_space, max_delay = observation_space, 0
    if isinstance(observation_space, spaces.Dict):
        keys = {"observation", "action_history", "delay"}
        if has_state_history(observation_space):
            keys |= {"state_history", "state_known"}
        if set(observation_space.keys()) != keys:
            raise ValueError(
                "Expected the dict observation of DelayedObservationWrapper (observation, action_history, delay), "
                f"got the keys {sorted(observation_space.keys())}; wrap the task in it."
            )
        state_space = observation_space["observation"]
        max_delay = observation_space["action_history"].shape[0]  # type: ignore[index]
    if not (isinstance(state_space, spaces.Box) and len(state_space.shape) == 1):
        raise ValueError(f"Expected a 1-D Box observation, got {state_space}; use gymnasium's FlattenObservation.")
    return state_space, max_delay


def has_state_history(observation_space: spaces.Space[Any]) -> bool:
    """Tell whether a space is of a ``DelayedObservationWrapper`` with ``state_history=True``."""
    return isinstance(observation_space, spaces.Dict) and "state_history" in observation_space.spaces


def ages_of(env: Any) -> list[int]:
    """Return the ages that observations can have amid the episodes of an environment, [0] where nothing is delayed.

    :param env: one environment, or an SB3 ``VecEnv`` of several that may have other delays; None has no delay
    """
    # Asked for first: a missing attribute ends the workers of a SubprocVecEnv. A plain task may have one of its own.
    if env is None or not isinstance(env.observation_space, spaces.Dict):
        return [0]
    if hasattr(env, "get_attr"):  # a VecEnv, which this room does not import
        ranges = env.get_attr("age_range") if env.has_attr("age_range") else [(0, 0)]
    else:
        ranges = [env.get_wrapper_attr("age_range") if env.has_wrapper_attr("age_range") else (0, 0)]
    return sorted({age for low, high in ranges for age in range(low, high + 1)})


def written_ages(ages: list[int]) -> str:
    """Write ages as a reader would, ``0..8`` or ``2, 5``."""
    is_range = len(ages) > 2 and ages == list(range(ages[0], ages[-1] + 1))
    return f"{ages[0]}..{ages[-1]}" if is_range else ", ".join(map(str, ages))
