"""The delayed world, NumPy only: delay processes and the observation wrapper."""

from sb3_said.delays.processes import DelayProcess, EpisodeDelay, FixedDelay
from sb3_said.delays.wrapper import DelayedObservationWrapper

__all__ = ["DelayProcess", "DelayedObservationWrapper", "EpisodeDelay", "FixedDelay"]
