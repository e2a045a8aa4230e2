"""Learning from logs on the command line: no environment is stepped, and runs go on, are played and tuned as online."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from trained_run import ENV, PLANNER, report_quickly, train_here

from sb3_said import SAID
from sb3_said.files.archive import load_tree
from sb3_said.offline import BC, DQL, IQL, REFERENCE_RETURNS, DQLConfig, IQLConfig
from sb3_said.offline.learning import GradientStepBar
from sb3_said.zoo import evaluate, train, tune
from sb3_said.zoo.algorithms import ALGOS
from sb3_said.zoo.offline import OfflineExperimentManager
from sb3_said.zoo.presets import PRESETS, config_file, dataset_kind, preset_overrides
from sb3_said.zoo.record import Record
from sb3_said.zoo.runs import answers, load_run

EVERY = "--eval-freq 10 --eval-episodes 2 --log-interval 10".split()
PARAMS = {
    "bc": ["-params", "batch_size:16", "policy_kwargs:dict(net_arch=[16])"],
    "dql": ["-params", "batch_size:16", "diffusion_kwargs:dict(hidden=16)"],
    "said": ["-params", f"planner_kwargs:{PLANNER}", "iql_kwargs:dict(expectile=0.9, hidden=16, batch_size=16)"],
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few episodes of the task under random actions."""
    env, rng = gym.make(ENV), np.random.default_rng(0)
    columns: dict[str, list[Any]] = {}
    for seed in range(8):
        obs, ended = env.reset(seed=seed)[0], False
        while not ended:
            action = rng.uniform(-1, 1, 1).astype(np.float32)
            after, reward, ended, _, _ = env.step(action)
            row = {"observations": obs, "actions": action, "rewards": reward, "terminals": ended, "timeouts": False}
            for key, value in (row | {"next_observations": after}).items():
                columns.setdefault(key, []).append(value)
            obs = after
    path = tmp_path_factory.mktemp("data") / "little-medium.npz"
    np.savez(path, **{key: np.array(value) for key, value in columns.items()})
    return path


class Killed(BaseException):
    """As a kill -9: nothing is written after it."""


def run_of(folder: Path, algo: str) -> Path:
    (run,) = (folder / algo).iterdir()
    return run


def weights(run: Path, algo: str) -> dict[str, Any]:
    return ALGOS[algo].load(run / f"{ENV}.zip", device="cpu").get_parameters()["policy"]


def command(algo: str, log: Path, steps: int = 20) -> list[str]:
    words = f"--algo {algo} --env {ENV} --delay 0 2 --dataset {log} -n {steps} --seed 3 --checkpoint-freq 5"
    return words.split()


