"""State-action inpainting with a diffusion transformer. Knows no algorithm and no delay wrapper."""

from sb3_said.planner.planner import InpaintingPlanner, Plan, PlannerConfig
from sb3_said.planner.trainer import PlannerTrainer

__all__ = ["InpaintingPlanner", "Plan", "PlannerConfig", "PlannerTrainer"]
