"""Constructor arguments and spaces as plain data, and back: the few named things that an agent's file can hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch.nn.modules import activation

from sb3_said.files.archive import SavedFileError

# Tables: nothing is imported or looked up because a file names it.
_CLASSES: dict[str, type] = {
    **{f"torch.nn.{name}": getattr(activation, name) for name in activation.__all__},
    **{f"torch.optim.{name}": cls for name, cls in vars(th.optim).items() if type(cls) is type},
    "FlattenExtractor": FlattenExtractor,
}
_NAMES = {cls: name for name, cls in _CLASSES.items()}
# Constructor arguments, by exact class: a subclass would come back as its parent.
_PARTS: dict[type, Callable[[Any], tuple[Any, ...]]] = {
    ConstantSchedule: lambda s: (s.val,),
    FloatSchedule: lambda s: (s.value_schedule,),
    LinearSchedule: lambda s: (s.start, s.end, s.end_fraction),
    NormalActionNoise: lambda n: (n._mu, n._sigma, np.dtype(n._dtype).str),
    OrnsteinUhlenbeckActionNoise: lambda n: (n._mu, n._sigma, n._theta, n._dt, n.initial_noise, np.dtype(n._dtype).str),
}
_BUILDERS = {cls.__name__: cls for cls in _PARTS}
_SCHEDULES = (ConstantSchedule, FloatSchedule, LinearSchedule)
_NOISE_TYPES = ("<f4", "<f8")


def as_data(value: Any, where: str) -> Any:
    """Return an argument as a tree for :func:`~sb3_said.files.archive.save_tree`.

    :param where: the argument's name, for the error
    :raises ValueError: for a function, or an object or class that is not in the tables of this module
    """
    value = value.item() if isinstance(value, np.str_) else value
    cls = type(value)
    if cls is dict:
        return {key: as_data(item, f"{where}[{key!r}]") for key, item in value.items()}
    if cls in (list, tuple):
        return cls(as_data(item, f"{where}[{index}]") for index, item in enumerate(value))
    if cls in (type(None), bool, int, float, str) or isinstance(value, (np.ndarray, np.generic, th.Tensor)):
        return value
    if cls is TrainFreq:
        return value.frequency, value.unit.value
    if cls is VectorizedActionNoise:  # learn() makes another, for as many environments as there are then
        return as_data(value.base_noise, where)
    if cls.__name__ == "SimpleLinearSchedule" and cls.__module__ == "rl_zoo3.utils":
        value, cls = LinearSchedule(value.initial_value, 0.0, 1.0), LinearSchedule
    if cls in _PARTS:
        return {"@": [cls.__name__, *(as_data(part, where) for part in _PARTS[cls](value))]}
    if isinstance(value, type) and value in _NAMES:
        return {"@": [_NAMES[value]]}
    raise ValueError(f"{where} is {value!r:.100}, which cannot be written without pickle.")


def instead_of(unknown: str, names: Sequence[str]) -> str:
    """Return the end of an error about an unknown name: the nearest of the known names, or all of them."""
    nearest = get_close_matches(unknown, names, n=1)
    return f"did you mean {nearest[0]}?" if nearest else f"it has {', '.join(names)}."


def from_data(node: Any) -> Any:
    """Return the argument that :func:`as_data` was given.

    :raises SavedFileError: for a name that is not in the tables of this module, or parts that do not go with it
    """
    if isinstance(node, (list, tuple)):
        return type(node)(from_data(item) for item in node)
    if not isinstance(node, dict):
        return node
    if "@" not in node:
        return {key: from_data(item) for key, item in node.items()}
    name, *parts = node["@"]
    if name in _BUILDERS:
        cls, parts = _BUILDERS[name], [from_data(part) for part in parts]
        is_noise = issubclass(cls, ActionNoise)
        allowed = (Real, np.ndarray, type(None)) if is_noise else (Real, *_SCHEDULES)
        if any(not isinstance(part, allowed) and not (is_noise and part in _NOISE_TYPES) for part in parts):
            raise SavedFileError(f"its {name} is made of {parts!s:.100}")
        return cls(*parts)
    if name not in _CLASSES or parts:
        raise SavedFileError(f"it names {name!r}, which no file of sb3_said does; loading builds nothing of that name")
    return _CLASSES[name]


def check_noise(noise: Any, action_space: spaces.Space[Any]) -> None:
    """Check action noise from a file against the action space.

    :raises SavedFileError: for another shape, or a negative scale
    """
    if isinstance(noise, (NormalActionNoise, OrnsteinUhlenbeckActionNoise)):
        shapes = {
            np.shape(part)
            for part in (noise._mu, noise._sigma, getattr(noise, "initial_noise", None))
            if part is not None
        }
        if not shapes <= {(), action_space.shape} or np.any(np.asarray(noise._sigma) < 0):
            raise SavedFileError(f"its action_noise {noise!s:.100} does not go with actions of {action_space.shape}")


def space_as_data(space: spaces.Space[Any]) -> Any:
    """Return [low, high] of a Box, or a dict of these.

    :raises ValueError: for other spaces
    """
    if isinstance(space, spaces.Dict):
        return {key: space_as_data(part) for key, part in space.items()}
    if not isinstance(space, spaces.Box):
        raise ValueError(f"Only Box spaces and Dict spaces of them can be saved, got {space}.")
    return [space.low, space.high]


def space_from_data(node: Any) -> spaces.Space[Any]:
    """Return the space that :func:`space_as_data` was given.

    :raises SavedFileError: for bounds that no space has
    """
    if isinstance(node, dict):  # pairs: a dict would be sorted, and the order of the keys is that of a network's inputs
        return spaces.Dict([(key, space_from_data(part)) for key, part in node.items()])
    low, high = node
    fits = all(isinstance(x, np.ndarray) for x in node) and (low.shape, low.dtype) == (high.shape, high.dtype)
    if not fits or low.dtype.kind not in "iuf" or not np.all(low <= high):
        raise SavedFileError("a space has bounds that do not belong together")
    return spaces.Box(low, high, dtype=low.dtype)


def replaced(settings: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Return the old values of what ``given`` changes; in a dict, those of the changed entries alone."""
    others = {}
    for name, now in given.items():
        before = settings.get(name, now)
        if isinstance(before, dict) and isinstance(now, dict):
            if entries := replaced(before, now):
                others[name] = entries
        elif repr(before) != repr(now):
            others[name] = before
    return others


def with_given(settings: dict[str, Any], given: dict[str, Any], nested: Iterable[str]) -> dict[str, Any]:
    """Return settings updated by ``given``.

    :param nested: names of settings that are dicts, merged entry by entry instead of replaced
    """
    for name in nested:
        before, now = settings.get(name), given.get(name)
        if isinstance(before, dict) and isinstance(now, dict):
            given = {**given, name: {**before, **now}}
    return {**settings, **given}
