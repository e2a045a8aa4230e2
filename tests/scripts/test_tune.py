"""tune.py: trains each depth once, resumes, shares its work between workers, prunes, and reports on fresh episodes."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch as th

pytest.importorskip("rl_zoo3")
pytest.importorskip("scipy")

import train
import tune
import yaml
from runs import load_run
from study import Search
from winner import RunConfig
from zoo import Delay, DelayedExperimentManager, Run, read_delay

from sb3_said import SAID
from sb3_said.common.checkpoint import CHECKPOINT_NAME
from sb3_said.common.save_util import load_tree
from sb3_said.evaluation import rollout
from sb3_said.planner import PlannerConfig
from sb3_said.said import tuning
from sb3_said.said.tuning import Claim, DepthPlanners

ENV = "InvertedPendulum-v5"
STEPS = 3
PLANNER = "dict(depth=1, d_model=32, horizon=4, sampling_steps=1, n_candidates=2, batch_size=8)"
SCRIPT = Path(tune.__file__)
QUICK = ["--episodes", "4", "--round", "2", "--report-episodes", "3", "--device", "cpu", "--num-threads", "1"]


def train_run(folder: Path, algo: str, *params: str, delay: Sequence[int] = (2,)) -> Path:
    train.main(
        ["--algo", algo, "--env", ENV, "--delay", *map(str, delay), "--preset", "cpu", "-f", str(folder), "--seed", "3",
         "--num-threads", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0", "-n", "200",
         "-params", "learning_starts:100", "buffer_size:400", *params]
    )  # fmt: skip
    return next((folder / algo).iterdir())


def train_said(folder: Path, *params: str, delay: Sequence[int] = (2,)) -> Path:
    planner = (f"planner_gradient_steps:{STEPS}", f"planner_kwargs:{PLANNER}")
    return train_run(folder, "said", *planner, *params, delay=delay)


def read_by_train(best: Path, delay: Delay, preset: str, folder: Path) -> dict[str, Any]:
    """Return the hyper-parameters that train.py gets from a best.yml."""
    run = Run([], delay, preset, 25_000)
    manager = DelayedExperimentManager(run, Namespace(), "said", ENV, str(folder), config=str(best), verbose=0)
    return manager.read_hyperparameters()[0]


def config_of(run: Path) -> dict[str, Any]:
    """Return the hyper-parameters that a run was trained with."""
    return dict(yaml.load((run / ENV / "config.yml").read_text(), Loader=yaml.UnsafeLoader))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_said(tmp_path_factory.mktemp("logs"))


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A run of its own, since tuning writes into it."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The depths that were trained, in order."""
    depths: list[int] = []
    train_planner = DepthPlanners._train

    def counted(self: DepthPlanners, depth: int) -> None:
        depths.append(depth)
        train_planner(self, depth)

    monkeypatch.setattr(DepthPlanners, "_train", counted)
    return depths


def forbidden(*_: Any, **__: Any) -> Any:
    raise AssertionError("this was done already")


