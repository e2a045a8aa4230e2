"""The trial after the planner's training measures what evaluate_policy does, and is no training."""

import itertools
import re
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from small_agent import make
from small_task import Drift, delayed, pendulum
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_said import DelayedObservationWrapper, PlannerTrainingCallback
from sb3_said.delays import UniformDelay
from sb3_said.planner import trainer as trainer_module
from sb3_said.planner.trainer import GUESS_UPDATES_EACH
from sb3_said.said import trial
from sb3_said.said.ways import WAYS, other_planners

OF_ONE_PLANNER = {name: way for name, way in WAYS.items() if name != "own_ages"}


@pytest.fixture(scope="module")
def trained():
    return make(env=pendulum(8, (0, 2)), planner_ways=OF_ONE_PLANNER).learn(25)


def test_returns_are_those_of_each_who_can_answer(trained, monkeypatch):
    monkeypatch.setattr(trial, "GO_ON", 6)  # all of them
    before = trained.policy.planner.config
    np.random.seed(3)
    found = trial.play_trial(trained, n_episodes=2)
    played = found.returns
    np.random.seed(3)
    seed = int(np.random.randint(2**31))
    assert list(played) == ["weighed", "actor", "default", "one_step", "inpainted", "planner", "expert"]
    assert found.n_steps == 7 * 2 * 8
    assert set(found.ages) <= {0, 1, 2}
    assert trained.policy.planner.config == before
    for name, returns in played.items():
        env = DummyVecEnv([lambda: Monitor(pendulum(8, (0, 2)))])
        trained.set_planner(**WAYS.get(name, {}))
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


def test_an_expert_that_has_not_learned_without_delay_acts_on_no_guess():
    model = make(env=pendulum(delay=2), planner_ways={"actor": WAYS["actor"]}).learn(25)
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


def test_without_delay_the_actor_is_the_expert_and_not_tried_twice():
    model = make(env=pendulum(delay=0), planner_ways={"actor": WAYS["actor"]}).learn(25)
    assert model.trained_ages == [0]
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


def test_who_falls_at_once_does_not_tell_an_episodes_age(trained, monkeypatch):
    """The planner ends its second episode before an observation shows an action, as if it were 2 steps old."""
    ages = iter([[0.0, 2.0], [0.0, 1.0], [0.0, 2.0]])
    monkeypatch.setattr(trained, "planner_ways", {"one_step": WAYS["one_step"]})
    monkeypatch.setattr(trial, "_play", lambda *_: (np.ones(2), np.array(next(ages)), 1))
    np.testing.assert_array_equal(trial.play_trial(trained, 2).ages, [0.0, 1.0])


def test_the_monitor_file_holds_the_training_and_not_the_trial(tmp_path):
    env = Monitor(pendulum(), str(tmp_path / "0"))
    model = make(env=env, planner_trial_episodes=2).learn(30)
    trial.play_trial(model, n_episodes=1)
    model.learn(15, reset_num_timesteps=False)
    rows = (tmp_path / "0.monitor.csv").read_text().splitlines()[2:]
    assert len(rows) == 2 + 1  # episodes of 15 steps


def test_the_file_of_a_vec_monitor_holds_the_training_alone_too(tmp_path):
    env = VecMonitor(DummyVecEnv([pendulum] * 2), str(tmp_path / "0"))
    model = make(env=env, planner_trial_episodes=2).learn(30)
    trial.play_trial(model, n_episodes=2)
    model.learn(30, reset_num_timesteps=False)
    assert len((tmp_path / "0.monitor.csv").read_text().splitlines()[2:]) == 2 * 1 + 2 * 1


def test_a_way_that_the_planner_already_has_is_not_played_twice_and_the_way_back_is(trained):
    own = trained.policy.planner.config
    try:
        trained.set_planner(**WAYS["one_step"])
        returns = trial.play_trial(trained, n_episodes=1).returns
    finally:
        trained.policy.planner.config = own
    assert list(returns) == ["weighed", "actor", "default", "planner", "inpainted", "expert"]


def test_episodes_of_several_environments_are_the_same_ones_whoever_ends_first():
    """A step's reward is 1, so returns tell whose environment an episode was played in."""

    def make_env(n_steps):
        return Monitor(gym.wrappers.TransformReward(pendulum(n_steps, (0, 2)), lambda _: 1.0))

    env = DummyVecEnv([lambda: make_env(9), lambda: make_env(4)])
    model = make(env=env, planner_ways={"b": {"sampling_steps": 1}}).learn(40)
    found = trial.play_trial(model, n_episodes=7)
    assert found.n_steps == 3 * 2 * 4 * 9  # three players, two environments, of which the second waits for the first
    for returns in found.returns.values():
        np.testing.assert_array_equal(returns, [9, 4, 9, 4, 9, 4, 9])
    assert set(found.ages) <= {0, 1, 2} and len(set(found.ages)) > 1


