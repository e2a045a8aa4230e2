"""What windows weigh: returns to go against a walk through plain lists of episodes, scales and weights."""

import math

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_said.planner import PlannerConfig
from sb3_said.planner.values import VALUE_SCALES, returns_to_go, scaled_values, window_weight
from sb3_said.replay.windows import WindowSource

EPISODES = st.lists(
    st.tuples(st.lists(st.floats(-10, 10, width=32), min_size=1, max_size=12), st.booleans()), min_size=1, max_size=8
)


def make_source(episodes):
    """Lay episodes, lists of rewards and whether the task itself ended them, behind each other in a random order."""
    rewards = th.tensor([r for rewards, _ in episodes for r in rewards])
    number = th.cat([th.full((len(rewards),), i) for i, (rewards, _) in enumerate(episodes)])
    remaining = th.cat([th.arange(len(rewards), 0, -1) for rewards, _ in episodes])
    terminated = th.tensor([ended for _, ended in episodes])[number] & (remaining == 1)
    n = len(rewards)
    states = th.arange(float(n))[:, None, None]
    order = th.randperm(n, generator=th.Generator().manual_seed(n))
    starts = (order, th.zeros(n, dtype=th.int64), remaining[order], number[order], th.zeros(n))
    return WindowSource(states, 0.5 * states, rewards[:, None], terminated[:, None], *starts)


def naive_returns(episodes, gamma, penalty, value_fn):
    returns, index, horizon = [], 0, 1 / (1 - gamma)
    going_on = [r for rewards, terminated in episodes for r in (rewards[:-1] if terminated else rewards)]
    for rewards, terminated in episodes:
        index += len(rewards)
        if terminated:
            tail = rewards[-1] if penalty is None else penalty
        else:
            lacking = max(horizon - len(rewards), 0)
            mean = (sum(rewards) + lacking * np.mean(going_on)) / (len(rewards) + lacking)
            tail = mean * horizon if value_fn is None else 1.5 * (index - 1)
        for t in range(len(rewards)):
            value, factor = 0.0, 1.0
            for reward in rewards[t:-1]:
                value, factor = value + factor * reward, factor * gamma
            returns.append(value + factor * tail)
    return returns


def critic(states, actions):
    return states[:, 0] + actions[:, 0]


@settings(max_examples=80, deadline=None)
@given(EPISODES, st.sampled_from([0.0, 0.5, 0.99]), st.sampled_from([None, -100.0]), st.sampled_from([None, critic]))
def test_returns_against_a_walk_through_episodes(episodes, gamma, penalty, value_fn):
    source = make_source(episodes)
    returns = returns_to_go(source, gamma, penalty, value_fn)
    assert returns.dtype == th.float32
    expected = np.array(naive_returns(episodes, gamma, penalty, value_fn))[source.rows]
    np.testing.assert_allclose(returns, expected, rtol=1e-4, atol=1e-3)


def test_returns_by_hand():
    source = make_source([([1.0, 2.0], True), ([4.0, 8.0], False)])

    def twenty(states, actions):  # of the last step and all after it
        return th.full((len(states),), 20.0)

    returns = returns_to_go(source, 0.5, value_fn=twenty)
    assert returns[source.rows.argsort()].tolist() == [1 + 0.5 * 2, 2, 4 + 0.5 * 20, 20]


def test_an_endless_constant_reward_is_worth_the_geometric_series():
    # Every step of an episode cut by a time limit must look the same, near the limit or not.
    returns = returns_to_go(make_source([([3.0] * 50, False)]), 0.99)
    np.testing.assert_allclose(returns, 300.0, rtol=1e-5)


def test_a_step_at_a_logs_end_does_not_spread_the_scale_of_all_others():
    whole = [([1.0] * 200, False), ([0.5] * 200, False)] * 10
    weights = []
    for episodes in (whole, [*whole, ([5.0], False)]):
        source = make_source(episodes)
        weight = window_weight(scaled_values(returns_to_go(source, 0.99), "centred"), 4.0)
        weights.append(weight[source.rows.argsort()][:4000])
    assert th.corrcoef(th.stack(weights)).min() > 0.99
    ratio = [float(weight[0] / weight[200]) for weight in weights]
    assert ratio[1] > 0.5 * ratio[0] > 1000


