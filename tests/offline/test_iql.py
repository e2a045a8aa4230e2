"""Implicit Q-learning against closed forms: expectiles, a bandit, and a chain solved by hand."""

import copy
import math

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import expectile as scipy_expectile

from sb3_said.offline import IQL, Dataset, ImplicitValues, IQLConfig
from sb3_said.offline.iql import expectile_loss


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=2, max_size=20), st.floats(0.5, 0.95))
def test_the_loss_is_least_at_the_expectile(samples, tau):
    best = scipy_expectile(samples, alpha=tau)
    q = th.tensor(samples, dtype=th.float64)
    losses = [expectile_loss(q - v, tau) for v in (best - 1e-2, best, best + 1e-2)]
    assert losses[1] <= min(losses)


def dataset(states, actions, rewards, terminated, ends, finals):
    floats = [np.asarray(x, np.float32) for x in (states, actions, rewards)]
    return Dataset(*floats, np.asarray(terminated, bool), np.asarray(ends, bool), np.asarray(finals, np.float32))


def train(data, updates, gamma=0.9, **config):
    th.manual_seed(0)
    values = ImplicitValues(data.states.shape[1], 1, IQLConfig(hidden=32, learning_rate=1e-2, batch_size=32, **config))
    iql = IQL(values, data, gamma)
    for _ in range(updates):
        iql.step()
    return values


@pytest.mark.parametrize("tau", [0.5, 0.9])
def test_a_bandit_has_the_expectile_of_its_arms_as_value(tau):
    """Arms of 0 and 4, drawn alike: tau (4 - v) = (1 - tau) v, so V is 4 tau; Q is each arm's reward."""
    actions, end = np.array([[-1.0], [1.0]]), [True, True]
    rewards = np.array([0.0, 4.0])
    values = train(dataset(np.zeros((2, 2)), actions, rewards, end, end, np.zeros((2, 2))), 300, expectile=tau)
    assert values.scale == 0.25  # one step over returns of 0 and 4; it must not show in the values
    with th.no_grad():
        assert values.value(th.zeros(1, 2)).item() == pytest.approx(4 * tau, abs=0.15)
        np.testing.assert_allclose(values.q_value(th.zeros(2, 2), th.tensor(actions).float()), rewards, atol=0.2)


@pytest.mark.parametrize("terminates", [True, False])
def test_values_reach_back_through_time_and_end_with_the_task_alone(terminates):
    """s0 -> s1 -> s2, 1 a step: 1 + 0.9 + 0.81 at s0, if the task ends; else s2 leads to itself, and all are 10."""
    states = np.eye(3)
    finals = [[0.0, 0.0, 0.0]] if terminates else states[2:]
    data = dataset(states, np.zeros((3, 1)), np.ones(3), [False, False, terminates], [False, False, True], finals)
    values = train(data, 500, target_rate=0.1)
    expected = [2.71, 1.9, 1.0] if terminates else [10.0, 10.0, 10.0]
    with th.no_grad():
        found = values.value(th.eye(3))
        np.testing.assert_allclose(found, expected, rtol=0.07, atol=0.1)
        np.testing.assert_allclose(values.value(th.eye(3)[:, None])[:, 0], found)  # any leading shape


def test_a_resumed_training_ends_as_one_that_never_stopped():
    data = dataset(np.eye(3), np.zeros((3, 1)), np.ones(3), [0, 0, 1], [0, 0, 1], np.zeros((1, 3)))

    def make(**changes):
        th.manual_seed(0)
        return IQL(ImplicitValues(3, 1, IQLConfig(hidden=8, **changes)), data, 0.9)

    whole, first = make(), make()
    for _ in range(6):
        whole.step()
    for _ in range(3):
        first.step()
    saved, second = copy.deepcopy(first.state_dict()), make()
    second.load_state_dict(saved)
    for _ in range(3):
        second.step()
    th.testing.assert_close(second.values.state_dict(), whole.values.state_dict(), rtol=0, atol=0)
    with pytest.raises(ValueError, match=r"'expectile': 0\.7, .* and is to go on with .*'expectile': 0\.9, "):
        make(expectile=0.9).load_state_dict(saved)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("expectile", (0.4, 1.0, math.nan, "high"), r"0\.5 \(the mean\) up to, not with, 1"),
        ("learning_rate", (0.0, math.inf, math.nan), "a number above 0"),
        ("target_rate", (0.0, 1.1), "a number above 0 and at most 1"),
        ("hidden", (0, 8.0), "a whole number, at least 1"),
        ("batch_size", (0,), "a whole number, at least 1"),
        ("updates", (0,), "a whole number, at least 1"),
    ],
)
def test_settings_out_of_range_are_refused(name, values, expected):
    for value in values:
        with pytest.raises(ValueError, match=f"{name} is {value!r}, expected {expected}"):
            IQLConfig(**{name: value})
