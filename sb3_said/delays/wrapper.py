"""The delayed world: a Gymnasium wrapper that hands out old observations and the actions sent since."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from sb3_said.delays.combined import TotalDelay
from sb3_said.delays.processes import LARGEST_DELAY, Delay, as_process, checked_count
from sb3_said.delays.receivers import RECEIVERS, Actuator, NewestPacket
from sb3_said.delays.space import EXECUTED, UNDELAYED, check_task, delayed_space, scale_action
from sb3_said.delays.text import age_range, as_text, make_process

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
    - ``delay`` (1,): how many of these actions do not show in ``observation`` yet: its age in control steps, plus the
      steps that actions take.

    ``state_history=True`` adds what an agent with a memory would know. Each state is in the row of the action that led
    to it:

    - ``state_history`` (D, obs_dim): the states s_{t-D+1..t}, oldest first, zeros where unknown;
    - ``state_known`` (D,): 1 for each of these that was handed out as ``observation`` so far in the episode, else 0.

    At reset s_0 arrives with age 0. It ages until the next observation arrives, so an episode starts as a task with a
    smaller delay.

    ``info["undelayed_observation"]`` is the true state after the step, for replay and diagnosis only.
    ``info["forced_deliveries"]`` counts the packets of the episode that were delivered only because the age would have
    exceeded the largest delay. Where every action takes a time of its own, ``info["executed_action"]`` is the action
    that the task executed, scaled like the history.

    ``gymnasium.wrappers.DelayObservation`` returns zeros before the first observation arrives. It returns neither the
    actions sent since nor the age, without which the process is not Markov (paper, Theorem 2.1).

    :param env: a task with a 1-D Box observation and a bounded Box action
    :param delay: d >= 0 control steps; or ``(low, high)``, drawn uniformly at every reset; or a delay process, also as
        text such as ``"UniformDelay(0, 8)"``
    :param action_delay: control steps from choosing an action to its execution, in the forms of ``delay``. The task
        starts when the first action arrives. With one delay an episode, steps are counted at the actuator: each action
        is executed at once, and observations are older by that delay. With one delay for each action, the actuator
        executes the newest that has arrived, and holds it until another arrives.
    :param max_delay: D, length of the action history; the largest delay by default. A larger one serves a model that
        was built for it.
    :param receiver: of observations, and of actions where each takes a time of its own. ``"newest"`` keeps the newest
        packet that has arrived; ``"independent"`` reads an age drawn anew at every step (paper, section 2)
    :param state_history: see above. Under ``"independent"`` states younger than ``observation`` may be known, under
        ``"newest"`` none are. Refused where every action takes a time of its own: the actions sent are then not
        those executed
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
        delay: Delay | str = 4,
        action_delay: Delay | str = 0,
        *,
        max_delay: int | None = None,
        receiver: str = "newest",
        state_history: bool = False,
    ):
        gym.utils.RecordConstructorArgs.__init__(
            self,
            delay=as_text(delay),  # an EnvSpec is written as JSON
            action_delay=as_text(action_delay),
            max_delay=None if max_delay is None else int(max_delay),
            receiver=receiver,
            state_history=state_history,
        )
        gym.Wrapper.__init__(self, env)
        obs_space, act_space = check_task(env.observation_space, env.action_space)
        self.process = make_process(delay)
        if action_delay != 0:
            self.process = TotalDelay(self.process, make_process(action_delay))
        largest = checked_count(f"max_delay of {self.process}", self.process.max_delay, 0, LARGEST_DELAY)
        self.max_delay = largest if max_delay is None else checked_count("max_delay", max_delay, 0, LARGEST_DELAY)
        if self.max_delay < largest:
            raise ValueError(f"max_delay={max_delay} is smaller than the largest delay {self.process.max_delay}.")
        if receiver not in RECEIVERS:
            raise ValueError(f"receiver is {receiver!r}, expected one of {tuple(RECEIVERS)}.")
        self._receiver = RECEIVERS[receiver]
        self.receiver, self.actuator = self.make_receivers()
        if self.actuator is not None and state_history:
            raise ValueError(
                f"Under {self.actuator.receiver.process} every action takes a time of its own, so the actions sent "
                "between two states are not those executed; leave state_history=False, or give an action delay that "
                "stays for an episode."
            )

        self._task_action_space = act_space
        self.state_history = state_history
        space = delayed_space(obs_space, act_space, self.max_delay, state_history)
        self.observation_space = space  # type: ignore[assignment]  # a Dict is a Space[dict[str, Any]]
        self._rng = np.random.default_rng()
        n = self.max_delay + 1
        self._actions = np.zeros((n, *act_space.shape), np.float32)  # a_{t-D-1..t-1}, each beside the state it led to
        self._states = np.zeros((n, *obs_space.shape), np.float32)  # s_{t-D..t}
        self._known = np.zeros(n, np.float32)  # which of these were handed out
        self._shown = 0  # age of the state that was handed out last
        self._is_over = True  # the episode is over, or none has begun

    def make_receivers(self) -> tuple[NewestPacket, Actuator | None]:
        """Return new receivers of observations, and of actions where each takes a time of its own."""
        observed, actuator = self.process, None
        if isinstance(self.process, TotalDelay) and self.process.action_varies:
            observed = as_process(self.process.observation)
            actuator = Actuator(self._receiver(as_process(self.process.action)), observed.max_delay)
        return self._receiver(observed), actuator

    @property
    def age_range(self) -> tuple[int, int]:
        """The smallest and the largest ``delay`` amid an episode: plain numbers, which workers can send."""
        return age_range(self.process)

    @property
    def task_id(self) -> str | None:
        """Id of the task, where it has one: a text, since workers cannot send every ``spec``."""
        return None if self.spec is None else self.spec.id

    @property
    def handed_out(self) -> dict[str, np.ndarray]:
        """The state and the action history that were handed out last."""
        return {"observation": self._states[-1 - self._shown], "action_history": self._actions[1:]}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset the task; s_0 arrives at once.

        :param seed: seeds the task and the delay process
        :raises ValueError: when the process draws a delay outside 0..max_delay, or the task's answer is malformed
        """
        state: Any
        info: Any
        answer: Any = self.env.reset(seed=seed, options=options)
        state, info = answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)
        self._check_answer(state, info)
        if seed is not None:
            self._rng = np.random.default_rng([seed, DELAY_STREAM])
        if self.actuator is not None:
            self.actuator.reset(self._rng.spawn(1)[0])
        self.receiver.reset(self._rng)
        self._actions[:] = self._states[:] = self._known[:] = 0.0
        self._is_over = False
        return self._observe(state, age=0), self._with_own(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action; observe what has arrived.

        :param action: (act_dim,), in the units of the action space
        :raises ResetNeeded: where no episode has begun, or the last one has ended
        :raises ValueError: for an action of another shape, when the process draws a delay outside 0..max_delay, or the
            task's answer is malformed
        """
        if self._is_over:
            raise gym.error.ResetNeeded(
                "Call reset() first: no episode has begun, or the last one has ended. What resets a task by itself, "
                "such as gymnasium.wrappers.Autoreset, goes around DelayedObservationWrapper."
            )
        if np.shape(action) != self._actions.shape[1:]:
            raise ValueError(f"The action has the shape {np.shape(action)}, expected {self._actions.shape[1:]}.")
        state: Any
        executed = action if self.actuator is None else self.actuator.execute(action)
        state, reward, terminated, truncated, info = self.env.step(np.array(executed))  # a copy: a task may change it
        self._check_answer(state, info)
        self._is_over = bool(terminated or truncated)
        _append(self._actions, scale_action(action, self._task_action_space))
        age = self.receiver.step()
        lag, shown = (0, None) if self.actuator is None else (self.actuator.lag(age), executed)
        return self._observe(state, age, lag), reward, terminated, truncated, self._with_own(info, shown)

    def _check_answer(self, state: Any, info: Any) -> None:
        """:raises ValueError: for an answer of the task that NumPy would broadcast or cast in silence"""
        given, shape = np.asarray(state), self._states.shape[1:]
        if given.shape != shape or given.dtype.kind not in "biuf" or not isinstance(info, dict):
            raise ValueError(
                f"The task answered with an observation of shape {given.shape} that holds {given.dtype}, and with an "
                f"info of type {type(info).__name__}; expected shape {shape}, real numbers and a dict. "
                "gymnasium.utils.env_checker.check_env(task) finds such mistakes."
            )

    def _observe(self, state: np.ndarray, age: int, lag: int = 0) -> dict[str, np.ndarray]:
        """Hand out the state of an age; ``lag`` actions sent before that state do not show in it yet."""
        _append(self._states, state)
        _append(self._known, 0.0)
        self._known[-1 - age], self._shown = 1.0, age
        obs = {
            "observation": self._states[-1 - age].copy(),
            "action_history": self._actions[1:].copy(),
            "delay": np.array([age + lag], dtype=np.float32),
        }
        if self.state_history:
            known = self._known[1:].copy()
            obs |= {"state_history": np.where(known[:, None] == 1, self._states[1:], 0), "state_known": known}
        return obs

    def _with_own(self, info: dict[str, Any], executed: np.ndarray | None = None) -> dict[str, Any]:
        """Return the task's info with this wrapper's entries, in place of the task's own under these names."""
        receivers = [self.receiver] if self.actuator is None else [self.receiver, self.actuator.receiver]
        return {
            **{key: value for key, value in info.items() if key != EXECUTED},
            UNDELAYED: self._states[-1].copy(),
            "forced_deliveries": sum(receiver.forced_deliveries for receiver in receivers),
            **({} if executed is None else {EXECUTED: scale_action(executed, self._task_action_space)}),
        }


def _append(rows: np.ndarray, row: np.ndarray | float) -> None:
    """Drop the oldest row and write the newest, in place."""
    rows[:-1] = rows[1:]
    rows[-1] = row
