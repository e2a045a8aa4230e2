"""Training from the command line, on cheap tasks: what a run leaves, and how one goes on."""

from __future__ import annotations

import errno
import functools
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rl_zoo3")

import gymnasium as gym
from forked import begin, run_script
from kill import Killed
from stable_baselines3.common.callbacks import EvalCallback
from test_cli import call
from trained_run import ENV, NETWORKS, PLANNER, config_of, same_agents, train_here

from sb3_said import SAID, DelayedSAC, StableSAC
from sb3_said.delays.space import ages_of
from sb3_said.files import checkpoint
from sb3_said.files.archive import load_tree
from sb3_said.files.checkpoint import TrainingCheckpointCallback
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.said import trial
from sb3_said.zoo import experiment, manager, train
from sb3_said.zoo.arguments import Delay
from sb3_said.zoo.folder import log_suffix
from sb3_said.zoo.manager import DelayedExperimentManager
from sb3_said.zoo.record import ENDED_NAME, Record
from sb3_said.zoo.runs import load_run

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
TINY_PLANNER = f"planner_kwargs:{PLANNER}"


def arguments(folder: Path) -> list[str]:
    base = f"--algo said --env {ENV} --delay 2 --preset smoke -n 120 --seed 3 --num-threads 1 --verbose 0"
    options = "--eval-freq 60 --eval-episodes 1 --checkpoint-freq 30 --device cpu"
    params = ["learning_starts:75", "planner_gradient_steps:10", "planner_newest_fraction:1.0", TINY_PLANNER, NETWORKS]
    return [*base.split(), *options.split(), "-f", str(folder), "-params", *params]


def run_of(folder: Path) -> Path:
    """Return the run of ``arguments``."""
    return folder / "said" / f"{ENV}-delay2-seed3_1"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    train.main(arguments(folder))
    return run_of(folder)


def test_a_run_leaves_an_agent_that_answers_with_its_planner(finished: Path) -> None:
    model = SAID.load(finished / f"{ENV}.zip")
    assert model.num_timesteps == 120
    assert model.policy.planner_is_trained
    assert model.policy.max_delay == 2
    assert load_run(finished, device="cpu").info["delay"] == 2
    config = (finished / ENV / "config.yml").read_text()  # what rl_zoo3's own tools make the task from
    assert "DelayedObservationWrapper" in config and "delay: 2" in config
    header = (finished / "progress.csv").read_text().splitlines()[0]
    assert "planner/present_error_mlp_d2" in header and "planner/action_error_d2" in header


