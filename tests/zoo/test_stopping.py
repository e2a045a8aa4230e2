"""Ctrl-C, SIGTERM and SIGHUP: a training writes a checkpoint, exits with 130, and goes on as if nothing had been."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from forked import begin, run_script
from stable_baselines3.common.callbacks import EvalCallback
from trained_run import ENV, NETWORKS, PLANNER, same_agents

from sb3_said import SAID
from sb3_said.files.archive import load_tree
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.sac import StableSAC
from sb3_said.zoo import experiment, manager, train
from sb3_said.zoo.runs import load_run
from sb3_said.zoo.stopping import SIGNALS, Stopping, holding_back_ctrl_c

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "train.py"
COMMAND = f"--algo said --env {ENV} --delay 2 --seed 3 --num-threads 1 --eval-freq -1 --device cpu --verbose 0"
PARAMS = [
    "learning_starts:50",
    "buffer_size:400",
    "planner_gradient_steps:10",
    "planner_trial_episodes:1",
    f"planner_kwargs:{PLANNER}",
    NETWORKS,
]


def arguments(folder: Path, *more: str) -> list[str]:
    return [*COMMAND.split(), "-n", "100", "-f", str(folder), *more, "-params", *PARAMS]


def run_of(folder: Path) -> Path:
    (run,) = (folder / "said").iterdir()
    return run


def signal_at(patch: pytest.MonkeyPatch, cls: type, method: str, call: int, number: int) -> None:
    """Send a signal to this process in the middle of a call of a method: after it, and before what follows it."""
    original: Callable[..., Any] = getattr(cls, method)
    calls = iter(range(1, 10**9))

    def sends(self: Any, *args: Any, **kwargs: Any) -> Any:
        result = original(self, *args, **kwargs)
        if next(calls) == call:
            signal.raise_signal(number)
        return result

    patch.setattr(cls, method, sends)


@pytest.fixture(autouse=True)
def listening() -> Iterator[None]:
    """Signals as in a terminal, wherever the suite runs: a background job of a shell ignores Ctrl-C, nohup SIGHUP."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    train.main(arguments(folder))
    return run_of(folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP], ids=lambda n: n.name)
