"""Planners of several depths: each trained once, resumed where it died, and put into an agent whose expert stays."""

import functools
import signal
import threading
import time
from dataclasses import fields

import pytest

pytest.importorskip("rl_zoo3")

import small_agent
import torch as th
from filelock import FileLock

from sb3_said import SAID, PlannerConfig
from sb3_said.files.checkpoint import CHECKPOINT_NAME, TrainingCheckpointCallback
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.zoo.depths import DepthPlanners

STEPS = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with a trained agent and the checkpoint of its training."""
    folder = tmp_path_factory.mktemp("run")
    model = small_agent.make(seed=3, planner_kwargs={"batch_size": 8}, planner_gradient_steps=STEPS)
    model.learn(80, callback=TrainingCheckpointCallback(folder, 80))
    model.save(folder / "agent.zip")
    return folder


def make(run, folder, steps=None, **settings):
    model = SAID.load(run / "agent.zip", device="cpu")
    model.set_planner(**settings)
    return DepthPlanners(model, run / CHECKPOINT_NAME, folder, steps)


def config_of(planners):
    return planners.model.policy.planner.config


def same_planner(first, second):
    th.testing.assert_close(
        first.model.policy.planner.state_dict(), second.model.policy.planner.state_dict(), rtol=0, atol=0
    )


def trainings(capsys):
    return capsys.readouterr().out.count("Training the planner of depth")


def test_each_depth_is_trained_once_and_never_the_runs_own(run, tmp_path, capsys):
    planners = make(run, tmp_path)
    planners.train([2, 1])
    assert trainings(capsys) == 1
    for depth, temperature in ((1, 0.5), (2, 0.5), (1, 0.0), (2, 0.0)):
        planners.put(depth, temperature=temperature)
        assert (config_of(planners).depth, config_of(planners).temperature) == (depth, temperature)
    own = SAID.load(run / "agent.zip", device="cpu").policy.planner.state_dict()
    planners.put(1)
    th.testing.assert_close(planners.model.policy.planner.state_dict(), own, rtol=0, atol=0)
    make(run, tmp_path).train([1, 2])
    assert trainings(capsys) == 0


def test_a_worker_takes_a_free_depth_and_waits_for_the_one_that_another_trains(run, tmp_path, capsys):
    make(run, tmp_path / "ready").train([2])
    planners = make(run, tmp_path / "shared")
    (tmp_path / "shared").mkdir()
    began = threading.Event()

    def train_elsewhere():
        with FileLock(tmp_path / "shared" / "planner_depth2.lock"):
            began.set()
            while not planners.path(3).exists():
                time.sleep(0.01)
            (tmp_path / "ready" / "planner_depth2.zip").rename(planners.path(2))

    other = threading.Thread(target=train_elsewhere)
    other.start()
    assert began.wait(60)
    planners.train([2, 3])
    other.join()
    out = capsys.readouterr().out
    assert "Another worker trains the planner of depth 2." in out
    assert out.count("Training the planner of depth 2") == 1  # the first one
    assert out.count("Training the planner of depth 3") == 1


def test_a_killed_training_goes_on_bit_for_bit(run, tmp_path, monkeypatch):
    whole = make(run, tmp_path / "whole", 6)
    whole.train([2])
    whole.put(2)
    monkeypatch.setattr(SAID, "train_planner", functools.partialmethod(SAID.train_planner, save_interval=2))
    make_trainer, calls = SAID.make_planner_trainer, []

    def stopping(self, *args):
        trainer = make_trainer(self, *args)
        step = trainer.step

        def one_step():
            if len(calls) == 3:
                raise KeyboardInterrupt
            calls.append(trainer.n_updates)
            step()

        monkeypatch.setattr(trainer, "step", one_step)
        return trainer

    halved = make(run, tmp_path / "halved", 6)
    with monkeypatch.context() as patch:
        patch.setattr(SAID, "make_planner_trainer", stopping)
        with pytest.raises(KeyboardInterrupt):
            halved.train([2])
    assert not halved.path(2).exists()
    again = make(run, tmp_path / "halved", 6)
    again.train([2])
    again.put(2)
    same_planner(whole, again)
    # The expert is the run's, whatever the planner.
    expert = SAID.load(run / "agent.zip", device="cpu").policy.actor.state_dict()
    th.testing.assert_close(again.model.policy.actor.state_dict(), expert, rtol=0, atol=0)


@pytest.fixture
def heard_ctrl_c():
    """A shell lets what it runs in the background ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_keeps_every_update(run, tmp_path, monkeypatch, heard_ctrl_c):
    step, made = PlannerTrainer.step, []

    def counted(trainer, *how):
        result = step(trainer, *how)
        made.append(trainer.n_updates)
        if made == [1, 2]:
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(PlannerTrainer, "step", counted)
    with pytest.raises(KeyboardInterrupt):
        make(run, tmp_path, 5).train([2])
    n_made = len(made)  # the update that was begun is ended
    again = make(run, tmp_path, 5)
    again.train([2])
    assert n_made < 5 and len(made) == 5
    again.put(2)
    whole = make(run, tmp_path / "whole", 5)
    whole.train([2])
    whole.put(2)
    same_planner(whole, again)


