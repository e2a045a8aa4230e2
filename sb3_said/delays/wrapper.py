"""The delayed world: a Gymnasium wrapper that hands out old observations and the actions sent since."""

from __future__ import annotations

from collections import deque
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_said.delays.actuator import Actuator
from sb3_said.delays.combined import TotalDelay
from sb3_said.delays.processes import DelayProcess, age_range, check_count, make_process
from sb3_said.delays.receivers import RECEIVERS

#: Keeps the delays' random numbers apart from those that the task draws from the same seed.
DELAY_STREAM = 1


class DelayedObservationWrapper(
    gym.Wrapper[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray], gym.utils.RecordConstructorArgs
):
    """Delay a task's observations and actions by some control steps; rewards and episode ends stay undelayed.

    The observation becomes a dict of float32 arrays:

    - ``observation`` (obs_dim,): s_{t-age}, the newest observation that has arrived;
    - ``action_history`` (D, act_dim): the D newest actions a_{t-D..t-1}, oldest first, scaled to [-1, 1] from the
      bounds of the action space, zeros before the episode;
    - ``delay`` (1,): how many of these do not show in ``observation`` yet: its age in control steps, plus those that
      actions take.

    With ``state_history=True`` also what an agent that remembers would have, in the rows of the actions that led there:

    - ``state_history`` (D, obs_dim): the states s_{t-D+1..t}, oldest first, zeros where unknown;
    - ``state_known`` (D,): 1 for each of these that was handed out as ``observation`` so far in the episode, else 0.

    At reset s_0 arrives with age 0, and ages while it is all that has arrived, so an episode starts as a task with a
    smaller delay. ``info["undelayed_observation"]`` is the true state after the step, for replay and diagnosis only;
    ``info["forced_deliveries"]`` counts the packets of the episode that were delivered only because the age would have
    exceeded the largest delay. Where every action takes a time of its own, ``info["executed_action"]`` is what the task
    was given, scaled like the history.

    ``gymnasium.wrappers.DelayObservation`` returns zeros before the first observation arrives, and neither the actions
    sent since nor the age, without which the process is not Markov (paper, Theorem 2.1).

    :param env: a task with a 1-D Box observation and a bounded Box action
    :param delay: d >= 0 control steps; or ``(low, high)``, drawn uniformly at every reset; or a delay process, also as
        text such as ``"UniformDelay(0, 8)"``
    :param action_delay: control steps from choosing an action to its execution, in the forms of ``delay``. The task
        starts when the first action arrives. One delay an episode: time is the actuator's, so the action is executed
        in the true state, and observations look older by as much. One for each action: the newest that has arrived is
        executed, and held until another arrives; ``delay`` counts the actions that do not show in ``observation``.
    :param max_delay: D, length of the action history; the largest delay by default. A larger one serves a model that
        was built for it.
    :param receiver: ``"newest"`` keeps the newest packet that has arrived; ``"independent"`` reads an age drawn anew at
        every step (paper, section 2); of observations, and of actions that take a time each
    :param state_history: see above; under ``"independent"`` states younger than ``observation`` may be known, under
        ``"newest"`` none are. Not where every action takes a time of its own: rows of sent actions are no steps of the
        task there
    :raises ValueError: for other spaces, a bad delay, an unknown receiver, a ``max_delay`` below the largest delay, or
        a ``state_history`` where every action takes a time of its own

    >>> env = DelayedObservationWrapper(gym.make("Pendulum-v1"), delay=2)
    >>> obs, info = env.reset(seed=0)
    >>> for _ in range(3):
    ...     obs, reward, terminated, truncated, info = env.step(np.array([1.0], dtype=np.float32))
    >>> obs["delay"], obs["action_history"].ravel()
    (array([2.], dtype=float32), array([0.5, 0.5], dtype=float32))

    Change logs:
     * v0.1.0 - Initially added
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        delay: int | tuple[int, int] | str | DelayProcess = 4,
        action_delay: int | tuple[int, int] | str | DelayProcess = 0,
        *,
        max_delay: int | None = None,
        receiver: str = "newest",
        state_history: bool = False,
    ):
        gym.utils.RecordConstructorArgs.__init__(
            self,
            delay=delay,
            action_delay=action_delay,
            max_delay=max_delay,
            receiver=receiver,
            state_history=state_history,
        )
        gym.Wrapper.__init__(self, env)
        obs_space, act_space = env.observation_space, env.action_space
        if not (isinstance(obs_space, spaces.Box) and len(obs_space.shape) == 1):
            raise ValueError(
                f"DelayedObservationWrapper needs a 1-D Box observation, got {obs_space}; "
                "put gymnasium.wrappers.FlattenObservation below it."
            )
        if not (isinstance(act_space, spaces.Box) and len(act_space.shape) == 1 and act_space.is_bounded()):
            raise ValueError(
                f"DelayedObservationWrapper needs a bounded 1-D Box action, got {act_space}; "
                "put gymnasium.wrappers.RescaleAction below it."
            )
        if not np.all(act_space.low < act_space.high):
            raise ValueError(
                f"DelayedObservationWrapper scales actions by their bounds, but low and high are equal in {act_space}; "
                "leave out the action entries that cannot vary."
            )
        self.process = (
            make_process(delay) if action_delay == 0 else TotalDelay(make_process(delay), make_process(action_delay))
        )
        largest = self.process.max_delay if max_delay is None else max_delay
        check_count("max_delay", largest, 0)
        self.max_delay = int(largest)
        if self.max_delay < self.process.max_delay:
            raise ValueError(f"max_delay={max_delay} is smaller than the largest delay {self.process.max_delay}.")
        if receiver not in RECEIVERS:
            raise ValueError(f"receiver is {receiver!r}, expected one of {tuple(RECEIVERS)}.")
        observed, self.actuator = self.process, None
        if isinstance(self.process, TotalDelay) and self.process.action_varies:
            if state_history:
                raise ValueError(
                    f"Under {self.process.action} every action takes a time of its own, so that what was sent between "
                    "two states is not what was executed; leave state_history=False, or give an action delay that "
                    "stays for an episode."
                )
            observed = make_process(self.process.observation)
            self.actuator = Actuator(RECEIVERS[receiver](make_process(self.process.action)), observed.max_delay)
        self.receiver = RECEIVERS[receiver](observed)

        self._action_low = act_space.low.astype(np.float64)  # whose span the bounds' own type may not hold
        self._action_span = act_space.high.astype(np.float64) - self._action_low
        self._action_is_scaled = bool(np.all(act_space.low == -1) and np.all(act_space.high == 1))
        with np.errstate(over="ignore"):  # a float64 bound beyond float32 becomes infinite
            low, high = (bound.astype(np.float32) for bound in (obs_space.low, obs_space.high))
        parts: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(low, high, dtype=np.float32),
            "action_history": spaces.Box(-1.0, 1.0, (self.max_delay, *act_space.shape), np.float32),
            "delay": spaces.Box(0.0, float(self.max_delay), (1,), np.float32),
        }
        self.state_history = state_history
        if state_history:
            low, high = (np.tile(bound, (self.max_delay, 1)) for bound in (np.minimum(low, 0), np.maximum(high, 0)))
            parts["state_history"] = spaces.Box(low, high, dtype=np.float32)
            parts["state_known"] = spaces.Box(0.0, 1.0, (self.max_delay,), np.float32)
        self.observation_space = spaces.Dict(parts)  # type: ignore[assignment]  # a Dict is a Space[dict[str, Any]]
        self._rng = np.random.default_rng()
        self._states: deque[np.ndarray] = deque(maxlen=self.max_delay + 1)
        self._history = np.zeros((self.max_delay, *act_space.shape), np.float32)
        self._received = np.zeros((self.max_delay + 1, *obs_space.shape), np.float32)  # s_{t-D..t}, zeros where unknown
        self._is_received = np.zeros(self.max_delay + 1, np.float32)

    @property
    def age_range(self) -> tuple[int, int]:
        """The smallest and the largest ``delay`` amid an episode; numbers, for workers of vectorised environments."""
        return age_range(self.process)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset the task; s_0 arrives at once.

        :param seed: seeds the task and the delay process
        :raises ValueError: when the process draws a delay outside 0..max_delay
        """
        state: Any
        state, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng([seed, DELAY_STREAM])
        if self.actuator is not None:
            self.actuator.reset(self._rng.spawn(1)[0])
        self.receiver.reset(self._rng)
        self._states.clear()
        self._history[:] = self._received[:] = self._is_received[:] = 0.0
        return self._observe(state, age=0), self._with_own(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action; observe what has arrived.

        :param action: (act_dim,), in the units of the action space
        :raises ValueError: when the process draws a delay outside 0..max_delay
        """
        state: Any
        executed = action if self.actuator is None else self.actuator.execute(action)
        state, reward, terminated, truncated, info = self.env.step(executed)
        if self.max_delay > 0:
            self._history[:-1] = self._history[1:]
            self._history[-1] = self._scale(action)
        age = self.receiver.step()
        if self.actuator is None:
            return self._observe(state, age), reward, terminated, truncated, self._with_own(info)
        obs = self._observe(state, age, self.actuator.lag(age))
        return obs, reward, terminated, truncated, self._with_own(info, executed_action=self._scale(executed))

    def _observe(self, state: np.ndarray, age: int, lag: int = 0) -> dict[str, np.ndarray]:
        """Hand out the state of an age that is behind by ``lag`` actions more."""
        self._states.append(np.asarray(state, dtype=np.float32).copy())
        obs = {
            "observation": self._states[-1 - age].copy(),
            "action_history": self._history.copy(),
            "delay": np.array([age + lag], dtype=np.float32),
        }
        return obs | self._remember(obs["observation"], age) if self.state_history else obs

    def _remember(self, observation: np.ndarray, age: int) -> dict[str, np.ndarray]:
        """Return all that was handed out, this observation included, in the rows of the actions that led there."""
        for rows in (self._received, self._is_received):
            rows[:-1] = rows[1:]
            rows[-1] = 0.0
        self._received[-1 - age], self._is_received[-1 - age] = observation, 1.0
        return {"state_history": self._received[1:].copy(), "state_known": self._is_received[1:].copy()}

    def _with_own(self, info: dict[str, Any], **own: np.ndarray) -> dict[str, Any]:
        """Return the task's info with this wrapper's entries, and without what it has under the same names."""
        return {
            **{key: value for key, value in info.items() if key != "executed_action"},
            "undelayed_observation": self._states[-1].copy(),
            "forced_deliveries": self.receiver.forced_deliveries
            + (0 if self.actuator is None else self.actuator.receiver.forced_deliveries),
            **own,
        }

    def _scale(self, action: np.ndarray) -> np.ndarray:
        """Scale from the action space to [-1, 1]; bit for bit the same where it has these bounds already."""
        if not self._action_is_scaled:
            action = 2.0 * ((action - self._action_low) / self._action_span) - 1.0
        return np.clip(action, -1.0, 1.0)
