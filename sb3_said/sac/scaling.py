"""Running scales of rewards and states, which are part of an agent's networks and of its file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch as th
from torch import nn

from sb3_said.replay.windows import mean_and_deviation

LARGEST_SCALED_RETURN = 5.0  # of SimbaV2, whose critic tells no larger returns apart
LARGEST_SCORE = 10.0  # as in SB3's VecNormalize


class OnTheHost(nn.Module):
    """Keeps its float64 buffers on the CPU: Apple's GPUs have no float64, and reading from any GPU waits for it."""

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> OnTheHost:
        everything = self._buffers
        self._buffers = {name: x for name, x in everything.items() if x is None or x.dtype != th.float64}
        super()._apply(fn, recurse)
        self._buffers = {**everything, **self._buffers}
        return self


def running_return(reward: np.ndarray, before: np.ndarray, begins: np.ndarray, gamma: float = 1.0) -> np.ndarray:
    """Return G_t = gamma G_{t-1} + r_t, with G_{t-1} = 0 where an episode begins; all arrays are (n_envs,)."""
    return reward + gamma * np.where(begins, 0.0, before)


class ReturnScale(OnTheHost):
    """The size of discounted returns so far, to divide rewards by (SimbaV2, https://arxiv.org/abs/2502.15280).

    It keeps mean, variance and largest size of the running returns G_t = gamma G_{t-1} + r_t of all steps, with
    G_{t-1} = 0 where an episode begins. ``value`` = max(sd(G), max |G| / 5), and 1 as long as all rewards are 0.
    """

    mean: th.Tensor
    variance: th.Tensor
    count: th.Tensor
    largest: th.Tensor
    value: th.Tensor  # () float32, on the networks' device, since CUDA graphs read it

    def __init__(self) -> None:
        super().__init__()
        for name in ("mean", "variance", "count", "largest"):
            self.register_buffer(name, th.zeros((), dtype=th.float64))
        self.register_buffer("value", th.ones(()), persistent=False)
        self.register_load_state_dict_post_hook(_take_value)

    def update(self, returns: np.ndarray) -> None:
        """Count the running returns of a step, (n_envs,) (Chan et al.'s parallel variance)."""
        n, count, mean = len(returns), float(self.count), float(self.mean)
        difference, total = float(np.mean(returns)) - mean, count + n
        squares = float(self.variance) * count + float(np.var(returns)) * n
        self.variance.fill_((squares + difference**2 * count * n / total) / total)
        self.mean.fill_(mean + difference * n / total)
        self.count.fill_(total)
        self.largest.fill_(max(float(self.largest), float(np.abs(returns).max())))
        _take_value(self)


def _take_value(scale: ReturnScale, _: object = None) -> None:
    """Set ``value``. As a hook it must be picklable, and so a function of the module."""
    size = float(th.maximum(scale.variance.sqrt(), scale.largest / LARGEST_SCALED_RETURN).float())
    scale.value.fill_(size if size > 0 else 1.0)


class StateNormalizer(OnTheHost):
    """z-scores of states, (s - mean) / sd, cut at +-10. Before its first fit it only cuts.

    :param obs_dim: of a state
    """

    mean: th.Tensor
    deviation: th.Tensor
    fitted_at: th.Tensor

    def __init__(self, obs_dim: int):
        super().__init__()
        self.register_buffer("mean", th.zeros(obs_dim))
        self.register_buffer("deviation", th.ones(obs_dim))
        self.register_buffer("fitted_at", th.zeros((), dtype=th.float64))  # environment steps

    def fit(self, states: th.Tensor, n_steps: int) -> None:
        """Take mean and standard deviation of replayed states, (N, obs_dim), at environment step ``n_steps``."""
        mean, deviation = mean_and_deviation(states)
        self.mean.copy_(mean)
        self.deviation.copy_(deviation)
        self.fitted_at.fill_(float(n_steps))

    def forward(self, states: th.Tensor) -> th.Tensor:
        """Normalise states: (..., obs_dim) -> (..., obs_dim)."""
        return ((states - self.mean) / self.deviation).clamp(-LARGEST_SCORE, LARGEST_SCORE)
