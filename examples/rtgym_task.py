"""Let an agent of sb3_said control a robot whose interface is written for rtgym.

An interface is a ``RealTimeGymInterface``: ``reset``, ``send_control``, ``get_obs_rew_terminated_info``. The control
loop takes the place of rtgym's own environment (its clock, its buffer of actions). It also counts how old observations
are and how long answers take. Copy this file, and call ``play`` with your interface.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np

from sb3_said.realtime import ControlLoop, ticks


def flat(observation: Any) -> np.ndarray:
    """Return rtgym's list of arrays as one state: (obs_dim,). The agent must have been trained on the same order."""
    return np.concatenate([np.ravel(part) for part in observation]).astype(np.float32)


def play(interface: Any, loop: ControlLoop, n_steps: int) -> float:
    """Play an episode of at most ``n_steps`` control steps, and return the sum of its rewards."""
    observation, _ = interface.reset()
    loop.reset()
    loop.observe(flat(observation))
    loop.wait()  # the robot still stands, so the first action may be a planned one
    total = 0.0
    try:
        for k, _ in enumerate(ticks(loop.period)):
            if k > 0:
                captured = time.monotonic()  # before the call, which may take long; or the sensor's own stamp
                observation, reward, terminated, _ = interface.get_obs_rew_terminated_info()
                total += reward
                loop.observe(flat(observation), captured)
                if terminated or k == n_steps:
                    return total
            interface.send_control(loop.act())
    finally:
        interface.send_control(interface.get_default_action())
    return total


if __name__ == "__main__":
    from my_robot import MyInterface  # yours

    from sb3_said import SAID
    from sb3_said.realtime import ModelProcess

    with ModelProcess(partial(SAID.load, "agent.zip", device="cpu")) as model, ControlLoop(model, 0.05) as loop:
        print("return", play(MyInterface(), loop, n_steps=1000))
        print(loop.statistics())
