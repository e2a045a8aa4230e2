"""The age of what a receiver holds: exact against a naive log of arrivals, and in distribution against closed forms."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_processes import processes

from sb3_said import DelayedObservationWrapper
from sb3_said.delays import (
    WIFI_20MS,
    DistributionDelay,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    PeriodicPackets,
    RandomWalkDelay,
    TotalDelay,
    UniformDelay,
)
from sb3_said.delays.processes import packet_delays
from sb3_said.delays.receivers import RECEIVERS, IndependentDraw, NewestPacket


def ages(receiver, n, seed=0):
    receiver.reset(np.random.default_rng(seed))
    return np.array([receiver.step() for _ in range(n)])


def naive_newest(process, n, seed=0):
    """Ages without a bound, from a list of all arrivals."""
    delays = packet_delays(process, np.random.default_rng(seed))
    arrivals, found = [(0, 0)], []
    for t in range(1, n + 1):
        delay = next(delays)
        arrivals += [] if delay is None else [(t, t + delay)]
        found.append(t - max(sent for sent, arrival in arrivals if arrival <= t))
    return np.array(found)


@settings(deadline=None)
@given(processes(), st.integers(0, 2**32))
def test_the_newest_packet_against_a_log_of_arrivals(process, seed):
    receiver = NewestPacket(process)
    found, unbounded = ages(receiver, 80, seed), naive_newest(process, 80, seed)
    np.testing.assert_array_equal(found, np.minimum(unbounded, process.max_delay))
    assert receiver.forced_deliveries == np.sum(unbounded > process.max_delay)
    assert np.all(np.diff(found, prepend=0) <= 1) and found.min() >= 0
    np.testing.assert_array_equal(ages(receiver, 80, seed), found)  # nothing is left of the last episode


@settings(deadline=None)
@given(processes(), st.integers(0, 2**32))
def test_independent_draws_against_a_log(process, seed):
    receiver = IndependentDraw(process)
    found = ages(receiver, 80, seed)
    delays = packet_delays(process, np.random.default_rng(seed))
    age = forced = 0
    for t, delay in zip(range(1, 81), delays, strict=False):
        forced += delay is None and age == process.max_delay
        age = min(age + 1, process.max_delay) if delay is None else min(delay, t)
        assert found[t - 1] == age
    assert receiver.forced_deliveries == forced


@pytest.mark.parametrize("receiver", [NewestPacket, IndependentDraw])
@pytest.mark.parametrize("delay", [0, 1, 4, 12])
def test_a_delay_that_does_not_vary_is_the_age_under_either_rule(receiver, delay):
    expected = np.minimum(np.arange(1, 31), delay)
    np.testing.assert_array_equal(ages(receiver(FixedDelay(delay)), 30), expected)
    np.testing.assert_array_equal(ages(receiver(EpisodeDelay(delay, delay)), 30), expected)


def test_an_overtaken_packet_is_of_no_use():
    class Table:
        max_delay = 5

        def sample(self, rng):
            return iter([0, 5, 2, None, 0, 0])  # packet 2 arrives at 7, after packets 3 and 5

    assert ages(NewestPacket(Table()), 6).tolist() == [0, 1, 2, 3, 0, 0]
    assert ages(IndependentDraw(Table()), 6).tolist() == [0, 2, 2, 3, 0, 0]


def test_a_slow_sensor_ages_between_its_packets():
    found = ages(NewestPacket(PeriodicPackets(2, 4)), 14)
    assert found.tolist() == [1, 2, 3, 4, 5, 2, 3, 4, 5, 2, 3, 4, 5, 2]


def test_a_loss_streak_is_cut_at_the_largest_age_and_counted():
    receiver = NewestPacket(DroppedPackets(4, p=1.0, max_losses=2))
    assert ages(receiver, 10).tolist() == [1, 2, 3, 4, 5, 6, 6, 6, 6, 6]
    assert receiver.forced_deliveries == 4
    receiver.reset(np.random.default_rng(0))
    assert receiver.forced_deliveries == 0


# ---------------------------------------------------------------------------------------------------- closed forms

N = 60_000


@pytest.mark.parametrize(
    "process",
    [
        UniformDelay(0, 8),
        UniformDelay(3, 5),
        WIFI_20MS,
        DistributionDelay((0.1, 0.0, 0.0, 0.9)),
        DroppedPackets(FixedDelay(3), p=0.4, max_losses=2),
        DroppedPackets(WIFI_20MS, p=0.7, max_losses=3),
    ],
)
def test_ages_of_the_newest_of_independent_packets(process):
    """The packet of k steps ago is still on its way, or lost, with probability P(delay > k), independently of the
    others; the age exceeds a if that holds for k = 0..a: P(age > a) = prod_{k <= a} P(delay > k), up to the bound."""
    p_lost = process.p if isinstance(process, DroppedPackets) else 0.0
    inner = process.process if isinstance(process, DroppedPackets) else process
    p = np.zeros(process.max_delay + 1)  # of each delay
    if isinstance(inner, FixedDelay):
        p[inner.delay] = 1.0
    elif isinstance(inner, UniformDelay):
        p[inner.low : inner.high + 1] = 1 / (inner.high + 1 - inner.low)
    else:
        p[: len(inner.probabilities)] = inner.probabilities
    exceeds = np.cumprod(1 - (1 - p_lost) * np.cumsum(p))  # without the bound, for a = 0..max_delay
    receiver = NewestPacket(process)
    found = ages(receiver, N)[process.max_delay :]
    measured = [(found > a).mean() for a in range(process.max_delay)]
    np.testing.assert_allclose(measured, exceeds[:-1], atol=0.015)
    np.testing.assert_allclose(receiver.forced_deliveries / N, exceeds[-1], atol=0.01)
    assert (receiver.forced_deliveries > 0) == (p_lost > 0)


def test_ages_of_independent_draws_are_the_distribution():
    found = ages(IndependentDraw(WIFI_20MS), N)[6:]
    np.testing.assert_allclose(np.bincount(found) / len(found), WIFI_20MS.probabilities, atol=5 * 0.5 / np.sqrt(N))
    assert np.diff(found).max() > 1  # an older observation after a younger one


# ---------------------------------------------------------------------------------------------------- copies


COPIED = [
    (EpisodeDelay(2, 9), 0),
    (UniformDelay(0, 8), 0),
    (DroppedPackets(UniformDelay(0, 8), p=0.3), 0),
    (RandomWalkDelay(0, 8, move_prob=0.5), UniformDelay(0, 3)),
    (2, (0, 5)),
    (DroppedPackets(TotalDelay(UniformDelay(0, 3), EpisodeDelay(0, 5)), p=0.3), 0),
]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize(("delay", "action_delay"), COPIED, ids=str)
@pytest.mark.parametrize("receiver", RECEIVERS)
def test_a_task_is_copied_amid_an_episode_with_all_that_will_come(delay, action_delay, receiver, copied):
    """As tasks without delay can be, which planning by trial needs."""
    env = DelayedObservationWrapper(gym.make("Pendulum-v1"), delay, action_delay, receiver=receiver)
    actions = np.random.default_rng(0).uniform(-2, 2, (30, 1)).astype(np.float32)
    env.reset(seed=3)
    for action in actions[:7]:
        env.step(action)
    twin, shown = copied(env), []
    for one in (env, twin):
        rows = [one.step(action)[0] for action in actions]
        rows += [one.reset()[0], *(one.step(action)[0] for action in actions)]  # of the next episode, too
        shown.append({key: np.stack([row[key] for row in rows]) for key in rows[0]})
    for key in shown[0]:
        np.testing.assert_array_equal(shown[0][key], shown[1][key], err_msg=key)


def test_a_process_can_be_shared():
    process = DroppedPackets(UniformDelay(0, 8), p=0.2)
    first, second = NewestPacket(process), NewestPacket(process)
    alone = ages(first, 50, seed=3)
    first.reset(np.random.default_rng(3)), second.reset(np.random.default_rng(4))
    together = np.array([(first.step(), second.step()) for _ in range(50)])
    np.testing.assert_array_equal(together[:, 0], alone)
    np.testing.assert_array_equal(together[:, 1], ages(NewestPacket(process), 50, seed=4))
