"""The delay of a logged system: exact on four tasks at delays 0..16, its meaning under jitter, and what is refused."""

import functools
import warnings

import gymnasium as gym
import numpy as np
import pytest

from sb3_said.delays import (
    WIFI_20MS,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    PeriodicPackets,
    UniformDelay,
    estimate_delay,
)
from sb3_said.delays.receivers import NewestPacket

TASKS = ["Hopper-v5", "HalfCheetah-v5", "Walker2d-v5", "Ant-v5"]


@functools.cache
def play(name, noise, n_steps, seed=0):
    """Episodes of true states (T + 1, obs_dim) and actions (T, act_dim); Ornstein-Uhlenbeck or uniform actions."""
    env, rng, episodes, left = gym.make(name), np.random.default_rng(seed), [], n_steps
    while left > 0:
        states, actions, done = [env.reset(seed=int(rng.integers(2**31)))[0]], [], False
        action = np.zeros(env.action_space.shape)
        while not done and left > 0:
            if noise == "uniform":
                action = rng.uniform(-1, 1, action.shape)
            else:
                action = 0.85 * action + 0.3 * rng.normal(size=action.shape)
            actions.append((np.clip(action, -1, 1) * env.action_space.high).astype(np.float32))
            state, _, terminated, truncated, _ = env.step(actions[-1])
            states.append(state)
            done, left = terminated or truncated, left - 1
        episodes.append((np.array(states, np.float32), np.array(actions)))
    return episodes


def delayed(episodes, process, seed=0):
    """Log what arrives: observations, actions and the ages."""
    receiver, rng = NewestPacket(process), np.random.default_rng(seed)
    observations, ages = [], []
    for _, actions in episodes:
        receiver.reset(rng)
        ages.append(np.array([0, *(receiver.step() for _ in actions)]))
    for (states, _), age in zip(episodes, ages, strict=True):
        observations.append(states[np.arange(len(states)) - age])
    return observations, [actions for _, actions in episodes], np.concatenate(ages)


@pytest.mark.parametrize("noise", ["uniform", "ou"])
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_delays_of_four_tasks(name, noise):
    episodes = play(name, noise, 1000)
    for delay in (0, 1, 2, 4, 8, 12, 16) if name != "Ant-v5" else (0, 1, 8, 16):  # the slowest of them
        observations, actions, _ = delayed(episodes, FixedDelay(delay))
        found = estimate_delay(observations, actions)
        assert found.delay == delay and found.confidence >= 0.99
        assert found.scores.shape == (21,)
        second = np.sort(found.scores)[-2]
        assert second < (0.1 if noise == "uniform" else 0.75) * found.scores[delay]  # one clear peak


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_jitter_gives_the_most_frequent_age(name):
    episodes = play(name, "uniform", 3000 if name == "Ant-v5" else 1500)  # of which a slow sensor shows a quarter
    for process, expected in [
        (WIFI_20MS, {2}),
        (DroppedPackets(FixedDelay(4), p=0.1), {4}),
        (DroppedPackets(FixedDelay(4), p=0.3), {4}),
        (UniformDelay(4, 8), {4, 5, 6}),  # 21, 30 and 29 % of the ages
        (PeriodicPackets(FixedDelay(2), 4), {2, 5}),  # what the age is when a packet has come, or just before
    ]:
        observations, actions, ages = delayed(episodes, process)
        found = estimate_delay(observations, actions)
        assert found.delay in expected
        occurs = np.bincount(ages, minlength=21) > 0
        assert found.scores[~occurs].max() < 0.25 * found.scores.max()


def test_scores_show_how_often_each_age_occurs():
    episodes = [episode for episode in linear_episodes(40) for _ in range(3)]
    observations, actions, ages = delayed(episodes, EpisodeDelay(2, 4), seed=1)
    found = estimate_delay(observations, actions, max_delay=8)
    shares = np.sqrt(np.maximum(found.scores, 0))
    frequencies = np.bincount(ages[ages >= 2], minlength=9)
    np.testing.assert_allclose(shares / shares.sum(), frequencies / frequencies.sum(), atol=0.1)


