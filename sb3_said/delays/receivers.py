"""What a receiver holds at every step: the age of the newest packet, given how long packets take."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sb3_said.delays.processes import DelayProcess, packet_delays


class NewestPacket:
    """Keeps the newest packet that has arrived; one that a younger packet has overtaken is of no use.

    Packet t is sent at step t and arrives at t + its delay; packet 0 is there from the start. The age grows by at most
    one a step and can fall by any amount. It never exceeds the process's ``max_delay``: where losses would make it, the
    packet that is ``max_delay`` steps old is delivered after all.

    :param process: how long packets take
    """

    def __init__(self, process: DelayProcess):
        self.process = process
        self._arriving = [0] * (process.max_delay + 1)  # the newest packet due at t, at t % (max_delay + 1)

    def reset(self, rng: np.random.Generator) -> None:
        """Start an episode: packet 0 is there, with age 0.

        :param rng: of the process, until the next reset
        :raises ValueError: when the process draws a delay outside 0..max_delay
        """
        self._delays: Iterator[int | None] = packet_delays(self.process, rng)
        self._arriving = [0] * len(self._arriving)
        self._step = self._newest = 0
        #: Packets of this episode that were delivered because the age would have exceeded ``max_delay``.
        self.forced_deliveries = 0

    def step(self) -> int:
        """Send the next packet.

        :return: the age of the newest packet, in control steps
        :raises ValueError: when the process draws a delay outside 0..max_delay
        """
        self._step += 1
        n_slots = len(self._arriving)
        delay = next(self._delays)
        if delay is not None:
            self._arriving[(self._step + delay) % n_slots] = self._step
        self._newest = max(self._newest, self._arriving[self._step % n_slots])
        if self._step - self._newest == n_slots:
            self._newest += 1
            self.forced_deliveries += 1
        return self._step - self._newest


class IndependentDraw(NewestPacket):
    """Reads a buffer at an age drawn for every step, as the DOMDP of the paper (section 2) has it.

    An older observation may follow a younger one, which no receiver that keeps the newest packet would hand out. A
    lost draw leaves the observation that was read last.

    :param process: the age to read at each step
    """

    def step(self) -> int:
        """Draw the next age.

        :return: the age of the observation read, in control steps
        :raises ValueError: when the process draws a delay outside 0..max_delay
        """
        self._step += 1
        delay = next(self._delays)
        if delay is not None:
            self._newest = max(self._step - delay, 0)
        elif self._step - self._newest == len(self._arriving):
            self._newest += 1
            self.forced_deliveries += 1
        return self._step - self._newest


#: What a user may write as ``receiver``.
RECEIVERS = {"newest": NewestPacket, "independent": IndependentDraw}
