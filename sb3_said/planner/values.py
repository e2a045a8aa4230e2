"""Discounted values of stored steps, for trajectory weights."""

from __future__ import annotations

import numpy as np


def discounted_values(
    rewards: np.ndarray, terminated: np.ndarray, ends: np.ndarray, tail_values: np.ndarray, gamma: float
) -> np.ndarray:
    """Return the discounted return-to-go of every step, bootstrapped where an episode was cut off.

    At a termination the return is the reward alone. At any other end of an episode (time limit, interruption, newest
    step) it is ``tail_values``: without this, states near a time limit look worthless although nothing is wrong with
    them.

    :param rewards: (T, n_envs), in the order of time
    :param terminated: (T, n_envs) bool, true episode ends
    :param ends: (T, n_envs) bool, the last stored step of each episode, terminated or not; true in the last row
    :param tail_values: (T, n_envs), value of taking the stored action where an episode was cut off; read only there
    :param gamma: discount factor
    :return: (T, n_envs) float32
    """
    values = np.empty_like(rewards, dtype=np.float32)
    following = np.zeros(rewards.shape[1], dtype=np.float64)
    for t in range(len(rewards) - 1, -1, -1):
        last = np.where(terminated[t], rewards[t], tail_values[t])
        following = np.where(ends[t], last, rewards[t] + gamma * following)
        values[t] = following
    return values


def average_reward_tail(rewards: np.ndarray, ends: np.ndarray, gamma: float) -> np.ndarray:
    """Bootstrap where no critic is at hand: as if each episode went on at its own average reward.

    :param rewards: (T, n_envs)
    :param ends: (T, n_envs) bool, the last stored step of each episode; true in the last row
    :param gamma: discount factor
    :return: (T, n_envs), read only where ``ends``
    :raises ValueError: for gamma = 1, where going on for ever is worth no finite value
    """
    if gamma >= 1.0:
        raise ValueError(f"An episode that goes on has a finite value only with gamma < 1, got gamma={gamma}.")
    tails = np.zeros_like(rewards, dtype=np.float32)
    for env in range(rewards.shape[1]):
        last = np.flatnonzero(ends[:, env])
        first = np.concatenate([[0], last[:-1] + 1])
        sums = np.add.reduceat(rewards[:, env], first) if len(last) else np.zeros(0)
        tails[last, env] = sums / (last - first + 1) / (1.0 - gamma)
    return tails


def normalise_values(values: np.ndarray) -> np.ndarray:
    """Map values to [0, 1] by their minimum and maximum, as w = exp(beta (V - 1)) expects.

    :param values: any shape; constant values become ones, so that every weight is one
    """
    low, high = float(values.min()), float(values.max())
    if high == low:
        return np.ones_like(values)
    return (values - low) / (high - low)
