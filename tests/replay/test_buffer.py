"""The replay: it samples what a store of whole transitions would, bit for bit, at the memory of states alone."""

import copy
import sys
from dataclasses import replace

import numpy as np
import pytest
from counting_task import ACT_DIM, OBS_DIM, Player, Row
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from random_processes import processes
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.delays import UniformDelay
from sb3_said.delays.space import UNDELAYED, delayed_space
from sb3_said.files.archive import load_tree, save_tree
from sb3_said.replay.buffer import DelayedReplayBuffer


def make_buffer(player, steps_per_env=20, buffer_class=DelayedReplayBuffer, **kwargs):
    vec = player.vec
    size = steps_per_env * vec.num_envs
    return buffer_class(size, vec.observation_space, vec.action_space, "cpu", n_envs=vec.num_envs, **kwargs)


def fill(buffer, rows):
    for row in rows:
        buffer.add(*row.added())
    return buffer


def batch_arrays(batch):
    """Flatten a sampled batch to name -> array."""
    arrays = {}
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        value = getattr(batch, name)
        for key, x in value.items() if isinstance(value, dict) else [("", value)]:
            arrays[f"{name}/{key}"] = x.numpy()
    return arrays


def assert_same_samples(first, second, batch_size=500, **kwargs):
    np.random.seed(1)
    expected = batch_arrays(first.sample(batch_size, **kwargs))
    np.random.seed(1)
    sampled = batch_arrays(second.sample(batch_size, **kwargs))
    assert expected.keys() == sampled.keys()
    for name in expected:
        np.testing.assert_array_equal(sampled[name], expected[name], err_msg=name)


def naive_transition(row: Row, env: int, max_delay: int) -> dict[str, np.ndarray]:
    arrays = {}
    before, after = ("observations", row.obs, row.states), ("next_observations", row.next_obs, row.next_states)
    for name, obs, states in (before, after):
        arrays.update({f"{name}/{key}": x[env] for key, x in obs.items()})
        arrays[f"{name}/{UNDELAYED}"] = states[env]
    executed = row.next_obs["action_history"][env, -1] if max_delay > 0 else row.action[env]
    arrays["actions/"] = executed
    arrays["dones/"] = np.array([row.terminated[env]], np.float32)
    arrays["rewards/"] = np.array([row.reward[env]], np.float32)
    return arrays


def assert_exact(buffer, rows, batch_size=3000):
    """Compare samples with the transitions themselves, found by the unique first component of the true state."""
    stored = rows[-buffer.buffer_size :]
    if len(rows) >= buffer.buffer_size:
        stored = stored[buffer.max_delay :]  # the past of the oldest is overwritten
    naive = {
        int(row.states[env, 0]): naive_transition(row, env, buffer.max_delay)
        for row in stored
        for env in range(buffer.n_envs)
    }
    sampled = batch_arrays(buffer.sample(batch_size))
    tags = sampled[f"observations/{UNDELAYED}"][:, 0].astype(int)
    there, places = np.unique(tags, return_inverse=True)
    assert there.tolist() == sorted(naive)  # all that can be rebuilt, and nothing else
    for name, values in sampled.items():
        np.testing.assert_array_equal(values, np.stack([naive[tag][name] for tag in there])[places], err_msg=name)


# ---------------------------------------------------------------------------------------------------- exactness


@st.composite
def players_and_sizes(draw):
    low = draw(st.integers(0, 5))
    high = draw(st.integers(low, 6))
    max_delay = draw(st.integers(high, 8))
    player = Player(
        n_envs=draw(st.integers(1, 3)),
        delay=draw(st.sampled_from([high, (low, high)])),
        max_delay=max_delay,
        max_length=draw(st.sampled_from([1, 3, 10, 30])),
        interruption=draw(st.sampled_from([0.0, 0.1, 0.5])),
        seed=draw(st.integers(0, 2**16)),
    )
    return player, draw(st.integers(max_delay + 2, 30))


