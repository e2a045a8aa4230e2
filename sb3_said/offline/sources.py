"""Where logs come from: files, replay buffers and Minari, each read into columns of the same names."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from tqdm.auto import tqdm

from sb3_said.offline.checks import Columns, check_lengths, continues, flags, numbers
from sb3_said.replay.buffer import DelayedReplayBuffer

#: Names that files give to a column. D4RL's come first, then Minari's and SB3's.
COLUMNS = {
    "observations": ("observations", "states", "obs"),
    "actions": ("actions",),
    "rewards": ("rewards",),
    "terminated": ("terminals", "terminations", "terminated"),
    "truncated": ("timeouts", "truncations", "truncated"),
    "next_observations": ("next_observations", "next_states", "next_obs"),
}
TASK = "env"  # entry of an .npz, entry or attribute of an HDF5 file: id of the task, if it is told
ABOUT = "about"  # entry of an .npz: what collect tells about the data, in JSON
MINARI = 'pip install "sb3_said[offline]"' if sys.version_info >= (3, 11) else "it needs Python 3.11, an .npz does not"
READ = {TASK, ABOUT, *(name for names in COLUMNS.values() for name in names)}


class Log(NamedTuple):
    """What one source holds."""

    name: str
    task: str | None
    """id of the log's task; None where the source does not tell it"""
    changes: str
    """how that task was changed, in JSON; empty where it was not, or where nothing says so"""
    parts: list[tuple[str, Columns]]
    """columns of each part, with its name for errors"""
    is_scaled: bool = False
    """whether actions are in [-1, 1] instead of the task's units"""


def read_file(path: Path, progress_bar: bool) -> Log:
    """Read an ``.npz`` or HDF5 file.

    :param progress_bar: show one over the columns, where they take more than a second
    :raises FileNotFoundError: where there is no such file
    :raises ValueError: for a damaged file, or one without a column that is needed
    :raises ImportError: for an HDF5 file without h5py
    """
    if not path.exists():
        raise FileNotFoundError(f"There is no dataset {path}.")
    if path.suffix != ".npz":
        try:
            import h5py
        except ImportError as error:
            raise ImportError(f'{path} needs h5py: pip install "sb3_said[offline]".') from error

    def read(file: Any, names: Iterable[str]) -> dict[str, Any]:
        bar = tqdm(names, desc=path.name, unit="column", disable=not progress_bar, delay=1.0)
        return {name: file[name][()] if name in READ else None for name in bar}  # the others' names are for errors

    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                given = read(file, file.files)
        else:
            with h5py.File(path, "r") as file:
                given = read(file, [name for name in file if isinstance(file[name], h5py.Dataset)])
                given |= {TASK: file.attrs[TASK]} if TASK in file.attrs else {}
    except Exception as error:  # NumPy, zipfile and HDF5 raise many kinds
        raise ValueError(f"{path} cannot be read; it is damaged, or no {path.suffix} file: {error}") from error
    task, about = given.pop(TASK, None), given.pop(ABOUT, "")
    task = task.item() if isinstance(task, np.ndarray) and task.size == 1 else task  # a list of one name
    task = task.decode(errors="replace") if isinstance(task, bytes) else task
    name = os.fspath(path)
    parts = [(name, _of_columns(name, given))]
    return Log(name, task if isinstance(task, str) else None, _changes(about), parts)


def _changes(about: Any) -> str:
    """Return the changes to the task that collect has noted, in JSON; other descriptions note none."""
    try:
        found = json.loads(str(about))["changes"]
    except (ValueError, TypeError, KeyError):
        return ""
    return json.dumps(found) if found else ""


def _of_columns(name: str, given: Mapping[str, Any]) -> Columns:
    """Return the columns under our names, with the trajectories' ends.

    Without next observations, the state after a cut-off step is unknown: the step is left out, and its own state is the
    final one. The state after a terminal step is unknown, too, but never learned from: the step's own state fills in.
    With next observations, a file need not say where episodes were cut off; ``d4rl.qlearning_dataset`` does not.
    """
    found = {ours: next((n for n in names if n in given), None) for ours, names in COLUMNS.items()}
    not_needed = {"next_observations"} if found["next_observations"] is None else {"truncated"}
    if lacking := [COLUMNS[key] for key in COLUMNS if found[key] is None and key not in not_needed]:
        hint = " 'dones' do not say whether the task or a time limit ended an episode." if "dones" in given else ""
        raise ValueError(
            f"{name} has the columns {', '.join(sorted(given))} and none of {' or '.join(lacking[0])}.{hint}"
        )
    columns = {key: np.asarray(given[theirs]) for key, theirs in found.items() if theirs is not None}
    check_lengths(name, columns)
    if "truncated" not in columns:
        states, next_states = (numbers(name, key, columns[key]) for key in ("observations", "next_observations"))
        if states.shape != next_states.shape:
            raise ValueError(
                f"{name} has observations of {states.shape}, and next_observations of {next_states.shape}."
            )
        columns["truncated"] = np.append(~continues(states, next_states), True)
    for key in ("terminated", "truncated"):
        columns[key] = flags(name, str(found[key]), columns[key])
    columns["ends"] = columns["terminated"] | columns.pop("truncated")
    columns["ends"][-1] = True
    if "next_observations" not in columns:
        states = columns["observations"]
        after = np.concatenate([states[1:], states[-1:]])
        after[columns["ends"]] = states[columns["ends"]]
        columns["next_observations"] = after
        unknown = columns["ends"] & ~columns["terminated"]
        columns["ends"] |= np.append(unknown[1:], False)  # a trajectory of this one step vanishes
        columns = {key: value[~unknown] for key, value in columns.items()}
    return columns