@pytest.mark.parametrize(("more", "n_envs"), [((), 3), (("--eval-freq", "-1"), 1)])
def test_a_trial_plays_in_several_environments_where_the_run_may_make_more_than_one(
    more: tuple[str, ...], n_envs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played, original = [], trial._play

    def play(model: Any, env: Any, *args: Any) -> Any:
        played.append((env.num_envs, ages_of(env)))
        return original(model, env, *args)

    monkeypatch.setattr(trial, "_play", play)
    train.main([*arguments(tmp_path), "planner_trial_episodes:3", *more])
    assert {*map(str, played)} == {str((n_envs, [2]))}
    rows = (run_of(tmp_path) / "0.monitor.csv").read_text().splitlines()[2:]
    assert sum(int(row.split(",")[1]) for row in rows) <= 120  # of the training's steps, and none of the trial's


def test_a_finished_run_has_nothing_left_to_do_and_else_resumes_to_the_same_agent(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(finished, tmp_path / "copy"))
    before = {file: file.stat().st_mtime_ns for file in copy.rglob("*")}
    for words in ([], ["-P"]):
        train.main(["--resume", str(copy), *words])
        assert f"{copy} has ended, and nothing is left to do" in capsys.readouterr().out
    assert {file: file.stat().st_mtime_ns for file in copy.rglob("*")} == before
    (copy / ENDED_NAME).unlink()  # as of one that was killed after its last checkpoint
    train.main(["--resume", str(copy)])
    assert same_agents(finished, copy)
    assert (copy / ENDED_NAME).is_file()
    (copy / ENDED_NAME).unlink()
    (copy / "checkpoint.zip").write_bytes(b"half of one")
    with pytest.raises(SystemExit, match=r"train: error: Cannot load .*checkpoint\.zip': the file is damaged"):
        train.main(["--resume", str(copy)])


def test_a_trial_that_has_failed_is_played_by_a_resume_with_as_many_steps(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(*_: Any) -> Any:
        raise OSError("no simulator")

    with monkeypatch.context() as patch:
        patch.setattr(trial, "_play", breaks)
        with pytest.warns(UserWarning, match="The trial has failed.*no simulator.*--resume with as many steps"):
            train.main(arguments(tmp_path))
    run = run_of(tmp_path)
    train.main(["--resume", str(run), "-n", "120"])
    assert "trial/way" in (run / "progress_120.csv").read_text()
    assert same_agents(finished, run)


def test_a_killed_run_goes_on_from_its_checkpoint_twice_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def save(callback: TrainingCheckpointCallback, original: Any = TrainingCheckpointCallback.save) -> None:
        original(callback)
        if callback.model.num_timesteps >= 90:
            raise Killed

    monkeypatch.setattr(TrainingCheckpointCallback, "save", save)
    with pytest.raises(Killed):
        train.main(arguments(tmp_path))
    monkeypatch.undo()
    folder = run_of(tmp_path)
    assert load_tree(folder / "checkpoint.zip")["counters"]["num_timesteps"] == 90
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    for each in (folder, copy):
        train.main(["--resume", str(each)])
        assert "at step 90" in capsys.readouterr().out
    assert same_agents(folder, copy)
    assert SAID.load(folder / f"{ENV}.zip").num_timesteps == 120
    assert np.load(folder / "expert" / "evaluations.npz")["timesteps"].tolist() == [60, 120]


def train_killed_amid_updates(folder: Path) -> None:
    """Train with checkpoints of the planner every 5 updates, not 1,000, and a kill -9 at the 8th."""

    def step(trainer: PlannerTrainer, original: Any = PlannerTrainer.step) -> None:
        if trainer.n_updates == 8:
            os.kill(os.getpid(), signal.SIGKILL)
        original(trainer)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(PlannerTrainer, "step", step)
        often = functools.partial(manager.PlannerTrainingCallback, save_interval=5)
        patched.setattr(manager, "PlannerTrainingCallback", often)
        run_script(SCRIPTS / "train.py", arguments(folder))


def test_a_run_killed_amid_the_planners_updates_ends_as_if_it_was_not(finished: Path, tmp_path: Path) -> None:
    killed = begin(output := tmp_path / "output.txt", train_killed_amid_updates, tmp_path)
    killed.join(timeout=240)
    assert killed.exitcode == -signal.SIGKILL, output.read_text()
    folder = run_of(tmp_path)
    assert load_tree(folder / "planner_checkpoint.zip")["trainer"]["n_updates"] == 5
    train.main(["--resume", str(folder)])
    assert same_agents(finished, folder)


def test_a_given_agent_learns_as_many_steps_as_a_new_one(tmp_path: Path) -> None:
    command, name = "--algo said --env Pendulum-v1 --delay 1 --preset smoke -n 120 --seed 3", "Pendulum-v1.zip"
    own = ["learning_starts:100", "planner_gradient_steps:2", "planner_trial_episodes:0"]
    params = ["-params", *own, TINY_PLANNER, NETWORKS]
    first, second = (tmp_path / "said" / f"Pendulum-v1-delay1-seed3_{k}" for k in (1, 2))
    train_here(tmp_path, command, *params)
    train_here(tmp_path, command, "-i", first / name, *params)
    before, after = (SAID.load(run / name) for run in (first, second))
    assert before.num_timesteps == after.num_timesteps == 120 and after.policy.planner_is_trained
    left, right = (agent.policy.actor.state_dict() for agent in (before, after))
    assert not all((left[key] == right[key]).all() for key in left)
    assert (second / "progress.csv").exists()  # the log of a new run, not of a resumed one
    (first / name).unlink()  # the run has a copy of its own
    train.main(["--resume", str(second), "-n", "130"])  # a resume does go on from where the run was
    assert SAID.load(second / name).num_timesteps == 130
    assert (second / "progress_120.csv").exists()


def test_a_resume_keeps_what_it_is_not_told_to_change(tmp_path: Path) -> None:
    train_here(tmp_path, "--algo dr --env Pendulum-v1 --preset smoke -n 60", "-params", "gamma:0.9", "tau:0.01")
    (run,) = (tmp_path / "dr").iterdir()
    before, seed = config_of(run), Record.read(run).seed
    assert run.name == f"Pendulum-v1-seed{seed}_1"  # drawn
    assert (before["gamma"], before["tau"], before["buffer_size"]) == (0.9, 0.01, 2000)
    for _ in range(2):
        train.main(["--resume", str(run), "-n", "80", "-params", "tau:0.02", "gradient_steps:2"])
        assert config_of(run) == {**before, "tau": 0.02, "gradient_steps": 2}
    model = DelayedSAC.load(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 80 and model.seed == seed  # kept
    assert Record.read(run).options["n_timesteps"] == 80


def test_a_resume_says_how_a_planner_of_its_checkpoint_decides(tmp_path: Path) -> None:
    train.main([*arguments(tmp_path), "planner_train_freq:80", "planner_trial_episodes:0"])
    run = run_of(tmp_path)
    train.main(["--resume", str(run), "-params", "planner_kwargs:{'temperature': 3.0, 'n_candidates': 2}"])
    for _ in range(2):  # and no other, as long as nothing else is said
        planner = SAID.load(run / f"{ENV}.zip", device="cpu").planner_kwargs
        assert (planner["temperature"], planner["n_candidates"], planner["depth"]) == (3.0, 2, 1)
        train.main(["--resume", str(run), "-n", "160"])
    before = {file: file.read_bytes() for file in run.iterdir() if file.is_file()}
    other = "planner_kwargs:{'mask': 'own', 'present': 'inpainted'}"
    with pytest.raises(SystemExit, match="goes on with mask='random', as its planner was trained, got 'own'"):
        train.main(["--resume", str(run), "-n", "200", "-params", other])
    assert {file: file.read_bytes() for file in run.iterdir() if file.is_file()} == before


def test_a_planner_that_lets_the_actor_decide_is_resumed_before_the_expert_has_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = [*arguments(tmp_path)[:-2], TINY_PLANNER.replace(")", ",decided_by='actor')"), NETWORKS]
    with monkeypatch.context() as patch:
        patch.setattr(SAID, "train_planner", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(SystemExit, match="130"):  # as Ctrl-C
            train.main([*begun, "-n", "60"])
    assert not SAID.load(run_of(tmp_path) / f"{ENV}.zip", device="cpu").has_expert
    train.main(["--resume", str(run_of(tmp_path)), "-n", "100"])
    model = SAID.load(run_of(tmp_path) / f"{ENV}.zip", device="cpu")
    assert model.has_expert and model.planner_kwargs["decided_by"] == "actor"


def test_a_resume_takes_no_setting_that_the_run_never_had(tmp_path: Path) -> None:
    """The YAML of a start is not kept, and a shipped one may have got more since."""
    own = {"n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 50}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"Hopper-v5": own}))
    train_here(tmp_path, "--algo stable --env Hopper-v5 --delay 1 --seed 3", "-conf", tmp_path / "own.yml")
    (run,) = (tmp_path / "stable").iterdir()
    before = config_of(run)
    assert "gamma" not in before
    train.main(["--resume", str(run), "-n", "80", "-params", "tau:0.02"])
    assert config_of(run) == {**before, "tau": 0.02}


def test_a_refused_resume_leaves_the_run_as_it_was(finished: Path, tmp_path: Path, capsys: Any) -> None:
    copy = Path(shutil.copytree(finished, tmp_path / "copy"))
    before = json.loads((copy / "run.json").read_text())
    for words, message in (
        ("--eval-freq -1", "as the run began, with evaluations: --eval-freq -1 does not"),
        ("-params planner_gradient_steps:11", "gradient_steps was 10"),
        ("-n 160 -params n_envs:3", "goes on with n_envs=1, as the replay has them, got 3"),
    ):
        with pytest.raises(SystemExit) as stop:
            train.main(["--resume", str(copy), *words.split()])
        assert message in f"{stop.value} {capsys.readouterr().err}"
        assert json.loads((copy / "run.json").read_text()) == before
        train.main(["--resume", str(copy)])
        assert "nothing is left to do" in capsys.readouterr().out
        assert same_agents(finished, copy)
    train.main(["--resume", str(copy), "-n", "160"])
    assert SAID.load(copy / f"{ENV}.zip").num_timesteps == 160 and (copy / ENDED_NAME).is_file()
    assert len([*copy.glob("*.monitor.csv")]) == 1


@pytest.mark.parametrize(("given", "evaluated"), [([], 8.0), (["--eval-env-kwargs", "g:5.0"], 5.0)])
def test_a_resume_with_another_task_keeps_that_of_its_evaluations(
    given: list[str], evaluated: float, tmp_path: Path
) -> None:
    words = "--algo sa --env Pendulum-v1 --preset smoke -n 60 --delay 1 --env-kwargs g:9.0"
    train_here(tmp_path, words, *given)
    (run,) = (tmp_path / "sa").iterdir()
    train.main(["--resume", str(run), "-n", "80", "--env-kwargs", "g:8.0"])
    record = Record.read(run)
    assert (record.env_kwargs, record.eval_env_kwargs) == ({"g": 8.0}, {"g": evaluated})


def test_a_file_s_settings_reach_the_evaluations_and_stay_beside_those_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = {"depth": 1, "d_model": 32, "temperature": 0.3}
    block = {"n_timesteps": 60, "policy": "MultiInputPolicy", "env_kwargs": {"g": 3.0}, "planner_kwargs": planner}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"default": block}))
    made: list[Any] = []

    def learn(of: manager.DelayedExperimentManager, model: SAID) -> None:
        assert of.evaluation is not None and model.env is not None
        made.extend([*model.env.get_attr("g"), *of.evaluation.eval_env.get_attr("g"), model.planner_kwargs])

    monkeypatch.setattr(manager.DelayedExperimentManager, "learn", learn)
    monkeypatch.setattr(manager.DelayedExperimentManager, "save_trained_model", lambda *_: None)
    command = f"--algo said --env Pendulum-v1 --delay 1 --verbose 0 -f {tmp_path} -conf {tmp_path}/own.yml -params"
    train.main([*command.split(), "planner_kwargs:dict(horizon=3)"])
    assert made[:2] == [3.0, 3.0]
    assert {name: made[2][name] for name in (*planner, "horizon")} == {**planner, "horizon": 3}


def lengths(monitor: Path) -> list[int]:
    """Return the lengths of the episodes in a file of SB3's Monitor."""
    return [int(row.split(",")[1]) for row in monitor.read_text().splitlines()[2:]]


def test_episodes_after_the_checkpoint_are_not_counted_twice(tmp_path: Path) -> None:
    train_here(tmp_path, f"--algo sa --env {ENV} --preset smoke -n 200 --seed 3", "-params", "n_envs:2")
    run = tmp_path / "sa" / f"{ENV}-seed3_1"
    for n in (320, 440):  # and after a resume, whose first episodes the files lack
        before = [lengths(run / f"{k}.monitor.csv") for k in (0, 1)]
        for k in (0, 1):
            with (run / f"{k}.monitor.csv").open("a") as monitor:
                monitor.write("1.0,1,9.5\n70.0,70,9.9\n8.0,")  # a run killed at a full disk
        train.main(["--resume", str(run), "-n", str(n)])
        for k in (0, 1):
            now = lengths(run / f"{k}.monitor.csv")
            assert now[: len(before[k])] == before[k] and len(now) > len(before[k])
            assert sum(now) <= n // 2 and now[len(before[k])] not in (1, 70)


def test_flags_of_rl_zoo3_work_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = "--algo sadr --env Pendulum-v1 --delay 1 --preset smoke -n 120 --save-replay-buffer --seed 3"
    agent = "Pendulum-v1"
    board, params = tmp_path / "board", ["-params", "learning_starts:100", NETWORKS]
    train_here(tmp_path, f"{command} --vec-env subproc -P --save-freq 50", "-tb", board, *params)
    assert "120/120" in "".join(capsys.readouterr())  # -P
    first, second = (tmp_path / "sadr" / f"Pendulum-v1-delay1-seed3_{k}" for k in (1, 2))
    assert {path.name for path in first.glob("rl_model_*.zip")} == {f"rl_model_{n}_steps.zip" for n in (50, 100)}
    assert list(board.glob("Pendulum-v1/sadr/Pendulum-v1-delay1-seed3_1/events.*"))

    # -i finds the replay beside the agent, and goes on adding to it.
    train_here(tmp_path, command, "-i", first / f"{agent}.zip", *params)
    model = DelayedSAC.load(second / agent)
    assert model.tensorboard_log is None  # a path of the machine that trained it
    model.load_replay_buffer(second / "replay_buffer.pkl")
    assert model.replay_buffer is not None and model.replay_buffer.size() == 240


def test_optimize_searches_and_writes_its_trials_and_no_folder_of_a_run(tmp_path: Path) -> None:
    command = "--algo sadr --env Pendulum-v1 --delay 1 --preset smoke -n 20 --seed 3 --eval-episodes 1"
    train_here(tmp_path, command, *"-optimize --n-trials 1 --n-startup-trials 0 --n-evaluations 1".split())
    (table,) = (tmp_path / "sadr").glob("report_*.csv")
    assert "params_learning_rate" in table.read_text().splitlines()[0]
    assert not [*tmp_path.rglob("*_1")]


def test_the_delay_range_and_its_flags_reach_the_run(tmp_path: Path) -> None:
    train_here(tmp_path, "--algo dr --env Pendulum-v1 --delay 0 3 --preset smoke -n 120 --seed 3")
    folder = tmp_path / "dr" / "Pendulum-v1-delay0-3-seed3_1"
    model = DelayedSAC.load(folder / "Pendulum-v1.zip")
    assert (model.augment_state, model.delay_reconciled_critic) == (False, True)
    assert model.policy.max_delay == 3
    assert json.loads((folder / "run.json").read_text())["delay"] == [0, 3]


@pytest.mark.parametrize(
    ("delay", "name"),
    [(None, ""), (4, "-delay4"), ([0, 8], "-delay0-8"), ("UniformDelay(0, 8)", "-delayUniformDelay-0-8")],
)
def test_the_log_path_names_the_delay(delay: Delay, name: str) -> None:
    assert experiment.Run(delay, "smoke").name == name


def test_the_log_path_of_many_logs_is_one_that_a_disk_takes() -> None:
    parts = [f"hopper_medium_replay_part_{k}.npz" for k in range(30)]
    names = [experiment.Run(2, "cpu", dataset=parts[:n]).name for n in (1, 29, 30)]
    assert names[0] == "-delay2-hopper_medium_replay_part_0"
    assert len(set(names)) == 3 and max(map(len, names)) < 120


def test_the_expert_can_learn_under_another_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = "--algo said --env Pendulum-v1 --delay 0 3 --expert-delay 0 --preset smoke -n 220 --seed 3"
    ages: list[int] = []

    def told(model: SAID, like: EvalCallback, *_: Any) -> None:
        assert like.eval_env is not None
        ages.extend(ages_of(like.eval_env))

    monkeypatch.setattr(manager, "evaluate_answer", told)
    monkeypatch.setattr("sb3_said.said.learning.let_the_best_answer", None)  # the expert's delay would tell of another
    params = ["-params", "learning_starts:200", "planner_gradient_steps:5", TINY_PLANNER, NETWORKS]
    train_here(tmp_path, command, "--eval-freq", "200", *params)
    assert ages == [0, 1, 2, 3]
    played = load_run(tmp_path / "said" / "Pendulum-v1-delay0-3-expert0-seed3_1", device="cpu")
    assert played.info["delay"] == "EpisodeDelay(low=0, high=3)"
    model = played.model
    assert isinstance(model, SAID)
    assert (model.trained_ages, model.policy.max_delay) == ([0], 3)
    assert model.policy.planner_is_trained
    env = played.make_env()
    obs, _ = env.reset(seed=1)
    while obs["delay"] < 1 or not obs["action_history"][0].any():  # an age that only the planner has met
        obs, *_ = env.step(model.predict(obs)[0])
    with model.policy.answering("expert"), pytest.warns(UserWarning, match="learned at ages 0 and is given"):
        model.predict(obs)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--delay -1", "whole number of control steps >= 0"),
        ("--algo sadr --delay 4 --expert-delay 0", "--expert-delay needs --algo said"),
        ("--algo said --expert-delay 0", "--expert-delay needs --algo said"),
        ("--resume {}", "holds no run"),
        ("--algo said --delay 4 -optimize", "with --algo stable -optimize, and the planner's with sb3-said tune"),
        ("--env Pendulun-v1", "you maybe meant Pendulum-v1?"),
        ("-i nowhere.zip", "must be a valid path to a .zip file"),
        ("--gym-packages not_there", "No module named 'not_there': install it, or name the folder"),
        ("--checkpoint-freq 0", "--checkpoint-freq must be at least 1, got 0"),
        ("-params gamma:O.9", "invalid syntax"),
        ("-params gamma:O.9", "A VALUE is Python, so that text has quotes of its own"),
        ("-params", "usage: sb3-said train [-h]"),
        ("-params", "argument -params/--hyperparams: expected at least one argument"),
        ("-n 0", "steps are a whole number, at least 1; -1 takes the preset's, got 0"),
        ("--n-timesteps -7", "got -7"),
        ("--device gpu", "auto, cpu, cuda or another that torch has, got gpu"),
        ("-params gamma:nine", "name 'nine' is not defined"),
        ("-params gamma:1/0", "division by zero"),
        ("-params policy_kwargs:dict(activation_fn=nn.ELUU)", "module 'torch.nn' has no attribute 'ELUU'"),
        ("--env-kwargs g:[][0]", "list index out of range"),
        ("--n-eval-envs 0", "--n-eval-envs must be at least 1, got 0"),
        ("--eval-episodes 0", "--eval-episodes must be at least 1, got 0"),
        ("--num-threads 0", "--num-threads must be at least 1, got 0"),
        ("-conf {}/broken.yml", "broken.yml is no YAML"),
        ("-conf {}/list.yml", "list.yml holds a list, expected settings by task"),
        ("-conf {}/empty.yml", "empty.yml holds nothing, expected settings by task, such as Pendulum-v1: {n_timesteps"),
        ("-conf {}/bare.yml", "bare.yml holds nothing, expected settings by task"),
        ("-conf {}/nowhere.yml", "nowhere.yml, which is not there"),
        ("-conf {}/presets.yml", "presets.yml holds 3 as presets, expected settings by name"),
        ("-conf {}/preset.yml --preset smoke", "preset.yml holds 3 as smoke, expected settings by name"),
        ("-conf {}/of_task.yml --preset smoke", "of_task.yml holds 3 as Pendulum-v1, expected settings by name"),
    ],
)
def test_says_what_is_wrong(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.yml").write_text("a: [1")
    files = {"list": "- a", "empty": "", "bare": "Pendulum-v1:", "presets": "presets: 3"}
    files |= {"preset": "presets: {smoke: 3}", "of_task": "presets: {smoke: {Pendulum-v1: 3}}"}
    for name, text in files.items():
        (tmp_path / f"{name}.yml").write_text(text)
    with pytest.raises(SystemExit) as stop:
        call(monkeypatch, "train", *["--env", "Pendulum-v1", "-f", str(tmp_path), *words.format(tmp_path).split()])
    assert stop.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-params gama:0.9", "has no argument gama; did you mean gamma"),
        ("-params planner_kwargs:dict(deepth=3)", "The planner has no setting deepth; did you mean depth"),
        ("-params temperature:0", "temperature: of the planner, .*planner_kwargs:{'temperature'"),
        ("--delay 2 -params normalize:True", "norm_obs_keys"),
        ("--env CartPole-v1", "action space"),
        ("--algo sadr -params planner_gradient_steps:3", "has no argument planner_gradient_steps"),
        ("-params gamma:2", "gamma is 2, expected 0..1"),
        ("-params batch_size:0", "batch_size is 0"),
        ("-params train_freq:0", "train_freq is 0"),
        ("-params n_envs:0", "n_envs must be at least 1, got 0"),
        ("-params gamma:'high'", "gamma is 'high', which is not of the type that SAID declares"),
        ("-params batch_size:64.5", "batch_size is 64.5, which is not of the type"),
        (
            "--delay 0 2 -params planner_kwargs:{'mask':'fixed'}",
            "plans at age 2 only, got 0, 1, 2; train one with mask",
        ),
        (
            "--delay 0 2 --expert-delay 2 -params planner_kwargs:{'mask':'fixed'}",
            "plans at age 2 only, got 0, 1, 2; train one with mask",
        ),
        ("-params env_wrapper:'gymnasium.wrappers.NormalizeObservation'", "statistics that no file holds"),
        ("-params frame_stack:2", "frame_stack wraps all environments at once, and no command could play the agent"),
        ("-tb /dev/null/x", "/dev/null"),
        ("-params env_wrapper:'gymnasium.wrappers.Nosuch'", "cannot be read: AttributeError.*Nosuch"),
        ("-params noise_type:'normal'", "cannot be read: KeyError.*noise_std"),
        ("-params noise_type:'foo' noise_std:0.1", "cannot be read: RuntimeError.*foo"),
        ("-params normalize:'foo('", "cannot be read: SyntaxError"),
        ("-params callback:'rl_zoo3.callbacks.ParallelTrainCallback'", "trains a copy of the agent"),
        ("-params n_timesteps:-5", "n_timesteps must be a whole number, at least 1, got -5"),
        ("-params n_timesteps:'abc'", "n_timesteps must be a whole number, at least 1, got 'abc'"),
        ("-params learning_rate:'abc'", "learning_rate must be a number, or fall from one as lin_1e-3 does, got 'abc'"),
        ("-params train_freq:(1,'episode') n_envs:2", "counts episodes, which takes n_envs=1, got 2"),
        ("-conf {}/bare.py", "bare.py cannot be read: KeyError.*Expected YAML of settings by task, or Python"),
        ("-conf {}/broken.py", "broken.py cannot be read: SyntaxError"),
    ],
)
def test_settings_that_do_not_fit_are_said_and_leave_no_folder(words: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "bare.py").write_text("settings = {}")
    (tmp_path / "broken.py").write_text("hyperparams = {")
    logs = tmp_path / "logs"
    with pytest.raises(SystemExit, match=f"sb3-said train: error: .*{message}"):
        train.main(
            ["--env", "Pendulum-v1", "-f", str(logs), "--verbose", "0", *words.replace("{}", str(tmp_path)).split()]
        )
    assert [file for file in logs.rglob("*") if file.is_file()] == []
    assert not [*logs.glob("*/*")]


