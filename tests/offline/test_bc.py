"""Behaviour cloning: it learns what the delay hides as far as history tells it, and steps no environment."""

import copy
import csv
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_task import Drift, delayed
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, LogEveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from torch.nn import functional as F

from sb3_said import DelayedObservationWrapper
from sb3_said.delays import UniformDelay
from sb3_said.offline import BC, Dataset
from sb3_said.offline.learning import GradientStepBar
from sb3_said.replay.buffer import DelayedReplayBuffer

DELAY = 3


def demonstrations(n_episodes=40, length=30, seed=0):
    """Return episodes of s' = 0.9 s + 0.3 a + noise-free, steered by a = -0.8 s plus an exploring part that repeats."""
    rng = np.random.default_rng(seed)
    states, actions = np.zeros((n_episodes, length + 1, 2)), np.zeros((n_episodes, length, 1))
    states[:, 0] = rng.normal(size=(n_episodes, 2))
    for t in range(length):
        actions[:, t, 0] = np.tanh(-0.8 * states[:, t, 0])
        states[:, t + 1] = 0.9 * states[:, t] + 0.3 * actions[:, t]
    ends = np.zeros((n_episodes, length), bool)
    ends[:, -1] = True
    flat = [states[:, :-1].reshape(-1, 2), actions.reshape(-1, 1), np.ones(n_episodes * length)]
    floats = [np.asarray(x, np.float32) for x in flat]
    return Dataset(*floats, np.zeros(ends.size, bool), ends.ravel(), states[:, -1].astype(np.float32))


def make(env=None, **kwargs):
    arguments = {
        "policy_kwargs": {"net_arch": [64]},
        "learning_rate": 3e-3,
        "batch_size": 128,
        "seed": 0,
        "device": "cpu",
    }
    env = DelayedObservationWrapper(Drift(), DELAY) if env is None else env
    return BC("MlpPolicy", env, buffer_size=100, **(arguments | kwargs))


@pytest.fixture(scope="module")
def learned():
    model = make()
    model.env.envs[0].step = None  # no environment is stepped, nor reset
    model.env.envs[0].reset = None
    return model.learn_offline(demonstrations(), 200)


def test_it_answers_with_the_action_of_the_hidden_present(learned):
    """The present follows from old state and history, so the error can vanish; acting on the old state keeps one."""
    held_out = demonstrations(seed=1)
    batch = held_out.to_replay(learned.observation_space, learned.action_space, learned._draw_ages()).sample(2_000)
    obs = {key: batch.observations[key].cpu().numpy() for key in learned.observation_space.spaces}
    actions = learned.predict(obs, deterministic=True)[0] / 2.0  # Drift's bounds are -2 and 2
    error = np.mean((actions - batch.actions.cpu().numpy()) ** 2)
    ignoring = np.mean((np.tanh(-0.8 * obs["observation"][:, :1]) - batch.actions.cpu().numpy()) ** 2)
    assert error < 0.1 * ignoring and error < 0.01
    np.testing.assert_array_equal(learned.predict(obs)[0] / 2.0, actions)  # SB3's default: no spread was learned


def test_vec_normalize_learns_from_the_logs():
    env = VecNormalize(DummyVecEnv([lambda: delayed(delay=DELAY)]), norm_obs_keys=["observation"], norm_reward=False)
    model, data = make(env), demonstrations(20)
    model.take_dataset(data)
    rms = env.obs_rms["observation"]
    np.testing.assert_allclose([rms.mean, rms.var], [data.states.mean(0), data.states.var(0)], atol=1e-4)
    shown = model.replay_buffer.sample(600, env=env).observations["undelayed_observation"]
    np.testing.assert_allclose(shown.std(0), 1.0, atol=0.15)
    env.training = False  # a deployed one stays as it is
    model.take_dataset(demonstrations(5, seed=3))
    np.testing.assert_allclose(rms.mean, data.states.mean(0), atol=1e-4)


def test_ages_are_those_of_play(learned):
    ages = learned.replay_buffer.ages[:1200, 0].reshape(-1, 30)
    assert (ages == np.minimum(np.arange(30), DELAY)).all()
    varying = make(delayed(delay=(0, 2)))
    varying.take_dataset(demonstrations())
    ages = varying.replay_buffer.ages[:1200, 0].reshape(-1, 30)
    assert set(ages[:, 5]) == {0, 1, 2} and (ages[:, 0] == 0).all() and (np.diff(ages[:, 3:]) == 0).all()


