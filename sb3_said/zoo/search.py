"""A search over settings of the planner that several workers share, kept in an Optuna study."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock
from optuna.samplers import GridSampler, TPESampler
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import MaxTrialsCallback
from optuna.trial import FrozenTrial, Trial, TrialState

from sb3_said.zoo.depths import check_same

optuna.logging.set_verbosity(optuna.logging.ERROR)

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


class Stopped(BaseException):
    """Ends a trial that did not finish, so that Optuna takes it for one that still runs.

    ``GridSampler`` tries the cell of such a trial again at the end, and that of a failed trial never.
    """


@dataclass
class Search:
    """Settings of the planner tried on the same episodes; the best mean return wins.

    With the sampler ``grid`` every cell is tried once; at the end two workers may try the same one. ``tpe`` draws
    temperatures between the lowest and the highest. A trial reports the return of every episode. It is pruned once a
    Wilcoxon test of the differences to the best trial, episode by episode, says that it is worse.

    :param study: see ``open_study``
    :param tried: values of ``depth``, ``temperature`` and ``sampling_steps``
    :param put: gives the agent such settings
    :param play: returns what the agent earned, (n,), in n episodes from a reset seed on
    :param sampler: ``grid`` or ``tpe``
    :param n_trials: of the whole study, over all workers; as many as the grid has by default
    :param episodes: of a trial
    :param round_size: episodes between two looks at pruning
    :param seed: reset seed of the first episode
    """

    study: optuna.Study
    tried: dict[str, list[Any]]
    put: Callable[..., None]
    play: Callable[[int, int], Sequence[float]]
    sampler: str = "grid"
    n_trials: int | None = None
    episodes: int = 20
    round_size: int = 5
    seed: int = 20_000

    def run(self, timeout: float | None = None) -> None:
        """Make trials until there is none left to begin.

        :param timeout: seconds after which none is begun
        """
        # TPE has no seed: workers that begin together are to draw differently.
        grid = GridSampler(self.tried)
        self.study.sampler = grid if self.sampler == "grid" else TPESampler(n_startup_trials=6, constant_liar=True)
        limit = self.n_trials
        if limit is None and self.sampler == "tpe":
            limit = math.prod(map(len, self.tried.values()))
        n_made = len(self.study.get_trials(deepcopy=False, states=FINISHED))
        if (self.sampler == "grid" and grid.is_exhausted(self.study)) or (limit is not None and n_made >= limit):
            print("No trial is left to make.")
            return
        callbacks = [] if limit is None else [MaxTrialsCallback(limit, states=FINISHED)]
        try:
            self.study.optimize(self._try, timeout=timeout, callbacks=callbacks)
        except Stopped as stopped:
            raise stopped.__cause__ or stopped from None

    def _try(self, trial: Trial) -> float:
        params = {name: self._suggest(trial, name, values) for name, values in self.tried.items()}
        known = next((made for made in finished(self.study) if made.params == params), None)
        if known is not None:  # in a smaller grid, of an earlier call
            for step, value in known.intermediate_values.items():
                trial.report(value, step)
            if known.value is None or known.state == TrialState.PRUNED:
                raise optuna.TrialPruned
            return known.value
        try:
            self.put(**params)
            return self._play(trial)
        except optuna.TrialPruned:
            raise
        except (Exception, KeyboardInterrupt) as error:
            raise Stopped from error

    def _suggest(self, trial: Trial, name: str, values: list[Any]) -> Any:
        if name == "temperature":
            return trial.suggest_float(name, min(values), max(values))
        if self.sampler == "tpe":
            return trial.suggest_categorical(name, values)
        return trial.suggest_int(name, min(values), max(values))  # a grid can grow, the choices of a category cannot

    def _play(self, trial: Trial) -> float:
        returns: list[float] = []
        is_pruned = False
        while len(returns) < self.episodes and not is_pruned:
            for value in self.play(self.seed + len(returns), min(self.round_size, self.episodes - len(returns))):
                trial.report(float(value), len(returns))
                returns.append(float(value))
            is_pruned = len(returns) < self.episodes and trial.should_prune()
        mean = float(np.mean(returns))
        told = f"trial {trial.number}: {describe(trial.params)}: mean return {mean:,.1f} over {len(returns)} episodes"
        print(told + " (pruned)" * is_pruned, flush=True)
        if is_pruned:
            raise optuna.TrialPruned
        return mean


def open_study(folder: Path, storage: str, name: str, settings: dict[str, Any], prune: float) -> optuna.Study:
    """Open a study, or begin it.

    :param folder: shared by the workers, for a lock
    :param storage: an Optuna RDB URL, or the path of a journal file
    :param settings: in JSON types, what all trials must have in common to be compared
    :param prune: p-value below which a trial is pruned; 0 prunes none
    :raises ValueError: when the study was begun with other settings
    """
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(), FileLock(folder / "study.lock"):
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        pruner = optuna.pruners.WilcoxonPruner(p_threshold=prune) if prune > 0 else optuna.pruners.NopPruner()
        study = optuna.create_study(
            storage=open_storage(storage), study_name=name, direction="maximize", load_if_exists=True, pruner=pruner
        )
        if "settings" not in study.user_attrs:
            study.set_user_attr("settings", settings)
    advice = "Go on with the old ones, or begin another study with --study-name."
    check_same(f"Study {name!r} in {storage} was begun", study.user_attrs["settings"], settings, advice)
    return study


def open_storage(storage: str) -> BaseStorage:
    """Open an RDB by its URL, or a journal file by its path."""
    if "://" in storage:
        # SQLite lets one worker write at a time, and tells the others that wait longer than this to give up.
        patience = {"connect_args": {"timeout": 120}} if storage.startswith("sqlite") else {}
        return RDBStorage(storage, engine_kwargs=patience)
    Path(storage).parent.mkdir(parents=True, exist_ok=True)
    return JournalStorage(JournalFileBackend(storage))


def finished(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that are complete or pruned; of several with equal settings, the first."""
    trials = study.get_trials(deepcopy=False, states=FINISHED)
    return list({tuple(sorted(trial.params.items())): trial for trial in reversed(trials)}.values())[::-1]


def find_winner(study: optuna.Study) -> FrozenTrial | None:
    """Return the complete trial of the highest mean; of equals, the shallowest, quickest and coldest."""
    complete = [trial for trial in finished(study) if trial.state == TrialState.COMPLETE]
    return max(complete, key=lambda t: (t.value, *(-t.params[name] for name in sorted(t.params))), default=None)


def describe(params: Mapping[str, float]) -> str:
    """Write what was tried, such as "depth 2, temperature 0.3, sampling steps 5"."""
    return ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in params.items())


def returns_of(trial: FrozenTrial) -> list[float]:
    """Return what a trial reported: the return of each of its episodes, in the order of their seeds."""
    return [trial.intermediate_values[step] for step in sorted(trial.intermediate_values)]


def save_plot(study: optuna.Study, path: Path) -> None:
    """Draw the mean return over each setting, of complete trials.

    :raises ImportError: without matplotlib
    """
    import matplotlib

    matplotlib.use("Agg")
    from optuna.visualization.matplotlib import plot_slice

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        axes = np.ravel(np.asarray(plot_slice(study, target_name="mean return")))
    axes[0].figure.savefig(path, dpi=150, bbox_inches="tight")
    matplotlib.pyplot.close(axes[0].figure)
