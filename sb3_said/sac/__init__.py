"""SAC, SA, DR and SADR: soft actor-critic for delayed observations."""

from sb3_said.sac.delayed_sac import DelayedSAC
from sb3_said.sac.policies import DelayedSACPolicy

MlpPolicy = DelayedSACPolicy
MultiInputPolicy = DelayedSACPolicy

__all__ = ["DelayedSAC", "DelayedSACPolicy", "MlpPolicy", "MultiInputPolicy"]