def test_ages_are_those_of_each_environment():
    model = make(DummyVecEnv([lambda: delayed(1, max_delay=4), lambda: delayed(4)]))
    model.take_dataset(demonstrations())
    ages = model.replay_buffer.ages[:1200, 0].reshape(-1, 30)[:, 5]
    assert model.learn_offline(None, 1).trained_ages == [1, 4]
    assert set(ages) == {1, 4} and 10 < (ages == 4).sum() < 30


def test_a_log_is_read_where_a_worker_cannot_send_the_task_s_spec():
    def make_env():
        task = gym.wrappers.TransformAction(gym.make("Pendulum-v1"), lambda action: action, None)
        return DelayedObservationWrapper(task, 2)

    env = SubprocVecEnv([make_env])
    try:
        states, actions = np.zeros((9, 3), np.float32), np.zeros((9, 1), np.float32)
        ends = np.arange(9) == 8
        data = Dataset(states, actions, np.zeros(9, np.float32), np.zeros(9, bool), ends, states[:1])
        assert make(env).learn_offline(data, 1).num_timesteps == 1
    finally:
        env.close()


def test_ages_count_the_actions_on_their_way_as_play_does():
    env = DelayedObservationWrapper(Drift(length=40), delay=1, action_delay="UniformDelay(0, 2)")
    draw = make(env, seed=5)._draw_ages()
    drawn = [draw(40).tolist() for _ in range(3)]
    env._rng = np.random.default_rng(5)
    for ages in drawn:
        played = [int(env.reset()[0]["delay"][0])]
        played += [int(env.step(env.action_space.sample())[0]["delay"][0]) for _ in range(40)]
        assert ages == played
    assert {1, 2, 3} == {age for ages in drawn for age in ages[3:]}


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_the_ages_of_logs_are_no_matter_of_an_episode_that_is_played(vec_env):
    def make_env():
        return DelayedObservationWrapper(Drift(), UniformDelay(0, 2), UniformDelay(0, 1))

    env = vec_env([make_env])
    try:
        model = make(env)
        env.seed(3)
        shown = env.reset()
        env.seed(3)
        env.reset()
        model.learn_offline(demonstrations(2), 1)  # amid the episode
        twin = DummyVecEnv([make_env])
        twin.seed(3)
        np.testing.assert_array_equal(twin.reset()["observation"], shown["observation"])
        for _ in range(9):
            left, right = (each.step(np.ones((1, 1), np.float32))[0] for each in (env, twin))
            for key in left:
                np.testing.assert_array_equal(left[key], right[key])
    finally:
        env.close()


def test_ages_that_logs_did_not_show_are_warned_of():
    model = make(DelayedObservationWrapper(Drift(), (1, 2), max_delay=4)).learn_offline(demonstrations(2), 1)
    assert model.trained_ages == [1, 2]
    with pytest.warns(UserWarning, match="BC learned at ages 1, 2 and is given 4"):
        model.set_env(DummyVecEnv([lambda: DelayedObservationWrapper(Drift(), 4)]))


def test_it_does_not_clone_what_it_does_itself(learned):
    with pytest.raises(ValueError, match=r"BC learns from logs: call learn_offline\(dataset, gradient_steps\)"):
        learned.learn(100)


def test_callbacks_that_log_episodes_find_none():
    model = make()
    model.set_logger(configure(format_strings=[]))
    assert model.learn_offline(demonstrations(2), 9, LogEveryNTimesteps(4)).num_timesteps == 9
    copied = copy.deepcopy(model)
    assert copied.num_timesteps == 9


def test_without_an_environment_ages_are_unknown(learned, tmp_path):
    learned.save(tmp_path / "bc.zip")
    loaded = BC.load(tmp_path / "bc.zip", device="cpu")
    with pytest.raises(ValueError, match=r"learns at the ages .* and has none: give it the environment"):
        loaded.learn_offline(demonstrations(2), 1)
    make(Drift()).save(tmp_path / "plain.zip")
    assert BC.load(tmp_path / "plain.zip", device="cpu").learn_offline(demonstrations(2), 1).num_timesteps == 1


