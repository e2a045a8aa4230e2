"""The normaliser: scales of states, actions and moves, and the way back."""

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from small_planner import ACT, LENGTH, OBS, make_planner, make_windows, seeded

from sb3_said.planner.normalizer import Normalizer
from sb3_said.replay.windows import Windows


@pytest.mark.parametrize("transform", ["standard", "tanh"])
def test_normalised_data_has_mean_0_and_deviation_1(transform):
    normalizer = Normalizer(3, 1, 4, transform, relative_states=False)
    states = th.randn(1000, 3, generator=seeded()) * th.tensor([3.0, 1e-7, 0.0]) + th.tensor([50.0, 0.0, 1.2345])
    actions = (2 * th.randn(1000, 1, generator=seeded(1))).tanh()
    normalizer.fit(states, actions)
    normal = normalizer.normalize_states(states)
    th.testing.assert_close(normal.mean(0), th.zeros(3), atol=1e-4, rtol=0.0)
    th.testing.assert_close(normal.std(0, correction=0), th.tensor([1.0, 1.0, 0.0]), atol=1e-4, rtol=0.0)
    normal = normalizer.normalize_actions(actions)
    assert normal.mean().item() == pytest.approx(0, abs=1e-4)
    assert normal.std(correction=0).item() == pytest.approx(1, abs=1e-4)
    th.testing.assert_close(normalizer.denormalize_states(normalizer.normalize_states(states)), states)


@pytest.mark.parametrize("transform", ["standard", "tanh"])
@given(action=st.floats(-1, 1), prediction=st.floats(-1e3, 1e3), mean=st.floats(-1, 1), std=st.floats(0.1, 3))
def test_actions_return_from_the_transform_within_bounds(transform, action, prediction, mean, std):
    normalizer = Normalizer(1, 1, 4, transform, relative_states=False)
    normalizer.action_mean.fill_(mean)
    normalizer.action_std.fill_(std)
    action = th.tensor([action])
    back = normalizer.denormalize_actions(normalizer.normalize_actions(action))
    expected = action if transform == "standard" else action.clamp(-0.999, 0.999)
    th.testing.assert_close(back, expected, atol=1e-5, rtol=1e-5)
    assert -1 <= normalizer.denormalize_actions(th.tensor([prediction])).item() <= 1


def test_moves_are_scaled_index_by_index_over_valid_steps():
    planner, windows = make_planner(relative_states=True), make_windows(40)
    normalizer = planner.normalizer
    normalizer.fit_moves(windows)
    z = normalizer.normalize_states(windows.states)
    for k in range(1, LENGTH):
        moves = z[windows.valid[:, k], k] - z[windows.valid[:, k], 0]
        th.testing.assert_close(normalizer.move_std[k - 1], moves.square().mean(0).sqrt())


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("transform", ["standard", "tanh"])
def test_windows_return_from_the_planners_units(relative, transform):
    planner, windows = make_planner(relative_states=relative, action_transform=transform), make_windows()
    planner.normalizer.fit_moves(windows)
    states, actions = planner.normalizer.denormalize(planner.normalizer.normalize(windows.states, windows.actions))
    th.testing.assert_close(states, windows.states, atol=1e-4, rtol=1e-4)
    th.testing.assert_close(actions, windows.actions.clamp(-0.999, 0.999), atol=2e-3, rtol=0.0)


def test_steps_that_never_move_are_not_blown_up():
    planner = make_planner(relative_states=True)
    still = th.ones(8, LENGTH, OBS), th.zeros(8, LENGTH, ACT), th.ones(8, LENGTH, dtype=th.bool), th.ones(8)
    planner.normalizer.fit_moves(Windows(*still))
    assert th.equal(planner.normalizer.move_std, th.ones(LENGTH - 1, OBS))
