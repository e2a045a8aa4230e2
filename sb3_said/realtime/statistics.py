"""What a control loop counts: how old observations were, how long answers took, and how often one was missing."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

#: Larger ages, answer times and gaps are counted as this many steps or periods.
LARGEST_COUNTED = 1_000
#: What is reported of each distribution; the last is the maximum.
PERCENTILES = {"p50": 0.50, "p95": 0.95, "p99": 0.99, "max": 1.0}


@dataclass
class LoopStatistics:
    """Counts of a :class:`~sb3_said.realtime.ControlLoop`, over all episodes since it was made. Memory is bounded."""

    ages: Counter[int] = field(default_factory=Counter)
    """of the newest observation when an action was sent, in control steps. Here and in the next two counts 1,000
    stands for all above"""
    answer_steps: Counter[int] = field(default_factory=Counter)
    """actions sent while an answer was made, of each answer after an episode's first action"""
    gaps: Counter[float] = field(default_factory=Counter)
    """from one action to the next, in periods, rounded to a thousandth below 2 and to whole periods above; 0 where a
    clock went back"""
    steps: int = 0
    """actions sent"""
    overruns: int = 0
    """actions sent more than half a period late"""
    waiting_steps: int = 0
    """safe actions sent before an episode's first answer"""
    held_steps: int = 0
    """actions repeated, since no action was planned for the step"""
    safe_steps: int = 0
    """safe actions sent, since holding had lasted too long"""
    late_answers: int = 0
    """answers after the step that they were planned for; the plan's later actions are used"""
    stale_observations: int = 0
    """observations dropped: no younger than the one at hand (repeated by a frozen sensor, or overtaken), of another
    episode, or stamped ahead of now"""

    def count_age(self, age: int) -> None:
        """Count the age, in control steps, of the newest observation when an action is sent."""
        self.ages[min(age, LARGEST_COUNTED)] += 1

    def count_answer(self, steps: int) -> None:
        """Count an answer that took some control steps."""
        self.answer_steps[min(steps, LARGEST_COUNTED)] += 1

    def count_gap(self, periods: float) -> None:
        """Count the time between two actions, in control periods."""
        periods = max(periods, 0.0)
        self.gaps[round(periods, 3) if periods < 2 else float(round(min(periods, LARGEST_COUNTED)))] += 1
        self.overruns += periods > 1.5

    def copy(self) -> LoopStatistics:
        """Return a copy, which further counting does not change."""
        return replace(self, ages=Counter(self.ages), answer_steps=Counter(self.answer_steps), gaps=Counter(self.gaps))

    def to_dict(self) -> dict[str, float]:
        """Return the counts, and percentiles of what was met, such as ``age_p95``, in JSON types."""
        found: dict[str, float] = {}
        for name, counts in (("age", self.ages), ("answer_steps", self.answer_steps), ("gap", self.gaps)):
            if counts:
                values, weights, shares = [*counts], [*counts.values()], [*PERCENTILES.values()]
                ranked = np.quantile(values, shares, weights=weights, method="inverted_cdf")  # values that were met
                found |= {f"{name}_{key}": float(value) for key, value in zip(PERCENTILES, ranked, strict=True)}
        return found | {name: value for name, value in vars(self).items() if isinstance(value, int)}

    def __str__(self) -> str:
        """Return one line for a log."""
        found = self.to_dict()

        def spread(name: str) -> str:
            return "/".join(f"{found[f'{name}_{key}']:g}" if f"{name}_{key}" in found else "-" for key in PERCENTILES)

        return (
            f"steps {self.steps}, p50/p95/p99/max: age {spread('age')}, answer {spread('answer_steps')} steps, "
            f"gap {spread('gap')} periods; overruns {self.overruns}, held {self.held_steps}, safe {self.safe_steps}, "
            f"waiting {self.waiting_steps}, late answers {self.late_answers}, stale {self.stale_observations}"
        )

    def record(self, logger: Any) -> None:
        """Hand every number to a logger of Stable-Baselines3, as ``realtime/...``; ``logger.dump(step)`` writes them.

        :param logger: such as ``configure("folder", ["tensorboard"])`` of ``stable_baselines3.common.logger``
        """
        for name, value in self.to_dict().items():
            logger.record(f"realtime/{name}", value)
