"""The planner's windows: pieces of single episodes, values and splits, against plain lists of episodes."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from counting_task import Player
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.replay import buffer as buffer_module
from sb3_said.replay.buffer import DelayedReplayBuffer
from sb3_said.replay.windows import WindowSource


def make_buffer(player, steps_per_env, rows):
    vec = player.vec
    size = steps_per_env * vec.num_envs
    buffer = DelayedReplayBuffer(size, vec.observation_space, vec.action_space, "cpu", n_envs=vec.num_envs)
    for row in rows:
        buffer.add(*row.added())
    return buffer


def naive_episodes(rows, env):
    """Cut one environment's rows into episodes: lists of rows, each with whether it terminated."""
    episodes, steps = [], []
    for row in rows:
        steps.append(row)
        if row.done[env] or row.interrupted or row is rows[-1]:
            episodes.append((steps, bool(row.terminated[env])))
            steps = []
    return episodes


def naive_starts(rows, n_envs, length):
    """Map the tag of every stored state to (states, actions, n_valid, reward, ends there), walking through episodes."""
    starts = {}
    for env in range(n_envs):
        for steps, terminated in naive_episodes(rows, env):
            states = np.stack([row.states[env] for row in steps])
            # SB3's scaled action, executed and scaled back
            actions = np.stack([row.next_obs["action_history"][env, -1] for row in steps])
            for t, row in enumerate(steps):
                index = np.minimum(np.arange(t, t + length), len(steps) - 1)
                n_valid, is_last = min(length, len(steps) - t), t == len(steps) - 1
                starts[int(states[t, 0])] = (
                    states[index], actions[index], n_valid, float(row.reward[env]), terminated and is_last
                )  # fmt: skip
    return starts


def assert_windows(source, starts, length):
    """Compare every window there is with the naive ones."""
    windows = source.gather(th.arange(len(source)), length)
    tags = windows.states[:, 0, 0].int().tolist()
    assert sorted(tags) == sorted(starts)  # each stored step starts one window: no episode is too short
    states, actions, n_valid, rewards, ended = (np.stack(x) for x in zip(*[starts[tag] for tag in tags], strict=True))
    np.testing.assert_array_equal(windows.states, states)
    np.testing.assert_array_equal(windows.actions, actions)
    np.testing.assert_array_equal(windows.valid, np.arange(length) < n_valid[:, None])
    np.testing.assert_array_equal(source.rewards[source.rows, source.envs], rewards.astype(np.float32))
    np.testing.assert_array_equal(source.terminated[source.rows, source.envs], ended)
    assert (windows.values == 0).all()
    assert [x.dtype for x in windows] == [th.float32, th.float32, th.bool, th.float32]


@settings(max_examples=80, deadline=None)
@given(
    n_envs=st.integers(1, 3),
    delay=st.sampled_from([1, (0, 3)]),
    max_length=st.sampled_from([1, 4, 12, 60]),
    interruption=st.sampled_from([0.0, 0.2]),
    n_steps=st.integers(1, 80),
    steps_per_env=st.integers(5, 40),
    length=st.integers(1, 15),
    newest_fraction=st.sampled_from([1.0, 0.5, 0.2, 0.001]),
    seed=st.integers(0, 2**16),
)
def test_every_window_is_a_piece_of_one_episode(
    n_envs, delay, max_length, interruption, n_steps, steps_per_env, length, newest_fraction, seed
):
    player = Player(n_envs, delay, 3, max_length=max_length, interruption=interruption, seed=seed)
    rows = player.play(n_steps)
    source = make_buffer(player, steps_per_env, rows).window_source(newest_fraction)
    n_rows = max(int(min(n_steps, steps_per_env) * newest_fraction), 1)
    assert_windows(source, naive_starts(rows[-n_rows:], n_envs, length), length)
    # Episodes are numbered apart, also where two end at the same time
    assert len(source.episodes.unique()) == sum(len(naive_episodes(rows[-n_rows:], env)) for env in range(n_envs))
    stored = rows[-steps_per_env:]
    if n_rows < len(stored):
        older = make_buffer(player, steps_per_env, rows).window_source(newest_fraction, older=True)
        assert_windows(older, naive_starts(stored[:-n_rows], n_envs, length), length)


