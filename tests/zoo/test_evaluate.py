"""evaluate.py and enjoy.py: what they write for a SAID run, and what they say when they are asked for nonsense."""

from __future__ import annotations

import json
import os
import shutil
import sys
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch as th

pytest.importorskip("rl_zoo3")

from drawing import need_a_renderer
from small_run import ENV, TINY_PLANNER, write_run
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.evaluation import Summary, rollout
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.said.policies import SAIDPolicy
from sb3_said.zoo import enjoy, evaluate
from sb3_said.zoo.record import Record
from sb3_said.zoo.runs import control_period, load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("said") / f"{ENV}-delay2_1", SAID, 2)


def test_evaluate_measures_the_planner_and_the_expert(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    plot, titles, save = run / "plot.png", [], evaluate.plots.save
    decided: dict[bool, list[int]] = {True: [], False: []}
    decide = SAIDPolicy._decide

    def recorded(ax: Any, path: Path) -> None:
        titles.append(ax.figure.get_suptitle())
        save(ax, path)

    def counted(self: SAIDPolicy, observation: Any, is_experts: bool, deterministic: bool) -> th.Tensor:
        decided[is_experts].append(len(observation["observation"]))
        return decide(self, observation, is_experts, deterministic)

    monkeypatch.setattr(evaluate.plots, "save", recorded)
    monkeypatch.setattr(SAIDPolicy, "_decide", counted)
    th.set_num_threads(2)
    evaluate.main([str(run), "--episodes", "3", "--n-envs", "2", "--latency-calls", "5", "--seed", "7",
                   "--plot", str(plot), "--device", "cpu"])  # fmt: skip
    document = json.loads((run / "evaluation.json").read_text())
    assert (document["algo"], document["env"], document["delay"]) == ("said", ENV, 2)
    assert (document["seed"], document["n_episodes"], document["trained_steps"]) == (7, 3, 60)
    assert [result["label"] for result in document["results"]] == ["planner", "expert"]
    assert document["origin"]["torch_threads"] == 1  # two would wait for each other on a busy machine
    instructions = document["origin"]["machine"].split(", ")[-1]  # by which sums round
    assert f"CPU capability usage: {instructions}\n" in th.__config__.show()
    for sizes in decided.values():  # in episodes together, and timed one by one
        assert 2 in sizes and set(sizes[-5:]) == {1}
    # The file holds what the library measures for the same agent and seeds.
    model = SAID.load(run / f"{ENV}.zip", device="cpu")
    for result in document["results"]:
        with model.policy.answering(result["label"], at_once=True):
            played = rollout(model, lambda: DelayedObservationWrapper(gym.make(ENV), delay=2), 3, seed=7, n_envs=2)
        assert result["returns"] == played.returns.tolist() and result["lengths"] == played.lengths.tolist()
        assert result["latency"]["n_calls"] == 5
    out = capsys.readouterr().out
    assert all(word in out for word in ("planner", "expert", "p95", "evaluation.json"))
    assert plot.read_bytes()[:4] == b"\x89PNG" and titles == [f"said on {ENV}, delay 2"]


@pytest.mark.parametrize(("period", "n"), [(1e6, 1), (1e-9, None)])
def test_evaluate_in_real_time(
    period: float, n: int | None, run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Any answer takes one period of ten days, and more of a nanosecond than an episode has."""
    file = tmp_path / "real.json"
    evaluate.main([str(run), "--episodes", "1", "--latency-calls", "0", "--seed", "7", "--device", "cpu",
                   "--realtime", "--period", str(period), "--json", str(file)])  # fmt: skip
    document = json.loads(file.read_text())
    labels = [f"{who}{how}" for who in ("planner", "expert") for how in ("", ", in real time", ", latency ignored")]
    rows = {row["label"]: row for row in document["results"]}
    assert list(rows) == labels and (document["delay"], document["period"]) == (0, period)
    loaded = load_run(run, delay=0, device="cpu")
    with loaded.model.policy.answering("planner"):
        assert rows["planner"]["returns"] == loaded.play(1, seed=7).returns.tolist()  # answers for free
    for label, counts in document["realtime"].items():
        assert counts["steps"] == sum(rows[label]["lengths"])
        if n is None:
            assert counts["waiting_steps"] == counts["steps"] and "answer_steps_p50" not in counts
        else:
            assert (counts["answer_steps_p50"], counts["answer_steps_max"]) == (n, n)
            assert (counts["waiting_steps"], counts["held_steps"], counts["late_answers"]) == (1, 0, 0)
    if n == 1:  # the same as behind a wrapper whose actions take one step, and whose first one is 0
        env = DelayedObservationWrapper(gym.make(ENV), 0, 1, max_delay=2)
        with loaded.model.policy.answering("expert"):
            obs, total, t, done = env.reset(seed=7)[0], 0.0, 0, False
            while not done:
                action = loaded.model.predict(obs, deterministic=True)[0] if t else np.zeros(1, np.float32)
                obs, reward, terminated, truncated, _ = env.step(action)
                total, t, done = total + float(reward), t + 1, terminated or truncated
        assert rows["expert, in real time"]["returns"][0] == total
    out = capsys.readouterr().out
    assert "expert, latency ignored: " in out and "age_p99 0" in out


def test_the_period_is_the_tasks_own_where_it_tells(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = load_run(run, device="cpu")
    assert control_period(loaded) == gym.make(ENV).unwrapped.dt  # type: ignore[attr-defined]
    assert control_period(replace(loaded, make_env=lambda: gym.make("MountainCarContinuous-v0"))) is None
    for dt in (lambda: 0.1, 0.0):
        assert control_period(replace(loaded, make_env=lambda dt=dt: Mock(unwrapped=Mock(dt=dt)))) is None
    monkeypatch.setattr(evaluate, "control_period", lambda run: None)
    with pytest.raises(SystemExit):
        evaluate.main([str(run), "--realtime", "--episodes", "1", "--device", "cpu"])
    assert "give --period" in capsys.readouterr().err


def test_an_agent_that_reads_normalised_observations_is_not_played_without_their_scale(tmp_path: Path) -> None:
    env = VecNormalize(
        DummyVecEnv([lambda: DelayedObservationWrapper(gym.make(ENV), 1)]), norm_obs_keys=["observation"]
    )
    first, second = tmp_path / "first.zip", tmp_path / "second.zip"
    DelayedSAC("MultiInputPolicy", env, learning_starts=20, buffer_size=100, device="cpu").learn(20).save(first)
    DelayedSAC.load(first, device="cpu").save(second)  # without an environment it remembers, too
    for file in (first, second):
        with pytest.raises(ValueError, match=f"{file.stem}.normalize.zip is missing"):
            load_run(file, "sadr", ENV, device="cpu")
        save_normalization(normalization_file(file), env)
        assert load_run(file, "sadr", ENV, device="cpu").normalize is not None


def test_statistics_that_belonged_to_another_agent_of_the_name_are_left_out(run: Path, tmp_path: Path) -> None:
    agent = tmp_path / "agent.zip"
    agent.write_bytes((run / f"{ENV}.zip").read_bytes())
    for norm_obs in (True, False):
        keys = ["observation"] if norm_obs else None
        env = VecNormalize(
            DummyVecEnv([lambda: DelayedObservationWrapper(gym.make(ENV), 1)]), norm_obs=norm_obs, norm_obs_keys=keys
        )
        save_normalization(normalization_file(agent), env)
        told = pytest.warns(UserWarning, match="belonged to another agent")
        with told if norm_obs else nullcontext():
            normalize = load_run(agent, "said", ENV, device="cpu").normalize
        assert (normalize is None) == norm_obs  # those of rewards alone are its own, and change no observation


def test_results_of_another_file_are_kept_apart(run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(run, tmp_path / run.name))
    (folder / "weighed.zip").write_bytes((folder / f"{ENV}.zip").read_bytes())
    few = ["--episodes", "1", "--latency-calls", "0", "--device", "cpu"]
    for path, options in ((folder, []), (folder / "weighed.zip", []), (folder, ["--realtime", "--period", "1"])):
        evaluate.main([str(path), *few, *options])
    for name, file in (("evaluation", ENV), ("weighed_evaluation", "weighed"), ("realtime", ENV)):
        assert Path(json.loads((folder / f"{name}.json").read_text())["file"]).stem == file


@pytest.mark.parametrize("held", ['{"env": "Hopper-v5", "cells": []}', "3", "notes"])
def test_a_file_of_something_else_is_not_written_over(
    held: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file := tmp_path / "returns.json").write_text(held)
    with pytest.raises(SystemExit):
        evaluate.main([str(run), "--episodes", "1", "--device", "cpu", "--json", str(file)])
    assert "returns.json holds something else than what" in capsys.readouterr().err and file.read_text() == held


def test_a_shorter_delay_keeps_the_length_of_the_action_history(run: Path) -> None:
    loaded = load_run(run, delay=1, device="cpu")
    env = loaded.make_env()
    env.action_space.seed(0)  # by which it does not fall in so few steps
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
    assert loaded.info["delay"] == 1 and observation["delay"] == 1 and observation["action_history"].shape == (2, 1)


def test_an_agent_without_its_run_folder(run: Path, tmp_path: Path) -> None:
    alone = tmp_path / "agent.zip"
    alone.write_bytes((run / f"{ENV}.zip").read_bytes())
    loaded, full = load_run(alone, algo="said", env_id=ENV, device="cpu"), load_run(run, device="cpu")
    assert loaded.info["delay"] == full.info["delay"] == 2
    left, right = (rollout(r.model, r.make_env, 2, seed=0) for r in (loaded, full))
    np.testing.assert_array_equal(left.returns, right.returns)


def test_an_agent_of_sb3_itself_is_not_opened(run: Path, tmp_path: Path) -> None:
    """Its file may run code, whatever a run.json beside it says."""
    from stable_baselines3 import PPO

    PPO("MlpPolicy", "Pendulum-v1", device="cpu").save(tmp_path / "Pendulum-v1.zip")
    Record("ppo", "Pendulum-v1").write(tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PPO, "load", lambda *_, **__: pytest.fail("opened"))
        for algo in (None, "sadr"):
            with pytest.raises(ValueError, match=r"is not known \(ppo\): give --algo, one of said, sac"):
                load_run(tmp_path, algo=algo)
    (tmp_path / "run.json").unlink()
    with pytest.raises(ValueError, match=r"is not known: give .*has saved, sb3-said collect alone opens"):
        load_run(tmp_path / "Pendulum-v1.zip")
    with pytest.warns(UserWarning, match="is of 'said', as it says itself: --algo bc changes nothing"):
        assert load_run(run, algo="bc", device="cpu").info["algo"] == "said"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--delay", "5"], "built for delays 0..2"),
        (["--env", "Hopper-v5"], "observation_space shapes"),
        (
            ["--env", "Pendulun-v1"],
            "Did you mean: `Pendulum`? A package that registers a task is named with --gym-packages",
        ),
        (["--episodes", "0"], "at least 1"),
        (["--algo", "nonsense"], "give --algo"),
        (["--period", "0.02"], "needs --realtime"),
        (["--realtime", "--period", "0"], "above 0"),
        (["--realtime", "--period", "inf"], "above 0"),
        (["--latency-calls", "-1"], "--latency-calls must be at least 0, got -1"),
        (["--json", "."], "it is a folder. Give the path of a file"),
        (["--plot", "plot.xyz"], "give it the suffix .png"),
        (["--seed", "-5"], "a reset seed is a whole number, 0 or more, got -5"),
        (["--device", "gpu"], "auto, cpu, cuda or another that torch has, got gpu"),
    ],
)
def test_evaluate_says_what_is_wrong(
    run: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        evaluate.main([str(run), *arguments])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


def test_an_interrupted_evaluation_ends_without_a_traceback(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "evaluate", interrupted)
    with pytest.raises(SystemExit) as exit_info:
        evaluate.main([str(run)])
    assert exit_info.value.code == 130 and "Interrupted." in capsys.readouterr().err


def test_an_agent_of_other_actions_is_not_played(tmp_path: Path) -> None:
    """Its run had a wrapper that scales them, which a file alone does not name."""
    env = DelayedObservationWrapper(gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), -1.0, 1.0), 1)
    DelayedSAC("MultiInputPolicy", env, buffer_size=10, device="cpu").save(tmp_path / "agent.zip")
    with pytest.raises(ValueError, match=r"sends actions in Box\(-1.0, 1.0.* the task takes Box\(-2.0, 2.0"):
        load_run(tmp_path / "agent.zip", "sadr", device="cpu")


def test_a_place_that_cannot_be_written_is_told_before_any_episode(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate, "evaluate", lambda *_, **__: pytest.fail("an episode was played"))
    with pytest.raises(SystemExit) as exit_info:
        evaluate.main([str(run), "--json", str(run / "run.json" / "numbers.json")])
    assert exit_info.value.code == 1


def test_the_curves_of_runs_below_a_folder_are_not_its_own(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "another" / "run").mkdir(parents=True)
    np.savez(tmp_path / "another" / "run" / "evaluations.npz", timesteps=[1], results=[[1.0]])
    summary = Summary.from_episodes("planner", np.ones(3), np.ones(3, np.int64))
    evaluate.draw(tmp_path / "x.png", [summary], tmp_path, "a bare file")
    assert (tmp_path / "x.png").is_file()


def test_logs_that_a_kill_has_cut_are_drawn_as_far_as_they_go(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    np.savez(tmp_path / "evaluations.npz", timesteps=np.arange(50), results=np.ones((50, 2)))
    os.truncate(tmp_path / "evaluations.npz", 300)
    (tmp_path / "0.monitor.csv").write_text('#{"t_start": 0}\nr,l,t\n5.0,12,1.0\n7.0,13,2.0\n8.0')
    with pytest.warns(UserWarning, match=r"evaluations\.npz is damaged"):
        ax = evaluate.plots.plot_learning_curve(tmp_path)
    (episodes, _) = ax.get_lines()
    np.testing.assert_array_equal(episodes.get_xydata(), [[12, 5], [25, 7]])


def test_a_run_that_stopped_before_its_planner_says_so(run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*stopped after")
        model = load_run(folder).model
    model.policy.planner_updates.zero_()
    model.save(folder / f"{ENV}.zip")
    with pytest.warns(
        UserWarning, match=f"stopped after 60 steps, before its planner .*train --resume {folder} goes on"
    ):
        load_run(folder)


def test_paths_that_hold_no_agent(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not exist"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"holds the runs .*{run.name}"):
        load_run(run.parent)
    with pytest.raises(ValueError, match=r"holds no run: .*run.json is missing"):
        load_run(tmp_path)
    unfinished = tmp_path / "of two words"
    unfinished.mkdir()
    Record("said", ENV).write(unfinished)
    with pytest.raises(ValueError, match=r"no finished agent.*train --resume '.*of two words' goes on with it"):
        load_run(unfinished)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--record", "film.avi"], "ending in .mp4 or .gif"),
        (["--record", "film.gif", "--fps", "0"], "at least 1"),
        (["--record", "{folder}"], "it is a folder"),
        (["--record", "film.gif", "--env", "Pendulum-v1", "--size", "64"], "Pendulum-v1 cannot be made with"),
        ([], "no display"),
    ],
)
def test_enjoy_says_what_is_wrong(
    run: Path,
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (folder := tmp_path / "a_folder.mp4").mkdir()
    with pytest.raises(SystemExit) as exit_info:
        enjoy.main([str(run), *[word.format(folder=folder) for word in arguments]])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("own", [25, 125, None])
@pytest.mark.parametrize("fps", [10, 12, 25, 30, 60, 125])
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_video_plays_in_real_time(fps: int, own: int | None, suffix: str, tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v3")

    class Drawn:
        metadata = {"render_fps": own}

        def render(self) -> np.ndarray:
            return np.full((16, 16, 3), video._steps % 256, np.uint8)

    video = enjoy.Video(tmp_path / "sub" / f"film{suffix}", fps)
    for _ in range(2 * (own or fps)):  # 2 seconds
        video.on_step(Drawn())
    video.close()
    assert len(imageio.imread(video.path)) == video.frames <= 2 * min(fps, own or fps)
    assert video.fps == pytest.approx(min(fps, own or fps), rel=0.25 if suffix == ".gif" else 0)  # in hundredths
    if own is None:  # nobody knows how long a step is
        assert video.frames == 2 * fps
        return
    found = imageio.immeta(video.path)
    seconds = video.frames * found["duration"] / 1000 if suffix == ".gif" else found["duration"]
    assert seconds == pytest.approx(2, abs=1.01 / video.fps)


def test_a_task_that_draws_nothing_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"render\(\) of the task returned NoneType, expected a frame"):
        enjoy.Video(tmp_path / "film.gif", 10).on_step(Mock(metadata={}, render=lambda: None))


def test_a_task_that_cannot_be_drawn_names_the_libraries(tmp_path: Path) -> None:
    class Broken:
        metadata: dict = {}

        def render(self) -> None:
            raise OSError("libEGL.so.1: cannot open shared object file")

    with pytest.raises(enjoy.CannotDraw, match=r"(?s)libEGL.*apt-get install libegl1"):
        enjoy.Video(tmp_path / "film.mp4", 25).on_step(Broken())


def test_a_fault_of_the_tasks_own_drawing_stays_what_it_is(tmp_path: Path) -> None:
    class Broken:
        metadata: dict = {}

        def render(self) -> None:
            raise NameError("name 'scren' is not defined")

    with pytest.raises(NameError, match="scren"):
        enjoy.Video(tmp_path / "film.mp4", 25).on_step(Broken())


def test_a_task_that_declares_no_pictures_is_told(tmp_path: Path) -> None:
    env = gym.make("MountainCar-v0")  # whose own metadata are these
    env.unwrapped.metadata = {"render_modes": ["ansi"]}
    with pytest.raises(ValueError, match=r"'rgb_array' is none of the render_modes in the task's metadata: \['ansi'\]"):
        enjoy.Video(tmp_path / "film.gif", 10).on_step(env)


def test_enjoy_prints_every_episode(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                    monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    pytest.importorskip("imageio")
    # Drawing needs a GL library that a test machine may lack: a blank picture stands in for it.
    monkeypatch.setattr("gymnasium.envs.mujoco.MujocoEnv.render", lambda self: np.zeros((32, 32, 3), np.uint8))
    monkeypatch.setattr(enjoy, "check_can_record", lambda path: None)
    film = tmp_path / "film.gif"
    enjoy.main([str(run), "--record", str(film), "--episodes", "2", "--answer", "expert", "--device", "cpu"])
    out = capsys.readouterr().out
    assert "seed 10000: return" in out and "seed 10001: return" in out and film.stat().st_size > 0


def test_the_expert_of_a_planner_of_one_delay_is_watched_at_others(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model: Any = load_run(run, device="cpu").model
    model.policy.make_planner(replace(model.policy.planner.config, mask="fixed", present="inpainted"))
    model.policy.planner_updates.fill_(1.0)
    model.save(tmp_path / "fixed.zip")
    shown: list[Any] = []
    monkeypatch.setattr(enjoy, "check_can_record", lambda path: None)
    monkeypatch.setattr(enjoy, "show", lambda run, *_: shown.append((run.model.policy.who_answers, run.info["delay"])))
    words = [str(tmp_path / "fixed.zip"), "--env", ENV, "--delay", "1", "--record", str(tmp_path / "film.gif")]
    enjoy.main([*words, "--answer", "expert"])
    assert shown == [("expert", 1)]
    for refused in (["--answer", "planner"], ["--answer", "planner", "--delay", "2", "--beside-ignorant"]):
        with pytest.raises(SystemExit):
            enjoy.main([*words, *refused])
        assert "mask='fixed'" in capsys.readouterr().err
    assert len(shown) == 1


def test_an_agent_beside_itself_that_ignores_the_delay(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    imageio = pytest.importorskip("imageio.v3")
    drawn = iter(range(10_000))
    monkeypatch.setattr(
        "gymnasium.envs.mujoco.MujocoEnv.render", lambda self: np.full((16, 16, 3), 100 + next(drawn) % 100, np.uint8)
    )
    monkeypatch.setattr(enjoy, "check_can_record", lambda path: None)
    film = tmp_path / "film.gif"
    words = [str(run), "--record", str(film), "--beside-ignorant", "--delay", "2", "--device", "cpu", "--episodes", "2"]
    enjoy.main(words)
    out = capsys.readouterr().out
    told = [line.split(":")[0] for line in out.splitlines() if line.startswith("seed")]
    ignorant = ", told that every observation is new"
    assert told == ["seed 10000" + ignorant, "seed 10000", "seed 10001" + ignorant, "seed 10001"]  # pairs of one start
    frames = imageio.imread(film)
    assert frames.shape[1:] == (16, 32, 3) and f"{len(frames)} frames" in out
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(SystemExit):
        enjoy.main([str(run), "--beside-ignorant"])
    assert "--beside-ignorant makes a video of two plays: give --record" in capsys.readouterr().err


def test_of_a_pair_the_one_that_ends_first_stays_there_darker(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v3")
    video = enjoy.SideBySide(tmp_path / "film.gif", fps=10)
    for n_frames in (2, 4):
        video.begin()
        for k in range(n_frames):
            video.append(np.full((16, 16, 3), 200 + 10 * k, np.uint8))
    video.close()
    left, right = np.split(imageio.imread(video.path), 2, axis=2)
    assert [int(x.mean()) for x in left] == pytest.approx([200, 210, 105, 105], abs=4)
    assert [int(x.mean()) for x in right] == pytest.approx([200, 210, 220, 230], abs=4)


def test_a_task_that_draws_itself_needs_no_library_of_mujocos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)  # as where its library is missing, an import fails
    enjoy.check_can_record(Path("film.gif"))
    with pytest.raises(enjoy.CannotDraw, match="apt-get install libegl1"), enjoy.naming_libraries():
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")
    monkeypatch.undo()
    with pytest.raises(ImportError, match="own_package is missing") as error, enjoy.naming_libraries():
        raise ImportError("own_package is missing")
    assert not isinstance(error.value, enjoy.CannotDraw)


def test_a_pair_that_was_interrupted_leaves_those_before_it(tmp_path: Path) -> None:
    imageio = pytest.importorskip("imageio.v3")
    for n_plays, shape in ((3, (16, 32, 3)), (4, (16, 32, 3)), (1, (16, 16, 3))):  # the last one has no frame yet
        video = enjoy.SideBySide(tmp_path / f"{n_plays}.gif", fps=10)
        for play in range(n_plays):
            video.begin()
            for brightness in () if play == 3 else (200, 100):
                video.append(np.full((16, 16, 3), brightness, np.uint8))
        video.close()
        assert video.frames == 2 and imageio.imread(video.path).shape == (2, *shape)


def test_enjoy_draws_an_mp4(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                            capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    imageio = pytest.importorskip("imageio")
    pytest.importorskip("imageio_ffmpeg")
    need_a_renderer(ENV, monkeypatch)
    film = tmp_path / "film.mp4"
    enjoy.main([str(run), "--record", str(film), "--answer", "expert", "--device", "cpu"])
    with imageio.get_reader(film) as reader:
        frames = [frame for frame in reader.iter_data()]  # list() would ask for a length, which is infinite
    assert f"{len(frames)} frames" in capsys.readouterr().out
    assert all(frame.shape == (480, 480, 3) and frame.std() > 10 for frame in frames)  # a picture, not a blank


@pytest.mark.parametrize(("env_id", "camera"), [("Hopper-v5", 0), ("InvertedPendulum-v5", -1)])
def test_videos_follow_a_robot_that_has_a_camera_for_it(env_id, camera):
    env = gym.make(env_id, render_mode="rgb_array")
    enjoy.follow(env)
    assert env.unwrapped.mujoco_renderer.camera_id == camera
    env.close()


def test_an_agent_that_reads_a_state_history_plays_without_its_run_folder(tmp_path: Path) -> None:
    env = DelayedObservationWrapper(gym.make(ENV), delay=2, state_history=True)
    planner = {**TINY_PLANNER, "extra_state_probability": 0.5}
    SAID("MultiInputPolicy", env, device="cpu", planner_kwargs=planner).save(tmp_path / "agent.zip")
    run = load_run(str(tmp_path / "agent.zip"), "said", ENV, delay=1)
    assert set(run.make_env().observation_space.spaces) >= {"state_history", "state_known"}
    assert rollout(run.model, run.make_env, 1, seed=0).lengths[0] > 0


def test_who_is_missing_in_the_best_agent_leaves_its_columns_empty(capsys: pytest.CaptureFixture[str]) -> None:
    planner, expert = (evaluate.Summary.from_episodes(who, [1.0, 3.0], [5, 5]) for who in ("planner", "expert"))
    evaluate.print_table([("last", planner), ("last", expert), ("best", expert)])
    _, first, second = capsys.readouterr().out.splitlines()
    assert first.split("   ")[0].split()[0] == "planner" and first.split()[-6:-2] == ["-"] * 4
    assert second.split().count("2.0") == 2 and len(first) == len(second)
