"""What of a window is known: the delayed observation and the actions sent since (the paper's section on SAID)."""

from __future__ import annotations

import torch as th
import torch.nn.functional as F

MASKS = ("random", "fixed")


def known_mask(delay: th.Tensor, length: int, obs_dim: int, act_dim: int) -> th.Tensor:
    """Return the known mask: (B, L, obs_dim + act_dim) bool, the state at index 0 and the actions at 0..d-1.

    :param delay: (B,) int64 observation delays d, each in 0..L
    :param length: L, steps of a window
    """
    steps = th.arange(length, device=delay.device)
    state_known = (steps == 0).expand(len(delay), -1)  # (B, L)
    action_known = steps < delay[:, None]  # (B, L)
    return th.cat([state_known[..., None].expand(-1, -1, obs_dim), action_known[..., None].expand(-1, -1, act_dim)], -1)


def known_window(observation: th.Tensor, action_history: th.Tensor, delay: th.Tensor, length: int) -> th.Tensor:
    """Write the known entries into their places: (B, L, obs_dim + act_dim), unknown entries are 0.

    :param observation: (B, obs_dim) delayed observation s_{t-d}
    :param action_history: (B, D, act_dim), the D newest actions, oldest first; D may be 0
    :param delay: (B,) int64 observation delays d, each in 0..D
    :param length: L >= D, steps of a window
    """
    _, max_delay, act_dim = action_history.shape
    states = F.pad(observation[:, None], (0, 0, 0, length - 1))  # (B, L, obs_dim)
    # Of a delay d the d newest actions are known, from D - d on; zeros behind the newest fill the unknown places
    padded = F.pad(action_history, (0, 0, 0, length))  # (B, D + L, act_dim)
    index = max_delay - delay[:, None] + th.arange(length, device=delay.device)  # (B, L)
    actions = padded.gather(1, index[..., None].expand(-1, -1, act_dim))  # (B, L, act_dim)
    return th.cat([states, actions], dim=-1)


def draw_delays(
    batch_size: int,
    max_delay: int,
    mask: str = "random",
    end_probability: float = 0.0,
    generator: th.Generator | None = None,
    device: th.device | str = "cpu",
) -> th.Tensor:
    """Draw the mask lengths of a training batch: (B,) int64 in 0..D.

    :param mask: ``"random"``: one network for every delay up to D; ``"fixed"``: always D (the paper's)
    :param end_probability: with this probability a random length is 0 or D, half each, instead of uniform over 0..D:
        0 starts every episode and D is the longest and hardest
    :raises ValueError: for an unknown mask
    """
    if mask not in MASKS:
        raise ValueError(f"mask is {mask!r}, expected one of {MASKS}.")
    if mask == "fixed":
        return th.full((batch_size,), max_delay, device=device)
    source = "cpu" if generator is None else generator.device
    uniform = th.randint(max_delay + 1, (batch_size,), generator=generator, device=source)
    ends = max_delay * th.randint(2, (batch_size,), generator=generator, device=source)
    at_end = th.rand(batch_size, generator=generator, device=source) < end_probability
    return th.where(at_end, ends, uniform).to(device)
