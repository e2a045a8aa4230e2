"""The delay of a logged system, from its observations and actions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

N_FOLDS = 5  # of the held-out predictions
MAX_BLOCKS = 100  # a block is a run of rows; it is held out and resampled as a whole
ROWS_PER_FEATURE = 4  # with fewer, held-out predictions are noise
MIN_ROWS = 50  # fewer make too few blocks to resample: unrelated data could look certain
LEAST_SCORE = 2e-3  # actions that the observations determine score less: the ridge leaves little of them
ROUNDING = 1e-8  # a channel stands still if it moves by less than this part of its size


@dataclass(frozen=True)
class DelayEstimate:
    """What ``estimate_delay`` found.

    :param delay: the age with the highest score, in control steps; the most frequent age where it varies
    :param confidence: fraction of resampled logs in which the same age has the highest score, and this is above 0.002.
        An age whose action explains nothing is no finding, however often it comes first
    :param scores: (max_delay + 1,), a score for each age: the part of the held-out change from one observation to the
        next that the action of that age explains, beyond what earlier observations explain. It is at most 1, and about
        0 or below for an age that does not occur. Where the delay varies, the scores are roughly in proportion to how
        often each age occurs.
    """

    delay: int
    confidence: float
    scores: np.ndarray


def estimate_delay(
    observations: Sequence[np.ndarray],
    actions: Sequence[np.ndarray],
    max_delay: int = 20,
    *,
    n_resamples: int = 200,
    seed: int = 0,
) -> DelayEstimate:
    """Find how many control steps a logged system's observations are old.

    If observations have age d, the action a_{t-d} causes the change from o_t to o_{t+1}. Ridge regression predicts that
    change, and each of the actions a_t, a_{t-1}, ..., a_{t-max_delay}, from o_t and the change that brought o_t. The
    residual of the right action explains most of the residual of the change (measured as the rise of R^2 on held-out
    blocks); the age of that action is the delay. A channel that echoes the command counts like any other. Rows without
    a new observation are left out.

    The observations must not determine the actions. In a log of a policy without noise they do, and all scores are near
    0: log random actions, noise, or a task that keeps moving. Observation and action delay cannot be told apart, so
    their sum is found. If the age found is ``max_delay``, the true one may be larger: ask again with a larger
    ``max_delay``.

    :param observations: for each episode (T + 1, obs_dim), as they arrived
    :param actions: for each episode (T, act_dim): action t was sent after observation t had arrived
    :param max_delay: largest age to try, in control steps
    :param n_resamples: how many resampled logs give the confidence
    :param seed: of the resampling
    :raises ValueError: for arrays that do not fit together or are not finite, observations or actions that never
        change by more than rounding, or too little data

    >>> rng = np.random.default_rng(0)
    >>> states, actions = np.zeros((501, 1)), rng.normal(size=(500, 1))
    >>> for t in range(500):
    ...     states[t + 1] = 0.9 * states[t] + 0.1 * actions[t]
    >>> estimate = estimate_delay([states[:-3]], [actions[3:]])  # at step t the observation is s_{t-3}
    >>> estimate.delay, estimate.confidence
    (3, 1.0)
    """
    if not (isinstance(max_delay, (int, np.integer)) and max_delay >= 0 and n_resamples >= 1):
        raise ValueError(f"max_delay is >= 0 and n_resamples >= 1, got {max_delay} and {n_resamples}.")
    _check_episodes(observations, actions)
    observations, actions = ([np.asarray(x, np.float64) for x in log] for log in (observations, actions))
    before, change, lagged = _rows(observations, actions, max_delay)
    n_rows, n_features = before.shape[0], before.shape[1] + lagged.shape[2]
    needed = max(MIN_ROWS, ROWS_PER_FEATURE * n_features)
    if n_rows < needed:
        raise ValueError(
            f"Too little data: {n_rows} steps brought a new observation, at least {needed} are "
            f"needed for {change.shape[1]} observation and {lagged.shape[2]} action entries that vary."
        )
    if change.shape[1] == 0:
        raise ValueError(
            "The observations change by the same at every step, which tells nothing of the actions; log the system "
            "while different actions move it."
        )
    block = np.arange(n_rows) * min(MAX_BLOCKS, n_rows // 5) // n_rows  # (N,)
    gains = _held_out_gains(before, change, lagged, block % N_FOLDS)  # (N, max_delay + 1)
    of_blocks = np.stack([np.bincount(block, gain) for gain in gains.T], axis=1)  # (n_blocks, max_delay + 1)
    scores = of_blocks.sum(0) / n_rows
    best = int(scores.argmax())
    if best == max_delay > 0:  # if each action resembles the last, a larger delay shows as this one, with confidence
        warnings.warn(
            f"The delay found, {best}, is the largest that was tried, and the true one may be larger: try a larger "
            "max_delay.",
            stacklevel=2,
        )

    n_blocks = len(of_blocks)
    draws = np.random.default_rng(seed).multinomial(n_blocks, np.full(n_blocks, 1 / n_blocks), n_resamples)
    resampled = draws @ of_blocks  # (n_resamples, max_delay + 1)
    n_rows_drawn = draws @ np.bincount(block)  # (n_resamples,)
    same = (resampled.argmax(1) == best) & (resampled.max(1) > LEAST_SCORE * n_rows_drawn)
    return DelayEstimate(best, float(same.mean()), scores)


def _rows(
    observations: Sequence[np.ndarray], actions: Sequence[np.ndarray], max_delay: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the standardised rows of the N steps that brought a new observation.

    Actions before the episode are the mean action.

    :return: (o_t, the change that brought o_t, 1), (N, features); o_{t+1} - o_t, (N, obs_dim); and a_t, ...,
        a_{t-max_delay}, (max_delay + 1, N, act_dim)
    :raises ValueError: for observations or actions that never change
    """
    all_sent = np.concatenate(actions)
    mean, scale = all_sent.mean(0), all_sent.std(0)  # (act_dim,)
    varies = scale > ROUNDING * np.abs(all_sent).max(0, initial=0.0)
    if not varies.any():
        raise ValueError("The actions never change; log the system while it is given different actions.")
    size = np.abs(np.concatenate(observations)).max(0)  # (obs_dim,)
    steps = [np.diff(o, axis=0) for o in observations]  # (T, obs_dim)
    if not np.any(np.abs(np.concatenate(steps)) > ROUNDING * size):
        raise ValueError("The observations never change: none arrived, or the log is of another system.")
    before, change, lagged = [], [], []
    for o, step, sent in zip(observations, steps, actions, strict=True):
        arrived = np.flatnonzero(np.any(step != 0, axis=1))  # steps whose next row is a new observation
        t = arrived[1:]
        before.append(np.hstack([o[t], step[arrived[:-1]]]))  # with the newest change that was seen
        change.append(step[t])
        a = np.concatenate([np.zeros((max_delay, sent.shape[1])), sent - mean])
        lagged.append(a[max_delay + t - np.arange(max_delay + 1)[:, None]])  # (max_delay + 1, n, act_dim)
    x, y = _standardise(np.concatenate(before), np.tile(size, 2)), _standardise(np.concatenate(change), size)
    a = np.concatenate(lagged, axis=1)
    return np.hstack([x, np.ones((len(x), 1))]), y, a[..., varies] / scale[varies]