@pytest.mark.parametrize(
    "process",
    [PeriodicPackets(FixedDelay(3), 2), PeriodicPackets(FixedDelay(3), 5), DroppedPackets(FixedDelay(3), p=0.5)],
)
def test_a_slow_sensor_of_positions(process):
    # the newest change that was seen tells the velocity; the row before may repeat what was seen, which tells nothing
    rng, episodes = np.random.default_rng(0), []
    for force in rng.uniform(-1, 1, (4, 750)):
        velocity = np.zeros(751)
        for t, f in enumerate(force):
            velocity[t + 1] = 0.8 * velocity[t] + 0.2 * f
        episodes.append((velocity.cumsum()[:, None], force[:, None]))
    observations, actions, ages = delayed(episodes, process)
    found = estimate_delay(observations, actions)
    assert 3 <= found.delay <= ages.max() and found.confidence > 0.9
    assert found.scores[ages.max() + 2 :].max() < 0.1 * found.scores.max()


@pytest.mark.parametrize("delay", [0, 5])
@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_positions_alone_suffice(delay):
    # velocities are not observed; without the newest step of the position, the action before would explain more
    observations, actions, _ = delayed(play("Hopper-v5", "ou", 1000), FixedDelay(delay))
    assert estimate_delay([o[:, :5] for o in observations], actions).delay == delay


@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_a_log_that_starts_amid_the_motion():
    # no repeated first observation gives the delay away
    episodes = [
        (states[: 100 - 7 + 1], actions[7:100])
        for k in range(0, 1000, 100)
        for states, actions in [[log[k:] for log in play("HalfCheetah-v5", "ou", 1000)[0]]]
    ]
    found = estimate_delay(*zip(*episodes, strict=True))
    assert (found.delay, found.confidence) == (7, 1.0)


def test_observation_and_action_delay_add_up():
    rng = np.random.default_rng(0)
    sent = rng.normal(size=(600, 2))
    executed = np.concatenate([np.zeros((3, 2)), sent[:-3]])
    states = linear_states(executed)
    assert estimate_delay([states[np.maximum(np.arange(601) - 2, 0)]], [sent]).delay == 5


def test_a_channel_that_echoes_the_command():
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(300, 1))
    echo = np.concatenate([np.zeros((7, 1)), actions[:-6]])  # a_{t-1} at delay 6
    observations = np.hstack([rng.normal(size=(301, 4)), echo])
    found = estimate_delay([observations], [actions])
    assert (found.delay, found.confidence) == (6, 1.0)


def linear_states(actions, seed=0):
    states = np.zeros((len(actions) + 1, 3))
    mix = np.random.default_rng(seed).normal(size=(2, 3))
    for t, action in enumerate(actions):
        states[t + 1] = 0.8 * states[t] + action @ mix
    return states


def linear_episodes(n, length=60):
    rng = np.random.default_rng(0)
    return [(linear_states(a), a) for a in rng.normal(size=(n, length, 2))]


def test_actions_of_no_effect_give_no_confidence():
    rng, confidences = np.random.default_rng(1), []
    for _ in range(20):
        states, others = linear_states(rng.normal(size=(400, 2))), rng.normal(size=(400, 2))
        confidences.append(estimate_delay([states], [others]).confidence)
    assert np.median(confidences) < 0.5 and max(confidences) < 0.95


@pytest.mark.parametrize("gains", [(0.3, 1.0), (1.0, 0.5), (0.1, 0.2)])
@pytest.mark.parametrize(("n", "length"), [(10, 60), (5, 200), (1, 500)])
def test_actions_that_follow_from_the_observations_give_no_confidence(gains, n, length):
    """A log without noise of a linear policy: nothing is left for the action to explain, at whatever age."""
    rng, episodes = np.random.default_rng(0), []
    for _ in range(n):
        states, actions = np.zeros((length + 1, 2)), np.zeros((length, 1))
        states[0] = rng.normal(size=2)
        for t in range(length):
            actions[t] = -np.dot(gains, states[t])
            states[t + 1] = np.array([[1, 0.05], [-0.2, 0.95]]) @ states[t] + np.array([0, 0.05]) * actions[t]
        episodes.append((states, actions))
    found = estimate_delay(*zip(*episodes, strict=True))
    assert found.scores.max() < 2e-3 and found.confidence < 0.5


def test_short_logs_of_unrelated_data_are_not_certain():
    rng = np.random.default_rng(0)
    logs = [(rng.normal(size=(54, 1)), rng.normal(size=(53, 1))) for _ in range(60)]
    certain = [estimate_delay([states], [actions]).confidence >= 0.95 for states, actions in logs]
    assert np.mean(certain) <= 0.05


def test_a_delay_beyond_those_tried_gives_no_confidence():
    observations, actions, _ = delayed(linear_episodes(20), FixedDelay(6))
    assert estimate_delay(observations, actions, max_delay=5).confidence < 0.95
    assert estimate_delay(observations, actions, max_delay=6).confidence == 1.0


