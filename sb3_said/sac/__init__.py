"""SAC, SA, DR and SADR, and a steadier SADR: soft actor-critic for delayed observations."""

from sb3_said.sac.delayed_sac import DelayedSAC
from sb3_said.sac.policies import DelayedSACPolicy
from sb3_said.sac.stable_sac import StableSAC

MlpPolicy = DelayedSACPolicy
MultiInputPolicy = DelayedSACPolicy

__all__ = ["DelayedSAC", "DelayedSACPolicy", "MlpPolicy", "MultiInputPolicy", "StableSAC"]