@pytest.mark.parametrize("fraction", [0.0, -0.2, 1.1, float("nan")])
def test_bad_fractions_are_refused(fraction):
    player = Player()
    with pytest.raises(ValueError, match="newest_fraction"):
        make_buffer(player, 20, player.play(3)).window_source(fraction)


def test_all_of_a_buffer_has_nothing_older():
    player = Player()
    with pytest.raises(ValueError, match="No step is older than the newest part, 1 of 3 steps"):
        make_buffer(player, 20, player.play(3)).window_source(older=True)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_without_a_warning_and_over_the_buffers_own_memory(n_envs):
    player = Player(n_envs)
    buffer = make_buffer(player, 20, player.play(30))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # one environment's indices used to be a read-only view
        source = buffer.window_source()
    assert source.states.data_ptr() == buffer.observations.ctypes.data
    assert source.actions.data_ptr() == buffer.actions.ctypes.data
    assert source.rewards.data_ptr() == buffer.rewards.ctypes.data
    for name in ("rows", "envs", "remaining", "values", "episodes"):
        assert getattr(source, name).numpy().flags.writeable


@pytest.mark.parametrize("delay", [2, None])
def test_states_are_normalised_as_the_experts_observations(delay):
    player = Player(delay=delay)
    rows = player.play(30)
    buffer = make_buffer(player, 20, rows)
    env = VecNormalize(player.vec, norm_obs_keys=None if delay is None else ["observation"])
    rms = env.obs_rms if delay is None else env.obs_rms["observation"]
    rms.update(np.concatenate([row.states for row in rows]))
    plain, normalised = buffer.window_source(), buffer.window_source(env=env)
    expected = (plain.states - th.tensor(rms.mean)) / th.tensor(rms.var + env.epsilon).sqrt()
    th.testing.assert_close(normalised.states, expected.float().clamp(-10, 10))
    for name in ("actions", "rows", "envs", "remaining", "values", "episodes"):
        assert th.equal(getattr(normalised, name), getattr(plain, name))
    assert normalised.states.dtype == th.float32


# ---------------------------------------------------------------------------------------------------- a plain dataset


def make_source(lengths):
    """Return episodes of the given lengths in one environment; the state is (episode, step)."""
    episodes = th.repeat_interleave(th.arange(len(lengths)), th.tensor(lengths))
    steps = th.cat([th.arange(n) for n in lengths])
    states = th.stack([episodes, steps], dim=1).float()[:, None]
    remaining = th.tensor(lengths)[episodes] - steps
    n = len(episodes)
    none = th.zeros(n, 1)
    starts = th.arange(n), th.zeros(n, dtype=th.int64), remaining, episodes, steps / max(lengths)
    return WindowSource(states, -states[..., :1], none, none.bool(), *starts)


def test_sample_is_uniform_over_steps_and_repeats_with_a_generator():
    source = make_source([1, 3, 6])
    windows = source.sample(20_000, 4, th.Generator().manual_seed(0))
    starts, counts = th.unique(windows.states[:, 0], dim=0, return_counts=True)
    assert len(starts) == 10
    np.testing.assert_allclose(counts, 2000, atol=220)  # five standard deviations
    again = source.sample(20_000, 4, th.Generator().manual_seed(0))
    assert all(th.equal(a, b) for a, b in zip(windows, again, strict=True))
    assert not th.equal(windows.states, source.sample(20_000, 4, th.Generator().manual_seed(1)).states)


@pytest.mark.parametrize("probability", [0.25, 1.0])
def test_a_part_of_the_windows_starts_early_in_episodes(probability):
    lengths = [1, 3, 40]
    source = make_source(lengths)
    source = source._select(th.randperm(len(source), generator=th.Generator().manual_seed(0)))  # stored in any order
    n = 200_000
    windows = source.sample(n, 4, th.Generator().manual_seed(0), probability)
    counted = np.zeros((len(lengths), max(lengths)))
    np.add.at(counted, tuple(windows.states[:, 0].long().T.numpy()), 1 / n)
    expected = np.zeros_like(counted)
    for episode, length in enumerate(lengths):
        steps = np.arange(length)
        early = np.log((steps + 2) / (steps + 1)) / np.log(length + 1) / len(lengths)
        expected[episode, :length] = probability * early + (1 - probability) / sum(lengths)
    assert expected.sum() == pytest.approx(1)
    np.testing.assert_allclose(counted, expected, atol=5 * np.sqrt(expected.max() / n))
    again = source.sample(n, 4, th.Generator().manual_seed(0), probability)
    assert all(th.equal(a, b) for a, b in zip(windows, again, strict=True))


