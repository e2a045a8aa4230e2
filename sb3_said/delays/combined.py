"""Delay processes made of other processes: held, periodic, lossy, or added up."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sb3_said.delays.processes import (
    BaseProcess,
    Delay,
    DelayProcess,
    as_process,
    checked_count,
    checked_probability,
    packet_delays,
    smallest_age,
)


def _inner(delay: Delay) -> DelayProcess:
    """Return ``delay`` as a process that another one may contain.

    :raises ValueError: for a :class:`TotalDelay` in which every action takes a time of its own
    """
    process = as_process(delay)
    if isinstance(process, TotalDelay) and process.action_varies:
        raise ValueError(
            f"{process.action} draws a delay for every action, which the age of observations cannot express; give "
            "TotalDelay to DelayedObservationWrapper as it is, not inside another process."
        )
    return process


@dataclass(frozen=True)
class _OfProcess(BaseProcess):
    """A process made of one other process."""

    process: Delay

    def __post_init__(self) -> None:
        process = _inner(self.process)
        self._set(process=process, min_delay=smallest_age(process), max_delay=process.max_delay)


@dataclass(frozen=True)
class HeldDelay(_OfProcess):
    """A delay that stays for a while: another process draws a new one only now and then.

    ``HeldDelay(UniformDelay(min_lag, max_lag), hold_prob, update_period)`` draws as the delay buffers of Isaac Lab and
    mjlab do (there ``update_period=0`` means every step, and the lag is 0 until the first update).

    :param process: draws a new delay when one is due; a process with one delay for an episode draws anew each time
    :param hold_prob: probability of keeping the last delay when a new one is due
    :param update_period: packets from one draw to the next; the phase is drawn at every reset
    :raises ValueError: for a probability outside 0..1 or a period below 1
    """

    hold_prob: float = 0.0
    update_period: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        hold_prob = checked_probability("hold_prob", self.hold_prob)
        self._set(hold_prob=hold_prob, update_period=checked_count("update_period", self.update_period, 1))

    def sample(self, rng: np.random.Generator) -> Iterator[int | None]:
        phase = int(rng.integers(self.update_period))
        delays = packet_delays(self.process, rng)
        delay = next(delays)
        for packet in itertools.count(phase + 1):
            yield delay
            if packet % self.update_period == 0 and rng.random() >= self.hold_prob:
                if isinstance(delays, itertools.repeat):
                    delays = packet_delays(self.process, rng)
                delay = next(delays)


@dataclass(frozen=True)
class PeriodicPackets(_OfProcess):
    """A slow sensor: after a reset, only every ``period``-th control step sends a packet.

    Between packets the age grows: a camera of 10 Hz in a control loop of 50 Hz has ``period=5``.

    :param process: delays of the packets that are sent
    :param period: control steps from one packet to the next, >= 1
    :raises ValueError: for a period below 1
    """

    period: int

    def __post_init__(self) -> None:
        super().__post_init__()
        period = checked_count("period", self.period, 1)
        self._set(period=period, max_delay=self.max_delay + period - 1)

    def sample(self, rng: np.random.Generator) -> Iterator[int | None]:
        for delay in packet_delays(self.process, rng):
            yield from itertools.repeat(None, self.period - 1)
            yield delay


@dataclass(frozen=True)
class DroppedPackets(_OfProcess):
    """Packets of another process, each lost with probability ``p``.

    Ages are bounded. If losses in a row would make the newest observation older than ``max_delay``, the packet of age
    ``max_delay`` is delivered after all, and ``info["forced_deliveries"]`` counts it.

    :param process: delays of the packets that are not lost
    :param p: probability that a packet is lost
    :param max_losses: how many control steps losses may add to the age: ``max_delay`` is the process's plus this
    :raises ValueError: for a probability outside 0..1, or ``max_losses`` below 1

    >>> DroppedPackets(4, p=0.1).max_delay
    8
    """

    p: float
    max_losses: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        p, max_losses = checked_probability("p", self.p), checked_count("max_losses", self.max_losses, 1)
        self._set(p=p, max_losses=max_losses, max_delay=self.max_delay + max_losses)

    def sample(self, rng: np.random.Generator) -> Iterator[int | None]:
        for delay in packet_delays(self.process, rng):
            yield None if rng.random() < self.p else delay


@dataclass(frozen=True)
class TotalDelay(BaseProcess):
    """Observation delay plus action delay: ``delay`` and ``action_delay`` of the wrapper in one, as on a command line.

    An action that takes k steps to the actuator is executed k steps after it was chosen. Counted at the actuator, it is
    executed at once, and observations are k steps older. As long as all actions of an episode take equally long, an
    agent cannot tell which of the two is delayed.

    :param observation: delays of observations
    :param action: delays of actions
    """

    observation: Delay
    action: Delay

    def __post_init__(self) -> None:
        observation, action = _inner(self.observation), _inner(self.action)
        low, high = smallest_age(observation) + smallest_age(action), observation.max_delay + action.max_delay
        self._set(observation=observation, action=action, min_delay=low, max_delay=high)

    @property
    def action_varies(self) -> bool:
        """Whether every action takes a time of its own; only the wrapper can simulate that."""
        return isinstance(as_process(self.action).sample(np.random.default_rng(0)), Iterator)

    def sample(self, rng: np.random.Generator) -> int | Iterator[int | None]:
        """Draw the observation delays from ``rng``, as without action delay, and the action delay from a child of it.

        This serves action delays that stay for an episode; the wrapper simulates the others.

        :return: one number if both delays stay for the episode, else an iterator
        """
        added = packet_delays(self.action, rng.spawn(1)[0])
        if not isinstance(added, itertools.repeat):
            raise ValueError(
                f"{self.action!r} drew a delay for all actions of an episode at first, and one for each now; as an "
                "action delay a process draws always the one or always the other."
            )
        k, delays = next(added), packet_delays(self.observation, rng)
        if isinstance(delays, itertools.repeat):
            return next(delays) + k
        return (None if delay is None else delay + k for delay in delays)
