"""What a first guess says of a window before the network is asked."""

from __future__ import annotations

import torch as th
from torch import nn

LEAST_STD = 0.01  # of a guess that is never wrong; in the planner's units
# Where a guess hardly varies, as that of contact forces that are mostly 0, least squares gives any slope: 85,000 was
# met, while no entry of the tasks without such forces has above 8 (results/settings.md)
LARGEST_SLOPE = 10.0
FEWEST_WINDOWS = 10  # that can tell how far a guess is right; by one window it looks as if it were never wrong


class Prior(nn.Module):
    """Takes each entry of a window for a draw from N(slope * guess, std^2), fitted for each delay and step.

    The network corrects the best prediction for such a draw, in units of that prediction's error. So a planner begins
    as good as its guess, and hardly changes what the guess is sure of. This is the preconditioning of Karras et al.
    2022 (https://arxiv.org/abs/2206.00364, section 5), but there the mean is 0, and one deviation serves all entries.

    Until :meth:`fit` the prior is N(0, 1), which leaves a prediction of v as it is.

    :param max_delay: D
    :param length: L, steps of the longest window
    :param n_entries: of a step, obs_dim + act_dim
    """

    slope: th.Tensor
    std: th.Tensor

    def __init__(self, max_delay: int, length: int, n_entries: int) -> None:
        super().__init__()
        self.register_buffer("slope", th.zeros(max_delay + 1, length, n_entries))
        self.register_buffer("std", th.ones(max_delay + 1, length, n_entries))

    @property
    def is_fitted(self) -> bool:
        """Whether :meth:`fit` has learned anything; it does not from fewer windows than ``FEWEST_WINDOWS``."""
        return bool((self.std != 1).any())

    @th.no_grad()
    def fit(self, delay: int, guess: th.Tensor, clean: th.Tensor, valid: th.Tensor) -> None:
        """Learn by least squares, within ``LARGEST_SLOPE``, how far guesses of one delay are right.

        :param guess: (M, L, n_entries), in the planner's units
        :param clean: (M, L, n_entries), the true entries, in the same units
        :param valid: (M, L) bool; a step that is valid in fewer windows than ``FEWEST_WINDOWS`` keeps its slope and
            deviation: one window alone lies on its own line, as if the guess were sure
        """
        share = valid[..., None] / valid.sum(0).clamp(min=1)[:, None]  # (M, L, 1)
        slope = (share * guess * clean).sum(0) / (share * guess**2).sum(0).clamp(min=1e-12)
        slope = slope.clamp(-LARGEST_SLOPE, LARGEST_SLOPE)
        std = (share * (clean - slope * guess) ** 2).sum(0).sqrt().clamp(min=LEAST_STD)
        is_seen = (valid.sum(0) >= FEWEST_WINDOWS)[:, None]
        self.slope[delay] = th.where(is_seen, slope, self.slope[delay])
        self.std[delay] = th.where(is_seen, std, self.std[delay])

    def forward(self, guess: th.Tensor, delay: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and standard deviation of each entry, both (B, L', n_entries).

        :param guess: (B, L', n_entries), L' at most L
        :param delay: (B,) int64
        """
        length = guess.shape[1]
        return self.slope[delay, :length] * guess, self.std[delay, :length]
