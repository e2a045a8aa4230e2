"""Implicit Q-learning against closed forms: expectiles, a bandit, and a chain solved by hand."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import expectile as scipy_expectile

from sb3_said.offline import IQL, ImplicitValues, IQLConfig, Transitions
from sb3_said.offline.iql import expectile_loss


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=2, max_size=20), st.floats(0.5, 0.95))
def test_the_loss_is_least_at_the_expectile(samples, tau):
    best = scipy_expectile(samples, alpha=tau)
    q = th.tensor(samples, dtype=th.float64)
    losses = [expectile_loss(q - v, tau) for v in (best - 1e-2, best, best + 1e-2)]
    assert losses[1] <= min(losses)


def train(batch, updates, gamma=0.9, **config):
    th.manual_seed(0)
    values = ImplicitValues(batch.states.shape[1], 1, IQLConfig(hidden=32, learning_rate=3e-3, **config))
    values.fit(batch.states, th.tensor([0.0, 500.0]))  # so that rewards are doubled, as returns must not show
    iql = IQL(values, gamma)
    for _ in range(updates):
        iql.update(batch)
    return values


@pytest.mark.parametrize("tau", [0.5, 0.9])
def test_a_bandit_has_the_expectile_of_its_arms_as_value(tau):
    """Arms of 0 and 1, drawn alike: tau (1 - v) = (1 - tau) v, so V is tau; Q is each arm's reward."""
    actions = th.tensor([[-1.0], [1.0]]).repeat(16, 1)
    states = th.zeros(32, 2)
    batch = Transitions(states, actions, (actions[:, 0] + 1) / 2, states, th.ones(32))
    values = train(batch, 400, expectile=tau)
    with th.no_grad():
        assert values.value(states[:1]).item() == pytest.approx(tau, abs=0.03)
        np.testing.assert_allclose(values.q_value(states[:2], actions[:2]), [0.0, 1.0], atol=0.05)


def test_values_reach_back_through_time_and_stop_at_terminal_states():
    """s0 -> s1 -> s2 -> end, 1 a step: V = 1 + 0.9 + 0.81, 1.9, 1; past a time limit V(s3) counts, too."""
    states = th.eye(4)[:3]
    next_states = th.eye(4)[1:]
    batch = Transitions(states, th.zeros(3, 1), th.ones(3), next_states, th.tensor([0.0, 0.0, 1.0]))
    values = train(Transitions(*(x.repeat(8, *[1] * (x.dim() - 1)) for x in batch)), 1500, target_rate=0.05)
    with th.no_grad():
        np.testing.assert_allclose(values.value(states), [2.71, 1.9, 1.0], atol=0.15)
        np.testing.assert_allclose(values.value(states[:, None])[:, 0], values.value(states))  # any leading shape


def test_settings_that_make_no_expectile_are_refused():
    for tau in (0.4, 1.0):
        with pytest.raises(ValueError, match="expectile is"):
            IQLConfig(expectile=tau)