def test_a_signal_to_the_experts_training(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        signal_at(patch, StableSAC, "train", 30, number)  # of updates, the first after step 50
        with pytest.raises(SystemExit) as stop:
            train.main(arguments(tmp_path))
    run = run_of(tmp_path)
    assert stop.value.code == 130 and signal.getsignal(number) is before
    shown = capsys.readouterr().out
    assert f"{number.name}: the training stops after this step" in shown
    assert f"Interrupted at step 80 and wrote a checkpoint; go on with --resume {run}" in shown
    counters = load_tree(run / "checkpoint.zip")["counters"]
    assert (counters["num_timesteps"], counters["_n_updates"]) == (80, 30)  # no update is lost
    assert SAID.load(run / f"{ENV}.zip", device="cpu").num_timesteps == 80  # and what was learned is kept
    train.main(["--resume", str(run)])
    assert "Resuming" in capsys.readouterr().out
    assert SAID.load(run / f"{ENV}.zip", device="cpu").num_timesteps == 100


def test_a_signal_to_an_evaluation_breaks_it_off_and_the_resume_plays_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluated = ("--eval-freq", "30", "--eval-episodes", "2", "--n-eval-envs", "1")
    steps = []

    def sends(self: EvalCallback, *_: Any) -> None:
        steps.append(self.num_timesteps)
        if steps[-2:] == [60, 60]:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(EvalCallback, "_log_success_callback", sends)
        with pytest.raises(SystemExit) as stop:
            train.main(arguments(tmp_path, *evaluated))
    run = run_of(tmp_path)
    assert stop.value.code == 130
    assert "Interrupted at step 60 and wrote a checkpoint" in capsys.readouterr().out
    file = run / "expert" / "evaluations.npz"
    with np.load(file) as saved:
        assert saved["timesteps"].tolist() == [30]
    train.main(["--resume", str(run)])
    with np.load(file) as saved:
        assert saved["timesteps"].tolist() == [30, 61, 91]


def test_a_signal_to_the_planners_training_loses_no_update(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        signal_at(patch, PlannerTrainer, "step", 7, signal.SIGTERM)
        with pytest.raises(SystemExit) as stop:
            train.main(arguments(tmp_path))
    run = run_of(tmp_path)
    assert stop.value.code == 130 and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    shown = capsys.readouterr().out
    assert "SIGTERM: the training stops after this step" in shown and f"go on with --resume {run}" in shown
    assert load_tree(run / "planner_checkpoint.zip")["trainer"]["n_updates"] == 7
    assert not same_agents(run, whole)
    with pytest.warns(UserWarning, match="after 100 steps, before its planner was trained to the end, and tried: it"):
        load_run(run)
    train.main(["--resume", str(run)])
    assert same_agents(run, whole)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*stopped after")
        load_run(run)


@pytest.mark.parametrize("where", [(StableSAC, "train", 10), (PlannerTrainer, "step", 7)], ids=["expert", "planner"])
@pytest.mark.parametrize("times", [1, 2], ids=["once", "twice"])
def test_a_run_that_is_trained_for_longer_keeps_its_planner_until_it_has_another(
    where: tuple[type, str, int],
    times: int,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = Path(shutil.copytree(whole, tmp_path / "run"))
    with monkeypatch.context() as patch:
        for _ in range(times):
            signal_at(patch, *where, signal.SIGINT)
        with pytest.raises(SystemExit):
            train.main(["--resume", str(run), "-n", "120"])
    assert f"{ENV}.zip stays as it was, with its planner" in capsys.readouterr().out and same_agents(run, whole)
    train.main(["--resume", str(run)])
    agent = SAID.load(run / f"{ENV}.zip", device="cpu")
    assert agent.num_timesteps == 120 and agent.policy.planner_is_trained and not same_agents(run, whole)


def test_the_same_again_stops_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    with monkeypatch.context() as patch:
        signal_at(patch, StableSAC, "train", 30, signal.SIGINT)
        signal_at(patch, StableSAC, "train", 30, signal.SIGTERM)
        with pytest.raises(SystemExit) as stop:
            train.main(arguments(tmp_path))
    assert stop.value.code == 130 and "without a checkpoint of this step" in capsys.readouterr().out
    assert not (run_of(tmp_path) / "checkpoint.zip").exists()  # amid an update there is nothing to go on from


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        stopping = Stopping()
        with stopping.listening():
            signal.raise_signal(signal.SIGHUP)
        assert not stopping.is_asked
    finally:
        signal.signal(signal.SIGHUP, before)


def test_ctrl_c_that_is_held_back_comes_once_what_it_would_break_off_is_done() -> None:
    done, before = False, signal.signal(signal.SIGINT, signal.default_int_handler)  # which a background job ignores
    try:
        with pytest.raises(KeyboardInterrupt), holding_back_ctrl_c():
            signal.raise_signal(signal.SIGINT)
            done = True
        assert done and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with holding_back_ctrl_c():
            pass
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_is_not_resumed_while_it_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Ended(Exception):
        pass

    def resumed_meanwhile(self: manager.DelayedExperimentManager, model: Any) -> None:
        with pytest.raises(SystemExit):
            train.main(["--resume", self.save_path])
        assert "is being trained by another process" in capsys.readouterr().err
        raise Ended

    monkeypatch.setattr(manager.DelayedExperimentManager, "learn", resumed_meanwhile)
    with pytest.raises(Ended):
        train.main(arguments(tmp_path))
    with pytest.raises(Ended):  # the first training has ended, so that this one begins
        train.main(["--resume", str(run_of(tmp_path))])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_a_signal_to_a_training_whose_environments_are_processes(number: signal.Signals, tmp_path: Path) -> None:
    """It is sent to all: Ctrl-C by a terminal, which environments outlive, SIGTERM by a cluster, which ends them."""
    words = arguments(tmp_path, "--vec-env", "subproc")
    words[words.index("-n") + 1] = "1000000"
    process = begin(output := tmp_path / "output.txt", run_script, SCRIPT, words)
    assert process.pid is not None
    try:
        while process.is_alive():  # up to the test's own time: a start takes minutes where others have the cores
            logs = tmp_path.glob("said/*/*.monitor.csv")
            if any(len(log.read_text().splitlines()) > 2 for log in logs):  # an episode below the header: it learns
                break
            time.sleep(0.1)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        process.join(timeout=120)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    shown = output.read_text()
    assert process.exitcode == 130 and "and wrote a checkpoint" in shown, shown
    steps = load_tree(run_of(tmp_path) / "checkpoint.zip")["counters"]["num_timesteps"]
    assert steps > 0 and f"Interrupted at step {steps}" in shown


def test_environments_processes_ignore_ctrl_c_and_the_training_does_not(tmp_path: Path) -> None:
    """Of a command, which has started no other process before."""
    told = """
from multiprocessing import get_context
from signal import SIGINT, default_int_handler, getsignal, signal
from sb3_said.zoo.stopping import shield
if __name__ == "__main__":
    signal(SIGINT, default_int_handler)  # which a background job of a shell ignores
    shield()
    with get_context("forkserver").Pool(1) as pool:
        print(pool.apply(getsignal, [SIGINT]).name, getsignal(SIGINT).__name__)
"""
    (script := tmp_path / "command.py").write_text(told)
    shown = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout
    assert shown == "SIG_IGN default_int_handler\n"


def test_ctrl_c_while_environments_are_made_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = experiment.ExperimentManager.create_envs

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return made(*args, **kwargs)

    monkeypatch.setattr(experiment.ExperimentManager, "create_envs", interrupted)
    with pytest.raises(SystemExit) as stop:
        train.main(arguments(tmp_path, "--vec-env", "subproc"))
    assert stop.value.code == 130 and "Interrupted." in capsys.readouterr().err
    assert not [*tmp_path.glob("said/*")]  # no run that could be gone on with
