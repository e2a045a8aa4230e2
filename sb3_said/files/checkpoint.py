"""Atomic checkpoints of a whole training run: what a run killed at any moment needs to go on."""

from __future__ import annotations

import functools
import math
import random
import time
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_said.files.agents import SafeSaveMixin, agent_state, restore_agent
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree, readable, save_tree
from sb3_said.files.arguments import as_data
from sb3_said.files.normalization import check_statistics, get_statistics, set_statistics

CHECKPOINT_NAME = "checkpoint.zip"
_EVALUATION = ("n_calls", "best_mean_reward", "evaluations_timesteps", "evaluations_results", "evaluations_length")
_SUCCESSES = "evaluations_successes"  # of tasks that tell them, and empty for others
_PATIENCE = "no_improvement"  # of callbacks that stop where nothing has improved: the best mean, and evaluations since

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
        """Begin to wait for the next."""
        size = self.path.stat().st_size if self.path.exists() else 0
        self._due = time.monotonic() + max(SECONDS, size / BYTES_A_SECOND)

    def is_due(self) -> bool:
        return time.monotonic() >= self._due

    def save(self, what: str, state: dict[str, Any], metadata: dict[str, Any] | None = None) -> bool:
        """Write it and wait for the next; return whether it is written.

        A full disk is no reason to lose what learns: a warning says so, and the checkpoint before stays.

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
    one file, which replaces the previous one only once it is whole; with them how long SB3's monitor files were then.

    :param folder: of the run; the file is ``checkpoint.zip`` in it
    :param save_freq: environment steps between two checkpoints. By default time decides: ten minutes, and longer where
        the replay is large, so that checkpoints write at most half a megabyte a second (2.4 GB every 80 minutes)
    :param should_stop: asked before every rollout, where nothing is half done; learning then ends with a
        ``KeyboardInterrupt``
    :param keeps_replay: False writes a checksum of the replay instead, where it is a dataset that a resume reads again
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
        # A resume makes an agent anew: it has the replay that this one was given from nowhere else, and would take a
        # checkpoint that another run has left in this folder
        if self._saved_at < 0 and (is_there or (self.keeps_replay and _replay_buffer(self.model).size() > 0)):
            self.save()

    def _is_own(self) -> bool:
        """Tell whether the checkpoint that is there is of this agent as it is now."""
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

        Where it cannot be written, as on a full disk, a warning says so, and the one before stays.

        :raises ValueError: for a run that has gone wrong, whose state is not finite; the one before stays
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
    """Return a number that tells replays apart, of all that they teach."""
    return crc32(part for part in _replay_buffer(model).state_dict().values() if isinstance(part, np.ndarray))


def crc32(arrays: Iterable[np.ndarray]) -> int:
    """Return the CRC-32 of arrays, one behind the other."""
    return functools.reduce(lambda found, array: zlib.crc32(np.ascontiguousarray(array).data, found), arrays, 0)


def evaluations_of(callback: BaseCallback | None) -> list[dict[str, Any]]:
    """Return the evaluations that each ``EvalCallback`` has made so far."""
    return [
        {
            **{name: np.array(getattr(evaluation, name)).tolist() for name in (*_EVALUATION, _SUCCESSES)},
            _PATIENCE: [[float(one.last_best_mean_reward), one.no_improvement_evals] for one in _stoppers(evaluation)],
        }
        for evaluation in _eval_callbacks(callback)
    ]


def restore_evaluations(callback: BaseCallback | None, saved: list[dict[str, Any]]) -> None:
    """Give each ``EvalCallback`` what :func:`evaluations_of` returned.

    :raises ValueError: for another number of them, or of their episodes
    :raises SavedFileError: for evaluations other than an EvalCallback's
    """
    eval_callbacks = _eval_callbacks(callback)
    if len(eval_callbacks) != len(saved):
        raise ValueError(
            f"the run had {len(saved)} EvalCallback and is resumed with {len(eval_callbacks)}; resume with the "
            "callbacks of the run"
        )
    for eval_callback, kept in zip(eval_callbacks, saved, strict=True):
        _check_evaluation(kept)
        n_episodes = {np.size(returns) for returns in kept["evaluations_results"]}
        if n_episodes - {eval_callback.n_eval_episodes}:  # its file, one array of all, could not be written
            raise ValueError(
                f"the run's evaluations are of {', '.join(map(str, n_episodes))} episodes and it is resumed with "
                f"{eval_callback.n_eval_episodes}; resume with as many as before"
            )
    for eval_callback, kept in zip(eval_callbacks, saved, strict=True):
        for name in _EVALUATION:
            setattr(eval_callback, name, kept[name])
        eval_callback.evaluations_successes = kept[_SUCCESSES]
        for stopper, (best, n) in zip(_stoppers(eval_callback), kept[_PATIENCE], strict=False):
            stopper.last_best_mean_reward, stopper.no_improvement_evals = best, n


def restore_training(model: SafeSaveMixin, path: str | Path, callback: BaseCallback | None = None) -> None:
    """Bring a newly made model to where a checkpoint was written. Its environment starts a new episode.

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
        _check_random_state(state["random"])
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
        # A seed that no other use has: large, where those of runs, evaluation and tuning are small numbers.
        drawn = np.random.SeedSequence([model.seed, model.num_timesteps]).generate_state(1)[0]
        seed = 2**30 + int(drawn) % 2**30
        model.env.seed(seed)
        model.action_space.seed(seed)


