"""benchmarks/where_it_is_lost.py: each row replaces what it names, and nothing else."""

import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

pytest.importorskip("rl_zoo3")

import where_it_is_lost as script
from small_run import ENV, TINY_PLANNER, write_run
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.evaluation import rollout
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.offline import load_dataset
from sb3_said.zoo import collect
from sb3_said.zoo.runs import load_run


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A planner that can be told states, an actor without delay, and a log."""
    folder = tmp_path_factory.mktemp("lost")
    kwargs = {"planner_kwargs": TINY_PLANNER | {"extra_state_probability": 0.5}, "planner_gradient_steps": 10}
    said = write_run(folder / "said-v0", SAID, (0, 2), **kwargs)
    actor = write_run(folder / "actor-v0", DelayedSAC, 0)
    collect.main([str(said), "--steps", "80", "--n-envs", "1", "-o", str(folder / "log.npz"), "--device", "cpu"])
    return said, actor, folder / "log.npz"


@pytest.fixture(scope="module")
def log(files):
    task = gym.make(ENV)
    return load_dataset(files[2], task.observation_space, task.action_space, ENV)


def make_env(delay):
    return script.ShowPresents(DelayedObservationWrapper(gym.make(ENV), delay, max_delay=2))


def test_rows_of_a_run(files, tmp_path, capsys):
    said, actor, log = files
    file = tmp_path / "lost.json"
    words = [str(said), "--dataset", str(log), "--actor", str(actor), "--json", str(file), "--episodes", "2"]
    found = script.main([*words, "--delays", "0", "2"])
    assert json.loads(file.read_text()) == found and found["data_distance"] > 0
    now, later = (found["delays"][d] for d in ("0", "2"))
    assert {"SAID", "true states since", "actor, true present", "2 held", "4 held"} < set(now) and set(now) == set(
        later
    )
    same = [now[name]["returns"] for name in ("SAID", "decoded present, age 0", "true present, age 0")]
    assert same[0] == same[1] == same[2]  # without delay the present is known
    assert now["SAID"]["present_error"] < 1e-5 < later["SAID"]["present_error"]
    off = [now[f"actor, present off by {x}"]["distance"] for x in script.OFF_BY]
    assert len({*off, now["actor, true present"]["distance"]}) == 5
    model = load_run(said, device="cpu").model
    with model.policy.answering("planner"):
        played = rollout(model, lambda: DelayedObservationWrapper(gym.make(ENV), 2, max_delay=2), 2, 10_000, 2)
    assert later["SAID"]["returns"] == played.returns.tolist()
    shown = capsys.readouterr()
    assert "| true present, age 0 | " in shown.out and "2 held plays 2 episodes at delay 2" in shown.err
    assert script.main([*words, "--delays", "0", "2"]) == found
    assert {"command", "date", "machine", "versions"} < set(found["origin"])
    settings = {"dataset": [str(log)], "actor": str(actor), "episodes": 2, "eval_seed": 10_000, "seed": 0}
    settings |= {"run": str(said), "trained_steps": 60}
    assert found.keys() == settings.keys() | {"delays", "data_distance", "origin"}
    assert {name: found[name] for name in settings} == settings
    with pytest.raises(SystemExit):  # rows of other episodes must not stand beside these
        script.main([*words, "--eval-seed", "5"])
    told = "holds results of {'eval_seed': 10000}, but {'eval_seed': 5} was asked for"
    assert told in capsys.readouterr().err and json.loads(file.read_text()) == found


def test_true_states_are_shown_oldest_first(files):
    env = make_env(2)
    env.action_space.seed(0)  # by which it does not fall in so few steps
    observation, info = env.reset(seed=0)
    states = [info[script.UNDELAYED]] * 3
    np.testing.assert_array_equal(observation[script.PRESENTS], np.array(states, np.float32))
    for _ in range(4):
        observation, *_, info = env.step(env.action_space.sample())
        states.append(info[script.UNDELAYED])
        np.testing.assert_array_equal(observation[script.PRESENTS], np.array(states[-3:], np.float32))
    np.testing.assert_array_equal(observation["observation"], observation[script.PRESENTS][0])


def test_neighbours_are_the_nearest(log):
    data = script.Neighbours(log)
    states = th.as_tensor(log.states) + 0.01 * th.randn(log.states.shape, generator=th.Generator().manual_seed(0))
    distance, row = data.nearest(states)
    apart = (((states[:, None] - th.as_tensor(log.states)) / data.scale) ** 2).mean(2).sqrt()  # (M, M)
    th.testing.assert_close(distance, apart.amin(1), rtol=1e-3, atol=1e-4)
    th.testing.assert_close(apart.gather(1, row[:, None])[:, 0], apart.amin(1), rtol=1e-3, atol=1e-4)
    others = data.nearest(states, data.trajectory)[1]
    assert (data.trajectory[others] != data.trajectory).all()


def test_a_held_plan_is_executed_in_its_order(files, log):
    model = load_run(files[0], device="cpu").model
    player = script.Held(model, 2, script.Neighbours(log))
    env, plans = make_env(1), []
    observation = env.reset(seed=3)[0]
    for k in range(4):
        batch = {key: np.asarray(value)[None] for key, value in observation.items()}
        if k % 2 == 0:
            plans.append((script.Step(model, batch).plan.actions[0, 0], int(observation["delay"][0])))
        action = player.predict(batch)[0][0]
        actions, now = plans[-1]
        np.testing.assert_allclose(action, model.policy.unscale_action(actions[now + k % 2].numpy()), rtol=1e-5)
        observation = env.step(action)[0]


def test_an_agent_that_reads_other_states_is_refused(files, tmp_path):
    said, actor, log = files
    shutil.copytree(actor, tmp_path / "actor-v0")
    env = DummyVecEnv([lambda: DelayedObservationWrapper(gym.make(ENV), 0)])
    statistics = VecNormalize(env, norm_obs_keys=["observation"])
    file = tmp_path / "actor-v0" / f"{ENV}.zip"
    (agent := DelayedSAC.load(file, device="cpu")).reads_normalized = True
    agent.save(file)
    save_normalization(normalization_file(file), statistics)
    words = "--dataset", str(log), "--json", str(tmp_path / "lost.json"), "--actor", str(tmp_path / "actor-v0")
    with pytest.raises(SystemExit, match="actor-v0 was trained under VecNormalize, which is not applied here"):
        script.main([str(said), *words])


def test_an_expert_alone_is_no_planner(files, tmp_path, capsys):
    with pytest.raises(SystemExit):
        script.main([str(files[1]), "--dataset", str(files[2]), "--json", str(Path(tmp_path) / "lost.json")])
    assert "is a DelayedSAC; give a SAID agent" in capsys.readouterr().err
