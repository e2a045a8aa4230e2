"""The task of a run: a user's wrapper under the delay, a user's package, and a loud word where there is no delay."""

from __future__ import annotations

import json
import re
import shutil
import sys
from argparse import Namespace
from pathlib import Path

import gymnasium as gym
import pytest

pytest.importorskip("rl_zoo3")

from rl_zoo3.wrappers import TimeFeatureWrapper
from small_task import Drift, pendulum
from trained_run import ENV, PLANNER, report_quickly, train_here

from sb3_said import DelayedObservationWrapper, DelayedSAC
from sb3_said.zoo import enjoy, evaluate, experiment, manager, over_delays, train, tune
from sb3_said.zoo.record import WRAPPER, Record
from sb3_said.zoo.runs import load_run

PLANNED = ("planner_gradient_steps:2", "planner_trial_episodes:0", f"planner_kwargs:{PLANNER}")


TIME = "rl_zoo3.wrappers.TimeFeatureWrapper"
QUICK = "--preset smoke -n 40 --seed 3"


@pytest.mark.parametrize("where", ["-params", "-conf"])
def test_the_delay_is_around_the_users_own_wrapper(
    where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "own.yml"
    config.write_text(f"default: {{n_timesteps: 40, policy: MultiInputPolicy, env_wrapper: {TIME}}}\n")
    given = ["-params", f"env_wrapper:{TIME!r}"] if where == "-params" else ["-conf", config, "--preset", "cpu"]
    train_here(tmp_path, f"--algo sadr --env Pendulum-v1 --delay 2 {QUICK}", *given)
    assert "NO DELAY" not in capsys.readouterr().out
    played = load_run(tmp_path / "sadr" / "Pendulum-v1-delay2-seed3_1", device="cpu")
    env = played.make_env()
    assert isinstance(env, DelayedObservationWrapper) and isinstance(env.env, TimeFeatureWrapper)
    assert played.model.observation_space["observation"].shape == (4,)  # type: ignore[index]  # a Dict has keys
    assert played.info["delay"] == 2
    train.main(["--resume", str(played.folder), "-n", "60"])
    assert DelayedSAC.load(played.folder / "Pendulum-v1.zip").num_timesteps == 60


def test_the_experts_other_delay_is_around_the_users_own_wrapper_too(tmp_path: Path) -> None:
    run = experiment.Run(3, "cpu", expert_delay=1)
    made = manager.DelayedExperimentManager(
        run,
        Namespace(),
        "said",
        "Pendulum-v1",
        str(tmp_path),
        verbose=0,
        eval_freq=-1,
        hyperparams={"env_wrapper": TIME},
    ).setup_experiment()
    assert made is not None and made[0].env is not None
    env = made[0].env.envs[0]  # type: ignore[attr-defined]  # a DummyVecEnv
    assert isinstance(env.env, TimeFeatureWrapper) and (env.process.delay, env.max_delay) == (1, 3)
    assert made[1]["env_wrapper"][1:] == [{WRAPPER: {"delay": 3, "max_delay": 3}}]


def test_a_task_without_a_delay_is_said_loudly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train_here(tmp_path, f"--algo sadr --env Pendulum-v1 {QUICK}")
    assert "NO DELAY: this trains on Pendulum-v1 without any delay; --delay 4 adds" in capsys.readouterr().out
    params = ["-params", f"env_wrapper:[{{{WRAPPER!r}: {{'delay': 1}}}}]"]
    train_here(tmp_path, f"--algo sadr --env Pendulum-v1 {QUICK}", *params)
    assert "NO DELAY" not in capsys.readouterr().out
    assert load_run(tmp_path / "sadr" / "Pendulum-v1-seed3_2", device="cpu").info["delay"] == 1


def test_a_task_that_is_registered_with_its_delay_has_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gym.register("Late-v0", lambda: DelayedObservationWrapper(Drift(), delay=2), max_episode_steps=12)
    try:
        train_here(tmp_path, f"--algo sadr --env Late-v0 {QUICK}")
        assert "NO DELAY" not in capsys.readouterr().out
        assert load_run(tmp_path / "sadr" / "Late-v0-seed3_1", device="cpu").info["delay"] == 2
    finally:
        gym.registry.pop("Late-v0")


def test_a_task_may_have_a_dot_in_its_name(tmp_path: Path) -> None:
    gym.register("Arm.Reach-v1", lambda: gym.make("Pendulum-v1").unwrapped, max_episode_steps=200)
    try:
        train_here(tmp_path, f"--algo sadr --env Arm.Reach-v1 --delay 1 {QUICK}")
        run = tmp_path / "sadr" / "Arm.Reach-v1-delay1-seed3_1"
        assert load_run(run, device="cpu").model.num_timesteps == 40
        train.main(["--resume", str(run), "-n", "50"])
        assert load_run(run, device="cpu").model.num_timesteps == 50
    finally:
        del gym.registry["Arm.Reach-v1"]


def test_a_task_registered_with_its_delay_keeps_it(tmp_path: Path) -> None:
    gym.register("Late-v0", lambda: pendulum(20, delay=1, max_delay=2))
    try:
        train_here(tmp_path, f"--algo sadr --env Late-v0 {QUICK}")
        run = tmp_path / "sadr" / "Late-v0-seed3_1"
        (copy := tmp_path / "alone.zip").write_bytes((run / "Late-v0.zip").read_bytes())
        for path in (run, copy):
            for delay in (None, 1):
                opened = load_run(path, "sadr", "Late-v0", delay, device="cpu")
                assert opened.info["delay"] == 1 and opened.play(1, seed=0).lengths.tolist() == [20]
            with pytest.raises(ValueError, match="Late-v0 is registered with a delay of its own, 1, and can be played"):
                load_run(path, "sadr", "Late-v0", 2, device="cpu")
        words = [str(run), "--delays", "1", "2", "--episodes", "2", "--json", str(tmp_path / "over.json")]
        over_delays.main(words)
        cells = json.loads((tmp_path / "over.json").read_text())["cells"]
        assert [cell["result"] is None for cell in cells] == [False, True]
        assert cells[1]["obstacle"] == "its task is registered with a delay of its own, 1"
        evaluate.main([str(run), "--realtime", "--period", "9", "--episodes", "1", "--latency-calls", "0"])
        assert json.loads((run / "realtime.json").read_text())["delay"] == 1
    finally:
        del gym.registry["Late-v0"]


class Simulated(Drift):
    process = "of a simulator"


@pytest.mark.parametrize("delay", [3, None])
def test_a_process_of_the_task_s_own_is_no_delay(delay: int | None, tmp_path: Path) -> None:
    gym.register("Simulated-v0", Simulated, max_episode_steps=5)
    try:
        env = gym.make("Simulated-v0")
        DelayedSAC("MlpPolicy", env if delay is None else DelayedObservationWrapper(env, delay)).save(tmp_path / "a")
        opened = load_run(tmp_path / "a.zip", "sadr", "Simulated-v0", device="cpu")
        assert opened.info["delay"] == (delay or 0) and opened.play(1, seed=0).lengths.tolist() == [5]
    finally:
        del gym.registry["Simulated-v0"]


def test_an_action_delay_of_the_task_counts_among_what_it_can_play(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = ["-params", f"env_wrapper:[{{{WRAPPER!r}: {{'delay': 2, 'action_delay': 1}}}}]"]
    train_here(tmp_path, f"--algo sadr --env {ENV} {QUICK}", *params)
    run, few = tmp_path / "sadr" / f"{ENV}-seed3_1", ["--episodes", "1", "--device", "cpu"]
    over_delays.main([str(run), *few, "--delays", "0", "2", "3", "--json", str(tmp_path / "over.json")])
    shown = capsys.readouterr().out
    assert "2 of 3 cells to play" in shown
    assert "cannot play delay 3: it was built for delays 0..3, and its task delays actions by 1" in shown
    agent = run / f"{ENV}.zip"
    (copy := tmp_path / "alone.zip").write_bytes(agent.read_bytes())  # which does not know of the task's action delay
    over_delays.main([str(copy), *few, "--algo", "sadr", "--delays", "2", "--json", str(tmp_path / "over.json")])
    assert "1 of 1 cells to play" in capsys.readouterr().out


def forget_mine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Be a process that has not imported the user's package."""
    for registered in (gym.registry, sys.modules):
        monkeypatch.delitem(registered, {id(gym.registry): "Mine-v0"}.get(id(registered), "mine"), raising=False)


def test_a_task_is_named_with_its_module_as_gymnasium_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_mine(monkeypatch)
    train_here(tmp_path, f"--algo sadr --env mine:Mine-v0 --delay 1 {QUICK}", "--env-kwargs", "length:5")
    run = tmp_path / "sadr" / "Mine-v0-delay1-seed3_1"
    record = Record.read(run)
    assert (record.env, record.gym_packages) == ("Mine-v0", ["mine"])
    forget_mine(monkeypatch)
    assert load_run(run, device="cpu").model.num_timesteps == 40


def test_a_run_remembers_the_package_of_its_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    forget_mine(monkeypatch)
    report_quickly(monkeypatch)
    train_here(tmp_path, f"--algo said --env Mine-v0 --gym-packages mine --delay 1 {QUICK}",
               "--env-kwargs", "length:5", "-params", *PLANNED)  # fmt: skip
    run = tmp_path / "said" / "Mine-v0-delay1-seed3_1"
    few = ["--episodes", "2", "--device", "cpu"]
    for play in (
        lambda: evaluate.main([str(run), *few, "--latency-calls", "0"]),
        lambda: over_delays.main([str(run), *few, "--delays", "1", "--json", str(tmp_path / "over.json")]),
        lambda: tune.main([str(run), "--depths", "1", "--temperatures", "0", "--report-episodes", "2", *few]),
        lambda: train.main(["--resume", str(run), "-n", "60"]),
        lambda: enjoy.main([str(run), "--record", str(tmp_path / "mine.gif"), "--device", "cpu"]),
    ):
        forget_mine(monkeypatch)
        play()
    assert (tmp_path / "mine.gif").read_bytes()[:3] == b"GIF"
    assert json.loads((run / "evaluation.json").read_text())["results"][0]["lengths"] == [5, 5]
    assert f"--gym-packages mine -conf {run / 'tune' / 'best.yml'}" in capsys.readouterr().out
    alone = Path(shutil.copy(run / "Mine-v0.zip", tmp_path))
    forget_mine(monkeypatch)
    evaluate.main([str(alone), *few, "--latency-calls", "0", "--algo", "said", "--env", "Mine-v0",
                   "--gym-packages", "mine"])  # fmt: skip
    forget_mine(monkeypatch)
    monkeypatch.setitem(sys.modules, "mine", None)
    with pytest.raises(ImportError, match="package 'mine', which cannot be imported here: install it"):
        load_run(run, device="cpu")


OWN = """
import gymnasium as gym
{at_import}
class Own(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    def __init__(self):
        {in_init}
    def reset(self, *, seed=None, options=None):
        {in_reset}
        return self.observation_space.sample(), {{}}
gym.register("Own-v0", Own)
"""


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"in_init": "raise ValueError('the motor is off')"}, r"the motor is off.* \(in .*, line 7\)"),
        ({"in_init": "int(None)"}, r"int\(\) argument must be .* \(in .*, line 7\)"),
        ({"in_init": "open('calibration.csv')"}, r"No such file.*calibration.csv.* \(in .*, line 7\)"),
        ({"in_init": "gym.spaces.Box([1, 2], 1.0, (1,))"}, r"Box low must be.* \(in .*, line 7\)"),
        ({"at_import": "import nowhere"}, r"No module named 'nowhere' \(in .*, line 3\): install it"),
        ({"at_import": "lidar"}, r"name 'lidar' is not defined \(in .*, line 3\)$"),
        ({"at_import": "1 +"}, r"invalid syntax \(own_\w+.py, line 3\)$"),
    ],
)
def test_a_fault_of_the_users_own_code_names_its_line(
    fault: dict[str, str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = f"own_{tmp_path.name}"  # each test imports a module of its own
    (tmp_path / f"{name}.py").write_text(OWN.format(**{"at_import": "", "in_init": "pass", "in_reset": "", **fault}))
    monkeypatch.syspath_prepend(tmp_path)
    try:
        with pytest.raises(SystemExit) as stop:
            train_here(tmp_path / "logs", f"--algo sadr --env {name}:Own-v0 --delay 2 {QUICK}")
        words = f"{stop.value.code}\n{capsys.readouterr().err}"
        assert re.search(message, words, re.MULTILINE) and "A VALUE is Python" not in words
        if "(in" in message:
            assert f"(in {tmp_path / name}.py, line" in words
    finally:
        gym.registry.pop("Own-v0", None)


class Still(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (1,))


def test_a_fault_of_the_users_own_code_names_its_line_where_an_agent_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own_task_playing.py"
    own.write_text(OWN.format(at_import="", in_init="pass", in_reset="raise ValueError('the motor is off')"))
    monkeypatch.syspath_prepend(tmp_path)
    try:
        DelayedSAC("MultiInputPolicy", DelayedObservationWrapper(Still(), 2), buffer_size=9).save(tmp_path / "a.zip")
        with pytest.raises(SystemExit):
            evaluate.main([*f"{tmp_path / 'a.zip'} --algo sadr --env Own-v0 --gym-packages {own.stem}".split()])
        assert f"the motor is off (in {own}, line 9)" in capsys.readouterr().err
    finally:
        gym.registry.pop("Own-v0", None)