@pytest.fixture(scope="module", params=["bc", "said"])
def finished(request: pytest.FixtureRequest, log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A run of each algorithm, evaluated twice on the way, and its folder."""
    folder = tmp_path_factory.mktemp("logs")
    train_here(folder, " ".join(command(request.param, log)), *EVERY, *PARAMS[request.param])
    return request.param, run_of(folder, request.param)


def test_a_run_leaves_its_agent_record_log_and_evaluations(finished: tuple[str, Path], log: Path) -> None:
    algo, run = finished
    assert run.name == f"{ENV}-delay0-2-little-medium-seed3_1"
    model = load_run(run, device="cpu").model
    assert isinstance(model, {"bc": BC, "said": SAID}[algo])
    assert model.num_timesteps == 20 and answers(model) == [None if algo == "bc" else "planner"]
    assert model._n_updates == (20 if algo == "bc" else 0)  # no expert learns beside a planner
    assert Record.read(run).dataset == [str(log)]
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    assert answers(load_run(run / "best_model.zip", device="cpu").model) == answers(model)
    assert not list(run.glob("*monitor.csv")) and not (run / "expert").exists()
    if isinstance(model, SAID):
        assert model.policy.values is not None
        assert model.policy.values.config == IQLConfig(expectile=0.9, hidden=16, batch_size=16)
    column = "train/action_error" if algo == "bc" else "iql/v_loss"
    assert column in (run / "progress.csv").read_text()


def test_what_may_follow_an_ended_run_is_said(
    finished: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    algo, run = finished
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    train.main(["--resume", str(copy)])
    shown = capsys.readouterr().out
    assert ("trains it for longer" in shown, "start a new run" in shown) == (algo == "bc", algo == "said")
    longer = ["--resume", str(copy), "-n", "25"]
    if algo == "bc":
        train.main(longer)
    else:
        with pytest.raises(SystemExit, match="gradient_steps was 20 and is now 25"):
            train.main(longer)


def test_evaluations_come_by_gradient_steps_however_many_environments_there_are(log: Path, tmp_path: Path) -> None:
    train_here(tmp_path, " ".join(command("bc", log)), *EVERY, *PARAMS["bc"], "n_envs:2")
    assert np.load(run_of(tmp_path, "bc") / "evaluations.npz")["timesteps"].tolist() == [10, 20]


def test_a_killed_run_ends_as_one_that_was_not(
    finished: tuple[str, Path], log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    algo, whole = finished

    def die_after(self: Any, watcher: Any, original: Any = BC._goes_on) -> bool:
        if self.num_timesteps == 13:
            raise Killed
        return original(self, watcher)

    monkeypatch.setattr(ALGOS[algo], "_goes_on", die_after)
    with pytest.raises(Killed):
        train_here(tmp_path, " ".join(command(algo, log)), *EVERY, *PARAMS[algo])
    monkeypatch.undo()
    run = run_of(tmp_path, algo)
    assert not (run / f"{ENV}.zip").exists()
    train.main(["--resume", str(run)])
    left, right = weights(whole, algo), weights(run, algo)
    assert all((left[key] == right[key]).all() for key in left)
    rows = [np.load(r / "evaluations.npz") for r in (whole, run)]  # the task goes on to other episodes
    np.testing.assert_array_equal(rows[0]["timesteps"], rows[1]["timesteps"])
    np.testing.assert_array_equal(rows[0]["results"][0], rows[1]["results"][0])


@pytest.mark.parametrize("algo", PARAMS)
def test_other_data_is_not_gone_on_with(
    algo: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.npz"
    mine.write_bytes(log.read_bytes())
    train_here(tmp_path, " ".join(command(algo, mine, steps=2)), *PARAMS[algo])
    words = ["--resume", str(run_of(tmp_path, algo))]
    # SAID's planner has the length that its training began with
    words += ["-n", "4"] if algo != "said" else ["--verbose", "1"]
    with np.load(log) as file:
        columns = dict(file)
    changes: list[dict[str, Any]] = [
        {"actions": -columns["actions"]},
        {"rewards": columns["rewards"] + 1},
        {name: 1.5 * columns[name] for name in ("observations", "next_observations")},
        {"terminals": columns["timeouts"], "timeouts": columns["terminals"]},
    ]
    for change in changes:
        np.savez(mine, **columns | change)
        with pytest.raises(SystemExit, match=r"train: error: Cannot load .*zip': it is of a training on other data; "):
            train.main(words)
    assert "Stopped" not in capsys.readouterr().out  # it did not begin
    np.savez(mine, **columns)
    train.main(words)
    assert load_run(run_of(tmp_path, algo), device="cpu").model.num_timesteps == (2 if algo == "said" else 4)


@pytest.mark.parametrize("algo", ["bc", "said"])
def test_a_resume_and_a_search_say_that_their_data_is_gone_or_damaged(
    algo: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.npz"
    mine.write_bytes(log.read_bytes())
    train_here(tmp_path, " ".join(command(algo, mine, steps=2)), *PARAMS[algo])
    run = str(run_of(tmp_path, algo))
    mine.write_bytes(log.read_bytes()[:500])
    for message in (r".*mine\.npz cannot be read; it is damaged", r"There is no dataset .*mine\.npz"):
        with pytest.raises(SystemExit, match=f"train: error: {message}"):
            train.main(["--resume", run, "-n", "4"])
        if algo == "said":  # bc has no planner to tune
            with pytest.raises(SystemExit):
                tune.main([run, "--depths", "2", "--device", "cpu"])
            assert re.search(message, capsys.readouterr().err)
        mine.unlink(missing_ok=True)


@pytest.mark.parametrize("algo", ["bc", "said"])
def test_the_bar_counts_gradient_steps(
    algo: str, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bars, close = [], GradientStepBar._on_training_end

    def note(bar: GradientStepBar) -> None:
        bars.append((bar.pbar.n, bar.pbar.total))
        close(bar)

    monkeypatch.setattr(GradientStepBar, "_on_training_end", note)
    train_here(tmp_path, " ".join(command(algo, log, steps=4)), "-P", *PARAMS[algo], "n_envs:2")
    assert bars == [(4, 4)] and "/8" not in capsys.readouterr().out


def test_evaluate_has_scores_and_the_best_agent_beside_the_last(
    finished: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    algo, run = finished
    monkeypatch.setitem(REFERENCE_RETURNS, ENV.split("-")[0].lower(), (10.0, 210.0))
    who = "bc" if algo == "bc" else "planner"
    best = ALGOS[algo].load(run / f"{ENV}.zip", device="cpu")
    killed = Path(shutil.copytree(run, tmp_path / "killed"))
    (killed / f"{ENV}.zip").unlink()
    for folder, steps, labels in (
        (run, 7, [(who, "last", 20), (who, "best", 7)]),
        (run, 20, [(who, "last", 20)]),
        (killed, 7, [(who, "best", 7)]),
    ):
        best.num_timesteps = steps
        best.save(folder / "best_model.zip")
        evaluate.main([str(folder), "--episodes", "2", "--latency-calls", "0", "--device", "cpu", "--delay", "1"])
        results = json.loads((folder / "evaluation.json").read_text())["results"]
        assert [(r["label"], r["which"], r["trained_steps"]) for r in results] == labels
        for r in results:
            assert r["normalized_score"][0] == pytest.approx((np.mean(r["returns"]) - 10) / 2)
        header, row = capsys.readouterr().out.splitlines()[-3:-1]
        kinds = [which for _, which, _ in labels]
        named = [kind for kind in ("mean", "last", "best") if f"{kind} return" in header]
        assert named == (["mean"] if kinds == ["last"] else kinds)
        assert row.split()[0] == who
        for r in results:  # in the columns of its own
            assert f"{r['mean_return']['value']:,.1f}" in row.split()
    assert evaluate.score_of(evaluate.Summary.from_episodes("x", [1.0, 2.0], [1, 1]), "Pendulum-v1") is None


def test_tune_trains_depths_on_the_same_logs(
    finished: tuple[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    algo, run = finished
    if algo == "bc":
        with pytest.raises(SystemExit):
            tune.main([str(run)])
        assert "is a run of 'bc', which has no planner" in capsys.readouterr().err
        return
    report_quickly(monkeypatch)
    monkeypatch.setattr(IQL, "step", lambda _: pytest.fail("V is the run's"))
    quick = "--depths 2 --temperatures 0.5 --sampling-steps 1 --episodes 2 --round 2 --report-episodes 2".split()
    for _ in range(2):  # the same command goes on after a crash, and where all is done
        tune.main([str(run), *quick, "--gradient-steps", "3", "--device", "cpu", "--num-threads", "1"])
    report = json.loads((run / "tune" / "results.json").read_text())["report"]
    assert [one["label"] for one in report["results"]] == ["planner"]
    assert f"--dataset {Record.read(run).dataset[0]}" in (run / "tune" / "best.yml").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--algo bc --delay 2", "--algo bc learns from logs: name them with --dataset"),
        ("--algo sac --dataset {log}", "--dataset is for --algo said, bc, dql"),
        ("--algo said --delay 2 --expert-delay 0 --dataset {log}", "--expert-delay has no effect"),
        ("--algo bc --dataset nowhere.npz", "nowhere.npz, which is not there"),
        ("--algo said --dataset {log} -params planner_gradient_steps:3", "whose steps -n sets"),
        ("--algo bc --dataset {log} --save-replay-buffer", "--save-replay-buffer has no place"),
        ("--algo bc --dataset {log} -optimize", "--algo stable -optimize"),
    ],
)
def test_says_what_is_wrong(
    words: str, message: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(["--env", ENV, "-f", str(tmp_path), *words.format(log=log).split()])
    assert stop.value.code == 2 and message in capsys.readouterr().err
    assert not list(tmp_path.glob("*/*/*"))


def test_data_of_another_task_ends_the_program_with_a_reason(log: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"observations of shape \(4,\), and the task \(3,\)"):
        train_here(tmp_path, f"--algo bc --env Pendulum-v1 --dataset {log} -n 5")


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("algo", ["said", "bc", "dql"])
def test_every_preset_exists(algo: str, preset: str) -> None:
    made = preset_overrides(config_file(algo, True), preset, "Hopper-v5", 4, None, ["medium"])
    assert made or preset == "cpu"


PAPER = {  # Table 4: depth, temperature at delays 0, 4, 8, 16
    ("HalfCheetah-v5", "medium-expert"): [(8, 0.8), (8, 0.3), (8, 0.1), (4, 0.1)],
    ("HalfCheetah-v5", "medium-replay"): [(4, 1.0), (8, 0.6), (8, 0.1), (8, 0.3)],
    ("HalfCheetah-v5", "medium"): [(8, 0.8), (8, 0.3), (8, 0.1), (8, 0.1)],
    ("Walker2d-v5", "medium-expert"): [(8, 1.0), (8, 0.8), (8, 0.8), (8, 0.3)],
    ("Walker2d-v5", "medium-replay"): [(2, 0.8), (4, 0.8), (4, 0.6), (8, 0.8)],
    ("Walker2d-v5", "medium"): [(8, 1.0), (8, 1.0), (4, 1.0), (8, 0.6)],
    ("Hopper-v5", "medium-expert"): [(8, 0.3), (8, 0.3), (4, 0.1), (8, 0.1)],
    ("Hopper-v5", "medium-replay"): [(2, 0.6), (8, 1.0), (8, 0.8), (4, 0.8)],
    ("Hopper-v5", "medium"): [(8, 1.0), (4, 1.0), (4, 1.0), (8, 1.0)],
}


def test_the_paper_preset_has_the_papers_pairs_by_the_datasets_name() -> None:
    for (env_id, kind), pairs in PAPER.items():
        for delay, pair in zip((0, 4, 8, 16), pairs, strict=True):
            name = f"{env_id.split('-')[0].lower()}_{kind.replace('-', '_')}-v2.hdf5"
            made = preset_overrides(config_file("said", True), "paper", env_id, delay, None, [name])
            planner = made["planner_kwargs"]
            assert (planner["depth"], planner["temperature"]) == pair, (env_id, kind, delay)
            assert (made["n_timesteps"], planner["mask"]) == (1_000_000, "fixed")
            assert made["iql_kwargs"] == {"updates": 1}  # Algorithm 2
            assert "planner_by_dataset" not in made
    varies = preset_overrides(config_file("said", True), "paper", "Hopper-v5", [0, 16], None, ["medium"])
    assert varies["planner_kwargs"]["mask"] == "random"
    kinds = {
        "mujoco/hopper/medium-v0": "medium",
        "/home/expert/replay/hopper-medium.npz": "medium",
        "mujoco/hopper/expert-v0": "medium-expert",
        "Replay.npz": "medium-replay",
    }
    assert {name: dataset_kind([name]) for name in kinds} == kinds


def test_a_stop_writes_a_checkpoint(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ask(self: Any, watcher: Any, original: Any = BC._goes_on) -> bool:
        if self.num_timesteps == 13:
            made[0].stopping.is_asked = True
        return original(self, watcher)

    made: list[Any] = []
    initialise = OfflineExperimentManager.__init__

    def remember(self: Any, *args: Any, **kwargs: Any) -> None:
        made.append(self)
        initialise(self, *args, **kwargs)

    monkeypatch.setattr(OfflineExperimentManager, "__init__", remember)
    monkeypatch.setattr(BC, "_goes_on", ask)
    monkeypatch.setattr(SAID, "_goes_on", ask)
    for algo, name in (("bc", "checkpoint"), ("said", "planner_checkpoint")):
        made.clear()
        with pytest.raises(SystemExit) as stop:
            train_here(tmp_path, " ".join(command(algo, log)), *PARAMS[algo])
        assert stop.value.code == 130
        state = load_tree(run_of(tmp_path, algo) / f"{name}.zip")
        assert (state["counters"]["num_timesteps"] if algo == "bc" else state["trainer"]["n_updates"]) == 13


def test_dql_has_the_papers_settings_and_learns_here(log: Path, tmp_path: Path) -> None:
    train_here(tmp_path, f"--algo dql --env {ENV} --delay 1 --dataset {log} --preset smoke -n 3 --seed 3")
    model = load_run(run_of(tmp_path, "dql"), device="cpu").model
    assert isinstance(model, DQL) and (model.augment_state, model.delay_reconciled_critic) == (True, False)
    assert model.policy.config == DQLConfig() and model._n_updates == 3
    assert "train/critic_loss" in (run_of(tmp_path, "dql") / "progress.csv").read_text()  # a run shorter than a row
    norms = {  # Table 4: medium, medium-replay, medium-expert
        "HalfCheetah-v5": (9.0, 2.0, 7.0),
        "Hopper-v5": (9.0, 4.0, 5.0),
        "Walker2d-v5": (1.0, 4.0, 5.0),
    }
    for preset, more in (("cpu", {}), ("paper", {"n_timesteps": 2_000_000, "lr_decay": True, "relabelled_ages": 0.0})):
        for env_id, of_task in norms.items():
            for name, norm in zip(("medium", "medium-replay", "medium-expert"), of_task, strict=True):
                made = preset_overrides(config_file("dql", True), preset, env_id, 4, None, [f"data/x-{name}-v2.hdf5"])
                assert made == {"diffusion_kwargs": {"max_grad_norm": norm}, **more}
        assert preset_overrides(config_file("dql", True), preset, "Mine-v0", 4, None, ["expert.npz"]) == more


def test_a_python_file_of_settings_has_no_presets(tmp_path: Path) -> None:
    file = tmp_path / "settings.py"
    file.write_text("hyperparams = {}")
    assert preset_overrides(file, "cpu", "Hopper-v5", 4) == {}
    with pytest.raises(ValueError, match="no preset 'paper'"):
        preset_overrides(file, "paper", "Hopper-v5", 4)