def test_a_search_from_grid_to_report(
    run: Path, trainings: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    command = ["--run", str(run), "--depths", "1", "2", "--temperatures", "0", "1", *QUICK]
    seeds: list[int] = []

    def recorded(model: Any, env: Any, n: int, seed: int, *args: Any, **kwargs: Any) -> Any:
        seeds.extend(range(seed, seed + n))
        return rollout(model, env, n, seed, *args, **kwargs)

    monkeypatch.setattr(tune, "rollout", recorded)
    tune.main(command)
    results = json.loads((run / "tune" / "results.json").read_text())
    cells = {(trial["depth"], trial["temperature"]) for trial in results["trials"]}
    assert len(results["trials"]) == 4 and cells == {(1, 0.0), (1, 1.0), (2, 0.0), (2, 1.0)}
    assert trainings == [2]  # once for two temperatures, and never the depth that the run itself has
    assert (run / "tune" / "importance.png").is_file() and (run / "tune" / "slice.png").is_file()

    # The report is on other episodes, and evaluate.py gets the same numbers from best.zip.
    report = results["report"]
    assert set(seeds) == set(range(20_000, 20_004))
    assert not set(seeds) & set(range(report["seed"], report["seed"] + report["n_episodes"]))
    best = load_run(run / "tune" / "best.zip", device="cpu")
    assert best.info["delay"] == 2 and isinstance(best.model, SAID)
    winner = results["winner"]
    config = best.model.policy.planner.config
    assert (config.depth, config.temperature) == (winner["depth"], winner["temperature"])
    for one in report["results"]:
        with best.model.policy.answering(one["label"]):
            played = rollout(best.model, best.make_env, 3, report["seed"], n_envs=8)
        assert one["returns"] == played.returns.tolist()
    assert [one["label"] for one in report["results"]] == ["planner", "expert"]

    # The same command again makes nothing twice, and still says what was found.
    monkeypatch.setattr(tune, "rollout", forbidden)
    monkeypatch.setattr(tune, "evaluate", forbidden)
    capsys.readouterr()
    tune.main(command)
    out = capsys.readouterr().out
    assert "No trial is left" in out and "4 trials" in out and trainings == [2]
    assert json.loads((run / "tune" / "results.json").read_text())["report"] == report

    # A grid that grew makes only what is new.
    monkeypatch.setattr(tune, "rollout", rollout)
    tune.main(["--run", str(run), "--depths", "1", "--temperatures", "0", "0.5", "1", *QUICK])
    trials = json.loads((run / "tune" / "results.json").read_text())["trials"]
    assert [(t["depth"], t["temperature"]) for t in trials[4:]] == [(1, 0.5)]


@pytest.mark.parametrize(
    ("delay", "params"),
    [
        ([0, 3], []),
        ([2], ["normalize:dict(norm_obs_keys=['observation'])"]),
        ([1, 2], ["normalize:dict(norm_obs=False)"]),
    ],
    ids=["drawn delay", "VecNormalize", "normalized rewards"],
)
def test_a_search_with_a_drawn_delay_or_vec_normalize(delay: list[int], params: list[str], tmp_path: Path) -> None:
    run = train_said(tmp_path, *params, delay=delay)
    tune.main(["--run", str(run), "--depths", "1", "2", "--temperatures", "0.5", *QUICK])
    results = json.loads((run / "tune" / "results.json").read_text())
    assert [(trial["depth"], trial["temperature"]) for trial in results["trials"]] == [(1, 0.5), (2, 0.5)]

    # A depth is trained on the very data, in the very units, that the run's own planner was.
    own, other = (load_tree(run / "tune" / f"planner_depth{depth}.zip")["planner"] for depth in (1, 2))
    statistics = [name for name in own if name.startswith("normalizer.")]
    assert statistics
    for name in statistics:
        th.testing.assert_close(other[name], own[name], rtol=0, atol=0)

    # What is reported is what best.zip and its statistics give again, and best.yml is of the same task.
    best, report = load_run(run / "tune" / "best.zip", device="cpu"), results["report"]
    assert (best.normalize is not None) == bool(params)
    for one in report["results"]:
        with best.model.policy.answering(one["label"]):
            played = rollout(best.model, best.make_env, 3, report["seed"], n_envs=8, normalize=best.normalize)
        assert one["returns"] == played.returns.tolist()
    expected = {**config_of(run), "n_timesteps": 200}
    expected["planner_kwargs"] |= {name: results["winner"][name] for name in ("depth", "temperature")}
    assert read_by_train(run / "tune" / "best.yml", read_delay([str(d) for d in delay]), "cpu", tmp_path) == expected
    command = RunConfig.read(run).train_command(run / "tune")
    assert f"--delay {' '.join(map(str, delay))} -conf" in command


def test_train_reads_the_winner(run: Path, tmp_path: Path) -> None:
    (run / "tune").mkdir()
    config = RunConfig.read(run)
    assert config.write_best(run / "tune", {"depth": 2, "temperature": 0.3}, "for a test") == []
    best = run / "tune" / "best.yml"
    expected = {**config_of(run), "n_timesteps": 200}
    expected["planner_kwargs"] |= {"depth": 2, "temperature": 0.3}
    for preset in ("cpu", "paper"):  # "paper" is the default on a machine with a GPU
        assert read_by_train(best, 2, preset, tmp_path) == expected
    assert config.train_command(run / "tune").endswith(f"--env {ENV} --delay 2 -conf {best}")
    train.main(["--algo", "said", "--env", ENV, "--delay", "2", "-conf", str(best), "-f", str(tmp_path), "-n", "120",
                "--num-threads", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0"])  # fmt: skip
    model = load_run(tmp_path / "said" / f"{ENV}-delay2_1", device="cpu").model
    assert isinstance(model, SAID) and model.policy.planner.config.temperature == 0.3
    assert len(model.policy.planner.network.blocks) == 2


def test_what_yaml_cannot_hold_is_named() -> None:
    config = RunConfig(Path(), {"policy_kwargs": {"activation_fn": th.nn.Tanh}, "gamma": 0.9}, {})
    block, left_out = config.block({"depth": 2, "temperature": 0.0})
    assert block == {"gamma": 0.9, "planner_kwargs": {"depth": 2, "temperature": 0.0}}
    assert left_out == ["policy_kwargs"]


@pytest.mark.parametrize("storage", [[], ["--storage", "sqlite:///{}/study.db"]], ids=["journal", "sqlite"])
def test_two_workers_share_a_study_and_train_no_depth_twice(run: Path, storage: list[str]) -> None:
    grid = ["--depths", "2", "3", "--temperatures", "0", "1"]
    command = [sys.executable, str(SCRIPT), "--run", str(run), *grid, *QUICK, *(word.format(run) for word in storage)]
    environ = {**os.environ, "OMP_NUM_THREADS": "1"}
    workers = [
        subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for _ in range(2)
    ]
    outputs = [worker.communicate(timeout=240)[0] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], outputs
    assert sum(out.count("Training the planner of depth 2") for out in outputs) == 1, outputs
    assert sum(out.count("Training the planner of depth 3") for out in outputs) == 1, outputs
    trials = json.loads((run / "tune" / "results.json").read_text())["trials"]
    assert len(trials) == 4 and len({(t["depth"], t["temperature"]) for t in trials}) == 4
    assert not list((run / "tune" / "locks").iterdir())
    assert (run / "study.db" if storage else run / "tune" / "study.log").exists()


def make_planners(run: Path, folder: Path, steps: int) -> DepthPlanners:
    model = load_run(run, device="cpu").model
    assert isinstance(model, SAID)
    return DepthPlanners(model, run / CHECKPOINT_NAME, folder, steps)


def test_a_killed_training_goes_on_bit_for_bit(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = make_planners(run, tmp_path / "whole", 6)
    whole.put(2, 0.5)
    callback = functools.partial(tuning.PlannerTrainingCallback, save_interval=2)
    monkeypatch.setattr(tuning, "PlannerTrainingCallback", callback)
    halved = make_planners(run, tmp_path / "halved", 6)
    step, calls = tuning.SAID.make_planner_trainer, []

    def stopping(self: SAID, gradient_steps: int | None = None) -> Any:
        trainer = step(self, gradient_steps)
        original = trainer.step

        def one_step() -> None:
            if len(calls) == 3:
                raise KeyboardInterrupt
            calls.append(trainer.n_updates)
            original()

        monkeypatch.setattr(trainer, "step", one_step)
        return trainer

    monkeypatch.setattr(SAID, "make_planner_trainer", stopping)
    with pytest.raises(KeyboardInterrupt):
        halved.put(2, 0.5)
    assert not halved.is_ready(2) and halved.claim(2).holder() is None
    monkeypatch.setattr(SAID, "make_planner_trainer", step)
    again = make_planners(run, tmp_path / "halved", 6)
    again.put(2, 0.5)
    for left, right in zip(
        whole.model.policy.planner.parameters(), again.model.policy.planner.parameters(), strict=True
    ):
        th.testing.assert_close(left, right, rtol=0, atol=0)
    # The expert is the run's, whatever the planner.
    expert = load_run(run, device="cpu").model.policy.actor.state_dict()
    for name, value in again.model.policy.actor.state_dict().items():
        th.testing.assert_close(value, expert[name], rtol=0, atol=0)


def test_planners_of_another_training_are_refused(run: Path, tmp_path: Path) -> None:
    make_planners(run, tmp_path, 2).put(2, 0.5)
    with pytest.raises(ValueError, match=r"gradient_steps was 2 and is now 4.*delete the file"):
        make_planners(run, tmp_path, 4).put(2, 0.5)


def test_how_a_planner_answers_is_no_matter_of_its_training(run: Path, tmp_path: Path, trainings: list[int]) -> None:
    first = make_planners(run, tmp_path, 2)
    first.put(2, 0.5)
    model = load_run(run, device="cpu").model
    assert isinstance(model, SAID)
    model.set_planner(n_candidates=3, sampling_steps=2)
    again = DepthPlanners(model, run / CHECKPOINT_NAME, tmp_path, 2)
    again.put(2, 0.1)
    assert trainings == [2]  # the same weights, other answers
    config = model.policy.planner.config
    assert (config.depth, config.temperature, config.n_candidates, config.sampling_steps) == (2, 0.1, 3, 2)
    assert first.training_settings(2) == again.training_settings(2)
    # Returns of other answers cannot be compared.
    differing = first.trial_settings()["config"].items() ^ again.trial_settings()["config"].items()
    assert {name for name, _ in differing} == {"n_candidates", "sampling_steps"}
    Search(tmp_path, str(tmp_path / "study.log"), "test", [2], [0.5], settings=first.trial_settings())
    with pytest.raises(
        ValueError, match=r"settings: n_candidates was 2 and is now 3; sampling_steps was 1 and is now 2\."
    ):
        Search(tmp_path, str(tmp_path / "study.log"), "test", [2], [0.5], settings=again.trial_settings())


def test_an_agent_with_a_planner_put_in_is_saved_with_it(run: Path, tmp_path: Path) -> None:
    planners = make_planners(run, tmp_path, 2)
    for depth, temperature in ((2, 0.3), (3, 0.0), (2, 0.7)):
        planners.put(depth, temperature)
        planners.model.save(tmp_path / "agent.zip")
        loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
        assert loaded.policy.planner.config == planners.model.policy.planner.config
        assert (loaded.policy.planner.config.depth, loaded.policy.planner.config.temperature) == (depth, temperature)
        assert loaded.planner_kwargs["depth"] == depth and loaded.policy.planner_updates == 2
        th.testing.assert_close(loaded.policy.state_dict(), planners.model.policy.state_dict(), rtol=0, atol=0)


def test_planners_have_the_runs_settings_whatever_the_defaults_are_then(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = make_planners(run, tmp_path / "before", STEPS)
    expected.put(1, 0.5)
    expected.put(2, 0.5)
    defaults = list(PlannerConfig.__init__.__defaults__)
    names = [field.name for field in fields(PlannerConfig)]
    for name, value in {"embed_known": False, "solver": "dpmsolver++2m"}.items():
        assert defaults[names.index(name)] != value
        defaults[names.index(name)] = value
    monkeypatch.setattr(PlannerConfig.__init__, "__defaults__", tuple(defaults))
    planners = make_planners(run, tmp_path / "after", STEPS)
    planners.put(1, 0.5)  # the run's own
    planners.put(2, 0.5)  # trained anew
    assert planners.config == expected.config
    assert planners.model.policy.planner.config == expected.model.policy.planner.config
    ours, theirs = (each.model.policy.planner.state_dict() for each in (planners, expected))
    th.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_a_claim_has_one_holder_and_outlives_no_process(tmp_path: Path) -> None:
    first, second = Claim(tmp_path / "work.lock"), Claim(tmp_path / "work.lock")
    assert first.try_acquire() and not second.try_acquire()
    assert second.holder() == f"process {os.getpid()} on {json.loads(first._content)['host']}"
    second.release()  # not its own: nothing happens
    assert first.holder() is not None
    first.release()
    assert second.try_acquire()
    second.release()

    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    content = json.loads(first._content)
    first.path.write_text(json.dumps({**content, "pid": ended.pid}))  # its process died here
    assert second.holder() is None and second.try_acquire()
    second.release()
    first.path.write_text(json.dumps({**content, "host": "elsewhere"}))
    assert not second.try_acquire()
    long_ago = time.time() - 1_000
    os.utime(first.path, (long_ago, long_ago))  # its process died elsewhere
    assert second.try_acquire()
    # Who still believes in the stale one takes nothing from its new holder.
    first._remove_stale(json.dumps({**content, "host": "elsewhere"}))
    assert second.holder() is not None
    second.release()
    assert not list(tmp_path.iterdir())


def test_a_held_claim_is_touched(tmp_path: Path) -> None:
    claim = Claim(tmp_path / "work.lock", stale_after=0.4)
    with claim:
        time.sleep(1.0)
        other = json.loads(claim._content) | {"host": "elsewhere"}
        claim._content = json.dumps(other)  # as a process on another host sees it: only the touches count
        assert claim.holder() is not None
        claim._content = json.dumps({**other, "host": json.loads(claim.path.read_text())["host"]})
    assert not claim.path.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "10049"], "Tuning would play the reset seeds 10049..10068"),
        (["--episodes", "0"], "--episodes must be at least 1, got 0"),
        (["--prune", "1.5"], "--prune is a p-value"),
        (["--depths", "2", "2"], "--depths names a value twice: 2 2"),
        (["--temperatures", "-1"], "temperature is -1"),
        (["--depths", "0"], "depth is 0"),
    ],
)
def test_says_what_is_wrong(run: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        tune.main(["--run", str(run), *arguments])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


def test_folders_that_cannot_be_tuned(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, message in (
        (tmp_path / "nowhere", "does not exist"),
        (train_run(tmp_path, "sadr"), "is a run of 'sadr', which has no planner"),
    ):
        with pytest.raises(SystemExit):
            tune.main(["--run", str(folder), "--device", "cpu"])
        assert message in capsys.readouterr().err
    (run / CHECKPOINT_NAME).unlink()
    with pytest.raises(SystemExit):
        tune.main(["--run", str(run), "--device", "cpu"])
    assert "has no checkpoint.zip" in capsys.readouterr().err
