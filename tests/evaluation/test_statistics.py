"""Intervals keep what an interval promises; summaries are strict JSON."""

from __future__ import annotations

import json
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import trim_mean, ttest_1samp

from sb3_said.evaluation import Latency, Summary, confidence_interval, stratified_interval, worst_tenth


def iqm(values, axis=-1):
    return trim_mean(values, 0.25, axis=axis)


@pytest.mark.parametrize("statistic", [np.mean, np.median, iqm])
@pytest.mark.parametrize("n", [10, 20, 100])
def test_interval_of_skewed_values(statistic, n: int) -> None:
    sample = np.random.default_rng(n).exponential(size=n) ** 2
    found = confidence_interval(sample, statistic)
    assert found.value == pytest.approx(statistic(sample))
    assert (found.n, found.confidence, found.method) == (n, 0.95, "BCa bootstrap")
    assert sample.min() <= found.low < found.value < found.high <= sample.max()
    # In exact powers of two, so that ties among resamples stay ties.
    scaled, turned = (confidence_interval(factor * sample, statistic) for factor in (4.0, -2.0))
    np.testing.assert_allclose(
        [scaled.low, scaled.value, scaled.high], [4 * found.low, 4 * found.value, 4 * found.high]
    )
    np.testing.assert_allclose(
        [turned.high, turned.value, turned.low], [-2 * found.low, -2 * found.value, -2 * found.high]
    )


def test_bca_corrects_for_skew() -> None:
    """A long tail above: the bound on its side lies further from the mean than the percentile interval's."""
    sample = np.random.default_rng(20).exponential(size=20) ** 2
    draws = np.random.default_rng(1).choice(sample, (20_000, 20)).mean(1)
    low, high = np.quantile(draws, [0.025, 0.975])
    found = confidence_interval(sample)
    assert found.low > low and found.high > high + 0.02 * (high - low)


def test_interval_covers_the_true_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(200):
        interval = confidence_interval(rng.exponential(size=20), n_resamples=500)
        hits.append(interval.low <= 1.0 <= interval.high)
    assert 0.88 <= np.mean(hits) <= 0.98  # BCa is a little short of 95 % at n = 20


@pytest.mark.parametrize("n", [2, 3, 5, 9])
def test_few_values_have_the_t_interval_of_their_mean(n: int) -> None:
    sample = np.random.default_rng(n).normal(1000.0, 300.0, n)
    expected = ttest_1samp(sample, 0.0).confidence_interval(0.9)
    found = confidence_interval(sample, confidence=0.9)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert found.method == "Student's t"


def test_seeds_are_the_units_whatever_their_episodes() -> None:
    """Three seeds: the interval of their means. Twelve: their episodes are drawn together."""
    rng = np.random.default_rng(0)
    returns = rng.normal(size=(3, 1)) + rng.normal(size=(3, 20))
    found, of_means = confidence_interval(returns), confidence_interval(returns.mean(1))
    assert (found.value, found.low, found.high) == pytest.approx((of_means.value, of_means.low, of_means.high))
    assert found.n == 3
    assert confidence_interval(returns, iqm).value == pytest.approx(iqm(returns.ravel()))
    many = 3 * rng.normal(size=(12, 1)) + rng.normal(size=(12, 20))
    by_seed, as_if_alone = confidence_interval(many), confidence_interval(many.ravel())
    of_means = confidence_interval(many.mean(1))
    assert (by_seed.low, by_seed.high) == pytest.approx((of_means.low, of_means.high), rel=1e-3)
    assert by_seed.method == "BCa bootstrap"
    assert by_seed.high - by_seed.low > 2 * (as_if_alone.high - as_if_alone.low)


