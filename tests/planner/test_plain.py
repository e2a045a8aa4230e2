"""The model of one step: in units of moves, and blind to what is behind an episode's end."""

from __future__ import annotations

import torch as th

from sb3_said.planner.plain import OneStepModel

OBS_DIM, ACT_DIM = 3, 2


def make_model() -> OneStepModel:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        return OneStepModel(OBS_DIM, ACT_DIM)


@th.no_grad()
def test_its_loss_is_in_moves_over_the_steps_that_follow():
    model, generator = make_model(), th.Generator().manual_seed(0)
    model.move_std.copy_(th.tensor([0.1, 1.0, 5.0]))
    states = th.randn(6, 2, OBS_DIM, generator=generator)
    actions = th.rand(6, ACT_DIM, generator=generator)
    follows = th.tensor([True, False, True, True, False, True])
    expected = [
        ((model(states[i, :1], actions[i : i + 1]) - states[i, 1:]) / model.move_std).square().mean()
        for i in (0, 2, 3, 5)
    ]
    th.testing.assert_close(model.loss(states, actions, follows), th.stack(expected).mean())
    states[~follows] = 1e6
    th.testing.assert_close(model.loss(states, actions, follows), th.stack(expected).mean())
    assert model.loss(states, actions, ~follows & follows) == 0  # none follows: nothing is divided by zero


@th.no_grad()
def test_a_network_that_says_nothing_keeps_the_state():
    model = make_model()
    for parameter in model.parameters():
        parameter.zero_()
    state = th.randn(4, OBS_DIM)
    th.testing.assert_close(model(state, th.rand(4, ACT_DIM)), state, rtol=0, atol=0)
