"""study.py: hands out every cell once, prunes, frees the cells of dead workers, and tells what mattered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("optuna")
pytest.importorskip("scipy")

import optuna
from optuna.trial import TrialState

from sb3_said.zoo import study
from sb3_said.zoo.study import MainEffects, Search, returns_of
from sb3_said.zoo.tuning import DepthPlanners


class FreePlanners(DepthPlanners):
    """Planners that need no training; remembers which is in use."""

    def __init__(self) -> None:
        self.tried: dict[str, Any] = {}

    def is_ready(self, depth: int) -> bool:
        return True

    def put(self, depth: int, **sampling: Any) -> None:
        self.tried = {"depth": depth, **sampling}


def make_search(folder: Path, temperatures: list[float], steps: Sequence[int] = (5,), **options: Any) -> Search:
    tried = {"depth": [2], "temperature": temperatures, "sampling_steps": list(steps)}
    return Search(folder, str(folder / "study.log"), "test", tried, **options)


def test_a_hopeless_trial_is_pruned_and_a_close_one_is_not(tmp_path: Path) -> None:
    planners = FreePlanners()
    strength = {0.0: 100.0, 0.5: 0.0, 1.0: 99.0}

    def play(seed: int, n: int) -> list[float]:
        temperature = planners.tried["temperature"]
        noise = [np.random.default_rng((s, int(10 * temperature))).normal(0, 20) for s in range(seed, seed + n)]
        return [strength[temperature] + x for x in noise]

    search = make_search(tmp_path, [0.0, 0.5, 1.0], episodes=20, round_size=5)
    assert search.work(planners, play) == 3
    states = {trial.params["temperature"]: trial for trial in search.finished()}
    assert states[0.5].state == TrialState.PRUNED and len(returns_of(states[0.5])) == 5
    assert states[0.0].state == states[1.0].state == TrialState.COMPLETE
    winner = search.winner()
    assert winner is not None and winner.params["temperature"] != 0.5 and len(returns_of(winner)) == 20


def test_denoising_steps_are_tried_with_every_temperature(tmp_path: Path) -> None:
    planners = FreePlanners()
    for steps in ([1, 2], [2, 5]):  # a grid that grew makes only what is new
        search = make_search(tmp_path, [0.0, 1.0], steps, episodes=1, prune=0.0)
        search.work(planners, lambda s, n: [-abs(planners.tried["sampling_steps"] - 2.0)] * n)
    cells = [(trial.params["temperature"], trial.params["sampling_steps"]) for trial in search.finished()]
    assert sorted(cells) == [(0.0, 1), (0.0, 2), (0.0, 5), (1.0, 1), (1.0, 2), (1.0, 5)]
    winner = search.winner()
    assert winner is not None and winner.params == {"depth": 2, "temperature": 0.0, "sampling_steps": 2}


def test_the_cell_of_a_dead_worker_is_tried_again(tmp_path: Path) -> None:
    search = make_search(tmp_path, [0.0, 1.0], episodes=2)
    begun = search._begin(FreePlanners())
    assert begun is not None
    other = make_search(tmp_path, [0.0, 1.0], episodes=2)
    assert other.work(FreePlanners(), lambda seed, n: [1.0] * n) == 1
    assert len(other.running()) == 1  # that worker is alive: its cell is left to it
    begun[1].release()
    assert other.running() == []
    assert other.work(FreePlanners(), lambda seed, n: [1.0] * n) == 1
    assert sorted(trial.params["temperature"] for trial in other.finished()) == [0.0, 1.0]
    winner = other.winner()
    assert winner is not None and winner.params["temperature"] == 0.0  # of equals, the coldest


def test_a_trial_that_ends_while_another_worker_looks_stays_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another worker may end its trial and release its claim between the list of running trials and the claim."""
    search = make_search(tmp_path, [0.0, 1.0], episodes=1)
    begun = search._begin(FreePlanners())
    assert begun is not None
    listed = search.study.get_trials(states=(TrialState.RUNNING,))
    search.study.tell(begun[0], 5.0)
    begun[1].release()
    get_trials = search.study.get_trials

    def stale(deepcopy: bool = True, states: Any = None) -> Any:
        return listed if states == (TrialState.RUNNING,) else get_trials(deepcopy, states)

    monkeypatch.setattr(search.study, "get_trials", stale)
    other = search._begin(FreePlanners())
    assert other is not None and other[0].params["temperature"] == 1.0
    assert [t.state for t in get_trials()] == [TrialState.COMPLETE, TrialState.RUNNING]