def read_buffer(buffer: ReplayBuffer) -> Log:
    """Read a replay buffer: a part for each parallel environment, oldest step first.

    Without ``handle_timeout_termination``, a warning says that dones are read as terminal states.

    :raises ValueError: for a buffer that does not hold the task's states, or how episodes ended
    """
    name = type(buffer).__name__
    if isinstance(buffer.observations, dict):
        raise ValueError(
            f"A {name} holds dicts, not the states of a task: a delayed observation is old, and a goal is no part of "
            "it. Give a DelayedReplayBuffer, as DelayedSAC fills it, or a ReplayBuffer of a task with Box observations."
        )
    if buffer.optimize_memory_usage:
        raise ValueError(
            f"A {name} with optimize_memory_usage=True keeps neither the last state of an episode nor whether a time "
            "limit ended it; collect with optimize_memory_usage=False."
        )
    size = buffer.size()
    if not buffer.handle_timeout_termination and (n_dones := int(buffer.dones[:size].sum())):
        warnings.warn(
            f"A {name} with handle_timeout_termination=False does not know which dones were time limits: all {n_dones} "
            "are read as terminal states, after which nothing is earned. Where the task has a time limit, collect with "
            "handle_timeout_termination=True.",
            stacklevel=4,  # at the caller of load_dataset
        )
    rows = (buffer.pos - size + np.arange(size)) % buffer.buffer_size
    parts = []
    for env in range(buffer.n_envs):
        envs = np.full(size, env)
        states = buffer.observations[rows, envs]
        if isinstance(buffer, DelayedReplayBuffer):
            next_states, breaks = buffer._successors(rows, envs)[0], buffer.ends[rows, envs]
        else:
            next_states = buffer.next_observations[rows, envs]
            breaks = np.append(np.any(next_states[:-1] != states[1:], axis=1), True)
        dones, timeouts = buffer.dones[rows, envs] > 0, buffer.timeouts[rows, envs] > 0
        ends = breaks | dones
        ends[-1:] = True
        columns = {
            "observations": states,
            "actions": buffer.actions[rows, envs],
            "rewards": buffer.rewards[rows, envs],
            "terminated": dones & ~timeouts,
            "ends": ends,
            "next_observations": next_states,
        }
        parts.append((f"environment {env} of {name}", columns))
    return Log(name, None, "", parts, is_scaled=True)


def import_minari(what: str) -> Any:
    """:raises ImportError: where Minari is missing; the message names what needs it"""
    try:
        import minari
    except ImportError as error:
        raise ImportError(f"{what} needs Minari: {MINARI}.") from error
    return minari


def read_minari(source: Any, progress_bar: bool) -> Log:
    """Read a Minari dataset, given by its id or loaded already; one that is not local is downloaded.

    :raises ValueError: for a missing or damaged dataset, and for observations that are no vectors
    """
    minari = import_minari(f"The dataset {source}")
    if isinstance(source, (str, os.PathLike)):
        try:
            source = minari.load_dataset(os.fspath(source), download=True)
        except Exception as error:  # Minari and the hub below it raise many kinds
            local = ", ".join(sorted(minari.list_local_datasets())) or "none"
            raise ValueError(
                f"There is no dataset {source!r}: it is no .npz or .hdf5 file, and Minari, whose ids are like "
                f"mujoco/hopper/medium-v0, cannot load it ({error!s:.200}). Local Minari datasets: {local}."
            ) from error
    name, spec = source.spec.dataset_id, source.env_spec
    episodes = tqdm(source.iterate_episodes(), desc=name, total=source.total_episodes, disable=not progress_bar)
    try:
        parts = [_of_episode(f"episode {episode.id} of {name}", episode) for episode in episodes]
    except (KeyError, OSError, RuntimeError) as error:  # errors of HDF5 do not name the file
        raise ValueError(
            f"The dataset {name} in {source.spec.data_path} cannot be read; it is damaged: {error}"
        ) from error
    told = source.storage.metadata.get("description", "")
    return Log(name, None if spec is None else spec.id, _changes(told), parts)


def _of_episode(name: str, episode: Any) -> tuple[str, Columns]:
    if not isinstance(episode.observations, np.ndarray):
        raise ValueError(f"{name} has observations of kind {type(episode.observations).__name__}, expected vectors.")
    length = len(episode.rewards)
    ends = np.zeros(length, bool)
    ends[-1:] = True
    columns = {
        "observations": episode.observations[:length],
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminated": flags(name, "terminations", episode.terminations),
        "ends": ends,
        "next_observations": episode.observations[1 : length + 1],
    }
    return name, columns
