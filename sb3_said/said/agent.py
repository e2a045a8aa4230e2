"""What an agent with a planner has, for the modules that train, try and distill one."""

from __future__ import annotations

from typing import Any

from sb3_said.offline import OfflineAlgorithm
from sb3_said.said.policies import SAIDPolicy, Value


class PlannerAgent(OfflineAlgorithm):
    """An agent with a planner; :class:`~sb3_said.said.SAID` sets what is declared here."""

    policy: SAIDPolicy
    planner_gradient_steps: int
    planner_train_freq: int | None
    planner_newest_fraction: float
    planner_terminal_penalty: float | None
    planner_trial_episodes: int
    planner_ways: dict[str, dict[str, Any]]
    value: Value
    _planner_trained_at: int  # num_timesteps of the last planner training

    @property
    def has_expert(self) -> bool:
        """Whether actor and critics have learned."""
        return self.has_learned

    @property
    def newest_fraction(self) -> float:
        """The part of the replay that is imitated; all of a log, where no step is newer than another."""
        return 1.0 if self.replay_buffer.holds_logs else self.planner_newest_fraction

    @property
    def planner_is_current(self) -> bool:
        """Whether :meth:`train_planner`, with its trial, has ended since the last step."""
        return self.policy.planner_is_trained and self._planner_trained_at == self.num_timesteps
