"""Logged episodes of a task without delay: one loader, one form in memory, from which a replay buffer is filled."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from tqdm.auto import tqdm

from sb3_said.delays.space import UNDELAYED, check_spaces, scale_action
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
ACTION_TOLERANCE = 1e-3  # of half the range: what float32 and a tanh leave beyond the bounds


@dataclass(frozen=True)
class Dataset:
    """Trajectories of a task without delay, laid end to end.

    A trajectory's end and a terminal state are two things: after a time limit, or where the log was cut, the last state
    still has a value. ``finals`` keeps it.

    :param states: (N, obs_dim) float32, before each action
    :param actions: (N, act_dim) float32, scaled to [-1, 1]
    :param rewards: (N,) float32
    :param terminated: (N,) bool, where the task itself ended
    :param ends: (N,) bool, the last step of each trajectory, whatever ended it
    :param finals: (n_trajectories, obs_dim) float32, the state after each trajectory's last step
    """

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    ends: np.ndarray
    finals: np.ndarray

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def next_states(self) -> np.ndarray:
        """The state after each step: (N, obs_dim), a copy."""
        after = np.roll(self.states, -1, axis=0)
        after[self.ends] = self.finals
        return after

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each trajectory: (n_trajectories,)."""
        return np.diff(np.flatnonzero(self.ends), prepend=-1)

    @property
    def returns(self) -> np.ndarray:
        """Sum of each trajectory's rewards: (n_trajectories,) float64."""
        starts = np.concatenate([[0], np.flatnonzero(self.ends)[:-1] + 1])
        return np.add.reduceat(self.rewards.astype(np.float64), starts)

    def select(self, keep: np.ndarray) -> Dataset:
        """Return some of the trajectories.

        :param keep: (n_trajectories,) bool
        """
        steps = np.repeat(keep, self.lengths)
        columns = {field.name: getattr(self, field.name)[steps] for field in fields(self) if field.name != "finals"}
        return Dataset(**columns, finals=self.finals[keep])

    def to_replay(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        draw_ages: Callable[[int], np.ndarray] | None = None,
        **buffer_kwargs: Any,
    ) -> DelayedReplayBuffer:
        """Fill a replay buffer as if an agent had collected these episodes.

        :param observation_space: that of ``DelayedObservationWrapper``, or the task's own
        :param action_space: the task's
        :param draw_ages: returns the ages at which an episode of n steps would be observed, from its first to its final
            state: (n + 1,) int. Ages are 0 by default, which is all that a planner and values need
        :param buffer_kwargs: of :class:`~sb3_said.replay.DelayedReplayBuffer`
        """
        _, max_delay = check_spaces(observation_space, action_space)
        size = max(len(self), max_delay + 2)
        buffer = DelayedReplayBuffer(size, observation_space, action_space, **buffer_kwargs)
        ends, lengths = np.flatnonzero(self.ends), self.lengths
        ages, tail_ages = np.zeros(len(self), np.int16), np.zeros(len(ends), np.int16)
        for i, (end, length) in enumerate(zip(ends, lengths, strict=True)):
            if draw_ages is not None:
                *ages[end + 1 - length : end + 1], tail_ages[i] = draw_ages(int(length))
        rows: dict[str, Any] = {
            "observations": self.states,
            "actions": self.actions,
            "rewards": self.rewards,
            "dones": self.ends.astype(np.float32),
            "timeouts": (self.ends & ~self.terminated).astype(np.float32),
            "ages": ages,
            "steps": (np.arange(len(self)) - np.repeat(ends + 1 - lengths, lengths)).astype(np.int32),
            "ends": np.append(self.ends[:-1], False),  # the newest row's tail is what follows the buffer
        }
        state = {name: column[:, None] for name, column in rows.items()} | {
            "pos": len(self) % size,
            "full": len(self) == size,
            "expected": None,
            "next_states": self.finals[-1:],
            "next_ages": tail_ages[-1:],
            "tail_places": np.stack([ends[:-1], np.zeros_like(ends[:-1])], axis=1),
            "tail_states": self.finals[:-1],
            "tail_ages": tail_ages[:-1],
        }
        buffer.load_state_dict(state)
        return buffer


def load_dataset(
    source: Any,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    env_id: str | None = None,
    progress_bar: bool = False,
) -> Dataset:
    """Read logged episodes of a task without delay.

    :param source: the id of a Minari dataset (``"mujoco/hopper/medium-v0"``, downloaded where it is not local) or one
        that is loaded; the path of a D4RL ``.hdf5`` file or of an ``.npz`` with columns as in D4RL or Minari; a replay
        buffer of SB3 or of this package; a ``Dataset``; or a list of these, which are joined
    :param observation_space: of the task, with or without ``DelayedObservationWrapper``
    :param action_space: of the task
    :param env_id: refuse a dataset that says it is of another task
    :param progress_bar: show one
    :raises ValueError: for data of other shapes or another task, actions outside the bounds, entries that are NaN or
        infinite, and steps that do not follow each other. It names the file and the row
    :raises FileNotFoundError: where there is no such file
    """
    state_space, _ = check_spaces(observation_space, action_space)
    assert isinstance(action_space, spaces.Box)
    parts = source if isinstance(source, (list, tuple)) else [source]
    read = [_read(part, state_space, action_space, env_id, progress_bar) for part in parts]
    if not read:
        raise ValueError("The list of datasets is empty; name at least one.")
    return _joined(read)


