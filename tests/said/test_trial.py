"""The trial after the planner's training: it measures what evaluate_policy does, and the better one answers."""

import csv
import itertools
import warnings
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from small_agent import answer, make, observe
from small_task import Drift, delayed
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper
from sb3_said.delays import UniformDelay
from sb3_said.planner import trainer as trainer_module
from sb3_said.planner.trainer import GUESS_UPDATES_EACH
from sb3_said.said import trial


def rigged(monkeypatch, planner, expert):
    played = trial.Trial({"planner": np.array(planner), "expert": np.array(expert)}, np.full(len(expert), 2.0), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *_: played)


def pendulum(n_steps=15, delay=2):
    return DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=n_steps), delay)


OF_ONE_PLANNER = {name: way for name, way in trial.WAYS.items() if name != "own_ages"}


@pytest.fixture(scope="module")
def trained():
    return make(env=pendulum(delay=(0, 2)), planner_ways=OF_ONE_PLANNER).learn(60)


def test_returns_are_those_of_each_who_can_answer(trained, monkeypatch):
    monkeypatch.setattr(trial, "GO_ON", 6)  # all of them
    before = trained.policy.planner.config
    np.random.seed(3)
    found = trial.play_trial(trained, n_episodes=3)
    played = found.returns
    np.random.seed(3)
    seed = int(np.random.randint(2**31))
    assert list(played) == ["weighed", "actor", "default", "one_step", "inpainted", "planner", "expert"]
    assert found.n_steps == 7 * 3 * 15
    assert set(found.ages) <= {0, 1, 2}
    assert trained.policy.planner.config == before
    for name, returns in played.items():
        env = DummyVecEnv([lambda: Monitor(pendulum(delay=(0, 2)))])
        trained.set_planner(**trial.WAYS.get(name, {}))
        for i, found_return in enumerate(returns):
            env.seed(seed + i)
            with trained.policy.answering("expert" if name == "expert" else "planner"):
                expected = evaluate_policy(trained, env, 1)[0]
            assert found_return == pytest.approx(expected, rel=1e-5)
        trained.policy.planner.config = before
    assert len({returns[0] for returns in played.values()}) == 7


def test_the_three_best_ways_and_the_expert_play_on(trained, monkeypatch):
    """A way counts together with the expert, each at the age at which it does better; of equal ones the first."""
    names = ["weighed", "actor", "default", "one_step", "inpainted", "planner", "expert"]
    first = [[6.0, 6.0], [9.0, 0.0], [5.0, 5.5], [0.0, 9.0], [7.0, 7.0], [6.0, 5.9], [5.0, 9.0]]
    shared = {"weighed": 7.5, "actor": 9.0, "default": 7.0, "one_step": 7.0, "inpainted": 8.0, "planner": 7.5}
    assert [trial.best_share(*map(np.array, (way, first[-1], [0.0, 2.0])))[0] for way in first[:-1]] == [
        *shared.values()
    ]
    parts, asked = iter([*first, *[[0.0] * 6] * 4]), []

    def play(model, env, n_episodes, seed, *_):
        asked.append((n_episodes, seed))
        returns = np.array(next(parts))
        return returns, np.resize([0.0, 2.0], len(returns)), len(returns)

    monkeypatch.setattr(trial, "_play", play)
    found = trial.play_trial(trained, 8)
    assert [*found.returns] == names
    assert [len(returns) for returns in found.returns.values()] == [8, 8, 2, 2, 8, 2, 8]
    seed = asked[0][1]
    assert asked == [(2, seed)] * 7 + [(6, seed + 2)] * 4
    np.testing.assert_array_equal(found.ages, [0, 2] * 4)
    assert found.n_steps == 7 * 2 + 4 * 6
    np.testing.assert_array_equal(found.returns["actor"], [9, 0, *[0] * 6])


