"""How old observations are: fixed and random delays, and what a user may write for them."""

import numpy as np
import pytest

from sb3_said.delays import EpisodeDelay, FixedDelay
from sb3_said.delays.processes import make_process


@pytest.mark.parametrize(
    ("written", "process"),
    [
        (0, FixedDelay(0)),
        (np.int64(300), FixedDelay(300)),
        ((0, 8), EpisodeDelay(0, 8)),
        ([3, 3], EpisodeDelay(3, 3)),  # YAML has no tuples
        (EpisodeDelay(1, 2), EpisodeDelay(1, 2)),
    ],
)
def test_what_a_user_may_write(written, process):
    assert make_process(written) == process


@pytest.mark.parametrize("written", [-1, (-1, 2), (4, 2), 1.5, (0, 2.5), (1, 2, 3), True, (False, True), None, "4"])
def test_what_is_refused(written):
    with pytest.raises(ValueError, match=r"delay"):
        make_process(written)


def test_fixed_delay_draws_nothing():
    rng = np.random.default_rng(0)
    process = FixedDelay(5)
    assert process.max_delay == 5 and process.sample(rng) == 5
    assert rng.bit_generator.state == np.random.default_rng(0).bit_generator.state


def test_episode_delay_is_uniform_with_both_ends():
    process, rng = EpisodeDelay(2, 6), np.random.default_rng(0)
    draws = [process.sample(rng) for _ in range(5000)]
    values, counts = np.unique(draws, return_counts=True)
    assert values.tolist() == [2, 3, 4, 5, 6] and process.max_delay == 6
    np.testing.assert_allclose(counts, 1000, atol=150)  # five standard deviations
    assert type(draws[0]) is int
