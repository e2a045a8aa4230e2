"""The command line end to end, in processes of its own, on a cheap MuJoCo task."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_said import SAID, DelayedSAC, PlannerConfig
from sb3_said.files.archive import load_tree
from sb3_said.zoo import manager as zoo
from sb3_said.zoo import train
from sb3_said.zoo.runs import load_run

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
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


def in_folder(folder: Path, command: str, *more: str | Path) -> list[str]:
    """Return the words of a command line with what makes it quick and quiet."""
    common = ["--num-threads", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0", "-f", folder]
    return [*command.split(), *map(str, [*common, *more])]


def train_here(folder: Path, command: str, *more: str | Path) -> None:
    """Train in this process, which is quicker than in one of its own."""
    train.main(in_folder(folder, command, *more))


def config_of(run: Path) -> dict[str, Any]:
    """Return the hyper-parameters that a run was last trained with."""
    (file,) = run.glob("*/config.yml")
    return dict(yaml.load(file.read_text(), Loader=yaml.UnsafeLoader))


def test_a_given_agent_learns_as_many_steps_as_a_new_one(tmp_path: Path) -> None:
    command, name = "--algo said --env Pendulum-v1 --delay 1 --preset smoke -n 150 --seed 3", "Pendulum-v1.zip"
    params = ["-params", "learning_starts:100", "planner_gradient_steps:2", TINY_PLANNER]
    first, second = (tmp_path / "said" / f"Pendulum-v1-delay1_{k}" for k in (1, 2))
    train_here(tmp_path, command, *params)
    train_here(tmp_path, command, "-i", first / name, *params)
    before, after = (SAID.load(run / name) for run in (first, second))
    assert before.num_timesteps == after.num_timesteps == 150 and after.policy.planner_is_trained
    left, right = (agent.policy.actor.state_dict() for agent in (before, after))
    assert not all((left[key] == right[key]).all() for key in left)
    assert (second / "progress.csv").exists()  # the log of a new run, not of a resumed one
    train.main(["--resume", str(second), "-n", "170"])  # a resume does go on from where the run was
    assert SAID.load(second / name).num_timesteps == 170
    assert (second / "progress_150.csv").exists()


def test_a_resume_keeps_what_it_is_not_told_to_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "default_preset", lambda: "smoke")
    train_here(tmp_path, "--algo dr --env Pendulum-v1 -n 60", "-params", "gamma:0.9", "tau:0.01")
    run = tmp_path / "dr" / "Pendulum-v1_1"
    before = config_of(run)
    assert (before["gamma"], before["tau"], before["buffer_size"]) == (0.9, 0.01, 2000)
    monkeypatch.setattr(train, "default_preset", lambda: "cpu")  # as on another machine
    for _ in range(2):
        train.main(["--resume", str(run), "-n", "80", "-params", "tau:0.02", "gradient_steps:2"])
        assert config_of(run) == {**before, "tau": 0.02, "gradient_steps": 2}
    assert DelayedSAC.load(run / "Pendulum-v1.zip").num_timesteps == 80


def lengths(monitor: Path) -> list[int]:
    """Return the lengths of the episodes in a file of SB3's Monitor."""
    return [int(row.split(",")[1]) for row in monitor.read_text().splitlines()[2:]]


def test_episodes_after_the_checkpoint_are_not_counted_twice(tmp_path: Path) -> None:
    train_here(tmp_path, "--algo sa --env InvertedPendulum-v5 --preset smoke -n 200 --seed 3", "-params", "n_envs:2")
    run = tmp_path / "sa" / "InvertedPendulum-v5_1"
    before = [lengths(run / f"{k}.monitor.csv") for k in (0, 1)]
    for k in (0, 1):
        with (run / f"{k}.monitor.csv").open("a") as monitor:
            monitor.write("70.0,70,9.5\n7.0,7,9.9\n8.0,")  # what a run that was killed at a full disk had gone on to
    train.main(["--resume", str(run), "-n", "320"])
    for k in (0, 1):
        now = lengths(run / f"{k}.monitor.csv")
        assert now[: len(before[k])] == before[k] and len(now) > len(before[k])
        assert sum(now) <= 160 and now[len(before[k])] != 70


def test_flags_of_rl_zoo3_work_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command, agent = "--algo sadr --env Pendulum-v1 --delay 1 --preset smoke -n 120 --save-replay-buffer", "Pendulum-v1"
    board, params = tmp_path / "board", ["-params", "learning_starts:60"]
    train_here(tmp_path, f"{command} --vec-env subproc -P --save-freq 50", "-tb", board, *params)
    assert "120/120" in "".join(capsys.readouterr())  # -P
    first, second = (tmp_path / "sadr" / f"Pendulum-v1-delay1_{k}" for k in (1, 2))
    assert {path.name for path in first.glob("rl_model_*.zip")} == {f"rl_model_{n}_steps.zip" for n in (50, 100)}
    assert list(board.glob("Pendulum-v1/Pendulum-v1-delay1_1/events.*"))

    # -i finds the replay beside the agent, and goes on adding to it.
    train_here(tmp_path, command, "-i", first / f"{agent}.zip", *params)
    model = DelayedSAC.load(second / agent)
    model.load_replay_buffer(second / "replay_buffer.pkl")
    assert model.replay_buffer is not None and model.replay_buffer.size() == 240


def test_optimize_searches_and_writes_its_trials(tmp_path: Path) -> None:
    command = "--algo sadr --env Pendulum-v1 --delay 1 --preset smoke -n 20 --seed 3 --eval-episodes 1"
    train_here(tmp_path, command, *"-optimize --n-trials 1 --n-evaluations 1 --no-optim-plots".split())
    (table,) = (tmp_path / "sadr").glob("report_*.csv")
    assert "params_learning_rate" in table.read_text().splitlines()[0]