def test_who_was_given_up_is_not_chosen(monkeypatch):
    played = {"a": np.array([9.0]), "planner": np.array([1.0, 2.0]), "b": np.array([3.0, 4.0]), "expert": np.zeros(2)}
    monkeypatch.setattr(trial, "play_trial", lambda *_: trial.Trial(played, np.full(2, 2.0), 7))
    ways = {"a": {"sampling_steps": 1}, "b": {"sampling_steps": 4}}
    model = make(planner_trial_episodes=2, planner_ways=ways).learn(60)
    assert model.policy.who_answers == "planner" and model.policy.planner.config.sampling_steps == 4


def test_an_expert_that_has_not_learned_without_delay_acts_on_no_guess():
    model = make(env=pendulum(delay=2), planner_ways={"actor": trial.WAYS["actor"]}).learn(60)
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


def test_without_delay_the_actor_is_the_expert_and_not_tried_twice():
    model = make(env=pendulum(delay=0), planner_ways={"actor": trial.WAYS["actor"]}).learn(60)
    assert model.trained_ages == [0]
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


def test_who_falls_at_once_does_not_tell_an_episodes_age(trained, monkeypatch):
    """The planner ends its second episode before an observation is 2 steps old."""
    ages = iter([[0.0, 1.0], [0.0, 2.0], [0.0, 1.0]])
    monkeypatch.setattr(trained, "planner_ways", {"one_step": trial.WAYS["one_step"]})
    monkeypatch.setattr(trial, "_play", lambda *_: (np.ones(2), np.array(next(ages)), 1))
    np.testing.assert_array_equal(trial.play_trial(trained, 2).ages, [0.0, 2.0])


def test_the_monitor_file_holds_the_training_and_not_the_trial(tmp_path):
    env = Monitor(pendulum(), str(tmp_path / "0"))
    model = make(env=env, planner_trial_episodes=2).learn(60)
    trial.play_trial(model, n_episodes=1)
    model.learn(30, reset_num_timesteps=False)
    rows = (tmp_path / "0.monitor.csv").read_text().splitlines()[2:]
    assert len(rows) == 4 + 2  # episodes of 15 steps


def test_the_file_of_a_vec_monitor_holds_the_training_alone_too(tmp_path):
    env = VecMonitor(DummyVecEnv([pendulum] * 2), str(tmp_path / "0"))
    model = make(env=env, planner_trial_episodes=2).learn(60)
    trial.play_trial(model, n_episodes=2)
    model.learn(60, reset_num_timesteps=False)
    assert len((tmp_path / "0.monitor.csv").read_text().splitlines()[2:]) == 2 * 2 + 2 * 2


def test_a_way_that_the_planner_already_has_is_not_played_twice_and_the_way_back_is(trained):
    own = trained.policy.planner.config
    try:
        trained.set_planner(**trial.WAYS["one_step"])
        returns = trial.play_trial(trained, n_episodes=1).returns
    finally:
        trained.policy.planner.config = own
    assert list(returns) == ["weighed", "actor", "default", "planner", "inpainted", "expert"]


@pytest.mark.parametrize(("means", "answers"), [((1, 2, 3, 0), "planner"), ((3, 2, 1, 4), "expert")])
def test_the_planner_decides_in_its_best_way_whoever_answers(means, answers, monkeypatch, tmp_path):
    played = {name: np.full(2, mean) for name, mean in zip(("planner", "a", "b", "expert"), means, strict=True)}
    monkeypatch.setattr(trial, "play_trial", lambda *_: trial.Trial(played, np.full(2, 2.0), 7))
    ways = {"a": {"temperature": 0.5}, "b": {"temperature": 1.0, "choice_factor": 2.0}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = make(planner_trial_episodes=2, planner_ways=ways).learn(60)
    assert model.policy.who_answers == answers
    config = model.policy.planner.config
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
        chosen.append(model.learn(60).planner_kwargs)
    assert [settings["n_candidates"] for settings in chosen] == [6, 7]


def test_episodes_of_several_environments_are_the_same_ones_whoever_ends_first():
    """A step's reward is 1, so returns tell whose environment an episode was played in."""

    def make_env(n_steps):
        return Monitor(gym.wrappers.TransformReward(pendulum(n_steps, (0, 2)), lambda _: 1.0))

    env = DummyVecEnv([lambda: make_env(9), lambda: make_env(4)])
    model = make(env=env, planner_ways={"b": {"sampling_steps": 1}}).learn(80)
    found = trial.play_trial(model, n_episodes=7)
    assert found.n_steps == 3 * 2 * 4 * 9  # three players, two environments, of which the second waits for the first
    for returns in found.returns.values():
        np.testing.assert_array_equal(returns, [9, 4, 9, 4, 9, 4, 9])
    assert set(found.ages) <= {0, 1, 2} and len(set(found.ages)) > 1


def test_ages_that_change_within_an_episode_tell_nothing_of_it():
    """The planner and the expert then meet other ages in what is the same episode by name."""
    model = make(env=pendulum(delay=UniformDelay(0, 2))).learn(60)
    np.testing.assert_array_equal(trial.play_trial(model, n_episodes=4).ages, np.zeros(4))


def test_no_trial_waits_for_the_end_of_episodes_that_do_not_end():
    env = DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=-1), 2)
    with pytest.warns(UserWarning, match="No episode has ended"):
        model = make(env=env, planner_trial_episodes=2).learn(60)
    assert model.policy.who_answers == "planner"