def test_a_file_without_steps_needs_them_on_the_command_line(tmp_path: Path) -> None:
    block = {"policy": "MlpPolicy", "learning_starts": 50, "buffer_size": 100}
    (tmp_path / "own.yml").write_text(yaml.safe_dump({"Pendulum-v1": block}))
    words = ["--algo", "sadr", "--env", "Pendulum-v1", "-conf", str(tmp_path / "own.yml"), "-f", str(tmp_path)]
    with pytest.raises(SystemExit, match=r"own\.yml says no n_timesteps for Pendulum-v1: add it, or give -n"):
        train.main(words)
    train.main([*words, "-n", "60", "--seed", "1", "--verbose", "0"])
    assert DelayedSAC.load(tmp_path / "sadr" / "Pendulum-v1-seed1_1" / "Pendulum-v1").num_timesteps == 60


def test_numbers_are_read_as_they_are_written(tmp_path: Path) -> None:
    """YAML takes 1e-3 for text, and Python 1e3 for a float."""
    block = "{policy: MlpPolicy, n_timesteps: 2e1, learning_rate: 1e-3, gamma: 9e-1, buffer_size: 1e3, n_envs: 2e0}"
    (tmp_path / "own.yml").write_text(f"Pendulum-v1: {block}")
    words = f"--algo stable --env Pendulum-v1 --seed 1 -conf {tmp_path}/own.yml --verbose 0 -params batch_size:1e1"
    train_here(tmp_path, words)
    model = StableSAC.load(tmp_path / "stable" / "Pendulum-v1-seed1_1" / "Pendulum-v1", device="cpu")
    assert (model.num_timesteps, model.lr_schedule(1.0), model.gamma) == (20, 1e-3, 0.9)
    assert (model.buffer_size, model.n_envs, model.batch_size) == (1000, 2, 10)
    assert isinstance(model.batch_size, int)


