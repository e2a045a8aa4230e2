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
from sb3_said.offline.iql import Transitions, expectile_loss


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
        x = th.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])  # states of all zeros, and either arm
        for q in values.q:
            np.testing.assert_allclose(q(x)[:, 0] / values.scale, rewards, atol=0.2)


def test_losses_are_those_of_the_formulas():
    """With both critics apart, so that it shows that the smaller one counts, of which networks, and where it ends."""
    th.manual_seed(0)
    values = ImplicitValues(3, 1, IQLConfig(hidden=8, expectile=0.8))
    with th.no_grad():
        for critics in (values.q, values.q_target):
            for q, factor in zip(critics, (9.0, -9.0), strict=True):  # neither is the smaller one everywhere
                q[-1].weight *= factor
        values.mean += 0.3
        values.std *= 2.0
        values.scale *= 0.25
    batch = Transitions(*(th.randn(20, *shape) for shape in ((3,), (1,), (), (3,))), (th.arange(20) % 3 == 0).float())
    expected, smaller = {"v_loss": 0.0, "q_loss": 0.0}, set()
    with th.no_grad():
        for s, a, r, s_next, ended in zip(*batch, strict=True):
            z, z_next = ((x - 0.3) / 2 for x in (s, s_next))
            x = th.cat([z, a])
            target = [q(x).item() for q in values.q_target]
            smaller.add(int(np.argmin(target)))
            u = min(target) - values.v(z).item()
            expected["v_loss"] += (0.8 if u >= 0 else 0.2) * u**2 / 20
            y = 0.25 * r.item() + (0.0 if ended else 0.9 * values.v(z_next).item())
            expected["q_loss"] += sum((q(x).item() - y) ** 2 for q in values.q) / 20
        losses = values.losses(batch, gamma=0.9)
    assert smaller == {0, 1}
    assert {name: loss.item() for name, loss in losses.items()} == pytest.approx(expected, rel=1e-4)


def test_rewards_are_scaled_by_the_longest_trajectory_over_the_spread_of_returns():
    """Trajectories of 2 and 3 steps, which return 5 and 1."""
    ends = [False, True, False, False, True]
    data = dataset(np.eye(5), np.zeros((5, 1)), [2.0, 3.0, 0.0, 0.0, 1.0], ends, ends, np.zeros((2, 5)))
    assert IQL(ImplicitValues(5, 1, IQLConfig(hidden=8)), data, 0.9).values.scale == 3 / 4


def test_values_of_nearly_equal_returns_are_found_too():
    """Each step returns 1, but for a thousandth: V is 1 / (1 - gamma) from any start, far from the ends."""
    rng = np.random.default_rng(0)
    ends = np.tile(np.arange(20) == 19, 3)
    rewards = 1.0 + 1e-3 * rng.normal(size=60)
    data = dataset(rng.normal(size=(60, 2)), np.zeros((60, 1)), rewards, np.zeros(60), ends, rng.normal(size=(3, 2)))
    values = train(data, 150, gamma=0.5, expectile=0.5, target_rate=0.3)
    assert values.scale == pytest.approx(20 / (0.1 * 20), rel=0.01)
    with th.no_grad():
        np.testing.assert_allclose(values.value(th.from_numpy(data.states)), 2.0, atol=0.2)


@pytest.mark.parametrize("terminates", [True, False])
def test_values_reach_back_through_time_and_end_with_the_task_alone(terminates):
    """s0 -> s1 -> s2, 1 a step: 1 + 0.9 + 0.81 at s0, if the task ends; else s2 leads to itself, and all are 10."""
    states = np.eye(3)
    finals = [[0.0, 0.0, 0.0]] if terminates else states[2:]
    data = dataset(states, np.zeros((3, 1)), np.ones(3), [False, False, terminates], [False, False, True], finals)
    values = train(data, 350, target_rate=0.15)
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
    with pytest.raises(ValueError, match=r"V\(s\) was learned with .*: expectile was 0\.7 and is now 0\.9\. "):
        make(expectile=0.9).load_state_dict(saved)
    saved["values"]["v.0.weight"][0] = th.nan
    with pytest.raises(ValueError, match="holds NaN or infinite numbers"):
        make().load_state_dict(saved)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("expectile", (0.4, 1.0), r"a number from 0\.5, the mean, up to below 1"),
        ("expectile", (math.nan, "high"), "a finite number"),
        ("learning_rate", (math.inf, math.nan), "a finite number"),
        ("hidden", (8.0,), "a whole number"),
        ("hidden", (0,), "at least 1"),
        ("batch_size", (0,), "at least 1"),
        ("updates", (0,), "at least 1"),
        ("updates", (10**9,), "at most 1000"),
        ("batch_size", (10**12,), "at most 1000000"),
    ],
)
def test_settings_out_of_range_are_refused(name, values, expected):
    for value in values:
        with pytest.raises(ValueError, match=f"{name} is {value!r}, expected {expected}"):
            IQLConfig(**{name: value})


@pytest.mark.parametrize("given", [{"learning_rate": 0.0}, {"target_rate": 0.0}, {"target_rate": 1.1}])
def test_rates_out_of_range_are_refused(given):
    with pytest.raises(ValueError, match="expected numbers above 0, the second at most 1"):
        IQLConfig(**given)
