"""A plain regression of what the planner has to decode, trained on the same batches: the bar to reach."""

from __future__ import annotations

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_said.planner.plain import plain_network
from sb3_said.replay.windows import Windows


class RegressionYardstick(nn.Module):
    """Multi-layer perceptron from (s_{t-d}, the d actions since, d) to (s_t, a_t).

    A generative planner should know the present at least as well as this small network. A planner that does not is
    trained too little, or wrongly, whatever its return.

    :param max_delay: D, the largest delay
    :param hidden: width of the two hidden layers
    """

    def __init__(self, obs_dim: int, act_dim: int, max_delay: int, hidden: int = 512) -> None:
        super().__init__()
        self.max_delay = max_delay
        self.sizes = [obs_dim, act_dim]
        self.net = plain_network(obs_dim + max_delay * (act_dim + 1), obs_dim + act_dim, hidden)

    def forward(self, state: th.Tensor, actions: th.Tensor, delay: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Predict the present (B, obs_dim), normalised, and the decision (B, act_dim), in [-1, 1].

        :param state: (B, obs_dim) s_{t-d}, normalised
        :param actions: (B, >= D, act_dim) the window's actions, in [-1, 1]; those from index d on are not read
        :param delay: (B,) int64, d
        """
        known = th.arange(self.max_delay, device=delay.device) < delay[:, None]  # (B, D)
        history = actions[:, : self.max_delay] * known[..., None]  # (B, D, act_dim)
        present, decision = self.net(th.cat([state, history.flatten(1), known], dim=1)).split(self.sizes, dim=1)
        return present, decision

    def loss(self, windows: Windows, delay: th.Tensor, weight: th.Tensor) -> th.Tensor:
        """Return the mean squared error over states plus that over actions, where the episode reaches the decision.

        :param windows: B windows with normalised states
        :param delay: (B,) int64, d
        :param weight: (B,) factor of each window's error, as in the planner's loss
        """
        at_decision = th.arange(len(delay), device=delay.device), delay
        present, decision = self(windows.states[:, 0], windows.actions, delay)
        error = F.mse_loss(present, windows.states[at_decision], reduction="none").mean(1)  # (B,)
        error = error + F.mse_loss(decision, windows.actions[at_decision], reduction="none").mean(1)
        valid = windows.valid[at_decision]
        return (error * valid * weight).sum() / valid.sum().clamp_min(1)
