"""The ways to decide that a trial compares: whose are taken, and which are refused."""

import pytest
from small_agent import make
from small_task import delayed, pendulum

from sb3_said import SAID
from sb3_said.said import trial
from sb3_said.said.ways import WAYS


def test_ways_that_are_given_are_checked_and_settings_of_the_users_own_are_kept(tmp_path):
    tiny = {"planner_kwargs": {"depth": 1, "d_model": 32}, "buffer_size": 100, "device": "cpu"}
    by_default = {name: {"mask": "random", "present": "guessed", **way} for name, way in WAYS.items()}
    assert SAID("MlpPolicy", delayed(), **tiny).planner_ways == by_default
    blind = SAID("MlpPolicy", delayed(), **{**tiny, "planner_kwargs": {"d_model": 32, "first_guess": "none"}})
    assert [*blind.planner_ways] == ["weighed", "default", "one_step", "own_ages"]
    ahead = SAID("MlpPolicy", delayed(), **{**tiny, "planner_kwargs": {"d_model": 32, "mask": "none"}})
    assert [*ahead.planner_ways] == ["weighed", "actor", "default", "one_step"]  # it knows nothing but presents
    assert make().planner_ways == {}  # it has a temperature
    SAID("MlpPolicy", delayed(), **tiny).save(tmp_path / "said")
    assert SAID.load(tmp_path / "said").planner_ways == by_default
    assert SAID.load(tmp_path / "said", planner_kwargs={"decision_weight": 2.0}).planner_ways == by_default
    assert SAID.load(tmp_path / "said", planner_kwargs={"temperature": 0.5}).planner_ways == {}
    own = {"own": {"sampling_steps": 3}}
    assert SAID.load(tmp_path / "said", planner_kwargs={"temperature": 0.5}, planner_ways=own).planner_ways == own
    assert make(planner_ways={}).planner_ways == {}
    two = make(planner_ways={**own, "second": {"mask": "own", "present": "inpainted"}}).planner_ways
    assert two["own"] == {"mask": "random", "present": "guessed", "sampling_steps": 3}  # also once the second is taken
    for wrong in ({"x": {"depth": 4}}, {"expert": {"temperature": 0.1}}, {"x": {"temperature": -1.0}}):
        with pytest.raises(ValueError, match=r"depth|expert|temperature"):
            make(planner_ways=wrong)
    long = "one_step_weighed_by_critics_"  # two of these would be one row of SB3's log
    with pytest.raises(ValueError, match="at most 25 letters"):
        make(planner_ways={long + "a": {"sampling_steps": 1}, long + "b": {"sampling_steps": 2}})


@pytest.mark.parametrize(
    ("way", "kwargs", "message"),
    [
        ({"decided_by": "actor"}, {"planner_kwargs": {"first_guess": "none"}}, "present='inpainted'"),
        ({"present": "inpainted"}, {"planner_kwargs": {"mask": "none"}}, "mask"),
        ({"scored_states": "decision"}, {"value": "iql"}, "scored_states='decision'"),
    ],
)
def test_a_way_that_the_agent_cannot_have_is_refused_before_anything_is_learned(way, kwargs, message):
    assert make(planner_ways={"x": way}).planner_ways == {"x": way}
    with pytest.raises(ValueError, match=message):
        make(planner_ways={"x": way}, **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "ways", "delay"),
    [
        ({"present": "inpainted"}, {"a": {"decided_by": "actor"}, "b": {"mask": "own"}}, (0, 2)),
        ({"mask": "own", "present": "inpainted"}, {"b": {"mask": "none"}}, (0, 2)),
        ({}, {"b": {"mask": "fixed"}}, 2),
    ],
)
def test_ways_of_several_planners_that_are_taken_are_trained_tried_and_loaded(kwargs, ways, delay, tmp_path):
    """Also where one contradicts the planner's own present."""
    model = make(pendulum(5, delay), planner_kwargs=kwargs, planner_ways=ways, planner_trial_episodes=1).learn(25)
    model.save(tmp_path / "agent.zip")
    assert SAID.load(tmp_path / "agent.zip", device="cpu").planner_ways == model.planner_ways
    assert {*model.planner_ways} == {*ways} and {*model.planner_ways["b"]} == {"mask", "present"}


@pytest.mark.parametrize("settings", [{"present": "inpainted"}, {"decided_by": "actor"}, {"temperature": 0.0}])
def test_a_decision_of_one_s_own_is_kept_in_a_file_and_tried_against_all_ways(settings, tmp_path):
    """Some ways say otherwise of who decides, and where."""
    ways = {**WAYS, "inpainted": {"present": "inpainted"}}
    model = make(env=pendulum(5, (0, 2)), planner_ways=ways, planner_gradient_steps=1).learn(25)
    model.set_planner(**settings)
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", env=pendulum(5, (0, 2)), device="cpu")
    assert loaded.policy.planner.config == model.policy.planner.config
    assert loaded.planner_ways == {name: {"mask": "random", "present": "guessed", **way} for name, way in ways.items()}
    model.train_planner(trial_episodes=1)
    assert set(trial.play_trial(model, 1).returns) >= {"planner", "expert"}


def test_a_planner_that_knows_nothing_but_presents_is_tried_without_delay():
    """None of its ways has a twin that inpaints the present, which it cannot."""
    ways = {"own": {"sampling_steps": 1}}
    model = make(pendulum(delay=0), planner_kwargs={"mask": "none"}, planner_ways=ways).learn(25)
    assert {*trial.play_trial(model, 1).returns} == {"planner", "own", "expert"}