class Lively(Drift):
    """Ends by an action near the bounds, which chance takes and no answer does."""

    def step(self, action):
        state, reward, *_ = super().step(action)
        return state, reward, bool(abs(action[0]) > 1.9), False, {}


def test_an_episode_that_a_good_answer_never_ends_is_cut(monkeypatch):
    model = make(env=DelayedObservationWrapper(Lively(), 2), learning_starts=60, gradient_steps=1).learn(70)
    longest = model.replay_buffer.steps.max() + 1
    monkeypatch.setattr(model, "predict", lambda obs, **_: (np.zeros((1, 1), np.float32), None))
    found = trial.play_trial(model, n_episodes=2)
    assert found.returns["planner"].tolist() == [10 * longest] * 2 and found.ages.tolist() == [2, 2]


class Noisy(Drift):
    """Draws from the task's random numbers in each step; actions decide how long an episode is."""

    starts: ClassVar[list[float]] = []

    def reset(self, **kwargs):
        state, info = super().reset(**kwargs)
        self.starts.append(float(state[0]))
        return state, info

    def step(self, action):
        state, reward, *_, info = super().step(action)
        return state, reward + self.np_random.normal(), self.t >= (5 if action[0] > 0 else 9), False, info


def test_all_players_meet_the_same_starts_whatever_a_task_draws_in_between(monkeypatch):
    model = make(env=DelayedObservationWrapper(Noisy(), 2), learning_starts=20, gradient_steps=1).learn(40)
    sign = {"planner": 1.0, "expert": -1.0}
    monkeypatch.setattr(
        model, "predict", lambda obs, **_: (np.full((1, 1), sign[model.policy.who_answers], np.float32), None)
    )
    Noisy.starts.clear()
    found = trial.play_trial(model, n_episodes=3)
    assert found.n_steps == 3 * 5 + 3 * 9
    played = [start for start in dict.fromkeys(Noisy.starts) if Noisy.starts.count(start) == 2]
    assert len(played) == 3  # by each player once; who ends an episode is reset once more, unseeded


def test_after_a_cut_episode_another_begins(monkeypatch):
    """A Monitor would count the cut one's rewards once more, where it went on."""
    env = Monitor(DelayedObservationWrapper(Lively(), 2))
    model = make(env=env, learning_starts=60, gradient_steps=1).learn(70)
    longest, n_answers = int(model.replay_buffer.steps.max()) + 1, itertools.count(1)

    def predict(obs, **_):  # ends an episode three steps after the cut
        return np.full((1, 1), next(n_answers) % (10 * longest + 3) == 0, np.float32) * 2, None

    monkeypatch.setattr(model, "predict", predict)
    found = trial.play_trial(model, n_episodes=3)
    assert found.returns["planner"].tolist() == [10 * longest, 3, 10 * longest]