@pytest.mark.parametrize("storage", ["study.log", "sqlite:///{}/study.db"])
def test_tpe_tries_as_many_as_it_is_told(tmp_path: Path, storage: str) -> None:
    planners = FreePlanners()
    options: dict[str, Any] = {"sampler": "tpe", "n_trials": 9, "episodes": 2, "prune": 0.0}
    place = storage.format(tmp_path) if "://" in storage else str(tmp_path / storage)
    for expected in (9, 0):
        tried = {"depth": [2, 4], "temperature": [0.0, 1.0], "sampling_steps": [1, 5]}
        search = Search(tmp_path, place, "test", tried, **options)
        assert search.work(planners, lambda s, n: [-abs(planners.tried["temperature"] - 0.5)] * n) == expected
    for name in ("depth", "sampling_steps"):
        assert {trial.params[name] for trial in search.finished()} == set(tried[name])
    assert all(0.0 <= trial.params["temperature"] <= 1.0 for trial in search.finished())


def test_importance_is_the_explained_variance() -> None:
    tried = optuna.create_study(direction="maximize")
    distributions = {
        "depth": optuna.distributions.IntDistribution(2, 8),
        "temperature": optuna.distributions.FloatDistribution(0.0, 1.0),
    }
    for depth in (2, 4, 8):
        for temperature in (0.0, 0.52, 1.0):
            params = {"depth": depth, "temperature": temperature}
            value = 10.0 * depth
            tried.add_trial(optuna.trial.create_trial(value=value, params=params, distributions=distributions))
    evaluator = MainEffects({"depth": [2, 4, 8], "temperature": [0.0, 0.5, 1.0]})
    found = optuna.importance.get_param_importances(tried, evaluator=evaluator)
    assert found == pytest.approx({"depth": 1.0, "temperature": 0.0})


def test_importance_counts_the_cells_of_workers_with_other_grids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    for temperatures in ([0.0, 0.5, 1.0], [0.0, 0.3]):
        search = make_search(tmp_path, temperatures, episodes=1, prune=0.0)
        search.work(FreePlanners(), lambda seed, n: [float(seed)] * n)
    levels: list[dict[str, Any]] = []

    def spy(given: dict[str, Any]) -> MainEffects:
        levels.append(given)
        return MainEffects(given)

    monkeypatch.setattr(study, "MainEffects", spy)
    assert len(study.save_plots(search, tmp_path)) == 2
    assert levels == [{"temperature": [0.0, 0.3, 0.5, 1.0]}]


def test_a_study_begun_otherwise_is_refused(tmp_path: Path) -> None:
    make_search(tmp_path, [0.0], episodes=2)
    with pytest.raises(ValueError, match=r"episodes was 2 and is now 3.*--study-name"):
        make_search(tmp_path, [0.0], episodes=3)


def test_how_planners_answered_is_told_by_its_settings(tmp_path: Path) -> None:
    before, now = ({"config": {"depth": 2, "n_candidates": n, "sampling_steps": n - 1}} for n in (2, 3))
    make_search(tmp_path, [0.5], settings=before)
    with pytest.raises(
        ValueError, match=r"settings: n_candidates was 2 and is now 3; sampling_steps was 1 and is now 2\."
    ):
        make_search(tmp_path, [0.5], settings=now)