@pytest.mark.parametrize("env", ["delayed", "plain"])
def test_the_unit_of_a_state_does_not_matter(env):
    """CORL's BC reads z-scores; without them a state in thousandths drowns the other, or is drowned."""

    def error(unit, **kwargs):
        scale = np.array([unit, 1.0], np.float32)

        def in_unit(data):
            return replace(data, states=data.states * scale, finals=data.finals * scale)

        model = make(delayed(DELAY) if env == "delayed" else Drift(), **kwargs)
        model.learn_offline(in_unit(demonstrations()), 100)
        model.take_dataset(in_unit(demonstrations(seed=1)))
        batch = model.replay_buffer.sample(1_000)
        with th.no_grad():
            return F.mse_loss(model.actor(batch.observations, deterministic=True), batch.actions).item()

    plain, thousandths = error(1.0), error(1000.0)
    assert thousandths < 1.5 * plain < 0.01
    assert error(1000.0, normalise_states=False) > 5 * plain


def test_the_scale_is_the_datasets_and_is_saved(learned, tmp_path):
    data, normalizer = demonstrations(), learned.policy.state_normalizer
    np.testing.assert_allclose(normalizer.mean, data.states.mean(0), atol=1e-5)
    np.testing.assert_allclose(normalizer.deviation, data.states.std(0), atol=2e-4)
    learned.save(tmp_path / "bc.zip")
    assert th.equal(BC.load(tmp_path / "bc.zip", device="cpu").policy.state_normalizer.mean, normalizer.mean)


@pytest.mark.parametrize("how", ["here", "taken over", "from a compact file", "by SGD"])
def test_weights_keep_the_scale_that_they_learned_with(how, tmp_path):
    model = make(**({"policy_kwargs": {"optimizer_class": th.optim.SGD}} if how == "by SGD" else {}))
    obs = delayed(DELAY).reset(seed=0)[0]
    model.learn_offline(demonstrations(4), 5)
    answer = model.predict(obs)[0]
    if how == "taken over":
        parameters, model = model.get_parameters(), make()
        model.set_parameters(parameters)
    elif how == "from a compact file":
        model.save(tmp_path / "bc.zip", compact=True)
        model = BC.load(tmp_path / "bc.zip", env=delayed(DELAY), device="cpu")
        answer = model.predict(obs)[0]  # in half precision
    data = demonstrations(4)
    model.take_dataset(replace(data, states=data.states / 5, finals=data.finals / 5))
    np.testing.assert_array_equal(model.predict(obs)[0], answer)


def test_its_policy_answers_with_the_mean_by_itself(learned, tmp_path):
    obs = delayed(DELAY).reset(seed=0)[0]
    learned.policy.save(tmp_path / "policy.zip")
    policy = type(learned.policy).load(tmp_path / "policy.zip", device="cpu")
    for _ in range(3):
        np.testing.assert_array_equal(policy.predict(obs)[0], learned.predict(obs)[0])


class OfTheUsersOwn(DelayedReplayBuffer):
    pass


def test_logs_go_into_the_buffer_that_was_asked_for():
    model = make(replay_buffer_class=OfTheUsersOwn, replay_buffer_kwargs={"handle_timeout_termination": False})
    model.take_dataset(demonstrations(2))
    assert type(model.replay_buffer) is OfTheUsersOwn and not model.replay_buffer.handle_timeout_termination


def test_a_replay_of_logs_is_as_long_as_they_are(tmp_path):
    model = make()  # of 100 steps
    model.take_dataset(demonstrations(5))
    model.save_replay_buffer(tmp_path / "replay")
    other = make(DummyVecEnv([lambda: delayed(DELAY)] * 2))
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer.size() == 150 and other.replay_buffer.holds_logs
    for name in ("observations", "actions", "ages"):
        np.testing.assert_array_equal(getattr(other.replay_buffer, name), getattr(model.replay_buffer, name))
    other.learn_offline(None, 2)


def test_a_replay_of_a_short_log_comes_back_too(tmp_path):
    model = make()  # whose buffer holds more than the steps that a delay of 3 looks back
    model.take_dataset(demonstrations(1, length=1))
    model.save_replay_buffer(tmp_path / "replay")
    other = make()
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer.size() == 1 and other.replay_buffer.buffer_size == model.replay_buffer.buffer_size


