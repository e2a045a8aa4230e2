"""Learning goes on where it was cut short: the replay holds what happened, whoever ended or disturbed a rollout."""

import copy
from functools import partial

import numpy as np
import pytest
from kill import Kill, Killed
from small_agent import make as make_agent
from small_task import Drift, delayed
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import DelayedSAC, StableSAC
from sb3_said.delays.space import UNDELAYED

make = partial(make_agent, cls=DelayedSAC)


class Stop(BaseCallback):
    """Ends training at a step."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        return self.num_timesteps < self.at


def record(model, monkeypatch):
    """Return a list that will hold, step for step, the observations that the replay is given and the true states."""
    rows, add = [], model.replay_buffer.add

    def note(obs, next_obs, action, reward, done, infos):
        obs, next_obs = copy.deepcopy((obs, next_obs))
        if not isinstance(obs, dict):
            obs, next_obs = {"observation": obs}, {"observation": next_obs}
        after = infos[0].get(UNDELAYED, next_obs["observation"][0])
        rows.append((obs, next_obs, after))
        add(obs, next_obs, action, reward, done, infos)

    monkeypatch.setattr(model.replay_buffer, "add", note)
    return rows


def assert_replay_is_what_happened(model, rows):
    """Compare every row, and the steps of the task itself, with what the replay makes of them."""
    buffer = model.replay_buffer
    assert buffer.size() == len(rows) and buffer.n_envs == 1
    batch = buffer._get_samples(np.arange(len(rows)))
    states, history = batch.observations, "action_history"
    if not buffer.is_delayed:
        states = {"observation": states, UNDELAYED: states}
    for t, (obs, next_obs, after) in enumerate(rows):
        for key, value in obs.items():
            np.testing.assert_array_equal(states[key][t], value[0], err_msg=f"{key} at {t}")
        if history in obs:
            np.testing.assert_array_equal(next_obs[history][0, :-1], obs[history][0, 1:], err_msg=f"at {t}")
        state, action = states[UNDELAYED][t].numpy(), 2.0 * batch.actions[t].numpy()
        np.testing.assert_allclose(after, 0.9 * state + 0.1 * np.array([action[0], state[0]]), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4), lambda: delayed(1)], ids=["plain", "4", "1"])
@pytest.mark.parametrize("end", [lambda: StopTrainingOnMaxEpisodes(2), lambda: Stop(15), lambda: Kill(15)])
def test_learning_goes_on_after_a_rollout_that_was_cut_short(make_env, end, monkeypatch):
    model = make(make_env(), learning_starts=100)
    rows = record(model, monkeypatch)
    try:
        model.learn(100, callback=end())
    except Killed:
        pass
    stopped = model.num_timesteps  # with the step that SB3 has not stored
    assert len(rows) == stopped - 1
    model.learn(30, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)
    steps = model.replay_buffer.steps[: len(rows), 0]
    assert steps.max() == 11 and steps[stopped - 1] == 0
    assert model.replay_buffer.window_source().remaining.max() == 12


@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4)], ids=["plain", "4"])
def test_consecutive_learning_goes_on_amid_an_episode(make_env, monkeypatch):
    model = make(make_env(), learning_starts=100)
    rows = record(model, monkeypatch)
    for _ in range(4):
        model.learn(10, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)
    assert model.replay_buffer.steps[:40, 0].tolist() == [*range(12), *range(12), *range(12), *range(4)]


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4)], ids=["plain", "delayed"])
def test_learning_goes_on_where_the_replay_has_not_seen_the_episode(make_env, normalize, monkeypatch, tmp_path):
    env = make_vec_env(make_env, n_envs=1)
    env = VecNormalize(env, norm_obs_keys=["observation"] if make_env is not Drift else None) if normalize else env
    model = make(env, learning_starts=100).learn(20)
    model.save(tmp_path / "agent")
    model.replay_buffer.reset()
    rows = record(model, monkeypatch)
    model.learn(30, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)

    model.learn(20)
    loaded = DelayedSAC.load(tmp_path / "agent", env=model.env, force_reset=False, device="cpu")
    rows = record(loaded, monkeypatch)
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.num_timesteps == 50 and len(rows) == 30
    assert_replay_is_what_happened(loaded, rows)


@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4)], ids=["plain", "4"])
@pytest.mark.parametrize("cls", [DelayedSAC, StableSAC])
def test_a_callback_may_play_the_environment_after_a_step(make_env, cls, monkeypatch):
    class Play(BaseCallback):
        def _on_step(self):
            if self.n_calls % 15 == 0:
                with self.model.borrowed_env() as env:
                    env.reset()
                    env.step(np.array([env.action_space.sample()]))
            return True

    model = make(make_env(), cls=cls, learning_starts=100)
    rows = record(model, monkeypatch)
    model.learn(70, callback=Play())
    assert model.num_timesteps == 70 and len(rows) == 70 - 4  # whose observations are gone
    assert_replay_is_what_happened(model, rows)


def normalized():
    return VecNormalize(make_vec_env(lambda: delayed(4), n_envs=1), norm_obs_keys=["observation"])


@pytest.mark.parametrize(
    "make_env", [Drift, lambda: delayed(4), lambda: delayed(0), normalized], ids=["plain", "4", "0", "normalised"]
)
@pytest.mark.parametrize("n_episodes", [1, 2])
def test_the_environment_may_be_played_between_two_calls(make_env, n_episodes, monkeypatch):
    model = make(make_env(), learning_starts=100)
    rows = record(model, monkeypatch)
    model.learn(25)
    evaluate_policy(model, model.get_env(), n_episodes, warn=False)
    model.learn(30, reset_num_timesteps=False)
    assert len(rows) == 55 and model.replay_buffer.steps[24:26, 0].tolist() == [0, 0]
    assert_replay_is_what_happened(model, rows)


def test_a_reset_between_two_calls_is_seen_at_the_start_of_an_episode_too(monkeypatch):
    model = make(Drift(), train_freq=(1, "episode"), learning_starts=100)
    rows = record(model, monkeypatch)
    model.learn(12)
    model.get_env().reset()
    model.learn(12, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)


def test_a_long_episode_goes_on_beside_one_that_begins():
    model = make(DummyVecEnv([(lambda n=n: Monitor(Drift(length=n))) for n in (5, 7, 200)]), learning_starts=10**6)
    for _ in range(20):
        model.learn(5 * 3, reset_num_timesteps=False)  # the first begins an episode each time
    replay = model.replay_buffer
    assert replay.steps.max(0).tolist() == [4, 6, 99]
    assert np.array_equal(replay.ends[:99], replay.dones[:99] == 1)  # none was cut
    model.env.reset()
    model.learn(5 * 3, reset_num_timesteps=False)
    assert replay.steps[100].tolist() == [0, 0, 0]


@pytest.mark.parametrize("rewards", [0.0, ("a", "b")])
def test_a_task_whose_attributes_have_a_monitors_names_is_none(rewards, monkeypatch):
    class Named(Drift):
        total_steps = 200

    Named.rewards = rewards
    model = make(DummyVecEnv([Named]), learning_starts=100)
    rows = record(model, monkeypatch)
    model.learn(25)
    evaluate_policy(model, model.get_env(), 1, warn=False)
    model.learn(10, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)


def test_a_loaded_agent_without_an_environment_is_told_so(tmp_path):
    make().save(tmp_path / "agent.zip")
    with pytest.raises(AssertionError, match="set the environment"):  # SB3's
        DelayedSAC.load(tmp_path / "agent.zip", device="cpu").learn(10)


@pytest.mark.parametrize("make_env", [Drift, delayed])
def test_learning_goes_on_under_monitors_that_refuse_resets(make_env):
    env = make_vec_env(make_env, 2, monitor_kwargs={"allow_early_resets": False})
    model = make(env).learn(100, callback=Stop(at=26))
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 46
    assert model.learn(17).num_timesteps == 18  # counted anew, from a reset
    with pytest.raises(RuntimeError, match="reset"):
        env.reset()


@pytest.mark.parametrize("eval_freq", [20, 24])  # amid an episode, and at its end
def test_who_plays_the_environment_during_learning_is_told_what_to_do(eval_freq):
    env = make_vec_env(lambda: delayed(4), n_envs=1)
    with pytest.raises(ValueError, match=r"evaluate_policy.*an environment of its own"):
        make(env).learn(50, callback=EvalCallback(env, eval_freq=eval_freq, n_eval_episodes=1, warn=False, verbose=0))


def test_a_replay_emptied_during_training_is_refused_with_what_to_do():
    class Forget(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 30:
                self.model.replay_buffer.reset()
            return True

    with pytest.raises(ValueError, match=r"between two calls of learn\(\)"):
        make(delayed(4)).learn(60, callback=Forget())
