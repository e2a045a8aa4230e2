"""Whether MuJoCo can draw on this machine."""

from __future__ import annotations

import os

import gymnasium as gym
import pytest


def need_a_renderer(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the test where no graphics library draws a task: EGL, unless MUJOCO_GL says otherwise."""
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset()
    try:
        env.render()
    except Exception as error:  # each graphics library fails in its own way
        pytest.skip(f"nothing can be drawn here: {error!r}")
    finally:
        env.close()
