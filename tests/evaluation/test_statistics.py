"""Intervals against scipy and against what an interval promises."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sb3_said.evaluation import Latency, Summary, bootstrap_interval, iqm


@pytest.mark.parametrize("statistic", [np.mean, iqm])
@pytest.mark.parametrize("n", [5, 20, 100])
def test_interval_agrees_with_scipy(statistic, n: int) -> None:
    scipy_stats = pytest.importorskip("scipy.stats")
    sample = np.random.default_rng(n).exponential(size=n) ** 2  # skewed, so that BCa and percentile differ
    ours = bootstrap_interval(sample, statistic, n_resamples=20_000)
    theirs = scipy_stats.bootstrap(
        (sample,), statistic, n_resamples=20_000, method="BCa", rng=np.random.default_rng(1)
    ).confidence_interval
    width = theirs.high - theirs.low
    assert ours.value == pytest.approx(statistic(sample))
    assert abs(ours.low - theirs.low) < 0.03 * width and abs(ours.high - theirs.high) < 0.05 * width


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


def test_interval_of_constant_and_single_values() -> None:
    constant = bootstrap_interval([3.0] * 5)
    assert (constant.value, constant.low, constant.high) == (3.0, 3.0, 3.0)
    one = bootstrap_interval([3.0])
    assert one.value == 3.0 and np.isnan(one.low) and np.isnan(one.high)


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