def aged(source, ages):
    return replace(source, ages=th.as_tensor(ages))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=8), st.integers(0, 4), st.integers(0, 10_000), st.booleans())
def test_windows_show_what_their_decision_was_made_on(lengths, largest, seed, is_cut):
    rng, source = np.random.default_rng(seed), make_source(lengths)
    steps = source.start_states()[:, 1].int().numpy()
    ages = np.minimum(rng.integers(0, largest + 1, len(source)), steps)
    source = aged(source, ages)._select(th.from_numpy(rng.permutation(len(source))))  # stored in any order
    if is_cut and len(source) > 1:  # the observations of an episode's first decisions are in the other part
        source = source.split(0.3, seed)[0]
    here = {tuple(state) for state in source.start_states().int().tolist()}
    made = {age: set() for age in range(largest + 2)}
    for (episode, step), age in zip(source.start_states().int().tolist(), source.ages.tolist(), strict=True):
        if (episode, step - age) in here:
            made[age].add((episode, step - age))
    n_ages = 1 + max((age for age in made if made[age]), default=0)
    generator = th.Generator().manual_seed(seed)
    for age, starts in made.items():
        is_met = age < n_ages and len(starts) * n_ages >= 0.25 * len(source)
        windows, delay = source.sample_own(th.full((400,), age), 3, generator)
        drawn = {tuple(state) for state in windows.states[:, 0].int().tolist()}
        assert delay.tolist() == [age] * 400 and drawn <= (starts if is_met else here)
        assert windows.values.tolist() == pytest.approx((windows.states[:, 0, 1] / max(lengths)).tolist())
        found = source.own_starts(age)
        assert len(found) == (len(starts) if is_met else 0)
        assert {tuple(state) for state in source.start_states()[found].int().tolist()} == (starts if is_met else set())
    if made[0]:
        windows, delay = source.sample_own(th.full((400,), largest + 1), 3, generator, early_probability=1.0)
        for (episode, step), age in zip(windows.states[:, 0].int().tolist(), delay.tolist(), strict=True):
            assert (episode, step) in (made[age] if age <= largest else here)  # of the decision drawn, or of none


def test_decisions_of_an_age_are_drawn_evenly_and_of_a_rare_one_any():
    source = aged(make_source([3, 30]), [0, 1, 1, *[0, 1], *[2] * 27, 1])
    n = 60_000
    for age, expected in ((0, 33 * [1 / 33]), (2, [*3 * [0], *27 * [1 / 27], *3 * [0]])):  # two of age 0 are too few
        generator = th.Generator().manual_seed(0)
        windows, delay = source.sample_own(th.full((n,), age), 3, generator)
        counts = np.zeros(33)
        np.add.at(counts, (3 * windows.states[:, 0, 0] + windows.states[:, 0, 1]).long().numpy(), 1 / n)
        assert (delay == age).all()
        np.testing.assert_allclose(counts, expected, atol=5 * np.sqrt(max(expected) / n))


def test_a_short_episode_repeats_its_last_row():
    windows = make_source([2, 9]).gather(th.tensor([0, 1, 2]), 4)
    assert windows.states[..., 0].tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [1, 1, 1, 1]]
    assert windows.states[..., 1].tolist() == [[0, 1, 1, 1], [1, 1, 1, 1], [0, 1, 2, 3]]
    assert windows.actions[..., 0].tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [-1, -1, -1, -1]]
    assert windows.valid.tolist() == [[True, True, False, False], [True, False, False, False], [True] * 4]


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.integers(1, 30), min_size=1, max_size=20).filter(lambda lengths: sum(lengths) > 1),
    st.sampled_from([0.01, 0.1, 0.5, 0.99]),
    st.integers(0, 1000),
)
def test_split_by_episodes(lengths, held_out, seed):
    source = make_source(lengths)
    training, validation = source.split(held_out, seed)
    assert len(validation) == max(1, int(held_out * len(source))) and len(training) + len(validation) == len(source)
    in_both = set(training.episodes.tolist()) & set(validation.episodes.tolist())
    assert len(in_both) <= 1  # the rest are whole
    for part in (training, validation):
        assert part.start_states()[:, 0].tolist() == part.episodes.tolist()  # every column is cut alike
        th.testing.assert_close(part.start_states()[:, 1], part.values * max(lengths))
        assert part.states is source.states  # not copied
    # No window of one part shows a step of the other, and each shows all steps of its own
    steps = []
    for part in (training, validation):
        windows = part.gather(th.arange(len(part)), max(lengths))
        steps.append({tuple(step) for step in windows.states[windows.valid].tolist()})
    assert not steps[0] & steps[1] and len(steps[0] | steps[1]) == len(source)


