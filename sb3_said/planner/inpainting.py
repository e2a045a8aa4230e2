"""What of a window is known: the delayed observation and the actions sent since (the paper's section on SAID).

Observations that arrive late or out of order are known too: any of the states s_{t-D+1..t}. Those younger than s_{t-d}
lie at indices 1..d of the window. Older ones are dropped: given s_{t-d}, they add nothing (Markov property).
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F


def known_mask(
    delay: th.Tensor, length: int, obs_dim: int, act_dim: int, state_known: th.Tensor | None = None
) -> th.Tensor:
    """Return the known mask: (B, L, obs_dim + act_dim) bool, the state at index 0 and the actions at 0..d-1.

    :param delay: (B,) int64 observation delays d, each in 0..L
    :param length: L, steps of a window
    :param state_known: (B, D) bool, which of the states s_{t-D+1..t} are known too; none by default
    """
    steps = th.arange(length, device=delay.device)
    known_states = (steps == 0).expand(len(delay), -1)  # (B, L)
    if state_known is not None:
        known_states = th.cat([known_states[:, :1], newest(state_known[..., None], delay, length - 1)[..., 0]], dim=1)
    known_actions = steps < delay[:, None]  # (B, L)
    return th.cat(
        [known_states[..., None].expand(-1, -1, obs_dim), known_actions[..., None].expand(-1, -1, act_dim)], dim=-1
    )


def known_window(
    observation: th.Tensor,
    action_history: th.Tensor,
    delay: th.Tensor,
    length: int,
    state_history: th.Tensor | None = None,
) -> th.Tensor:
    """Write the known entries into their places: (B, L, obs_dim + act_dim).

    Unknown entries are 0, or what the state history has in their places.

    :param observation: (B, obs_dim) delayed observation s_{t-d}
    :param action_history: (B, D, act_dim), the D newest actions, oldest first; D may be 0
    :param delay: (B,) int64 observation delays d, each in 0..D
    :param length: L, steps of a window, more than any of the delays
    :param state_history: (B, D, obs_dim), the states s_{t-D+1..t} as far as known, each in the row of the action that
        led to it; none by default
    """
    if state_history is None:
        states = F.pad(observation[:, None], (0, 0, 0, length - 1))  # (B, L, obs_dim)
    else:
        states = th.cat([observation[:, None], newest(state_history, delay, length - 1)], dim=1)
    return th.cat([states, newest(action_history, delay, length)], dim=-1)


def newest(history: th.Tensor, delay: th.Tensor, length: int) -> th.Tensor:
    """Return the d newest rows of a history, and zeros behind them: (B, length, n).

    :param history: (B, D, n), oldest first
    :param delay: (B,) int64, d
    """
    padded = F.pad(history, (0, 0, 0, length))  # (B, D + length, n)
    index = history.shape[1] - delay[:, None] + th.arange(length, device=delay.device)  # (B, length)
    return padded.gather(1, index[..., None].expand(-1, -1, history.shape[2]))


def draw_delays(
    batch_size: int,
    max_delay: int,
    mask: str = "random",
    end_probability: float = 0.0,
    generator: th.Generator | None = None,
) -> th.Tensor:
    """Draw the mask lengths of a training batch on the generator's device: (B,) int64 in 0..D.

    :param mask: ``"random"`` or ``"own"``: any of 0..D, so that one network serves every delay; ``"fixed"``: always D
        (the paper's); ``"none"``: always 0
    :param end_probability: with this probability a random length is 0 or D, half each, instead of uniform over 0..D:
        every episode starts with 0, and D is the hardest
    """
    device = "cpu" if generator is None else generator.device
    if mask in ("fixed", "none"):
        return th.full((batch_size,), max_delay if mask == "fixed" else 0, device=device)
    uniform = th.randint(max_delay + 1, (batch_size,), generator=generator, device=device)
    ends = max_delay * th.randint(2, (batch_size,), generator=generator, device=device)
    at_end = th.rand(batch_size, generator=generator, device=device) < end_probability
    return th.where(at_end, ends, uniform)


def draw_known_states(
    batch_size: int, max_delay: int, probability: float, generator: th.Generator | None = None
) -> th.Tensor:
    """Draw which of the states s_{t-D+1..t} a training batch shows, on the generator's device: (B, D) bool.

    A window that shows any draws its own share of them, uniform in [0, 1]. So every number of them is as likely.

    :param probability: that a window shows any
    """
    device = "cpu" if generator is None else generator.device
    shows_any = th.rand(batch_size, 1, generator=generator, device=device) < probability
    share = th.rand(batch_size, 1, generator=generator, device=device)
    known = th.rand(batch_size, max_delay, generator=generator, device=device) < share
    return known & shows_any
