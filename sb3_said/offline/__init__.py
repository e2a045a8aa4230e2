"""Learning from logged data: datasets, values, baselines."""

from sb3_said.offline.bc import BC
from sb3_said.offline.datasets import Dataset, load_dataset
from sb3_said.offline.dql import DQL, DQLConfig
from sb3_said.offline.iql import IQL, ImplicitValues, IQLConfig, Transitions
from sb3_said.offline.learning import OfflineAlgorithm
from sb3_said.offline.scores import REFERENCE_RETURNS, normalized_score, reference_returns
from sb3_said.offline.writing import write_dataset

__all__ = [
    "BC",
    "DQL",
    "IQL",
    "REFERENCE_RETURNS",
    "DQLConfig",
    "Dataset",
    "IQLConfig",
    "ImplicitValues",
    "OfflineAlgorithm",
    "Transitions",
    "load_dataset",
    "normalized_score",
    "reference_returns",
    "write_dataset",
]
