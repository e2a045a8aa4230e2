"""Learning from logged data: datasets, values, baselines."""

from sb3_said.offline.datasets import Dataset, load_dataset
from sb3_said.offline.iql import IQL, ImplicitValues, IQLConfig, Transitions
from sb3_said.offline.scores import REFERENCE_RETURNS, normalized_score, reference_returns

__all__ = [
    "IQL",
    "REFERENCE_RETURNS",
    "Dataset",
    "IQLConfig",
    "ImplicitValues",
    "Transitions",
    "load_dataset",
    "normalized_score",
    "reference_returns",
]
