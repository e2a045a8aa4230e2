"""A search over settings of the planner that several workers share, kept in an Optuna study."""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock
from optuna.samplers import GridSampler, TPESampler
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.study import MaxTrialsCallback
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError  # Optuna's data bases are SQLAlchemy's

from sb3_said.planner.checks import check_same

optuna.logging.set_verbosity(optuna.logging.ERROR)

DRAWN = ("temperature", "choice_factor")  # real numbers, which tpe draws between the lowest and the highest
OWN_STUDY = "study.log"  # in the output folder
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


class Stopped(BaseException):
    """Ends an unfinished trial in such a way that Optuna believes that it still runs.

    ``GridSampler`` tries the cell of a running trial again at the end, but never that of a failed trial.
    """


def search(
    study: optuna.Study,
    tried: dict[str, list[Any]],
    put: Callable[..., None],
    play: Callable[[int, int], Sequence[float]],
    sampler: str = "grid",
    n_trials: int | None = None,
    episodes: int = 20,
    round_size: int = 5,
    seed: int = 20_000,
    timeout: float = math.inf,
) -> None:
    """Try settings of the planner on the same episodes, until no trial is left to begin.

    With the sampler ``grid`` every cell is tried once; at the end two workers may try the same one. ``tpe`` draws
    temperatures and choice factors between the lowest and the highest. A trial reports the return of every episode. It
    is pruned once a Wilcoxon test of the differences to the best trial, episode by episode, says that it is worse. At
    temperature 0 nothing is chosen, so one choice factor is played for all.

    :param study: see ``open_study``
    :param tried: values of ``depth``, ``temperature``, ``sampling_steps`` and ``choice_factor``, or of some of them
    :param put: gives the agent such settings
    :param play: takes a reset seed and n; returns what n episodes from that seed on earned, (n,)
    :param sampler: ``grid`` or ``tpe``
    :param n_trials: of the whole study, over all workers; as many as the grid has by default
    :param episodes: of a trial
    :param round_size: episodes between two looks at pruning
    :param seed: reset seed of the first episode
    :param timeout: seconds after which no trial is begun
    :raises ValueError: where a return is not finite
    """

    def objective(trial: Trial) -> float:
        try:
            params = suggest(trial, tried, sampler)
            known = next((made for made in finished(study) if decisive(made.params) == decisive(params)), None)
            if known is not None:  # from an earlier, smaller grid, or temperature 0 with another factor
                return repeat(trial, known)
            put(**params)
            return play_trial(trial, play, episodes, round_size, seed)
        except optuna.TrialPruned:
            raise
        except (Exception, KeyboardInterrupt) as error:
            raise Stopped from error

    grid = GridSampler(tried)
    # Without a seed: workers that begin together are to draw differently.
    study.sampler = grid if sampler == "grid" else TPESampler(n_startup_trials=6, constant_liar=True)
    limit = n_trials or (math.prod(map(len, tried.values())) if sampler == "tpe" else sys.maxsize)
    n_made = len(study.get_trials(deepcopy=False, states=FINISHED))
    if n_made >= limit or (sampler == "grid" and grid.is_exhausted(study)):
        print("No trial is left to make.")
        return
    try:
        study.optimize(
            objective,
            timeout=None if timeout == math.inf else timeout,
            callbacks=[MaxTrialsCallback(limit, states=FINISHED)],
        )
    except Stopped as stopped:
        raise stopped.__cause__ or stopped from None


def suggest(trial: Trial, tried: dict[str, list[Any]], sampler: str) -> dict[str, Any]:
    """Let the sampler choose one of the settings."""
    params: dict[str, Any] = {}
    for name, values in tried.items():
        if name in DRAWN:
            params[name] = trial.suggest_float(name, min(values), max(values))
        elif sampler == "tpe":
            params[name] = trial.suggest_categorical(name, values)
        else:  # a range may grow with the grid; the choices of a category may not
            params[name] = trial.suggest_int(name, min(values), max(values))
    return params


