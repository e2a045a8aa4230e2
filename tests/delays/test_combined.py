"""Processes made of others: what they keep of them, and the statistics of what they add, against closed forms."""

import itertools
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logged_task import LoggedTask
from random_processes import N, draw_packets, frequencies, processes

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    DroppedPackets,
    FixedDelay,
    HeldDelay,
    PeriodicPackets,
    TotalDelay,
    UniformDelay,
)
from sb3_said.delays.processes import packet_delays
from sb3_said.delays.receivers import RECEIVERS
from sb3_said.delays.text import age_range, parse_process


@pytest.mark.parametrize("inner", [-1, (4, 2), 1.5, None])
def test_what_is_refused_as_a_process(inner):
    combinations = (
        HeldDelay,
        lambda x: PeriodicPackets(x, 2),
        lambda x: DroppedPackets(x, 0.1),
        lambda x: TotalDelay(x, 1),
        lambda x: TotalDelay(1, x),
    )
    for combine in combinations:
        with pytest.raises(ValueError, match="delay"):
            combine(inner)


def test_what_a_user_may_write_as_a_process():
    for combine in (HeldDelay, lambda x: PeriodicPackets(x, 2), lambda x: DroppedPackets(x, 0.1)):
        written, process = combine(4), combine(FixedDelay(4))
        np.testing.assert_array_equal(draw_packets(written, 30), draw_packets(process, 30))
        assert written.max_delay == process.max_delay


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda: HeldDelay(3, hold_prob=-0.1), "hold_prob is a probability"),
        (lambda: HeldDelay(3, update_period=0), "update_period is a whole number >= 1, got 0"),
        (lambda: PeriodicPackets(3, 0), "period is a whole number >= 1, got 0"),
        (lambda: PeriodicPackets(3, 2.5), "period is a whole number >= 1, got 2.5"),
        (lambda: DroppedPackets(3, 2.0), "p is a probability"),
        (lambda: DroppedPackets(3, 0.1, max_losses=0), "max_losses is a whole number >= 1, got 0"),
        (lambda: HeldDelay(TotalDelay(1, UniformDelay(0, 2)), 0.5), "draws a delay for every action"),
        (lambda: DroppedPackets(TotalDelay(1, WIFI_20MS), p=0.1), "not inside another process"),
        (lambda: PeriodicPackets(HeldDelay(TotalDelay((0, 1), (0, 2))), 2), None),
        (lambda: TotalDelay(TotalDelay(1, UniformDelay(0, 2)), 1), "draws a delay for every action"),
        (lambda: TotalDelay(1, TotalDelay(0, WIFI_20MS)), "draws a delay for every action"),
    ],
)
def test_bad_settings_are_refused(write, reason):
    with pytest.raises(ValueError, match=reason) if reason else nullcontext():
        write()


@pytest.mark.parametrize(("hold_prob", "update_period"), [(0.0, 1), (0.8, 1), (0.0, 5), (0.5, 4)])
def test_held_delay_keeps_the_distribution_and_is_as_correlated_as_it_says(hold_prob, update_period):
    delays = draw_packets(HeldDelay(UniformDelay(0, 3), hold_prob, update_period), N)
    np.testing.assert_allclose(frequencies(delays, 4), 0.25, atol=0.03)
    changed = np.flatnonzero(np.diff(delays))
    assert len(set(changed % update_period)) == 1  # only when an update is due
    kept = 1 - (1 - hold_prob) / update_period  # else drawn anew, independently
    np.testing.assert_allclose(np.corrcoef(delays[1:], delays[:-1])[0, 1], kept, atol=0.03)


def test_held_delay_updates_at_a_phase_of_its_own_in_each_episode():
    process = HeldDelay(UniformDelay(0, 50), update_period=4)
    phases = [np.flatnonzero(np.diff(draw_packets(process, 40, seed)))[0] % 4 for seed in range(60)]
    assert set(phases) == {0, 1, 2, 3}


class Mixed:
    """Draws one delay for an episode, or one for each packet."""

    max_delay = 3

    def __init__(self):
        self.n_asked = 0

    def sample(self, rng):
        self.n_asked += 1
        return 1 if self.n_asked == 1 else itertools.repeat(2)


def test_actions_are_delayed_always_for_an_episode_or_always_one_by_one():
    env = DelayedObservationWrapper(LoggedTask(), 1, Mixed())
    with pytest.raises(ValueError, match="as an action delay a process draws always the one or always the other"):
        env.reset(seed=0)


