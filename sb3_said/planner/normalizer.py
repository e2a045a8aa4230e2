"""Environment units to the planner's units and back."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_said.planner.diffusion import check_choice

ACTION_TRANSFORMS = ("standard", "tanh")
LARGEST_ACTION = 0.999  # the paper's bound before arctanh


class Normalizer(nn.Module):
    """Z-score states and actions; its statistics are buffers, so they are saved with the planner.

    :param obs_dim: numbers in a state
    :param act_dim: numbers in an action
    :param action_transform: ``"standard"``: z-score actions as they are, and clip them on the way back; ``"tanh"`` (the
        paper's): clip to 0.999, arctanh, z-score, and back through tanh
    :raises ValueError: for an unknown transform
    """

    state_mean: th.Tensor
    state_std: th.Tensor
    action_mean: th.Tensor
    action_std: th.Tensor

    def __init__(self, obs_dim: int, act_dim: int, action_transform: str = "standard") -> None:
        super().__init__()
        check_choice("action_transform", action_transform, ACTION_TRANSFORMS)
        self.action_transform = action_transform
        for name, size in (("state", obs_dim), ("action", act_dim)):
            self.register_buffer(f"{name}_mean", th.zeros(size))
            self.register_buffer(f"{name}_std", th.ones(size))

    @th.no_grad()
    def fit(self, states: th.Tensor, actions: th.Tensor) -> None:
        """Take over the mean and standard deviation of the data.

        :param states: (M, obs_dim) float32, environment units
        :param actions: (M, act_dim) float32, in [-1, 1]
        """
        for name, values in (("state", states), ("action", self._bend(actions))):
            variance, mean = th.var_mean(values, dim=0, correction=0)
            std = variance.sqrt()
            # Rounding may leave a constant column a tiny deviation, and dividing by it would blow that noise up
            std[std <= 1e-6 * values.abs().amax(0)] = 1.0
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_std").copy_(std)

    def normalize_states(self, states: th.Tensor) -> th.Tensor:
        """Map (..., obs_dim) from environment units to standard deviations from the mean."""
        return (states - self.state_mean) / self.state_std

    def normalize_actions(self, actions: th.Tensor) -> th.Tensor:
        """Map (..., act_dim) from [-1, 1] to the planner's units."""
        return (self._bend(actions) - self.action_mean) / self.action_std

    def denormalize_states(self, states: th.Tensor) -> th.Tensor:
        """Invert :meth:`normalize_states`."""
        return states * self.state_std + self.state_mean

    def denormalize_actions(self, actions: th.Tensor) -> th.Tensor:
        """Invert :meth:`normalize_actions`; the result lies in [-1, 1] whatever is given."""
        actions = actions * self.action_std + self.action_mean
        return actions.tanh() if self.action_transform == "tanh" else actions.clamp(-1.0, 1.0)

    def _bend(self, actions: th.Tensor) -> th.Tensor:
        if self.action_transform == "standard":
            return actions
        return actions.clamp(-LARGEST_ACTION, LARGEST_ACTION).atanh()
