"""The same planner written the plain way, as public diffusion planners are: what the benchmarks compare with.

It follows CleanDiffuser's DiT pipelines, the code under the paper's results, in what costs time:

- eager float32 and ``nn.MultiheadAttention``;
- time embedding and adaLN modulations for every sample at every call, solver coefficients for every plan;
- an optimizer and an average of the weights that go parameter by parameter;
- windows fetched one by one, and the loss read after every update.

Shapes and arithmetic of the transformer are ours, so that both ways do the same work. Nothing is slower here than in
CleanDiffuser. What never touches the result (an unused second network, logs of every denoising step) is left out.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

import numpy as np
import torch as th
from stable_baselines3.sac.policies import ContinuousCritic
from torch import nn
from torch.utils.data import DataLoader, Dataset

from sb3_said.replay.windows import Windows

EMBEDDING = 128  # width of the time embedding, CleanDiffuser's emb_dim
START_TIME, END_TIME = 1e-3, 1.0


def alpha_sigma(t: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return the factors of the clean sample and of the noise in the linear schedule, each of the shape of t."""
    alpha = (-(20.0 - 0.1) / 4 * t**2 - 0.1 / 2 * t).exp()
    return alpha, (1 - alpha**2).sqrt()


class TimeEmbedding(nn.Module):
    """Random Fourier features of the time, through an MLP."""

    frequencies: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("frequencies", 16 * th.randn(16))
        self.mlp = nn.Sequential(nn.Linear(32, EMBEDDING), nn.Mish(), nn.Linear(EMBEDDING, EMBEDDING))

    def forward(self, t: th.Tensor) -> th.Tensor:
        """Map (M,) times to (M, EMBEDDING)."""
        angles = 2 * math.pi * t[:, None] * self.frequencies
        return self.mlp(th.cat([angles.cos(), angles.sin()], dim=-1))