def decisive(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that change an answer."""
    return {name: value for name, value in params.items() if name != "choice_factor" or params["temperature"] > 0}


def repeat(trial: Trial, known: FrozenTrial) -> float:
    """Report what another trial of the same settings did, and end as it did."""
    returns = returns_of(known)
    for step, value in enumerate(returns):
        trial.report(value, step)
    if known.state == TrialState.PRUNED:
        raise optuna.TrialPruned
    return float(np.mean(returns))


def play_trial(
    trial: Trial, play: Callable[[int, int], Sequence[float]], episodes: int, round_size: int, seed: int
) -> float:
    """Report the episodes of a trial, and return their mean.

    :raises TrialPruned: when the trial is worse than the best
    """
    returns: list[float] = []
    is_pruned = False
    while len(returns) < episodes and not is_pruned:
        try:
            played = play(seed + len(returns), min(round_size, episodes - len(returns)))
        except ValueError as error:  # Optuna itself does not tell the settings
            raise ValueError(f"With {describe(trial.params)}: {error}") from error
        for value in played:
            if not math.isfinite(value):
                raise ValueError(f"A reward is not finite: with {describe(trial.params)} an episode returned {value}.")
            trial.report(float(value), len(returns))
            returns.append(float(value))
        is_pruned = len(returns) < episodes and trial.should_prune()
    mean = float(np.mean(returns))
    told = f"trial {trial.number}: {describe(trial.params)}: mean return {mean:,.1f} over {len(returns)} episodes"
    print(told + " (pruned)" * is_pruned, flush=True)
    if is_pruned:
        raise optuna.TrialPruned
    return mean


def open_study(
    folder: Path, storage: str, name: str | None, settings: dict[str, Any], prune: float, new_name: str = "said"
) -> optuna.Study:
    """Open a study, or begin it.

    :param folder: shared by the workers; holds their lock
    :param storage: an Optuna RDB URL, or the path of a journal file
    :param name: of the study; by default that of the study in the folder's own file, even if the run was renamed since
    :param settings: in JSON types, what all trials must have in common to be compared
    :param prune: p-value below which a trial is pruned; 0 prunes none
    :param new_name: of a study that is begun without ``name``
    :raises ValueError: when the study was begun with other settings, or a data base cannot be opened
    """
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(), FileLock(folder / "study.lock"):
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        pruner = optuna.pruners.WilcoxonPruner(p_threshold=prune) if prune > 0 else optuna.pruners.NopPruner()
        backend = _open_storage(storage)
        if name is None:
            known = optuna.get_all_study_names(backend) if storage == str(folder / OWN_STUDY) else []
            name = known[0] if len(known) == 1 else new_name
        study = optuna.create_study(
            storage=backend, study_name=name, direction="maximize", load_if_exists=True, pruner=pruner
        )
        if "settings" not in study.user_attrs:
            if study.get_trials(deepcopy=False) or study.direction != optuna.study.StudyDirection.MAXIMIZE:
                raise ValueError(f"Study {name!r} in {storage} is of something else: give another --study-name.")
            study.set_user_attr("settings", settings)
    advice = "Go on with the old ones, or give another --output, and with --storage another --study-name."
    check_same(f"Study {name!r} in {storage} was begun", study.user_attrs["settings"], settings, advice)
    return study


def _open_storage(storage: str) -> BaseStorage:
    if "://" not in storage:
        Path(storage).parent.mkdir(parents=True, exist_ok=True)
        lock = JournalFileOpenLock(storage)  # the default one is a symbolic link, which Windows lets few users make
        lock.acquire()
        try:
            _mend_journal(Path(storage))
        finally:
            lock.release()
        return JournalStorage(JournalFileBackend(storage, lock))
    # SQLite lets one worker write at a time. The others give up after these seconds.
    patience = {"connect_args": {"timeout": 120}} if storage.startswith("sqlite") else {}
    try:
        return RDBStorage(storage, engine_kwargs=patience)
    except (SQLAlchemyError, RuntimeError) as error:  # RuntimeError: of another version of Optuna
        raise ValueError(f"--storage {storage} cannot be opened: {str(error).splitlines()[0]}") from error


def _mend_journal(journal: Path) -> None:
    """Remove a last line that a full disk or a power cut left incomplete: the next one would be joined to it.

    :raises ValueError: for a file of something else
    """
    if not journal.exists():
        return
    written, begins = journal.read_bytes(), b'{"op_code"'
    if not all(begins.startswith(line[: len(begins)]) for line in written.splitlines()):
        raise ValueError(
            f"--storage {journal} is no journal of Optuna: give another file, or for a data base its URL, such as "
            f"sqlite:///{journal}."
        )
    if not written.endswith(b"\n"):
        os.truncate(journal, written.rfind(b"\n") + 1)


def finished(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that are complete or pruned; of several with equal settings, the first."""
    trials = study.get_trials(deepcopy=False, states=FINISHED)
    return list({tuple(sorted(trial.params.items())): trial for trial in reversed(trials)}.values())[::-1]


def find_winner(study: optuna.Study) -> FrozenTrial | None:
    """Return the complete trial of the highest mean; of equals, the one of the lowest settings, in order of names."""
    complete = [trial for trial in finished(study) if trial.state == TrialState.COMPLETE]
    return max(complete, key=lambda t: (t.value, *(-t.params[name] for name in sorted(t.params))), default=None)


def describe(params: Mapping[str, float]) -> str:
    """Write what was tried, such as "depth 2, temperature 0.3, sampling steps 5"."""
    return ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in params.items())


def returns_of(trial: FrozenTrial) -> list[float]:
    """Return what a trial reported: the return of each of its episodes, in the order of their seeds."""
    return [trial.intermediate_values[step] for step in sorted(trial.intermediate_values)]


def save_plot(study: optuna.Study, path: Path, title: str) -> None:
    """Draw the mean return over each setting, of complete trials.

    :param title: names the task and its delay
    :raises ImportError: without matplotlib
    """
    import matplotlib

    matplotlib.use("Agg")
    from optuna.visualization.matplotlib import plot_slice

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        axes = np.ravel(np.asarray(plot_slice(study, target_name="mean return")))
    for ax in axes:
        ax.set_title("")  # "Slice Plot"
    axes[0].figure.suptitle(title)
    axes[0].figure.savefig(path, dpi=150, bbox_inches="tight")
    matplotlib.pyplot.close(axes[0].figure)
