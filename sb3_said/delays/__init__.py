"""The delayed world, NumPy and Gymnasium only: processes, receivers, the wrapper, scaled actions, a log's delay."""

from sb3_said.delays.combined import DroppedPackets, HeldDelay, PeriodicPackets, TotalDelay
from sb3_said.delays.estimation import DelayEstimate, estimate_delay
from sb3_said.delays.processes import (
    WIFI_20MS,
    DelayProcess,
    DistributionDelay,
    EpisodeDelay,
    FixedDelay,
    RandomWalkDelay,
    UniformDelay,
    in_steps,
)
from sb3_said.delays.space import scale_action, unscale_action
from sb3_said.delays.wrapper import DelayedObservationWrapper

__all__ = [
    "WIFI_20MS",
    "DelayEstimate",
    "DelayProcess",
    "DelayedObservationWrapper",
    "DistributionDelay",
    "DroppedPackets",
    "EpisodeDelay",
    "FixedDelay",
    "HeldDelay",
    "PeriodicPackets",
    "RandomWalkDelay",
    "TotalDelay",
    "UniformDelay",
    "estimate_delay",
    "in_steps",
    "scale_action",
    "unscale_action",
]