def random_state() -> dict[str, Any]:
    """Return the global random states of Python, NumPy and torch."""
    name, keys, *numpy_rest = np.random.get_state(legacy=True)
    state = {"python": random.getstate(), "numpy": [name, np.asarray(keys), *numpy_rest], "torch": th.get_rng_state()}
    if th.cuda.is_initialized():  # a run on the CPU takes no memory of a GPU
        state["cuda"] = th.cuda.get_rng_state_all()
    return state


def restore_random_state(state: dict[str, Any]) -> None:
    """Restore what ``random_state`` returned.

    :raises SavedFileError: for a state that NumPy's generator never has, which would crash the process
    """
    _check_random_state(state)
    (version, internal, gauss), (name, keys, *rest) = state["python"], state["numpy"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state((name, keys, *rest))
    th.set_rng_state(state["torch"])
    if "cuda" in state and th.cuda.is_available():
        th.cuda.set_rng_state_all(state["cuda"][: th.cuda.device_count()])  # the machine before may have had more


def _check_random_state(state: dict[str, Any]) -> None:
    """:raises SavedFileError: for states that no generator has; their own checks let some pass"""
    version, internal, gauss = state["python"]
    random.Random().setstate((version, tuple(internal), gauss))  # raises, and no global generator has changed yet
    name, keys, position, has_gauss, cached = state["numpy"]
    if name != "MT19937" or type(position) is not int or not 0 <= position <= 624:
        raise SavedFileError(f"NumPy's random state is {name!s:.20} at position {position!s:.20}, expected 0..624")
    if not isinstance(keys, np.ndarray) or (keys.dtype, keys.shape) != (np.uint32, (624,)):
        raise SavedFileError("NumPy's random state is not of 624 numbers")
    if has_gauss not in (0, 1) or not all(x is None or _is_finite(x) for x in (gauss, cached)):
        raise SavedFileError("a random state keeps a number that is not finite for its next draw")
    probe = th.Generator()
    probe.set_state(state["torch"])
    if not th.randn(2, generator=probe, dtype=th.float64).isfinite().all():
        raise SavedFileError("torch's random state draws numbers that are not finite")


def _check_evaluation(saved: dict[str, Any]) -> None:
    """:raises SavedFileError: for evaluations other than an EvalCallback's"""
    best, results = saved["best_mean_reward"], [saved[name] for name in _EVALUATION[2:]]
    if type(saved["n_calls"]) is not int or type(best) is not float or best != best:
        raise SavedFileError(f"an evaluation has n_calls {saved['n_calls']!s:.20} and the best mean {best!s:.20}")
    if any(type(rows) is not list or len(rows) != len(results[0]) for rows in results):
        raise SavedFileError("evaluations differ in how many they are")
    successes = saved[_SUCCESSES]
    if type(successes) is not list or len(successes) > len(results[0]):  # fewer, where some evaluations told none
        raise SavedFileError("evaluations differ in how many they are")
    if any(np.asarray(rows).dtype.kind not in "bif" for rows in (*results, successes) if rows):
        raise SavedFileError("evaluations hold more than numbers")
    for mean, n in saved[_PATIENCE]:
        if type(mean) is not float or mean != mean or type(n) is not int or n < 0:
            raise SavedFileError(f"an evaluation has not improved on {mean!s:.20} for {n!s:.20}")


def _stoppers(evaluation: EvalCallback) -> list[StopTrainingOnNoModelImprovement]:
    """Return the callbacks below an ``EvalCallback`` that stop where nothing has improved."""
    children = [evaluation.callback_on_new_best, evaluation.callback]
    several = [one for child in children for one in (child.callbacks if isinstance(child, CallbackList) else [child])]
    return [one for one in several if isinstance(one, StopTrainingOnNoModelImprovement)]


def _is_finite(x: Any) -> bool:
    return type(x) in (int, float) and math.isfinite(x)


def _replay_buffer(model: OffPolicyAlgorithm) -> Any:
    if not hasattr(model.replay_buffer, "load_state_dict"):
        name = type(model.replay_buffer).__name__
        raise ValueError(
            f"Checkpoints need a replay buffer with a state_dict, such as DelayedReplayBuffer, got {name}."
        )
    return model.replay_buffer


def _eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    if isinstance(callback, CallbackList):  # nested: SB3's progress bar puts the run's list into another
        return [found for child in callback.callbacks for found in _eval_callbacks(child)]
    if isinstance(callback, EvalCallback):
        return [callback]
    return _eval_callbacks(callback.callback) if isinstance(callback, EventCallback) else []
