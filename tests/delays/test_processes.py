"""How long packets take: what a user may write, and the statistics of each process against its closed form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logged_task import LoggedTask
from random_processes import N, draw_packets, frequencies, processes

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    DistributionDelay,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    HeldDelay,
    PeriodicPackets,
    RandomWalkDelay,
    UniformDelay,
    in_steps,
)
from sb3_said.delays.processes import packet_delays
from sb3_said.delays.text import make_process

# ---------------------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize(
    ("written", "process"),
    [
        (0, FixedDelay(0)),
        (np.int64(300), FixedDelay(300)),
        ((0, 8), EpisodeDelay(0, 8)),
        ([3, 3], EpisodeDelay(3, 3)),  # YAML has no tuples
        (EpisodeDelay(1, 2), EpisodeDelay(1, 2)),
        ("4", FixedDelay(4)),
        ("(0, 8)", EpisodeDelay(0, 8)),
        ("WIFI_20MS", WIFI_20MS),
    ],
)
def test_what_a_user_may_write(written, process):
    assert make_process(written) == process


def test_whole_numbers_of_numpy_are_numbers():
    """``in_steps`` returns them for an array."""
    low, high = in_steps(np.array([20.0, 160.0]), 20)
    for process, expected in [
        (UniformDelay(low, high), "UniformDelay(low=1, high=8)"),
        (FixedDelay(high), "FixedDelay(delay=8)"),
        (PeriodicPackets(2, high), "PeriodicPackets(process=FixedDelay(delay=2), period=8)"),
        (DroppedPackets(2, 0.1, max_losses=high), "DroppedPackets(process=FixedDelay(delay=2), p=0.1, max_losses=8)"),
        (HeldDelay(2, update_period=high), "HeldDelay(process=FixedDelay(delay=2), hold_prob=0.0, update_period=8)"),
    ]:
        assert repr(process) == expected and make_process(expected) == process
        for kwargs in ({"delay": process}, {"delay": 0, "action_delay": process}, {"delay": 0, "max_delay": high}):
            DelayedObservationWrapper(LoggedTask(), **kwargs).reset(seed=0)


@pytest.mark.parametrize("written", [-1, (-1, 2), (4, 2), 1.5, (0, 2.5), (1, 2, 3), True, (False, True), None, "4.5"])
def test_what_is_refused(written):
    with pytest.raises(ValueError, match=r"delay"):
        make_process(written)


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda: FixedDelay(-1), "whole number of control steps >= 0, got -1"),
        (lambda: FixedDelay(1.5), "got 1.5"),
        (lambda: UniformDelay(3, 2), r"got \(3, 2\)"),
        (lambda: RandomWalkDelay(0, 2.5), r"got \(0, 2.5\)"),
        (lambda: RandomWalkDelay(0, 2, move_prob=1.1), "move_prob is a probability in 0..1, got 1.1"),
        (lambda: DistributionDelay((0.5, 0.4)), "add up to 1"),
        (lambda: DistributionDelay((1.5, -0.5)), ">= 0"),
        (lambda: DistributionDelay(()), "add up to 1"),
        (lambda: DistributionDelay((float("nan"), 1.0)), "add up to 1"),
        (lambda: DistributionDelay.from_samples([]), "whole numbers"),
        (lambda: DistributionDelay.from_samples(in_steps(70, 20)), "a list of whole numbers .* got 4"),
        (lambda: DistributionDelay.from_samples(np.ones((2, 2), int)), "a list of whole numbers"),
        (lambda: DistributionDelay.from_samples([0, -1]), "whole numbers"),
        (lambda: DistributionDelay.from_samples([12.5, 31.0]), "in_steps"),
    ],
)
def test_bad_settings_are_refused(write, reason):
    with pytest.raises(ValueError, match=reason):
        write()


@pytest.mark.parametrize(
    ("milliseconds", "steps"),
    [(0, 0), (0.1, 1), (19.9, 1), (20, 1), (20.1, 2), (70, 4), ([0, 20, 60, 61], [0, 1, 3, 4])],
)
def test_milliseconds_are_rounded_up_to_control_steps(milliseconds, steps):
    assert np.array_equal(in_steps(milliseconds, control_period=20), steps)


def test_processes_from_yaml_are_equal_to_those_from_python():
    assert hash(DistributionDelay([0.5, 0.5])) == hash(DistributionDelay((0.5, 0.5)))
    assert DistributionDelay([0.5, 0.5]) == DistributionDelay((0.5, 0.5))


def test_milliseconds_of_periods_that_floats_cannot_hold():
    assert [in_steps(0.1 * k, control_period=0.1) for k in range(50)] == list(range(50))
    assert FixedDelay(in_steps(8, 2)) == FixedDelay(4)


@pytest.mark.parametrize(
    ("delay", "period"), [(-1, 20), (float("nan"), 20), (20, 0), (20, -5), (20, float("inf")), (1e30, 1)]
)
def test_impossible_milliseconds_are_refused(delay, period):
    with pytest.raises(ValueError, match="control period"):
        in_steps(delay, period)


def test_measured_delays_keep_their_frequencies():
    process = DistributionDelay.from_samples(in_steps([5, 25, 30, 35, 75], control_period=20))
    assert process == DistributionDelay((0.0, 0.2, 0.6, 0.0, 0.2)) and process.max_delay == 4


# ---------------------------------------------------------------------------------------------------- properties


@settings(deadline=None)
@given(processes(), st.integers(0, 2**32))
def test_any_process_stays_in_its_range_and_repeats_with_its_seed(process, seed):
    delays = draw_packets(process, 60, seed)
    assert delays.min() >= -1 and delays.max() <= process.max_delay
    np.testing.assert_array_equal(delays, draw_packets(process, 60, seed))
    assert hash(process) == hash(make_process(process))  # an immutable description


@pytest.mark.parametrize("process", [FixedDelay(5), FixedDelay(0)])
def test_fixed_delay_draws_nothing(process):
    rng = np.random.default_rng(0)
    assert process.sample(rng) == process.max_delay == process.delay
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state


@pytest.mark.parametrize(
    ("drawn", "reason"), [(4, "drew a delay of 4"), (-1, "of -1"), (2.0, "of 2.0"), (None, "of None"), ([1], "of")]
)
def test_a_process_that_breaks_its_promise_is_refused_at_once(drawn, reason):
    class Broken:
        max_delay = 3

        def sample(self, rng):
            return drawn

    with pytest.raises(ValueError, match=reason):
        packet_delays(Broken(), np.random.default_rng())


def test_a_process_that_breaks_its_promise_amid_an_episode_is_refused_then():
    class Broken:
        max_delay = 3

        def sample(self, rng):
            return iter([3, None, 4])

    class Short(Broken):
        def sample(self, rng):
            return iter([3, None])

    for process, reason in [(Broken(), "drew a delay of 4, expected a whole number in 0..3"), (Short(), "ran out")]:
        delays = packet_delays(process, np.random.default_rng())
        assert [next(delays), next(delays)] == [3, None]
        with pytest.raises(ValueError, match=reason):
            next(delays)


class TableDelay:
    """A user's own process."""

    def __init__(self, max_delay, draws):
        self.max_delay = max_delay
        self.draws = iter(draws)

    def sample(self, rng):
        return next(self.draws)


