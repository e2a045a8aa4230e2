"""A damped oscillator with a motor: its delayed present and its best plan are known in closed form."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch as th

from sb3_said.replay.windows import WindowSource

A = th.tensor([[1.0, 0.25], [-0.15, 0.9]])  # stable: |eigenvalues| = 0.97
B = th.tensor([[0.05], [0.3]])
Q, R = th.eye(2), 0.05 * th.eye(1)
BEHAVIOUR_GAIN, BEHAVIOUR_NOISE = th.tensor([[0.0, 0.2]]), 0.4  # a = -gain s + noise: weak and noisy
STATE_DIM, ACTION_DIM = 2, 1


@functools.cache
def riccati(n_iterations: int = 500) -> tuple[th.Tensor, th.Tensor]:
    """Return the gain K of the best policy a = -K s and the matrix P of its cost-to-go s' P s."""
    P = Q.clone()
    for _ in range(n_iterations):
        K = th.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    return K, P


def next_state(state: th.Tensor, action: th.Tensor) -> th.Tensor:
    return state @ A.T + action @ B.T


def cost(state: th.Tensor, action: th.Tensor) -> th.Tensor:
    return (state @ Q * state).sum(-1) + (action @ R * action).sum(-1)


def make_source(n_episodes: int = 400, length: int = 40, seed: int = 0, process_noise: float = 0.0) -> WindowSource:
    """Return windows of the behaviour policy; values are the best cost-to-go, negated.

    :param process_noise: standard deviation of what is added to each entry of every next state
    """
    generator = th.Generator().manual_seed(seed)
    state = th.randn(n_episodes, STATE_DIM, generator=generator)
    states, actions = [], []
    for _ in range(length):
        noise = BEHAVIOUR_NOISE * th.randn(n_episodes, ACTION_DIM, generator=generator)
        action = (noise - state @ BEHAVIOUR_GAIN.T).clamp(-1.0, 1.0)
        states.append(state)
        actions.append(action)
        state = next_state(state, action)
        if process_noise > 0:
            state = state + process_noise * th.randn(n_episodes, STATE_DIM, generator=generator)
    stacked = th.stack(states)  # (length, n_episodes, STATE_DIM): one row per step, one environment per episode
    value = -(stacked @ riccati()[1] * stacked).sum(-1)
    rows = th.arange(length).repeat_interleave(n_episodes)
    envs = th.arange(n_episodes).repeat(length)
    return WindowSource(
        states=stacked,
        actions=th.stack(actions),
        rewards=th.zeros(length, n_episodes),
        terminated=th.zeros(length, n_episodes, dtype=th.bool),
        rows=rows,
        envs=envs,
        remaining=length - rows,
        episodes=envs.clone(),
        values=value.flatten(),
    )


Policy = Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]


def delayed_cost(policy: Policy, max_delay: int, n_episodes: int = 200, length: int = 30, seed: int = 1) -> float:
    """Return the mean cost of an episode under a delay that grows to ``max_delay``, as after a reset.

    :param policy: maps (observation (B, 2), action_history (B, D, 1), delay (B,)) to actions (B, 1)
    """
    state = th.randn(n_episodes, STATE_DIM, generator=th.Generator().manual_seed(seed))
    states, total = [state], th.zeros(n_episodes)
    history = th.zeros(n_episodes, max_delay, ACTION_DIM)
    for t in range(length):
        delay = min(t, max_delay)
        action = policy(states[t - delay], history, th.full((n_episodes,), delay)).clamp(-1.0, 1.0)
        total += cost(states[t], action)
        states.append(next_state(states[t], action))
        history = th.cat([history, action[:, None]], dim=1)[:, 1:]
    return total.mean().item()


def present(observation: th.Tensor, history: th.Tensor, delay: th.Tensor) -> th.Tensor:
    """Return the true s_t that delayed observations and the actions since determine."""
    state = observation
    for action in history[:, history.shape[1] - int(delay[0]) :].unbind(1):
        state = next_state(state, action)
    return state
