"""Atomic checkpoints of a whole training run: what a run killed at any moment needs to go on."""

from __future__ import annotations

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
    vec_normalize = model.get_vec_normalize_env()
    return {
        **agent_state(model),
        "replay_buffer": _replay_buffer(model).state_dict(),
        "vec_normalize": None if vec_normalize is None else _vec_normalize_state(vec_normalize),
        "evaluations": [_evaluation_state(e) for e in _eval_callbacks(callback)],
        "random": random_state(),
    }


def restore_training(model: SafeSaveMixin, path: str | Path, callback: BaseCallback | None = None) -> None:
    """Bring a newly made model to where a checkpoint was written. Its environment starts a new episode.

    The environment is seeded from the run's seed and the step reached, so two resumes from one checkpoint are the same
    and neither repeats the run's first episodes.

    :param model: made with the arguments of the run
    :param path: of a ``checkpoint.zip``
    :param callback: made as the run's, whose ``EvalCallback`` evaluations are restored
    :raises ValueError: when the checkpoint does not fit the model
    """
    replay_buffer, eval_callbacks = _replay_buffer(model), _eval_callbacks(callback)
    state = load_tree(path)
    if len(eval_callbacks) != len(state["evaluations"]):
        raise ValueError(
            f"The run of {path} had {len(state['evaluations'])} EvalCallback and is resumed with "
            f"{len(eval_callbacks)}; resume with the callbacks of the run."
        )
    vec_normalize = model.get_vec_normalize_env()
    if (vec_normalize is None) != (state["vec_normalize"] is None):
        raise ValueError(
            f"The run of {path} was {'not ' if vec_normalize else ''}normalised by VecNormalize, and this model's "
            f"environment is{'' if vec_normalize else ' not'}; resume with the environment of the run."
        )
    with readable(path):
        restore_agent(model, state)
    replay_buffer.load_state_dict(state["replay_buffer"])
    if vec_normalize is not None:
        _restore_vec_normalize(vec_normalize, state["vec_normalize"])
    for eval_callback, kept in zip(eval_callbacks, state["evaluations"], strict=True):
        _restore_evaluations(eval_callback, kept)
    model._last_obs = None  # the replay's newest episode is not the environment's, even where it looks so
    if model.seed is not None and model.env is not None:
        seed = _seed_of_resume(model.seed, model.num_timesteps)
        model.env.seed(seed)
        model.action_space.seed(seed)
    with readable(path):
        restore_random_state(state["random"])


def _seed_of_resume(seed: int, steps: int) -> int:
    """Return a seed that no other use has: large, where those of runs, evaluation and tuning are small numbers."""
    return 2**30 + int(np.random.SeedSequence([seed, steps]).generate_state(1)[0]) % 2**30


def random_state() -> dict[str, Any]:
    """Return the global random states of Python, NumPy and torch."""
    name, keys, *numpy_rest = np.random.get_state(legacy=True)
    state = {"python": random.getstate(), "numpy": [name, np.asarray(keys), *numpy_rest], "torch": th.get_rng_state()}
    if th.cuda.is_available():
        state["cuda"] = th.cuda.get_rng_state_all()
    return state


def restore_random_state(state: dict[str, Any]) -> None:
    """Restore what ``random_state`` returned.

    :raises SavedFileError: for a position that NumPy's generator never has, which would crash the process
    """
    version, internal, gauss = state["python"]
    name, keys, position, *rest = state["numpy"]
    if name != "MT19937" or type(position) is not int or not 0 <= position <= 624:
        raise SavedFileError(f"NumPy's random state is {name} at position {position}, expected MT19937 at 0..624")
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state((name, keys, position, *rest))
    th.set_rng_state(state["torch"])
    if "cuda" in state and th.cuda.is_available():
        th.cuda.set_rng_state_all(state["cuda"])


def _replay_buffer(model: OffPolicyAlgorithm) -> Any:
    if not hasattr(model.replay_buffer, "load_state_dict"):
        name = type(model.replay_buffer).__name__
        raise ValueError(
            f"Checkpoints need a replay buffer with a state_dict, such as DelayedReplayBuffer, got {name}."
        )
    return model.replay_buffer


def _statistics(vec_normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    observations = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
    if isinstance(observations, RunningMeanStd):
        observations = {"observation": observations}
    return {"return": vec_normalize.ret_rms, **{f"obs/{key}": rms for key, rms in observations.items()}}


def _vec_normalize_state(vec_normalize: VecNormalize) -> dict[str, Any]:
    return {name: [rms.mean, rms.var, rms.count] for name, rms in _statistics(vec_normalize).items()}


def _restore_vec_normalize(vec_normalize: VecNormalize, state: dict[str, Any]) -> None:
    for name, rms in _statistics(vec_normalize).items():
        rms.mean, rms.var, rms.count = state[name]


def _eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    if isinstance(callback, CallbackList):  # nested: SB3's progress bar puts the run's list into another
        return [found for child in callback.callbacks for found in _eval_callbacks(child)]
    return [callback] if isinstance(callback, EvalCallback) else []


def _evaluation_state(callback: EvalCallback) -> dict[str, Any]:
    return {
        "n_calls": callback.n_calls,
        "best_mean_reward": float(callback.best_mean_reward),
        "timesteps": list(callback.evaluations_timesteps),
        "results": [[float(x) for x in row] for row in callback.evaluations_results],
        "lengths": [[int(x) for x in row] for row in callback.evaluations_length],
    }


def _restore_evaluations(callback: EvalCallback, state: dict[str, Any]) -> None:
    callback.n_calls = state["n_calls"]
    callback.best_mean_reward = state["best_mean_reward"]
    callback.evaluations_timesteps = state["timesteps"]
    callback.evaluations_results = state["results"]
    callback.evaluations_length = state["lengths"]
