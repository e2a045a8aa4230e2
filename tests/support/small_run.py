"""What rl_zoo3 leaves of a training, which here was hardly one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.files.archive import save_tree
from sb3_said.files.checkpoint import CHECKPOINT_NAME, training_state
from sb3_said.zoo.record import Record

ENV = "InvertedPendulum-v5"
TINY_PLANNER = {"depth": 1, "d_model": 32, "horizon": 4, "sampling_steps": 2, "n_candidates": 2}


def write_run(
    folder: Path,
    cls: type[DelayedSAC],
    delay: int | tuple[int, int],
    steps: int = 60,
    seed: int = 0,
    checkpoint: bool = False,
    **kwargs: Any,
) -> Path:
    """Train an agent on ``ENV`` and leave its run folder.

    :param checkpoint: leave one, too, of its end
    :param kwargs: of the agent
    """
    if cls is SAID:
        kwargs = {"planner_kwargs": TINY_PLANNER, "planner_gradient_steps": 2, "planner_trial_episodes": 0, **kwargs}
    kwargs = {"learning_starts": 50, "buffer_size": 500, "policy_kwargs": {"net_arch": [64]}, "device": "cpu", **kwargs}
    model = cls("MultiInputPolicy", DelayedObservationWrapper(gym.make(ENV), delay), seed=seed, **kwargs)
    model.learn(steps)
    model.save(folder / f"{ENV}.zip")
    if checkpoint:
        save_tree(folder / CHECKPOINT_NAME, training_state(model))
    written = delay if isinstance(delay, int) else list(delay)
    Record("said" if cls is SAID else "sadr", ENV, seed, written).write(folder)
    return folder