def test_a_resume_of_fewer_steps_than_there_are_is_refused(finished: Path) -> None:
    record = (finished / "run.json").read_bytes()
    with pytest.raises(SystemExit, match="has taken 120 steps: give -n more than that, or leave it out, got 90"):
        train.main(["--resume", str(finished), "-n", "90"])
    assert (finished / "run.json").read_bytes() == record and (finished / "ended.json").is_file()
    with pytest.raises(SystemExit, match="2"):
        train.main(["--resume", str(finished), "-optimize"])


def test_a_resume_takes_no_option_of_the_start(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        "-conf a.yml",
        "-f x",
        "--log-fol x",
        "--storage x.log",
        "--study-name s",
        "--trial-id 3",
        "-i a.zip",
        "-uuid",
    ):
        with pytest.raises(SystemExit):
            train.main(["--resume", str(finished), *words.split()])
        assert "goes on with the run's own --" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------------- failures


@pytest.mark.parametrize(
    ("nan_in", "params"), [("reward", ["normalize:dict(norm_obs_keys=['observation'])"]), ("observation", [])]
)
def test_a_nan_of_the_task_is_in_no_checkpoint(
    nan_in: str, params: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import mine

    monkeypatch.setattr(mine.Mine, "steps", 0)
    command = "--algo sadr --env Mine-v0 --gym-packages mine --delay 1 --seed 3 --checkpoint-freq 20 -n 100"
    task = ["--env-kwargs", "nan_at:90", f"nan_in:{nan_in!r}"]
    settings = ["-params", "learning_starts:30", "buffer_size:200", NETWORKS, *params]
    with np.errstate(all="ignore"), pytest.raises(ValueError):
        train_here(tmp_path, command, *task, *settings)
    run = tmp_path / "sadr" / "Mine-v0-delay1-seed3_1"
    assert f"by an error; --resume {run} goes on from the last checkpoint" in capsys.readouterr().out
    assert load_tree(run / "checkpoint.zip")["counters"]["num_timesteps"] == 80
    train.main(["--resume", str(run)])
    assert DelayedSAC.load(run / "Mine-v0.zip").num_timesteps == 100


def test_a_full_disk_at_the_planners_checkpoint_loses_no_planner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *args: Any) -> None:
        if path.name.startswith("planner"):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        save(path, *args)

    save = checkpoint.save_tree
    monkeypatch.setattr(checkpoint, "save_tree", full)
    with pytest.warns(UserWarning, match=r"written to .*planner_checkpoint.zip \(.*No space left on device"):
        train.main(arguments(tmp_path))
    model = SAID.load(run_of(tmp_path) / f"{ENV}.zip")
    assert model.policy.planner_updates == 10


