"""Checks of what a file claims, before anything is built or taken over."""

from __future__ import annotations

import contextlib
import copy
import functools
import inspect
import math
import threading
import types
import typing
from collections.abc import Callable, Collection, Iterator
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from torch.nn.modules import module as torch_hooks

from sb3_said.files.archive import SavedFileError

_LARGEST = 2.0**63
#: Ranges of SB3's off-policy arguments: a number outside is a mistake or takes too much memory.
RANGES: dict[str, tuple[float, float]] = {
    "learning_rate": (0, _LARGEST),
    "buffer_size": (1, 1e9),
    "learning_starts": (0, _LARGEST),
    "batch_size": (1, 1e7),
    "tau": (0, 1),
    "gamma": (0, 1),
    "train_freq": (1, _LARGEST),
    "gradient_steps": (-1, _LARGEST),
    "target_update_interval": (1, _LARGEST),
    "stats_window_size": (1, 1e9),
    "seed": (0, 2**32 - 1),
}
# State of torch's optimizers: counts, and means of squares, of which roots are taken.
_NEVER_NEGATIVE = ("step", "exp_avg_sq", "max_exp_avg_sq", "square_avg", "sum", "exp_inf")


# ---------------------------------------------------------------------------------------------------- arguments


def check_argument(name: str, value: Any, cls: type) -> None:
    """Check a constructor argument against its range and its type in the first constructor that names it.

    :param cls: its own constructor comes first, then those that it inherits
    :raises ValueError: for another type, or a number out of range
    """
    if not _fits(value, declared(name, cls)):
        raise ValueError(f"{name} is {value!r:.100}, which is not of the type that {cls.__name__} declares.")
    check_range(name, value)


def declared(name: str, cls: type) -> Any:
    """Return the type of an argument in the first constructor that names it; ``Any`` where none does."""
    constructors = [vars(base)["__init__"] for base in cls.__mro__ if "__init__" in vars(base)]
    return next((hint for make in constructors for argument, hint in _hints(make).items() if argument == name), Any)


def check_range(name: str, value: Any) -> None:
    """:raises ValueError: for a number, or a ``train_freq`` with its unit, that is out of range"""
    low, high = RANGES.get(name, (-_LARGEST, _LARGEST))
    number = value[0] if name == "train_freq" and isinstance(value, (tuple, list)) else value
    if isinstance(number, Real) and not low <= float(number) <= high:
        raise ValueError(f"{name} is {value!r:.100}, expected {low:g}..{high:g}.")


def check_numbers(where: str, node: Any) -> None:
    """Check every number in an argument's plain data, at any depth.

    :raises ValueError: for one that is not finite, or too large for any setting
    """
    if isinstance(node, dict):
        node = [*node, *node.values()]
    if isinstance(node, (list, tuple)):
        for item in node:
            check_numbers(where, item)
        return
    if isinstance(node, str):
        with contextlib.suppress(ValueError):  # most texts are no numbers; SB3 reads those that are
            node = float(node)
    if isinstance(node, int) and abs(node) > _LARGEST:
        raise ValueError(f"{where} holds a number of {node.bit_length()} bits.")
    array = node.numpy(force=True) if isinstance(node, th.Tensor) else node
    if isinstance(array, (Real, np.ndarray)) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"{where} holds {array!s:.100}, expected finite numbers.")


@functools.cache
def _hints(make: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of a constructor's arguments, and none where its module does not know them at run time."""
    try:
        parameters = inspect.signature(make, eval_str=True).parameters
    except NameError:
        return {}
    return {name: parameter.annotation for name, parameter in parameters.items()}


def _fits(value: Any, hint: Any) -> bool:
    """Tell whether a value is of a declared type, as users mean it: a whole number for a float, a tuple for a list."""
    if hint in (Any, inspect.Parameter.empty) or not (isinstance(hint, type) or typing.get_args(hint)):
        return hint is not None or value is None  # what is no type declares nothing
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in args)
    if hint in (int, float):
        return isinstance(value, (Real, np.bool_)) and (hint is float or float(value).is_integer())
    if hint is bool:
        return isinstance(value, (bool, np.bool_))
    if origin is type:
        return isinstance(value, type) and (not isinstance(args[0], type) or issubclass(value, args[0]))
    if origin is Callable:
        return callable(value) and not isinstance(value, type)
    if origin is dict:
        return isinstance(value, dict) and all(_fits(key, args[0]) and _fits(x, args[1]) for key, x in value.items())
    if origin is list:
        return isinstance(value, (list, tuple)) and all(_fits(item, args[0]) for item in value)
    if origin is tuple:
        is_pair = isinstance(value, (list, tuple)) and len(value) == len(args)
        return is_pair and all(map(_fits, value, args))
    return origin is not None or isinstance(value, hint)