def test_of_two_episodes_no_more_is_held_out_than_asked_for():
    training, validation = make_source([100, 100]).split(0.05)
    assert (len(training), len(validation)) == (190, 10)
    assert validation.start_states()[:, 1].tolist() == [*range(90, 100)]  # the end of one of them


def test_split_repeats_with_its_seed():
    source = make_source([3] * 30)
    assert th.equal(source.split(0.2, 1)[1].rows, source.split(0.2, 1)[1].rows)
    assert not th.equal(source.split(0.2, 1)[1].rows, source.split(0.2, 2)[1].rows)


def test_split_needs_two_steps():
    with pytest.raises(ValueError, match="at least two"):
        make_source([1]).split(0.1)


def test_arrays_of_another_dtype_are_told():
    source = make_source([2, 3])
    with pytest.raises(ValueError, match=r"states are torch\.float64, expected torch\.float32: give states\.float\(\)"):
        replace(source, states=source.states.double())


def test_dimensions_and_starts():
    source = make_source([2, 3])
    assert (len(source), source.obs_dim, source.act_dim) == (5, 2, 1)
    assert th.equal(source.start_actions(), -source.start_states()[:, :1])
    half = source.split(0.5)[1]
    assert half.start_actions().shape == (len(half), 1)


def test_sample_windows_of_the_buffer():
    player = Player(max_length=6)
    rows = player.play(50)
    windows = make_buffer(player, 20, rows).sample_windows(64, 5, th.Generator().manual_seed(0))
    starts = naive_starts(rows[-20:], 2, 5)
    for states, actions, valid in zip(windows.states, windows.actions, windows.valid, strict=True):
        expected_states, expected_actions, n_valid, *_ = starts[int(states[0, 0])]
        np.testing.assert_array_equal(states, expected_states)
        np.testing.assert_array_equal(actions, expected_actions)
        assert valid.sum() == n_valid


def test_moving_to_where_it_is_copies_nothing():
    source = make_source([2, 3])
    moved = source.to("cpu")
    for name in ("states", "actions", "rows", "envs", "remaining", "values", "episodes"):
        assert getattr(moved, name) is getattr(source, name)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_windows_of_a_gpu_are_those_of_the_cpu():
    source = make_source([2, 9, 4])
    on_gpu = source.to("cuda")
    starts = th.arange(len(source))
    for a, b in zip(source.gather(starts, 4), on_gpu.gather(starts.cuda(), 4), strict=True):
        assert b.is_cuda and th.equal(a, b.cpu())
    drawn = on_gpu.sample(64, 4, th.Generator("cuda").manual_seed(0))
    assert drawn.states.is_cuda and len(drawn.states[:, 0].unique(dim=0)) > 10


def test_only_the_states_that_windows_can_show_are_normalised_and_few_at_a_time(monkeypatch):
    monkeypatch.setattr(buffer_module, "NORMALIZED_ROWS", 7)
    player = Player(2, 1, 3)
    buffer = make_buffer(player, 500, player.play(60))
    env, asked = VecNormalize(player.vec, norm_obs_keys=["observation"]), []
    env.obs_rms["observation"].mean += 3.0
    normalize = env.normalize_obs

    def counted(obs):
        asked.append(len(obs["observation"]))
        return normalize(obs)

    monkeypatch.setattr(env, "normalize_obs", counted)
    newest, older = buffer.window_source(0.3, env), buffer.window_source(0.3, env, older=True)
    assert sum(asked) == 60 and max(asked) == 7
    states = normalize({"observation": buffer.observations[:60]})["observation"].astype(np.float32)
    np.testing.assert_array_equal(th.cat([older.states[:42], newest.states[42:60]]), states)
    assert not newest.states[60:].any() and not newest.states[:42].any()
