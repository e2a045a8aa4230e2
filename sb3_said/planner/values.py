"""The weight of a training window: an exponential of the scaled return to go of its first state."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

from sb3_said.replay.windows import WindowSource

VALUE_SCALES = ("rank", "range", "centred")


def returns_to_go(
    source: WindowSource,
    gamma: float,
    terminal_penalty: float | None = None,
    value_fn: Callable[[th.Tensor, th.Tensor], th.Tensor] | None = None,
) -> th.Tensor:
    """Return the discounted return to go of every start, bootstrapped where its episode was cut off.

    Without the bootstrap, states near a time limit would look worthless although nothing is wrong with them.

    :param source: M starts
    :param gamma: discount factor
    :param terminal_penalty: replaces the reward of a terminating step (paper, Table 3); None keeps it
    :param value_fn: (states (K, obs_dim), actions (K, act_dim)) -> (K,), the value of the last stored step of an
        episode that was cut off. Without it such an episode is taken to go on at its average reward. In the average of
        an episode shorter than the horizon 1 / (1 - gamma), the mean reward of all steps that do not terminate stands
        for the missing ones: few steps tell little
    :return: (M,) float32
    :raises ValueError: for gamma = 1 without ``value_fn`` where an episode was cut off: it has no finite value
    """
    rewards = source.rewards[source.rows, source.envs].clone()  # (M,)
    terminated, last = source.terminated[source.rows, source.envs], source.remaining == 1
    cut = last & ~terminated
    if terminal_penalty is not None:
        rewards[terminated] = terminal_penalty
    if value_fn is not None:
        rewards[cut] = value_fn(source.start_states()[cut], source.start_actions()[cut]).float()
    elif gamma < 1.0:
        _, episode = source.episodes.unique(return_inverse=True)
        length, horizon = episode.bincount(), 1.0 / (1.0 - gamma)
        lacking = (horizon - length).clamp(min=0.0)
        sums = rewards.new_zeros(len(length)).index_add(0, episode, rewards) + lacking * rewards[~terminated].mean()
        rewards[cut] = (sums / (length + lacking))[episode[cut]] * horizon
    elif cut.any():
        raise ValueError(
            f"An episode that goes on has a finite value only with gamma < 1, got gamma={gamma}: give a smaller "
            "one. (Of an expert's own steps its critics tell what they are worth, with any gamma.)"
        )

    order = (source.episodes * (int(source.remaining.max()) + 1) + source.remaining).argsort()  # newest step first
    value, values = 0.0, []
    for reward, is_last in zip(rewards[order].tolist(), last[order].tolist(), strict=True):
        value = reward if is_last else reward + gamma * value
        values.append(value)
    returns = th.empty(len(source), device=rewards.device)
    returns[order] = th.tensor(values)
    return returns


def scaled_values(values: th.Tensor, scale: str) -> th.Tensor:
    """Map values to V of the weight exp(beta (V - 1)), which is at most 1.

    :param values: (M,)
    :param scale: ``"rank"``, the part of the others that lie below a value, equal ones counted half; ``"range"``, the
        place between the lowest and the highest, in [0, 1]; ``"centred"``, the same place in [-1, 1], as in the code
        under the paper's results (DV), so that beta counts twice as much. The last two give 1 where all are equal
    """
    if scale != "rank":
        low, high = values.min(), values.max()
        place = th.ones_like(values) if low == high else (values - low) / (high - low)
        return 2.0 * place - 1.0 if scale == "centred" else place
    ordered = values.sort().values
    below, up_to = th.searchsorted(ordered, values), th.searchsorted(ordered, values, right=True)  # (M,)
    return (below + up_to - 1) / (2 * max(1, len(values) - 1))


def window_weight(values: th.Tensor, weight_factor: float) -> th.Tensor:
    """Return exp(beta (V - 1)), the weight of a window whose first state has the scaled value V (paper, Appendix B.4).

    :param values: (B,) V, of :func:`scaled_values`
    :param weight_factor: beta; 0 weighs all windows alike
    """
    return th.exp(weight_factor * (values - 1.0))
