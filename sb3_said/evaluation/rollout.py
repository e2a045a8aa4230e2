"""Whole episodes from seeded resets, with batched decisions, and the time decisions take."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from sb3_said.evaluation.statistics import Latency, Summary

if TYPE_CHECKING:
    from stable_baselines3.common.type_aliases import PolicyPredictor

Observation = Any  # one array, or a dict of arrays; batched with a leading axis where a docstring says (B, ...)
EnvMaker = str | Callable[[], gym.Env[Any, Any]]
State = tuple[np.ndarray, ...] | None

LONG = 10_000  # steps of an episode that may have no end, ten times those of MuJoCo's tasks


@dataclass(frozen=True)
class Rollout:
    """What ``rollout`` measured."""

    returns: np.ndarray
    """(n_episodes,) float64, sum of the rewards, in the order of the reset seeds. With an SB3 ``Monitor``, the rewards
    below it count, which are the task's own"""
    lengths: np.ndarray
    """(n_episodes,) int64, in control steps"""
    terminated: np.ndarray
    """(n_episodes,) bool, whether the task ended the episode (in MuJoCo by a fall), not a time limit"""
    action_changes: np.ndarray
    """(n_episodes,) float64, mean |a_t - a_{t-1}| over steps and entries, in halves of the action space's range"""
    successes: np.ndarray | None
    """(n_episodes,) bool, ``info["is_success"]`` at each episode's end; None if the task does not tell it"""

    def summary(self, label: str, latency: Latency | None = None) -> Summary:
        """Return a row of an evaluation.

        :param label: who answered
        :param latency: of single decisions, if it was measured
        """
        measured = latency, self.terminated, self.action_changes, self.successes
        return Summary.from_episodes(label, self.returns, self.lengths, *measured)


def rollout(
    model: PolicyPredictor,
    env: EnvMaker,
    n_episodes: int,
    seed: int,
    n_envs: int = 1,
    deterministic: bool = True,
    normalize: Callable[[Observation], Observation] | None = None,
    on_step: Callable[[gym.Env[Any, Any]], None] | None = None,
    on_episode: Callable[[int, float, int], None] | None = None,
) -> Rollout:
    """Play whole episodes; episode i starts from ``reset(seed=seed + i)``.

    The environments step in lock-step, so that one call of ``predict`` decides for all of them. The next episode goes
    to the first environment that is free; an environment without a further episode leaves the batch. Hence exactly
    ``n_episodes`` episodes count, and short ones are not over-represented. Returns do not depend on ``n_envs`` as long
    as ``predict`` answers each row by itself (batched arithmetic may still differ in the last bits). An episode is
    played to its end, however long; one of ``LONG`` steps is warned of.

    :param model: anything with the ``predict`` of Stable-Baselines3
    :param env: an environment id, or a function that makes an environment
    :param n_episodes: >= 1
    :param seed: reset seed of episode 0; take seeds that training and tuning never saw
    :param n_envs: environments in lock-step, >= 1; the largest batch that ``predict`` gets
    :param deterministic: handed to ``predict``
    :param normalize: applied to batched observations before ``predict``, such as ``VecNormalize.normalize_obs``
    :param on_step: called with the environment after every step, for instance to render it
    :param on_episode: called with (episode, return, length) after every episode, in the order in which they end
    :raises ValueError: when ``n_episodes`` or ``n_envs`` is not positive, ``env`` returns one environment twice, a
        return is not finite, or ``normalize`` is missing for a model that learned with ``VecNormalize``
    """
    if n_episodes < 1 or n_envs < 1:
        raise ValueError(f"n_episodes and n_envs must be at least 1, got n_episodes={n_episodes}, n_envs={n_envs}.")
    normalize = normalize or _as_they_are(model)
    returns, lengths = np.zeros(n_episodes), np.zeros(n_episodes, np.int64)
    ended, changes = np.zeros(n_episodes, bool), np.zeros(n_episodes)
    before: dict[int, np.ndarray] = {}  # the last action of each episode that is played
    successes: list[bool | None] = [None] * n_episodes
    envs = _make_all(env, min(n_envs, n_episodes))
    half_range = _half_range(envs[0].action_space)
    try:
        playing = [(e, episode, e.reset(seed=seed + episode)[0]) for episode, e in enumerate(envs)]
        next_episode = len(playing)
        state: State = None
        while playing:
            batch = _stack([observation for _, _, observation in playing])
            batch = normalize(batch)
            episode_start = np.array([lengths[episode] == 0 for _, episode, _ in playing])

            actions, state = model.predict(batch, state=state, episode_start=episode_start, deterministic=deterministic)

            going_on = {}  # by the row in this batch
            for row, (e, episode, _) in enumerate(playing):
                observation, reward, terminated, truncated, info = e.step(actions[row])
                returns[episode] += float(reward)
                lengths[episode] += 1
                ended[episode] = terminated
                action = np.array(actions[row], np.float64)  # a copy: a model may write all its answers into one array
                changes[episode] += np.mean(np.abs(action - before.get(episode, action)) / half_range)
                before[episode] = action
                if not (terminated or truncated):
                    warn_if_long(lengths[episode], episode)
                if on_step is not None:
                    on_step(e)
                if terminated or truncated:
                    successes[episode] = info.get("is_success")
                    returns[episode] = _monitored(e, returns[episode])
                    if not np.isfinite(returns[episode]):
                        raise ValueError(
                            f"Episode {episode} (seed {seed + episode}) returned {returns[episode]}: expected finite "
                            "rewards; look at what the task rewards there."
                        )
                    if on_episode is not None:
                        on_episode(episode, float(returns[episode]), int(lengths[episode]))
                    if next_episode == n_episodes:
                        continue
                    episode, next_episode = next_episode, next_episode + 1
                    observation, _ = e.reset(seed=seed + episode)
                going_on[row] = (e, episode, observation)
            if len(going_on) < len(playing):
                state = _keep_rows(model, state, list(going_on))
            playing = list(going_on.values())
    finally:
        for e in envs:
            e.close()
    changes /= np.maximum(lengths - 1, 1)
    return Rollout(returns, lengths, ended, changes, None if None in successes else np.array(successes, bool))


