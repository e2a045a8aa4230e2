"""sb3-said tune: from a run to a report on fresh episodes, alone and shared between workers."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch as th

pytest.importorskip("rl_zoo3")
pytest.importorskip("scipy")

from forked import begin, run_script
from rl_zoo3 import exp_manager
from stable_baselines3.common.torch_layers import FlattenExtractor
from trained_run import ENV, config_of, read_by_train, report_quickly, train_run, train_said

from sb3_said import SAID, PlannerConfig
from sb3_said.files.archive import load_tree
from sb3_said.files.checkpoint import CHECKPOINT_NAME
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.zoo import best as best_module
from sb3_said.zoo import train, tune
from sb3_said.zoo.arguments import read_delay
from sb3_said.zoo.best import plain_settings, write_best
from sb3_said.zoo.record import Record
from sb3_said.zoo.runs import LoadedRun, load_run
from sb3_said.zoo.search import save_plot

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "tune.py"
QUICK = ["--episodes", "4", "--round", "2", "--report-episodes", "3", "--device", "cpu", "--num-threads", "1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_said(tmp_path_factory.mktemp("logs"))


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A run of its own, since tuning writes into it."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture(autouse=True)
def quick_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    report_quickly(monkeypatch)


def results_of(run: Path) -> dict[str, Any]:
    return dict(json.loads((run / "tune" / "results.json").read_text()))


def settings_of(agent: Path) -> dict[str, Any]:
    """Return what a search may change of a planner, as an agent has it."""
    model: Any = load_run(agent, device="cpu").model
    return {name: getattr(model.policy.planner.config, name) for name in ("mask", "depth", *SAMPLING_SETTINGS)}


def check_report(run: Path) -> None:
    """The winner is the best trial, and best.zip gives the reported returns again."""
    results, best = results_of(run), load_run(run / "tune" / "best.zip", device="cpu")
    assert isinstance(best.model, SAID)
    winner, report = results["winner"], results["report"]
    complete = [trial for trial in results["trials"] if trial["state"] == "COMPLETE"]
    assert winner["mean_return"] == max(trial["mean_return"] for trial in complete)
    config = best.model.policy.planner.config
    tried = ("depth", "temperature", "sampling_steps")
    assert [getattr(config, name) for name in tried] == [winner[name] for name in tried]
    assert [one["label"] for one in report["results"]] == ["planner", "expert"]
    for one in report["results"]:
        with best.model.policy.answering(one["label"], at_once=True):
            assert one["returns"] == best.play(report["n_episodes"], report["seed"], n_envs=8).returns.tolist()


def test_a_search_from_grid_to_report(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    grid = ["--depths", "1", "2", "--temperatures", "0", "1", "--sampling-steps", "2", "--prune", "0"]
    command = [str(run), *grid, *QUICK]
    model: Any = load_run(run, device="cpu").model
    model.set_planner(choice_factor=3.0)  # as a trial may have found
    model.save(run / f"{ENV}.zip")
    seeds: list[int] = []

    def recorded(self: LoadedRun, n: int, seed: int, *args: Any, original: Any = LoadedRun.play, **kwargs: Any) -> Any:
        seeds.extend(range(seed, seed + n))
        return original(self, n, seed, *args, **kwargs)

    monkeypatch.setattr(LoadedRun, "play", recorded)
    with monkeypatch.context() as patch:
        patch.setattr(tune, "save_plot", save_plot)
        tune.main(command)
    # Once for two temperatures, and never the depth that the run itself has.
    out = capsys.readouterr().out
    assert out.count("Training the planner of depth") == out.count("Training the planner of depth 2:") == 1
    results = results_of(run)
    cells = {(trial["depth"], trial["temperature"]) for trial in results["trials"]}
    assert len(results["trials"]) == 4 and cells == {(1, 0.0), (1, 1.0), (2, 0.0), (2, 1.0)}
    assert (run / "tune" / "slice.png").is_file()
    # Every trial plays the same episodes, and the report is on others, once for the planner and once for the expert.
    assert sorted(seeds) == sorted([*(4 * [*range(20_000, 20_004)]), *(2 * [*range(10_000, 10_003)])])
    assert results["winner"]["sampling_steps"] == 2 != PlannerConfig().sampling_steps
    check_report(run)
    assert load_run(run / "tune", device="cpu").info["file"] == str(run / "tune" / "best.zip")
    with pytest.raises(ValueError, match=r"what sb3-said tune found, and no training: give -conf .*best\.yml"):
        train.read_command_line(["--resume", str(run / "tune")])

    # The same command again makes nothing twice, and still says what was found.
    seeds.clear()
    tune.main(command)
    out = capsys.readouterr().out
    assert not seeds and "No trial is left" in out and "4 trials" in out and "Training" not in out
    assert results_of(run)["report"] == results["report"]

    # Its folder may be renamed.
    renamed = run.rename(run.with_name("renamed"))
    tune.main([str(renamed), *command[1:]])
    assert not seeds and "4 trials are finished" in capsys.readouterr().out
    renamed.rename(run)

    # A report that is interrupted leaves a folder that the same command goes on in.
    for name in ("best.yml", "run.json", "results.json"):
        (run / "tune" / name).unlink()
    with monkeypatch.context() as patch:
        patch.setattr(best_module, "write_text", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(SystemExit) as stop:
            tune.main(command)
        assert stop.value.code == 130
    tune.main(command)
    again = results_of(run)["report"]["results"]
    assert [row["returns"] for row in again] == [row["returns"] for row in results["report"]["results"]]
    capsys.readouterr()

    # A training reads the winner.
    best = run / "tune" / "best.yml"
    assert f"sb3-said train --algo said --env {ENV} --delay 2 -conf {best}" in out
    expected = {**config_of(run), "n_timesteps": 120}
    expected["planner_kwargs"] |= settings_of(run / "tune" / "best.zip")
    assert read_by_train(best, 2, run) == expected
    assert expected["planner_kwargs"]["choice_factor"] == 3.0  # as the run decides, and so each trial


@pytest.mark.parametrize(
    ("delay", "params"),
    [
        ([0, 3], ["normalize:dict(norm_obs_keys=['observation'])"]),
        ([2], ["normalize:dict(norm_obs=False)"]),
    ],
    ids=["drawn delay, VecNormalize", "normalized rewards"],
)
def test_a_search_with_a_drawn_delay_or_vec_normalize(
    delay: list[int], params: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train_said(tmp_path, *params, delay=delay)
    tune.main([str(run), "--depths", "1", "2", "--temperatures", "0.5", *QUICK])
    results = results_of(run)
    assert sorted((trial["depth"], trial["temperature"]) for trial in results["trials"]) == [(1, 0.5), (2, 0.5)]

    # A depth is trained on the very data, in the very units, that the run's own planner was.
    own, other = (load_tree(run / "tune" / f"planner_depth{depth}.zip")["planner"] for depth in (1, 2))
    statistics = [name for name in own if name.startswith("normalizer.")]
    assert statistics
    for name in statistics:
        th.testing.assert_close(other[name], own[name], rtol=0, atol=0)

    # What is reported is what best.zip and its statistics give again, and best.yml is of the same task.
    assert (load_run(run / "tune" / "best.zip", device="cpu").normalize is not None) == bool(params)
    check_report(run)
    expected = {**config_of(run), "n_timesteps": 120}
    expected["planner_kwargs"] |= settings_of(run / "tune" / "best.zip")
    assert read_by_train(run / "tune" / "best.yml", read_delay([str(d) for d in delay]), tmp_path) == expected
    assert f"--delay {' '.join(map(str, delay))} -conf" in capsys.readouterr().out


def test_a_search_for_how_the_critics_choose(run: Path) -> None:
    grid = ["--depths", "1", "--temperatures", "0.5", "1", "--choice-factors", "0.5", "100", "--prune", "0"]
    tune.main([str(run), *grid, *QUICK])
    tried, winner = results_of(run)["trials"], results_of(run)["winner"]
    assert sorted((t["temperature"], t["choice_factor"]) for t in tried) == [(0.5, 0.5), (0.5, 100), (1, 0.5), (1, 100)]
    check_report(run)
    best: Any = load_run(run / "tune" / "best.zip", device="cpu").model
    assert best.policy.planner.config.choice_factor == winner["choice_factor"]
    read = read_by_train(run / "tune" / "best.yml", 2, run)
    assert read["planner_kwargs"]["choice_factor"] == winner["choice_factor"]


def test_what_is_trained_with_its_yaml_is_what_won(run: Path, tmp_path: Path) -> None:
    model: Any = load_run(run, device="cpu").model
    mask = model.policy.planner.config.mask
    tune.main([str(run), "--depths", "1", "--temperatures", "0", "--gradient-steps", "5", *QUICK])
    trained = read_by_train(run / "tune" / "best.yml", 2, run)
    assert trained["planner_gradient_steps"] == 5 and trained["planner_kwargs"]["mask"] == mask


def test_a_file_of_something_else_is_told_before_the_search(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "tune").mkdir()
    (run / "tune" / "results.json").write_text('{"a": 1}')
    with pytest.raises(SystemExit):
        tune.main([str(run), "--depths", "1", "--temperatures", "0", *QUICK])
    assert "results.json holds something else than what sb3-said tune writes" in capsys.readouterr().err
    assert not (run / "tune" / "study.log").exists()


def test_two_workers_share_a_study_and_train_no_depth_twice(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(run), "--depths", "2", "3", "--temperatures", "0", "1", *QUICK]
    other = begin(output := run / "output.txt", run_script, SCRIPT, command)
    while other.is_alive() and not (run / "tune" / "study.lock").exists():  # it has all its imports then
        time.sleep(0.02)
    tune.main(command)  # this process is the second worker
    other.join(timeout=240)
    outputs = [output.read_text(), capsys.readouterr().out]
    assert other.exitcode == 0, outputs
    assert sum(out.count("Training the planner of depth 2") for out in outputs) == 1, outputs
    assert sum(out.count("Training the planner of depth 3") for out in outputs) == 1, outputs
    trials = results_of(run)["trials"]
    assert sorted((t["depth"], t["temperature"]) for t in trials) == [(2, 0.0), (2, 1.0), (3, 0.0), (3, 1.0)]
    assert (run / "tune" / "study.log").exists()
    check_report(run)


def test_a_worker_that_waits_reports_the_winner_of_then(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command, lock, play = [str(run), "--depths", "2", "--temperatures", "0", "1", *QUICK], tune.FileLock, LoadedRun.play

    def better(self: LoadedRun, n: int, seed: int, *how: Any, **more: Any) -> Any:
        played = play(self, n, seed, *how, **more)
        played.returns[:] += 1000.0
        return played

    def waits(path: Path) -> Any:
        monkeypatch.setattr(tune, "FileLock", lock)
        with monkeypatch.context() as patched:
            patched.setattr(LoadedRun, "play", better)
            tune.main(command)
        return lock(path)

    monkeypatch.setattr(tune, "FileLock", waits)
    tune.main([*command, "--n-trials", "1"])
    results = results_of(run)
    assert results["winner"]["mean_return"] == max(trial["mean_return"] for trial in results["trials"]) > 1000.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "10049"], "Tuning would play the reset seeds 10049..10068"),
        (["--episodes", "0"], "--episodes must be at least 1, got 0"),
        (["--prune", "1.5"], "--prune is a p-value"),
        (["--depths", "2", "2"], "--depths names a value twice: 2 2"),
        (["--temperatures", "-1"], "temperature is -1"),
        (["--sampling-steps", "0"], "sampling_steps is 0"),
        (["--sampling-steps", "2", "2"], "--sampling-steps names a value twice: 2 2"),
        (["--depths", "0"], "depth is 0"),
        (["--choice-factors", "-1"], "choice_factor is -1"),
        (["--depths", "1", "--timeout", "0"], "No trial is finished"),
        (["--storage", "nonsense://x"], "--storage nonsense://x cannot be opened"),
    ],
)
def test_says_what_is_wrong(run: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        tune.main([str(run), *arguments])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


def test_another_runs_trials_are_not_its_own(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Though both have the same settings and their studies the same name."""
    other = Path(shutil.copytree(run, tmp_path / "logs" / "run"))
    model: Any = load_run(other, device="cpu").model
    with th.no_grad():
        next(model.policy.actor.parameters()).add_(1e-3)
    model.save(other / f"{ENV}.zip")
    search = ["--depths", "1", "--temperatures", "0", "--storage", str(tmp_path / "shared.log"), *QUICK]
    tune.main([str(run), *search])
    with pytest.raises(SystemExit):
        tune.main([str(other), *search])
    assert "agent was" in (error := capsys.readouterr().err) and "give another --output" in error


