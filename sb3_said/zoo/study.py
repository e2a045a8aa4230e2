"""A search over settings of the planner that several workers share, kept in an Optuna study."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from filelock import FileLock
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.importance import BaseImportanceEvaluator
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from sb3_said.zoo.locks import is_held, try_acquire, work_lock
from sb3_said.zoo.tuning import DepthPlanners

optuna.logging.set_verbosity(optuna.logging.WARNING)

#: Returns (n,) of the agent, in n episodes from a reset seed on.
Play = Callable[[int, int], Sequence[float]]


@dataclass
class Search:
    """Settings of the planner tried on the same episodes, the best mean return wins.

    With the sampler ``grid`` every cell is tried once. The cells are handed out here, as Optuna's ``GridSampler`` now
    and then gives two workers the same one, and does not know that a depth is being trained: a worker takes a trained
    depth first, and then one that nobody is training. ``tpe`` draws temperatures between the lowest and the highest.

    A trial reports the return of every episode; it is pruned once a Wilcoxon test of the differences to the best trial,
    episode by episode, says that it is worse.

    :param folder: shared by the workers, for their locks
    :param storage: an Optuna RDB URL, or the path of a journal file
    :param name: of the study
    :param tried: values of ``depth``, ``temperature`` and ``sampling_steps``
    :param settings: in JSON types, what all trials must have in common to be compared
    :param n_trials: of the whole study, over all workers
    :param episodes: of a trial
    :param round_size: episodes between two looks at pruning
    :param seed: reset seed of the first episode
    :param prune: p-value below which a trial is pruned; 0 prunes none
    :raises ValueError: when the study was made with other settings
    """

    folder: Path
    storage: str
    name: str
    tried: dict[str, list[Any]]
    sampler: str = "grid"
    n_trials: int | None = None
    episodes: int = 20
    round_size: int = 5
    seed: int = 20_000
    prune: float = 0.05
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        common = {**self.settings, "sampler": self.sampler, "episodes": self.episodes, "seed": self.seed}
        if self.sampler == "tpe":
            temperatures = self.tried["temperature"]
            common |= {**self.tried, "temperature": [min(temperatures), max(temperatures)]}
        pruner: optuna.pruners.BasePruner = optuna.pruners.NopPruner()
        if self.prune > 0:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                pruner = optuna.pruners.WilcoxonPruner(p_threshold=self.prune)
        with self._lock():
            self.study = optuna.create_study(
                storage=open_storage(self.storage),
                study_name=self.name,
                direction="maximize",
                load_if_exists=True,
                pruner=pruner,
                sampler=optuna.samplers.RandomSampler(),
            )
            before = self.study.user_attrs.get("settings")
            if before is None:
                self.study.set_user_attr("settings", common)
        if before is not None and before != common:
            old, now = ({**settings, **settings.get("config", {})} for settings in (before, common))
            differing = [key for key in sorted({*old, *now} - {"config"}) if old.get(key) != now.get(key)]
            raise ValueError(
                f"Study {self.name!r} in {self.storage} was begun with other settings: "
                + "; ".join(f"{key} was {old.get(key)} and is now {now.get(key)}" for key in differing)
                + ". Go on with the old ones, or begin another with --study-name."
            )

    @property
    def limit(self) -> float:
        """Trials that the study may have; a grid ends by itself."""
        if self.n_trials is not None:
            return self.n_trials
        return math.inf if self.sampler == "grid" else math.prod(map(len, self.tried.values()))

    def work(self, planners: DepthPlanners, play: Play, deadline: float | None = None) -> int:
        """Make trials until there is none left to begin, and return how many were made.

        :param planners: of the agent that plays
        :param play: plays episodes
        :param deadline: ``time.monotonic()`` after which none is begun
        """
        made = 0
        while deadline is None or time.monotonic() < deadline:
            begun = self._begin(planners)
            if begun is None:
                break
            trial, lock = begun
            try:
                planners.put(**trial.params)
                returns = self._play(trial, play)
            except BaseException:
                self.study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)
                raise
            finally:
                lock.release()
            pruned = "" if len(returns) == self.episodes else " (pruned)"
            print(
                f"trial {trial.number}: {describe(trial.params)}: mean return {np.mean(returns):,.1f} over "
                f"{len(returns)} episodes{pruned}",
                flush=True,
            )
            made += 1
        return made

    def running(self) -> list[FrozenTrial]:
        """Return the trials that a living worker is at."""
        trials = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        return [trial for trial in trials if is_held(self._trial_lock(trial))]

    def finished(self) -> list[FrozenTrial]:
        """Return the trials that are complete or pruned."""
        return self.study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))

    def winner(self) -> FrozenTrial | None:
        """Return the complete trial of the highest mean; of equals, the shallowest, coldest and quickest."""
        complete = [trial for trial in self.finished() if trial.state == TrialState.COMPLETE]
        return max(complete, key=lambda t: (t.value, *(-t.params[name] for name in self.tried)), default=None)

    def _begin(self, planners: DepthPlanners) -> tuple[Trial, FileLock] | None:
        with self._lock():
            for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                lock = self._trial_lock(trial)
                if try_acquire(lock):  # its worker died, and the cell is free again; or has ended since the list
                    self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
                    lock.release()
            taken = [trial for trial in self.study.get_trials(deepcopy=False) if trial.state != TrialState.FAIL]
            waiting = [trial for trial in taken if trial.state == TrialState.WAITING]
            if not waiting and len(taken) >= self.limit:
                return None
            if self.sampler == "tpe":
                # Seeded by what is there: no two workers draw alike, and one worker alone repeats itself.
                seed = self.seed + len(self.study.get_trials(deepcopy=False))
                self.study.sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=6, constant_liar=True)
            elif not waiting:
                cell = self._next_cell(planners, taken)
                if cell is None:
                    return None
                self.study.enqueue_trial(cell, {"worker": os.getpid()})
            begun = self.study.ask()
            for name, values in self.tried.items():
                if name == "temperature":
                    begun.suggest_float(name, min(values), max(values))
                elif self.sampler == "tpe":
                    begun.suggest_categorical(name, values)
                else:  # an int, so that others can be added to a study later
                    begun.suggest_int(name, min(values), max(values))
            lock = self._trial_lock(begun)
            lock.acquire()  # at once, but for another worker that looks whether it is held
        return begun, lock

    def _next_cell(self, planners: DepthPlanners, taken: list[FrozenTrial]) -> dict[str, Any] | None:
        seen = [trial.params for trial in taken]
        cells = (dict(zip(self.tried, values, strict=True)) for values in product(*self.tried.values()))
        left = [cell for cell in cells if cell not in seen]
        depths = {cell["depth"] for cell in left}
        busy = {depth: not planners.is_ready(depth) and is_held(planners.lock(depth)) for depth in depths}
        # A worker that has just begun a depth holds its lock a moment later; its running trial says so already.
        running = {t.params["depth"] for t in taken if t.state == TrialState.RUNNING}
        rank = {d: 0 if planners.is_ready(d) else 2 if busy[d] or d in running else 1 for d in busy}
        return min(left, key=lambda cell: rank[cell["depth"]], default=None)

    def _play(self, trial: Trial, play: Play) -> list[float]:
        returns: list[float] = []
        for start in range(0, self.episodes, self.round_size):
            for value in play(self.seed + start, min(self.round_size, self.episodes - start)):
                trial.report(float(value), len(returns))
                returns.append(float(value))
            if len(returns) < self.episodes and trial.should_prune():
                self.study.tell(trial, state=TrialState.PRUNED)
                return returns
        self.study.tell(trial, float(np.mean(returns)))
        return returns

    def _lock(self) -> FileLock:
        return work_lock(self.folder / "locks" / f"{self.name}.lock")

    def _trial_lock(self, trial: Trial | FrozenTrial) -> FileLock:
        return work_lock(self.folder / "locks" / f"{self.name}_trial{trial.number}.lock")


def open_storage(storage: str) -> BaseStorage:
    """Open an RDB by its URL, or a journal file by its path."""
    if "://" in storage:
        # SQLite lets one worker write at a time, and tells the others that wait longer than this to give up.
        patience = {"connect_args": {"timeout": 120}} if storage.startswith("sqlite") else {}
        return RDBStorage(storage, engine_kwargs=patience)
    Path(storage).parent.mkdir(parents=True, exist_ok=True)
    return JournalStorage(JournalFileBackend(storage))


def describe(params: Mapping[str, float]) -> str:
    """Write what was tried, such as "depth 2, temperature 0.3, sampling steps 5"."""
    return ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in params.items())


def returns_of(trial: FrozenTrial) -> list[float]:
    """Return what a trial reported: the return of each of its episodes, in the order of their seeds."""
    return [trial.intermediate_values[step] for step in sorted(trial.intermediate_values)]


class MainEffects(BaseImportanceEvaluator):
    """Part of the variance of the trials that the mean over each level of a parameter explains.

    For a whole grid these are the main effects of functional ANOVA. Optuna's own evaluators estimate densities or fit
    forests, which a dozen trials do not bear.

    :param levels: values of each parameter; others count as the nearest
    """

    def __init__(self, levels: Mapping[str, Sequence[float]]):
        self.levels = {name: np.array(sorted(values)) for name, values in levels.items()}

    def evaluate(
        self,
        study: optuna.Study,
        params: list[str] | None = None,
        *,
        target: Callable[[FrozenTrial], float] | None = None,
    ) -> dict[str, float]:
        trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        values = np.array([trial.value if target is None else target(trial) for trial in trials])
        effects = {}
        for name in params or self.levels:
            given = np.array([trial.params[name] for trial in trials], float)
            level = np.abs(given[:, None] - self.levels[name]).argmin(1)
            means = np.array([values[level == k].mean() for k in level])
            effects[name] = float(means.var() / values.var()) if values.var() > 0 else 0.0
        return dict(sorted(effects.items(), key=lambda item: -item[1]))


def save_plots(search: Search, folder: Path) -> list[Path]:
    """Draw how much each parameter matters and how each does, pruned trials by the mean as far as they got.

    :return: the files; none where there is nothing to compare yet
    :raises ImportError: without matplotlib
    """
    import matplotlib

    matplotlib.use("Agg")
    from optuna.visualization import matplotlib as draw

    trials = search.finished()
    levels: dict[str, list[Any]] = {name: sorted({t.params[name] for t in trials}) for name in search.tried}
    varied = [name for name, values in levels.items() if len(values) > 1]
    if not varied:
        return []
    whole = optuna.create_study(direction="maximize")
    for trial in trials:
        distributions: dict[str, BaseDistribution] = {
            name: FloatDistribution(values[0], values[-1]) if name == "temperature" else CategoricalDistribution(values)
            for name, values in levels.items()
        }
        value = float(np.mean(returns_of(trial)))
        whole.add_trial(optuna.trial.create_trial(value=value, params=trial.params, distributions=distributions))
    # Of any temperature there are as many levels as were named; a grid's are those of all its workers.
    bins = {**levels, "temperature": search.tried["temperature"]} if search.sampler == "tpe" else levels
    effects = MainEffects({name: bins[name] for name in varied})
    paths = [folder / "importance.png", folder / "slice.png"]
    for path, drawing in (
        (paths[0], lambda: draw.plot_param_importances(whole, effects, varied, target_name="mean return")),
        (paths[1], lambda: draw.plot_slice(whole, varied, target_name="mean return")),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            axes = np.ravel(np.asarray(drawing()))
        axes[0].figure.savefig(path, dpi=150, bbox_inches="tight")
        matplotlib.pyplot.close(axes[0].figure)
    return paths