def test_a_trial_in_environments_that_are_made_is_the_one_in_the_trainings(trained, monkeypatch):
    """Each environment plays the starts that one alone would. (Of the agent's own way rounding decides candidates.)"""
    monkeypatch.setattr(trained, "planner_ways", {"one_step": WAYS["one_step"], "actor": WAYS["actor"]})
    made, closed = [], []

    def make_env(n_envs):
        made.append(DummyVecEnv([lambda: Monitor(pendulum(8, (0, 2)))] * n_envs))
        monkeypatch.setattr(made[-1], "close", lambda: closed.append(n_envs))
        return made[-1]

    np.random.seed(3)
    expected = trial.play_trial(trained, 6)
    with monkeypatch.context() as patch:
        patch.setattr(trained, "borrowed_env", lambda: pytest.fail("borrowed"))
        np.random.seed(3)
        found = trial.play_trial(trained, 6, make_env=make_env)
    assert ([env.num_envs for env in made], closed) == ([trial.AT_ONCE], [trial.AT_ONCE])
    assert [*found.returns] == [*expected.returns] == ["one_step", "actor", "planner", "expert"]
    for who in ("one_step", "actor", "expert"):
        np.testing.assert_allclose(found.returns[who], expected.returns[who], rtol=1e-4)
    np.testing.assert_array_equal(found.ages, expected.ages)
    trial.play_trial(trained, 2, make_env=make_env)
    assert made[-1].num_envs == 2  # no more than there are episodes
    trial.play_trial(trained, 1, make_env=lambda _: pytest.fail("made one more, as the training's"))


def test_environments_that_are_made_show_what_those_of_the_training_do(monkeypatch):
    """Scaled observations, and rewards as they are."""

    def make_env(n_envs=1, **kwargs):
        env = DummyVecEnv([lambda: Monitor(pendulum())] * n_envs)
        return VecNormalize(env, norm_obs_keys=["observation"], **kwargs)

    model, made = make(env=make_env(), planner_ways={}).learn(25), []
    np.random.seed(3)
    expected = trial.play_trial(model, 2).returns
    np.random.seed(3)
    found = trial.play_trial(model, 2, make_env=lambda n: made.append(make_env(n)) or made[0]).returns
    np.testing.assert_allclose(found["expert"], expected["expert"], rtol=1e-4)
    own = model.get_vec_normalize_env()
    assert own.training and made[0].obs_rms["observation"].count == own.obs_rms["observation"].count > 25

    for kwargs in (None, {"clip_obs": 0.5, "epsilon": 1.0}):  # without one, and of other settings
        np.random.seed(3)
        alike = trial.play_trial(
            model, 2, make_env=lambda n, k=kwargs: make_env(n).venv if k is None else make_env(n, **k)
        )
        np.testing.assert_allclose(alike.returns["expert"], expected["expert"], rtol=1e-4)


def test_where_environments_cannot_be_made_the_trainings_is_played_in_and_nothing_is_lost(recwarn):
    env = VecNormalize(DummyVecEnv([lambda: Monitor(pendulum(5))]), norm_obs_keys=["observation"])
    model = make(env=env, planner_ways={}, planner_trial_episodes=2, learning_starts=5)

    def fails(n):
        raise OSError("Address already in use")

    for make_env, warned in [
        (fails, "Address already in use"),
        (lambda n: VecMonitor(DummyVecEnv([Drift] * n)), "norm_obs_keys|spaces do not match"),
        (lambda n: pendulum(), "no attribute"),
        (lambda n: env, None),  # the training's own
    ]:
        callback = PlannerTrainingCallback(make_trial_env=make_env)
        recwarn.clear()
        model.learn(8, callback=callback)
        found = [str(w.message) for w in recwarn if "training's own environment" in str(w.message)]
        assert bool(found) == (warned is not None) and all(re.search(warned, text) for text in found)
        assert not any("trial has failed" in str(w.message) for w in recwarn)
        assert env.training and env.norm_reward
        env.reset()


def test_environments_that_cannot_be_closed_lose_no_trial(trained, monkeypatch):
    def make_env(n_envs):
        env = DummyVecEnv([lambda: Monitor(pendulum(8, (0, 2)))] * n_envs)
        monkeypatch.setattr(env, "close", lost)
        return env

    def lost():
        raise EOFError("a process has ended")

    with pytest.warns(UserWarning, match="could not be closed: EOFError: a process has ended"):
        found = trial.play_trial(trained, 2, make_env=make_env)
    assert len(found.returns["expert"]) == 2


def test_an_error_of_the_task_amid_the_trial_loses_no_planner(monkeypatch):
    def lost(*_):
        raise RuntimeError("physics server lost")

    monkeypatch.setattr(trial, "_play", lost)
    with pytest.warns(UserWarning, match="physics server lost"):
        model = make(env=pendulum(), planner_trial_episodes=2).learn(25)
    assert model.policy.who_answers == "planner"


