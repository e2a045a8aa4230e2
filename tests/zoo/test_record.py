"""run.json: it brings back what a run was started with, and nothing that anyone writes beside a run is executed."""

from __future__ import annotations

import argparse
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch as th

pytest.importorskip("rl_zoo3")

from small_run import ENV, write_run
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_said import DelayedSAC
from sb3_said.zoo import train
from sb3_said.zoo.record import Record, with_delay
from sb3_said.zoo.runs import load_run


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("sadr") / f"{ENV}-delay2-seed0_1", DelayedSAC, 2)


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A run of its own, to write into."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def test_what_a_run_was_started_with_comes_back(tmp_path: Path) -> None:
    record = Record(
        "said", ENV, 3, [0, 4], 0, "quick", 500, ["gymnasium"], {"range": (0.7, math.inf)}, {},
        {
            "gamma": 0.9,
            "train_freq": (1, "step"),
            "policy_kwargs": {"activation_fn": th.nn.Tanh, "net_arch": [8]},
            "env_wrapper": [{"rl_zoo3.wrappers.TimeFeatureWrapper": {"test_mode": True}}],
            "callback": [{"stable_baselines3.common.callbacks.CheckpointCallback": {"save_freq": 9, "save_path": "x"}}],
        },
        {"n_timesteps": -1, "progress": True, "device": "cpu"},
    )  # fmt: skip
    record.write(tmp_path)
    assert Record.read(tmp_path) == record
    assert record.command_line() == [
        f"--env={ENV}",
        "--seed=3",
        "--n-timesteps=-1", "--progress", "--device=cpu", "--gym-packages", "gymnasium"
    ]  # fmt: skip


def test_what_no_plain_file_holds_is_named(tmp_path: Path) -> None:
    given = {
        "gamma": 0.9,
        "policy_kwargs": {"f": len},
        "callback": [CheckpointCallback(9, "x")],
        "env_wrapper": "os.fork",
    }
    Record("said", ENV, hyperparams=given).write(tmp_path)
    record = Record.read(tmp_path)
    assert record.hyperparams == {"gamma": 0.9} and set(record.missing) == {"policy_kwargs", "callback", "env_wrapper"}
    with pytest.raises(ValueError, match=r"env_wrapper is not in its run.json: .* gymnasium.core.Wrapper"):
        record.require("env_wrapper")


def test_the_delay_is_around_the_users_own_wrappers_and_given_once() -> None:
    wrapper = "sb3_said.delays.DelayedObservationWrapper"
    assert with_delay("a.B", 2) == ["a.B", {wrapper: {"delay": 2}}]
    assert with_delay(None, [0, 2], 4) == [{wrapper: {"delay": [0, 2], "max_delay": 4}}]
    assert with_delay([{wrapper: {"delay": 3}}], None) == [{wrapper: {"delay": 3}}]
    with pytest.raises(ValueError, match="given twice, as --delay 2 and in env_wrapper="):
        with_delay([{wrapper: {"delay": 3}}], 2)


def forge(run: Path, **changes: Any) -> None:
    document = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**document, **changes}))


def test_code_beside_a_run_is_not_run(run: Path, tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    touch = f"__import__('pathlib').Path({str(trace)!r}).touch()"
    (run / ENV).mkdir()
    for name in ("args.yml", "config.yml"):
        (run / ENV / name).write_text(f"!!python/object/apply:builtins.exec [{json.dumps(touch)}]\n")
    (run / "train_args.json").write_text(json.dumps(["--env", ENV, "-params", f"gamma:{touch}"]))
    for path in (run, run / f"{ENV}.zip"):
        assert load_run(path, device="cpu").info["delay"] == 2
    train.read_command_line(["--resume", str(run)])
    assert not trace.exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"options": {"hyperparams": ["gamma:print(1)"]}}, "the option hyperparams="),
        ({"options": {"hyperp": "gamma:print(1)"}}, "the option hyperp="),
        ({"options": {"device": ["cpu", "-params", "gamma:print(1)"]}}, "the option device="),
        ({"options": {"conf_file": "evil.py"}}, "the option conf_file="),
        ({"gym_packages": ["gymnasium", "-params"]}, "'-params' is no name of a module"),
        ({"hyperparams": {"gamma": {"@": ["eval", "1"]}}}, "damaged"),
        ({"hyperparams": 3}, "damaged"),
        ({"unknown": 3}, "damaged, or of another version"),
    ],
    ids=str,
)
def test_a_forged_record_is_refused(changes: dict[str, Any], message: str, run: Path, capsys: Any) -> None:
    forge(run, **changes)
    with pytest.raises(ValueError, match=message):
        train.read_command_line(["--resume", str(run)])


@pytest.mark.parametrize("name", ["subprocess.Popen", "os.system", "builtins.exec", "os.getcwd"])
def test_a_forged_name_calls_nothing(name: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forge(run, hyperparams={"env_wrapper": [{name: {}}]})
    with pytest.raises(ValueError, match=f"'{name}' is no class that derives from gymnasium.core.Wrapper"):
        load_run(run, device="cpu")
    for kind in ("callback", "vec_env_wrapper", "env_wrapper"):
        forge(run, hyperparams={kind: [{name: {}}]})
        with pytest.raises(SystemExit):
            train.main(["--resume", str(run), "--verbose", "0"])
        assert f"'{name}' is no class that derives from" in capsys.readouterr().err


def test_text_that_rl_zoo3_would_evaluate_is_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("policy_kwargs", "normalize", "monitor_kwargs", "replay_buffer_kwargs", "replay_buffer_class"):
        forge(run, hyperparams={kind: "print('evil')"})
        with pytest.raises(SystemExit):
            train.main(["--resume", str(run), "--verbose", "0"])
        shown = capsys.readouterr()
        assert f"{kind} is text" in shown.err and "evil" not in shown.out


def test_a_resume_keeps_the_number_of_threads_unless_told(run: Path) -> None:
    options = json.loads((run / "run.json").read_text())["options"]
    forge(run, options={**options, "num_threads": 2})
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--num-threads", type=int)
    for given, n_threads in ([], 2), (["--num-threads", "3"], 3):
        words = train.read_command_line(["--resume", str(run), *given])[2]
        assert parser.parse_known_args(words)[0].num_threads == n_threads


def test_a_resume_imports_packages_beside_the_run_s_own(run: Path) -> None:
    forge(run, gym_packages=["json"])
    words = train.read_command_line(["--resume", str(run), "--gym-packages", "csv"])[2]
    assert words[words.index("--gym-packages") :] == ["--gym-packages", "json", "csv"]


@pytest.mark.parametrize("words", ["--delay 3", "--algo sadr", "--env Hopper-v5", "--env=Hopper-v5", "--preset paper"])
def test_a_resume_has_the_runs_own_task(words: str, run: Path) -> None:
    with pytest.raises(ValueError, match=rf"goes on with the run's own {words[:5]}.*: leave them out"):
        train.read_command_line(["--resume", str(run), *words.split()])