@settings(deadline=None, max_examples=30)
@given(
    n=st.integers(2, 5),
    m=st.integers(1, 4),
    spread=st.sampled_from([0.0, 1e-5, 1.0, 300.0]),
    statistic=st.sampled_from([np.mean, np.median, iqm]),
    seed=st.integers(0, 1000),
)
def test_few_values_that_hardly_change_have_the_same_interval(n, m, spread, statistic, seed) -> None:
    rng = np.random.default_rng(seed)
    sample = rng.choice([-700.0, -766.0, 1000.0], (n, m)) + spread * rng.normal(size=(n, m))
    tiny = 1e-5 * rng.uniform(-1, 1, (n, m))
    before, after = confidence_interval(sample, statistic), confidence_interval(sample + tiny, statistic)
    # No unit moves a statistic by more than its values move; t is 12.7 at one degree of freedom.
    assert abs(after.value - before.value) <= 1e-5
    assert abs(after.low - before.low) <= 1e-3 and abs(after.high - before.high) <= 1e-3


@pytest.mark.parametrize("n", [3, 5])
def test_intervals_over_few_seeds_cover_the_mean_of_normal_returns(n: int) -> None:
    """Episodes within seeds, seeds within the algorithm: 95 % of the intervals hold the algorithm's mean."""
    rng = np.random.default_rng(n)
    hits = []
    for _ in range(1500):
        returns = 5.0 + 2.0 * rng.normal(size=(n, 1)) + rng.normal(size=(n, 10))
        interval = confidence_interval(returns)
        hits.append(interval.low <= 5.0 <= interval.high)
    assert 0.93 <= np.mean(hits) <= 0.97  # the standard error is 0.006


@pytest.mark.parametrize("n", [3, 12])
def test_interval_repeats_and_contains_its_value(n: int) -> None:
    sample = np.random.default_rng(3).normal(size=n)
    first, second = confidence_interval(sample), confidence_interval(sample)
    assert first == second and first.low < first.value < first.high
    wider = confidence_interval(sample, confidence=0.99)
    assert wider.low < first.low and first.high < wider.high


@pytest.mark.filterwarnings("error")
def test_interval_of_constant_and_single_values() -> None:
    for statistic in (np.mean, iqm):
        constant = confidence_interval([0.1] * 7, statistic)
        assert (constant.value, constant.low, constant.high) == pytest.approx((0.1, 0.1, 0.1), abs=1e-15)
    one = confidence_interval([3.0])
    assert one.value == 3.0 and np.isnan(one.low) and np.isnan(one.high) and str(one) == "3.0"


@settings(deadline=None, max_examples=30)
@given(st.floats(-1e4, 1e4), st.integers(2, 50), st.integers(0, 99))
def test_an_interval_of_equal_values_holds_their_mean(value: float, n: int, seed: int) -> None:
    """Whose last bits depend on the order of the sum."""
    for interval in (confidence_interval([value] * n, seed=seed), stratified_interval([[value] * n] * 3, seed=seed)):
        assert interval.low <= interval.value <= interval.high


@pytest.mark.filterwarnings("error")
def test_interval_where_no_single_value_matters() -> None:
    found = confidence_interval([1.0] * 7 + [5.0] * 4, np.median)
    assert (found.value, found.low, found.high, found.method) == (1.0, 1.0, 5.0, "percentile bootstrap")
    successes = confidence_interval([1000.0] * 9 + [990.0], iqm)
    assert 990.0 < successes.low < successes.value == successes.high == 1000.0


@pytest.mark.parametrize("values", [[], [[], []], [1.0, np.nan], [np.inf]])
def test_interval_refuses_what_has_no_mean(values: list[Any]) -> None:
    with pytest.raises(ValueError, match="finite"):
        confidence_interval(values)
    with pytest.raises(ValueError, match="confidence"):
        confidence_interval([1.0, 2.0], confidence=95)


def test_latency_percentiles_are_ordered() -> None:
    latency = Latency.from_seconds(np.arange(1, 101) / 1000)
    assert latency.p50_ms == pytest.approx(50.5) and latency.max_ms == 100.0
    assert latency.p50_ms < latency.p95_ms < latency.p99_ms < latency.max_ms
    with pytest.raises(ValueError, match="none"):
        Latency.from_seconds([])