def test_no_discount_needs_a_value_function():
    source = make_source([([1.0, 1.0], False)])
    with pytest.raises(ValueError, match="gamma < 1"):
        returns_to_go(source, 1.0)
    assert sorted(returns_to_go(source, 1.0, value_fn=lambda s, a: th.full((len(s),), 7.0)).tolist()) == [7.0, 8.0]
    ended = make_source([([1.0, 1.0], True), ([5.0], True)])
    assert sorted(returns_to_go(ended, 1.0).tolist()) == [1.0, 2.0, 5.0]


def test_the_range_is_from_the_lowest_to_the_highest():
    np.testing.assert_allclose(scaled_values(th.tensor([-5.0, 0.0, 15.0]), "range"), [0, 0.25, 1])
    assert scaled_values(th.full((4,), -7.0), "range").tolist() == [1.0] * 4


def test_the_centred_range_counts_beta_twice():
    """The code under the paper's results maps values to [-1, 1], so that its weights run from exp(-2 beta) to 1."""
    values = th.tensor([-5.0, 0.0, 15.0])
    np.testing.assert_allclose(scaled_values(values, "centred"), [-1, -0.5, 1])
    assert scaled_values(th.full((4,), -7.0), "centred").tolist() == [1.0] * 4
    weights = window_weight(scaled_values(values, "centred"), 2.0)
    np.testing.assert_allclose(weights, [math.exp(-4.0), math.exp(-3.0), 1.0], rtol=1e-6)
    th.testing.assert_close(weights, window_weight(scaled_values(values, "range"), 4.0))


@pytest.mark.parametrize("scale", VALUE_SCALES)
@given(st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=1, max_size=20))
def test_scaled_values_are_within_their_bounds_and_in_order(scale, values):
    values = th.tensor(values)
    scaled = scaled_values(values, scale)
    assert scaled.dtype == th.float32 and scaled.min() >= (-1 if scale == "centred" else 0) and scaled.max() <= 1
    assert (scaled[values.argsort()].diff() >= 0).all()


def test_window_weight_is_the_papers():
    values = th.tensor([0.0, 0.25, 1.0])
    expected = [math.exp(-2.0), math.exp(-1.5), 1.0]
    np.testing.assert_allclose(window_weight(values, 2.0), expected, rtol=1e-6)
    np.testing.assert_array_equal(window_weight(values, 0.0), np.ones(3))


@given(st.lists(st.integers(-3, 3), min_size=1, max_size=30))
def test_the_rank_is_the_part_of_the_others_below(values):
    others = np.array(values)[:, None]  # (M, 1)
    above = (others > values).sum(1) + ((others == values).sum(1) - 1) / 2
    ranks = scaled_values(th.tensor(values, dtype=th.float32), "rank")
    np.testing.assert_allclose(ranks, above / max(1, len(values) - 1), rtol=1e-6)


def test_by_default_falls_weigh_next_to_nothing_where_all_begin_low():
    """By ranks a start that leads to a fall weighs half of one that does not: most windows are worth more than both."""
    config = PlannerConfig()
    falls, starts, later = th.linspace(-100, 0, 200), th.linspace(300, 400, 100), th.linspace(500, 800, 10_000)
    values = th.cat([falls, starts, later])
    weights = window_weight(scaled_values(values, config.value_scale), config.weight_factor)
    assert weights[:200].max() < weights[200:300].min() / 10
    assert weights[200:300].min() > weights.max() / 100  # and still count themselves


def test_ranks_weigh_alike_whatever_the_scale_of_values():
    """One beta picks as much of data that is mostly bad as of data that is mostly good."""
    values = th.rand(1000, generator=th.Generator().manual_seed(0), dtype=th.float64)
    weights = window_weight(scaled_values(values, "rank"), 2.0)
    for other in (values**4, 1 - (1 - values) ** 4, 5 * values - 3):
        th.testing.assert_close(window_weight(scaled_values(other, "rank"), 2.0), weights)
