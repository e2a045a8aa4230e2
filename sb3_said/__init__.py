"""Reinforcement learning on old observations: an add-on to Stable-Baselines3."""

from sb3_said.delays import DelayedObservationWrapper
from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.sac import DelayedSAC
from sb3_said.said import SAID, PlannerTrainingCallback

__version__ = "0.1.0"
__all__ = [
    "SAID",
    "DelayedObservationWrapper",
    "DelayedSAC",
    "InpaintingPlanner",
    "PlannerConfig",
    "PlannerTrainingCallback",
]