def test_each_of_the_environments_plays_though_their_delays_differ():
    env = DummyVecEnv([lambda delay=delay: Monitor(pendulum(9, delay, 2)) for delay in range(3)])
    model = make(env=env, planner_ways=OF_ONE_PLANNER).learn(36)
    found = trial.play_trial(model, n_episodes=5)
    np.testing.assert_array_equal(found.ages, [0, 1, 2, 0, 1])
    assert sorted({len(returns) for returns in found.returns.values()}) == [3, 5]  # a quarter is less than one round


def test_ages_that_change_within_an_episode_tell_nothing_of_it():
    """The planner and the expert then meet other ages in what is the same episode by name."""
    model = make(env=pendulum(delay=UniformDelay(0, 2))).learn(25)
    np.testing.assert_array_equal(trial.play_trial(model, n_episodes=4).ages, np.zeros(4))


class Lively(Drift):
    """Ends by an action near the bounds, which chance takes and no answer does."""

    info: ClassVar[dict] = {}

    def step(self, action):
        state, reward, *_ = super().step(action)
        return state, reward, bool(abs(action[0]) > 1.9), False, dict(self.info)


@pytest.mark.parametrize("info", [{}, {"episode": None}])  # the second is of Isaac Lab's VecEnv
def test_an_episode_that_a_good_answer_never_ends_is_cut(info, monkeypatch):
    monkeypatch.setattr(Lively, "info", info)
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
    model = make(env=DelayedObservationWrapper(Noisy(), 2), learning_starts=20, gradient_steps=1).learn(25)
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
    found = trial.play_trial(make(env=env).learn(25), n_episodes=5)
    assert found.n_steps <= 2 * 5 * 9 and {len(returns) for returns in found.returns.values()} == {5}
    if task == "InvertedPendulum-v5":  # one a step
        assert all(0 < r <= 9 for returns in found.returns.values() for r in returns)


def test_the_tasks_own_rewards_count_where_a_wrapper_above_its_monitor_changes_them():
    task = Monitor(gym.wrappers.TransformReward(gym.make("Pendulum-v1", max_episode_steps=9), lambda _: 1.0))
    env = DelayedObservationWrapper(gym.wrappers.TransformReward(task, lambda reward: reward / 100), 2)
    found = trial.play_trial(make(env=env, planner_ways={}).learn(25), n_episodes=2)
    assert {name: returns.tolist() for name, returns in found.returns.items()} == {"planner": [9, 9], "expert": [9, 9]}


def test_a_monitor_that_allows_no_early_reset_is_none_in_a_trial():
    env = Monitor(pendulum(), allow_early_resets=False)
    model = make(env=env, planner_trial_episodes=1).learn(25)
    trial.play_trial(model, n_episodes=1)  # an error of which is no warning
    assert not env.allow_early_resets
    assert model.learn(10, reset_num_timesteps=False).num_timesteps == 35
    env.reset()
    with pytest.raises(RuntimeError, match="before done"):
        env.reset()


def test_a_trial_can_be_stopped_and_the_planner_stays_trained(monkeypatch):
    monkeypatch.setattr(trainer_module, "GUESS_PASSES", 10_000)  # so that few rows do not end the guess sooner
    model, asked = make(env=pendulum(), planner_ways={}).learn(25), []
    own, n_updates = model.policy.planner.config, 5 * GUESS_UPDATES_EACH + 5

    def should_stop():
        asked.append(model.policy.who_answers)
        return len(asked) > n_updates + 20  # amid the trial's second episode

    with pytest.raises(KeyboardInterrupt):
        model.train_planner(5, trial_episodes=9, should_stop=should_stop)
    assert len(asked) == n_updates + 21 and asked[-1] == "planner" == model.policy.who_answers
    assert model.policy.planner.config == own


def test_an_expert_without_updates_acts_on_no_guess():
    model = make(env=pendulum(delay=(0, 2)), planner_ways={"actor": WAYS["actor"]}, learning_starts=100).learn(25)
    assert list(trial.play_trial(model, n_episodes=1).returns) == ["planner", "expert"]


def test_the_trial_is_no_training(monkeypatch):
    """Neither steps, replay nor VecNormalize's statistics move, and learning starts anew afterwards."""
    env = VecNormalize(DummyVecEnv([lambda: Monitor(delayed())]), norm_obs_keys=["observation"])
    model = make(env=env, planner_trial_episodes=0).learn(25)
    before = env.obs_rms["observation"].mean.copy(), env.ret_rms.var, model.replay_buffer.size()
    trial.play_trial(model, n_episodes=2)
    assert env.training
    np.testing.assert_array_equal(env.obs_rms["observation"].mean, before[0])
    assert (env.ret_rms.var, model.replay_buffer.size(), model.num_timesteps) == (*before[1:], 25)
    model.learn(10, reset_num_timesteps=False)
    assert model.num_timesteps == 35