@pytest.mark.parametrize("task", ["Pendulum-v1", "InvertedPendulum-v5"])
def test_episodes_may_end_above_their_monitor(task):
    """Where some fall, too, the Monitor sees those end and no others."""
    env = DelayedObservationWrapper(gym.wrappers.TimeLimit(Monitor(gym.make(task)), 9), 2)
    found = trial.play_trial(make(env=env).learn(60), n_episodes=5)
    assert found.n_steps <= 2 * 5 * 9 and {len(returns) for returns in found.returns.values()} == {5}
    if task == "InvertedPendulum-v5":  # one a step
        assert all(0 < r <= 9 for returns in found.returns.values() for r in returns)


def test_an_expert_without_updates_is_not_tried(monkeypatch):
    monkeypatch.setattr(trial, "play_trial", lambda *_: pytest.fail("played"))
    with pytest.warns(UserWarning, match="after 60 steps, of which the first learning_starts=1000 are random actions"):
        model = make(env=pendulum(), planner_trial_episodes=2, learning_starts=1000).learn(60)
    assert model.policy.who_answers == "planner"


def test_a_monitor_that_allows_no_early_reset_is_none_in_a_trial():
    env = Monitor(pendulum(), allow_early_resets=False)
    model = make(env=env, planner_trial_episodes=1).learn(50)
    assert not env.allow_early_resets
    assert model.learn(50, reset_num_timesteps=False).num_timesteps == 100
    env.reset()
    with pytest.raises(RuntimeError, match="before done"):
        env.reset()


def test_a_trial_can_be_stopped_and_the_planner_stays_trained(monkeypatch):
    monkeypatch.setattr(trainer_module, "GUESS_PASSES", 10_000)  # so that few rows do not end the guess sooner
    model, asked = make(env=pendulum(), planner_ways={}).learn(60), []
    own, n_updates = model.policy.planner.config, 5 * GUESS_UPDATES_EACH + 5

    def should_stop():
        asked.append(model.policy.who_answers)
        return len(asked) > n_updates + 20  # amid the trial's second episode

    with pytest.raises(KeyboardInterrupt):
        model.train_planner(5, trial_episodes=9, should_stop=should_stop)
    assert len(asked) == n_updates + 21 and asked[-1] == "planner" == model.policy.who_answers
    assert model.policy.planner.config == own


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


@pytest.mark.parametrize("settings", [{"present": "inpainted"}, {"decided_by": "actor"}, {"temperature": 0.0}])
def test_a_decision_of_one_s_own_is_kept_in_a_file_and_tried_against_all_ways(settings, tmp_path):
    """Some ways say otherwise of who decides, and where."""
    ways = {**trial.WAYS, "inpainted": {"present": "inpainted"}}
    model = make(env=pendulum(delay=(0, 2)), planner_ways=ways).learn(60)
    model.set_planner(**settings)
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", env=pendulum(delay=(0, 2)), device="cpu")
    assert loaded.policy.planner.config == model.policy.planner.config and loaded.planner_ways == ways
    model.train_planner(trial_episodes=1)
    assert set(trial.play_trial(model, 1).returns) >= {"planner", "expert"}


def test_ties_are_broken_in_the_same_order_again_and_again():
    """Drift pays everyone alike. A way that the agent decides in already stands where it stood."""
    model = make(planner_trial_episodes=2, planner_ways=trial.WAYS).learn(60)
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
    model = make(env=pendulum(delay=(0, 2)), planner_trial_episodes=2).learn(60)
    assert model.policy.who_answers == "planner"


@pytest.mark.parametrize(("age", "expert_ages"), [(2.0, range(2)), (0.0, range(2, 3))])
def test_both_answer_where_each_does_better(age, expert_ages, monkeypatch, tmp_path):
    """The planner is better at an age, the expert at the other."""
    returns = {"planner": np.array([5.0, 1.0, 5.1, 1.1]), "expert": np.array([1.0, 3.0, 1.1, 3.1])}
    found = trial.Trial(returns, np.array([age, 2.0 - age, age, 2.0 - age]), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *_: found)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The planner is worse than its expert")
        model = make(env=pendulum(delay=(0, 2)), planner_trial_episodes=2).learn(60)
    assert model.policy.who_answers == "both" and model.policy.expert_ages == expert_ages
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.who_answers == "both" and loaded.policy.expert_ages == expert_ages
    assert loaded.policy.answers == ["planner", "expert", "both"]