# train.py with checkpoints of the planner every 10 updates, not 1,000, that kills itself at the 15th.
KILLED_AMID_UPDATES = """
import functools, os, signal, sys

from sb3_said.zoo import train; from sb3_said.zoo import manager as zoo
from sb3_said.planner.trainer import PlannerTrainer

def step(trainer, original=PlannerTrainer.step):
    if trainer.n_updates == 15:
        os.kill(os.getpid(), signal.SIGKILL)
    original(trainer)

PlannerTrainer.step = step
zoo.PlannerTrainingCallback = functools.partial(zoo.PlannerTrainingCallback, save_interval=10)
train.main(sys.argv[1:])
"""


def test_a_run_killed_amid_the_planners_updates_ends_as_if_it_was_not(finished: Path, tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED_AMID_UPDATES, *arguments(tmp_path)], capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    folder = tmp_path / "said" / "InvertedPendulum-v5-delay2_1"
    assert load_tree(folder / "planner_checkpoint.zip")["trainer"]["n_updates"] == 10
    run("--resume", folder)
    left, right = (
        SAID.load(each / "InvertedPendulum-v5.zip").get_parameters()["policy"] for each in (finished, folder)
    )
    assert all((left[key] == right[key]).all() for key in left)


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


@pytest.mark.parametrize("delay", [None, 8, "8", "FixedDelay(8)"])
def test_the_papers_planner_knows_one_delay(delay: zoo.Delay) -> None:
    settings = zoo.preset_overrides(zoo.config_file("said"), "paper", "Hopper-v5", delay)
    assert settings["planner_kwargs"]["mask"] == "fixed"


@pytest.mark.parametrize("delay", [[0, 8], "UniformDelay(0, 8)"])
def test_under_a_delay_that_varies_the_papers_planner_knows_all(delay: zoo.Delay) -> None:
    fixed, varying = (
        zoo.preset_overrides(zoo.config_file("said"), "paper", "Hopper-v5", d)["planner_kwargs"] for d in (8, delay)
    )
    assert varying == {**fixed, "mask": "random"}


def test_where_the_expert_meets_larger_delays_the_papers_planner_knows_all() -> None:
    """A planner of ``mask: fixed`` answers under the largest delay alone, which would be the expert's."""
    masks = [
        zoo.preset_overrides(zoo.config_file("said"), "paper", "Hopper-v5", 4, max_delay)["planner_kwargs"]["mask"]
        for max_delay in (4, 8)
    ]
    assert masks == ["fixed", "random"]


def test_a_planner_of_one_delay_has_an_expert_of_another(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    command = "--algo said --env Pendulum-v1 --delay 2 --expert-delay 0 --preset smoke -n 510 --eval-freq -1"
    train_here(tmp_path, command, "-params", "planner_kwargs:dict(mask='fixed')", "planner_gradient_steps:2")
    assert not [w for w in recwarn if "mask='fixed'" in str(w.message)]
    played = load_run(tmp_path / "said" / "Pendulum-v1-delay2-expert0_1", device="cpu")
    assert not [w for w in recwarn if "learned at ages" in str(w.message)]
    env = played.make_env()
    obs, _ = env.reset(seed=0)
    for _ in range(4):
        obs, *_ = env.step(played.model.predict(obs)[0])
    with played.model.policy.answering("expert"), pytest.warns(UserWarning, match="learned at ages 0 and is given 2"):
        played.model.predict(obs)


def test_a_planner_of_one_delay_is_refused_a_larger_one_of_its_expert(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train_here(
            tmp_path, "--env Pendulum-v1 --delay 2 --expert-delay 0 4", "-params", "planner_kwargs:dict(mask='fixed')"
        )
    assert "serves the largest delay alone, here 4, got --delay 2" in capsys.readouterr().err


def test_a_planner_of_one_delay_is_refused_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train_here(
            tmp_path, "--algo said --env Pendulum-v1 --delay 0 3", "-params", "planner_kwargs:dict(mask='fixed')"
        )
    assert "serves the largest delay alone, here 3, got --delay [0, 3]" in capsys.readouterr().err


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
    assert (model.trained_ages, model.policy.max_delay) == ([0], 3)
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


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("-n 5 --eval-freq -1", "-n 5 --eval-freq -1"),
        ("-params a:1 b:2 -n 5 --hyperparams b:3 -P", "-n 5 -P -params a:1 b:2 b:3"),
        ("--env X --env-kwargs c:1 -params a:1 --env-kwargs d:2", "--env X -params a:1 --env-kwargs c:1 d:2"),
    ],
)
def test_settings_given_twice_are_joined(given: str, read: str) -> None:
    assert train.joined_settings(given.split()) == read.split()


def test_the_command_line_is_kept_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zoo.write_arguments(tmp_path, ["-n", "5"])

    def killed(descriptor: int) -> None:
        os.truncate(descriptor, 3)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        zoo.write_arguments(tmp_path, ["-n", "70"])
    assert zoo.read_arguments(tmp_path) == ["-n", "5"]


def test_no_log_is_overwritten(tmp_path: Path) -> None:
    names = []
    for steps in (0, 500, 500, 500, 900, 0):
        names.append(zoo.log_suffix(tmp_path, steps))
        (tmp_path / f"progress{names[-1]}.csv").touch()
    assert names == ["", "_500", "_500_2", "_500_3", "_900", "_0_2"]
