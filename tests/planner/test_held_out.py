"""Held-out errors, against the same numbers worked out apart."""

import numpy as np
import pytest
import torch as th
from linear_system import ACTION_DIM, STATE_DIM, make_source

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.held_out import draw_held_out, held_out_errors, worse_than_regression
from sb3_said.planner.yardstick import RegressionYardstick

D = 3


def make_planner(max_delay: int = D) -> InpaintingPlanner:
    """Return a planner that has learned nothing, with a normaliser of the linear system."""
    source = make_source(40, 20)
    config = PlannerConfig(depth=1, d_model=32, horizon=3, sampling_steps=2, first_guess="none")
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        planner = InpaintingPlanner(STATE_DIM, ACTION_DIM, max_delay, config)
        th.nn.init.normal_(planner.network.out.weight, std=0.1)  # which begins at 0
    planner.fit_normalizer(source.start_states(), source.start_actions())
    return planner.requires_grad_(False)


@pytest.fixture
def yardstick() -> RegressionYardstick:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(1)
        return RegressionYardstick(STATE_DIM, ACTION_DIM, D).requires_grad_(False)


def test_errors_are_of_the_present_and_of_the_action_at_the_decision(yardstick: RegressionYardstick) -> None:
    planner = make_planner()
    held_out = draw_held_out(make_source(40, 20), planner, seed=0)
    metrics, normalize = held_out_errors(planner, yardstick, held_out), planner.normalizer.normalize_states
    assert len(metrics) == 4 * (D + 1)
    for d, (states, actions, _, _) in held_out.items():
        history = th.zeros(len(states), D, ACTION_DIM)
        history[:, D - d :] = actions[:, :d]
        delay = th.full((len(states),), d)
        plan = planner.plan(states[:, 0], history, delay, temperature=0.0)
        present, decision = yardstick(normalize(states[:, 0]), actions, delay)
        for name, error in (
            ("present_error", normalize(plan.present) - normalize(states[:, d])),
            ("action_error", plan.action - actions[:, d]),
            ("present_error_mlp", present - normalize(states[:, d])),
            ("action_error_mlp", decision.clamp(-1, 1) - actions[:, d]),
        ):
            assert metrics[f"planner/{name}_d{d}"] == pytest.approx(error.abs().mean().item(), rel=1e-5)


def test_windows_reach_the_decision() -> None:
    held_out = draw_held_out(make_source(40, 5), make_planner(3), seed=0)
    assert list(held_out) == [0, 1, 2, 3]
    assert all(windows.valid[:, d].all() for d, windows in held_out.items())
    # In an episode of five steps no decision comes five or six steps after an observation.
    assert list(draw_held_out(make_source(40, 5), make_planner(6), seed=0)) == [0, 1, 2, 3, 4]


def test_errors_see_no_future_action(yardstick: RegressionYardstick) -> None:
    """Errors are those of an agent: whatever is unknown at the decision may be anything."""
    planner = make_planner()
    held_out = draw_held_out(make_source(40, 20), planner, seed=0)
    with pytest.MonkeyPatch.context() as patch:
        given, plan = [], planner.plan
        patch.setattr(planner, "plan", lambda *batch, **rest: given.append(batch[1]) or plan(*batch, **rest))
        held_out_errors(planner, yardstick, held_out)
    for (d, windows), history in zip(held_out.items(), given, strict=True):
        delay = th.full((len(windows.states),), d)
        np.testing.assert_array_equal(history[:, D - d :], windows.actions[:, :d])
        np.testing.assert_array_equal(history[:, : D - d], 0.0)
        guess = yardstick(windows.states[:, 0], windows.actions, delay)
        others = windows.actions.clone()
        others[:, d:] = 7.0
        for part, other in zip(guess, yardstick(windows.states[:, 0], others, delay), strict=True):
            assert th.equal(part, other)


def test_what_a_planner_is_worse_at_is_named() -> None:
    errors = {"planner/present_error_d0": 0.0, "planner/present_error_d4": 0.31, "planner/action_error_d4": 0.204}
    bars = {
        "planner/present_error_mlp_d0": 0.0,
        "planner/present_error_mlp_d4": 0.2,
        "planner/action_error_mlp_d4": 0.2,
    }
    assert worse_than_regression(errors | bars) == "present_error_d4 0.31 against 0.2"
    assert worse_than_regression(errors | bars, tolerance=0.0).endswith(", action_error_d4 0.204 against 0.2")
    assert worse_than_regression({}) == ""
