"""Atomic checkpoints of a whole training run: what a run killed at any moment needs to go on."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.files.agents import SafeSaveMixin, agent_state, restore_agent
from sb3_said.files.archive import SavedFileError, load_tree, readable, save_tree

CHECKPOINT_NAME = "checkpoint.zip"
_EVALUATION = ("n_calls", "best_mean_reward", "evaluations_timesteps", "evaluations_results", "evaluations_length")


class TrainingCheckpointCallback(BaseCallback):
    """Write everything that a run needs to go on, every ``save_freq`` environment steps and when learning ends.

    Model, optimizers, replay buffer, counters, normalisation statistics, evaluations so far and random states go into
    one file, which replaces the previous one only once it is whole.

    :param folder: of the run; the file is ``checkpoint.zip`` in it
    :param save_freq: environment steps between two checkpoints
    """

    def __init__(self, folder: str | Path, save_freq: int):
        super().__init__()
        self.path = Path(folder) / CHECKPOINT_NAME
        self.save_freq = save_freq
        self._saved_at = 0

    def _on_training_start(self) -> None:
        self._saved_at = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        # Here, and not in on_step, the replay buffer holds every step taken and the updates have caught up with it.
        if self.model.num_timesteps - self._saved_at >= self.save_freq:
            self.save()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if self.model.num_timesteps > self._saved_at:
            self.save()

    def save(self) -> None:
        """Write a checkpoint now."""
        assert isinstance(self.model, SafeSaveMixin)
        save_tree(self.path, training_state(self.model, self.locals.get("callback")))
        self._saved_at = self.model.num_timesteps


def training_state(model: SafeSaveMixin, callback: BaseCallback | None = None) -> dict[str, Any]:
    """Return the state of a run as nested dicts of tensors, arrays and numbers.

    :param model: with a replay buffer that has a ``state_dict``
    :param callback: whose ``EvalCallback`` evaluations are kept too
    """
    statistics = _statistics(model.get_vec_normalize_env())
    return {
        **agent_state(model),
        "replay_buffer": _replay_buffer(model).state_dict(),
        "vec_normalize": {name: [rms.mean, rms.var, rms.count] for name, rms in statistics.items()},
        "evaluations": [
            {name: np.array(getattr(evaluation, name)).tolist() for name in _EVALUATION}
            for evaluation in _eval_callbacks(callback)
        ],
        "random": random_state(),
    }


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
    replay_buffer, eval_callbacks = _replay_buffer(model), _eval_callbacks(callback)
    statistics = _statistics(model.get_vec_normalize_env())
    state = load_tree(path)
    with readable(path, explained=(ValueError,)):
        if len(eval_callbacks) != len(state["evaluations"]):
            raise ValueError(
                f"the run had {len(state['evaluations'])} EvalCallback and is resumed with {len(eval_callbacks)}; "
                "resume with the callbacks of the run"
            )
        if statistics.keys() != state["vec_normalize"].keys():
            raise ValueError(
                f"in the run VecNormalize normalised {', '.join(state['vec_normalize']) or 'nothing'}, in this model's "
                f"environment {', '.join(statistics) or 'nothing'}; resume with the environment of the run"
            )
        for name, rms in statistics.items():
            _check_statistics(name, state["vec_normalize"][name], rms)
        for kept in state["evaluations"]:
            _check_evaluation(kept)
        _check_random_state(state["random"])
        restore_agent(model, state)
        replay_buffer.load_state_dict(state["replay_buffer"])
        for name, rms in statistics.items():
            rms.mean, rms.var, rms.count = state["vec_normalize"][name]
        for eval_callback, kept in zip(eval_callbacks, state["evaluations"], strict=True):
            for name in _EVALUATION:
                setattr(eval_callback, name, kept[name])
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
    if th.cuda.is_available():
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
        th.cuda.set_rng_state_all(state["cuda"])


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


def _check_statistics(name: str, saved: list[Any], own: RunningMeanStd) -> None:
    """:raises SavedFileError: for statistics of VecNormalize of another shape, or that scale by no number"""
    mean, var, count = saved
    for part, like in ((mean, own.mean), (var, own.var)):
        if (
            np.shape(part) != np.shape(like)
            or not np.isfinite(part).all()
            or np.any(np.asarray(part) < 0) & (part is var)
        ):
            raise SavedFileError(f"its statistics of {name} do not fit: {part!s:.100}")
    if not _is_finite(count) or count < 0:
        raise SavedFileError(f"its statistics of {name} do not fit: of {count!s:.20} numbers")


def _check_evaluation(saved: dict[str, Any]) -> None:
    """:raises SavedFileError: for evaluations other than an EvalCallback's"""
    best, results = saved["best_mean_reward"], [saved[name] for name in _EVALUATION[2:]]
    if type(saved["n_calls"]) is not int or type(best) is not float or best != best:
        raise SavedFileError(f"an evaluation has n_calls {saved['n_calls']!s:.20} and the best mean {best!s:.20}")
    if any(type(rows) is not list or len(rows) != len(results[0]) for rows in results):
        raise SavedFileError("evaluations differ in how many they are")
    if any(np.asarray(rows).dtype.kind not in "if" for rows in results if rows):
        raise SavedFileError("evaluations hold more than numbers")


def _is_finite(x: Any) -> bool:
    return type(x) in (int, float) and math.isfinite(x)


def _replay_buffer(model: OffPolicyAlgorithm) -> Any:
    if not hasattr(model.replay_buffer, "load_state_dict"):
        name = type(model.replay_buffer).__name__
        raise ValueError(
            f"Checkpoints need a replay buffer with a state_dict, such as DelayedReplayBuffer, got {name}."
        )
    return model.replay_buffer


def _statistics(vec_normalize: VecNormalize | None) -> dict[str, RunningMeanStd]:
    """Return what VecNormalize has learned of rewards and observations, and nothing without it."""
    if vec_normalize is None:
        return {}
    observations = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
    if isinstance(observations, RunningMeanStd):
        observations = {"observation": observations}
    return {"return": vec_normalize.ret_rms, **{f"obs/{key}": rms for key, rms in observations.items()}}


def _eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    if isinstance(callback, CallbackList):  # nested: SB3's progress bar puts the run's list into another
        return [found for child in callback.callbacks for found in _eval_callbacks(child)]
    return [callback] if isinstance(callback, EvalCallback) else []
