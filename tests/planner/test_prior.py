"""The prior: least squares as NumPy has it, a planner that begins at its guess, and a loss of the whole prediction."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from linear_system import ACTION_DIM, STATE_DIM, make_source
from small_planner import ACT, DELAY, LENGTH, OBS, FakeNetwork, make_planner, make_windows, seeded

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.diffusion import gaussian_prediction
from sb3_said.planner.prior import FEWEST_WINDOWS, LARGEST_SLOPE, LEAST_STD, Prior
from sb3_said.planner.trainer import PlannerTrainer

D, HORIZON = 4, 3


def test_it_is_fitted_by_least_squares():
    generator = th.Generator().manual_seed(0)
    guess = th.randn(200, 5, 3, generator=generator)
    clean = th.tensor([1.0, 0.5, -2.0]) * guess + 0.3 * th.randn(200, 5, 3, generator=generator)
    valid = th.rand(200, 5, generator=generator) < th.tensor([1.0, 0.9, 0.5, 0.1, 0.0])
    prior = Prior(max_delay=2, length=5, n_entries=3)
    prior.fit(1, guess, clean, valid)
    for k in range(4):
        rows = valid[:, k].numpy()
        for j in range(3):
            x, y = guess[:, k, j].numpy()[rows], clean[:, k, j].numpy()[rows]
            slope, (squares,), *_ = np.linalg.lstsq(x[:, None], y, rcond=None)
            assert prior.slope[1, k, j].item() == pytest.approx(slope[0], abs=1e-4)
            assert prior.std[1, k, j].item() == pytest.approx((squares / len(y)) ** 0.5, abs=1e-4)
    untouched = Prior(2, 5, 3)
    for name in ("slope", "std"):  # what no window has, and the other delays
        own, as_made = getattr(prior, name), getattr(untouched, name)
        assert th.equal(own[1, 4], as_made[1, 4]) and th.equal(own[[0, 2]], as_made[[0, 2]])
    mean, std = prior(guess[:2], th.tensor([1, 0]))
    th.testing.assert_close(mean, th.stack([prior.slope[1] * guess[0], th.zeros(5, 3)]))
    th.testing.assert_close(std, th.stack([prior.std[1], th.ones(5, 3)]))


def test_a_step_that_few_windows_have_is_not_taken_for_a_sure_one():
    generator = th.Generator().manual_seed(0)
    guess, clean = th.randn(1000, 4, 1, generator=generator), th.randn(1000, 4, 1, generator=generator)
    valid = th.arange(1000)[:, None] < th.tensor([1000, 10, 2, 1])
    prior = Prior(max_delay=0, length=4, n_entries=1)
    prior.fit(0, guess, clean, valid)
    assert prior.std[0, 0, 0] == pytest.approx(1, abs=0.1) and 0.4 < prior.std[0, 1, 0] < 1.6
    assert prior.std[0, 2:].tolist() == [[1.0]] * 2 and prior.slope[0, 2:].tolist() == [[0.0]] * 2


def test_a_guess_that_hardly_moves_is_not_blown_up():
    """As of Ant-v5's contact forces, which are 0 but for a few steps."""
    generator = th.Generator().manual_seed(0)
    guess, clean = 1e-4 * th.randn(500, 2, 1, generator=generator), th.zeros(500, 2, 1)
    at = guess[:, :, 0].argmax(0)
    clean[at, th.arange(2)] = 30.0  # one contact, of which the guess knows nothing
    prior, valid = Prior(0, 2, 1), th.ones(500, 2, dtype=th.bool)
    prior.fit(0, guess, clean, valid)
    assert prior.slope[0].abs().max() <= LARGEST_SLOPE
    mean, std = prior(th.ones(1, 2, 1), th.zeros(1, dtype=th.int64))
    assert mean.abs().max() <= LARGEST_SLOPE
    th.testing.assert_close(std[0], (clean - prior.slope[0] * guess).square().mean(0).sqrt())  # of that slope


def test_a_guess_that_is_never_wrong_keeps_a_deviation():
    guess = th.randn(50, 2, 1, generator=th.Generator().manual_seed(0))
    prior = Prior(0, 2, 1)
    prior.fit(0, guess, guess, th.ones(50, 2, dtype=th.bool))
    assert th.equal(prior.std[0], th.full((2, 1), LEAST_STD)) and prior.slope[0].min() > 0.999


@pytest.fixture(scope="module")
def trainer() -> PlannerTrainer:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        small = PlannerConfig(
            depth=1, d_model=32, horizon=HORIZON, present="inpainted", precision="float32", weight_factor=0.0
        )
        trainer = PlannerTrainer(InpaintingPlanner(STATE_DIM, ACTION_DIM, D, small), make_source(), gradient_steps=30)
    trainer.make_first_guess()
    return trainer


def test_of_few_windows_none_counts_twice():
    """One that is drawn ten times would be taken for ten, and what it shows for sure."""
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        small = PlannerConfig(depth=1, d_model=32, horizon=HORIZON, present="inpainted", precision="float32")
        source = make_source()
        few = source._select((source.episodes == source.episodes[0]) & (source.remaining <= D + FEWEST_WINDOWS + 1))
        trainer = PlannerTrainer(InpaintingPlanner(STATE_DIM, ACTION_DIM, D, small), few, gradient_steps=1)
        trainer.make_first_guess()
    n = trainer.average.window_length
    reached = (trainer.source.remaining[:, None] > th.arange(n)).sum(0)  # windows that have a step
    is_new = (trainer.average.prior.std[D, :n] == 1).all(1)
    assert reached[D:].tolist() == [10, 9, 8] and is_new[D:].tolist() == [False, True, True]


