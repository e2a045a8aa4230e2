"""Write datasets that other tools read, too: an ``.npz`` with D4RL's columns and the task's id, or a Minari dataset."""

from __future__ import annotations

import copy
import os
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from sb3_said.delays.space import check_spaces, unscale_action
from sb3_said.files.atomic import check_writable, replacing
from sb3_said.offline.datasets import Dataset, is_file
from sb3_said.offline.scores import reference_returns
from sb3_said.offline.sources import ABOUT, TASK, import_minari


def check_target(target: str | os.PathLike[str]) -> None:
    """Refuse a target that cannot be written, before the dataset is made.

    :param target: path of an ``.npz``, or id of a Minari dataset such as ``"hopper/mine-v0"``
    :raises ValueError: for a file of another format, text that is no id of Minari, and a target that exists already
    :raises ImportError: without Minari
    :raises OSError: for a folder that cannot be written
    """
    if is_file(target):
        if Path(target).suffix != ".npz":
            raise ValueError(f"Datasets are written as .npz or into Minari, got {os.fspath(target)}.")
        if Path(target).exists():
            raise ValueError(f"{os.fspath(target)} is there already; give another name, or remove it.")
        check_writable(target)
        return
    name = os.fspath(target)
    if not name.rpartition("-v")[2].isdigit():
        raise ValueError(f"{name!r} is neither an .npz nor an id of Minari, which ends in its version: {name}-v0.")
    import_minari(f"{name} is no .npz, and")
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name!r} is no id of a Minari dataset, such as hopper/mine-v0: {error}") from error
    if (folder := get_dataset_path(name)).exists():  # a failed attempt leaves one, too
        raise ValueError(f"{folder} is there already; give another name or version, or remove it.")


def write_dataset(
    data: Dataset, target: str | os.PathLike[str], env: gym.Env[Any, Any], about: str = "", algorithm: str = ""
) -> None:
    """Write a dataset; :func:`~sb3_said.offline.load_dataset` reads it again.

    :param data: to write
    :param target: path of an ``.npz``, or id of a Minari dataset such as ``"hopper/mine-v0"``
    :param env: the task it is of, with or without ``DelayedObservationWrapper``
    :param about: kept in the file, for its readers
    :param algorithm: name of the algorithm that acted, for Minari
    :raises ValueError: as :func:`check_target`
    """
    check_target(target)
    if is_file(target):
        _write_npz(data, target, env, about)
    else:
        _write_minari(data, os.fspath(target), env, about, algorithm)


def _write_npz(data: Dataset, path: str | os.PathLike[str], env: gym.Env[Any, Any], about: str) -> None:
    """Write D4RL's columns and the task's id."""
    _, action_space, _ = check_spaces(env.observation_space, env.action_space)
    spec = env.unwrapped.spec
    columns: dict[str, Any] = {
        "observations": data.states,
        "actions": unscale_action(data.actions, action_space),
        "rewards": data.rewards,
        "terminals": data.terminated,
        "timeouts": data.truncated,
        "next_observations": data.next_states,
        ABOUT: np.array(about),
        **({} if spec is None else {TASK: np.array(spec.id)}),
    }
    with replacing(path) as file:
        np.savez(file, **columns)


def _write_minari(data: Dataset, name: str, env: gym.Env[Any, Any], about: str, algorithm: str) -> None:
    """Write episodes, how to make the task again, and its reference returns where they are known."""
    import minari
    from minari.data_collector import EpisodeBuffer

    state_space, action_space, _ = check_spaces(env.observation_space, env.action_space)
    actions, spec = unscale_action(data.actions, action_space), env.unwrapped.spec
    registration = _registration_of(env, name)
    reference = reference_returns(spec.id) if spec is not None else None
    scores = {} if reference is None else {"ref_min_score": reference[0], "ref_max_score": reference[1]}
    buffers, truncated = [], data.truncated
    for i, (stop, length) in enumerate(zip(np.flatnonzero(data.ends) + 1, data.lengths, strict=True)):
        steps = slice(stop - length, stop)
        buffers.append(
            EpisodeBuffer(
                id=i,
                observations=np.concatenate([data.states[steps], data.finals[[i]]]),
                actions=actions[steps],
                rewards=data.rewards[steps],
                terminations=data.terminated[steps],
                truncations=truncated[steps],
                infos={},
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Minari's, that neither an author nor a link to code is named
        minari.create_dataset_from_buffers(
            name,
            buffers,
            env=registration,
            algorithm_name=algorithm,
            description=about,
            observation_space=state_space,
            action_space=env.action_space,
            **scores,
        )


def _registration_of(env: gym.Env[Any, Any], target: str) -> EnvSpec | None:
    """Return the spec that makes a task again: the registered one, with this task's arguments and time limit.

    A file can hold code only by its name. Where code has none, warn and return None.
    """
    own = env.unwrapped.spec
    if own is None:
        return None
    spec = copy.deepcopy(gym.spec(own.id))
    spec.kwargs = {**spec.kwargs, **own.kwargs}
    spec.max_episode_steps = (env.spec or spec).max_episode_steps  # the task's own spec lacks it
    code = spec.entry_point
    name = getattr(code, "__qualname__", "")
    if name.isidentifier():  # neither a lambda nor nested in a class or function
        spec.entry_point = f"{code.__module__}:{name}"
    try:
        spec.to_json()
    except (ValueError, TypeError) as error:
        warnings.warn(f"{target} will not say its task: {error}", stacklevel=4)
        return None
    return spec