def test_an_interval_of_the_log_is_a_count():
    with pytest.raises(ValueError, match="log_interval must be a whole number, at least 1, got 0"):
        make().learn_offline(demonstrations(2), 2, log_interval=0)


def test_gradient_steps_are_a_count():
    with pytest.raises(ValueError, match="gradient_steps must be a whole number, at least 0, got -3"):
        make().learn_offline(demonstrations(2), -3)


def test_it_is_saved_and_loaded(learned, tmp_path):
    learned.save(tmp_path / "bc.zip")
    loaded = BC.load(tmp_path / "bc.zip", device="cpu")
    obs = learned.observation_space.sample()
    obs["delay"][:] = 2.0
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], learned.predict(obs, deterministic=True)[0]
    )
    assert loaded.num_timesteps == 200


def test_each_update_is_a_rollout_that_begins_and_ends():
    class Noted(BaseCallback):
        calls = ""

        def _on_rollout_start(self):
            self.calls += "("

        def _on_step(self):
            self.calls += "."
            return self.num_timesteps < 3

        def _on_rollout_end(self):
            self.calls += ")"

    callback = Noted()
    make().learn_offline(demonstrations(2), 5, callback=callback)
    assert callback.calls == "(.)(.)(."  # as SB3 leaves the last one, which a callback ends


def test_callbacks_follow_each_update_and_can_end_it():
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 7

    model = make().learn_offline(demonstrations(5), 20, callback=Stop())
    assert model.num_timesteps == model._n_updates == 7
    model.learn_offline(demonstrations(5), 5, reset_num_timesteps=False)
    assert model.num_timesteps == 12


@pytest.mark.parametrize(("log_interval", "rows"), [(10, [10]), (4, [4, 8, 10]), (100, [10]), (None, [])])
def test_the_last_row_of_the_log_is_at_the_end(log_interval, rows, tmp_path):
    model = make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn_offline(demonstrations(5), 10, log_interval=log_interval)
    with open(tmp_path / "progress.csv") as file:
        written = list(csv.DictReader(file))
    assert [int(row["train/n_updates"]) for row in written] == rows
    assert all(float(row["train/action_error"]) > 0 for row in written)


@pytest.mark.parametrize("n_envs", [None, 1, 2])
def test_a_bar_counts_gradient_steps(n_envs, tmp_path, monkeypatch):
    bars, calls, close = [], [], GradientStepBar._on_training_end

    def note(bar):
        bars.append((bar.pbar.n, bar.pbar.total))
        close(bar)

    monkeypatch.setattr(GradientStepBar, "_on_training_end", note)
    if n_envs is None:
        make(Drift()).save(tmp_path / "bc.zip")
        model = BC.load(tmp_path / "bc.zip", device="cpu")
    else:
        model = make(DummyVecEnv([Drift] * n_envs))
    count = ConvertCallback(lambda *given: calls.append(given) or True)
    for callback in (None, count, [count], count.callback):
        model.learn_offline(demonstrations(2), 5, callback=callback, progress_bar=True)
    assert bars == [(5, 5)] * 4 and len(calls) == 15


def test_equal_seeds_learn_alike_and_a_plain_task_is_delay_0():
    def weights():
        model = make(Drift()).learn_offline(demonstrations(5), 5)
        return th.cat([p.flatten() for p in model.actor.parameters()])

    assert th.equal(weights(), weights())


def test_data_of_another_task_is_refused():
    data = demonstrations(2)
    wrong = make(DelayedObservationWrapper(Wide(), 1))
    with pytest.raises(ValueError, match=r"of shape \(2,\), and the task \(3,\)"):
        wrong.learn_offline(data.to_replay(Drift.observation_space, Drift.action_space), 1)


class Wide(Drift):
    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)


def test_a_part_of_the_ages_of_logs_is_exchanged_as_asked():
    model = make(delayed(delay=(0, 2)), relabelled_ages=0.3)
    model.take_dataset(demonstrations(2))
    assert model.replay_buffer.relabelled_ages == 0.3


def test_logs_tell_no_ages_of_their_decisions():
    model = make(delayed(delay=(0, 2)))
    model.take_dataset(demonstrations(2))
    assert model.replay_buffer.window_source().ages is None
