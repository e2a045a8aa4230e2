"""Schedules, predictions and solvers against closed forms and against diffusers."""

import math

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_said.planner import diffusion

MEAN, STD = th.tensor([2.0, -1.0, 0.3], dtype=th.float64), th.tensor([0.5, 1.5, 0.05], dtype=th.float64)


def gaussian_predictor(steps, prediction):
    """The optimal prediction for clean data N(MEAN, STD^2), in closed form."""

    def predict(x, i):
        alpha, sigma = steps[i].alpha, steps[i].sigma
        clean = MEAN + alpha * STD**2 / (alpha**2 * STD**2 + sigma**2) * (x - alpha * MEAN)
        noise = (x - alpha * clean) / sigma
        return {"epsilon": noise, "v": alpha * noise - sigma * clean}[prediction]

    return predict


def solve_gaussian(x, n_steps, schedule="cosine", prediction="v"):
    steps = diffusion.solver_steps(schedule, n_steps)
    return diffusion.solve(gaussian_predictor(steps, prediction), x, steps, prediction)


def exact_gaussian(x, schedule):
    """The exact flow of N(MEAN, STD^2) from the end time to the start time: it maps quantiles to quantiles."""
    times = th.tensor([diffusion.END_TIMES[schedule], diffusion.START_TIME], dtype=th.float64)
    (alpha_1, alpha_0), (sigma_1, sigma_0) = diffusion.alpha_sigma(times, schedule)
    std_1, std_0 = (alpha_1**2 * STD**2 + sigma_1**2).sqrt(), (alpha_0**2 * STD**2 + sigma_0**2).sqrt()
    return alpha_0 * MEAN + std_0 / std_1 * (x - alpha_1 * MEAN)


@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_schedules_preserve_the_variance_and_go_from_clean_to_noise(schedule):
    t = th.linspace(diffusion.START_TIME, diffusion.END_TIMES[schedule], 100)
    alpha, sigma = diffusion.alpha_sigma(t, schedule)
    th.testing.assert_close(alpha**2 + sigma**2, th.ones(100))
    assert (alpha.diff() < 0).all() and (sigma.diff() > 0).all()
    assert alpha[0] > 0.9999 and 0.005 < alpha[-1] < 0.01


def test_linear_schedule_matches_the_numbers_of_the_paper_code():
    alpha, sigma = diffusion.alpha_sigma(th.tensor([1e-3, 1.0]), "linear")
    np.testing.assert_allclose(alpha, [0.99995, 0.00657], rtol=5e-4)
    np.testing.assert_allclose(sigma, [0.0105, 0.99998], rtol=5e-3)


