"""The observation space of a delayed task: its keys, how to build and to read it, and the ages that come with it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

#: Keys of every delayed observation, and those that ``state_history=True`` adds.
KEYS = ("observation", "action_history", "delay")
STATE_KEYS = ("state_history", "state_known")
#: Key of the true state in ``info`` and in sampled observations; never part of an environment's observation space.
UNDELAYED = "undelayed_observation"
#: Key in ``info`` of the action that the task executed, where each action takes a time of its own.
EXECUTED = "executed_action"
#: Advice in errors about a wrapper that changed delayed observations or actions.
WRAPPER_ORDER = (
    "Wrappers that change observations or actions go below DelayedObservationWrapper, around the task itself; "
    "gymnasium.wrappers.FrameStackObservation and FlattenObservation do there what VecFrameStack does."
)


def check_task(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of a task without delay as the Boxes that they have to be.

    :raises ValueError: unless observations are a 1-D Box, and actions a 1-D Box with finite bounds that differ; the
        message says how to get there
    """
    for what, space in (("observation", observation_space), ("action", action_space)):
        if isinstance(space, spaces.Box) and space.shape == (0,):
            raise ValueError(f"The {what} has no entries, got {space}; there is nothing to learn.")
    if isinstance(observation_space, spaces.Dict) and set(KEYS) <= set(observation_space.keys()):
        raise ValueError(
            "The task is in a DelayedObservationWrapper already. One wrapper gives every delay: "
            "DelayedObservationWrapper(task, delay=..., action_delay=...)."
        )
    if not (isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 1):
        flat = "wrap the task in gymnasium.wrappers.FlattenObservation first"
        advice = flat if observation_space.is_np_flattenable else "give the task one, of a fixed length"
        raise ValueError(f"Expected a 1-D Box observation, got {observation_space}; {advice}.")
    if not isinstance(action_space, spaces.Box):
        advice = "so let the agent see one, with gymnasium.wrappers.TransformAction"
        if isinstance(action_space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            advice = "so a task with discrete actions is not supported. Take its continuous variant where it has one"
        raise ValueError(
            f"Expected a 1-D Box action, got {action_space}: agents here, as SAC, answer with real numbers between "
            f"bounds, {advice}."
        )
    if len(action_space.shape) != 1:
        raise ValueError(
            f"Expected a 1-D Box action, got {action_space}; let the agent see it flat, with "
            "gymnasium.wrappers.TransformAction(task, lambda action: action.reshape(shape), "
            "gymnasium.spaces.Box(low.ravel(), high.ravel()))."
        )
    if not action_space.is_bounded():
        raise ValueError(
            f"Actions are scaled by their bounds, which must be finite, got {action_space}; state the range to act in, "
            "with gymnasium.wrappers.TransformAction(task, lambda action: action, gymnasium.spaces.Box(low, high)). "
            "gymnasium.wrappers.ClipAction leaves the space without bounds."
        )
    if not np.all(action_space.low < action_space.high):
        raise ValueError(
            f"Actions are scaled by their bounds, but low and high are equal in {action_space}; leave out the action "
            "entries that cannot vary."
        )
    return observation_space, action_space


def scale_action(action: np.ndarray, action_space: spaces.Box) -> np.ndarray:
    """Scale actions to [-1, 1], the units of an action history; bit for bit the same where the bounds are -1 and 1.

    :param action: (..., act_dim), in the units of the action space; clipped to its bounds
    :param action_space: (act_dim,), with finite bounds
    :return: (..., act_dim) float64

    >>> scale_action(np.array([0.5]), spaces.Box(-2.0, 2.0, (1,)))
    array([0.25])
    """
    center, half = center_and_half(action_space)
    return np.clip((action - center) / half, -1.0, 1.0)


def unscale_action(scaled_action: np.ndarray, action_space: spaces.Box) -> np.ndarray:
    """Return actions in the units of the action space: the inverse of :func:`scale_action`.

    :param scaled_action: (..., act_dim), clipped to [-1, 1]
    :param action_space: (act_dim,), with finite bounds
    :return: (..., act_dim), of the action space's type
    """
    center, half = center_and_half(action_space)
    return within_bounds(center + half * np.clip(scaled_action, -1.0, 1.0), action_space)


def within_bounds(action: np.ndarray, action_space: spaces.Box) -> np.ndarray:
    """Return actions in the type of the action space, clipped to its bounds, and rounded where it holds whole numbers.

    :param action: (..., act_dim), in the units of the action space
    """
    action = np.rint(action) if holds_whole_numbers(action_space) else action
    return np.clip(action, action_space.low, action_space.high).astype(action_space.dtype)


def holds_whole_numbers(space: spaces.Box) -> bool:
    return np.issubdtype(space.dtype, np.integer)


def center_and_half(space: spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of the bounds and half their distance, (act_dim,) float64 each."""
    low, high = 0.5 * space.low.astype(np.float64), 0.5 * space.high.astype(np.float64)
    return low + high, high - low  # halved first: float64 may not hold the whole distance


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


class TaskSpaces(NamedTuple):
    """The spaces of a task without its delay, and its largest delay."""

    state: spaces.Box
    """of true states, (obs_dim,)"""
    action: spaces.Box
    """(act_dim,)"""
    max_delay: int
    """D"""


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> TaskSpaces:
    """Return the spaces of a task and its largest delay D.

    :param observation_space: a 1-D Box, or that of ``DelayedObservationWrapper``
    :param action_space: a 1-D Box with finite bounds
    :raises ValueError: for anything else
    """
    state_space, max_delay = observation_space, 0
    if isinstance(observation_space, spaces.Dict):
        if set(observation_space.keys()) not in (set(KEYS), {*KEYS, *STATE_KEYS}):
            raise ValueError(
                f"Expected the dict observation of DelayedObservationWrapper ({', '.join(KEYS)}), "
                f"got the keys {sorted(observation_space.keys())}; wrap the task in it, after "
                f"gymnasium.wrappers.FlattenObservation where it has a dict of its own. {WRAPPER_ORDER}"
            )
        state_space = observation_space["observation"]
        if not isinstance(state_space, spaces.Box) or len(state_space.shape) != 1:
            raise ValueError(
                f"observation was changed to {state_space}, where DelayedObservationWrapper gives a 1-D Box. "
                f"{WRAPPER_ORDER}"
            )
        max_delay = (observation_space["action_history"].shape or (0,))[0]
    state_box, action_box = check_task(state_space, action_space)
    if isinstance(observation_space, spaces.Dict):
        _check_parts(observation_space, state_box, action_box, max_delay)
    return TaskSpaces(state_box, action_box, max_delay)


def _check_parts(space: spaces.Dict, state_box: spaces.Box, action_box: spaces.Box, max_delay: int) -> None:
    """:raises ValueError: for a part of a delayed space that ``DelayedObservationWrapper`` does not give"""
    shapes = {"observation": state_box.shape, "action_history": (max_delay, *action_box.shape), "delay": (1,)}
    if has_state_history(space):
        shapes |= {"state_history": (max_delay, *state_box.shape), "state_known": (max_delay,)}
    for key, shape in shapes.items():  # before a space is built for this max_delay, which may be 1e9
        if space[key].shape != shape:
            raise ValueError(
                f"{key} was changed to {space[key]}, where DelayedObservationWrapper gives the shape {shape}. "
                f"{WRAPPER_ORDER}"
            )
    for key, box in delayed_space(state_box, action_box, max_delay, has_state_history(space)).items():
        is_state = key in ("observation", "state_history")  # VecNormalize may set their bounds
        if not is_state and space[key] != box:
            raise ValueError(
                f"{key} was changed to {space[key]}, where DelayedObservationWrapper gives {box}. {WRAPPER_ORDER}"
            )


def has_state_history(observation_space: spaces.Space[Any]) -> bool:
    """Tell whether a space is of a ``DelayedObservationWrapper`` with ``state_history=True``."""
    return isinstance(observation_space, spaces.Dict) and "state_history" in observation_space.spaces


def ages_of(env: Any) -> list[int]:
    """Return the ages that observations can have amid the episodes of an environment, [0] where nothing is delayed.

    A simulator that delays observations by itself may state them as ``age_range``; else every age may occur.

    :param env: one environment, or an SB3 ``VecEnv`` of several, whose delays may differ; None has no delay
    """
    if env is None or not isinstance(env.observation_space, spaces.Dict):  # a plain task may have an age_range, too
        return [0]
    if not has_attribute(env, "age_range"):
        return [*range(check_spaces(env.observation_space, env.action_space).max_delay + 1)]
    ranges = env.get_attr("age_range") if is_vectorised(env) else [env.get_wrapper_attr("age_range")]
    return sorted({age for low, high in ranges for age in range(low, high + 1)})


def is_vectorised(env: Any) -> bool:
    """Tell whether this is an SB3 ``VecEnv``, which this room does not import, or one environment."""
    return hasattr(env, "get_attr")


def has_attribute(env: Any, name: str) -> bool:
    """Tell whether an environment, or each of a ``VecEnv``'s, has an attribute; False if it cannot be asked.

    Ask before reading: to read a missing attribute ends the workers of a ``SubprocVecEnv``.
    """
    try:
        return env.has_attr(name) if is_vectorised(env) else env.has_wrapper_attr(name)
    except NotImplementedError:  # from a simulator; SB3 itself takes an AttributeError for a no
        return False


def check_one_max_delay(env: Any) -> None:
    """Refuse environments whose action histories differ in length, so that no batch could hold them.

    :param env: as of :func:`ages_of`
    :raises ValueError: where the ``max_delay`` of an SB3 ``VecEnv``'s environments differ
    """
    is_delayed = isinstance(env.observation_space, spaces.Dict)  # a plain task may have a max_delay of its own
    if is_delayed and is_vectorised(env) and has_attribute(env, "max_delay"):
        largest = env.get_attr("max_delay")
        if len(set(largest)) > 1:
            raise ValueError(
                f"The environments' action histories must be of one length, but their max_delay are {largest}; give "
                f"each of them DelayedObservationWrapper(..., max_delay={max(largest)})."
            )


def written_ages(ages: list[int]) -> str:
    """Write ages as a reader would, ``0..8`` or ``2, 5``."""
    is_range = len(ages) > 2 and ages == list(range(ages[0], ages[-1] + 1))
    return f"{ages[0]}..{ages[-1]}" if is_range else ", ".join(map(str, ages))
