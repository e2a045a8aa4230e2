"""A plain regression of what the planner has to decode, trained on the same batches: the bar to reach."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F


class Present(NamedTuple):
    """What hides behind a delay of d steps: the present, and the decision taken in it."""

    state: th.Tensor  # (B, obs_dim) s_t, normalised
    action: th.Tensor  # (B, act_dim) a_t, in environment units


class RegressionYardstick(nn.Module):
    """Multi-layer perceptron from (s_{t-d}, the d actions since, d) to (s_t, a_t).

    A generative planner has to know the present at least as well as this small network does. One that does not is not
    trained enough, or wrong, whatever its return says.

    :param obs_dim: size of an observation
    :param act_dim: size of an action
    :param max_delay: D, the largest delay
    :param hidden: width of the two hidden layers
    """

    def __init__(self, obs_dim: int, act_dim: int, max_delay: int, hidden: int = 512) -> None:
        super().__init__()
        self.max_delay = max_delay
        self.sizes = [obs_dim, act_dim]
        self.net = nn.Sequential(
            nn.Linear(obs_dim + max_delay * (act_dim + 1), hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, obs_dim + act_dim),
        )

    def forward(self, state: th.Tensor, actions: th.Tensor, delay: th.Tensor) -> Present:
        """Predict the present.

        :param state: (B, obs_dim) s_{t-d}, normalised
        :param actions: (B, >= D, act_dim) the window's actions in environment units; those from index d on are not read
        :param delay: (B,) int64, d
        """
        known = th.arange(self.max_delay, device=delay.device) < delay[:, None]  # (B, D)
        history = actions[:, : self.max_delay] * known[..., None]  # (B, D, act_dim)
        return Present(*self.net(th.cat([state, history.flatten(1), known], dim=1)).split(self.sizes, dim=1))

    def loss(
        self,
        state: th.Tensor,
        actions: th.Tensor,
        delay: th.Tensor,
        target: Present,
        valid: th.Tensor,
        weight: th.Tensor,
    ) -> th.Tensor:
        """Return the mean squared error over states plus that over actions.

        :param target: the true present
        :param valid: (B,) bool, False where the episode ended before the decision
        :param weight: (B,) factor of each window's error, as in the planner's loss
        """
        guess = self(state, actions, delay)
        error = F.mse_loss(guess.state, target.state, reduction="none").mean(1)  # (B,)
        error = error + F.mse_loss(guess.action, target.action, reduction="none").mean(1)
        return (error * valid * weight).sum() / valid.sum().clamp_min(1)
