"""After a trial the better one answers, in its best way, also from a file."""

import csv
import warnings

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from small_agent import answer, make, observe
from small_task import delayed, pendulum
from stable_baselines3.common.logger import configure

from sb3_said import SAID, DelayedObservationWrapper
from sb3_said.said import trial
from sb3_said.said.ways import WAYS


def rigged(monkeypatch, planner, expert):
    played = trial.Trial({"planner": np.array(planner), "expert": np.array(expert)}, np.full(len(expert), 2.0), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *_: played)


def test_who_was_given_up_is_not_chosen(monkeypatch):
    played = {"a": np.array([9.0]), "planner": np.array([1.0, 2.0]), "b": np.array([3.0, 4.0]), "expert": np.zeros(2)}
    monkeypatch.setattr(trial, "play_trial", lambda *_: trial.Trial(played, np.full(2, 2.0), 7))
    ways = {"a": {"sampling_steps": 1}, "b": {"sampling_steps": 4}}
    model = make(planner_trial_episodes=2, planner_ways=ways).learn(25)
    assert model.policy.who_answers == "planner" and model.policy.planner.config.sampling_steps == 4


@pytest.mark.parametrize(("means", "answers"), [((1, 2, 3, 0), "planner"), ((3, 2, 1, 4), "expert")])
def test_the_planner_decides_in_its_best_way_whoever_answers(means, answers, monkeypatch, tmp_path):
    played = {name: np.full(2, mean) for name, mean in zip(("planner", "a", "b", "expert"), means, strict=True)}
    monkeypatch.setattr(trial, "play_trial", lambda *_: trial.Trial(played, np.full(2, 2.0), 7))
    ways = {"a": {"temperature": 0.5}, "b": {"temperature": 1.0, "choice_factor": 2.0}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = make(planner_trial_episodes=2, planner_ways=ways)
        model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
        model.learn(25)
    assert model.policy.who_answers == answers
    config = model.policy.planner.config
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    assert rows[-1]["trial/way"] == ("b" if answers == "planner" else "planner")
    assert (config.temperature, config.choice_factor) == ((1.0, 2.0) if answers == "planner" else (0.5, None))
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.planner.config == config and loaded.planner_ways == ways


def test_of_ways_that_the_trial_cannot_tell_apart_the_first_is_taken(monkeypatch):
    """The last is the best by less than the error of that over b, and by more than that over a."""
    base, gain = np.array([10.0, -7.0, 3.0, 3.0]), np.array([0.0, 2.0, 0.0, 2.0])  # error 0.577, as below
    played = {"planner": base - 9.0, "a": base - 0.6, "b": base + 0.5, "c": base + gain, "expert": base - 9.0}
    ways, chosen = {name: {"n_candidates": n} for n, name in enumerate("abc", 5)}, []
    for order in ("abc", "acb"):
        returns = {name: played[name] for name in (*order, "planner", "expert")}  # as `play_trial` has them
        monkeypatch.setattr(trial, "play_trial", lambda *_, given=returns: trial.Trial(given, np.full(4, 2.0), 7))
        model = make(planner_trial_episodes=2, planner_ways={name: ways[name] for name in order})
        chosen.append(model.learn(25).planner_kwargs)
    assert [settings["n_candidates"] for settings in chosen] == [6, 7]


@given(st.lists(st.tuples(*[st.integers(-50, 50)] * 2, st.integers(0, 6)), min_size=1, max_size=8))
@example([(0, 0, 0), (0, 1, 1)])  # level at one age
def test_the_best_share_is_that_of_all(rows):
    planner, expert, ages = np.array(rows, float).T
    mean, cut, is_below = trial.best_share(planner, expert, ages)
    every = [
        np.where((ages <= age) == below, expert, planner).mean() for age in range(-1, 7) for below in (True, False)
    ]
    assert mean == pytest.approx(max(every))
    assert np.where((ages <= cut) == is_below, expert, planner).mean() == pytest.approx(mean)
    apart = [(age, below) for age in range(int(ages.min()), int(ages.max())) for below in (True, False)]
    others = [np.where((ages <= age) == below, expert, planner) for age, below in apart]
    best_alone = max(planner.mean(), max((x.mean() for x in others), default=-np.inf))
    assert np.isinf(cut) == (expert.mean() > best_alone + 1e-12)


def test_ties_are_broken_in_the_same_order_again_and_again():
    """Drift pays everyone alike. A way that the agent decides in already stands where it stood."""
    model = make(delayed(length=5), planner_trial_episodes=2, planner_ways=WAYS, planner_gradient_steps=1).learn(25)
    for _ in range(2):
        config = model.policy.planner.config
        assert (config.temperature, config.sampling_steps, config.choice_factor) == (1.0, 2, 1.0)  # "weighed"
        model.train_planner()
    model.planner_ways = {"own": {"temperature": 1.0}, "other": {"temperature": 0.0}}
    model.train_planner()
    assert model.policy.planner.config.temperature == 1.0
    model.planner_ways = {"other": {"temperature": 0.0}, "own": {"temperature": 1.0}}
    model.train_planner()
    assert model.policy.planner.config.temperature == 0.0


def test_both_answer_only_where_that_gains_more_than_its_error():
    """The paired differences' mean has to exceed their standard error."""
    base = np.array([10.0, -7.0, 3.0, 3.0])
    gain = np.array([0.0, 2.0, 0.0, 2.0])  # standard deviation sqrt(4 / 3), of the mean half of it: 0.577
    gains = trial.gains_more_than_its_error
    assert gains(base + gain - 0.4, base) and not gains(base + gain - 0.45, base)
    assert not gains(base, base)
    assert not gains(np.array([2.0]), np.array([1.0]))  # one episode tells nothing of its chance


def test_a_share_by_chance_is_none(monkeypatch):
    """At one age of two the expert is better, by so little that four episodes do not tell."""
    returns = {"planner": np.array([4.0, 9.0, 4.0, 9.0]), "expert": np.array([4.1, 1.0, 3.95, 1.0])}
    found = trial.Trial(returns, np.array([0.0, 2.0, 0.0, 2.0]), 7)
    assert trial.best_share(*returns.values(), found.ages)[1:] == (1.0, True)
    monkeypatch.setattr(trial, "play_trial", lambda *_: found)
    model = make(env=pendulum(delay=(0, 2)), planner_trial_episodes=2).learn(25)
    assert model.policy.who_answers == "planner"


@pytest.mark.parametrize(("age", "expert_ages"), [(2.0, range(2)), (0.0, range(2, 3))])
def test_both_answer_where_each_does_better(age, expert_ages, monkeypatch, tmp_path):
    """The planner is better at an age, the expert at the other."""
    returns = {"planner": np.array([5.0, 1.0, 5.1, 1.1]), "expert": np.array([1.0, 3.0, 1.1, 3.1])}
    found = trial.Trial(returns, np.array([age, 2.0 - age, age, 2.0 - age]), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *_: found)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The planner is worse than its expert")
        model = make(env=pendulum(delay=(0, 2)), planner_trial_episodes=2).learn(25)
    assert model.policy.who_answers == "both" and model.policy.expert_ages == expert_ages
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.who_answers == "both" and loaded.policy.expert_ages == expert_ages
    assert loaded.policy.answers == ["planner", "expert", "both"]


@pytest.mark.parametrize("better", ["planner", "expert"])
def test_the_better_one_answers_also_after_saving(better, monkeypatch, tmp_path):
    rigged(monkeypatch, planner=[0.0, 3.0] if better == "planner" else [0.0, 1.0], expert=[1.0, 1.0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = make(planner_trial_episodes=2).learn(25)
    worse = [str(w.message) for w in caught if "worse than its expert" in str(w.message)]
    assert len(worse) == (better == "expert")
    assert model.policy.who_answers == better
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.who_answers == better
    obs = observe()
    np.testing.assert_array_equal(answer(loaded, obs), answer(model, obs))
    loaded.set_answer("expert" if better == "planner" else "planner")
    assert not np.array_equal(answer(loaded, obs), answer(model, obs))


def test_a_new_training_gives_the_planner_another_chance(monkeypatch):
    rigged(monkeypatch, planner=[0.0], expert=[1.0])
    with pytest.warns(UserWarning, match="worse than its expert"):
        model = make(planner_trial_episodes=1).learn(25)
    rigged(monkeypatch, planner=[1.0], expert=[0.0])
    model.train_planner()
    assert model.policy.who_answers == "planner"


def test_an_expert_without_updates_is_not_tried(monkeypatch):
    monkeypatch.setattr(trial, "play_trial", lambda *_: pytest.fail("played"))
    told = r"random actions, which the newest 10 steps are: .* learning_starts=1000 of them\. Learn for longer\."
    with pytest.warns(UserWarning, match=told):
        model = make(env=pendulum(), planner_trial_episodes=2, learning_starts=1000).learn(10)
    assert model.policy.who_answers == "planner"


def test_no_trial_waits_for_the_end_of_episodes_that_do_not_end():
    env = DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=-1), 2)
    with pytest.warns(UserWarning, match="No episode has ended"):
        model = make(env=env, planner_trial_episodes=2).learn(25)
    assert model.policy.who_answers == "planner"


def test_no_episodes_and_no_environment_leave_the_planner(monkeypatch):
    monkeypatch.setattr(trial, "play_trial", lambda *_: pytest.fail("played"))
    model = make(planner_trial_episodes=0).learn(25)
    assert model.policy.who_answers == "planner"
    model.planner_trial_episodes, model.env = 3, None
    model.train_planner()
    assert model.policy.who_answers == "planner"


def test_only_the_last_training_of_many_is_tried(monkeypatch):
    """While collection goes on its episode must not be cut."""
    calls, played = [], trial.Trial({"planner": np.ones(1), "expert": np.zeros(1)}, np.full(1, 2.0), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *args: calls.append(args) or played)
    make(planner_trial_episodes=1, planner_train_freq=10, learning_starts=5).learn(25)
    assert len(calls) == 1


def test_returns_and_steps_are_logged_behind_the_planners_rows(monkeypatch, tmp_path):
    rigged(monkeypatch, planner=[1.0, 3.0], expert=[1.0, 1.0])
    model = make(planner_trial_episodes=2).learn(25)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.logger.record("mine", 7)
    model.train_planner()
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    assert [float(rows[-1][f"trial/{key}"]) for key in ("planner_return", "expert_return", "steps")] == [2.0, 1.0, 7.0]
    assert rows[-1]["trial/way"] == "planner"  # as it decided before
    assert (float(rows[-1]["trial/expert_from"]), float(rows[-1]["trial/expert_up_to"])) == (0.0, -1.0)
    assert model.logger.name_to_value["mine"] == 7  # for the user's next row
