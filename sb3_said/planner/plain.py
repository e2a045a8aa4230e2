"""Plain networks: what a planner is shown first, and what it is measured against."""

from __future__ import annotations

import torch as th
from torch import nn


def plain_network(n_in: int, n_out: int, hidden: int) -> nn.Sequential:
    """Return a network of two hidden layers."""
    return nn.Sequential(
        *(nn.Linear(n_in, hidden), nn.ReLU()), *(nn.Linear(hidden, hidden), nn.ReLU()), nn.Linear(hidden, n_out)
    )


class OneStepModel(nn.Module):
    """Predicts the state that follows an action, as a difference from the one before, in units of its usual moves.

    :param hidden: width of the two hidden layers
    """

    move_std: th.Tensor  # (obs_dim,), set it to how far z-scored states move in a step

    def __init__(self, obs_dim: int, act_dim: int, hidden: int = 512) -> None:
        super().__init__()
        self.net = plain_network(obs_dim + act_dim, obs_dim, hidden)
        self.register_buffer("move_std", th.ones(obs_dim))

    def forward(self, state: th.Tensor, action: th.Tensor) -> th.Tensor:
        """Return the states that follow: (B, obs_dim).

        :param state: (B, obs_dim), z-scored
        :param action: (B, act_dim), in [-1, 1]
        """
        return state + self.move_std * self.net(th.cat([state, action], dim=-1))

    def loss(self, states: th.Tensor, actions: th.Tensor, follows: th.Tensor) -> th.Tensor:
        """Return the mean squared error of one step, in moves.

        :param states: (B, 2, obs_dim), one after the other
        :param actions: (B, act_dim), between them
        :param follows: (B,) bool, whether the second state is of the same episode
        """
        now, then = states.unbind(1)
        error = (((self(now, actions) - then) / self.move_std) ** 2).mean(-1)  # (B,)
        return (error * follows).sum() / follows.sum().clamp(min=1)