@settings(max_examples=40, deadline=None)
@given(players_and_sizes(), st.integers(1, 90))
def test_samples_are_the_transitions_themselves(player_and_size, n_steps):
    player, steps_per_env = player_and_size
    rows = player.play(n_steps)
    assert_exact(fill(make_buffer(player, steps_per_env), rows), rows)


@settings(max_examples=30, deadline=None)
@given(processes(), st.sampled_from(["newest", "independent"]), st.integers(0, 2**16), st.integers(2, 20))
def test_samples_are_the_transitions_themselves_however_ages_jump(process, receiver, seed, spare):
    player = Player(delay=process, receiver=receiver, max_length=25, interruption=0.05, seed=seed)
    rows = player.play(50)
    assert_exact(fill(make_buffer(player, process.max_delay + spare), rows), rows)


def pasts_and_rows(rows):
    """Map the tag of each true state to the states of its episode up to the next one, its row and its environment."""
    found = {}
    for env in range(len(rows[0].done)):
        past = []
        for row in rows:
            past = [*past, row.states[env]]
            found[int(row.states[env, 0])] = [*past, row.next_states[env]], row, env
            if row.done[env] or row.interrupted:
                past = []
    return found


@settings(max_examples=40, deadline=None)
@given(players_and_sizes(), st.integers(1, 90), st.sampled_from([0.3, 1.0]))
def test_relabelled_ages_show_what_would_have_been_observed_at_them(player_and_size, n_steps, part):
    player, steps_per_env = player_and_size
    rows = player.play(n_steps)
    found = pasts_and_rows(rows)
    sampled = batch_arrays(fill(make_buffer(player, steps_per_env, relabelled_ages=part), rows).sample(300))
    ages, next_ages = (sampled[f"{name}/delay"][:, 0].astype(int) for name in ("observations", "next_observations"))
    assert np.all(next_ages <= ages + 1)
    expected = []
    for i, tag in enumerate(sampled[f"observations/{UNDELAYED}"][:, 0].astype(int)):
        states, row, env = found[tag]
        seen = {"observations/observation": states[:-1][-1 - ages[i]], "observations/delay": ages[[i]]}
        seen |= {"next_observations/observation": states[-1 - next_ages[i]], "next_observations/delay": next_ages[[i]]}
        expected.append(naive_transition(row, env, player.vec.observation_space["action_history"].shape[0]) | seen)
    for name, values in sampled.items():
        np.testing.assert_array_equal(values, np.stack([each[name] for each in expected]), err_msg=name)


def test_that_part_of_the_ages_is_exchanged():
    player = Player(delay=(0, 4), max_length=60)
    rows = player.play(1500)
    buffer, found = fill(make_buffer(player, 2000), rows), pasts_and_rows(rows)
    np.random.seed(0)
    for part in (0.0, 0.4, 1.0):
        buffer.relabelled_ages = part
        sampled = batch_arrays(buffer.sample(20_000))
        transitions = [found[tag] for tag in sampled[f"observations/{UNDELAYED}"][:, 0]]
        late = np.array([len(states) > 6 for states, _, _ in transitions])  # before, the largest ages do not fit
        own = np.array([row.obs["delay"][env, 0] for _, row, env in transitions])[late]
        shown = sampled["observations/delay"][late, 0]
        # Of a mixture of the own age and an independent one of the same distribution
        assert np.corrcoef(own, shown)[0, 1] == pytest.approx(1.0 - part, abs=0.03)
        for age in range(5):
            assert np.mean(shown == age) == pytest.approx(np.mean(own == age), abs=0.02)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 5), st.sampled_from([1, 3, 10, 30]), st.integers(0, 2**16))
def test_of_one_delay_there_is_nothing_to_exchange(delay, max_length, seed):
    player = Player(delay=delay, max_delay=5, max_length=max_length, seed=seed)
    rows = player.play(45)
    assert_exact(fill(make_buffer(player, 20, relabelled_ages=1.0), rows), rows)


