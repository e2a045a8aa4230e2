"""Training episodes that have lost what was learned, and the average of StableSAC's actor, which waits for them."""

from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from hypothesis import given
from hypothesis import strategies as st
from small_agent import make
from small_task import Drift, delayed, pendulum
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, StableSAC
from sb3_said.sac.episodes import FORGETS, N_EPISODES, TrainingEpisodes

LEARNED, LOST, HELD = [0.0] * 10 + [100.0] * 10, [0.0] * 6, [0.0] * 4


def after(returns, n_steps=0):
    episodes = TrainingEpisodes()
    for each in returns:
        episodes.add(each, n_steps)
    return episodes


@given(st.lists(st.integers(-1000, 1000), max_size=40), st.integers(-3000, 3000), st.sampled_from([0.25, 1.0, 8.0]))
def test_half_of_what_was_learned(returns, offset, scale):
    """Where nothing is forgotten: means of ten against the first and the best, in rewards of any sign and unit."""
    means = [np.mean(returns[i : i + 10]) for i in range(len(returns) - 9)] or [0.0]
    fall = max(means) - means[-1]
    least = max(0.5 * (max(means) - means[0]), 1.2 * np.std(returns[-10:] or [0.0]))
    found = after([scale * x + offset for x in returns]).have_collapsed
    assert abs(fall - least) < 1e-9 or found == (fall > least)


def test_no_plateau_is_taken_for_a_collapse():
    """Of an agent that had learned before its first ten episodes here."""
    rng, waits = np.random.default_rng(0), []
    for returns in (3100.0 + 100.0 * rng.normal(size=1000), np.where(rng.random(1000) < 0.2, 600.0, 3100.0)):
        episodes = after(returns[:10])
        for each in returns[10:]:
            episodes.add(each, 1000)
            waits.append(episodes.have_collapsed)
    assert np.mean(waits) < 0.1


def test_a_task_that_returns_less_than_at_first_is_got_used_to():
    episodes = after([-200.0] * 10)
    for n in range(2000):
        episodes.add(-210.0 - n % 2, 200)
        assert episodes.have_collapsed or not 10 < n < 400
    assert not episodes.have_collapsed


def test_a_collapse_is_told_within_ten_episodes_and_its_end_too():
    assert not after(LEARNED + HELD).have_collapsed  # 60 of 100
    assert after(LEARNED + LOST).have_collapsed  # 40
    assert not after(LEARNED + LOST + [100.0] * 7).have_collapsed


def test_the_best_is_forgotten_where_nothing_returns_as_much_any_more():
    steps, episodes = 1000, after(LEARNED)
    n = 0
    while n < 10 or episodes.have_collapsed:
        episodes.add(20.0, steps)
        n += 1
    # best - 20 decays from 80 by a factor of 1 - steps / FORGETS an episode, and 20 is half of 40
    assert n == pytest.approx(np.log(80 / 20) / -np.log(1 - steps / FORGETS), abs=10)
    episodes.forget()
    assert not any(value.any() for value in episodes.buffers())


def test_training_counts_the_episodes_that_end():
    model = make(Drift(length=7), cls=StableSAC, learning_starts=1000).learn(90)
    episodes = model.policy.training_episodes
    returns = [info["r"] for info in model.ep_info_buffer]
    assert episodes.count == len(returns) == 12
    np.testing.assert_array_equal(episodes.newest, returns[-N_EPISODES:])
    assert episodes.first == pytest.approx(np.mean(returns[:10]))


@pytest.mark.parametrize("scales", [False, True])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_episodes_count_the_same_where_no_monitor_tells_of_them(n_envs, scales):
    def counted(*wrappers):
        def make_env():
            env = pendulum(7)
            for wrapper in wrappers:
                env = wrapper(env)
            return env

        env = DummyVecEnv([make_env] * n_envs)
        env = VecNormalize(env, norm_obs_keys=["observation"]) if scales else env
        return make(env, cls=StableSAC, learning_starts=1000).learn(105).policy.training_episodes

    known, own = counted(Monitor), counted()
    inside = counted(Monitor, partial(TimeLimit, max_episode_steps=5))  # whose Monitor sees no end
    for found in (known, own, inside):
        assert found.count == 105 // (5 if found is inside else 7) // n_envs * n_envs
    for name, value in known.named_buffers():
        th.testing.assert_close(getattr(own, name), value, rtol=0, atol=1e-5)  # a Monitor rounds to 6 digits
    assert inside.newest.std() > 0


@pytest.mark.parametrize(("decay", "waits"), [(0.5, True), (0.999, False)])
def test_the_average_waits_once_it_is_of_as_many_updates_as_it_remembers(decay, waits):
    model = make(Drift(), cls=StableSAC, actor_averaging=decay, policy_delay=1, learning_starts=1000).learn(30)
    weight = model.policy.averaged_actor.mu.weight

    def moves() -> bool:
        before = weight.clone()
        model.train(1, 16)
        return not th.equal(weight, before)

    model.train(3, 16)
    model.policy.training_episodes.load_state_dict(after(LEARNED + LOST).state_dict())
    assert moves() != waits
    assert model.logger.name_to_value["train/average_waits"] == 1.0
    model.policy.training_episodes.load_state_dict(after(LEARNED + HELD).state_dict())
    assert moves()
    assert model.logger.name_to_value["train/average_waits"] == 0.0


def test_it_is_part_of_a_training_and_not_of_the_next(tmp_path):
    model = make(delayed(2), cls=SAID).learn(30)
    model.policy.training_episodes.load_state_dict(after(LEARNED + LOST).state_dict())
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", env=delayed(2), device="cpu")
    assert loaded.policy.training_episodes.have_collapsed
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.policy.training_episodes.have_collapsed
    loaded.learn(1)
    assert loaded.policy.training_episodes.count == 0


def test_an_agent_of_before_they_were_counted_is_taken_over():
    model, other = make(delayed(2), cls=SAID).learn(30), make(delayed(2), cls=SAID)
    given = model.get_parameters()
    given["policy"] = {name: x for name, x in given["policy"].items() if not name.startswith("training_episodes.")}
    other.set_parameters(given)
    th.testing.assert_close(other.actor.state_dict(), model.actor.state_dict())
    assert other.policy.training_episodes.count == 0


def test_without_an_average_nothing_is_counted():
    assert make(Drift(), cls=StableSAC, actor_averaging=0.0).learn(30).policy.training_episodes is None
