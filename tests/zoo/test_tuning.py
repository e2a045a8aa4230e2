"""Planners of several depths: each trained once, resumed where it died, and put into an agent whose expert stays."""

import functools
import threading
import time
from dataclasses import fields

import pytest
import small_agent
import torch as th

from sb3_said import SAID, PlannerConfig, PlannerTrainingCallback
from sb3_said.files.checkpoint import CHECKPOINT_NAME, TrainingCheckpointCallback
from sb3_said.said import tuning
from sb3_said.zoo.locks import is_held
from sb3_said.zoo.tuning import DepthPlanners

STEPS = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with a trained agent and the checkpoint of its training."""
    folder = tmp_path_factory.mktemp("run")
    model = small_agent.make(seed=3, planner_kwargs={"batch_size": 8}, planner_gradient_steps=STEPS)
    model.learn(80, callback=TrainingCheckpointCallback(folder, 80))
    model.save(folder / "agent.zip")
    return folder


@pytest.fixture
def trainings(monkeypatch):
    """The depths that were trained, in order."""
    depths, train = [], DepthPlanners._train

    def counted(self, depth):
        depths.append(depth)
        train(self, depth)

    monkeypatch.setattr(DepthPlanners, "_train", counted)
    return depths


def make(run, folder, steps=None, **settings):
    model = SAID.load(run / "agent.zip", device="cpu")
    model.set_planner(**settings)
    return DepthPlanners(model, run / CHECKPOINT_NAME, folder, steps)


def same_planner(first, second):
    th.testing.assert_close(
        first.model.policy.planner.state_dict(), second.model.policy.planner.state_dict(), rtol=0, atol=0
    )


def test_each_depth_is_trained_once_and_never_the_runs_own(run, tmp_path, trainings):
    planners = make(run, tmp_path)
    for depth, temperature in ((1, 0.5), (2, 0.5), (1, 0.0), (2, 0.0)):
        planners.put(depth, temperature=temperature)
        config = planners.model.policy.planner.config
        assert (config.depth, config.temperature) == (depth, temperature)
    assert trainings == [2]
    make(run, tmp_path).put(2, temperature=0.5)
    assert trainings == [2]


def test_a_worker_waits_for_the_one_that_trains(run, tmp_path, trainings, capsys):
    make(run, tmp_path / "ready").put(2, temperature=0.5)
    planners = make(run, tmp_path / "shared")
    began = threading.Event()

    def train_elsewhere():
        with planners.lock(2):
            began.set()
            time.sleep(0.5)
            (tmp_path / "ready" / "planner_depth2.zip").rename(planners.path(2))

    threading.Thread(target=train_elsewhere).start()
    assert began.wait(10)
    planners.put(2, temperature=0.5)
    assert trainings == [2]  # the first one
    assert "Another worker trains the planner of depth 2; waiting." in capsys.readouterr().out


def test_a_killed_training_goes_on_bit_for_bit(run, tmp_path, monkeypatch):
    whole = make(run, tmp_path / "whole", 6)
    whole.put(2, temperature=0.5)
    callback = functools.partial(PlannerTrainingCallback, save_interval=2)
    monkeypatch.setattr(tuning, "PlannerTrainingCallback", callback)
    halved = make(run, tmp_path / "halved", 6)
    make_trainer, calls = SAID.make_planner_trainer, []

    def stopping(self, gradient_steps=None):
        trainer = make_trainer(self, gradient_steps)
        step = trainer.step

        def one_step():
            if len(calls) == 3:
                raise KeyboardInterrupt
            calls.append(trainer.n_updates)
            step()

        monkeypatch.setattr(trainer, "step", one_step)
        return trainer

    monkeypatch.setattr(SAID, "make_planner_trainer", stopping)
    with pytest.raises(KeyboardInterrupt):
        halved.put(2, temperature=0.5)
    assert not halved.is_ready(2) and not is_held(halved.lock(2))
    monkeypatch.setattr(SAID, "make_planner_trainer", make_trainer)
    again = make(run, tmp_path / "halved", 6)
    again.put(2, temperature=0.5)
    same_planner(whole, again)
    # The expert is the run's, whatever the planner.
    expert = SAID.load(run / "agent.zip", device="cpu").policy.actor.state_dict()
    th.testing.assert_close(again.model.policy.actor.state_dict(), expert, rtol=0, atol=0)


def test_planners_of_another_training_are_refused(run, tmp_path):
    make(run, tmp_path, 2).put(2, temperature=0.5)
    with pytest.raises(ValueError, match=r"gradient_steps was 2 and is now 4.*delete the file"):
        make(run, tmp_path, 4).put(2, temperature=0.5)


def test_how_a_planner_answers_is_no_matter_of_its_training(run, tmp_path, trainings):
    first = make(run, tmp_path, 2)
    first.put(2, temperature=0.5)
    again = make(run, tmp_path, 2, n_candidates=3, solver="dpmsolver++2m")
    again.put(2, temperature=0.1, sampling_steps=4)
    assert trainings == [2]  # the same weights, other answers
    config = again.model.policy.planner.config
    assert (config.depth, config.temperature, config.n_candidates, config.sampling_steps) == (2, 0.1, 3, 4)
    assert first.training_settings(2) == again.training_settings(2)
    # Returns of other answers cannot be compared.
    differing = first.trial_settings()["config"].items() ^ again.trial_settings()["config"].items()
    assert {name for name, _ in differing} == {"n_candidates", "solver"}


def test_an_agent_with_a_planner_put_in_is_saved_with_it(run, tmp_path):
    planners = make(run, tmp_path, 2)
    for depth, temperature in ((2, 0.3), (3, 0.0), (2, 0.7)):
        planners.put(depth, temperature=temperature)
        planners.model.save(tmp_path / "agent.zip")
        loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
        assert loaded.policy.planner.config == planners.model.policy.planner.config
        assert (loaded.policy.planner.config.depth, loaded.policy.planner.config.temperature) == (depth, temperature)
        assert loaded.planner_kwargs["depth"] == depth and loaded.policy.planner_updates == 2
        th.testing.assert_close(loaded.policy.state_dict(), planners.model.policy.state_dict(), rtol=0, atol=0)


def test_planners_have_the_runs_settings_whatever_the_defaults_are_then(run, tmp_path, monkeypatch):
    expected = make(run, tmp_path / "before")
    expected.put(1, temperature=0.5)
    expected.put(2, temperature=0.5)
    defaults = list(PlannerConfig.__init__.__defaults__)
    names = [field.name for field in fields(PlannerConfig)]
    for name, value in {"embed_known": False, "solver": "dpmsolver++2m"}.items():
        assert defaults[names.index(name)] != value
        defaults[names.index(name)] = value
    monkeypatch.setattr(PlannerConfig.__init__, "__defaults__", tuple(defaults))
    planners = make(run, tmp_path / "after")
    planners.put(1, temperature=0.5)  # the run's own
    planners.put(2, temperature=0.5)  # trained anew
    assert planners.config == expected.config
    assert planners.model.policy.planner.config == expected.model.policy.planner.config
    same_planner(planners, expected)
