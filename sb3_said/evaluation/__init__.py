"""How good and how fast an agent is: whole seeded episodes, intervals, decision latencies, plots."""

from sb3_said.evaluation.rollout import Rollout, collect_observations, measure_latency, rollout
from sb3_said.evaluation.statistics import (
    Interval,
    Latency,
    Summary,
    confidence_interval,
    stratified_interval,
    worst_tenth,
)

__all__ = [
    "Interval",
    "Latency",
    "Rollout",
    "Summary",
    "collect_observations",
    "confidence_interval",
    "measure_latency",
    "rollout",
    "stratified_interval",
    "worst_tenth",
]
