"""Intervals, percentiles and the summary of an evaluation that is written to disk."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

# With fewer units a bootstrap interval covers less than Student's t, for normal and for skewed values.
FEWEST_RESAMPLED = 10


@dataclass(frozen=True)
class Interval:
    """A statistic of n independent units and its interval, see ``confidence_interval``.

    ``low`` and ``high`` are NaN for a single unit, which tells nothing about the spread.
    """

    value: float
    low: float
    high: float
    confidence: float
    n: int
    method: str

    def __str__(self) -> str:
        return f"{self.value:.1f}" + f" [{self.low:.1f}, {self.high:.1f}]" * (self.n > 1)


@dataclass(frozen=True)
class Latency:
    """Percentiles of the time of single decisions, in milliseconds."""

    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float
    n_calls: int

    @classmethod
    def from_seconds(cls, seconds: npt.ArrayLike) -> Latency:
        """Summarise call times.

        :param seconds: (n_calls,), not empty
        :raises ValueError: for no calls
        """
        milliseconds = 1e3 * np.asarray(seconds, dtype=np.float64)
        if milliseconds.size == 0:
            raise ValueError("Percentiles need at least one measured call, got none.")
        p50, p95, p99 = np.percentile(milliseconds, [50, 95, 99])
        return cls(float(p50), float(p95), float(p99), float(milliseconds.max()), milliseconds.size)

    def __str__(self) -> str:
        return f"p50 {self.p50_ms:.2f} ms, p95 {self.p95_ms:.2f} ms, p99 {self.p99_ms:.2f} ms"


@dataclass(frozen=True)
class Summary:
    """One row of an evaluation: who answered, how well and how fast."""

    label: str
    mean_return: Interval
    mean_length: Interval
    latency: Latency | None
    returns: list[float]
    lengths: list[int]
    worst_tenth: float
    """mean of the lowest tenth of the returns, of at least one"""
    terminations: int | None = None
    """episodes that the task ended (in MuJoCo by a fall), not a time limit"""
    mean_action_change: Interval | None = None
    """mean |a_t - a_{t-1}| in halves of the action space's range: how rough the motion is"""
    successes: int | None = None
    """episodes that the task called a success at their end"""

    @classmethod
    def from_episodes(
        cls,
        label: str,
        returns: npt.ArrayLike,
        lengths: npt.ArrayLike,
        latency: Latency | None = None,
        terminated: npt.ArrayLike | None = None,
        action_changes: npt.ArrayLike | None = None,
        successes: npt.ArrayLike | None = None,
    ) -> Summary:
        """Summarise whole episodes.

        :param label: who answered, such as "planner" or "expert"
        :param returns: (n_episodes,)
        :param lengths: (n_episodes,), in control steps
        :param latency: of single decisions, if it was measured
        :param terminated: (n_episodes,) bool, if it is known
        :param action_changes: (n_episodes,), if they were measured
        :param successes: (n_episodes,) bool, if the task tells them
        """
        return cls(
            label=label,
            mean_return=confidence_interval(returns),
            mean_length=confidence_interval(lengths),
            latency=latency,
            returns=[float(x) for x in np.asarray(returns)],
            lengths=[int(x) for x in np.asarray(lengths)],
            worst_tenth=worst_tenth(returns),
            terminations=None if terminated is None else int(np.sum(terminated)),
            mean_action_change=None if action_changes is None else confidence_interval(action_changes),
            successes=None if successes is None else int(np.sum(successes)),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the row in JSON types; NaN becomes None, since JSON has no NaN."""
        return {key: _without_nan(value) for key, value in asdict(self).items()}


def worst_tenth(returns: npt.ArrayLike) -> float:
    """Return the mean of the lowest tenth of returns, rounded up to at least one.

    :param returns: (n_episodes,), or (n_seeds, n_episodes), where all episodes count alike
    """
    ordered = np.sort(np.asarray(returns, dtype=np.float64), axis=None)
    return float(ordered[: math.ceil(len(ordered) / 10)].mean())


def confidence_interval(
    values: npt.ArrayLike,
    statistic: Callable[..., Any] = np.mean,
    confidence: float = 0.95,
    n_resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Interval of a statistic of independent units: episodes of one agent, or training seeds with their episodes.

    Values of one unit share its luck, so they are left out or drawn together. Their own spread counts as part of the
    units' spread. The interval's ``method`` says how it was made:

    - ``"Student's t"``, below 10 units: value +- t_{n-1} times the jackknife's standard error, which leaves out one
      unit at a time (Efron and Stein 1981). For the mean it is the usual t interval of the units' means. With three
      to five normal units, a nominal 95 % bootstrap interval covers only 73 to 83 %, and jumps when values hardly
      change. The jackknife needs a smooth statistic: for a median, the interval covers less than it says.
    - ``"BCa bootstrap"``, from 10 units on, by SciPy. Returns of control tasks are skewed: a few episodes fall far
      below many good ones. BCa corrects for that, and the other two methods do not.
    - ``"percentile bootstrap"`` where BCa is undefined, because leaving out any one unit changes nothing.

    :param values: (n,), one for each unit; or (n_seeds, n_episodes), whose rows are the units
    :param statistic: takes all values of all units, (..., k) along ``axis=-1``, such as ``np.mean``
    :param confidence: probability that the interval is to cover, in (0, 1)
    :param n_resamples: bootstrap samples
    :param seed: of the resampling; fixed, so that the same episodes give the same interval
    :raises ValueError: for no values, values that are not finite, or a confidence outside (0, 1)
    """
    units = np.asarray(values, dtype=np.float64)
    units = units.reshape(len(units), -1) if units.size else units  # (n, k)
    n = len(units)
    if units.size == 0 or not np.all(np.isfinite(units)):
        raise ValueError(f"An interval needs at least one value and only finite ones, got {units}.")
    _check_confidence(confidence)

    def of_units(rows: np.ndarray, axis: int = -1) -> Any:
        """Return the statistic over the units whose numbers are on the last axis: (..., m) -> (...)."""
        return statistic(units[rows.astype(np.intp)].reshape(*rows.shape[:-1], -1), axis=-1)

    everyone = np.arange(n)
    value = float(of_units(everyone))
    if n == 1:
        return Interval(value, math.nan, math.nan, confidence, n, "none")
    if n < FEWEST_RESAMPLED:
        without_one = of_units(np.stack([np.delete(everyone, i) for i in everyone]))  # (n,)
        error = math.sqrt((n - 1) * np.var(without_one))
        half = float(stdtrit(n - 1, (1 + confidence) / 2)) * error
        return Interval(value, value - half, value + half, confidence, n, "Student's t")
    from scipy.stats import DegenerateDataWarning, bootstrap  # takes a second, which a command's --help saves

    method = "BCa bootstrap"
    # In parts, as all samples together take gigabytes
    settings = {"statistic": of_units, "confidence_level": confidence, "vectorized": True, "batch": 500}
    with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
        warnings.simplefilter("ignore", DegenerateDataWarning)
        found = bootstrap((everyone,), n_resamples=n_resamples, rng=np.random.default_rng(seed), **settings)
    if not np.all(np.isfinite(found.confidence_interval)):
        method = "percentile bootstrap"
        found = bootstrap((everyone,), n_resamples=0, method="percentile", bootstrap_result=found, **settings)
    return Interval(value, *_holding(value, *found.confidence_interval), confidence, n, method)


def stratified_interval(
    returns: npt.ArrayLike, confidence: float = 0.95, n_resamples: int = 10_000, seed: int = 0
) -> Interval:
    """Interval of the mean over training seeds and episodes: a bootstrap that draws seeds, then episodes of each.

    It counts both spreads, as the stratified bootstrap of Agarwal et al. 2021 (arXiv 2108.13264) draws runs within
    tasks. With three to five seeds it covers less than it says; use :func:`confidence_interval` (Student's t) there.

    :param returns: (n_seeds, n_episodes)
    :param confidence: probability that the interval is to cover, in (0, 1)
    :param n_resamples: bootstrap samples
    :param seed: of the resampling
    :raises ValueError: for returns of another shape, or that are not finite
    """
    values = np.asarray(returns, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.all(np.isfinite(values)):
        raise ValueError(f"Expected finite returns of the shape (n_seeds, n_episodes), got {values}.")
    _check_confidence(confidence)
    n_seeds, n_episodes = values.shape
    rng = np.random.default_rng(seed)
    means = np.zeros(n_resamples)
    for _ in range(n_seeds):
        drawn = rng.integers(n_seeds, size=n_resamples)
        for part in np.array_split(np.arange(n_resamples), -(-n_resamples // 500)):  # as all together take gigabytes
            episodes = rng.integers(n_episodes, size=(len(part), n_episodes))
            means[part] += values[drawn[part, None], episodes].mean(1) / n_seeds
    bounds = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    value = float(values.mean())
    return Interval(value, *_holding(value, *bounds), confidence, values.size, "stratified bootstrap")


def _holding(value: float, low: float, high: float) -> tuple[float, float]:
    """Return bounds that include the value: means of equal values, summed in another order, miss it by rounding."""
    return min(float(low), value), max(float(high), value)


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is a probability strictly between 0 and 1, got {confidence}.")


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(v) for key, v in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value
