"""A replay buffer that stores every true state once and rebuilds delayed observations by index arithmetic."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.delays.space import EXECUTED, UNDELAYED, WRAPPER_ORDER, check_spaces
from sb3_said.replay.checks import OWN_ENVIRONMENT, check_finite, check_order, true_states
from sb3_said.replay.stored import ROW_ARRAYS, check_stored
from sb3_said.replay.windows import Windows, WindowSource

UNCHANGED = 1e-3  # by how much a wrapper's float32 arithmetic may change an action in [-1, 1]
NORMALIZED_ROWS = 10_000  # at a time


def rows_for_logs(n_steps: int, max_delay: int) -> int:
    """Return how many rows logs need: more than they fill, since a full buffer does not sample its oldest rows."""
    return max(n_steps + 1, max_delay + 2)


class DelayedReplayBuffer(ReplayBuffer):
    """Replay of a delayed task, in the memory of an undelayed one.

    Each row holds s_t, a_t, r_t, done, timeout, the age of the observation at t and the step t within its episode.
    s_{t+1} is the next row's state. If no row continues the episode, s_{t+1} is kept aside (a *tail*). Sampling returns
    what a store of whole transitions would, bit for bit. In a delayed observation space, sampled observations have the
    extra key ``undelayed_observation``, the true state, for a delay-reconciled critic. They have no ``state_history``,
    which neither actor nor critics read.

    The stored action is the one that was executed: the newest of ``action_history``, or ``info["executed_action"]``
    where each action takes a time of its own to the actuator. So the critics' transitions are the task's own there,
    too. Rebuilt histories then hold the actions executed, not those sent; the two differ while delays change.

    :param buffer_size: transitions over all environments
    :param observation_space: that of ``DelayedObservationWrapper``, or a 1-D Box (delay 0)
    :param action_space: bounded 1-D Box
    :param device: of sampled tensors
    :param n_envs: parallel environments
    :param optimize_memory_usage: must be False; each state is stored once anyway
    :param handle_timeout_termination: bootstrap at time limits
    :param relabelled_ages: part of the sampled transitions, in [0, 1], that are shown as they would have been observed
        at another one's age. All true states are known, so an episode under one delay teaches the others too. Under
        one fixed delay nothing changes
    :raises ValueError: for other spaces, a part outside [0, 1], or when the buffer cannot hold more steps than the
        largest delay
    """

    next_observations: None  # type: ignore[assignment]  # rebuilt, never stored

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        relabelled_ages: float = 0.0,
    ):
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError("DelayedReplayBuffer stores each state once already; leave optimize_memory_usage=False.")
        self.optimize_memory_usage = False
        if not 0.0 <= relabelled_ages <= 1.0:
            raise ValueError(f"relabelled_ages is a part of the transitions in [0, 1], got {relabelled_ages}.")
        self.relabelled_ages = relabelled_ages
        self.handle_timeout_termination = handle_timeout_termination
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.is_delayed = isinstance(observation_space, spaces.Dict)
        state_space, _, self.max_delay = check_spaces(observation_space, action_space)
        if self.buffer_size <= self.max_delay + 1:
            raise ValueError(
                f"A buffer of {self.buffer_size} steps per environment cannot rebuild observations that are up to "
                f"{self.max_delay} steps old; use a buffer_size of at least {(self.max_delay + 2) * n_envs}."
            )
        shape = (self.buffer_size, n_envs)
        self.observations = np.zeros((*shape, state_space.shape[0]), np.float32)
        self.actions = np.zeros((*shape, self.action_dim), np.float32)
        self.rewards = np.zeros(shape, np.float32)
        self.dones = np.zeros(shape, np.float32)
        self.timeouts = np.zeros(shape, np.float32)
        self.ages = np.zeros(shape, np.int16)
        self.steps = np.zeros(shape, np.int32)
        # Rows that no stored row continues, and the (state, age) that follows each: its tail
        self.ends = np.zeros(shape, bool)
        self.tails: dict[tuple[int, int], tuple[np.ndarray, int]] = {}
        # What follows the newest row of each environment, and the observation that would continue its episode.
        self._next_states = np.zeros((n_envs, state_space.shape[0]), np.float32)
        self._next_ages = np.zeros(n_envs, np.int16)
        self._expected: dict[str, np.ndarray] | None = None
        self._has_warned_of_actions = False
        self.holds_logs = False  # steps that the agent was given and did not collect

    # ------------------------------------------------------------------------------------------------ writing

    def add(
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        next_obs: np.ndarray | dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one transition of every environment.

        :param obs: observation before the action, (n_envs, obs_dim) or the wrapper's dict
        :param next_obs: observation after the action; at an episode's end the last one, not the one after reset
        :param action: (n_envs, act_dim) in [-1, 1]
        :param infos: each with ``undelayed_observation`` when the space is delayed
        :raises ValueError: for what is not finite, a missing true state, a past of ``obs`` that is neither stored nor
            empty, a ``next_obs`` that is not one action later, or an observation that is not the state of its age;
            nothing is stored then
        """
        obs, next_obs = (x if isinstance(x, dict) else {"observation": x} for x in (obs, next_obs))
        row, previous = self.pos, (self.pos - 1) % self.buffer_size
        continues = self._continues(obs)
        next_states = next_obs["observation"]
        if self.is_delayed:
            next_states = true_states(infos, self._next_states.shape[1:])
        parts = {"reward": reward, "action": action, "observation after the action": next_states}
        if not continues.all():  # else it was checked as the observation after the last action
            parts["observation before the action"] = obs["observation"]
        check_finite(parts, self.n_envs)
        states = np.where(continues[:, None], self._next_states, obs["observation"])
        if self.is_delayed:
            check_order(obs, next_obs, continues, self._starts(obs))
            # Two kinds are not checked: VecNormalize clips an episode's last observation; where each action takes a
            # time of its own, ``delay`` counts actions.
            is_state = (np.asarray(done) == 0) & np.array([EXECUTED not in info for info in infos])
            self._check_shown(next_obs, states, next_states, is_state)
        timeouts = [bool(info.get("TimeLimit.truncated", False)) for info in infos]  # the flag may be an array of one
        started = np.flatnonzero(~continues)
        for env in np.flatnonzero(self.ends[row]).tolist():  # overwritten
            del self.tails[row, env]
        self.ends[row] = False
        if self.size() > 0:
            for env in started.tolist():
                self.tails[previous, env] = self._next_states[env].copy(), int(self._next_ages[env])
                self.ends[previous, env] = True

        self.observations[row] = states
        self.steps[row] = np.where(continues, self.steps[previous] + 1, 0)
        self.ages[row] = obs["delay"].reshape(self.n_envs) if self.is_delayed else 0
        sent = next_obs["action_history"][:, -1] if self.max_delay > 0 else action
        self.actions[row] = sent.reshape(self.n_envs, self.action_dim)
        self._check_sent(self.actions[row], action)
        if self.is_delayed:  # else the task itself may use that name
            for i, info in enumerate(infos):
                if EXECUTED in info:
                    self.actions[row, i] = info[EXECUTED]
        self.rewards[row] = reward
        self.dones[row] = done
        if self.handle_timeout_termination:
            self.timeouts[row] = timeouts

        self._next_states[:] = next_states
        self._next_ages[:] = next_obs["delay"].reshape(self.n_envs) if self.is_delayed else 0
        self._expected = {key: np.array(value) for key, value in next_obs.items()}

        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _continues(self, obs: dict[str, np.ndarray]) -> np.ndarray:
        """Tell for each environment whether ``obs`` goes on from the newest row: (n_envs,) bool."""
        if self._expected is None:
            return np.zeros(self.n_envs, bool)
        same = [
            np.all((obs[key] == self._expected[key]).reshape(self.n_envs, -1), axis=1) for key in self._expected
        ]  # False where training was interrupted and the environment was reset
        return np.logical_and.reduce(same) & (self.dones[self.pos - 1] == 0)

    def knows_past(self, obs: np.ndarray | dict[str, np.ndarray]) -> np.ndarray:
        """Tell for each environment whether ``obs`` follows the newest row or may begin an episode.

        :param obs: as in :meth:`add`
        :return: (n_envs,) bool
        """
        if not isinstance(obs, dict):
            return np.ones(self.n_envs, bool)
        return self._continues(obs) | self._starts(obs)

    def _starts(self, obs: dict[str, np.ndarray]) -> np.ndarray:
        """Tell for each environment whether ``obs`` can be the first of an episode: (n_envs,) bool."""
        past = (obs[key].reshape(self.n_envs, -1) for key in ("delay", "action_history"))
        return np.logical_and.reduce([np.all(part == 0, axis=1) for part in past])

    def _check_sent(self, sent: np.ndarray, action: np.ndarray) -> None:
        """Warn, once, if a history's newest action is not the one that the agent sent; both (n_envs, act_dim)."""
        off = float(np.abs(sent - np.reshape(action, sent.shape)).max())
        if off > UNCHANGED and not self._has_warned_of_actions:
            self._has_warned_of_actions = True
            warnings.warn(
                "A wrapper around DelayedObservationWrapper changes actions on their way: the history has others than "
                f"the agent sends, by up to {off:.3g} of [-1, 1]. {WRAPPER_ORDER}",
                stacklevel=3,
            )

    def _check_shown(
        self, next_obs: dict[str, np.ndarray], states: np.ndarray, next_states: np.ndarray, is_state: np.ndarray
    ) -> None:
        """Refuse an observation that is not the state of its age: sampling would show that state instead.

        :param states: (n_envs, obs_dim), true ones before the action; their row is not written yet
        :param next_states: (n_envs, obs_dim), true ones after it
        :param is_state: (n_envs,) bool, where the observation must be the state of its age
        :raises ValueError: naming the environment
        """
        ages = next_obs["delay"].reshape(self.n_envs).astype(np.int64)
        shown = self.observations[(self.pos + 1 - ages) % self.buffer_size, np.arange(self.n_envs)]
        shown[ages == 1], shown[ages == 0] = states[ages == 1], next_states[ages == 0]
        differs = np.any(shown != next_obs["observation"], axis=1) & is_state
        if differs.any():
            env = np.argmax(differs)
            raise ValueError(
                f"The observation of environment {env} has age {ages[env]}, but is not the state of {ages[env]} steps "
                f"before. {OWN_ENVIRONMENT} {WRAPPER_ORDER}"
            )

    def reset(self) -> None:
        """Forget everything stored."""
        super().reset()
        self.ends[:] = False
        self.tails.clear()
        self._expected = None
        self.holds_logs = False

    # ------------------------------------------------------------------------------------------------ sampling

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        """Sample transitions uniformly, except the few oldest whose past has been overwritten.

        :param batch_size: B
        :param env: normalises observations and rewards
        :raises ValueError: when the buffer is empty
        """
        if self.size() == 0:
            raise ValueError("The replay buffer is empty; add transitions before sampling.")
        rows = np.random.randint(0, self.size(), size=batch_size)
        while self.full and (stale := (rows - self.pos) % self.buffer_size < self.max_delay).any():
            rows[stale] = np.random.randint(0, self.size(), size=int(stale.sum()))
        return self._get_samples(rows, env=env)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> ReplayBufferSamples | DictReplayBufferSamples:
        rows, envs = batch_inds, np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        states = self.observations[rows, envs]  # (B, obs_dim)
        next_states, next_ages = self._successors(rows, envs)
        actions = self.actions[rows, envs]  # (B, act_dim)
        # Only the dones that are not due to time limits
        dones = (self.dones[rows, envs] * (1 - self.timeouts[rows, envs])).reshape(-1, 1)
        rewards = self._normalize_reward(self.rewards[rows, envs].reshape(-1, 1), env)
        if not self.is_delayed:
            data = (self.normalized(states, env), actions, self.normalized(next_states, env), dones, rewards)
            return ReplayBufferSamples(*map(self.to_torch, data))

        ages = self.ages[rows, envs]
        if self.relabelled_ages > 0.0:
            self._relabel(ages, next_ages, self.steps[rows, envs])
        history = self._histories(rows, envs)  # (B, D, act_dim)
        next_history = np.concatenate([history, actions[:, None]], axis=1)[:, 1:]
        past = self.observations[(rows + 1 - next_ages) % self.buffer_size, envs]  # (B, obs_dim)
        obs = {
            "observation": self.observations[(rows - ages) % self.buffer_size, envs],
            "action_history": history,
            "delay": ages[:, None].astype(np.float32),
        }
        next_obs = {
            "observation": np.where(next_ages[:, None] == 0, next_states, past),
            "action_history": next_history,
            "delay": next_ages[:, None].astype(np.float32),
        }
        return DictReplayBufferSamples(
            observations=self._to_observation(obs, states, env),
            actions=self.to_torch(actions),
            next_observations=self._to_observation(next_obs, next_states, env),
            dones=self.to_torch(dones),
            rewards=self.to_torch(rewards),
        )

    def to_torch(self, array: np.ndarray, copy: bool = False) -> th.Tensor:
        """Turn a gathered array into a tensor, without SB3's second copy: gathering has copied it already."""
        return super().to_torch(array, copy)

    def _successors(self, rows: np.ndarray, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s_{t+1} and its observation's age: (B, obs_dim), (B,)."""
        next_rows = (rows + 1) % self.buffer_size
        states, ages = self.observations[next_rows, envs], self.ages[next_rows, envs]
        for i in np.flatnonzero(self.ends[rows, envs]):
            states[i], ages[i] = self.tails[int(rows[i]), int(envs[i])]
        newest = rows == (self.pos - 1) % self.buffer_size
        states[newest], ages[newest] = self._next_states[envs[newest]], self._next_ages[envs[newest]]
        return states, ages

    def _relabel(self, ages: np.ndarray, next_ages: np.ndarray, steps: np.ndarray) -> None:
        """Give a part of the transitions the ages of others, in place, cut where these reach before their episode.

        A pair (age, next age) is given as one, so that ages change from step to step as they do in play. A transition
        that still shows s_0 gives none: only the episode's start keeps its age small. So a fixed delay stays as it is.

        :param ages: (B,)
        :param next_ages: (B,)
        :param steps: (B,) of each transition within its episode
        """
        takers = np.flatnonzero(np.random.random(len(ages)) < self.relabelled_ages)
        givers = np.flatnonzero(ages < steps)
        if givers.size:
            drawn = np.random.choice(givers, takers.size)
            ages[takers] = np.minimum(ages[drawn], steps[takers])
            next_ages[takers] = np.minimum(next_ages[drawn], steps[takers] + 1)

    def _histories(self, rows: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """Return the actions a_{t-D..t-1}, zeros before the episode: (B, D, act_dim)."""
        back = np.arange(self.max_delay, 0, -1)  # (D,)
        actions = self.actions[(rows[:, None] - back) % self.buffer_size, envs[:, None]]  # (B, D, act_dim)
        actions[back > self.steps[rows, envs][:, None]] = 0.0
        return actions

    def _to_observation(
        self, obs: dict[str, np.ndarray], states: np.ndarray, env: VecNormalize | None
    ) -> dict[str, th.Tensor]:
        scaled = {"observation": self.normalized(obs["observation"], env), UNDELAYED: self.normalized(states, env)}
        return {key: self.to_torch(value) for key, value in {**obs, **scaled}.items()}

    # ------------------------------------------------------------------------------------------------ windows

    def window_source(
        self, newest_fraction: float = 1.0, env: VecNormalize | None = None, older: bool = False
    ) -> WindowSource:
        """Return every place a planner's window can start, over this buffer's own arrays, all of value 0.

        The buffer must not grow while the source is in use.

        :param newest_fraction: use only the newest part of the buffer (the paper's 20 % is 0.2), in (0, 1]
        :param env: normalises states as it does the expert's observations
        :param older: use the steps before that part instead; an episode that runs on into it is cut there
        :raises ValueError: when the buffer or the part is empty, or the fraction is not in (0, 1]
        """
        if not 0.0 < newest_fraction <= 1.0:
            raise ValueError(f"newest_fraction is a part of the buffer in (0, 1], got {newest_fraction}.")
        if self.size() == 0:
            raise ValueError("The replay buffer is empty; call learn() first, or load_replay_buffer() after load().")
        n_newest = max(int(self.size() * newest_fraction), 1)
        n_rows = self.size() - n_newest if older else n_newest
        if n_rows == 0:
            raise ValueError(f"No step is older than the newest part, {newest_fraction:g} of {self.size()} steps.")
        rows = (self.pos - n_newest - n_rows * older + np.arange(n_rows)) % self.buffer_size  # (T,), oldest first
        ends = self.ends[rows]  # (T, n_envs), a copy
        ends[-1] = True
        last = np.where(ends, np.arange(n_rows)[:, None], n_rows)
        last = np.minimum.accumulate(last[::-1], axis=0)[::-1]  # (T, n_envs): where each episode ends

        states = self.observations if env is None else self._normalized_rows(rows, env)
        grid = np.broadcast_to(rows[:, None], ends.shape), np.broadcast_to(np.arange(self.n_envs), ends.shape)
        remaining = last - np.arange(n_rows)[:, None] + 1
        episodes = last + np.arange(self.n_envs) * n_rows  # unique for each environment and end
        ages = () if self.holds_logs else (self.ages[rows].astype(np.int64),)  # a log knows none
        per_start = (*grid, remaining, episodes, np.zeros(ends.shape, np.float32), *ages)
        return WindowSource(
            th.from_numpy(states),
            th.from_numpy(self.actions),
            th.from_numpy(self.rewards),
            th.from_numpy((self.dones > 0) & (self.timeouts == 0)),
            *(th.from_numpy(x.flatten()) for x in per_start),  # a copy: the grid is read-only
        )

    def _normalized_rows(self, rows: np.ndarray, env: VecNormalize) -> np.ndarray:
        """Return an array of the shape of ``observations`` with these rows normalised; only they take memory."""
        states = np.zeros(self.observations.shape, np.float32)  # memory that is never touched is not taken
        for part in np.array_split(rows, -(-len(rows) // NORMALIZED_ROWS)):  # in parts, since it goes through float64
            states[part] = self.normalized(self.observations[part], env)
        return states

    def normalized(self, states: np.ndarray, env: VecNormalize | None) -> np.ndarray:
        """Return states (..., obs_dim) as ``env`` normalises observations; without it, as they are."""
        if env is None:
            return states
        obs: Any = env.normalize_obs({"observation": states} if self.is_delayed else states)
        return obs["observation"] if self.is_delayed else obs

    def sample_windows(self, batch_size: int, length: int, generator: th.Generator | None = None) -> Windows:
        """Sample planner windows uniformly over all stored steps.

        :param batch_size: B
        :param length: L
        :param generator: CPU generator; torch's global one by default
        """
        return self.window_source().sample(batch_size, length, generator)

    # ------------------------------------------------------------------------------------------------ saving

    def state_dict(self) -> dict[str, Any]:
        """Return everything stored, as arrays and numbers; unused rows are left out.

        The arrays are this buffer's own memory: write them out, or copy them, before you add more.
        """
        return {
            "holds_logs": self.holds_logs,
            "pos": self.pos,
            "full": self.full,
            "expected": self._expected,
            "next_states": self._next_states,
            "next_ages": self._next_ages,
            "tail_places": np.array([*self.tails], np.int64).reshape(-1, 2),
            "tail_states": np.array([x for x, _ in self.tails.values()], np.float32).reshape(
                -1, self.observations.shape[2]
            ),
            "tail_ages": np.array([age for _, age in self.tails.values()], np.int16),
            **{name: getattr(self, name)[: self.size()] for name in ROW_ARRAYS},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; nothing changes unless all of it fits.

        :raises ValueError: when it came from a buffer of another shape, or holds what no buffer stores
        """
        size = len(state["rewards"])
        check_stored(self, state)
        self.holds_logs = state["holds_logs"]
        self.pos, self.full, self._expected = state["pos"], state["full"], state["expected"]
        self._next_states, self._next_ages = state["next_states"].copy(), state["next_ages"].copy()
        places = map(tuple, state["tail_places"].tolist())
        self.tails = dict(
            zip(places, zip(state["tail_states"].copy(), state["tail_ages"].tolist(), strict=True), strict=True)
        )
        for name in ROW_ARRAYS:
            getattr(self, name)[:size] = state[name]
        self.ends[size:] = False  # of what was stored before
