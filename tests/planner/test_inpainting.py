"""The known mask and the known window against naive loops; the drawn mask lengths."""

import pytest
import torch as th

from sb3_said.planner.inpainting import draw_delays, known_mask, known_window


@pytest.mark.parametrize("max_delay", [0, 1, 5])
def test_known_part_at_every_delay_matches_a_naive_loop(max_delay):
    length, obs_dim, act_dim = max_delay + 3, 3, 2
    delay = th.arange(max_delay + 1)
    observation = 1 + th.rand(max_delay + 1, obs_dim)
    history = 1 + th.rand(max_delay + 1, max_delay, act_dim)
    mask = known_mask(delay, length, obs_dim, act_dim)
    window = known_window(observation, history, delay, length)
    for d in range(max_delay + 1):
        expected = th.zeros(length, obs_dim + act_dim)
        expected[0, :obs_dim] = observation[d]
        newest = list(history[d])[max_delay - d :]  # the d newest actions, oldest first
        for k, action in enumerate(newest):
            expected[k, obs_dim:] = action
        assert th.equal(window[d], expected)
        assert th.equal(mask[d], expected != 0)  # all given numbers are at least 1


def test_random_lengths_have_the_stated_distribution():
    n, max_delay, p = 40_000, 4, 0.4
    delay = draw_delays(n, max_delay, "random", p, th.Generator().manual_seed(0))
    share = th.bincount(delay, minlength=max_delay + 1) / n
    inner = (1 - p) / (max_delay + 1)
    th.testing.assert_close(share, th.tensor([inner + p / 2, inner, inner, inner, inner + p / 2]), atol=0.01, rtol=0.0)
    again = draw_delays(n, max_delay, "random", p, th.Generator().manual_seed(0))
    assert th.equal(delay, again)


def test_fixed_lengths_and_no_delay():
    assert draw_delays(5, 4, "fixed", 0.5).tolist() == [4] * 5
    assert draw_delays(5, 0, "random", 0.5).tolist() == [0] * 5


def test_unknown_mask_is_refused():
    with pytest.raises(ValueError, match=r"mask is 'block', expected one of \('random', 'fixed'\)"):
        draw_delays(5, 4, "block")
