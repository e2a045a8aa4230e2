"""Environment units to the planner's units and back."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_said.replay.windows import Windows, mean_and_deviation

LARGEST_ACTION = 0.999  # the paper's bound before arctanh


class Normalizer(nn.Module):
    """Z-score states and actions; its statistics are buffers, so they are saved with the planner.

    With ``relative_states`` every state but the first is given as its move from the first, in standard deviations of
    the moves at its index: states a few steps apart differ by little, and that little counts.

    :param window_length: L, steps of a window
    :param relative_states: see above; False z-scores every state alike (paper)
    :param action_transform: ``"standard"``: z-score actions as they are, and clip them on the way back; ``"tanh"`` (the
        paper's): clip to 0.999, arctanh, z-score, and back through tanh
    """

    state_mean: th.Tensor
    state_std: th.Tensor
    action_mean: th.Tensor
    action_std: th.Tensor
    move_std: th.Tensor

    def __init__(
        self,
        obs_dim: int,
        act_dim: int,
        window_length: int,
        action_transform: str,
        relative_states: bool,
    ) -> None:
        super().__init__()
        self.sizes = [obs_dim, act_dim]
        self.relative_states = relative_states
        self.register_buffer("move_std", th.ones(window_length - 1, obs_dim))
        self.action_transform = action_transform
        for name, size in (("state", obs_dim), ("action", act_dim)):
            self.register_buffer(f"{name}_mean", th.zeros(size))
            self.register_buffer(f"{name}_std", th.ones(size))

    @th.no_grad()
    def fit(self, states: th.Tensor, actions: th.Tensor) -> None:
        """Take over the mean and standard deviation of states (M, obs_dim) and actions (M, act_dim), float32."""
        for name, values in (("state", states), ("action", self._bend(actions))):
            mean, std = mean_and_deviation(values)
            getattr(self, f"{name}_mean").copy_(mean)
            getattr(self, f"{name}_std").copy_(std)

    @th.no_grad()
    def fit_moves(self, windows: Windows) -> None:
        """Take over how far states move within a window, index by index; call :meth:`fit` before."""
        z = self.normalize_states(windows.states)
        moves, valid = z[:, 1:] - z[:, :1], windows.valid[:, 1:, None]
        std = (th.where(valid, moves**2, 0.0).sum(0) / valid.sum(0).clamp(min=1)).sqrt()  # (L - 1, obs_dim)
        self.move_std.copy_(th.where(std > 1e-6, std, 1.0))

    def normalize(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Map windows to the planner's units.

        :param states: (..., L, obs_dim), environment units
        :param actions: (..., L, act_dim), in [-1, 1]
        :return: (..., L, obs_dim + act_dim)
        """
        z = self.normalize_states(states)
        if self.relative_states:
            first = z[..., :1, :]
            z = th.cat([first, (z[..., 1:, :] - first) / self.move_std[: z.shape[-2] - 1]], dim=-2)
        return th.cat([z, self.normalize_actions(actions)], dim=-1)

    def denormalize(self, x: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Invert :meth:`normalize`: states and actions, the latter in [-1, 1] whatever is given."""
        z, actions = x.split(self.sizes, dim=-1)
        if self.relative_states:
            first = z[..., :1, :]
            z = th.cat([first, first + z[..., 1:, :] * self.move_std[: z.shape[-2] - 1]], dim=-2)
        return self.denormalize_states(z), self.denormalize_actions(actions)

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