def test_a_total_that_is_one_for_an_episode_is_drawn_anew_by_what_holds_it():
    held = [
        draw_packets(HeldDelay(process, 0.8), N) for process in ((2, 5), TotalDelay((0, 3), 2), TotalDelay(2, (0, 3)))
    ]
    for delays in held:
        assert set(delays) == {2, 3, 4, 5}
    np.testing.assert_array_equal(held[0], held[1])  # the same draws


def test_held_losses_come_in_bursts():
    delays = draw_packets(HeldDelay(DroppedPackets(2, p=0.25), hold_prob=0.9), N)
    lost = delays == -1
    np.testing.assert_allclose(lost.mean(), 0.25, atol=0.04)
    np.testing.assert_allclose(lost[1:][lost[:-1]].mean(), 0.9 + 0.1 * 0.25, atol=0.02)


def test_periodic_packets_are_sent_every_so_many_steps():
    delays = draw_packets(PeriodicPackets(UniformDelay(0, 9), 3), 300)
    sent = np.flatnonzero(delays >= 0)
    assert sent.tolist() == list(range(2, 300, 3))  # packets 3, 6, ... counted from 1
    np.testing.assert_array_equal(delays[sent], draw_packets(UniformDelay(0, 9), 100))
    assert PeriodicPackets(UniformDelay(0, 9), 3).max_delay == 11


def test_dropped_packets_are_lost_independently_and_the_others_keep_their_delays():
    delays = draw_packets(DroppedPackets(UniformDelay(0, 1), p=0.3), N)
    np.testing.assert_allclose(frequencies(delays + 1, 3), [0.3, 0.35, 0.35], atol=5 * 0.5 / np.sqrt(N))
    lost = (delays == -1).astype(float)
    assert abs(np.corrcoef(lost[1:], lost[:-1])[0, 1]) < 5 / np.sqrt(N)


@settings(deadline=None)
@given(processes(), st.integers(0, 3), st.integers(0, 3), st.integers(0, 2**16))
def test_observations_take_as_long_with_action_delay_as_without(process, low, spread, seed):
    def receive(rng, process):
        return list(itertools.islice(packet_delays(process, rng), 40))

    alone = receive(np.random.default_rng(seed), process)
    total = receive(np.random.default_rng(seed), TotalDelay(process, (low, low + spread)))
    added = {b - a for a, b in zip(alone, total, strict=True) if a is not None}
    assert [x is None for x in alone] == [x is None for x in total]
    assert len(added) <= 1 and added <= set(range(low, low + spread + 1))
    assert TotalDelay(process, (low, low + spread)).max_delay == process.max_delay + low + spread


def test_held_delay_draws_an_episodes_delay_anew():
    delays = draw_packets(HeldDelay((0, 3), hold_prob=0.5), N)
    np.testing.assert_allclose(frequencies(delays, 4), 0.25, atol=0.03)
    assert set(draw_packets(HeldDelay(2, hold_prob=0.5), 50).tolist()) == {2}


@settings(deadline=None)
@given(processes(), processes(), st.sampled_from(sorted(RECEIVERS)), st.integers(0, 2**16))
def test_ages_are_in_the_range_that_a_process_says(observation, action, receiver, seed):
    env = DelayedObservationWrapper(LoggedTask(length=60), observation, action, receiver=receiver)
    low, high = env.age_range
    assert (low, high) == age_range(TotalDelay(observation, action))
    env.reset(seed=seed)
    ages = [env.step(env.action_space.sample())[0]["delay"].item() for _ in range(60)]
    assert low <= min(ages[env.max_delay :]) and max(ages) <= high


def test_the_range_of_ages():
    for process in (3, (3, 3), TotalDelay(1, (2, 2)), "HeldDelay(3)", UniformDelay(3, 3)):
        assert age_range(process) == (3, 3)
    assert age_range((2, 3)) == (2, 3)
    assert age_range(TotalDelay(1, WIFI_20MS)) == (2, 7)
    assert age_range(DroppedPackets(PeriodicPackets(2, period=5), p=0.1)) == (2, 10)


def test_text_is_of_the_whole():
    for make in (lambda: DroppedPackets("WIFI_20MS", p=0.1), lambda: TotalDelay("WIFI_20MS", 4)):
        with pytest.raises(ValueError, match="got 'WIFI_20MS'; inside another process give it as it is"):
            make()
    assert parse_process("DroppedPackets(WIFI_20MS, p=0.1)") == DroppedPackets(WIFI_20MS, p=0.1)