def warn_if_long(steps: int, episode: int | None = None) -> None:
    """Warn once of an episode that may never end, ``LONG`` steps after its start.

    :param steps: how many it has lasted so far
    :param episode: its number, where it has one
    """
    if steps == LONG:
        which = "An episode" if episode is None else f"Episode {episode}"
        warnings.warn(
            f"{which} has not ended after {LONG:,} steps, and is waited for. If it need never end, register the "
            "task with max_episode_steps, or train it with --env-kwargs max_episode_steps:1000.",
            stacklevel=3,
        )


def collect_observations(env: EnvMaker, n_observations: int, seed: int) -> Observation:
    """Gather observations along random actions, for timing decisions.

    :param env: an environment id, or a function that makes an environment
    :param n_observations: how many, >= 1
    :param seed: of the resets and the actions
    :return: (n_observations, ...), a dict of such arrays for a dict space
    """
    made = _make(env)
    made.action_space.seed(seed)
    observation, _ = made.reset(seed=seed)
    observations = [observation]
    while len(observations) < n_observations:
        observation, _, terminated, truncated, _ = made.step(made.action_space.sample())
        if terminated or truncated:
            observation, _ = made.reset()
        observations.append(observation)
    made.close()
    return _stack(observations)


def measure_latency(
    model: PolicyPredictor,
    observations: Observation,
    n_calls: int = 200,
    deterministic: bool = True,
    normalize: Callable[[Observation], Observation] | None = None,
) -> Latency:
    """Time single decisions, from a NumPy observation to a NumPy action, as a control loop asks for them.

    ``model.warmup()`` runs first, or one call of ``predict`` where a model has no ``warmup``. Every call after that
    counts, slow ones included, and gets the state that the call before it returned.

    :param model: anything with the ``predict`` of Stable-Baselines3
    :param observations: (M, ...), or a dict of such arrays; call i gets observation i mod M
    :param n_calls: >= 1
    :param deterministic: handed to ``predict``
    :param normalize: applied to observations (1, ...) inside the measured time
    :raises ValueError: when ``n_calls`` is not positive
    """
    if n_calls < 1:
        raise ValueError(f"n_calls must be at least 1, got {n_calls}.")
    first = -1
    if hasattr(model, "warmup"):
        model.warmup()
        first = 0
    n_observations = len(next(iter(observations.values())) if isinstance(observations, dict) else observations)
    seconds = []
    state: State = None
    for call in range(first, n_calls):
        observation = _row(observations, call % n_observations)
        began = time.perf_counter()
        if normalize is not None:
            observation = normalize(observation)
        _, state = model.predict(
            observation, state=state, episode_start=np.array([call == first]), deterministic=deterministic
        )
        seconds.append(time.perf_counter() - began)
    return Latency.from_seconds(seconds[-n_calls:])


def _make(env: EnvMaker) -> gym.Env[Any, Any]:
    return gym.make(env) if isinstance(env, str) else env()


def _make_all(env: EnvMaker, n_envs: int) -> list[gym.Env[Any, Any]]:
    envs = [_make(env) for _ in range(n_envs)]
    if len({id(one.unwrapped) for one in envs}) < n_envs:
        raise ValueError(f"env returned one environment twice, and {n_envs} play at once: make a new one at each call.")
    return envs


def _as_they_are(model: PolicyPredictor) -> Callable[[Observation], Observation]:
    if getattr(model, "reads_normalized", False):
        raise ValueError("This model learned with VecNormalize: give rollout(..., normalize=venv.normalize_obs).")
    return lambda observation: observation


def _monitored(env: gym.Env[Any, Any], counted: float) -> float:
    """Return what a Monitor counted, below wrappers that change rewards or end episodes; without one, ``counted``."""
    from stable_baselines3.common.env_util import unwrap_wrapper
    from stable_baselines3.common.monitor import Monitor  # at the top, this would import torch

    monitor = unwrap_wrapper(env, Monitor)
    return sum(monitor.rewards) if isinstance(monitor, Monitor) else counted


def _half_range(space: gym.Space[Any]) -> np.ndarray:
    """Return half the distance between a Box's bounds, and 1 where it is 0 or infinite, and for other spaces."""
    if not isinstance(space, gym.spaces.Box):
        return np.ones(())
    half = space.high.astype(np.float64) / 2 - space.low.astype(np.float64) / 2
    return np.where(np.isfinite(half) & (half > 0), half, 1.0)


def _row(observations: Observation, row: int) -> Observation:
    """Cut one observation (1, ...) out of a batch."""
    if isinstance(observations, dict):
        return {key: values[[row]] for key, values in observations.items()}
    return observations[[row]]


def _stack(observations: list[Observation]) -> Observation:
    if isinstance(observations[0], dict):
        return {key: np.stack([o[key] for o in observations]) for key in observations[0]}
    return np.stack(observations)


def _keep_rows(model: PolicyPredictor, state: State, rows: list[int]) -> State:
    """Keep the rows of the environments that go on; in sb3_contrib's recurrent states they are on axis 1."""
    if state is None:
        return None
    axis = 1 if hasattr(getattr(model, "policy", None), "lstm_actor") else 0
    return tuple(np.take(array, rows, axis=axis) for array in state)
