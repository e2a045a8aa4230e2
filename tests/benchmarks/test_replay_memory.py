"""The replay benchmark fills both buffers with the same transitions, and counts their memory."""

from __future__ import annotations

import json

import numpy as np
import pytest
import replay_memory
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer

from sb3_said import DelayedObservationWrapper
from sb3_said.replay.buffer import DelayedReplayBuffer


def test_both_buffers_return_the_same(monkeypatch):
    monkeypatch.setattr(replay_memory, "EPISODE_LENGTH", 7)
    env = DelayedObservationWrapper(replay_memory.RandomTask(3, 2), delay=2)
    ours, theirs = (replay_memory.make_buffer(cls, env, 60) for cls in (DelayedReplayBuffer, DictReplayBuffer))
    for buffer in (ours, theirs):
        replay_memory.fill(buffer, env)
    rows = np.arange(3, 60)  # the oldest lost their past
    a, b = (buffer._get_samples(rows) for buffer in (ours, theirs))
    for key, value in b.observations.items():
        assert th.equal(a.observations[key], value) and th.equal(a.next_observations[key], b.next_observations[key])
    assert th.equal(a.actions, b.actions) and th.equal(a.dones, b.dones) and a.dones.sum() == 8


def test_memory_does_not_grow_with_the_delay(tmp_path):
    file = tmp_path / "figures.json"
    rows = replay_memory.main(["--rows", "1000", "--rounds", "2", "--delay", "0", "16", "--json", str(file)])
    held = {(row["buffer"], row["delay"]): row["GB / 1 M"] for row in rows}
    assert held["ours", 16] == pytest.approx(held["ours", 0], rel=0.01)
    assert held["ours", 16] < 0.55
    # Twice: two states, the history, the age; once: action, reward, done, timeout
    expected = (2 * (2 * 105 + 16 * 8 + 1) + 8 + 3) * 4 * 1e-3
    assert held["SB3's", 16] == pytest.approx(expected, rel=0.01)
    assert [row["samples / s"] for row in json.loads(file.read_text())["rows"]] == [row["samples / s"] for row in rows]