class Block(nn.Module):
    """Attention and MLP with adaLN-zero."""

    def __init__(self, d_model: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(d_model, elementwise_affine=False, eps=1e-6)
        self.attention = nn.MultiheadAttention(d_model, d_model // 32, batch_first=True)
        self.norm2 = nn.LayerNorm(d_model, elementwise_affine=False, eps=1e-6)
        self.mlp = nn.Sequential(
            nn.Linear(d_model, 4 * d_model), nn.GELU(approximate="tanh"), nn.Linear(4 * d_model, d_model)
        )
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(d_model, 6 * d_model))

    def forward(self, x: th.Tensor, embedded: th.Tensor) -> th.Tensor:
        """
        :param x: (M, L, d_model)
        :param embedded: (M, d_model)
        """
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.modulation(embedded).chunk(6, dim=1)
        h = modulate(self.norm1(x), shift_a, scale_a)
        x = x + gate_a.unsqueeze(1) * self.attention(h, h, h)[0]
        return x + gate_m.unsqueeze(1) * self.mlp(modulate(self.norm2(x), shift_m, scale_m))


def modulate(x: th.Tensor, shift: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """Scale (M, L, d_model) tokens by 1 + scale and shift them, both (M, d_model)."""
    return x * (1 + scale.unsqueeze(1)) + shift.unsqueeze(1)


class DiT(nn.Module):
    """Predicts the noise in a noisy window, one token per time step.

    :param in_dim: numbers in a state and an action together
    """

    positions: th.Tensor

    def __init__(self, in_dim: int, length: int, d_model: int, depth: int) -> None:
        super().__init__()
        self.token_embedding = nn.Linear(in_dim, d_model)
        self.time_embedding = TimeEmbedding()
        self.map_embedding = nn.Sequential(
            nn.Linear(EMBEDDING, d_model), nn.Mish(), nn.Linear(d_model, d_model), nn.Mish()
        )
        angles = th.arange(length)[:, None] * 10_000.0 ** -th.linspace(0, 1, d_model // 2)
        self.register_buffer("positions", th.cat([angles.sin(), angles.cos()], dim=-1))  # (L, d_model)
        self.blocks = nn.ModuleList(Block(d_model) for _ in range(depth))
        self.norm = nn.LayerNorm(d_model, elementwise_affine=False, eps=1e-6)
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(d_model, 2 * d_model))
        self.out = nn.Linear(d_model, in_dim)

    def forward(self, x: th.Tensor, t: th.Tensor) -> th.Tensor:
        """Return the predicted noise: (M, L, in_dim).

        :param x: (M, L, in_dim)
        :param t: (M,), the time of each sample
        """
        embedded = self.map_embedding(self.time_embedding(t))  # (M, d_model)
        tokens = self.token_embedding(x) + self.positions
        for block in self.blocks:
            tokens = block(tokens, embedded)
        shift, scale = self.modulation(embedded).chunk(2, dim=1)
        return self.out(modulate(self.norm(tokens), shift, scale))


class WindowDataset(Dataset[dict[str, th.Tensor]]):
    """One item is one window, in the planner's units.

    :param windows: M windows of states and actions
    """

    def __init__(self, windows: Windows) -> None:
        self.x = th.cat([windows.states, windows.actions], dim=-1).numpy()  # (M, L, in_dim)
        self.values = windows.values.numpy()  # (M,)

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, index: int) -> dict[str, th.Tensor]:
        return {"x": th.tensor(self.x[index]), "value": th.tensor(self.values[index])}


def batches(dataset: WindowDataset, batch_size: int, num_workers: int = 0) -> Iterator[dict[str, th.Tensor]]:
    """Yield shuffled batches for ever.

    :param num_workers: processes that fetch; the public code's 4 would take cores away from what is measured
    """
    loader = DataLoader(dataset, batch_size, shuffle=True, num_workers=num_workers, drop_last=True)
    while True:
        yield from loader


class PlainPlanner:
    """Training and planning for one fixed delay d.

    :param obs_dim: numbers in a state
    :param act_dim: numbers in an action
    :param delay: d, how many actions are known
    :param length: L, steps of a window
    :param gradient_steps: updates over which the learning rate falls to 0
    """

    def __init__(
        self,
        obs_dim: int,
        act_dim: int,
        delay: int,
        length: int,
        d_model: int = 256,
        depth: int = 2,
        gradient_steps: int = 1_000_000,
        ema_decay: float = 0.9999,
        weight_factor: float = 2.0,
        device: str | th.device = "cpu",
    ) -> None:
        self.obs_dim, self.act_dim, self.delay, self.device = obs_dim, act_dim, delay, device
        self.model = DiT(obs_dim + act_dim, length, d_model, depth).to(device).train()
        self.model_ema = copy.deepcopy(self.model).requires_grad_(False).eval()
        self.optimizer = th.optim.AdamW(self.model.parameters(), lr=2e-4, weight_decay=1e-5)
        self.lr_scheduler = th.optim.lr_scheduler.CosineAnnealingLR(self.optimizer, T_max=gradient_steps)
        self.ema_decay, self.weight_factor = ema_decay, weight_factor
        self.known = th.zeros(length, obs_dim + act_dim, device=device)  # 1 where given
        self.known[0, :obs_dim] = 1.0
        self.known[:delay, obs_dim:] = 1.0
        self.state_mean, self.state_std = np.zeros(obs_dim, np.float32), np.ones(obs_dim, np.float32)

    def update(self, batch: dict[str, th.Tensor]) -> float:
        """Make one update on a batch of :func:`batches`, and return its loss."""
        x0, value = batch["x"].to(self.device), batch["value"].to(self.device)  # (B, L, in_dim), (B,)
        weight = th.exp(self.weight_factor * (value - 1))
        t = th.rand(len(x0), device=self.device) * (END_TIME - START_TIME) + START_TIME
        noise = th.randn_like(x0)
        alpha, sigma = (factor[:, None, None] for factor in alpha_sigma(t))
        xt = alpha * x0 + sigma * noise
        xt = xt * (1 - self.known) + x0 * self.known
        error = (self.model(xt, t) - noise) ** 2 * (1 - self.known) * weight[:, None, None]
        loss = error.mean()
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.lr_scheduler.step()
        with th.no_grad():
            for parameter, average in zip(self.model.parameters(), self.model_ema.parameters(), strict=True):
                average.mul_(self.ema_decay).add_(parameter, alpha=1 - self.ema_decay)
        return loss.item()

    @th.no_grad()
    def sample(self, prior: th.Tensor, sampling_steps: int, temperature: float) -> th.Tensor:
        """Return denoised windows by DDIM: (M, L, in_dim).

        :param prior: (M, L, in_dim), with all known entries in place
        """
        times = th.linspace(START_TIME, END_TIME, sampling_steps + 1, device=self.device)
        alphas, sigmas = alpha_sigma(times)
        x = th.randn_like(prior) * temperature
        x = x * (1 - self.known) + prior * self.known
        for i in reversed(range(1, sampling_steps + 1)):
            t = th.full((len(x),), float(times[i]), device=self.device)
            noise = self.model_ema(x, t)
            x = alphas[i - 1] * (x - sigmas[i] * noise) / alphas[i] + sigmas[i - 1] * noise
            x = x * (1 - self.known) + prior * self.known
        return x

    @th.no_grad()
    def decide(
        self,
        observation: np.ndarray,
        action_history: np.ndarray,
        critic: ContinuousCritic,
        sampling_steps: int,
        n_candidates: int,
        temperature: float,
        scored: slice,
    ) -> np.ndarray:
        """Return the action of the best candidate, by the mean of min Q over its scored states: (B, act_dim).

        A single candidate is not scored.

        :param observation: (B, obs_dim) delayed observations
        :param action_history: (B, d, act_dim) actions sent since, oldest first
        :param critic: scores (state, action) pairs of the plan
        :param scored: the states of a window that count
        """
        n, length = len(observation), len(self.known)
        prior = th.zeros(n * n_candidates, length, self.obs_dim + self.act_dim, device=self.device)
        state = th.tensor((observation - self.state_mean) / self.state_std, device=self.device)
        actions = th.tensor(action_history, device=self.device)
        prior[:, 0, : self.obs_dim] = state.repeat_interleave(n_candidates, 0)
        prior[:, : self.delay, self.obs_dim :] = actions.repeat_interleave(n_candidates, 0)
        x = self.sample(prior, sampling_steps, temperature).view(n, n_candidates, length, -1)
        std, mean = th.tensor(self.state_std, device=self.device), th.tensor(self.state_mean, device=self.device)
        states, actions = x[..., : self.obs_dim] * std + mean, x[..., self.obs_dim :].clamp(-1, 1)
        if n_candidates == 1:
            return actions[:, 0, self.delay].cpu().numpy()
        values = th.cat(critic(states[:, :, scored].flatten(0, 2), actions[:, :, scored].flatten(0, 2)), dim=1)
        best = values.min(1).values.view(n, n_candidates, -1).mean(-1).argmax(1)
        return actions[th.arange(n, device=self.device), best, self.delay].cpu().numpy()
