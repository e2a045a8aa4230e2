"""What a receiver holds at every step, and what an actuator executes, given how long packets take."""

from __future__ import annotations

import copy
from collections import deque
from typing import Any

import numpy as np

from sb3_said.delays.processes import DelayProcess, packet_delays


class Draws:
    """The delays of an episode's packets, one after the other. A copy made within an episode draws the same delays.

    A generator cannot be copied, so the copy first draws once more what the original has drawn.

    :param process: how long packets take
    :param rng: draws them; nobody else draws from it until the next episode
    """

    def __init__(self, process: DelayProcess, rng: np.random.Generator):
        self.process, self.rng, self.n_drawn = process, rng, 0
        bits: Any = rng.bit_generator  # Any: in some NumPy versions its type does not declare __getstate__
        self._began = copy.deepcopy(bits.__getstate__())  # which includes the number of spawned children
        self._delays = packet_delays(process, rng)

    def __next__(self) -> int | None:
        self.n_drawn += 1
        return next(self._delays)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_delays"}  # cannot be copied

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        bits: Any = self.rng.bit_generator
        bits.__setstate__(copy.deepcopy(self._began))
        self._delays = packet_delays(self.process, self.rng)
        for _ in range(self.n_drawn):
            next(self._delays)


class NewestPacket:
    """Keeps the newest packet that has arrived, and drops one that a younger packet has overtaken.

    Packet t is sent at step t and arrives at t + its delay; packet 0 is there from the start. The age grows by at most
    one a step and can fall by any amount. It never exceeds the process's ``max_delay``: if losses would make it, the
    packet that is ``max_delay`` steps old is delivered after all.

    :param process: how long packets take
    """

    def __init__(self, process: DelayProcess):
        self.process = process
        self._arriving = [0] * (process.max_delay + 1)  # at t % (max_delay + 1): the newest packet due at step t

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode: packet 0 is there, with age 0. Until the next reset, ``rng`` draws the delays."""
        self._delays = Draws(self.process, rng)
        self._arriving = [0] * len(self._arriving)
        self._step = self._newest = 0
        #: Packets of this episode that were delivered because the age would have exceeded ``max_delay``.
        self.forced_deliveries = 0

    def step(self) -> int:
        """Send the next packet, and return the age of the one that is held now, in control steps."""
        self._step += 1
        self._newest = self._read(next(self._delays))
        if self._step - self._newest == len(self._arriving):
            self._newest += 1
            self.forced_deliveries += 1
        return self._step - self._newest

    def _read(self, delay: int | None) -> int:
        """Send the packet of this step, and return the number of the one that is held now."""
        n_slots = len(self._arriving)
        if delay is not None:
            self._arriving[(self._step + delay) % n_slots] = self._step
        return max(self._newest, self._arriving[self._step % n_slots])


class IndependentDraw(NewestPacket):
    """Reads a buffer at an age drawn for every step, as the DOMDP of the paper (section 2) does.

    An older observation may follow a younger one; under :class:`NewestPacket` it never does. If a draw is lost, the
    observation read last stays.

    :param process: the age to read at each step
    """

    def _read(self, delay: int | None) -> int:
        return self._newest if delay is None else max(self._step - delay, 0)


#: What a user may write as ``receiver``.
RECEIVERS = {"newest": NewestPacket, "independent": IndependentDraw}


class Actuator:
    """Executes the newest action that has arrived, and holds it until another arrives.

    The task starts when the first action arrives, so that action is there from the start, as s_0 is for observations.

    :param receiver: of actions; it gives the age of the action to execute
    :param memory: steps for which it remembers what it executed: the largest age of an observation
    """

    def __init__(self, receiver: NewestPacket, memory: int):
        self.receiver = receiver
        self._sent: deque[np.ndarray] = deque(maxlen=int(receiver.process.max_delay) + 1)
        self._ages: deque[int] = deque(maxlen=int(memory) + 1)  # of the youngest action executed by then, each step

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode. Until the next reset, ``rng`` draws the action delays."""
        self.receiver.reset(rng)
        self._sent.clear()
        self._ages.clear()

    def execute(self, action: np.ndarray) -> np.ndarray:
        """Send an action (act_dim,), and return the one that this step executes, sent now or earlier."""
        age = self.receiver.step() if self._sent else 0
        self._sent.append(np.array(action))
        self._ages.append(min(age, self._ages[-1] + 1) if self._ages else age)  # one executed before may be younger
        return self._sent[-1 - age]

    def lag(self, age: int) -> int:
        """Return how many of the actions sent before the state of this age do not show in it yet."""
        # That is how old the youngest executed action was at the step that led to this state. No step leads to s_0.
        return self._ages[-1 - age] if age < len(self._ages) else 0
