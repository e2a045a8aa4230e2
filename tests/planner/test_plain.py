"""The model of one step: in units of moves, each entry for itself, and blind to what is behind an episode's end."""

from __future__ import annotations

import math

import pytest
import torch as th

from sb3_said.planner.plain import FARTHEST, RIGHT, OneStepModel

OBS_DIM, ACT_DIM = 3, 2


def make_model() -> OneStepModel:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        return OneStepModel(OBS_DIM, ACT_DIM)


@pytest.mark.parametrize(("n_steps", "loudness"), [(1, 1.0), (3, 1.0), (3, 1e3)])
@th.no_grad()
def test_its_loss_is_in_moves_over_the_steps_that_follow(n_steps: int, loudness: float):
    """It goes on from its own answers, which run away no further than FARTHEST."""
    model, generator = make_model(), th.Generator().manual_seed(0)
    model.net[-1].weight *= loudness
    model.move_std.copy_(th.tensor([0.1, 1.0, 5.0]))
    states = th.randn(6, n_steps + 1, OBS_DIM, generator=generator)
    actions = th.rand(6, n_steps, ACT_DIM, generator=generator)
    follows = th.rand(6, n_steps, generator=generator) < 0.6
    assert follows.any(0).all() and not follows.all(0).any()
    expected, state = 0.0, states[:, 0]
    for k in range(n_steps):
        state = model(state, actions[:, k])
        for entry in range(OBS_DIM):
            errors = [
                ((state - states[:, k + 1]) / model.move_std)[i, entry].item() ** 2 for i in range(6) if follows[i, k]
            ]
            expected += math.log(1 + sum(errors) / len(errors) / RIGHT) / OBS_DIM / n_steps
    assert (loudness > 1) == (state.abs().max() == FARTHEST)
    assert model.loss(states, actions, follows).item() == pytest.approx(expected, rel=1e-5)
    states[:, 1:][~follows] = 1e6
    assert model.loss(states, actions, follows).item() == pytest.approx(expected, rel=1e-5)
    assert model.loss(states, actions, ~follows & follows) == 0  # none follows: nothing is divided by zero


def test_what_cannot_be_foreseen_does_not_hide_what_can():
    """However loud the noise of an entry, what the hidden layers learn from it is as much, and from the others, too."""
    generator = th.Generator().manual_seed(0)
    states = th.randn(64, 2, OBS_DIM, generator=generator)
    actions = th.rand(64, 1, ACT_DIM, generator=generator)
    gradients = []
    for loudness in (1.0, 1000.0):
        model = make_model()
        louder = states.clone()
        louder[:, 1, 2] *= loudness
        model.loss(louder, actions, th.ones(64, 1, dtype=th.bool)).backward()
        last = model.net[-1]
        gradients.append((last.weight.grad, model.net[0].weight.grad.norm().item()))
    th.testing.assert_close(gradients[0][0][:2], gradients[1][0][:2])
    assert gradients[1][1] < 2 * gradients[0][1]


@th.no_grad()
def test_a_network_that_says_nothing_keeps_the_state():
    model = make_model()
    for parameter in model.parameters():
        parameter.zero_()
    state = th.randn(4, OBS_DIM)
    th.testing.assert_close(model(state, th.rand(4, ACT_DIM)), state, rtol=0, atol=0)