def test_folders_that_cannot_be_tuned(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, message in (
        (tmp_path / "nowhere", "does not exist"),
        (train_run(tmp_path, "sadr"), "is a run of 'sadr', which has no planner"),
    ):
        with pytest.raises(SystemExit):
            tune.main([str(folder), "--device", "cpu"])
        assert message in capsys.readouterr().err
    found = run / "tune"
    found.mkdir()
    write_best(run, found, {}, 5, "chosen")
    elsewhere = Path(shutil.copytree(found, tmp_path / "elsewhere"))
    for folder, message in (
        (run, "has no checkpoint.zip"),
        (found, f"what sb3-said tune found: give {run}"),
        (elsewhere, "what sb3-said tune found: give the run that it searched"),
    ):
        (run / CHECKPOINT_NAME).unlink(missing_ok=True)
        with pytest.raises(SystemExit):
            tune.main([str(folder), "--device", "cpu"])
        assert message in capsys.readouterr().err


def test_the_folder_of_a_run_is_no_output(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "run.json").read_bytes()
    with pytest.raises(SystemExit):
        tune.main([str(run), "--depths", "1", "--temperatures", "0", "--output", str(run), *QUICK])
    assert "is the folder of a run, whose run.json would be replaced" in capsys.readouterr().err
    assert (run / "run.json").read_bytes() == before


def test_the_command_that_trains_with_it_begins_with_the_same_agent(run: Path, tmp_path: Path) -> None:
    replace(Record.read(run), options={"trained_agent": "old.zip"}).write(run)
    command = write_best(run, tmp_path, {}, 5, "chosen")
    assert " -i old.zip " in command and f"# {command}\n" in (tmp_path / "best.yml").read_text()


def test_what_yaml_cannot_hold_is_named() -> None:
    given = {"policy_kwargs": {"activation_fn": th.nn.Tanh}, "gamma": 0.9, "train_freq": (1, "step")}
    given |= {"learning_rate": lambda left: 1e-3 * left, "replay_buffer_kwargs": {"x": FlattenExtractor}}
    record = Record(
        "said", ENV, env_kwargs={"healthy_reward": 2.0}, hyperparams=given, missing={"callback": "a lambda"}
    )
    block, left_out = plain_settings(record)
    assert eval(block.pop("policy_kwargs"), vars(exp_manager)) == given["policy_kwargs"]  # as rl_zoo3 does
    assert block == {"gamma": 0.9, "train_freq": [1, "step"], "env_kwargs": {"healthy_reward": 2.0}}
    assert left_out == ["callback", "learning_rate", "replay_buffer_kwargs"]