# ---------------------------------------------------------------------------------------------------- networks


@contextlib.contextmanager
def no_larger_than(saved: dict[str, Any]) -> Iterator[None]:
    """Refuse, in this thread, to build networks of more parameters than a state dict holds, before they are filled.

    :raises SavedFileError: at the first parameter that is too many
    """
    # Twice and a bit, since some modules are built and then replaced. An empty parameter counts too: it takes time.
    left = 2 * sum(tensor.numel() + 1 for tensor in saved.values() if isinstance(tensor, th.Tensor)) + 1000
    thread = threading.get_ident()

    def count(module: th.nn.Module, name: str, parameter: th.Tensor | None) -> None:
        nonlocal left
        if parameter is not None and threading.get_ident() == thread:
            left -= parameter.numel() + 1
            if left < 0:
                raise SavedFileError("its arguments ask for larger networks than it holds parameters of")

    parameters, buffers = (
        torch_hooks.register_module_parameter_registration_hook(count),
        torch_hooks.register_module_buffer_registration_hook(count),
    )
    with parameters, buffers:
        yield


def check_tensors(where: str, saved: dict[str, Any], own: dict[str, Any], exact: bool = True) -> None:
    """Check tensors against a model's own.

    :param exact: whether none may be missing
    :raises SavedFileError: for other names, shapes or types, or numbers that are not finite
    """
    check_names(where, saved, own, exact)
    for name, value in saved.items():
        shape, dtype = own[name].shape, own[name].dtype
        if not isinstance(value, th.Tensor) or (value.shape, value.dtype) != (shape, dtype):
            given = (value.dtype, tuple(value.shape)) if isinstance(value, th.Tensor) else value
            raise SavedFileError(
                f"its part {where!r} does not fit: {name} is {given!s:.60}, expected {dtype, tuple(shape)}"
            )
        if not th.isfinite(value).all():
            raise SavedFileError(f"its part {where!r} does not fit: {name} has NaN or infinite entries")


def check_optimizer_state(where: str, saved: dict[int, Any], optimizer: th.optim.Optimizer) -> None:
    """Check an optimizer's state against what one of its own steps leaves for each parameter.

    :raises SavedFileError: for other names, shapes or types, or numbers that are not finite
    """
    if not saved:
        return
    twin = copy.deepcopy(optimizer)
    twin.state.clear()
    for group in twin.param_groups:
        group.setdefault("capturable", False)  # with a GPU, a copied Adafactor reads this key, which it lacks
        for parameter in group["params"]:
            parameter.grad = th.zeros_like(parameter)
    twin.step()
    own = twin.state_dict()["state"]
    check_names(where, saved, own, exact=False)
    for index, values in saved.items():
        tensors = {name: value for name, value in own[index].items() if isinstance(value, th.Tensor)}
        check_names(f"{where}[{index}]", values, own[index])
        check_tensors(f"{where}[{index}]", {name: values[name] for name in tensors}, tensors)
        if negative := [name for name in tensors if name in _NEVER_NEGATIVE and (values[name] < 0).any()]:
            raise SavedFileError(f"its part '{where}[{index}]' does not fit: {negative[0]} has negative entries")
        for name in own[index].keys() - tensors.keys():
            if type(values[name]) is not type(own[index][name]) or not math.isfinite(values[name] or 0):
                raise SavedFileError(f"its part '{where}[{index}]' does not fit: {name} is {values[name]!r:.50}")


def check_names(where: str, saved: Collection[Any], own: Collection[Any], exact: bool = True) -> None:
    """:raises SavedFileError: for unknown names and, if ``exact``, for missing ones"""
    lacking, unknown = [x for x in own if x not in saved], [x for x in saved if x not in own]
    if unknown or (exact and lacking):
        found = {"lacks": lacking if exact else [], "has unknown": unknown}
        told = " and ".join(f"{what} {names[:5]!s:.200}" for what, names in found.items() if names)
        raise SavedFileError(f"its part {where!r} does not fit: it {told}")