def test_a_users_own_process():
    env = DelayedObservationWrapper(LoggedTask(), TableDelay(3, [3, 0, 2]))
    assert env.max_delay == 3
    for delay in [3, 0, 2]:
        env.reset()
        ages = [env.step(env.action_space.sample())[0]["delay"].item() for _ in range(6)]
        assert ages == [min(t, delay) for t in range(1, 7)]


@pytest.mark.parametrize("draw", [-1, 4])
def test_a_process_outside_its_range_is_refused(draw):
    # A negative delay would hand out the oldest state as the newest.
    env = DelayedObservationWrapper(LoggedTask(), TableDelay(3, [draw]))
    with pytest.raises(ValueError, match=f"drew a delay of {draw}"):
        env.reset()


# ---------------------------------------------------------------------------------------------------- statistics


def test_episode_delay_is_uniform_with_both_ends():
    process, rng = EpisodeDelay(2, 6), np.random.default_rng(0)
    draws = [process.sample(rng) for _ in range(5000)]
    values, counts = np.unique(draws, return_counts=True)
    assert values.tolist() == [2, 3, 4, 5, 6] and process.max_delay == 6
    np.testing.assert_allclose(counts, 1000, atol=150)  # five standard deviations
    assert type(draws[0]) is int


@pytest.mark.parametrize(
    ("process", "p"),
    [
        (UniformDelay(2, 4), [0, 0, 1 / 3, 1 / 3, 1 / 3]),
        (DistributionDelay((0.0, 0.7, 0.0, 0.3, 0.0)), [0, 0.7, 0, 0.3]),
        (DistributionDelay((1.0,)), [1]),
        (WIFI_20MS, [0, 0.3082, 0.5927, 0.0829, 0.0075, 0.0031, 0.0056]),
    ],
)
def test_packets_follow_the_distribution_independently(process, p):
    delays = draw_packets(process, N)
    assert process.max_delay == len(p) - 1
    np.testing.assert_allclose(frequencies(delays, len(p)), p, atol=5 * 0.5 / np.sqrt(N))
    assert set(delays) == set(np.flatnonzero(p))  # what has probability 0 never occurs
    if len(set(delays)) > 1:
        assert abs(np.corrcoef(delays[1:], delays[:-1])[0, 1]) < 5 / np.sqrt(N)


def test_random_walk_is_uniform_and_forgets_at_its_rate():
    low, high, move_prob = 1, 4, 0.5
    process = RandomWalkDelay(low, high, move_prob)
    delays = draw_packets(process, N)
    moves = np.diff(delays)
    assert set(moves) == {-1, 0, 1} and process.max_delay == high
    np.testing.assert_allclose(frequencies(delays - low, 4), 0.25, atol=0.02)
    starts = [draw_packets(process, 1, seed)[0] for seed in range(400)]
    np.testing.assert_allclose(frequencies(np.array(starts) - low, 4), 0.25, atol=5 * 0.43 / 20)
    # of a reflected walk on n states, cos(pi (x + 1/2) / n) is an eigenfunction: it decays by 1 - p (1 - cos(pi / n))
    f = np.cos(np.pi * (delays - low + 0.5) / 4)
    for lag in (1, 3):
        decay = (1 - move_prob * (1 - np.cos(np.pi / 4))) ** lag
        np.testing.assert_allclose((f[lag:] * f[:-lag]).mean() / (f * f).mean(), decay, atol=0.02)