def test_returns_are_in_the_task_s_own_rewards_without_a_monitor_too():
    env = VecNormalize(DummyVecEnv([lambda: delayed()]), norm_obs_keys=["observation"])
    model = make(env=env).learn(25)
    np.testing.assert_allclose(trial.play_trial(model, n_episodes=2).returns["expert"], 12.0)  # 1 a step
    assert env.norm_reward


def test_the_same_seed_gives_the_same_trial():
    def returns():
        model = make(env=pendulum()).learn(25)
        return trial.play_trial(model, n_episodes=2).returns

    first, second = returns(), returns()
    for who in first:
        np.testing.assert_array_equal(first[who], second[who])


class Split(Drift):
    """Chance decides at the reset whether an episode has 4 steps, which pay the action, or 20, which cost a little."""

    def reset(self, **kwargs):
        state, info = super().reset(**kwargs)
        self.length = 4 if self.np_random.random() < 0.5 else 20
        return state, info

    def step(self, action):
        state, _, ended, *_ = super().step(action)
        return state, float(action[0]) * (5.0 if self.length == 4 else -0.1), ended, False, {}


@pytest.mark.parametrize("delay", [6, (4, 6)])
def test_an_episode_that_ends_before_an_action_shows_is_of_who_begins_episodes(delay, monkeypatch):
    """The planner is the better one in short episodes, and worse in long ones by less."""
    env = DelayedObservationWrapper(Split(truncates=False), delay)
    model, sign = make(env=env, planner_ways={}).learn(40), {"planner": 1.0, "expert": -1.0}
    monkeypatch.setattr(
        model, "predict", lambda obs, **_: (np.full((1, 1), sign[model.policy.who_answers], np.float32), None)
    )
    found = trial.play_trial(model, 12)
    is_short = found.returns["planner"] > 0
    assert 0 < is_short.sum() < 12 and set(found.ages[is_short]) == {6}
    assert set(found.ages) == {6} if delay == 6 else {6} < set(found.ages) <= {4, 5, 6}
    trial.let_the_best_answer(model, 12)
    if delay == 6:
        assert model.policy.who_answers == "planner"
    else:  # whoever answers at 6 begins
        assert model.policy.who_answers == "planner" or model.policy.expert_ages.stop <= 6


def test_ctrl_c_ends_the_trial_and_not_the_learning(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "_play", interrupted)
    model = make(env=pendulum(), planner_trial_episodes=2, planner_train_freq=25).learn(30)
    assert model.policy.who_answers == "planner" and model._planner_trained_at == 30
    assert "The trial was interrupted" in capsys.readouterr().out


def test_a_trial_whose_rewards_are_no_numbers_chooses_nothing(monkeypatch):
    class Broken(gym.RewardWrapper):
        is_broken = False

        def reward(self, reward):
            return np.nan if self.is_broken else reward

    def play(*args):
        Broken.is_broken = True  # once the replay, which refuses such a reward, is full
        return played(*args)

    played = trial._play
    monkeypatch.setattr(trial, "_play", play)
    env = DelayedObservationWrapper(Broken(gym.make("Pendulum-v1", max_episode_steps=15)), 2)
    with pytest.warns(
        UserWarning, match="trial has failed, and the planner answers as it is: ValueError: A reward of the trial"
    ):
        model = make(env=env, planner_trial_episodes=2).learn(25)
    assert model.policy.who_answers == "planner" and model.policy.planner.config.temperature == 0.5  # as made


def test_a_planner_of_one_age_is_not_tried_at_others_and_no_second_one_is_trained():
    with pytest.warns(UserWarning, match="No trial is played, and the planner answers: .*mask='fixed'"):
        model = make(
            env=pendulum(max_delay=4), planner_kwargs={"mask": "fixed", "present": None}, planner_trial_episodes=2
        ).learn(25)
    assert model.policy.who_answers == "planner"
    ways = {"paper": {"mask": "fixed", "present": "inpainted"}}
    assert other_planners(make(env=pendulum(delay=(0, 2)), planner_ways=ways).learn(25)) == []
    (other,) = other_planners(make(env=pendulum(), planner_ways=ways).learn(25))
    assert (other.mask, other.present) == ("fixed", "inpainted")


def test_without_delay_no_way_is_played_twice():
    ways = {**OF_ONE_PLANNER, "own": {"temperature": 0.5}}
    model = make(env=pendulum(delay=0), planner_ways=ways).learn(25)
    names = [*trial.play_trial(model, 1).returns]
    assert "default" in names and "inpainted" not in names and "actor" not in names