def test_planners_of_another_training_are_refused(run, tmp_path):
    make(run, tmp_path, 2).train([2])
    with pytest.raises(ValueError, match=r"gradient_steps was 2 and is now 4.*delete the file"):
        make(run, tmp_path, 4).put(2)


def test_planners_of_another_run_are_refused_whose_settings_are_the_same(run, tmp_path):
    (tmp_path / "other").mkdir()
    model = SAID.load(run / "agent.zip", device="cpu")
    with th.no_grad():
        next(model.policy.actor.parameters()).add_(1e-3)  # as it would be of another task's
    model.save(tmp_path / "other" / "agent.zip")
    make(run, tmp_path, 2).train([2])
    with pytest.raises(ValueError, match=r"agent was \w{8} and is now \w{8}.*into another folder"):
        make(tmp_path / "other", tmp_path, 2).put(2)


def test_a_replay_of_another_step_is_refused(run, tmp_path):
    planners = make(run, tmp_path)
    planners.model.num_timesteps += 1
    with pytest.raises(ValueError, match="finish the run first: sb3-said train --resume"):
        planners.train([2])


def test_how_a_planner_answers_is_no_matter_of_its_training(run, tmp_path, capsys):
    make(run, tmp_path, 2).train([2])
    again = make(run, tmp_path, 2, n_candidates=3, scored_states="all")
    again.train([2])
    again.put(2, temperature=0.1, sampling_steps=4)
    assert trainings(capsys) == 1  # the same weights, other answers
    config = config_of(again)
    assert (config.depth, config.temperature, config.n_candidates, config.sampling_steps) == (2, 0.1, 3, 4)


def test_an_agent_with_a_planner_put_in_is_saved_with_it(run, tmp_path):
    planners = make(run, tmp_path, 2)
    planners.train([2, 3])
    for depth, temperature in ((2, 0.3), (3, 0.0), (2, 0.7)):
        planners.put(depth, temperature=temperature)
        planners.model.save(tmp_path / "agent.zip")
        loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
        assert loaded.policy.planner.config == config_of(planners)
        assert (loaded.policy.planner.config.depth, loaded.policy.planner.config.temperature) == (depth, temperature)
        assert loaded.planner_kwargs["depth"] == depth and loaded.policy.planner_updates == 2
        th.testing.assert_close(loaded.policy.state_dict(), planners.model.policy.state_dict(), rtol=0, atol=0)


def test_a_planner_put_in_answers_whoever_did_before(run, tmp_path):
    planners = make(run, tmp_path, 2)
    policy = planners.model.policy
    policy.make_student(8)
    policy.student.preferred.fill_(1.0)
    policy.expert_preferred.fill_(1.0)
    planners.train([2])
    planners.put(2)
    assert policy.who_answers == "planner"


def test_planners_have_the_runs_settings_whatever_the_defaults_are_then(run, tmp_path, monkeypatch):
    expected = make(run, tmp_path / "before")
    expected.train([1, 2])
    expected.put(2)
    defaults = list(PlannerConfig.__init__.__defaults__)
    names = [field.name for field in fields(PlannerConfig)]
    for name, value in {"embed_known": False, "scored_states": "all"}.items():
        assert defaults[names.index(name)] != value
        defaults[names.index(name)] = value
    monkeypatch.setattr(PlannerConfig.__init__, "__defaults__", tuple(defaults))
    planners = make(run, tmp_path / "after")
    planners.train([1, 2])
    planners.put(2)
    assert config_of(planners) == config_of(expected)
    same_planner(planners, expected)