def test_repeats_and_does_not_depend_on_units():
    observations, actions, _ = delayed(linear_episodes(20), UniformDelay(0, 4))
    first, again = (estimate_delay(observations, actions) for _ in range(2))
    assert first.confidence == again.confidence and first.delay == again.delay
    np.testing.assert_array_equal(first.scores, again.scores)
    scaled = estimate_delay([1e-3 * o + 5 for o in observations], [1e3 * a - 7 for a in actions])
    np.testing.assert_allclose(scaled.scores, first.scores, atol=1e-6)
    tiny = estimate_delay([(1e-12 * o).tolist() for o in observations], [(1e-12 * a).tolist() for a in actions])
    np.testing.assert_allclose(tiny.scores, first.scores, atol=1e-6)


def test_entries_that_never_vary_are_left_out():
    observations, actions, _ = delayed(linear_episodes(20), FixedDelay(3))
    expected = estimate_delay(observations, actions)
    padded = [np.hstack([o, np.full((len(o), 30), 2.0)]) for o in observations]
    found = estimate_delay(padded, [np.hstack([a, np.ones((len(a), 1))]) for a in actions])
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-12)


STATES, ACTIONS = linear_episodes(1, 200)[0]


@pytest.mark.parametrize(
    ("observations", "actions", "reason"),
    [
        ([], [], "at least one, got 0 and 0"),
        ([STATES], [ACTIONS, ACTIONS], "got 1 and 2"),
        ([STATES[:-1]], [ACTIONS], r"Episode 0 has observations \(200, 3\) and actions \(200, 2\), expected \(T \+ 1"),
        ([STATES, STATES[:, 0]], [ACTIONS, ACTIONS], "same dimensions"),
        ([STATES, STATES[:, :2]], [ACTIONS, ACTIONS], "same dimensions"),
        ([STATES[:, 0]], [ACTIONS[:, 0]], r"expected \(T \+ 1, obs_dim\)"),
        ([STATES, np.full_like(STATES, np.nan)], [ACTIONS, ACTIONS], "Episode 1 .* not finite"),
        ([STATES], [np.full_like(ACTIONS, 0.3)], "actions never change"),
        ([np.ones_like(STATES)], [ACTIONS], "observations never change"),
        ([STATES[:51]], [ACTIONS[:50]], "Too little data: 49 steps brought a new observation, at least 50 are needed"),
        ([np.tile(STATES[:51], 3)], [ACTIONS[:50]], "49 steps brought a new observation, at least 84 are needed"),
        ([np.arange(201.0)[:, None]], [ACTIONS], "change by the same at every step"),
        ([5 + 1e-12 * STATES], [ACTIONS], "observations never change"),
        ([STATES], [5 + 1e-12 * ACTIONS], "actions never change"),
        ([STATES[:2]] * 50, list(ACTIONS[:50, None]), "Too little data: 0 steps"),
    ],
)
def test_what_is_refused(observations, actions, reason):
    with pytest.raises(ValueError, match=reason):
        estimate_delay(observations, actions)


@pytest.mark.parametrize("kwargs", [{"max_delay": -1}, {"max_delay": 2.5}, {"n_resamples": 0}])
def test_bad_arguments_are_refused(kwargs):
    with pytest.raises(ValueError, match="max_delay is >= 0 and n_resamples >= 1"):
        estimate_delay([STATES], [ACTIONS], **kwargs)


def test_a_delay_beyond_those_tried_is_warned_of():
    """Actions that resemble each other point at the largest age that is tried, and with full confidence."""
    episodes = play("HalfCheetah-v5", "ou", 1000)
    late = delayed(episodes, FixedDelay(11))[:2]
    with pytest.warns(UserWarning, match=r"10, is the largest that was tried, and the true one may be larger"):
        found = estimate_delay(*late, max_delay=10)
    assert found.delay == 10
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert estimate_delay(*late).delay == 11


def test_resamples_are_as_many_as_asked_for_and_of_the_seed():
    rng = np.random.default_rng(1)
    log = [linear_states(rng.normal(size=(400, 2)))], [rng.normal(size=(400, 2))]  # actions of no effect
    found = [estimate_delay(*log, max_delay=4, seed=seed).confidence for seed in (1, 1, 2, 3)]
    assert found[0] == found[1] and len(set(found)) > 1
    part = 7 * estimate_delay(*log, max_delay=4, n_resamples=7).confidence
    assert part == pytest.approx(round(part), abs=1e-9)
