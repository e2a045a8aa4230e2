"""What learning changes in an agent: counters, recent episodes, networks and optimizers, as a tree and back."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from sb3_said.files.archive import SavedFileError
from sb3_said.files.checks import check_names, check_optimizer_state, check_tensors

LARGEST_COUNT = 2**63 - 1


class Learner(OffPolicyAlgorithm):
    """An SB3 algorithm that names what it counts; a subclass adds to ``counters``."""

    counters: ClassVar[tuple[str, ...]] = (
        "num_timesteps", "_total_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining"
    )  # fmt: skip

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Return the state dicts to take over from those given; an algorithm may keep some of its own."""
        return params


def agent_state(model: Learner) -> dict[str, Any]:
    """Return what learning has changed, as a tree; of optimizers only the state, as their settings are arguments."""
    parameters = model.get_parameters()
    return {
        "counters": {name: _plain(name, getattr(model, name)) for name in model.counters},
        "episodes": {
            "returns": [float(episode["r"]) for episode in model.ep_info_buffer or ()],
            "lengths": [int(episode["l"]) for episode in model.ep_info_buffer or ()],
            "successes": [float(success) for success in model.ep_success_buffer or ()],
        },
        "parameters": {name: part["state"] if "param_groups" in part else part for name, part in parameters.items()},
        "variables": {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]},
    }


def _plain(name: str, value: Any) -> Any:
    """Return a counter as a file has it, a plain number; ``learn(1e6)``, ``learn(inf)`` and NumPy leave others."""
    value = value.item() if isinstance(value, np.generic) else value
    if name == "_current_progress_remaining" or not isinstance(value, float):
        return value
    return min(math.ceil(value), LARGEST_COUNT) if math.isfinite(value) else LARGEST_COUNT


def restore_agent(model: Learner, saved: dict[str, Any]) -> None:
    """Take over what :func:`agent_state` returned, once it is known to fit the model's own.

    :raises SavedFileError: for parts of other names, shapes or types, or that are not finite
    """
    check_counters(model, saved["counters"])
    parameters = fitting_parameters(model, saved["parameters"])
    own = {name: getattr(model, name).data for name in model._get_torch_save_params()[1]}
    check_tensors("variables", saved["variables"], own)
    _recall_episodes(model, saved.get("episodes"))
    for name in model.counters:
        setattr(model, name, saved["counters"][name])
    take_parameters(model, parameters)
    for name, value in own.items():
        value.copy_(saved["variables"][name])


def _recall_episodes(model: Learner, saved: dict[str, list[float]] | None) -> None:
    """Take over the recent episodes, whose mean return and length SB3 logs; an older file has none."""
    if saved is None:
        return
    check_names("episodes", saved, ("returns", "lengths", "successes"))
    if any(type(x) not in (int, float) for values in saved.values() for x in values):
        raise SavedFileError("its part 'episodes' holds more than numbers")
    episodes = zip(saved["returns"], saved["lengths"], strict=True)
    model.ep_info_buffer = deque(({"r": r, "l": n} for r, n in episodes), maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(saved["successes"], maxlen=model._stats_window_size)


def check_counters(model: Learner, saved: dict[str, Any]) -> None:
    check_names("counters", saved, model.counters)
    for name in model.counters:
        value, own = saved[name], getattr(model, name)
        if isinstance(own, int):
            fits = type(value) is int and 0 <= value <= LARGEST_COUNT
        elif isinstance(own, float):
            fits = type(value) is float and math.isfinite(value)
        else:  # trained_ages, None before learning
            fits = value is None or (type(value) is list and all(type(x) is int and 0 <= x < 2**31 for x in value))
        if not fits:
            raise SavedFileError(f"its part 'counters' does not fit: {name} is {value!r:.50}")


def fitting_parameters(model: Learner, saved: dict[str, Any], exact: bool = True) -> dict[str, Any]:
    """Return what a model takes over of saved networks and optimizers, once it is known to fit."""
    saved, own = model._adapt_parameters(saved), model.get_parameters()
    check_names("parameters", saved, own, exact)
    saved = {name: _in_full(state, own[name]) for name, state in saved.items()}
    for name, state in saved.items():
        target = recursive_getattr(model, name)
        if isinstance(target, th.optim.Optimizer):
            check_optimizer_state(name, state, target)
        else:
            check_tensors(name, state, own[name], exact)
    return saved


def in_half(value: th.Tensor) -> th.Tensor:
    """Return a matrix as float16, if it is one of float32 that stays finite."""
    half = value.half() if value.dtype == th.float32 and value.ndim > 1 else value
    return half if half.isfinite().all() else value


def _in_full(state: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return tensors that :func:`in_half` wrote, back in the types of the model's own."""

    def full(name: str, value: Any) -> Any:
        is_half = isinstance(value, th.Tensor) and value.dtype == th.float16 and isinstance(own.get(name), th.Tensor)
        return value.to(own[name].dtype) if is_half else value

    return {name: full(name, value) for name, value in state.items()}


def take_parameters(model: Learner, saved: dict[str, Any], exact: bool = True) -> None:
    for name, state in saved.items():
        target = recursive_getattr(model, name)
        if isinstance(target, th.optim.Optimizer):
            target.load_state_dict({**target.state_dict(), "state": state})
        else:
            target.load_state_dict(state, strict=exact)
