"""The command line end to end, in processes of its own, on a cheap MuJoCo task."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import train
import zoo
from runs import load_run

from sb3_said import SAID, PlannerConfig
from sb3_said.common.save_util import load_tree

SCRIPTS = Path(zoo.__file__).parent
TINY_PLANNER = "planner_kwargs:dict(d_model=32,depth=1,horizon=3,batch_size=16,precision='float32')"


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, str(SCRIPTS / "train.py"), *map(str, arguments)]


def run(*arguments: str | Path) -> str:
    done = subprocess.run(command(*arguments), capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout


def arguments(folder: Path, *more: str) -> list[str]:
    base = "--algo said --env InvertedPendulum-v5 --delay 2 --preset smoke -n 600 --seed 3 --num-threads 1"
    options = "--eval-freq 300 --checkpoint-freq 100"
    return [*base.split(), *options.split(), "-f", str(folder), "-params", TINY_PLANNER, *more]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    run(*arguments(folder))
    return folder / "said" / "InvertedPendulum-v5-delay2_1"


def test_a_run_leaves_an_agent_that_answers_with_its_planner(finished: Path) -> None:
    model = SAID.load(finished / "InvertedPendulum-v5.zip")
    assert model.num_timesteps == 600
    assert model.policy.planner_is_trained
    assert model.policy.max_delay == 2
    config = (finished / "InvertedPendulum-v5" / "config.yml").read_text()  # what enjoy and evaluate make the task from
    assert "DelayedObservationWrapper" in config and "delay: 2" in config
    evaluations = np.load(finished / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [300, 600]
    header = (finished / "progress.csv").read_text().splitlines()[0]
    assert "planner/present_error_mlp_d2" in header and "planner/action_error_d2" in header


def test_a_finished_run_resumes_to_the_same_agent(finished: Path) -> None:
    before = SAID.load(finished / "InvertedPendulum-v5.zip").get_parameters()["policy"]
    run("--resume", finished)
    after = SAID.load(finished / "InvertedPendulum-v5.zip").get_parameters()["policy"]
    assert all((before[key] == after[key]).all() for key in before)


def kill_when(process: subprocess.Popen[bytes], is_reached: Path) -> None:
    deadline = time.time() + 200
    while not is_reached.exists():
        assert process.poll() is None and time.time() < deadline, "the run ended before it could be killed"
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()


def test_a_killed_run_goes_on_from_its_checkpoint_twice_alike(tmp_path: Path) -> None:
    process = subprocess.Popen(command(*arguments(tmp_path)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folder = tmp_path / "said" / "InvertedPendulum-v5-delay2_1"
    kill_when(process, folder / "checkpoint.zip")
    reached = load_tree(folder / "checkpoint.zip")["counters"]["num_timesteps"]
    assert 100 <= reached < 600
    copy = tmp_path / "copy"
    subprocess.run(["cp", "-r", folder, copy], check=True)

    for each in (folder, copy):
        assert f"at step {reached}" in run("--resume", each)
    one, other = (SAID.load(each / "InvertedPendulum-v5.zip") for each in (folder, copy))
    assert one.num_timesteps == 600
    left, right = one.get_parameters()["policy"], other.get_parameters()["policy"]
    assert all((left[key] == right[key]).all() for key in left)
    steps = np.load(folder / "evaluations.npz")["timesteps"]
    assert steps.tolist() == [300, 600]


def test_the_delay_range_and_its_flags_reach_the_run(tmp_path: Path) -> None:
    run(
        *"--algo dr --env Pendulum-v1 --delay 0 3 --preset smoke -n 120 --eval-freq -1 --num-threads 1".split(),
        "-f",
        tmp_path,
    )
    folder = tmp_path / "dr" / "Pendulum-v1-delay0-3_1"
    model = zoo.ALGORITHMS["dr"][0].load(folder / "Pendulum-v1.zip")
    assert (model.augment_state, model.delay_reconciled_critic) == (False, True)
    assert model.policy.max_delay == 3
    argv = json.loads((folder / "train_args.json").read_text())
    assert argv[argv.index("--delay") : argv.index("--delay") + 3] == ["--delay", "0", "3"]
    assert "--seed" in argv  # drawn, and kept for a resume


@pytest.mark.parametrize("env_id", ["Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5"])
@pytest.mark.parametrize("delay", [0, 4, 8, 16])
def test_the_paper_preset_is_the_papers_table(env_id: str, delay: int) -> None:
    tables = {  # Table 6: depth, temperature
        "Ant-v5": [(8, 0.6), (8, 0.6), (8, 0.6), (8, 0.8)],
        "HalfCheetah-v5": [(8, 0.6), (8, 0.3), (8, 0.3), (8, 0.1)],
        "Hopper-v5": [(8, 0.6), (4, 0.3), (2, 0.1), (8, 0.6)],
        "Walker2d-v5": [(8, 0.8), (8, 0.6), (4, 0.8), (8, 0.6)],
    }
    settings = zoo.preset_overrides(zoo.config_file("said"), "paper", env_id, delay)
    depth, temperature = tables[env_id][[0, 4, 8, 16].index(delay)]
    assert settings["n_timesteps"] == 5e6 and settings["planner_gradient_steps"] == 1_000_000
    config = PlannerConfig(**settings["planner_kwargs"])
    assert config == PlannerConfig.paper(depth=depth, temperature=temperature, precision="auto")


@pytest.mark.parametrize("preset", zoo.PRESETS)
@pytest.mark.parametrize("algo", zoo.ALGORITHMS)
def test_every_preset_exists_for_every_algorithm(algo: str, preset: str) -> None:
    assert isinstance(zoo.preset_overrides(zoo.config_file(algo), preset, "Hopper-v5", 4), dict)


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValueError, match="no preset 'fast'"):
        zoo.preset_overrides(zoo.config_file("said"), "fast", "Hopper-v5", 4)


@pytest.mark.parametrize(
    ("words", "delay"),
    [
        ([], None),
        (["4"], 4),
        (["0", "8"], [0, 8]),
        (["WIFI_20MS"], "WIFI_20MS"),
        (["DroppedPackets(4, p=0.1)"], "DroppedPackets(4, p=0.1)"),
    ],
)
def test_what_delay_takes(words: list[str], delay: zoo.Delay) -> None:
    assert zoo.read_delay(words) == delay


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-1"], "whole number of control steps >= 0"),
        (["1", "2", "3"], "--delay takes N, or LOW HIGH"),
        (["UniformDelay(0,", "8)"], "--delay takes N, or LOW HIGH"),
        (["4", "WIFI_20MS"], "--delay takes N, or LOW HIGH"),
        (["print(1)"], "expected numbers, WIFI_20MS, FixedDelay"),
    ],
)
def test_a_bad_delay_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train.main(["--env", "Pendulum-v1", "--delay", *words])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("delay", "name"),
    [(None, ""), (4, "-delay4"), ([0, 8], "-delay0-8"), ("UniformDelay(0, 8)", "-delayUniformDelay-0-8")],
)
def test_the_log_path_names_the_delay(delay: zoo.Delay, name: str) -> None:
    assert zoo.Run([], delay, "smoke", 1).delay_name == name


def test_the_expert_can_learn_under_another_delay(tmp_path: Path) -> None:
    command = "--algo said --env Pendulum-v1 --delay 0 3 --expert-delay 0 --preset smoke -n 700 --eval-freq -1"
    train.main([*command.split(), "--num-threads", "1", "-f", str(tmp_path), "--verbose", "0"])
    run = tmp_path / "said" / "Pendulum-v1-delay0-3-expert0_1"
    played = load_run(run, device="cpu")
    assert played.info["delay"] == "EpisodeDelay(low=0, high=3)"
    model = played.model
    assert (model.trained_delay, model.policy.max_delay) == ("FixedDelay(delay=0)", 3)
    assert model.policy.planner_is_trained


@pytest.mark.parametrize("words", (["--algo", "sadr", "--delay", "4"], ["--algo", "said"]))
def test_only_a_planner_serves_another_delay_than_its_expert(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train.main(["--env", "Pendulum-v1", *words, "--expert-delay", "0"])
    assert "--expert-delay is for --algo said" in capsys.readouterr().err


def test_the_papers_settings_go_by_the_largest_delay() -> None:
    def depth(delay: zoo.Delay) -> int:
        return int(
            zoo.preset_overrides(zoo.config_file("said"), "paper", "Hopper-v5", delay)["planner_kwargs"]["depth"]
        )

    assert [depth(delay) for delay in (4, [0, 8], "UniformDelay(0, 8)", 5)] == [4, 2, 2, 8]


def test_resuming_a_folder_without_a_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="holds no run"):
        train.main(["--resume", str(tmp_path)])


def test_help_shows_both_command_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(["--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert "--delay" in shown and "--tensorboard-log" in shown and "examples:" in shown


def test_resume_is_taken_out_of_a_command_line() -> None:
    assert train.without_resume(["--resume", "a", "-P", "--resume=b", "-n", "5"]) == ["-P", "-n", "5"]


def test_no_log_is_overwritten(tmp_path: Path) -> None:
    names = []
    for steps in (0, 500, 500, 500, 900, 0):
        names.append(zoo.log_suffix(tmp_path, steps))
        (tmp_path / f"progress{names[-1]}.csv").touch()
    assert names == ["", "_500", "_500_2", "_500_3", "_900", "_0_2"]
