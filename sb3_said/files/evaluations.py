"""What SB3's ``EvalCallback`` has measured so far, as a tree and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
    StopTrainingOnNoModelImprovement,
)

from sb3_said.files.archive import SavedFileError

_EVALUATION = ("n_calls", "best_mean_reward", "evaluations_timesteps", "evaluations_results", "evaluations_length")
_SUCCESSES = "evaluations_successes"  # of tasks that tell them, and empty for others
_PATIENCE = "no_improvement"  # of callbacks that stop where nothing has improved: the best mean, and evaluations since


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

    :raises ValueError: for another number of ``EvalCallback``, or of episodes of one evaluation
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
        if n_episodes - {eval_callback.n_eval_episodes}:  # EvalCallback could not write all as one array
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


def _eval_callbacks(callback: BaseCallback | None) -> list[EvalCallback]:
    if isinstance(callback, CallbackList):  # nested: SB3's progress bar puts the run's list into another
        return [found for child in callback.callbacks for found in _eval_callbacks(child)]
    if isinstance(callback, EvalCallback):
        return [callback]
    return _eval_callbacks(callback.callback) if isinstance(callback, EventCallback) else []