def is_file(source: Any) -> bool:
    """Tell whether a dataset is meant as the path of a file, by its suffix; other text is an id of Minari."""
    return isinstance(source, (str, os.PathLike)) and Path(source).suffix in (".hdf5", ".h5", ".npz")


def _read(source: Any, state_space: spaces.Box, action_space: spaces.Box, env_id: str | None, bar: bool) -> Dataset:
    if isinstance(source, Dataset):
        return source
    if isinstance(source, ReplayBuffer):
        parts, name = _of_buffer(source), type(source).__name__
        named = {f"environment {i} of {name}": columns for i, columns in enumerate(parts)}
    elif is_file(source):
        name = os.fspath(source)
        named = {name: _of_columns(name, _read_columns(Path(source)))}
    else:
        parts, name = _of_minari(source, env_id, bar)
        named = {f"episode {i} of {name}": columns for i, columns in enumerate(parts)}
    read = [_checked(where, part, state_space, action_space) for where, part in named.items() if len(part["rewards"])]
    if not read:
        raise ValueError(f"{name} has no step whose next state is known.")
    return _joined(read)


def _joined(parts: Sequence[Dataset]) -> Dataset:
    return Dataset(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Dataset)))


# ------------------------------------------------------------------------------------------------ sources

Columns = dict[str, np.ndarray]  # observations, actions, rewards, terminated, ends and next_observations, N rows each


def _read_columns(path: Path) -> Mapping[str, np.ndarray]:
    """Read the columns of an ``.npz`` or HDF5 file."""
    if not path.exists():
        raise FileNotFoundError(f"There is no dataset {path}.")
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f'{path} needs h5py: pip install "sb3_said[offline]".') from error
    with h5py.File(path, "r") as file:
        return {name: file[name][()] for name in file if isinstance(file[name], h5py.Dataset)}


def _of_columns(name: str, given: Mapping[str, np.ndarray]) -> Columns:
    """Return the columns under our names, with the trajectories' ends.

    Without next observations, the state after a time limit is unknown: that step's state ends the trajectory instead.
    """
    found = {ours: next((given[n] for n in names if n in given), None) for ours, names in COLUMNS.items()}
    if lacking := [COLUMNS[key] for key in COLUMNS if found[key] is None and key != "next_observations"]:
        hint = " 'dones' do not say whether the task or a time limit ended an episode." if "dones" in given else ""
        raise ValueError(
            f"{name} has the columns {', '.join(sorted(given))} and none of {' or '.join(lacking[0])}.{hint}"
        )
    columns = {key: np.asarray(value) for key, value in found.items() if value is not None}
    sizes = {key: value.shape[:1] for key, value in columns.items()}
    if len(set(sizes.values())) > 1 or sizes["rewards"] in ((), (0,)):
        raise ValueError(f"The columns of {name} differ in length, or are empty: {sizes}.")
    columns["terminated"] = columns["terminated"].astype(bool).reshape(-1)
    columns["ends"] = columns["terminated"] | columns.pop("truncated").astype(bool).reshape(-1)
    columns["ends"][-1] = True
    if "next_observations" not in columns:
        states = columns["observations"]
        columns["next_observations"] = np.concatenate([states[1:], states[-1:]])
        unknown = columns["ends"] & ~columns["terminated"]
        columns["ends"] |= np.append(unknown[1:], False)  # where it was the only step, nothing is left of it
        columns = {key: value[~unknown] for key, value in columns.items()}
    return columns


def _of_buffer(buffer: ReplayBuffer) -> list[Columns]:
    """Return the columns of each parallel environment, oldest step first."""
    size = buffer.size()
    rows = (buffer.pos - size + np.arange(size)) % buffer.buffer_size
    columns = []
    for env in range(buffer.n_envs):
        envs = np.full(size, env)
        if isinstance(buffer, DelayedReplayBuffer):
            states, next_states = buffer.observations[rows, envs], buffer._successors(rows, envs)[0]
            breaks = buffer.ends[rows, envs]
        else:
            parts: list[Any] = [buffer.observations, buffer.next_observations]
            if isinstance(parts[0], dict):
                key = UNDELAYED if UNDELAYED in parts[0] else "observation"
                parts = [part[key] for part in parts]
            states, next_states = (part[rows, envs] for part in parts)
            breaks = np.append(np.any(next_states[:-1] != states[1:], axis=1), True)
        dones, timeouts = buffer.dones[rows, envs] > 0, buffer.timeouts[rows, envs] > 0
        ends = breaks | dones
        ends[-1:] = True
        columns.append(
            {
                "observations": states,
                "actions": buffer.actions[rows, envs],
                "rewards": buffer.rewards[rows, envs],
                "terminated": dones & ~timeouts,
                "ends": ends,
                "next_observations": next_states,
                "scaled": np.ones(size, bool),
            }
        )
    return columns


