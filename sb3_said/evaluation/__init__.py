"""How good and how fast an agent is: whole seeded episodes, bootstrap intervals, decision latencies, plots."""

from sb3_said.evaluation.rollout import Rollout, collect_observations, measure_latency, rollout
from sb3_said.evaluation.statistics import Interval, Latency, Summary, bootstrap_interval, iqm

__all__ = [
    "Interval",
    "Latency",
    "Rollout",
    "Summary",
    "bootstrap_interval",
    "collect_observations",
    "iqm",
    "measure_latency",
    "rollout",
]
