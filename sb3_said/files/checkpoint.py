"""Atomic checkpoints of a whole training run: what a run killed at any moment needs to go on."""

from __future__ import annotations

import functools
import time
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_said.files.agents import SafeSaveMixin
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree, readable, save_tree
from sb3_said.files.arguments import as_data
from sb3_said.files.evaluations import evaluations_of, restore_evaluations
from sb3_said.files.normalization import check_statistics, get_statistics, set_statistics
from sb3_said.files.random_states import check_random_state, random_state, restore_random_state
from sb3_said.files.state import agent_state, restore_agent

CHECKPOINT_NAME = "checkpoint.zip"

SECONDS = 600.0  # of training between two checkpoints, at least
BYTES_A_SECOND = 500_000  # that checkpoints write at most, over the whole training


class CheckpointClock:
    """Says when a checkpoint is due: ten minutes after the last, and later where its file is large.

    :param path: of the checkpoint
    """

    def __init__(self, path: Path):
        self.path = path
        self.wait()

    def wait(self) -> None:
        """Start waiting for the next checkpoint."""
        size = self.path.stat().st_size if self.path.exists() else 0
        self._due = time.monotonic() + max(SECONDS, size / BYTES_A_SECOND)

    def is_due(self) -> bool:
        return time.monotonic() >= self._due

    def save(self, what: str, state: dict[str, Any], metadata: dict[str, Any] | None = None) -> bool:
        """Write a checkpoint and wait for the next; return whether it is written.

        A full disk is no reason to end the training: it only warns, and the previous checkpoint stays.

        :param what: the checkpoint's name, for the warning
        """
        try:
            save_tree(self.path, state, metadata)
        except OSError as error:
            warnings.warn(
                f"{what} could not be written to {self.path} ({error}). Training goes on; make room, or a crash loses "
                "what was learned since the last one.",
                stacklevel=3,
            )
            return False
        finally:
            self.wait()
        return True


class TrainingCheckpointCallback(BaseCallback):
    """Write everything that a run needs to go on, from time to time and when learning ends.

    Model, optimizers, replay buffer, counters, normalisation statistics, evaluations so far and random states go into
    one file, which replaces the previous one only once it is whole. It also has the length of SB3's monitor files.

    :param folder: of the run; the file is ``checkpoint.zip`` in it
    :param save_freq: environment steps between two checkpoints. By default time decides: ten minutes, and longer where
        the replay is large, so that checkpoints write at most half a megabyte a second (2.4 GB every 80 minutes)
    :param should_stop: asked before every rollout, where nothing is half done; True ends learning with a
        ``KeyboardInterrupt``
    :param keeps_replay: False writes only a checksum of the replay, for a dataset that a resume reads again
    """

    model: SafeSaveMixin

    def __init__(
        self,
        folder: str | Path,
        save_freq: int | None = None,
        should_stop: Callable[[], bool] | None = None,
        keeps_replay: bool = True,
    ):
        super().__init__()
        self.keeps_replay = keeps_replay
        self.path = Path(folder) / CHECKPOINT_NAME
        self.save_freq = save_freq
        self.should_stop = should_stop or (lambda: False)
        self._tried_at = self._saved_at = -1  # num_timesteps
        self._clock = CheckpointClock(self.path)

    def _on_training_start(self) -> None:
        self._tried_at = self.model.num_timesteps
        is_there = self.path.exists()
        self._saved_at = self._tried_at if self._tried_at > 0 and is_there and self._is_own() else -1
        self._clock.wait()
        # A resume makes a new agent, which has only the checkpoint. So write now a replay that this agent was given,
        # and replace a checkpoint that another run has left in this folder.
        if self._saved_at < 0 and (is_there or (self.keeps_replay and _replay_buffer(self.model).size() > 0)):
            self.save()

    def _is_own(self) -> bool:
        """Tell whether the existing checkpoint is of this agent as it is now."""
        try:
            return bool(load_metadata(self.path)["metadata"].get("at") == self._now())
        except SavedFileError:
            return False

    def _now(self) -> list[int]:
        weights = self.model.policy.state_dict().values()
        return [self.model.num_timesteps, crc32(x.numpy(force=True) for x in weights)]

    def _on_rollout_start(self) -> None:
        # Here, and not in on_step, the replay buffer holds every step taken and the updates have caught up with it.
        if self.should_stop():
            raise KeyboardInterrupt
        if self.save_freq is None:
            is_due = self._clock.is_due()
        else:
            is_due = self.model.num_timesteps - self._tried_at >= self.save_freq
        if is_due:
            self.save()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.save()

    def save(self) -> bool:
        """Write a checkpoint now, if there is anything new; return whether the file has it all.

        If it cannot be written, as on a full disk, a warning says so, and the previous checkpoint stays.

        :raises ValueError: for a run whose state is not finite; the previous checkpoint stays
        """
        self._tried_at = self.model.num_timesteps
        if self._tried_at != self._saved_at:
            state = training_state(self.model, self.locals.get("callback"), self.keeps_replay)
            check_finite(state, self.path)
            monitors = {file.name: file.stat().st_size for file in self.path.parent.glob("*.monitor.csv")}
            about = {"monitors": monitors, "at": self._now()}
            if self._clock.save(f"The checkpoint of step {self._tried_at}", state, about):
                self._saved_at = self._tried_at
        return self._saved_at == self._tried_at