@settings(max_examples=30, deadline=None)
@given(players_and_sizes(), st.integers(0, 70), st.integers(1, 50), st.integers(0, 40))
def test_a_restored_replay_goes_on_as_if_never_saved(player_and_size, n_before, n_after, n_other):
    player, steps_per_env = player_and_size
    before = player.play(n_before)
    buffer = fill(make_buffer(player, steps_per_env), before)
    other = replace(player, seed=player.seed + 1)
    restored = fill(make_buffer(player, steps_per_env), other.play(n_other))  # what it held does not matter
    restored.load_state_dict(copy.deepcopy(buffer.state_dict()))
    after = player.play(n_after)
    fill(buffer, after), fill(restored, after)
    assert_same_samples(buffer, restored)
    assert_exact(restored, before + after)


def test_a_replay_restored_from_a_file_continues_the_episode(tmp_path):
    player = Player(max_length=50)  # saved amid an episode, of which no row may look like an end
    before = player.play(25)
    buffer = fill(make_buffer(player), before)
    save_tree(tmp_path / "replay.zip", buffer.state_dict())
    restored = make_buffer(player)
    restored.load_state_dict(load_tree(tmp_path / "replay.zip"))
    assert_same_samples(buffer, restored)
    after = player.play(7)
    fill(buffer, after), fill(restored, after)
    assert_same_samples(buffer, restored)
    assert_exact(restored, before + after)
    assert restored.tails.keys() == buffer.tails.keys()


def test_an_interruption_neither_ends_an_episode_nor_joins_two():
    player = Player(n_envs=1, delay=2, max_length=1000)
    first = player.play(5)
    player.obs = player.vec.reset()  # no done: as a resumed run does
    rows = first + player.play(5)
    buffer = fill(make_buffer(player), rows)
    assert_exact(buffer, rows)
    assert buffer.dones.sum() == 0
    assert buffer.steps[:10, 0].tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]
    assert buffer.window_source().remaining.tolist() == [5, 4, 3, 2, 1] * 2


def test_an_end_is_an_end_though_the_next_episode_starts_where_it_ended():
    player = Player(n_envs=1, delay=None)
    buffer = make_buffer(player)
    state = np.ones((1, OBS_DIM), np.float32)
    for t in range(6):
        done = np.array([t % 3 == 2])
        buffer.add(state, state, np.zeros((1, ACT_DIM)), np.zeros(1), done, [{}])
    assert buffer.window_source().remaining.tolist() == [3, 2, 1, 3, 2, 1]
    assert buffer.steps[:6, 0].tolist() == [0, 1, 2, 0, 1, 2]


def test_each_environment_has_its_own_episodes():
    player = Player(n_envs=3, delay=(0, 4), max_length=8)
    rows = player.play(200)
    assert any(row.done.sum() == 1 for row in rows) and len({tuple(row.obs["delay"].ravel()) for row in rows}) > 5
    assert_exact(fill(make_buffer(player, 50), rows), rows)