def _standardise(x: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the columns that vary as z-scores, clipped where a contact or a fall makes them huge: (N, <= dim).

    :param size: (dim,) of the observations; columns that vary by less than their rounding are left out
    """
    if len(x) == 0:
        return x
    x = x[:, x.std(0) > ROUNDING * size]
    return np.clip((x - x.mean(0)) / x.std(0), -4.0, 4.0)


def _held_out_gains(x: np.ndarray, y: np.ndarray, lagged: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Return by how much each age's action lowers the squared error of the change, averaged over channels.

    The change has variance 1, so the mean over rows is the rise of R^2.

    :return: (N, max_delay + 1)
    """
    gains = np.zeros((len(y), len(lagged)))
    for k in range(N_FOLDS):
        kept, held = fold != k, fold == k
        y_left, *lagged_left = _residuals(x, [y, *lagged], kept)
        for age, a_left in enumerate(lagged_left):
            (error,) = _residuals(a_left, [y_left], kept)  # (N, obs_dim)
            gains[held, age] = (y_left[held] ** 2 - error[held] ** 2).mean(1)
    return gains


def _residuals(x: np.ndarray, targets: list[np.ndarray], kept: np.ndarray) -> list[np.ndarray]:
    """Return each target's residual in a ridge regression on x, fitted to the rows kept."""
    rows, y = x[kept], np.hstack(targets)
    weights = np.linalg.solve(rows.T @ rows + np.eye(x.shape[1]), rows.T @ y[kept])
    return np.split(y - x @ weights, np.cumsum([target.shape[1] for target in targets])[:-1], axis=1)


def _check_episodes(observations: Sequence[np.ndarray], actions: Sequence[np.ndarray]) -> None:
    """:raises ValueError: for a log whose arrays do not fit together or are not finite"""
    if len(observations) != len(actions) or len(actions) == 0:
        raise ValueError(
            "estimate_delay takes one array of observations and one of actions for each episode, at least one, "
            f"got {len(observations)} and {len(actions)}."
        )
    dims = {(np.shape(o)[1:], np.shape(a)[1:]) for o, a in zip(observations, actions, strict=True)}
    for i, (o, a) in enumerate(zip(observations, actions, strict=True)):
        if np.ndim(o) != 2 or np.ndim(a) != 2 or len(o) != len(a) + 1 or len(dims) > 1:
            raise ValueError(
                f"Episode {i} has observations {np.shape(o)} and actions {np.shape(a)}, expected (T + 1, obs_dim) and "
                "(T, act_dim) with the same dimensions in every episode."
            )
        if not (np.all(np.isfinite(o)) and np.all(np.isfinite(a))):
            raise ValueError(f"Episode {i} has observations or actions that are not finite.")
