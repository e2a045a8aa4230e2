"""Delay processes in tests: any of them for Hypothesis, and what they draw."""

import itertools

import numpy as np
from hypothesis import strategies as st

from sb3_said.delays import (
    WIFI_20MS,
    DistributionDelay,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    HeldDelay,
    PeriodicPackets,
    RandomWalkDelay,
    UniformDelay,
)
from sb3_said.delays.processes import packet_delays

N = 40_000  # packets for statistics


def draw_packets(process, n, seed=0):
    """The delays of the first n packets of an episode; -1 for one that is lost."""
    delays = itertools.islice(packet_delays(process, np.random.default_rng(seed)), n)
    return np.array([-1 if delay is None else delay for delay in delays])


def frequencies(delays, n):
    return np.bincount(delays, minlength=n) / len(delays)


@st.composite
def processes(draw, depth=2):
    low = draw(st.integers(0, 4))
    high = draw(st.integers(low, 6))
    probability = st.floats(0, 1)
    simple = st.one_of(
        st.sampled_from([FixedDelay(high), EpisodeDelay(low, high), UniformDelay(low, high), WIFI_20MS]),
        st.lists(st.integers(0, 6), min_size=1).map(DistributionDelay.from_samples),
        st.builds(RandomWalkDelay, st.just(low), st.just(high), probability),
    )
    if depth == 0:
        return draw(simple)
    inner = st.one_of(st.sampled_from([high, (low, high)]), processes(depth - 1))
    combined = st.one_of(
        st.builds(HeldDelay, inner, probability, st.integers(1, 4)),
        st.builds(PeriodicPackets, inner, st.integers(1, 4)),
        st.builds(DroppedPackets, inner, probability, st.integers(1, 5)),
    )
    return draw(st.one_of(simple, combined))
