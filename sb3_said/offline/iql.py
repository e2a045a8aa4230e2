"""Implicit Q-learning (Kostrikov et al., ICLR 2022, https://arxiv.org/abs/2110.06169): values from logs alone."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_said.offline.datasets import Dataset
from sb3_said.planner.checks import check_same, check_settings, check_stored
from sb3_said.planner.plain import ZScored

AT_MOST = {"hidden": 16_384, "batch_size": 1_000_000, "updates": 1000}  # more is a slip, and would cost memory or hours
SMALLEST_SPREAD = 0.1  # of returns, as a part of the largest: nearly equal returns would be scaled up without bound


class Transitions(NamedTuple):
    """A batch of B steps of a task without delay, in environment units."""

    states: th.Tensor  # (B, obs_dim)
    actions: th.Tensor  # (B, act_dim), in [-1, 1]
    rewards: th.Tensor  # (B,)
    next_states: th.Tensor  # (B, obs_dim)
    terminated: th.Tensor  # (B,) float32, 1 where the task itself ended


@dataclass(frozen=True)
class IQLConfig:
    """Settings of the values, with their sources in parentheses."""

    expectile: float = 0.7
    """tau of the expectile regression, in [0.5, 1); 0.5 is the mean (SAID paper, Table 3: iql_tau)"""
    hidden: int = 256
    """width of the two hidden layers, each with LayerNorm and Mish (CleanDiffuser, utils/iql.py)"""
    learning_rate: float = 3e-4
    """of Adam, for V and Q (IQL, CleanDiffuser)"""
    target_rate: float = 0.005
    """part of the way that target critics move to the critics (IQL; CleanDiffuser keeps 0.995)"""
    batch_size: int = 256
    """steps of an update (IQL, SAID paper)"""
    updates: int = 2
    """of V and Q for each update of the planner (ours: a planner that learns within hours has few; the paper's: one)"""

    def __post_init__(self) -> None:
        check_settings(self, {"hidden": 1, "batch_size": 1, "updates": 1}, AT_MOST)
        if not 0.5 <= self.expectile < 1:
            raise ValueError(f"expectile is {self.expectile}, expected a number from 0.5, the mean, up to below 1.")
        if not self.learning_rate > 0 or not 0 < self.target_rate <= 1:
            raise ValueError(
                f"learning_rate is {self.learning_rate} and target_rate {self.target_rate}, expected numbers above 0, "
                "the second at most 1."
            )


class ImplicitValues(ZScored):
    """V(s), and the Q(s, a) from which V is learned, without asking about an action that is not in the data.

    V is the expectile of Q over the data's actions: with tau near 1, Q of the best of them. :meth:`fit` sets the scales
    of states and rewards; :meth:`value` is in the environment's units.

    :param obs_dim: entries of a state
    :param act_dim: entries of an action
    :param config: settings
    """

    def __init__(self, obs_dim: int, act_dim: int, config: IQLConfig | None = None):
        super().__init__(obs_dim)
        self.config = config = config or IQLConfig()
        self.v = _network(obs_dim, config.hidden)
        self.q = nn.ModuleList(_network(obs_dim + act_dim, config.hidden) for _ in range(2))
        self.q_target = copy.deepcopy(self.q).requires_grad_(False)
        self.register_buffer("scale", th.ones(()))

    scale: th.Tensor

    @th.no_grad()
    def fit(self, states: th.Tensor, returns: th.Tensor, longest: int) -> None:
        """Fit the scales of states and rewards.

        :param states: (M, obs_dim)
        :param returns: (n_trajectories,)
        :param longest: T, steps of the longest trajectory. Rewards are multiplied by T / (largest - smallest return),
            on MuJoCo IQL's 1000 / (...). The difference counts as at least a tenth of the largest absolute return
        """
        self.scale_to(states)
        spread = th.maximum(returns.max() - returns.min(), SMALLEST_SPREAD * returns.abs().max())
        self.scale.copy_(longest / spread if spread > 0 else th.ones(()))

    def value(self, states: th.Tensor) -> th.Tensor:
        """Return V(s) in units of the environment's rewards.

        :param states: (..., obs_dim)
        :return: (...)
        """
        return self.v(self._z(states))[..., 0] / self.scale

    def losses(self, batch: Transitions, gamma: float) -> dict[str, th.Tensor]:
        """Return the losses of V (equation 5) and Q (equation 6), in scaled rewards.

        :param batch: B steps
        :param gamma: discount factor
        """
        z, next_z = self._z(batch.states), self._z(batch.next_states)
        x = th.cat([z, batch.actions], dim=-1)
        with th.no_grad():
            target_q = th.minimum(*(q(x)[:, 0] for q in self.q_target))  # (B,)
            next_v = self.v(next_z)[:, 0]
        v_loss = expectile_loss(target_q - self.v(z)[:, 0], self.config.expectile)
        y = batch.rewards * self.scale + gamma * (1.0 - batch.terminated) * next_v  # (B,)
        q_loss = sum((F.mse_loss(q(x)[:, 0], y) for q in self.q), start=y.new_zeros(()))
        return {"v_loss": v_loss, "q_loss": q_loss}


class IQL:
    """Trains :class:`ImplicitValues` on a dataset, one batch a step.

    :param values: what to train; its scales are fitted to the data
    :param data: logged trajectories
    :param gamma: discount factor
    :param seed: of the batches
    """

    def __init__(self, values: ImplicitValues, data: Dataset, gamma: float, seed: int = 0):
        self.values, self.gamma = values, gamma
        device = values.mean.device
        rows = (data.states, data.actions, data.rewards, data.next_states, data.terminated.astype(np.float32))
        self.data = Transitions(*(th.from_numpy(np.ascontiguousarray(column)).to(device) for column in rows))
        values.fit(self.data.states, th.from_numpy(data.returns), int(data.lengths.max()))
        trained = [*values.v.parameters(), *values.q.parameters()]
        self.optimizer = th.optim.Adam(trained, lr=values.config.learning_rate, fused=True)  # saves a tenth of a step
        self.generator = th.Generator().manual_seed(seed)

    def step(self) -> dict[str, th.Tensor]:
        """Make a gradient step on a batch drawn uniformly from all steps, then move the target critics.

        :return: both losses
        """
        drawn = th.randint(len(self.data.rewards), (self.values.config.batch_size,), generator=self.generator)
        drawn = drawn.to(self.data.rewards.device)
        losses = self.values.losses(Transitions(*(part[drawn] for part in self.data)), self.gamma)
        self.optimizer.zero_grad()
        (losses["v_loss"] + losses["q_loss"]).backward()
        self.optimizer.step()
        polyak_update(self.values.q.parameters(), self.values.q_target.parameters(), self.values.config.target_rate)
        return losses

    def check_finite(self) -> None:
        """:raises FloatingPointError: where the values have learned NaN or infinite weights"""
        if not nn.utils.get_total_norm(self.values.parameters()).isfinite():
            raise FloatingPointError(
                "The weights of V(s) are no longer finite. Check the data for huge rewards; else lower learning_rate "
                f"of iql_kwargs ({self.values.config.learning_rate})."
            )

    def state_dict(self) -> dict[str, Any]:
        """Return all that a resumed training needs, but the data.

        :raises FloatingPointError: as :meth:`check_finite`
        """
        self.check_finite()
        return {
            "config": asdict(self.values.config),
            "values": self.values.state_dict(),
            "optimizer": self.optimizer.state_dict()["state"],
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what :meth:`state_dict` returned.

        :raises ValueError: when the saved training had other settings, or has numbers that are not finite
        """
        check_stored(state)
        advice = "Give the old iql_kwargs, or start a new training."
        check_same("V(s) was learned", state["config"], asdict(self.values.config), advice)
        self.values.load_state_dict(state["values"])
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": state["optimizer"]})
        self.generator.set_state(state["generator"])


def expectile_loss(difference: th.Tensor, expectile: float) -> th.Tensor:
    """Return the mean of |tau - 1(u < 0)| u^2. With u = Q - V, the tau-expectile of Q is the V that minimises it.

    :param difference: (B,) u
    :param expectile: tau
    """
    weight = th.where(difference < 0, 1.0 - expectile, expectile)
    return (weight * difference**2).mean()


def _network(n_in: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        *(nn.Linear(n_in, hidden), nn.LayerNorm(hidden), nn.Mish()),
        *(nn.Linear(hidden, hidden), nn.LayerNorm(hidden), nn.Mish()),
        nn.Linear(hidden, 1),
    )
