"""Plain networks: those of a planner's first guess, and the regression that a planner is measured against."""

from __future__ import annotations

from collections.abc import Callable

import torch as th
from torch import nn
from tqdm.auto import tqdm

from sb3_said.replay.windows import mean_and_deviation

MODEL_WIDTH, MODEL_BLOCKS = 256, 4
# In standard deviations: a model asked far from its data must not diverge. In a log without noise falls lie at 31
FARTHEST = 100.0
RIGHT = 1e-4  # squared error below which an entry counts as known: that of a hundredth of its usual move


def plain_network(n_in: int, n_out: int, hidden: int) -> nn.Sequential:
    """Return a network of two hidden layers."""
    return nn.Sequential(
        *(nn.Linear(n_in, hidden), nn.ReLU()), *(nn.Linear(hidden, hidden), nn.ReLU()), nn.Linear(hidden, n_out)
    )


def descend(
    loss: Callable[[], th.Tensor],
    rates: dict[nn.Module, float],
    clip: float | None,
    n_updates: int,
    name: str,
    progress_bar: bool,
    should_stop: Callable[[], bool] | None,
) -> bool:
    """Make updates of Adam, whose learning rates fall to 0 by a cosine; return whether all were made.

    :param loss: draws a batch and returns its loss
    :param rates: learning rate of each network
    :param clip: largest norm of a network's gradient; None for any
    :param name: for the progress bar
    :param should_stop: asked after every update; None never stops
    """
    optimizer = th.optim.Adam([{"params": [*x.parameters()], "lr": rate} for x, rate in rates.items()], fused=True)
    scheduler = th.optim.lr_scheduler.CosineAnnealingLR(optimizer, n_updates)
    for _ in tqdm(range(n_updates), desc=name, disable=not progress_bar):
        optimizer.zero_grad()
        loss().backward()
        if clip is not None:
            for network in rates:
                th.nn.utils.clip_grad_norm_(network.parameters(), clip)
        optimizer.step()
        scheduler.step()
        if should_stop is not None and should_stop():
            return False
    return True


class ZScored(nn.Module):
    """A network that reads z-scores of n entries; before :meth:`scale_to` it reads them as they are."""

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, n: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(n))
        self.register_buffer("std", th.ones(n))

    @property
    def has_learned(self) -> bool:
        """Whether :meth:`scale_to` has given it a scale."""
        return bool((self.mean != 0).any() or (self.std != 1).any())

    @th.no_grad()
    def scale_to(self, rows: th.Tensor) -> None:
        """Take over mean and deviation of rows (M, n); an entry that never varies keeps its scale."""
        mean, std = mean_and_deviation(rows)
        self.mean.copy_(mean)
        self.std.copy_(std)

    def _z(self, rows: th.Tensor) -> th.Tensor:
        return (rows - self.mean) / self.std


class ResidualBlock(nn.Module):
    """Two layers that read the normalised input; their output is added to it (as in transformers and SimbaV1)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Map (B, width) to (B, width)."""
        return x + self.net(x)


class OneStepModel(nn.Module):
    """Predicts the state that follows an action: its difference from the state before, in units of the usual moves.

    The error of four residual blocks is a quarter below that of two, and further below that of two plain layers
    (measured, results/first_guess.md, results/nine_logs.md).
    """

    learning_rate = 2e-3  # of Adam, results/nine_logs.md has others
    move_std: th.Tensor  # (obs_dim,), set it to how far z-scored states move in a step

    def __init__(self, obs_dim: int, act_dim: int) -> None:
        super().__init__()
        blocks = [ResidualBlock(MODEL_WIDTH) for _ in range(MODEL_BLOCKS)]
        self.net = nn.Sequential(nn.Linear(obs_dim + act_dim, MODEL_WIDTH), *blocks, nn.Linear(MODEL_WIDTH, obs_dim))
        self.register_buffer("move_std", th.ones(obs_dim))

    def forward(self, state: th.Tensor, action: th.Tensor) -> th.Tensor:
        """Return the states that follow: (B, obs_dim), no entry beyond FARTHEST.

        :param state: (B, obs_dim), z-scored
        :param action: (B, act_dim), in [-1, 1]
        """
        return (state + self.move_std * self.net(th.cat([state, action], dim=-1))).clamp(-FARTHEST, FARTHEST)

    def loss(self, states: th.Tensor, actions: th.Tensor, follows: th.Tensor) -> th.Tensor:
        """Return the mean over steps and entries of log(1 + e / RIGHT), e an entry's mean squared error, in moves.

        The model goes on from its own answers, as in use. Up to constants the loss is the negative log-likelihood of
        Gaussian errors, where each entry has its variance in the batch. A plain mean would mostly count what cannot be
        foreseen: 78 of Ant-v5's 105 entries are contact forces (measured, results/first_guess.md).

        :param states: (B, K + 1, obs_dim), successive and z-scored
        :param actions: (B, K, act_dim), in [-1, 1], between the states
        :param follows: (B, K) bool, whether each state but the first is of the same episode
        """
        state, losses = states[:, 0], []
        for k in range(actions.shape[1]):
            state = self(state, actions[:, k])
            error = ((state - states[:, k + 1]) / self.move_std) ** 2 * follows[:, k, None]  # (B, obs_dim)
            losses.append((error.sum(0) / follows[:, k].sum().clamp(min=1) / RIGHT).log1p().mean())
        return th.stack(losses).mean()