def test_the_stored_action_is_the_one_that_histories_hold():
    player = Player(n_envs=1, delay=1, max_length=100)
    rows = player.play(10)
    buffer = fill(make_buffer(player), rows)
    for t in range(9):
        np.testing.assert_array_equal(buffer.actions[t], rows[t + 1].obs["action_history"][:, -1])
        np.testing.assert_allclose(buffer.actions[t], rows[t].action, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(processes(), st.sampled_from(["newest", "independent"]), st.integers(0, 2**16))
def test_actions_that_take_a_time_each_are_stored_as_they_are_executed(process, receiver, seed):
    player = Player(
        n_envs=1, delay=process, action_delay=UniformDelay(0, 3), receiver=receiver, max_length=25, seed=seed
    )
    rows = player.play(70)
    batch = batch_arrays(fill(make_buffer(player, 80), rows).sample(200))
    first = int(rows[0].states[0, 0])
    row_of = {int(row.states[0, 0]): row for row in rows}
    tags, first_samples = np.unique(batch[f"observations/{UNDELAYED}"][:, 0].astype(int), return_index=True)
    for tag, i in zip(tags.tolist(), first_samples, strict=True):
        row = row_of[tag]
        np.testing.assert_array_equal(batch["actions/"][i], row.infos[0]["executed_action"])
        np.testing.assert_array_equal(batch[f"next_observations/{UNDELAYED}"][i], row.next_states[0])
        n_unseen = int(row.obs["delay"].item())  # what was executed since, instead of what was sent since
        np.testing.assert_array_equal(batch["observations/delay"][i], [n_unseen])
        assert tag - n_unseen >= first
        np.testing.assert_array_equal(batch["observations/observation"][i], row_of[tag - n_unseen].states[0])
        for k in range(1, n_unseen + 1):
            executed = row_of[tag - k].infos[0]["executed_action"]
            np.testing.assert_array_equal(batch["observations/action_history"][i, -k], executed)


def test_the_info_of_a_task_without_the_wrapper_is_its_own():
    space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    buffer = DelayedReplayBuffer(4, space, space)
    obs, action = np.zeros((1, 2), np.float32), np.full((1, 2), 0.5, np.float32)
    buffer.add(obs, obs, action, np.zeros(1), np.zeros(1), [{"executed_action": np.array([7.0, 8.0])}])
    np.testing.assert_array_equal(buffer.actions[0], action)


def test_delay_zero_has_empty_histories():
    player = Player(delay=0)
    rows = player.play(50)
    buffer = fill(make_buffer(player), rows)
    assert_exact(buffer, rows)
    batch = buffer.sample(7)
    for observations in (batch.observations, batch.next_observations):
        assert observations["action_history"].shape == (7, 0, ACT_DIM)
    np.testing.assert_array_equal(batch.observations["observation"], batch.observations[UNDELAYED])


@pytest.mark.parametrize("handled", [True, False])
def test_time_limits_are_no_terminations(handled):
    player = Player(n_envs=1, max_length=2)
    rows = player.play(60)
    buffer = fill(make_buffer(player, 100, handle_timeout_termination=handled), rows)
    batch = buffer.sample(1000)
    done = {int(row.states[0, 0]): float(row.terminated[0] if handled else row.done[0]) for row in rows}
    tags = batch.observations[UNDELAYED][:, 0].tolist()
    assert batch.dones[:, 0].tolist() == [done[int(tag)] for tag in tags]
    assert sum(row.done[0] for row in rows) > sum(row.terminated[0] for row in rows) > 0


# ---------------------------------------------------------------------------------------------------- SB3's own buffers


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("n_steps", [1, 13, 20, 67])
def test_equals_sb3_on_a_plain_task(n_steps, normalised):
    player = Player(n_envs=3, delay=None)
    rows = player.play(n_steps)
    ours, theirs = fill(make_buffer(player), rows), fill(make_buffer(player, buffer_class=ReplayBuffer), rows)
    assert_same_samples(theirs, ours, env=trained_normalizer(player, rows) if normalised else None)


@pytest.mark.parametrize("n_steps", [1, 19])  # not full: there SB3's row numbers are ours, random numbers and all
def test_equals_sb3_on_a_delayed_task_with_true_states_beside(n_steps):
    player = Player(n_envs=2, delay=(0, 3))
    rows = player.play(n_steps)
    ours, theirs = fill(make_buffer(player), rows), fill(make_buffer(player, buffer_class=DictReplayBuffer), rows)
    env = trained_normalizer(player, rows, norm_obs_keys=["observation"])
    np.random.seed(0)
    expected = batch_arrays(theirs.sample(300, env=env))
    np.random.seed(0)
    sampled = batch_arrays(ours.sample(300, env=env))
    assert set(sampled) - set(expected) == {f"observations/{UNDELAYED}", f"next_observations/{UNDELAYED}"}
    for name, values in expected.items():
        # SB3 stores the action as sent to the wrapper, which scales it back with a rounding error
        np.testing.assert_allclose(sampled[name], values, atol=1e-6 if name == "actions/" else 0, rtol=0, err_msg=name)


def trained_normalizer(player, rows, **kwargs):
    env = VecNormalize(player.vec, **kwargs)
    rms = env.obs_rms["observation"] if isinstance(env.obs_rms, dict) else env.obs_rms
    rms.update(np.concatenate([row.states for row in rows]))
    env.ret_rms.update(np.concatenate([5 * row.reward for row in rows]))
    return env


def test_an_episode_s_last_observation_may_be_clipped():
    """By VecNormalize, whose own statistics bring it back to environment units."""
    player = Player(delay=3)
    buffer, ended = make_buffer(player), []
    for row in player.play(40):
        for env in np.flatnonzero(row.done):
            row.next_obs["observation"][env] += 0.5
            ended.append(env)
        fill(buffer, [row])
    assert ended


def test_true_states_are_normalised_with_the_statistics_of_observations():
    player = Player(delay=3)
    rows = player.play(40)
    buffer = fill(make_buffer(player), rows)
    env = trained_normalizer(player, rows, norm_obs_keys=["observation"])
    np.random.seed(2)
    raw = buffer.sample(200)
    np.random.seed(2)
    batch = buffer.sample(200, env=env)
    rms = env.obs_rms["observation"]
    for name in ("observations", "next_observations"):
        before, after = getattr(raw, name), getattr(batch, name)
        for key in ("observation", UNDELAYED):
            scaled = np.clip((before[key].numpy() - rms.mean) / np.sqrt(rms.var + env.epsilon), -10, 10)
            np.testing.assert_allclose(after[key], scaled, rtol=1e-5, atol=1e-6)
        for key in ("action_history", "delay"):
            np.testing.assert_array_equal(after[key], before[key])
    rewards = np.clip(raw.rewards.numpy() / np.sqrt(env.ret_rms.var + env.epsilon), -10, 10)
    np.testing.assert_allclose(batch.rewards, rewards, rtol=1e-5)
    np.testing.assert_array_equal(batch.dones, raw.dones)


def test_extend_adds_a_batch():
    player = Player()
    rows = player.play(30)
    one_by_one, at_once = fill(make_buffer(player), rows), make_buffer(player)
    at_once.extend(*zip(*[row.added() for row in rows], strict=True))
    assert_same_samples(one_by_one, at_once)


@pytest.mark.parametrize("n_before", [7, 33])
def test_sb3s_pickle(tmp_path, n_before):
    player = Player(max_length=15)
    before = player.play(n_before)
    buffer = fill(make_buffer(player), before)
    save_to_pkl(tmp_path / "replay.pkl", buffer)
    loaded = load_from_pkl(tmp_path / "replay.pkl")
    after = player.play(9)
    assert_same_samples(fill(buffer, after), fill(loaded, after))
    assert_exact(loaded, before + after)


def test_reset_forgets_everything():
    player = Player(max_length=3, delay=3)
    buffer = fill(make_buffer(player), player.play(45))  # many episode ends, all over the rows
    buffer.reset()
    assert buffer.size() == 0
    player.obs = player.vec.reset()
    rows = player.play(15)
    assert_exact(fill(buffer, rows), rows)
    fresh = fill(make_buffer(player), rows)
    assert_same_samples(fresh, buffer)
    np.testing.assert_array_equal(buffer.window_source().remaining, fresh.window_source().remaining)


# ---------------------------------------------------------------------------------------------------- memory


def memory_per_transition(delay, episode_length, n_steps=1000):
    """Return bytes of all that is stored over the transitions it holds, for Ant-v5's dimensions."""
    state_space, act_space = spaces.Box(-np.inf, np.inf, (105,)), spaces.Box(-1, 1, (8,))
    buffer = DelayedReplayBuffer(n_steps, delayed_space(state_space, act_space, delay), act_space)
    history, action = np.zeros((1, delay, 8), np.float32), np.zeros((1, 8), np.float32)
    for t in range(n_steps + n_steps // 2):
        step = t % episode_length
        obs, next_obs = (
            {
                "observation": np.full((1, 105), t + k - min(step + k, delay), np.float32),
                "action_history": history,
                "delay": np.array([[min(step + k, delay)]], np.float32),
            }
            for k in (0, 1)
        )
        done = np.array([step == episode_length - 1])
        buffer.add(obs, next_obs, action, np.zeros(1), done, [{UNDELAYED: np.full(105, t + 1, np.float32)}])
    arrays = sum(x.nbytes for x in vars(buffer).values() if isinstance(x, np.ndarray))
    number = sys.getsizeof(1)  # where Python 3.10's 0 has four bytes less
    tails = sum(max(sys.getsizeof(x), number) for place, tail in buffer.tails.items() for x in (place, tail, *tail))
    return (arrays + tails) / n_steps


@pytest.mark.parametrize("episode_length", [50, 1000])  # early, and grown-up, Ants
def test_memory_for_ant(episode_length):
    at_16 = memory_per_transition(16, episode_length)
    assert at_16 <= 550  # 0.55 GB per million
    assert at_16 == memory_per_transition(0, episode_length)


def test_tails_go_with_their_rows():
    player = Player(max_length=1)  # the worst case: every row ends an episode
    buffer = make_buffer(player, 30)
    sizes = []
    for _ in range(5):
        fill(buffer, player.play(60))
        sizes.append(len(buffer.tails))
    assert len(set(sizes)) == 1 and sizes[0] == buffer.ends.sum() <= 2 * 30


# ---------------------------------------------------------------------------------------------------- refusals


def test_sb3s_memory_option_is_refused():
    with pytest.raises(ValueError, match="optimize_memory_usage=False"):
        make_buffer(Player(), optimize_memory_usage=True)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_buffer_shorter_than_the_delay_names_the_smallest_that_works(n_envs):
    player = Player(n_envs=n_envs, delay=4, max_length=30)
    with pytest.raises(ValueError, match=f"buffer_size of at least {6 * n_envs}"):
        make_buffer(player, 5)
    rows = player.play(40)
    assert_exact(fill(make_buffer(player, 6), rows), rows)


@pytest.mark.parametrize("part", [-0.1, 1.5])
def test_only_a_part_of_the_ages_can_be_exchanged(part):
    with pytest.raises(ValueError, match=r"in \[0, 1\]"):
        make_buffer(Player(), relabelled_ages=part)


def test_an_empty_buffer_has_nothing_to_give():
    buffer = make_buffer(Player())
    with pytest.raises(ValueError, match="empty"):
        buffer.sample(1)
    with pytest.raises(ValueError, match="empty"):
        buffer.window_source()


def test_the_true_state_is_required():
    player = Player()
    row = player.play(1)[0]
    del row.infos[1][UNDELAYED]
    with pytest.raises(ValueError, match=r"environment 1 has no 'undelayed_observation'.*DelayedObservationWrapper"):
        make_buffer(player).add(*row.added())


def test_transitions_out_of_order_are_refused():
    player = Player(delay=3, max_length=100)
    rows = player.play(6)
    with pytest.raises(ValueError, match="2 steps old: transitions must be added in the order they happened"):
        make_buffer(player).add(*rows[2].added())
    with pytest.raises(ValueError, match="in the order they happened"):
        fill(make_buffer(player), [*rows[:3], *rows[4:]])


def test_an_episode_joined_at_age_zero_is_refused_too():
    player = Player(n_envs=1, delay=0, max_delay=3, max_length=100)
    rows = player.play(6)
    assert rows[2].obs["delay"] == 0
    with pytest.raises(ValueError, match=r"environment 0 .* 2 actions sent before"):
        make_buffer(player).add(*rows[2].added())
    buffer = fill(make_buffer(player), rows[:2])
    with pytest.raises(ValueError, match=r"environment 0 .* 3 actions sent before"):
        buffer.add(*rows[3].added())
    assert_exact(fill(buffer, rows[2:]), rows)  # a refusal changes nothing


def test_a_step_between_two_observations_that_do_not_follow_each_other_is_refused():
    player = Player(n_envs=2, delay=3, max_length=100)
    rows = player.play(8)
    stale = replace(rows[5], obs=rows[4].obs)  # as after a step that was taken and not stored
    buffer = fill(make_buffer(player), rows[:4])
    with pytest.raises(ValueError, match=r"environment 0 does not follow .* go below DelayedObservationWrapper"):
        buffer.add(*stale.added())
    assert_exact(fill(buffer, rows[4:]), rows)


def damaged(row, part, env, value):
    """Return a step of which one environment's part is a value that it should not be."""
    row = copy.deepcopy(row)
    is_delayed = isinstance(row.obs, dict)
    parts = {
        "reward": row.reward,
        "action": row.action,
        "observation before the action": row.obs["observation"] if is_delayed else row.obs,
        "observation after the action": row.next_obs,
    }
    if is_delayed and part == "observation after the action":
        row.infos[env][UNDELAYED][:] = value
    else:
        parts[part][env] = value
    return row


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("delay", [None, 0, 3])
@pytest.mark.parametrize("part", ["reward", "action", "observation after the action", "observation before the action"])
def test_what_is_not_finite_is_refused_and_nothing_of_the_step_is_stored(part, delay, value):
    player = Player(n_envs=3, delay=delay, max_length=4, seed=3)
    rows = player.play(20)
    buffer = fill(make_buffer(player, 30), rows[:9])
    before = copy.deepcopy(buffer.state_dict())
    with pytest.raises(ValueError, match=f"The {part} of environment 2 is not finite"):
        buffer.add(*damaged(rows[9], part, 2, value).added())
    np.testing.assert_equal(buffer.state_dict(), before)
    expected = fill(make_buffer(player, 30), rows)
    assert_same_samples(expected, fill(buffer, rows[9:]))


def test_what_float32_cannot_hold_is_refused():
    player = Player()
    row = player.play(1)[0]
    with pytest.raises(ValueError, match="reward of environment 1 is not finite"):
        make_buffer(player).add(*replace(row, reward=np.array([1.0, 1e300])).added())


@pytest.mark.parametrize("delay", [None, 2])
def test_a_time_limit_may_be_told_by_an_array(delay):
    player = Player(n_envs=2, delay=delay, max_length=3)
    rows = player.play(19)
    told = copy.deepcopy(rows)
    for row in told:
        row.infos[1]["TimeLimit.truncated"] = np.array([row.infos[1]["TimeLimit.truncated"]])
    assert any(row.infos[1]["TimeLimit.truncated"] for row in rows)
    assert_same_samples(fill(make_buffer(player), rows), fill(make_buffer(player), told))


def test_true_states_of_another_size_are_refused_with_what_to_do():
    player = Player()
    row = player.play(1)[0]
    row.infos[1][UNDELAYED] = np.zeros(OBS_DIM + 1, np.float32)
    with pytest.raises(ValueError, match=r"environment 1 has the shape \(4,\), .* go below DelayedObservationWrapper"):
        make_buffer(player).add(*row.added())


@pytest.mark.parametrize("delay", [0, 1, 3, UniformDelay(0, 3)])
def test_observations_that_are_not_the_states_of_their_age_are_refused(delay):
    """As a wrapper around ours makes them, by scaling or adding noise; a replay could not tell them from the states."""
    player = Player(delay=delay, max_length=100)
    rows = player.play(12)
    assert not any(row.done.any() for row in rows)
    for t in (0, 1, 2, 11):
        row = copy.deepcopy(rows[t])
        row.next_obs["observation"][1] *= 1.01
        buffer = fill(make_buffer(player), rows[:t])
        age = int(row.next_obs["delay"][1, 0])
        with pytest.raises(
            ValueError, match=f"environment 1 has age {age}, but is not the state of {age} steps before"
        ):
            buffer.add(*row.added())
        assert_exact(fill(buffer, rows[t:]), rows)


OTHER_BUFFERS = {
    "size": lambda: make_buffer(Player(), 19),
    "full size": lambda: make_buffer(Player(), 30),
    "environments": lambda: make_buffer(Player(n_envs=3)),
    "max_delay": lambda: make_buffer(Player(max_delay=5)),
    "no delay": lambda: make_buffer(Player(delay=None)),
    "actions": lambda: DelayedReplayBuffer(40, *boxes(OBS_DIM, 3), n_envs=2),
    "states": lambda: DelayedReplayBuffer(40, *boxes(OBS_DIM + 1, 2), n_envs=2),
}


def boxes(obs_dim, act_dim):
    state_space, act_space = spaces.Box(-1, 1, (obs_dim,)), spaces.Box(-1, 1, (act_dim,))
    return delayed_space(state_space, act_space, 2), act_space


@pytest.mark.parametrize("other", OTHER_BUFFERS)
def test_another_tasks_state_is_refused_and_nothing_changes(other):
    player = Player()
    state = fill(make_buffer(player), player.play(33 if other == "full size" else 20)).state_dict()
    buffer = OTHER_BUFFERS[other]()
    with pytest.raises(ValueError, match="does not fit"):
        buffer.load_state_dict(state)
    assert buffer.size() == 0


def test_a_single_action_is_not_broadcast_over_many():
    state_space = spaces.Box(-1, 1, (3,))
    one, three = (DelayedReplayBuffer(10, state_space, spaces.Box(-1, 1, (n,))) for n in (1, 3))
    one.add(np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{}])
    with pytest.raises(ValueError, match="does not fit"):
        three.load_state_dict(one.state_dict())


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("pos", lambda pos: -1),
        ("pos", lambda pos: float(pos)),
        ("full", lambda full: 1),
        ("holds_logs", lambda holds: 0),
        ("observations", lambda x: np.where(x == x, np.nan, x)),
        ("observations", lambda x: x.astype(np.float64)),
        ("rewards", lambda x: x + np.float32(np.inf)),
        ("ages", lambda x: x - np.int16(1000)),
        ("ages", lambda x: x + np.int16(1000)),
        ("next_ages", lambda x: x + np.int16(1000)),
        ("next_states", lambda x: x[:, :1]),
        ("steps", lambda x: -1 - x),
        ("dones", lambda x: x + np.float32(0.5)),
        ("ends", lambda x: ~x),
        ("ends", lambda x: x.view(np.int8)),
        ("tail_places", lambda x: x + 10**6),
        ("tail_places", lambda x: np.concatenate([x[:1], x[:-1]])),
        ("tail_states", lambda x: x[:-1]),
        ("tail_ages", lambda x: x[:0]),
        ("expected", lambda x: {key: value * np.nan for key, value in x.items()}),
        ("expected", lambda x: {key: value.astype(str) for key, value in x.items()}),
    ],
)
def test_what_no_buffer_stores_is_refused_and_nothing_changes(name, change):
    players = Player(max_length=4), Player(max_length=4)
    state = fill(make_buffer(players[0]), players[0].play(30)).state_dict()
    assert state["full"] and len(state["tail_places"]) > 2
    other = fill(make_buffer(players[1]), players[1].play(7))
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(ValueError, match=r"A stored replay|The stored"):
        other.load_state_dict({**state, name: change(state[name])})
    for key, value in other.state_dict().items():
        np.testing.assert_equal(value, before[key])
    other.load_state_dict(state)
    np.testing.assert_equal(other.state_dict(), state)