@pytest.mark.parametrize("prediction", diffusion.PREDICTIONS)
@given(
    t=st.floats(diffusion.START_TIME, 0.99),
    clean=st.floats(-5, 5),
    noise=st.floats(-5, 5),
    schedule=st.sampled_from(diffusion.SCHEDULES),
)
def test_predictions_give_back_what_the_sample_was_made_of(prediction, t, clean, noise, schedule):
    clean, noise, t = (th.tensor(value, dtype=th.float64) for value in (clean, noise, t))
    alpha, sigma = diffusion.alpha_sigma(t, schedule)
    x = alpha * clean + sigma * noise
    target = diffusion.prediction_target(clean, noise, alpha, sigma, prediction)
    th.testing.assert_close(diffusion.to_clean(target, x, alpha, sigma, prediction), clean, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("prediction", diffusion.PREDICTIONS)
@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_the_best_prediction_for_gaussian_data_and_how_far_it_is_off(prediction, schedule):
    steps = diffusion.solver_steps(schedule, 6)
    generator = th.Generator().manual_seed(0)
    clean, noise = (th.randn(20_000, 3, generator=generator, dtype=th.float64) for _ in range(2))
    clean = MEAN + STD * clean
    for i, step in enumerate(steps):
        x = step.alpha * clean + step.sigma * noise
        best, off = diffusion.gaussian_prediction(x, MEAN, STD, step.alpha, step.sigma, prediction)
        th.testing.assert_close(best, gaussian_predictor(steps, prediction)(x, i), atol=1e-9, rtol=1e-9)
        target = diffusion.prediction_target(clean, noise, *(th.tensor(f) for f in step[1:3]), prediction)
        th.testing.assert_close((target - best).square().mean(0).sqrt(), off.expand(3), atol=0, rtol=0.02)


def test_standard_normal_data_leave_a_prediction_of_v_as_it_is():
    x, one = th.randn(5), th.ones(5)
    best, off = diffusion.gaussian_prediction(x, 0 * one, one, 0.6, 0.8, "v")
    th.testing.assert_close(best, 0 * one)
    th.testing.assert_close(off, one)


@pytest.mark.parametrize("time_sampling", diffusion.TIME_SAMPLINGS)
@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_training_times_fill_their_range(time_sampling, schedule):
    t = diffusion.draw_times(20_000, schedule, time_sampling, generator=th.Generator().manual_seed(0))
    low, high = diffusion.START_TIME, diffusion.END_TIMES[schedule]
    assert t.dtype == th.float32 and t.min() >= low and t.max() <= high
    fraction = (t - low) / (high - low)
    logit = (fraction / (1 - fraction)).log()
    spread = logit.std() if time_sampling == "logit_normal" else fraction.std() * math.sqrt(12)
    assert spread.item() == pytest.approx(1.0, abs=0.03) and fraction.mean().item() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("time_sampling", diffusion.TIME_SAMPLINGS)
def test_a_part_of_the_training_times_is_where_sampling_starts(time_sampling):
    for schedule in diffusion.SCHEDULES:
        start = diffusion.solver_steps(schedule, 5)[0].t
        t = diffusion.draw_times(20_000, schedule, time_sampling, 0.25, th.Generator().manual_seed(0))
        assert (t == start).float().mean().item() == pytest.approx(0.25, abs=0.01)
        others = diffusion.draw_times(20_000, schedule, time_sampling, 0.0, th.Generator().manual_seed(0))
        assert th.equal(t[t < start], others[t < start])


@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_steps_are_uniform_in_time(schedule):
    times = [step.t for step in diffusion.solver_steps(schedule, 8)]
    np.testing.assert_allclose(np.diff(times), (diffusion.START_TIME - diffusion.END_TIMES[schedule]) / 8)
    assert times[0] == diffusion.END_TIMES[schedule]


@pytest.mark.parametrize("prediction", diffusion.PREDICTIONS)
@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_ddim_takes_the_steps_of_diffusers(schedule, prediction):
    diffusers = pytest.importorskip("diffusers")
    n_steps = 7
    times = th.linspace(diffusion.END_TIMES[schedule], diffusion.START_TIME, n_steps + 1, dtype=th.float64)
    alpha, _ = diffusion.alpha_sigma(times, schedule)
    scheduler = diffusers.DDIMScheduler(
        num_train_timesteps=n_steps + 1,
        clip_sample=False,
        set_alpha_to_one=False,
        prediction_type={"v": "v_prediction", "epsilon": "epsilon"}[prediction],
    )
    scheduler.alphas_cumprod = alpha.flip(0) ** 2  # its discrete step k is our time n_steps - k
    scheduler.set_timesteps(n_steps + 1)
    steps = diffusion.solver_steps(schedule, n_steps)
    start = th.randn(4, 3, dtype=th.float64, generator=th.Generator().manual_seed(0))
    predict = gaussian_predictor(steps, prediction)
    expected = start
    for i in range(n_steps):
        expected = scheduler.step(predict(expected, i), n_steps - i, expected, eta=0.0).prev_sample
    actual = diffusion.solve(predict, start, steps, prediction)
    th.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
@pytest.mark.parametrize("prediction", diffusion.PREDICTIONS)
def test_gaussian_samples_have_the_right_mean_and_deviation(schedule, prediction):
    noise = th.special.ndtri((th.arange(1000, dtype=th.float64) + 0.5) / 1000)  # its quantiles
    samples = solve_gaussian(noise[:, None].expand(-1, 3), 1000, schedule, prediction)
    assert ((samples.mean(0) - MEAN).abs() < 0.03 * STD + 0.003).all()
    th.testing.assert_close(samples.std(0), STD, rtol=0.04, atol=0.0)


@pytest.mark.parametrize("schedule", diffusion.SCHEDULES)
def test_convergence_is_of_first_order(schedule):
    x = th.linspace(-2, 2, 5, dtype=th.float64)[:, None].expand(-1, 3)
    errors = [(solve_gaussian(x, n, schedule) - exact_gaussian(x, schedule)).abs().max().item() for n in (250, 500)]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


def test_impose_holds_before_every_step_and_at_the_end():
    seen = []

    def predict(x, i):
        seen.append(x[0].item())
        return x

    steps = diffusion.solver_steps("cosine", 4)
    result = diffusion.solve(predict, th.randn(3), steps, "v", lambda x: th.cat([th.tensor([7.0]), x[1:]]))
    assert seen == [7.0] * 4 and result[0] == 7.0


def test_a_number_of_steps_below_1_is_refused():
    with pytest.raises(ValueError, match="is 0, expected at least 1"):
        diffusion.solver_steps("cosine", 0)