@th.no_grad()
@pytest.mark.parametrize("sampling_steps", [1, 5])
def test_a_planner_that_has_learned_nothing_decides_as_its_guess(trainer: PlannerTrainer, sampling_steps: int):
    planner = trainer.average
    generator = th.Generator().manual_seed(1)
    observation = th.randn(D + 1, STATE_DIM, generator=generator)
    history = 2 * th.rand(D + 1, D, ACTION_DIM, generator=generator) - 1
    plan = planner.plan(observation, history, th.arange(D + 1), temperature=0.0, sampling_steps=sampling_steps)
    for d in range(D + 1):
        z = planner.normalizer.normalize_states(observation[d])
        moved = z
        for action in history[d, D - d :]:
            moved = planner.first_guess.model(moved, action)
        present = z
        if d > 0:  # in moves since the observation, each as far as it is right
            present = z + planner.prior.slope[d, d, :STATE_DIM] * (moved - z)
        present = planner.normalizer.denormalize_states(present)
        decision = planner.normalizer.normalize_actions(planner.first_guess.clone(moved).clamp(-1, 1))
        decision = planner.normalizer.denormalize_actions(planner.prior.slope[d, d, STATE_DIM:] * decision)
        th.testing.assert_close(plan.present[d], present, atol=2e-3, rtol=2e-3)
        th.testing.assert_close(plan.action[d], decision, atol=2e-3, rtol=2e-3)
    slopes = th.stack([planner.prior.slope[d, d, :STATE_DIM] for d in range(1, D + 1)])
    assert (slopes - 1).abs().max() < 0.1  # a linear system is soon known


@th.no_grad()
def test_it_learns_from_steps_of_the_episode_and_of_the_age_s_window_alone(monkeypatch: pytest.MonkeyPatch):
    planner, windows, fitted = make_planner(first_guess="prior"), make_windows(30), []
    monkeypatch.setattr(planner.prior, "fit", lambda d, guess, clean, valid: fitted.append((d, guess, valid)))
    planner.fit_prior(windows)
    assert [d for d, *_ in fitted] == list(range(DELAY + 1))
    z, known = planner.normalizer.normalize_states(windows.states), th.arange(LENGTH).expand(30, -1) == 0
    for d, guess, valid in fitted:
        assert th.equal(valid, windows.valid & (th.arange(LENGTH) < d + planner.config.horizon))
        own = planner.first_guess(z, windows.actions, th.full((30,), d), known, longest=d)
        th.testing.assert_close(guess, planner._normalized_guess(own))


@th.no_grad()
def test_what_the_guess_is_sure_of_is_hardly_moved():
    planner = make_planner(first_guess="prior")
    planner.prior.slope.fill_(1.0)
    for parameter in planner.first_guess.model.parameters():
        parameter.zero_()  # nothing moves: an untrained model ends far away, where the network is as large
    observation, history = th.randn(4, OBS, generator=seeded()), th.rand(4, DELAY, ACT, generator=seeded(1))
    delay = th.full((4,), DELAY)
    plans = {}
    for std in (LEAST_STD, 1.0):
        planner.prior.std.fill_(std)
        plans[std] = planner.plan(observation, history, delay, temperature=0.0)
    planner.network.out.weight.zero_()
    planner.network.out.bias.zero_()
    guess = planner.plan(observation, history, delay, temperature=0.0)
    off = {
        std: ((plan.present - guess.present) / planner.normalizer.state_std).abs().mean() for std, plan in plans.items()
    }
    assert 0 < off[LEAST_STD] < 0.1 * off[1.0]


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
def test_the_loss_is_of_the_whole_prediction(prediction: str):
    """That of a network without a prior whose output is the whole."""
    planner, windows = make_planner(prediction=prediction, first_guess="prior"), make_windows()
    planner.prior.slope.uniform_(0.0, 1.0, generator=seeded(2))
    planner.prior.std.uniform_(0.1, 1.0, generator=seeded(3))
    n = len(windows.states)
    delay, output = th.arange(n) % (DELAY + 1), th.randn(n, LENGTH, OBS + ACT, generator=seeded(4))
    seen: list[tuple[th.Tensor, ...]] = []
    forward = planner.prior.forward
    planner.prior.forward = lambda guess, delay: seen.append(forward(guess, delay)) or seen[-1]
    planner.network = network = FakeNetwork(output)
    loss = planner.loss(windows, delay, generator=seeded())

    alpha, sigma = th.cos(th.pi / 2 * network.t)[:, None, None], th.sin(th.pi / 2 * network.t)[:, None, None]
    best, off = gaussian_prediction(network.x, *seen[0], alpha, sigma, prediction)
    without = make_planner(prediction=prediction, first_guess="none")
    without.normalizer.load_state_dict(planner.normalizer.state_dict())
    without.network = FakeNetwork(best + off * output)
    th.testing.assert_close(loss, without.loss(windows, delay, generator=seeded()), atol=1e-5, rtol=1e-5)
