"""The observation space of a delayed task: its keys, how to build and to read it, and the ages that come with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

#: Keys of every delayed observation, and those that ``state_history=True`` adds.
KEYS = ("observation", "action_history", "delay")
STATE_KEYS = ("state_history", "state_known")
#: Key of the true state in ``info`` and in sampled observations; never part of an environment's observation space.
UNDELAYED = "undelayed_observation"
#: Key in ``info`` of what the task was given, where that is not the action sent last.
EXECUTED = "executed_action"


def check_task(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of a task without delay as the Boxes that they have to be.

    :raises ValueError: unless observations are a 1-D Box, and actions a 1-D Box with finite bounds that differ
    """
    for what, space in (("observation", observation_space), ("action", action_space)):
        if isinstance(space, spaces.Box) and space.shape == (0,):
            raise ValueError(f"The {what} has no entries, got {space}; there is nothing to learn.")
    if not (isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 1):
        raise ValueError(
            f"Expected a 1-D Box observation, got {observation_space}; wrap the task in "
            "gymnasium.wrappers.FlattenObservation first."
        )
    if not (isinstance(action_space, spaces.Box) and len(action_space.shape) == 1 and action_space.is_bounded()):
        raise ValueError(
            f"Expected a 1-D Box action with finite bounds, got {action_space}; actions are continuous here and "
            "scaled by their bounds, so give the task such an action space."
        )
    if not np.all(action_space.low < action_space.high):
        raise ValueError(
            f"Actions are scaled by their bounds, but low and high are equal in {action_space}; leave out the action "
            "entries that cannot vary."
        )
    return observation_space, action_space


def delayed_space(
    state_space: spaces.Box, action_space: spaces.Box, max_delay: int, state_history: bool = False
) -> spaces.Dict:
    """Build the observation space of a delayed task, float32 throughout.

    :param state_space: (obs_dim,), of the task
    :param action_space: (act_dim,), of the task
    :param max_delay: D, length of the action history
    :param state_history: whether it holds the states that were handed out
    """
    with np.errstate(over="ignore"):  # a float64 bound beyond float32 becomes infinite
        low, high = (bound.astype(np.float32) for bound in (state_space.low, state_space.high))
    parts: dict[str, spaces.Space[Any]] = {
        "observation": spaces.Box(low, high, dtype=np.float32),
        "action_history": spaces.Box(-1.0, 1.0, (max_delay, *action_space.shape), np.float32),
        "delay": spaces.Box(0.0, float(max_delay), (1,), np.float32),
    }
    if state_history:  # with zeros where a state is unknown
        low, high = (np.tile(bound, (max_delay, 1)) for bound in (np.minimum(low, 0), np.maximum(high, 0)))
        parts["state_history"] = spaces.Box(low, high, dtype=np.float32)
        parts["state_known"] = spaces.Box(0.0, 1.0, (max_delay,), np.float32)
    return spaces.Dict(parts)


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> tuple[spaces.Box, int]:
    """Return the space of true states and the largest delay D of a task.

    :param observation_space: a 1-D Box, or that of ``DelayedObservationWrapper``
    :param action_space: a 1-D Box with finite bounds
    :raises ValueError: for anything else
    """
    state_space, max_delay = observation_space, 0
    if isinstance(observation_space, spaces.Dict):
        if set(observation_space.keys()) not in (set(KEYS), {*KEYS, *STATE_KEYS}):
            raise ValueError(
                f"Expected the dict observation of DelayedObservationWrapper ({', '.join(KEYS)}), "
                f"got the keys {sorted(observation_space.keys())}; wrap the task in it."
            )
        state_space = observation_space["observation"]
        max_delay = (observation_space["action_history"].shape or (0,))[0]
    state_box, action_box = check_task(state_space, action_space)
    if isinstance(observation_space, spaces.Dict):
        expected = {"observation": state_box.shape, "action_history": (max_delay, *action_box.shape), "delay": (1,)}
        if has_state_history(observation_space):
            expected |= {"state_history": (max_delay, *state_box.shape), "state_known": (max_delay,)}
        given = {key: part.shape for key, part in observation_space.items()}
        if given != expected:
            raise ValueError(
                f"The parts of a delayed observation have the shapes {given}, expected {expected}; leave them as "
                "DelayedObservationWrapper makes them."
            )
    return state_box, max_delay


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
