"""Intervals keep what an interval promises; summaries are strict JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sb3_said.evaluation import Latency, Summary, bootstrap_interval, iqm


@pytest.mark.parametrize("statistic", [np.mean, np.median, iqm])
@pytest.mark.parametrize("n", [5, 20, 100])
def test_interval_of_skewed_values(statistic, n: int) -> None:
    sample = np.random.default_rng(n).exponential(size=n) ** 2
    found = bootstrap_interval(sample, statistic)
    assert found.value == pytest.approx(statistic(sample)) and (found.n, found.confidence) == (n, 0.95)
    assert sample.min() <= found.low < found.value < found.high <= sample.max()
    # In exact powers of two, so that ties among resamples stay ties.
    scaled, turned = (bootstrap_interval(factor * sample, statistic) for factor in (4.0, -2.0))
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
    found = bootstrap_interval(sample)
    assert found.low > low and found.high > high + 0.02 * (high - low)


def test_interval_covers_the_true_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(400):
        interval = bootstrap_interval(rng.exponential(size=20), n_resamples=1000)
        hits.append(interval.low <= 1.0 <= interval.high)
    assert 0.88 <= np.mean(hits) <= 0.98  # BCa is a little short of 95 % at n = 20


def test_interval_repeats_and_contains_its_value() -> None:
    sample = np.random.default_rng(3).normal(size=12)
    first, second = bootstrap_interval(sample), bootstrap_interval(sample)
    assert first == second and first.low < first.value < first.high
    wider = bootstrap_interval(sample, confidence=0.99)
    assert wider.low < first.low and first.high < wider.high


@pytest.mark.filterwarnings("error")
def test_interval_of_constant_and_single_values() -> None:
    for statistic in (np.mean, iqm):
        constant = bootstrap_interval([0.1] * 7, statistic)
        assert (constant.value, constant.low, constant.high) == pytest.approx((0.1, 0.1, 0.1), abs=1e-15)
    one = bootstrap_interval([3.0])
    assert one.value == 3.0 and np.isnan(one.low) and np.isnan(one.high)


@pytest.mark.filterwarnings("error")
def test_interval_where_no_single_value_matters() -> None:
    found = bootstrap_interval([1.0, 1.0, 1.0, 1.0, 5.0], np.median)
    assert (found.value, found.low, found.high) == (1.0, 1.0, 5.0)
    successes = bootstrap_interval([1000.0] * 9 + [990.0], iqm)
    assert 990.0 < successes.low < successes.value == successes.high == 1000.0


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [np.inf]])
def test_interval_refuses_what_has_no_mean(values: list[float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        bootstrap_interval(values)
    with pytest.raises(ValueError, match="confidence"):
        bootstrap_interval([1.0, 2.0], confidence=95)


def test_iqm_drops_a_quarter_at_each_end() -> None:
    assert iqm(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    np.testing.assert_allclose(iqm(np.arange(12.0).reshape(2, 6)), [2.5, 8.5])


def test_latency_percentiles_are_ordered() -> None:
    latency = Latency.from_seconds(np.arange(1, 101) / 1000)
    assert latency.p50_ms == pytest.approx(50.5) and latency.max_ms == 100.0
    assert latency.p50_ms < latency.p95_ms < latency.p99_ms < latency.max_ms
    with pytest.raises(ValueError, match="none"):
        Latency.from_seconds([])


def test_summary_is_strict_json() -> None:
    summary = Summary.from_episodes("planner", [5.0], [7], Latency.from_seconds([0.001]))
    read = json.loads(json.dumps(summary.to_dict(), allow_nan=False))
    assert read["mean_return"] == {"value": 5.0, "low": None, "high": None, "confidence": 0.95, "n": 1}
    assert read["returns"] == [5.0] and read["lengths"] == [7] and read["latency"]["n_calls"] == 1
