"""Variance-preserving diffusion in continuous time: schedules, predictions, DDIM. Knows no network.

"DV" is the public code of Lu et al. 2025, as in ``config``.

A noisy sample at time t is ``x = alpha(t) * clean + sigma(t) * noise`` with ``alpha^2 + sigma^2 = 1``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import torch as th

START_TIME = 1e-3  # the cleanest time, in training and as the last solver time (CleanDiffuser, and so the paper)
END_TIMES = {
    "cosine": 0.9946,  # alpha(1) is 0, and to_clean divides by alpha; DPM-Solver stops here, too
    "linear": 1.0,
}
SCHEDULES = tuple(END_TIMES)
PREDICTIONS = ("v", "epsilon")
TIME_SAMPLINGS = ("uniform", "logit_normal")


def alpha_sigma(t: th.Tensor, schedule: str) -> tuple[th.Tensor, th.Tensor]:
    """Return the factors of the clean sample and of the noise, each of the shape of t.

    :param t: diffusion times in [0, ``END_TIMES[schedule]``]
    :param schedule: ``"cosine"`` (Nichol and Dhariwal 2021) or ``"linear"`` (DV's)
    """
    if schedule == "cosine":
        return th.cos(math.pi / 2 * t), th.sin(math.pi / 2 * t)
    log_alpha = -(20.0 - 0.1) / 4 * t**2 - 0.1 / 2 * t
    return log_alpha.exp(), (-th.expm1(2 * log_alpha)).sqrt()  # expm1: 1 - alpha^2 cancels near t = 0


def prediction_target(
    clean: th.Tensor, noise: th.Tensor, alpha: th.Tensor, sigma: th.Tensor, prediction: str
) -> th.Tensor:
    """Return what the network is trained to predict: the noise, or v = alpha noise - sigma clean.

    :param prediction: ``"v"`` (Salimans and Ho 2022) or ``"epsilon"`` (the paper's)
    """
    return noise if prediction == "epsilon" else alpha * noise - sigma * clean


def to_clean(
    output: th.Tensor, x: th.Tensor, alpha: float | th.Tensor, sigma: float | th.Tensor, prediction: str
) -> th.Tensor:
    """Return the clean sample that a prediction at a noisy sample x implies; arguments broadcast."""
    return (x - sigma * output) / alpha if prediction == "epsilon" else alpha * x - sigma * output


def gaussian_prediction(
    x: th.Tensor,
    mean: th.Tensor,
    std: th.Tensor,
    alpha: float | th.Tensor,
    sigma: float | th.Tensor,
    prediction: str,
) -> tuple[th.Tensor, th.Tensor]:
    """Return the best prediction at a noisy sample x whose clean entries are from N(mean, std^2), and its error.

    The error is a standard deviation. For v and N(0, 1) the two are 0 and 1. Arguments broadcast.
    """
    variance = alpha**2 * std**2 + sigma**2  # of x
    if prediction == "epsilon":
        return sigma / variance * (x - alpha * mean), alpha * std / variance**0.5
    return sigma / variance * (alpha * (1 - std**2) * x - mean), std / variance**0.5


def draw_times(
    n: int,
    schedule: str,
    time_sampling: str,
    end_probability: float = 0.0,
    generator: th.Generator | None = None,
) -> th.Tensor:
    """Draw training times on the generator's device: (n,) float32 in [START_TIME, END_TIMES[schedule]].

    :param time_sampling: ``"uniform"`` (DV's), or ``"logit_normal"`` (Esser et al. 2024) for more in the middle
    :param end_probability: part of the times that are the last one, where every sampling starts
    """
    device = "cpu" if generator is None else generator.device
    if time_sampling == "uniform":
        fraction = th.rand(n, generator=generator, device=device)
    else:
        fraction = th.randn(n, generator=generator, device=device).sigmoid()
    if end_probability > 0:
        fraction = th.where(th.rand(n, generator=generator, device=device) < end_probability, 1.0, fraction)
    return START_TIME + (END_TIMES[schedule] - START_TIME) * fraction


class SolverStep(NamedTuple):
    """One denoising step: ``x_next = keep * x + clean * x0``."""

    t: float
    alpha: float
    sigma: float
    keep: float
    clean: float


@cache
def solver_steps(schedule: str, n_steps: int) -> tuple[SolverStep, ...]:
    """Return the coefficients of DDIM's steps (Song et al. 2021, eta 0) at uniform times, as DV's.

    :param schedule: see :func:`alpha_sigma`
    :param n_steps: number of network evaluations
    :raises ValueError: for n_steps < 1
    """
    if n_steps < 1:
        raise ValueError(f"The number of solver steps is {n_steps}, expected at least 1.")
    times = th.linspace(END_TIMES[schedule], START_TIME, n_steps + 1, dtype=th.float64)
    alpha, sigma = alpha_sigma(times, schedule)  # (n_steps + 1,)
    keep = sigma[1:] / sigma[:-1]
    clean = alpha[1:] - alpha[:-1] * keep
    rows = th.stack((times[:-1], alpha[:-1], sigma[:-1], keep, clean), dim=1)
    return tuple(SolverStep(*row) for row in rows.tolist())


def solve(
    predict: Callable[[th.Tensor, int], th.Tensor],
    x: th.Tensor,
    steps: Sequence[SolverStep],
    prediction: str,
    impose: Callable[[th.Tensor], th.Tensor] = lambda x: x,
) -> th.Tensor:
    """Run DDIM from initial noise to a sample.

    :param predict: gives the network's output at (x, index of the step)
    :param x: initial noise, any shape, float32
    :param steps: from :func:`solver_steps`
    :param prediction: what ``predict`` predicts, see :func:`prediction_target`
    :param impose: applied to the initial noise and after every step, the last included
    """
    x = impose(x)
    for i, step in enumerate(steps):
        x0 = to_clean(predict(x, i), x, step.alpha, step.sigma, prediction)
        x = impose(step.keep * x + step.clean * x0)
    return x
