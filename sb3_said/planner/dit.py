"""A one-dimensional diffusion transformer: one token per time step of a window."""

from __future__ import annotations

import math

import torch as th
import torch.nn.functional as F
from torch import nn

HEAD_DIM = 32  # d_model // 32 heads, as in DV and the paper
N_TIME_FEATURES = 32  # as CleanDiffuser's Fourier embedding


def sinusoidal_positions(length: int, d_model: int) -> th.Tensor:
    """Return a fixed embedding of the positions 0..length-1: (length, d_model) float32.

    The angular frequencies run from 1 to 1/length radians a step, so that every pair of features changes over a window.
    The public code under the paper's results rounds the frequencies down to integers, so that all but the first are 0.
    """
    frequencies = float(length) ** -th.linspace(0.0, 1.0, d_model // 2)  # (d_model / 2,)
    angles = th.arange(length, dtype=th.float32)[:, None] * frequencies  # (L, d_model / 2)
    return th.cat([angles.sin(), angles.cos()], dim=-1)


def _modulate(x: th.Tensor, shift: th.Tensor, factor: th.Tensor) -> th.Tensor:
    """Layer-normalise tokens (M, L, d_model), then scale and shift them by (M, 1, d_model), or (d_model,) for all."""
    if shift.dim() == 1:  # the norm's own affine map: one kernel instead of two
        return th.layer_norm(x, x.shape[-1:], factor, shift, 1e-6)
    return th.addcmul(shift, th.layer_norm(x, x.shape[-1:], eps=1e-6), factor)


class DiTBlock(nn.Module):
    """Attention and MLP with adaLN-zero (Peebles and Xie 2023) on a true residual stream.

    The public code under the paper's results overwrites the stream with its normalised version in each block; here
    the identity path runs through the whole depth.
    """

    def __init__(self, d_model: int) -> None:
        super().__init__()
        self.qkv = nn.Linear(d_model, 3 * d_model)
        self.attention_out = nn.Linear(d_model, d_model)
        # Exact GELU: the public code's tanh is off by up to 5e-4, and takes four times as long on a CPU
        self.mlp = nn.Sequential(nn.Linear(d_model, 4 * d_model), nn.GELU(), nn.Linear(4 * d_model, d_model))

    def forward(
        self, x: th.Tensor, modulation: tuple[th.Tensor, ...], attention_bias: th.Tensor | None = None
    ) -> th.Tensor:
        """Return the residual stream behind the block: (M, L, d_model) float32, whatever the weights' number format.

        :param x: (M, L, d_model) float32
        :param modulation: shift, factor and gate of the attention, then of the MLP: 6 of (M, 1, d_model), or of
            (d_model,) for all
        :param attention_bias: (M, 1, 1, L) float32, -inf for tokens that may not be attended to; 0 by default
        """
        shift_a, factor_a, gate_a, shift_m, factor_m, gate_m = modulation
        dtype = self.qkv.weight.dtype
        attended = self._attention(_modulate(x, shift_a, factor_a).to(dtype), attention_bias)
        x = th.addcmul(x, gate_a, attended)
        return th.addcmul(x, gate_m, self.mlp(_modulate(x, shift_m, factor_m).to(dtype)))

    def _attention(self, x: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        m, length, d_model = x.shape
        qkv = self.qkv(x).view(m, length, 3, -1, HEAD_DIM).permute(2, 0, 3, 1, 4).contiguous()
        q, k, v = qkv.view(3, -1, length, HEAD_DIM).unbind()  # each (M * heads, L, HEAD_DIM)
        # Plain products: windows are short, and PyTorch's fused attention is slower on CPUs, forward and backward.
        # With beta=0 the first argument counts for nothing; but on MPS a NaN in it would count, so it is 0
        scores = th.baddbmm(q.new_zeros(1), q, k.mT, beta=0, alpha=HEAD_DIM**-0.5)  # (M * heads, L, L)
        if bias is not None:
            scores = (scores.view(m, -1, length, length) + bias).view(-1, length, length)
        mixed = th.bmm(scores.softmax(-1, dtype=th.float32).to(v.dtype), v)  # (M * heads, L, HEAD_DIM)
        return self.attention_out(mixed.view(m, -1, length, HEAD_DIM).transpose(1, 2).reshape(m, length, d_model))


class DiT1d(nn.Module):
    """Predict v or the noise of a noisy window whose known entries are clean, or the error of a prior's prediction.

    A call has three parts, since only the last is repeated for each candidate and denoising step: :meth:`modulations`
    depends on the diffusion time alone, :meth:`context` on what is known alone, :meth:`forward` on both.

    :param max_delay: D, the most actions that can be known
    :param length: steps of the longest window
    :param d_model: width, a multiple of 32
    :param embed_known: add an embedding of all known entries to every token; each is shown in its own place anyway
    :param extra_states: states at indices 1..D may be known too, and are embedded
    :param first_guess: a guess of the window is shown beside what is known
    """

    frequencies: th.Tensor
    positions: th.Tensor
    is_factor: th.Tensor

    def __init__(
        self,
        obs_dim: int,
        act_dim: int,
        max_delay: int,
        length: int,
        d_model: int,
        depth: int,
        embed_known: bool,
        extra_states: bool,
        first_guess: bool,
    ) -> None:
        super().__init__()
        self.d_model = d_model
        self.obs_dim = obs_dim
        self.max_delay = max_delay
        self.extra_states = extra_states
        self.token_embedding = nn.Linear(obs_dim + act_dim, d_model)
        self.flag_embedding = nn.Linear(2, d_model, bias=False)
        n_known = obs_dim + max_delay * (act_dim + 1 + extra_states * (obs_dim + 1))
        self.known_embedding = _mlp(n_known, d_model) if embed_known else None
        self.guess_embedding = nn.Linear(2 * obs_dim + act_dim, d_model) if first_guess else None
        self.time_embedding = _mlp(N_TIME_FEATURES, d_model)
        # One linear map for the modulations of all blocks (6 each) and of the output (2): one product instead of many
        self.modulation = nn.Linear(d_model, (6 * depth + 2) * d_model)
        self.blocks = nn.ModuleList(DiTBlock(d_model) for _ in range(depth))
        self.out = nn.Linear(d_model, obs_dim + act_dim)
        is_factor = th.tensor([0.0, 1.0, 0.0] * (2 * depth) + [0.0, 1.0])[:, None]  # (6 * depth + 2, 1)
        self.register_buffer("is_factor", is_factor, persistent=False)
        # Periods of 4 to 1/16 of the diffusion time: smooth enough for few steps, fine enough near t = 0
        frequencies = 2 * math.pi * 2 ** th.linspace(-2.0, 4.0, N_TIME_FEATURES // 2)
        self.register_buffer("frequencies", frequencies, persistent=False)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        # adaLN-zero: every block is the identity and the output is 0 before training
        for layer in (self.modulation, self.out):
            nn.init.zeros_(layer.weight)
        self.register_buffer("positions", sinusoidal_positions(length, d_model), persistent=False)

    def modulations(self, t: th.Tensor) -> th.Tensor:
        """Return what the time changes in every layer: (n, 6 * depth + 2, d_model) float32.

        First of each block: shift, factor and gate of the attention, then of the MLP. Last: shift and factor of the
        output.

        :param t: (n,) float32 diffusion times
        """
        angles = t[:, None] * self.frequencies  # (n, N_TIME_FEATURES / 2)
        embedded = self.time_embedding(th.cat([angles.cos(), angles.sin()], dim=-1))  # (n, d_model)
        rows = self.modulation(F.silu(embedded)).unflatten(-1, (-1, self.d_model))
        return rows + self.is_factor  # adaLN-zero predicts factors minus 1. In float32, like the residual stream

    def context(self, window: th.Tensor, known: th.Tensor, guess: th.Tensor | None = None) -> th.Tensor:
        """Return what positions, known entries and the first guess add to the tokens: (B, L, d_model).

        :param window: (B, L, obs_dim + act_dim), normalised, L at most ``length``; only known entries are read
        :param known: (B, L, obs_dim + act_dim) bool known mask
        :param guess: (B, L, obs_dim + act_dim), needed by a network with ``first_guess``
        """
        # (B, L, 2): whether the state is known, and the action
        flags = th.stack((known[..., 0], known[..., self.obs_dim]), dim=-1).to(window.dtype)
        added = self.flag_embedding(flags) + self.positions[: window.shape[1]]
        if self.guess_embedding is not None:
            assert guess is not None
            states = guess[..., : self.obs_dim]  # their moves since the first are shown, too: states differ by little
            added = added + self.guess_embedding(th.cat([guess, states - states[:, :1]], dim=-1))
        if self.known_embedding is None:
            return added
        # Zeros stand for the steps that a window of a smaller delay does not have
        D, padding = self.max_delay, (0, 0, 0, self.max_delay)
        given, flags = F.pad(th.where(known, window, 0.0), padding), F.pad(flags, padding)
        states, actions = given[..., : self.obs_dim], given[..., self.obs_dim :]
        parts = [states[:, 0], actions[:, :D].flatten(1), flags[:, :D, 1]]
        if self.extra_states:
            parts.append(th.cat([states, flags[..., :1]], dim=-1)[:, 1 : D + 1].flatten(1))
        return added + self.known_embedding(th.cat(parts, dim=1))[:, None]

    def forward(
        self, x: th.Tensor, context: th.Tensor, modulations: th.Tensor, valid: th.Tensor | None = None
    ) -> th.Tensor:
        """Return the prediction for each entry: (B * N, L, obs_dim + act_dim).

        :param x: (B * N, L, obs_dim + act_dim) noisy windows, known entries clean; N successive ones share a context
        :param context: (B, L, d_model), from :meth:`context`
        :param modulations: (B * N, 6 * depth + 2, d_model), from :meth:`modulations`, or (6 * depth + 2, d_model)
            where all windows have one time
        :param valid: (B * N, L) bool, the tokens that may be attended to; all by default
        """
        tokens = self.token_embedding(x).unflatten(0, (len(context), -1)) + context[:, None]  # (B, N, L, d_model)
        tokens = tokens.flatten(0, 1)
        bias = None if valid is None else th.where(valid, 0.0, -th.inf)[:, None, None]  # (B * N, 1, 1, L)
        if modulations.dim() == 3:
            modulations = modulations.transpose(0, 1)[:, :, None]  # (6 * depth + 2, B * N, 1, d_model)
        parts = modulations.unbind()  # at once: the gradient of each slice would be as large as all modulations
        for i, block in enumerate(self.blocks):
            tokens = block(tokens, parts[6 * i : 6 * i + 6], bias)
        return self.out(_modulate(tokens, parts[-2], parts[-1]).to(self.out.weight.dtype))


def _mlp(n_in: int, d_model: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_in, d_model), nn.SiLU(), nn.Linear(d_model, d_model))
