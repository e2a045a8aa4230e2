"""Reinforcement learning on old observations: an add-on to Stable-Baselines3.

Names are imported when they are first used, so that what needs the delayed world alone (a robot, the workers of a
``SubprocVecEnv``) never waits for PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_said.delays import DelayedObservationWrapper
    from sb3_said.planner import InpaintingPlanner, PlannerConfig
    from sb3_said.sac import DelayedSAC, StableSAC
    from sb3_said.said import SAID, PlannerTrainingCallback

__version__ = "0.1.0"
__all__ = [
    "SAID",
    "DelayedObservationWrapper",
    "DelayedSAC",
    "InpaintingPlanner",
    "PlannerConfig",
    "PlannerTrainingCallback",
    "StableSAC",
]
_HOMES = ("delays", "planner", "sac", "said")  # where these names live, each folder after those that it imports
_FOLDERS = (*_HOMES, "replay", "files", "offline", "evaluation", "realtime", "zoo")


def __getattr__(name: str) -> Any:
    if name in __all__:
        folders = (import_module(f"{__name__}.{folder}") for folder in _HOMES)
        return next(getattr(folder, name) for folder in folders if name in folder.__all__)
    if name in _FOLDERS:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_FOLDERS})
