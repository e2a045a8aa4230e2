"""The known mask and the known window against naive loops; the drawn mask lengths."""

import pytest
import torch as th

from sb3_said.planner.inpainting import draw_delays, draw_known_states, known_mask, known_window


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


@pytest.mark.parametrize("max_delay", [0, 1, 5])
def test_extra_states_lie_where_their_actions_led(max_delay):
    n, length, obs_dim, act_dim = 60, max_delay + 3, 3, 2
    generator = th.Generator().manual_seed(0)
    delay = th.randint(max_delay + 1, (n,), generator=generator)
    states = 1 + th.rand(n, max_delay + 1, obs_dim, generator=generator)  # s_{t-D..t}
    actions = 1 + th.rand(n, max_delay, act_dim, generator=generator)
    state_known = th.rand(n, max_delay, generator=generator) < 0.5
    observation = states[th.arange(n), max_delay - delay]
    mask = known_mask(delay, length, obs_dim, act_dim, state_known)
    window = known_window(observation, actions, delay, length, states[:, 1:])
    for b, d in enumerate(delay.tolist()):
        expected = th.zeros(length, obs_dim + act_dim)
        expected[0, :obs_dim] = observation[b]
        for k in range(max_delay):  # a_{t-D+k} leads to s_{t-D+k+1}, which a window from s_{t-d} has at index k+1-(D-d)
            index = k + 1 - (max_delay - d)
            if index >= 1:
                expected[index - 1, obs_dim:] = actions[b, k]
                expected[index, :obs_dim] = states[b, k + 1] * state_known[b, k]
        assert th.equal(mask[b], expected != 0)  # all given numbers are at least 1
        assert th.equal(window[b] * mask[b], expected)
        if d == 0:  # nothing is hidden, and nothing else is known
            assert mask[b].sum() == obs_dim


def test_any_number_of_extra_states_is_as_likely_as_any_other():
    n, max_delay, p = 40_000, 4, 0.6
    known = draw_known_states(n, max_delay, p, th.Generator().manual_seed(0))
    share = th.bincount(known.sum(1), minlength=max_delay + 1) / n
    each = p / (max_delay + 1)
    th.testing.assert_close(share, th.tensor([1 - p + each] + [each] * max_delay), atol=0.01, rtol=0.0)
    th.testing.assert_close(known.float().mean(0), th.full((max_delay,), p / 2), atol=0.01, rtol=0.0)
    assert th.equal(known, draw_known_states(n, max_delay, p, th.Generator().manual_seed(0)))
    assert draw_known_states(5, 0, 1.0).shape == (5, 0)


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
