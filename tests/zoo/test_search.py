"""The search: every cell once, pruning, going on after a crash, and what cannot be compared is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformReward

pytest.importorskip("rl_zoo3")
pytest.importorskip("scipy")

import optuna
from optuna import Study
from optuna.trial import TrialState

from sb3_said.evaluation import rollout
from sb3_said.zoo import search as search_module
from sb3_said.zoo.search import find_winner, finished, open_study, returns_of, save_plot, search


class Agent:
    """Answers as a search puts it, without a planner; counts how often it is put."""

    def __init__(self, strength: Callable[..., float], noise: float = 0.0):
        self.strength, self.noise = strength, noise
        self.settings: dict[str, Any] = {}
        self.n_put = 0

    def put(self, **settings: Any) -> None:
        self.settings = settings
        self.n_put += 1

    def play(self, seed: int, n: int) -> list[float]:
        rngs = [np.random.default_rng((s, int(10 * self.settings["temperature"]))) for s in range(seed, seed + n)]
        return [self.strength(**self.settings) + self.noise * float(rng.normal()) for rng in rngs]


def run(
    folder: Path,
    agent: Agent,
    temperatures: list[float],
    steps: Sequence[int] = (5,),
    storage: str = "",
    prune: float = 0.0,
    **options: Any,
) -> Study:
    tried = {"depth": [2], "temperature": temperatures, "sampling_steps": list(steps)}
    study = open_study(folder, storage or str(folder / "study.log"), "test", {}, prune)
    search(study, tried, agent.put, agent.play, **{"episodes": 2, **options})
    return study


def cells(study: Study) -> list[tuple[float, int]]:
    return sorted((t.params["temperature"], t.params["sampling_steps"]) for t in finished(study))


def test_a_hopeless_trial_is_pruned_and_a_close_one_is_not(tmp_path: Path) -> None:
    strength = {0.0: 100.0, 0.5: 0.0, 1.0: 99.0}
    agent = Agent(lambda temperature, **_: strength[temperature], noise=20.0)
    for temperatures in ([0.0], [0.0, 0.5, 1.0]):  # a good one first, whatever the order of a grid
        study = run(tmp_path, agent, temperatures, prune=0.05, episodes=20)
    trials = {trial.params["temperature"]: trial for trial in finished(study)}
    assert trials[0.5].state == TrialState.PRUNED and len(returns_of(trials[0.5])) == 5
    assert trials[0.0].state == trials[1.0].state == TrialState.COMPLETE
    winner = find_winner(study)
    assert winner is not None and winner.params["temperature"] != 0.5 and len(returns_of(winner)) == 20


def test_a_grid_that_grew_plays_only_what_is_new(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    agent = Agent(lambda sampling_steps, **_: -abs(sampling_steps - 2.0))
    for steps in ([1, 2], [1, 2], [2, 5]):
        study = run(tmp_path, agent, [0.0, 1.0], steps)
    assert agent.n_put == 6 and "No trial is left to make" in capsys.readouterr().out
    assert cells(study) == [(0.0, 1), (0.0, 2), (0.0, 5), (1.0, 1), (1.0, 2), (1.0, 5)]
    winner = find_winner(study)  # of equals, the coldest
    assert winner is not None and winner.params == {"depth": 2, "temperature": 0.0, "sampling_steps": 2}
    save_plot(study, tmp_path / "slice.png", "a task, a delay")
    assert (tmp_path / "slice.png").read_bytes()[:4] == b"\x89PNG"


def test_choice_factors_are_tried_and_at_temperature_0_one_stands_for_all(tmp_path: Path) -> None:
    agent = Agent(lambda temperature, choice_factor, **_: temperature - (choice_factor - 3.0) ** 2)
    study = open_study(tmp_path, str(tmp_path / "study.log"), "test", {}, 0.0)
    tried = {"depth": [2], "temperature": [0.0, 1.0], "choice_factor": [1.0, 3.0, 100.0]}
    search(study, tried, agent.put, agent.play, episodes=2)
    found = {(t.params["temperature"], t.params["choice_factor"]): t.value for t in finished(study)}
    assert len(found) == 6 and agent.n_put == 1 + 3
    assert len({found[0.0, factor] for factor in (1.0, 3.0, 100.0)}) == 1
    winner = find_winner(study)
    assert winner is not None and winner.params == {"depth": 2, "temperature": 1.0, "choice_factor": 3.0}
    study = open_study(tmp_path, str(tmp_path / "tpe.log"), "test", {}, 0.0)
    search(study, tried | {"temperature": [1.0]}, agent.put, agent.play, "tpe", n_trials=10, episodes=2)
    assert all(1.0 <= t.params["choice_factor"] <= 100.0 for t in finished(study))
    assert len({t.params["choice_factor"] for t in finished(study)}) == 10


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, MemoryError, SystemExit])
def test_a_cell_that_was_not_finished_is_tried_again(error: type[BaseException], tmp_path: Path) -> None:
    """SystemExit leaves the trial as a killed worker does: Optuna sees it run for ever."""
    broken = Agent(lambda temperature, **_: temperature)

    def play(seed: int, n: int) -> list[float]:
        if broken.n_put == 2:
            raise error
        return Agent.play(broken, seed, n)

    broken.play = play  # type: ignore[method-assign]
    with pytest.raises(error):
        run(tmp_path, broken, [0.0, 0.5, 1.0])
    agent = Agent(lambda temperature, **_: temperature)
    study = run(tmp_path, agent, [0.0, 0.5, 1.0])
    assert agent.n_put == 2 and cells(study) == [(0.0, 5), (0.5, 5), (1.0, 5)]


def test_a_cell_that_was_being_chosen_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = Agent(lambda temperature, **_: temperature)
    run(tmp_path, agent, [0.0])
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(search_module, "decisive", Mock(side_effect=KeyboardInterrupt))
        run(tmp_path, agent, [0.5])
    assert cells(run(tmp_path, agent, [0.5])) == [(0.0, 5), (0.5, 5)]


def test_what_is_not_finite_ends_the_search_and_is_tried_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"A reward is not finite: with depth 2, temperature 0\.5, .* returned nan"):
        run(tmp_path, Agent(lambda temperature, **_: float("nan") if temperature else 1.0), [0.0, 0.5])
    assert cells(run(tmp_path, Agent(lambda **_: 2.0), [0.0, 0.5])) == [(0.0, 5), (0.5, 5)]


def test_what_cannot_be_played_is_told_with_its_settings(tmp_path: Path) -> None:
    model = Mock(["predict"], predict=lambda obs, **_: (np.zeros((len(obs), 1)), None))
    task = TransformReward(gym.make("Pendulum-v1", max_episode_steps=2), lambda _: float("nan"))
    agent = Agent(lambda **_: rollout(model, lambda: task, 1, seed=7).returns[0])
    told = r"^With depth 2, temperature 0\.5, .*: Episode 0 \(seed 7\) returned nan"
    with pytest.raises(ValueError, match=told):
        run(tmp_path, agent, [0.5])


@pytest.mark.parametrize("content", [b"SQLite format 3\x00\x10\n\xfb", b"PK\x03\x04", b"notes\nof mine"])
def test_a_file_of_something_else_is_refused_and_stays(content: bytes, tmp_path: Path) -> None:
    (file := tmp_path / "tune.db").write_bytes(content)
    with pytest.raises(ValueError, match=r"no journal of Optuna.*sqlite:///"):
        search_module._open_storage(str(file))
    assert file.read_bytes() == content


def test_a_journal_whose_last_line_was_cut_goes_on(tmp_path: Path) -> None:
    agent = Agent(lambda temperature, **_: temperature)
    run(tmp_path, agent, [0.0, 0.5])
    journal = tmp_path / "study.log"
    journal.write_bytes(journal.read_bytes()[:-7])
    for temperatures in ([0.0, 0.5], [0.0, 0.5, 1.0]):
        assert cells(run(tmp_path, agent, temperatures)) == [(temperature, 5) for temperature in temperatures]


@pytest.mark.parametrize("sampler", ["grid", "tpe"])
def test_no_trial_is_begun_after_the_timeout_or_the_last_one(sampler: str, tmp_path: Path) -> None:
    agent = Agent(lambda temperature, **_: temperature)
    run(tmp_path, agent, [0.0, 0.5, 1.0], sampler=sampler, n_trials=2, timeout=0.0)
    assert agent.n_put == 0
    for _ in range(2):
        study = run(tmp_path, agent, [0.0, 0.5, 1.0], sampler=sampler, n_trials=2)
        assert agent.n_put == len(finished(study)) == 2


@pytest.mark.parametrize("storage", ["", "sqlite:///{}/study.db"])
def test_tpe_tries_as_many_as_it_is_told(tmp_path: Path, storage: str) -> None:
    agent = Agent(lambda temperature, **_: -abs(temperature - 0.5))
    study = run(tmp_path, agent, [0.0, 1.0], [1, 5], storage.format(tmp_path), sampler="tpe", n_trials=12)
    trials = finished(study)
    assert len(trials) == 12 and {trial.params["sampling_steps"] for trial in trials} <= {1, 5}
    temperatures = {trial.params["temperature"] for trial in trials}
    assert len(temperatures) > 2 and 0.0 <= min(temperatures) <= max(temperatures) <= 1.0


def test_a_journal_needs_no_symbolic_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise OSError(1314, "A required privilege is not held by the client")  # Windows says so to most users

    monkeypatch.setattr("os.symlink", refused)
    assert cells(run(tmp_path, Agent(lambda temperature, **_: temperature), [0.0, 1.0])) == [(0.0, 5), (1.0, 5)]


@pytest.mark.parametrize("storage", ["", "sqlite:///{}/study.db"])
def test_workers_share_a_grid(storage: str, tmp_path: Path) -> None:
    agents = [Agent(lambda temperature, **_: temperature) for _ in range(3)]
    temperatures = [k / 8 for k in range(9)]
    with ThreadPoolExecutor(3) as pool:
        made = [pool.submit(run, tmp_path, agent, temperatures, (5,), storage.format(tmp_path)) for agent in agents]
        studies = [one.result() for one in made]
    assert all(cells(study) == [(t, 5) for t in temperatures] for study in studies)
    assert sum(agent.n_put for agent in agents) < 2 * len(temperatures)  # at the end, a cell may be tried twice


def test_a_study_begun_otherwise_is_refused(tmp_path: Path) -> None:
    storage, settings = str(tmp_path / "study.log"), {"episodes": 2, "n_candidates": 2, "betas": [0.9, 0.999]}
    open_study(tmp_path, storage, "test", settings, 0.0)
    open_study(tmp_path, storage, "test", dict(settings), 0.0)
    with pytest.raises(ValueError, match=r"settings: episodes was 2 and is now 3; n_candidates .* --study-name"):
        open_study(tmp_path, storage, "test", {**settings, "episodes": 3, "n_candidates": 4}, 0.0)
    open_study(tmp_path, storage, "other", {**settings, "episodes": 3}, 0.0)


@pytest.mark.parametrize("direction", ["minimize", "maximize"])
def test_a_study_of_something_else_is_refused_and_stays(direction: str, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path / 'studies.db'}"
    theirs = optuna.create_study(storage=storage, study_name="run", direction=direction)
    if direction == "maximize":
        theirs.optimize(lambda trial: trial.suggest_float("lr", 0, 1), n_trials=1)
    with pytest.raises(ValueError, match=r"Study 'run' in sqlite.* is of something else: give another --study-name"):
        open_study(tmp_path, storage, "run", {"episodes": 2}, 0.0)
    assert not optuna.load_study(storage=storage, study_name="run").user_attrs


def test_a_data_base_of_another_version_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other(*_: Any, **__: Any) -> None:
        raise RuntimeError("The runtime optuna version 4.0 is no longer compatible with the table schema")

    monkeypatch.setattr(search_module, "RDBStorage", other)
    with pytest.raises(ValueError, match=r"cannot be opened: The runtime optuna version"):
        open_study(tmp_path, "sqlite:///x.db", "run", {}, 0.0)
