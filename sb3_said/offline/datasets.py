"""Logged episodes of a task without delay: one loader, one form in memory, from which a replay buffer is filled."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_said.delays.space import check_spaces
from sb3_said.offline.checks import Columns, check_lengths, check_task, checked, flags
from sb3_said.offline.sources import Log, read_buffer, read_file, read_minari
from sb3_said.replay.buffer import DelayedReplayBuffer, rows_for_logs


@dataclass(frozen=True)
class Dataset:
    """Trajectories of a task without delay, laid end to end.

    The end of a trajectory need not be terminal: after a time limit, or where the log was cut, the state that follows
    the last step still has a value. ``finals`` keeps that state.

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

    @property
    def truncated(self) -> np.ndarray:
        """Whether a trajectory was cut here, which the task did not end: (N,) bool."""
        return self.ends & ~self.terminated

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
        buffer_class: type[DelayedReplayBuffer] = DelayedReplayBuffer,
        **buffer_kwargs: Any,
    ) -> DelayedReplayBuffer:
        """Fill a replay buffer as if an agent had collected these episodes.

        :param observation_space: that of ``DelayedObservationWrapper``, or the task's own
        :param action_space: the task's
        :param draw_ages: returns the ages at which an episode of n steps would be observed, from its first to its final
            state: (n + 1,) int. Ages are 0 by default, which is all that a planner and values need
        :param buffer_class: to fill
        :param buffer_kwargs: of that :class:`~sb3_said.replay.buffer.DelayedReplayBuffer`
        """
        max_delay = check_spaces(observation_space, action_space).max_delay
        size = rows_for_logs(len(self), max_delay)
        buffer = buffer_class(size, observation_space, action_space, **buffer_kwargs)
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
            "timeouts": self.truncated.astype(np.float32),
            "ages": ages,
            "steps": (np.arange(len(self)) - np.repeat(ends + 1 - lengths, lengths)).astype(np.int32),
            "ends": np.append(self.ends[:-1], False),  # what follows the newest row is no tail, but in next_states
        }
        state = {name: column[:, None] for name, column in rows.items()} | {
            "holds_logs": True,
            "pos": len(self),
            "full": False,
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
        buffer of this package, or one of SB3 that holds Box observations; a ``Dataset``; or a list of these, which are
        joined
    :param observation_space: of the task, with or without ``DelayedObservationWrapper``
    :param action_space: of the task
    :param env_id: id of the task; data of another task is refused, data of another version or a changed task warned of
    :param progress_bar: show one, where reading takes long
    :raises ValueError: for what is no dataset, a damaged file, data of other shapes or another task, actions outside
        the bounds, entries that are NaN or infinite, flags other than 0 and 1, and steps that do not follow each other.
        The message names the file and the row
    :raises FileNotFoundError: where there is no such file
    """
    state_space, action_space, _ = check_spaces(observation_space, action_space)
    read = []
    for part in source if isinstance(source, (list, tuple)) else [source]:
        log = _read(part, progress_bar)
        check_task(log.name, log.task, log.changes, env_id)
        known = [(name, columns) for name, columns in log.parts if len(columns["rewards"])]
        if not known:
            raise ValueError(f"{log.name} has no step whose next state is known.")
        box = spaces.Box(-1.0, 1.0, action_space.shape) if log.is_scaled else action_space
        read += [Dataset(**checked(name, columns, state_space, box)) for name, columns in known]
    if not read:
        raise ValueError("The list of datasets is empty; name at least one.")
    return _joined(read)


def is_file(source: Any) -> bool:
    """Tell by its suffix whether a source is the path of a file; any other text is the id of a Minari dataset."""
    return isinstance(source, (str, os.PathLike)) and Path(source).suffix in (".hdf5", ".h5", ".npz")


def _read(source: Any, progress_bar: bool) -> Log:
    if isinstance(source, Dataset):
        name = type(source).__name__
        return Log(name, None, "", [(name, _of_dataset(name, source))], is_scaled=True)
    if isinstance(source, ReplayBuffer):
        return read_buffer(source)
    if is_file(source):
        return read_file(Path(source), progress_bar)
    if isinstance(source, (str, os.PathLike)) or hasattr(source, "iterate_episodes"):
        return read_minari(source, progress_bar)
    raise ValueError(
        f"{source!r:.80} is no dataset; give the id of a Minari dataset, the path of an .npz or .hdf5 file, a replay "
        "buffer, a Dataset, or one list of these."
    )


def _of_dataset(name: str, data: Dataset) -> Columns:
    """Return the columns of a dataset, checked, since a user may have made it."""
    columns = {field.name: np.asarray(getattr(data, field.name)) for field in fields(Dataset)}
    finals = columns.pop("finals")
    check_lengths(name, columns)
    ends, states = flags(name, "ends", columns["ends"]), columns["states"]
    expected = (int(ends.sum()), *states.shape[1:])
    if not ends[-1] or finals.shape != expected:
        raise ValueError(
            f"{name} has finals of shape {finals.shape}, expected one for each end of a trajectory, {expected}, and "
            "the last step to be such an end."
        )
    return {
        "observations": states,
        "actions": columns["actions"],
        "rewards": columns["rewards"],
        "terminated": flags(name, "terminated", columns["terminated"]),
        "ends": ends,
        "next_observations": replace(data, states=states, ends=ends, finals=finals).next_states,
    }


def _joined(parts: Sequence[Dataset]) -> Dataset:
    return Dataset(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Dataset)))
