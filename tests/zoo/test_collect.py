"""Collecting: a log of the true states, in the shares and noise asked for, that the loader reads back."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

pytest.importorskip("rl_zoo3")

from logged_task import LoggedTask
from scipy.stats import chisquare
from small_run import write_run
from small_task import Drift
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm.auto import tqdm
from trained_run import ENV, train_run

from sb3_said import DelayedObservationWrapper, DelayedSAC
from sb3_said.offline import Dataset, load_dataset
from sb3_said.zoo import collect
from sb3_said.zoo.collect import NoisyAgent, Recorder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("sadr") / f"{ENV}-delay2_1", DelayedSAC, 2, seed=2)


def spaces_of(env_id: str) -> tuple[Any, Any]:
    env = gym.make(env_id)
    return env.observation_space, env.action_space


def load(path: Path | str) -> Dataset:
    return load_dataset(path, *spaces_of(ENV), ENV)


def collected(path: Path | str, *words: str | Path) -> Dataset:
    collect.main([*map(str, words), "-o", str(path), "--device", "cpu", "--n-envs", "3"])
    return load(path)


@pytest.mark.parametrize("action_delay", [0, "UniformDelay(0, 2)"])
def test_the_log_is_what_the_task_was_in_and_given(action_delay: Any) -> None:
    """Observations are up to three steps old, and actions may be executed late; the log shows neither."""
    task, episodes = LoggedTask(), []
    env = Recorder(DelayedObservationWrapper(task, delay=3, action_delay=action_delay), episodes)
    env.action_space.seed(0)
    for seed in range(3):
        env.reset(seed=seed)
        while not env.step(env.action_space.sample())[2]:
            pass
    data = collect.join(episodes)
    assert data.lengths.tolist() == [12] * 3 and data.terminated.sum() == 3
    for i, given in enumerate(task.states):
        rows = slice(12 * i, 12 * (i + 1))
        np.testing.assert_array_equal(np.vstack([data.states[rows], data.finals[i]]), given)
        scaled = (np.array(task.actions[i]) - [0, 4]) / [2, 4]
        np.testing.assert_allclose(data.actions[rows], scaled, atol=1e-6)
        np.testing.assert_allclose(data.rewards[rows], np.array(task.actions[i])[:, 0], atol=1e-6)


def test_shares_are_equal_repeatable_and_cut_where_they_are_full(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (run, "random", "--noise", "0", "0.5", "--steps", "203", "--seed", "5")
    data, again = collected(tmp_path / "a.npz", *words), collected(tmp_path / "b.npz", *words)
    told_of = capsys.readouterr().err
    assert len(data) == 203
    for name in ("states", "actions", "rewards", "terminated", "ends", "finals"):
        np.testing.assert_array_equal(getattr(data, name), getattr(again, name))
    about = json.loads(str(np.load(tmp_path / "a.npz")["about"]))
    told = [(share["agent"], share["noise"]) for share in about["shares"]]
    assert told == [(str(run), 0.0), (str(run), 0.5), ("random", 0.0), ("random", 0.0)]
    # The first share is the agent's own play, episode by episode
    n_first = about["shares"][0]["episodes"]
    assert data.lengths[:n_first].sum() == 203 // 4
    played = collect.load_run(run, device="cpu").play(n_first + 3, 5, 3)
    assert len(set(played.lengths[:n_first])) > 1  # in the order of seeds: short ones end first
    assert data.lengths[: n_first - 1].tolist() == played.lengths[: n_first - 1].tolist()
    np.testing.assert_allclose(data.returns[: n_first - 1], played.returns[: n_first - 1])
    assert data.lengths[n_first - 1] < played.lengths[n_first - 1]  # cut off: its return is no episode's
    assert about["shares"][0]["mean_return"] == pytest.approx(np.mean(played.returns[: n_first - 1]))
    assert f"{n_first} episodes, mean return {np.mean(played.returns[: n_first - 1]):.1f}" in told_of
    with pytest.raises(ValueError, match=rf"a\.npz is of {ENV}, and the task is Pendulum-v1"):
        load_dataset(tmp_path / "a.npz", *spaces_of(ENV), "Pendulum-v1")


def test_an_agent_that_plays_twice_plays_on_and_not_the_same_again(run: Path, tmp_path: Path) -> None:
    words = (run, f"{run}/", "random", "--noise", "0", "0.5", "--steps", "240", "--seed", "5")
    data = collected(tmp_path / "a.npz", *words)
    starts = data.states[np.append(0, np.flatnonzero(data.ends)[:-1] + 1)]
    about = json.loads(str(np.load(tmp_path / "a.npz")["about"]))
    shares = [(share["agent"].rstrip("/"), share["noise"]) for share in about["shares"]]
    first = np.cumsum([0, *(share["episodes"] for share in about["shares"])])
    drawn: dict[Any, list[Any]] = {}
    for share, left, right in zip(shares, first[:-1], first[1:], strict=True):
        drawn.setdefault(share, []).extend(map(tuple, starts[left:right]))
    assert len(drawn) == 3
    for states in drawn.values():
        assert len(set(states)) == len(states)


def test_a_cut_episode_is_no_terminal_and_keeps_the_state_after_it(run: Path, tmp_path: Path) -> None:
    whole = collected(tmp_path / "whole.npz", run, "--steps", "60")
    length = int(whole.lengths[0])
    cut = collected(tmp_path / "cut.npz", run, "--steps", str(length - 1))
    assert cut.ends.tolist() == [False] * (length - 2) + [True] and not cut.terminated.any()
    np.testing.assert_array_equal(cut.finals[0], whole.states[length - 1])
    assert whole.terminated[length - 1]
    assert json.loads(str(np.load(tmp_path / "cut.npz")["about"]))["shares"][0]["mean_return"] is None


def test_an_episode_that_never_ends_is_cut(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(gym.registry, "Endless-v0", gym.envs.registration.EnvSpec("Endless-v0", lambda: Drift(10**9)))
    words = "random", "--env", "Endless-v0", "--steps", "50", "--n-envs", "3", "--device", "cpu"
    collect.main([*words, "-o", str(tmp_path / "endless.npz")])
    data = load_dataset(tmp_path / "endless.npz", Drift.observation_space, Drift.action_space, "Endless-v0")
    assert data.ends.tolist() == [False] * 49 + [True] and not data.terminated.any()


def test_a_place_that_cannot_be_written_is_told_before_any_step(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "play", lambda *_: pytest.fail("a step was taken"))
    with pytest.raises(SystemExit) as stop:
        collect.main([str(run), "-o", str(run / "run.json" / "log.npz")])
    assert stop.value.code == 1


def test_noise_has_the_size_asked_for_in_units_of_the_range() -> None:
    class Still:
        def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
            return np.zeros((len(observation), 2), np.float32), state

    space = gym.spaces.Box(np.float32([-10, -1]), np.float32([10, 1]))
    actions = NoisyAgent(Still(), space, 0.1, 0).predict(np.zeros((5000, 1)))[0]
    np.testing.assert_allclose(actions.std(0), [1.0, 0.1], rtol=0.05)
    loud = NoisyAgent(Still(), space, 5.0, 0).predict(np.zeros((500, 1)))[0]
    assert (np.abs(loud) <= space.high).all() and (np.abs(loud) == space.high).any()
    drawn = NoisyAgent(None, space, 0.0, 0).predict({"observation": np.zeros((5000, 1))})[0]
    np.testing.assert_allclose([drawn.min(0), drawn.max(0)], [space.low, space.high], rtol=0.01)


@pytest.mark.parametrize(("low", "high", "dtype"), [(-3, 3, np.int64), (-100, 100, np.int8), (0, 255, np.uint8)])
def test_whole_numbers_are_drawn_evenly_and_rounded(low: int, high: int, dtype: type) -> None:
    space = gym.spaces.Box(low, high, (1,), dtype)
    drawn = NoisyAgent(None, space, 0.0, 0).predict(np.zeros((100_000, 1)))[0]
    values, counts = np.unique(drawn, return_counts=True)
    assert drawn.dtype == dtype and [*values] == [*range(low, high + 1)]
    assert chisquare(counts).pvalue > 1e-4

    class Between:
        def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
            return np.float32([[2.6], [high + 0.9], [low - 0.9], [low + 0.9]]), state

    assert [*NoisyAgent(Between(), space, 0.0, 0).predict(None)[0][:, 0]] == [3, high, low, low + 1]


def test_random_actions_do_not_follow_what_the_task_draws_from_the_seed() -> None:
    env = gym.make("Pendulum-v1")
    start = np.arctan2(*env.reset(seed=5)[0][1::-1])
    action = NoisyAgent(None, env.action_space, 0.0, 5).predict(np.zeros((1, 3)))[0].item()
    assert abs(action / 2.0 - start / np.pi) > 0.01  # each uniform, and the same number of the same generator


def test_bounds_may_be_farther_apart_than_their_type_holds() -> None:
    space = gym.spaces.Box(np.float32([-3e38]), np.float32([3e38]))
    assert np.isfinite(NoisyAgent(None, space, 0.0, 0).predict(np.zeros((100, 1)))[0]).all()


def test_an_agent_of_sb3_goes_into_minari(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    SAC("MlpPolicy", ENV, buffer_size=10, device="cpu", seed=0).save(tmp_path / "sac.zip")
    words = [str(tmp_path / "sac.zip"), "--algo", "sac", "--env", ENV, "--steps", "50", "--device", "cpu"]
    collect.main([*words, "-o", "mine/pendulum-v0"])
    collect.main([*words, "-o", str(tmp_path / "same.npz")])
    one, other = load("mine/pendulum-v0"), load(tmp_path / "same.npz")
    assert len(one) == 50
    for name in ("states", "actions", "rewards", "terminated", "ends", "finals"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    spec = minari.load_dataset("mine/pendulum-v0").spec
    assert (spec.env_spec.id, spec.env_spec.max_episode_steps) == (ENV, gym.spec(ENV).max_episode_steps)
    assert json.loads(minari.load_dataset("mine/pendulum-v0").storage.metadata["description"])
    capsys.readouterr()
    with pytest.raises(SystemExit):
        collect.main([*words, "-o", "mine/pendulum-v0"])
    assert "mine/pendulum-v0" in (told := capsys.readouterr().err) and "there already" in told


@pytest.mark.parametrize("place", ["vecnormalize.pkl", f"{ENV}/vecnormalize.pkl", None])
def test_an_agent_of_sb3_sees_what_vec_normalize_showed_it(
    place: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ENV)]))
    model = SAC("MlpPolicy", env, buffer_size=100, learning_starts=60, device="cpu", seed=0).learn(60)
    model.save(tmp_path / "sac.zip")
    if place is not None:
        (tmp_path / place).parent.mkdir(exist_ok=True)
        env.save(str(tmp_path / place))
    words = (tmp_path / "sac.zip", "--algo", "sac", "--env", ENV, "--steps", "30")
    data = collected(tmp_path / "log.npz", *words)
    seen = data.states if place is None else env.normalize_obs(data.states)
    expected = model.policy.scale_action(model.predict(seen, deterministic=True)[0])
    np.testing.assert_allclose(data.actions, expected, atol=1e-4)
    said = "as they are; no vecnormalize.pkl" if place is None else f"normalised by {tmp_path / place}"
    assert said in capsys.readouterr().err


@pytest.fixture
def own_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A package that registers a task when it is imported."""
    lines = "import gymnasium as gym", f"gym.register('Own-v0', entry_point=lambda: gym.make('{ENV}').unwrapped)"
    (tmp_path / "own_package.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "own_package"
    gym.registry.pop("Own-v0", None)
    sys.modules.pop("own_package", None)


@pytest.mark.parametrize("is_named", [True, False])
def test_a_task_that_is_registered_with_code_goes_into_minari(
    is_named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setitem(gym.registry, "Own-v0", EnvSpec("Own-v0", Drift if is_named else lambda: Drift()))
    words = ["random", "--env", "Own-v0", "--steps", "40", "-o", "mine/own-v0"]
    with nullcontext() if is_named else pytest.warns(UserWarning, match="mine/own-v0 will not say its task: Callable"):
        collect.main(words)
    spec = minari.load_dataset("mine/own-v0").spec.env_spec
    assert (spec and spec.entry_point) == ("small_task:Drift" if is_named else None)
    assert len(load_dataset("mine/own-v0", Drift.observation_space, Drift.action_space)) == 40


def test_a_folder_of_minari_without_data_is_in_the_way(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (tmp_path / "mine" / "log-v0" / "data").mkdir(parents=True)
    monkeypatch.setattr(collect, "play", lambda *_: pytest.fail("it plays first"))
    with pytest.raises(SystemExit):
        collect.main([str(run), "-o", "mine/log-v0"])
    assert f"{tmp_path / 'mine' / 'log-v0'} is there already" in capsys.readouterr().err


def test_a_bar_that_is_not_shown_ends_it_too(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``TQDM_DISABLE=1`` makes one that counts nothing."""
    monkeypatch.setattr(collect, "tqdm", lambda **given: tqdm(**{**given, "disable": True}))
    assert len(collected(tmp_path / "log.npz", run, "random", "--steps", "30")) == 30


def test_a_changed_task_is_said(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    changed = train_run(tmp_path, "sadr", options=["--env-kwargs", "reset_noise_scale:0.2"])
    for target in (tmp_path / "a.npz", *(["mine/changed-v0"] if find_spec("minari") else [])):
        with pytest.warns(UserWarning, match=rf'{target} is of a task changed by {{"env_kwargs": .*: learn for one'):
            collected(target, changed, "random", "--steps", "20")
    about = json.loads(str(np.load(tmp_path / "a.npz")["about"]))
    assert about["changes"] == {"env_kwargs": {"reset_noise_scale": 0.2}}
    assert f'of {ENV} changed by {{"env_kwargs": {{"reset_noise_scale": 0.2}}}}' in capsys.readouterr().out
    with pytest.raises(SystemExit):
        collected(tmp_path / "b.npz", changed, run, "--steps", "20")
    assert "the agents change theirs differently" in capsys.readouterr().err
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*changed")
        collected(tmp_path / "c.npz", run, "--steps", "20")
    assert "changed by" not in capsys.readouterr().out


@pytest.mark.parametrize("agent", ["random", "sac.zip --algo sac"])
def test_a_task_of_a_package_is_found(agent: str, own_task: str, tmp_path: Path) -> None:
    SAC("MlpPolicy", ENV, buffer_size=10, device="cpu", seed=0).save(tmp_path / "sac.zip")
    player = agent.replace("sac.zip", str(tmp_path / "sac.zip")).split()
    words = *player, "--env", "Own-v0", "--gym-packages", own_task, "--steps", "20"
    collect.main([*words, "-o", str(tmp_path / "own.npz"), "--device", "cpu"])
    assert len(load_dataset(tmp_path / "own.npz", *spaces_of(ENV), "Own-v0")) == 20


@pytest.mark.parametrize("words", ["random", "{tmp}/sac.zip --algo sac", "{run}"])
def test_a_task_that_is_not_registered_is_said(
    words: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SAC("MlpPolicy", ENV, buffer_size=10, device="cpu", seed=0).save(tmp_path / "sac.zip")
    with pytest.raises(SystemExit) as stop:
        collect.main(f"{words} --env Nope-v0 -o {{tmp}}/x.npz".format(run=run, tmp=tmp_path).split())
    assert stop.value.code == 2
    assert "Environment `Nope` doesn't exist" in (shown := capsys.readouterr().err) and "--gym-packages" in shown


def test_a_normalisation_of_another_task_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    SAC("MlpPolicy", ENV, buffer_size=10, device="cpu", seed=0).save(tmp_path / "sac.zip")
    VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])).save(str(tmp_path / "vecnormalize.pkl"))
    with pytest.raises(SystemExit):
        collect.main(f"{tmp_path}/sac.zip --algo sac --env {ENV} -o {tmp_path}/x.npz".split())
    assert "vecnormalize.pkl cannot be opened, or is of another task" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{run} -o {tmp}/x.hdf5", "written as .npz or into Minari"),
        ("{run} -o hopper/mine", "ends in its version: hopper/mine-v0"),
        ("{run} -o {run}/there.npz", "is there already"),
        ("{run} -o {tmp}/x.npz --noise -1", "--noise is a standard deviation"),
        ("{run} -o {tmp}/x.npz --noise 0 inf", "--noise is a standard deviation, 0 or more, got inf"),
        ("{run} -o {tmp}/x.npz --noise nan", "--noise is a standard deviation"),
        ("{run} -o {tmp}/x.npz --steps 0", "--steps must be at least 1"),
        ("{run} random -o {tmp}/x.npz --steps 1", "fewer than there are shares, 2"),
        ("random -o {tmp}/x.npz", "of no task: give --env"),
        (f"random --env {ENV} --delay 3 --stochastic -o {{tmp}}/x.npz", "--delay, --stochastic: for random actions"),
        (f"random --env {ENV} --algo sac --noise 0 1 -o {{tmp}}/x.npz", "--algo, --noise: for random actions alone"),
        (f"{{tmp}}/sac.zip --algo td3 --env {ENV} -o {{tmp}}/x.npz", "cannot be opened as an agent of --algo td3"),
        (f"{{tmp}}/sac.zip --algo ppo --env {ENV} -o {{tmp}}/x.npz", "cannot be opened as an agent of --algo ppo"),
        ("nowhere -o {tmp}/x.npz", "nowhere does not exist"),
    ],
)
def test_says_what_is_wrong(
    words: str, message: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "there.npz").touch()
    SAC("MlpPolicy", ENV, buffer_size=10, device="cpu", seed=0).save(tmp_path / "sac.zip")
    with pytest.raises(SystemExit) as stop:
        collect.main(words.format(run=run, tmp=tmp_path).split())
    assert stop.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("name", ["hop.per/x-v0", "h/x-v0", "-v0"])
def test_no_id_of_minari_is_played_for(
    name: str, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("minari")
    monkeypatch.setattr(collect, "play", lambda *_: pytest.fail("it plays first"))
    with pytest.raises(SystemExit):
        collect.main([str(run), f"--output={name}"])
    assert f"{name!r} is no id of a Minari dataset, such as hopper/mine-v0" in capsys.readouterr().err


def test_random_actions_need_a_task_alone(tmp_path: Path) -> None:
    data = collected(tmp_path / "random.npz", "random", "--env", ENV, "--steps", "300")
    assert np.abs(data.actions.mean()) < 0.15 and 0.5 < data.actions.std() < 0.65  # uniform: 0 and 0.577
