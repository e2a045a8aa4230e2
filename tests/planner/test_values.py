"""Values of stored steps, against loops that need no thought."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_said.planner.values import average_reward_tail, discounted_values, normalise_values

STEPS = st.integers(1, 30).flatmap(
    lambda n_steps: st.integers(1, 3).flatmap(
        lambda n_envs: st.tuples(
            hnp.arrays(np.float32, (n_steps, n_envs), elements=st.floats(-10, 10, width=32)),
            hnp.arrays(bool, (n_steps, n_envs)),
            hnp.arrays(bool, (n_steps, n_envs)),
            hnp.arrays(np.float32, (n_steps, n_envs), elements=st.floats(-100, 100, width=32)),
        )
    )
)


def naive_values(rewards, terminated, ends, tails, gamma):
    """Sum forwards from every step to its episode's end."""
    values = np.zeros(rewards.shape)
    for start, env in np.ndindex(*rewards.shape):
        factor, t = 1.0, start
        while not ends[t, env]:
            values[start, env] += factor * float(rewards[t, env])
            factor, t = factor * gamma, t + 1
        last = rewards[t, env] if terminated[t, env] else tails[t, env]
        values[start, env] += factor * float(last)
    return values


@settings(max_examples=60, deadline=None)
@given(STEPS, st.sampled_from([0.0, 0.5, 0.99, 1.0]))
def test_discounted_values_against_a_loop(steps, gamma):
    rewards, ends, terminations, tails = steps
    ends[-1] = True
    terminated = ends & terminations
    values = discounted_values(rewards, terminated, ends, tails, gamma)
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, naive_values(rewards, terminated, ends, tails, gamma), rtol=1e-5, atol=1e-4)


def test_discounted_values_by_hand():
    rewards = np.array([[1.0], [2.0], [4.0], [8.0]], np.float32)
    ends = np.array([[False], [True], [False], [True]])
    terminated = np.array([[False], [True], [False], [False]])
    tails = np.array([[9.0], [9.0], [9.0], [20.0]], np.float32)  # 20 is of the last step and all after it
    values = discounted_values(rewards, terminated, ends, tails, 0.5)
    assert values[:, 0].tolist() == [1 + 0.5 * 2, 2, 4 + 0.5 * 20, 20]


@settings(max_examples=40, deadline=None)
@given(STEPS)
def test_average_reward_tail_against_a_loop(steps):
    rewards, ends, *_ = steps
    ends[-1] = True
    tails = average_reward_tail(rewards, ends, 0.9)
    for env in range(rewards.shape[1]):
        first = 0
        for t in np.flatnonzero(ends[:, env]):
            mean = np.mean(rewards[first : t + 1, env], dtype=np.float64)
            np.testing.assert_allclose(tails[t, env], mean * 10, rtol=1e-4, atol=1e-4)
            first = t + 1


def test_an_endless_constant_reward_is_worth_the_geometric_series():
    # Every step of an episode cut by a time limit must look the same, near the limit or not.
    rewards, ends = np.full((50, 1), 3.0, np.float32), np.zeros((50, 1), bool)
    ends[-1] = True
    values = discounted_values(rewards, np.zeros_like(ends), ends, average_reward_tail(rewards, ends, 0.99), 0.99)
    np.testing.assert_allclose(values, 300.0, rtol=1e-5)


def test_no_discount_has_no_endless_value():
    with pytest.raises(ValueError, match="gamma < 1"):
        average_reward_tail(np.ones((3, 1), np.float32), np.ones((3, 1), bool), 1.0)


def test_normalise_values():
    np.testing.assert_allclose(normalise_values(np.array([[-5.0], [0.0], [15.0]], np.float32)), [[0], [0.25], [1]])
    constant = normalise_values(np.full((4, 2), -7.0, np.float32))
    np.testing.assert_array_equal(constant, np.ones((4, 2)))


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, st.integers(1, 20), elements=st.floats(-(2.0**100), 2.0**100, width=32)))
def test_normalised_values_are_within_zero_and_one_and_in_order(values):
    scaled = normalise_values(values)
    assert scaled.dtype == np.float32 and scaled.min() >= 0 and scaled.max() == 1
    order = np.argsort(values, kind="stable")
    assert np.all(np.diff(scaled[order]) >= 0)
