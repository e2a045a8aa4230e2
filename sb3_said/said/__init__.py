"""SAID: State-Action Inpainting Diffuser."""

from sb3_said.said.callbacks import PlannerTrainingCallback
from sb3_said.said.policies import SAIDPolicy
from sb3_said.said.said import SAID

MlpPolicy = SAIDPolicy
MultiInputPolicy = SAIDPolicy

__all__ = ["SAID", "MlpPolicy", "MultiInputPolicy", "PlannerTrainingCallback", "SAIDPolicy"]