def _of_minari(source: Any, env_id: str | None, progress_bar: bool) -> tuple[list[Columns], str]:
    """Return the columns of each episode of a Minari dataset, and its id."""
    try:
        import minari
    except ImportError as error:
        raise ImportError(f'The dataset {source} needs Minari: pip install "sb3_said[offline]".') from error
    if isinstance(source, (str, os.PathLike)):
        try:
            source = minari.load_dataset(os.fspath(source), download=True)
        except Exception as error:  # Minari and the hub below it raise many kinds
            local = ", ".join(sorted(minari.list_local_datasets())) or "none"
            raise ValueError(
                f"There is no dataset {source!r}: it is no .npz or .hdf5 file, and Minari says {error!s:.200} "
                f"Local Minari datasets: {local}."
            ) from error
    name, spec = source.spec.dataset_id, source.env_spec
    if env_id is not None and spec is not None and spec.id != env_id:
        message = f"{name} is of {spec.id}, and the task is {env_id}"
        if spec.id.rpartition("-v")[0] != env_id.rpartition("-v")[0]:
            raise ValueError(f"{message}; give a dataset of that task.")
        warnings.warn(f"{message}: versions may differ in rewards and observations.", stacklevel=4)
    episodes = tqdm(source.iterate_episodes(), desc=name, total=source.total_episodes, disable=not progress_bar)
    return [_of_episode(name, episode) for episode in episodes], name


def _of_episode(name: str, episode: Any) -> Columns:
    if not isinstance(episode.observations, np.ndarray):
        raise ValueError(f"{name} has observations of kind {type(episode.observations).__name__}, expected vectors.")
    length = len(episode.rewards)
    ends = np.zeros(length, bool)
    ends[-1:] = True
    return {
        "observations": episode.observations[:length],
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminated": np.asarray(episode.terminations, bool),
        "ends": ends,
        "next_observations": episode.observations[1 : length + 1],
    }


# ------------------------------------------------------------------------------------------------ checks


def _checked(name: str, columns: Columns, state_space: spaces.Box, action_space: spaces.Box) -> Dataset:
    """Return one source's columns as a dataset, actions scaled.

    :raises ValueError: for what is no log of the task; names the row
    """
    box = spaces.Box(-1.0, 1.0, action_space.shape) if "scaled" in columns else action_space
    states, actions, next_states = (columns[key] for key in ("observations", "actions", "next_observations"))
    for key, x, expected in (
        ("observations", states, state_space.shape),
        ("actions", actions, action_space.shape),
        ("next_observations", next_states, state_space.shape),
    ):
        if x.shape[1:] != expected:
            raise ValueError(
                f"{name} has {key} of shape {x.shape[1:]}, and the task {expected}: it is of another task."
            )
    floats = {key: np.asarray(columns[key], np.float32) for key in ("observations", "actions", "next_observations")}
    floats["rewards"] = np.asarray(columns["rewards"], np.float32).reshape(-1)
    for key, x in floats.items():
        bad = np.any(~np.isfinite(x.reshape(len(x), -1)), axis=1)
        _refuse(name, bad, f"{key} must be finite", x)
    ends, terminated = columns["ends"], columns["terminated"]
    half = (box.high - box.low) / 2
    outside = np.any(np.abs(floats["actions"] - (box.low + box.high) / 2) > half * (1 + ACTION_TOLERANCE), axis=1)
    _refuse(name, outside, f"the action is outside the bounds {box}", actions)
    _refuse(name, terminated & ~ends, "the task ended, and the trajectory goes on", terminated)
    follows = np.all(np.isclose(next_states[:-1], states[1:], rtol=1e-3, atol=1e-3), axis=1) | ends[:-1]
    _refuse(name, ~follows, "its next observation is not that of the next row, and no flag ends it", next_states)
    return Dataset(
        floats["observations"],
        scale_action(floats["actions"], box).astype(np.float32),
        floats["rewards"],
        terminated,
        ends,
        floats["next_observations"][ends],
    )


def _refuse(name: str, bad: np.ndarray, why: str, values: np.ndarray) -> None:
    """:raises ValueError: where a row is bad; it names the first, and how many there are"""
    if (rows := np.flatnonzero(bad)).size:
        more = f" ({rows.size} rows like this)" if rows.size > 1 else ""
        raise ValueError(f"Row {rows[0]} of {name}: {why}, got {values[rows[0]]}{more}.")