def test_summary_is_strict_json() -> None:
    summary = Summary.from_episodes("planner", [5.0], [7], Latency.from_seconds([0.001]))
    read = json.loads(json.dumps(summary.to_dict(), allow_nan=False))
    assert read["mean_return"] == {
        "value": 5.0,
        "low": None,
        "high": None,
        "confidence": 0.95,
        "n": 1,
        "method": "none",
    }
    assert read["returns"] == [5.0] and read["lengths"] == [7] and read["latency"]["n_calls"] == 1


def test_a_summary_has_each_of_its_numbers_from_its_own_column() -> None:
    returns, lengths, ends = np.arange(30.0), np.arange(30) + 100, np.arange(30) < 4
    summary = Summary.from_episodes("x", returns, lengths, terminated=ends, action_changes=returns / 100)
    assert summary.mean_return == confidence_interval(returns)
    assert summary.mean_length == confidence_interval(lengths)
    assert summary.mean_action_change == confidence_interval(returns / 100)
    assert (summary.worst_tenth, summary.terminations) == (1.0, 4)
    assert Summary.from_episodes("x", returns, lengths).terminations is None
    assert Summary.from_episodes("x", returns, lengths, successes=~ends).successes == 26


def test_the_worst_tenth() -> None:
    assert worst_tenth([5.0]) == 5.0
    assert worst_tenth(np.arange(20.0)[::-1]) == 0.5
    assert worst_tenth(np.arange(22.0).reshape(2, 11)) == 1.0


def test_a_stratified_interval_has_the_spread_of_seeds_and_of_their_episodes() -> None:
    """The mean's variance, of S seeds drawn and E episodes of each: between / S + within / (S E)."""
    rng = np.random.default_rng(0)
    for spread, n_seeds, n_episodes in ((0.0, 4, 20), (30.0, 4, 20), (30.0, 9, 5)):
        returns = rng.normal(100, 10, (n_seeds, n_episodes)) + spread * rng.normal(size=(n_seeds, 1))
        between, within = returns.mean(1).var(), returns.var(1).mean()
        expected = 1.96 * np.sqrt(between / n_seeds + within / (n_seeds * n_episodes))
        found = stratified_interval(returns)
        assert found.value == pytest.approx(returns.mean()) and found.n == n_seeds * n_episodes
        assert (found.high - found.low) / 2 == pytest.approx(expected, rel=0.08)
    only = stratified_interval(np.full((3, 2), 7.0))
    assert (only.low, only.value, only.high) == (7.0, 7.0, 7.0)


@pytest.mark.parametrize("returns", [[1.0, 2.0], [[]], [[np.nan, 1.0]]])
def test_a_stratified_interval_needs_seeds_and_their_episodes(returns: Any) -> None:
    with pytest.raises(ValueError, match="shape"):
        stratified_interval(returns)


def test_an_interval_of_many_episodes_takes_no_gigabytes() -> None:
    values = np.random.default_rng(0).normal(size=4_000)
    for interval in (confidence_interval, lambda x, **how: stratified_interval(np.stack([x, x + 1]), **how)):
        tracemalloc.start()
        found = interval(values, n_resamples=1_500)
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert largest < 100e6 and found.low < found.value < found.high  # at once: 560 MB, and 96 MB a seed


def test_percentiles_are_those_they_are_called():
    latency = Latency.from_seconds(np.arange(101) / 1000)
    assert (latency.p50_ms, latency.p95_ms, latency.p99_ms, latency.max_ms) == pytest.approx((50, 95, 99, 100))


@pytest.mark.parametrize("interval", [confidence_interval, stratified_interval])
def test_resamples_are_of_the_seed(interval: Any) -> None:
    values = np.random.default_rng(0).normal(size=(12, 3))
    first, again, other = (interval(values, n_resamples=200, seed=seed) for seed in (1, 1, 2))
    assert first == again and first.low != other.low


def test_a_stratified_interval_is_wider_where_it_is_to_cover_more():
    values = np.random.default_rng(0).normal(size=(12, 3))
    narrow, wide = (stratified_interval(values, confidence, n_resamples=2000) for confidence in (0.5, 0.99))
    assert wide.low < narrow.low < narrow.high < wide.high