# ---------------------------------------------------------------------------------------------------- the command


def test_help_shows_both_command_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        train.main(["--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert "--delay" in shown and "--tensorboard-log" in shown and "examples:" in shown
    assert "said,sac,sa,dr,sadr" in shown and "ppo" not in shown


def test_the_default_preset_is_the_same_on_every_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert train.read_command_line([])[0].preset == "cpu"


@pytest.mark.parametrize(
    ("given", "n_threads"), [([], "1"), (["--num-threads", "3"], "3"), (["--num-threads=-1"], "-1")]
)
def test_training_takes_one_thread_unless_told(given: list[str], n_threads: str) -> None:
    """Two wait for each other beside another process: 3 steps a second in place of 100 (results/settings.md)."""
    assert f"--num-threads={n_threads}" in train.read_command_line(given)[2]


def test_a_given_agent_is_found_from_another_folder_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"--trained-agent={tmp_path / 'logs' / 'agent.zip'}" in train.read_command_line(["-i", "logs/agent.zip"])[2]
    assert not any("trained-agent" in word for word in train.read_command_line([])[2])


def test_a_resume_from_another_folder_goes_on_with_the_same_curve(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"--tensorboard-log={tmp_path / 'tb'}" in train.read_command_line(["-tb", "tb"])[2]
    assert "--tensorboard-log=" in train.read_command_line(["-tb", ""])[2]  # rl_zoo3's for none
    assert not any("tensorboard" in word for word in train.read_command_line([])[2])


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("-n 5 --eval-freq -1", "-n 5 --eval-freq -1"),
        ("-params a:1 b:2 -n 5 --hyperparams b:3 -P", "-n 5 -P -params a:1 b:2 b:3"),
        ("--env X --env-kwargs c:1 -params a:1 --env-kwargs d:2", "--env X -params a:1 --env-kwargs c:1 d:2"),
        ("--gym-packages a -n 5 --gym-packages b", "-n 5 --gym-packages a b"),
    ],
)
def test_settings_given_twice_are_joined(given: str, read: str) -> None:
    assert train.joined_settings(given.split()) == read.split()


def test_a_setting_without_a_value_is_refused_with_its_form() -> None:
    with pytest.raises(ValueError, match=r"-params takes NAME:VALUE, got 'gamma=0.9'.*policy:'MlpPolicy'"):
        train.joined_settings(["-params", "gamma=0.9"])


@pytest.mark.parametrize("words", ["-params policy:MlpPolicy", "-params gamma:", "--env-kwargs max_episode_steps:abc"])
def test_a_value_that_is_no_python_is_refused_with_its_form(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train.main(["--algo", "said", "--env", ENV, "--delay", "2", *words.split()])
    assert "text has quotes of its own: -params" in capsys.readouterr().err


def test_a_task_whose_library_is_missing_ends_in_one_line(monkeypatch, tmp_path: Path) -> None:
    def missing(*_: object, **__: object) -> None:
        raise gym.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(DelayedExperimentManager, "create_envs", missing)
    with pytest.raises(SystemExit, match="error: Box2D is not installed"):
        train.main(["--env", "Pendulum-v1", "-f", str(tmp_path), "--verbose", "0"])


def test_no_log_is_overwritten(tmp_path: Path) -> None:
    names = []
    for steps in (0, 500, 500, 500, 900, 0):
        names.append(log_suffix(tmp_path, steps))
        (tmp_path / f"progress{names[-1]}.csv").touch()
    assert names == ["", "_500", "_500_2", "_500_3", "_900", "_0_2"]
