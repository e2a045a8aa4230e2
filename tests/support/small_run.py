"""What rl_zoo3 leaves of a training, which here was hardly one."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC

ENV = "InvertedPendulum-v5"
TINY_PLANNER = {"depth": 1, "d_model": 32, "horizon": 4, "sampling_steps": 2, "n_candidates": 2}


def write_run(folder: Path, cls: type[DelayedSAC], delay: int, steps: int = 60, seed: int = 0, **kwargs: Any) -> Path:
    """Train an agent on ``ENV`` and leave its run folder.

    :param kwargs: of the agent
    """
    wrapper: dict[str, Any] = {"delay": delay}
    if cls is SAID:
        kwargs = {"planner_kwargs": TINY_PLANNER, "planner_gradient_steps": 2, "planner_trial_episodes": 0, **kwargs}
    kwargs = {"learning_starts": 50, "buffer_size": 500, "device": "cpu", **kwargs}
    model = cls("MultiInputPolicy", DelayedObservationWrapper(gym.make(ENV), **wrapper), seed=seed, **kwargs)
    model.learn(steps)
    model.save(folder / f"{ENV}.zip")
    (folder / ENV).mkdir(exist_ok=True)
    config = OrderedDict(env_wrapper=[{"sb3_said.delays.DelayedObservationWrapper": wrapper}], n_timesteps=steps)
    (folder / ENV / "config.yml").write_text(yaml.dump(config))
    args = OrderedDict(algo="said" if cls is SAID else "sadr", env=ENV, env_kwargs=None)
    (folder / ENV / "args.yml").write_text(yaml.dump(args))
    return folder