def test_ways_that_are_given_are_checked_and_settings_of_the_users_own_are_kept(tmp_path):
    tiny = {"planner_kwargs": {"depth": 1, "d_model": 32}, "buffer_size": 100, "device": "cpu"}
    by_default = {name: {"mask": "random", "present": "guessed", **way} for name, way in trial.WAYS.items()}
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


def test_an_expert_without_updates_acts_on_no_guess():
    model = make(env=pendulum(delay=(0, 2)), planner_ways={"actor": trial.WAYS["actor"]}, learning_starts=100).learn(60)
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


@pytest.mark.parametrize("better", ["planner", "expert"])
def test_the_better_one_answers_also_after_saving(better, monkeypatch, tmp_path):
    rigged(monkeypatch, planner=[0.0, 3.0] if better == "planner" else [0.0, 1.0], expert=[1.0, 1.0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = make(planner_trial_episodes=2).learn(60)
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
        model = make(planner_trial_episodes=1).learn(60)
    rigged(monkeypatch, planner=[1.0], expert=[0.0])
    model.train_planner()
    assert model.policy.who_answers == "planner"


def test_no_episodes_and_no_environment_leave_the_planner(trained, monkeypatch):
    monkeypatch.setattr(trial, "play_trial", lambda *_: pytest.fail("played"))
    model = make(planner_trial_episodes=0).learn(60)
    assert model.policy.who_answers == "planner"
    model.planner_trial_episodes, model.env = 3, None
    model.train_planner()
    assert model.policy.who_answers == "planner"


def test_the_trial_is_no_training(monkeypatch):
    """Neither steps, replay nor VecNormalize's statistics move, and learning starts anew afterwards."""
    env = VecNormalize(DummyVecEnv([lambda: Monitor(delayed())]), norm_obs_keys=["observation"])
    model = make(env=env, planner_trial_episodes=0).learn(60)
    before = env.obs_rms["observation"].mean.copy(), env.ret_rms.var, model.replay_buffer.size()
    trial.play_trial(model, n_episodes=2)
    assert env.training
    np.testing.assert_array_equal(env.obs_rms["observation"].mean, before[0])
    assert (env.ret_rms.var, model.replay_buffer.size(), model.num_timesteps) == (*before[1:], 60)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 80


def test_returns_are_in_the_task_s_own_rewards_without_a_monitor_too():
    env = VecNormalize(DummyVecEnv([lambda: delayed()]), norm_obs_keys=["observation"])
    model = make(env=env).learn(60)
    np.testing.assert_allclose(trial.play_trial(model, n_episodes=2).returns["expert"], 12.0)  # 1 a step
    assert env.norm_reward


def test_only_the_last_training_of_many_is_tried(monkeypatch):
    """While collection goes on its episode must not be cut."""
    calls, played = [], trial.Trial({"planner": np.ones(1), "expert": np.zeros(1)}, np.full(1, 2.0), 7)
    monkeypatch.setattr(trial, "play_trial", lambda *args: calls.append(args) or played)
    make(planner_trial_episodes=1, planner_train_freq=20).learn(60)
    assert len(calls) == 1


def test_the_same_seed_gives_the_same_trial():
    def returns():
        model = make(env=pendulum()).learn(60)
        return trial.play_trial(model, n_episodes=2).returns

    first, second = returns(), returns()
    for who in first:
        np.testing.assert_array_equal(first[who], second[who])


def test_returns_and_steps_are_logged_behind_the_planners_rows(monkeypatch, tmp_path):
    rigged(monkeypatch, planner=[1.0, 3.0], expert=[1.0, 1.0])
    model = make(planner_trial_episodes=2).learn(60)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.logger.record("mine", 7)
    model.train_planner()
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    assert [float(rows[-1][f"trial/{key}"]) for key in ("planner_return", "expert_return", "steps")] == [2.0, 1.0, 7.0]
    assert (float(rows[-1]["trial/expert_from"]), float(rows[-1]["trial/expert_up_to"])) == (0.0, -1.0)
    assert model.logger.name_to_value["mine"] == 7  # for the user's next row