def check_finite(state: dict[str, Any], path: Path) -> None:
    """Refuse a state that no training can go on from.

    :param state: as ``training_state`` returns it
    :param path: of the checkpoint that stays, for the message
    :raises ValueError: naming what is not finite
    """
    for part in ("parameters", "variables", "vec_normalize", "replay_buffer"):
        for where, value in _numbers(state[part], part):
            # min and max keep NaN, and need no second array of a replay's size
            if value.size and not (np.isfinite(value.min()) and np.isfinite(value.max())):
                raise ValueError(
                    f"The training has gone wrong: {where} is not finite. No checkpoint is written of it. {path} stays "
                    "as it was, and --resume goes on from there; find out what made it so (a NaN of the environment, "
                    "too high a learning rate)."
                )


def _numbers(tree: Any, where: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays and tensors of floating numbers in a tree, each with its place."""
    if isinstance(tree, (dict, list, tuple)):
        for key, item in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from _numbers(item, f"{where}[{key!r}]")
    elif isinstance(tree, (th.Tensor, np.ndarray, np.generic)):
        array = tree.numpy(force=True) if isinstance(tree, th.Tensor) else np.asarray(tree)
        if array.dtype.kind == "f":
            yield where, array


def training_state(
    model: SafeSaveMixin, callback: BaseCallback | None = None, keeps_replay: bool = True
) -> dict[str, Any]:
    """Return the state of a run as nested dicts of tensors, arrays and numbers.

    :param model: with a replay buffer that has a ``state_dict``
    :param callback: whose ``EvalCallback`` evaluations are kept too
    :param keeps_replay: False for a checksum in the replay's place
    """
    return {
        **agent_state(model),
        "settings": {name: as_data(getattr(model, name), name) for name in model.settings_arguments},
        "replay_buffer": _replay_buffer(model).state_dict() if keeps_replay else {"checksum": checksum(model)},
        "vec_normalize": get_statistics(model.get_vec_normalize_env()),
        "evaluations": evaluations_of(callback),
        "random": random_state(),
    }


def checksum(model: OffPolicyAlgorithm) -> int:
    """Return a checksum of all that a replay teaches."""
    return crc32(part for part in _replay_buffer(model).state_dict().values() if isinstance(part, np.ndarray))


def crc32(arrays: Iterable[np.ndarray]) -> int:
    """Return the CRC-32 of arrays, one behind the other."""
    return functools.reduce(lambda found, array: zlib.crc32(np.ascontiguousarray(array).data, found), arrays, 0)


def restore_training(model: SafeSaveMixin, path: str | Path, callback: BaseCallback | None = None) -> None:
    """Bring a newly made model to the state of a checkpoint. Its environment starts a new episode.

    The environment is seeded from the run's seed and the step reached, so two resumes from one checkpoint are the same
    and neither repeats the run's first episodes.

    :param model: made with the arguments of the run
    :param path: of a ``checkpoint.zip``
    :param callback: made as the run's, whose ``EvalCallback`` evaluations are restored
    :raises SavedFileError: when the file is damaged or forged, or does not fit the model
    :raises ValueError: when the model's replay buffer has no ``load_state_dict``
    """
    replay_buffer = _replay_buffer(model)
    state = load_tree(path)
    with readable(path, explained=(ValueError,)):
        restore_evaluations(callback, state["evaluations"])
        check_random_state(state["random"])
        check_statistics(model.get_vec_normalize_env(), state["vec_normalize"])
        is_dataset = "checksum" in state["replay_buffer"]
        if is_dataset and state["replay_buffer"]["checksum"] != checksum(model):
            raise ValueError("it is of a training on other data; resume with the dataset of the run")
        model._take_settings(state)
        restore_agent(model, state)
        if not is_dataset:
            replay_buffer.load_state_dict(state["replay_buffer"])
        set_statistics(model.get_vec_normalize_env(), state["vec_normalize"])
        restore_random_state(state["random"])
    model._last_obs = None  # the replay's newest episode is not the environment's, even where it looks so
    if model.seed is not None and model.env is not None:
        # A seed that nothing else uses: it is large, those of runs, evaluation and tuning are small.
        drawn = np.random.SeedSequence([model.seed, model.num_timesteps]).generate_state(1)[0]
        seed = 2**30 + int(drawn) % 2**30
        model.env.seed(seed)
        model.action_space.seed(seed)


def _replay_buffer(model: OffPolicyAlgorithm) -> Any:
    if not hasattr(model.replay_buffer, "load_state_dict"):
        name = type(model.replay_buffer).__name__
        raise ValueError(
            f"Checkpoints need a replay buffer with a state_dict, such as DelayedReplayBuffer, got {name}."
        )
    return model.replay_buffer
