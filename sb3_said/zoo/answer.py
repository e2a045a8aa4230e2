"""What a run plays beside its training: evaluations while it learns, and one of the trained agent as it answers."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_said import SAID, DelayedSAC
from sb3_said.evaluation.rollout import warn_if_long
from sb3_said.files.atomic import replacing
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.zoo.stopping import Stopping

BEST_NAME = "best_model.zip"  # of the agent that did best in training, as SB3's EvalCallback names it
EXPERT_FOLDER = "expert"  # in the run's folder: what EvalCallback wrote while the expert learned


class _BrokenOff(Exception):
    pass


class StoppableEvaluation(EvalCallback):
    """SB3's ``EvalCallback``. An evaluation breaks off when the training is asked to stop.

    A resumed training plays it again in its first step. All later evaluations then come one step later, too.

    :param stopping: says whether the training is asked to stop
    """

    def __init__(self, eval_env: VecEnv, stopping: Stopping, **kwargs: Any):
        super().__init__(eval_env, **kwargs)
        self.stopping = stopping

    def _on_step(self) -> bool:
        try:
            return super()._on_step()
        except _BrokenOff:
            self.n_calls -= 1  # so that the next call plays it again
            return True

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if self.stopping.is_asked:
            raise _BrokenOff
        _warn_if_long(locals_)
        super()._log_success_callback(locals_, globals_)


def _warn_if_long(of_evaluate_policy: dict[str, Any]) -> None:
    if not of_evaluate_policy["done"]:
        warn_if_long(int(of_evaluate_policy["current_lengths"][of_evaluate_policy["i"]]))


def evaluate_answer(model: SAID, like: EvalCallback, folder: Path, stopping: Stopping) -> None:
    """Play a trained agent as it answers, and add the returns to ``evaluations.npz`` in the run's folder.

    Beside SB3's arrays, ``answers`` says who answered. The first row, of step 0, holds NaN: there was no planner yet,
    and rl_zoo3's plots need two rows. ``best_model.zip`` is the agent of the row with the highest mean.

    :param like: callback that gives the environment and the number of episodes
    :param stopping: ends the evaluation with a ``KeyboardInterrupt``
    """
    if model.get_vec_normalize_env() is not None:
        sync_envs_normalization(model.env, like.eval_env)  # type: ignore[arg-type]  # a trained agent has one

    def on_step(locals_: dict[str, Any], _: object) -> None:
        if stopping.is_asked:
            raise KeyboardInterrupt
        _warn_if_long(locals_)

    like.eval_env.seed(model.seed)  # so a resumed run plays the same episodes as one never stopped
    played: Any = evaluate_policy(
        model, like.eval_env, like.n_eval_episodes, like.deterministic, callback=on_step, return_episode_rewards=True
    )
    returns, lengths = played
    path, now, who = folder / "evaluations.npz", model.num_timesteps, model.policy.who_answers
    rows: dict[int, Sequence[Any]] = {0: ([np.nan] * len(returns), [0] * len(returns), "")}
    if path.exists():
        # One array can only hold evaluations of equally many episodes.
        rows |= {t: row for t, *row in _rows_before(path) if 0 < t < now and len(row[0]) == len(returns)}
    best = max((np.mean(row[0]) for step, row in rows.items() if step > 0), default=-np.inf)
    rows[now] = (returns, lengths, who)
    with replacing(path) as file:
        results, ep_lengths, answers = zip(*rows.values(), strict=True)
        np.savez(file, timesteps=list(rows), results=results, ep_lengths=ep_lengths, answers=answers)
    mean = float(np.mean(returns))
    name = "both" if who == "both" else f"the {who}"
    print(f"Evaluation of {name}: mean return {mean:.2f} over {len(returns)} episodes")
    model.logger.record("eval/answer_mean_reward", mean)
    model.logger.record("eval/answer_mean_ep_length", float(np.mean(lengths)))
    model.logger.dump(model.num_timesteps)
    if mean >= best:
        save_with_normalization(model, folder / BEST_NAME)


def _rows_before(path: Path) -> list[tuple[Any, ...]]:
    """Return the rows of a file of evaluations: step, returns, ...; none of a damaged file, with a warning."""
    try:
        with np.load(path) as file:
            columns = [file[name].tolist() for name in ("timesteps", "results", "ep_lengths", "answers")]
        return [*zip(*columns, strict=True)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        warnings.warn(f"{path} cannot be read ({error}), and is begun anew.", stacklevel=3)
        return []


def save_with_normalization(model: DelayedSAC, path: Path) -> None:
    """Write an agent, and beside it the statistics that normalise its observations."""
    model.save(path)
    vec_normalize = model.get_vec_normalize_env()
    if vec_normalize is not None:
        save_normalization(normalization_file(path), vec_normalize)
