"""benchmarks/what_diffusion_buys.py: every row is played by whom it names, and nothing is played twice."""

import copy
import json
import shutil
from argparse import Namespace
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th

pytest.importorskip("rl_zoo3")

import distillation
import what_diffusion_buys as script
import where_it_is_lost
from small_run import ENV, TINY_PLANNER, write_run

from sb3_said import SAID, DelayedObservationWrapper
from sb3_said.evaluation import rollout
from sb3_said.files.archive import save_tree
from sb3_said.files.checkpoint import training_state
from sb3_said.zoo.record import Record


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a run that was stopped before its planner was trained, as a checkpoint leaves it."""
    folder = tmp_path_factory.mktemp("runs") / f"{ENV}-delay0-2-seed0_1"
    env = DelayedObservationWrapper(gym.make(ENV), (0, 2))
    kwargs = {"learning_starts": 80, "buffer_size": 500, "planner_kwargs": TINY_PLANNER, "planner_gradient_steps": 1}
    model = SAID("MlpPolicy", env, seed=0, device="cpu", planner_trial_episodes=0, **kwargs).learn(90)
    model.policy.planner_updates.zero_()
    save_tree(folder / "checkpoint.zip", training_state(model))
    model.num_timesteps = 60
    with th.no_grad():
        model.actor.mu.bias.fill_(1.0)
    model.save(folder / "expert" / "best_model.zip")
    Record("said", ENV, 0, [0, 2]).write(folder)
    return folder


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Return a run of another seed that has ended."""
    folder = tmp_path_factory.mktemp("runs") / "ended"
    return write_run(folder, SAID, (0, 2), 90, seed=1, checkpoint=True, learning_starts=80)


def test_rows_are_played_by_whom_they_name(run, tmp_path, monkeypatch, capsys):
    file = tmp_path / "rows.json"
    words = [str(run), "--updates", "3", "--delays", "0", "2", "--episodes", "2", "--json", str(file)]
    tiny = script.PlannerConfig.paper
    monkeypatch.setattr(script.PlannerConfig, "paper", lambda **kw: tiny(**(TINY_PLANNER | {"n_candidates": 2} | kw)))
    trained = []
    original = script.train
    monkeypatch.setattr(script, "train", lambda *args: trained.append(args[-1]) or original(*args))
    document = script.main([*words, "--seeds", "1", "2"])
    out = capsys.readouterr().out
    returns = document["returns"]
    assert trained == [1, 1, 2, 2] and json.loads(file.read_text()) == document
    assert set(returns) == {"expert, last/None", "expert, average/None", "together/None"} | {
        f"{row}/{seed}" for row in (*script.LEARNED, *script.PAPER) for seed in (1, 2)
    }
    assert all(len(returns[key][delay]) == 2 for key in returns for delay in ("0", "2"))
    assert all(f"| {row} | " in out for row in script.ROWS)

    model = script.open_run(run)
    make = lambda: DelayedObservationWrapper(gym.make(ENV), 2, max_delay=2)  # noqa: E731
    average = rollout(model, make, 2, 10_000, 20).returns
    with model.policy.without_average():
        last = rollout(model, make, 2, 10_000, 20).returns
    assert returns["expert, average/None"]["2"] == average.tolist()
    assert returns["expert, last/None"]["2"] == last.tolist()

    script.main([*words, "--seeds", "1"])
    assert trained == [1, 1, 2, 2]  # all known

    assert model.policy.values is None
    script.train(model, replace(model.policy.planner.config, **script.WAYS["default"]), 3, 1)
    for row in ("chosen by Q", "chosen by V"):
        if row == "chosen by V":
            script.learn_values(model, 3)
        model.set_planner(**script.SETTINGS[row])
        with model.policy.answering("planner"):
            th.manual_seed(1)
            played = rollout(script.AllAtOnce(model), make, 2, 10_000, 20)
            assert played.returns.tolist() == returns[f"{row}/1"]["2"]


def test_together_planners_answer_their_mean(run):
    model = script.open_run(run)
    planners = []
    for seed in (1, 2):
        script.train(model, model.policy.planner.config, 2, seed)
        planners.append(copy.deepcopy(model.policy.planner))
    observation = {"observation": np.full((3, 4), 0.01, np.float32), "action_history": np.zeros((3, 2, 1), np.float32)}
    observation["delay"] = np.array([[0.0], [1.0], [2.0]], np.float32)
    with model.policy.answering("planner"):
        answer, _ = script.Together(model, planners).predict(observation)
        alone = []
        for planner in planners:
            model.policy.planner = planner
            alone.append(model.predict(observation)[0])
    np.testing.assert_allclose(answer, (alone[0] + alone[1]) / 2, rtol=1e-6)
    assert np.abs(alone[0] - alone[1]).max() > 1e-4


