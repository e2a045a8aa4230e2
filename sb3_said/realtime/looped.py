"""A model that answers through a control loop, so that its evaluation measures what latency costs it."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_said.realtime.loop import ControlLoop


class LoopedModel:
    """Plays one environment through a loop, with the ``predict`` of Stable-Baselines3.

    If the environment is delayed, the age that its wrapper counts tells the loop how many actions were executed.

    :param loop: made with ``simulate``, so that time is counted in steps
    """

    def __init__(self, loop: ControlLoop):
        self.loop = loop

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """Return the action that the loop sends in this step: (1, act_dim). An ``episode_start`` resets the loop.

        :param observation: (1, ...), not normalised, since the loop normalises
        :param deterministic: has no effect: the loop was told how to ask its model
        :raises ValueError: for more than one observation
        """
        parts = observation if isinstance(observation, dict) else {"observation": observation}
        if len(parts["observation"]) != 1:
            raise ValueError(
                f"A loop plays one environment, got {len(parts['observation'])} observations; give n_envs=1."
            )
        if episode_start is not None and episode_start[0]:
            self.loop.reset()
        age = int(parts["delay"][0, 0]) if "delay" in parts else 0
        self.loop.observe(parts["observation"][0], n_executed=self.loop.n_sent - age)
        return self.loop.act(self.loop.n_sent * self.loop.period)[None], None
