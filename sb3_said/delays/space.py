"""Which observation and action spaces are served."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces


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