def test_other_settings_of_the_planner_need_another_file(run, tmp_path, monkeypatch, capsys):
    original, trained = script.train, []
    monkeypatch.setattr(script, "train", lambda *args: trained.append(args[1]) or original(*args))
    words = [str(run), "--updates", "3", "--delays", "2", "--episodes", "1", "--seeds", "1", "--rows", "one step"]
    words += ["--json", str(tmp_path / "other.json")]
    script.main(words)
    with pytest.raises(SystemExit):
        script.main([*words, "--planner-kwargs", "end_time_probability=1.0"])
    error = capsys.readouterr().err
    assert "holds results of {'planner_end_time_probability': 0.25}, but" in error
    other = [
        *words[:-1],
        str(tmp_path / "one_step.json"),
        "--planner-kwargs",
        "horizon=3,decision_weight=1.0,lr_schedule=constant",
    ]
    found = script.main(other)
    assert (found["planner_horizon"], found["planner_lr_schedule"], found["eval_seed"]) == (3, "constant", 10_000)
    assert trained[1] == replace(trained[0], horizon=3, decision_weight=1.0, lr_schedule="constant")
    with pytest.raises(SystemExit):
        script.main([*other[:-1], "horizon"])
    assert "--planner-kwargs takes NAME=VALUE" in capsys.readouterr().err


def test_another_agent_needs_another_file(run, ended, tmp_path, capsys):
    words = ["--updates", "3", "--delays", "2", "--episodes", "1", "--rows", "expert, average"]
    words += ["--json", str(tmp_path / "rows.json")]
    script.main([str(run), *words])
    with pytest.raises(SystemExit):
        script.main([str(ended), *words])
    assert "holds results of {'actor':" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changed",
    [
        {"env_kwargs": {"reset_noise_scale": 0.1}},
        {"hyperparams": {"env_wrapper": {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 50}}}},
    ],
)
def test_a_task_that_is_not_made_here_is_refused(changed, ended, tmp_path):
    run = shutil.copytree(ended, tmp_path / "run")
    assert script.open_run(run).num_timesteps == 90
    (run / "a-v5.normalize.zip").touch()  # is no agent
    replace(Record.read(run), **changed).write(run)
    with pytest.raises(SystemExit, match="env_kwargs or env_wrapper, which is not made here"):
        script.load_agent(next(run.glob("*-v*[0-9].zip")))


def test_of_a_run_that_has_not_ended_the_checkpoint_counts(run):
    model = script.open_run(run)
    assert model.num_timesteps == 90 and model.replay_buffer.size() == 90 and model.actor.mu.bias.item() != 1.0


def test_the_plain_network_reads_what_the_planner_reads(run):
    model = script.open_run(run)
    trainer = script.train(model, model.policy.planner.config, 2, 1)
    regression = script.Regression(trainer, model)
    source = model.replay_buffer.window_source()
    windows = source.gather(th.arange(20), 3)
    for delay in range(3):
        ages = th.full((20,), delay)
        history = th.nn.functional.pad(windows.actions[:, :delay], (0, 0, 2 - delay, 0))
        present, action = regression.ask(windows.states[:, 0], history, ages)
        normalizer = trainer.average.normalizer
        expected = trainer.yardstick(normalizer.normalize_states(windows.states[:, 0]), windows.actions, ages)
        th.testing.assert_close(present, normalizer.denormalize_states(expected[0]))
        th.testing.assert_close(action, expected[1].clamp(-1, 1))
    observation = {"observation": np.zeros((1, 4), np.float32), "action_history": np.zeros((1, 2, 1), np.float32)}
    answer, _ = regression.predict(observation | {"delay": np.ones((1, 1), np.float32)})
    assert answer.shape == (1, 1) and np.abs(answer).max() <= model.action_space.high.max()


def test_the_preset_is_the_first_planners_whichever_the_trial_took():
    env = DelayedObservationWrapper(gym.make(ENV), (0, 2))
    model = SAID("MlpPolicy", env, planner_kwargs={"d_model": 32, "depth": 1}, buffer_size=500, device="cpu")
    preset = model.policy.planner.config
    second = replace(preset, mask="own", present="inpainted", sampling_steps=1)
    model.policy.take_planner(model.policy.new_planner(second), second)
    assert script.preset_of(model, Namespace(planner_kwargs={})) == preset
    other = script.preset_of(model, Namespace(planner_kwargs={"present": "inpainted"}))
    assert other == replace(preset, present="inpainted")


@pytest.mark.parametrize("main", [script.main, distillation.main, where_it_is_lost.main])
def test_a_wrong_path_is_no_traceback(main, tmp_path, capsys):
    data = ["--dataset", "log.npz"] if main is where_it_is_lost.main else []
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path / "nowhere"), *data, "--json", str(tmp_path / "rows.json")])
    assert stop.value.code == 2 and "nowhere" in capsys.readouterr().err
