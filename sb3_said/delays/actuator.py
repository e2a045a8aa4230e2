"""What an actuator executes when every action takes a time of its own to reach it."""

from __future__ import annotations

from collections import deque

import numpy as np

from sb3_said.delays.receivers import NewestPacket


class Actuator:
    """Holds the action that its receiver says has arrived, until another takes its place.

    The task starts when the first action arrives, so that one is there from the start, as s_0 is for observations.

    :param receiver: of actions; it says how old the action is that is executed
    :param memory: for how many steps the executed actions are remembered: the largest age of an observation
    """

    def __init__(self, receiver: NewestPacket, memory: int):
        self.receiver = receiver
        self._sent: deque[np.ndarray] = deque(maxlen=int(receiver.process.max_delay) + 1)
        self._ages: deque[int] = deque(maxlen=int(memory) + 1)  # of what was executed in the newest steps

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode.

        :param rng: of the action delays, until the next reset
        """
        self.receiver.reset(rng)
        self._sent.clear()
        self._ages.clear()

    def execute(self, action: np.ndarray) -> np.ndarray:
        """Send an action to the actuator.

        :param action: (act_dim,)
        :return: the action that is executed in this step, sent now or earlier
        """
        age = self.receiver.step() if self._sent else 0
        self._sent.append(np.array(action))
        self._ages.append(age)
        return self._sent[-1 - age]

    def lag(self, age: int) -> int:
        """Return by how many actions more than ``age`` a state of that age is behind.

        That is the age of the action whose execution led to it: those sent later do not show in it. No action leads to
        s_0, which is behind by all that were sent.

        :param age: of a state, in control steps
        """
        return self._ages[-1 - age] if age < len(self._ages) else 0
