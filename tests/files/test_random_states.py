"""Random states: what is drawn after them, also on another machine."""

import random

import numpy as np
import pytest
import torch as th

from sb3_said.files.archive import load_tree, save_tree
from sb3_said.files.random_states import random_state, restore_random_state


def test_random_states_come_back(tmp_path):
    random.gauss(0, 1)  # Python keeps a second number for the next call
    np.random.normal()  # so does NumPy
    save_tree(tmp_path / "random", random_state())

    def draw():
        return random.gauss(0, 1), random.random(), np.random.normal(), np.random.rand(), th.rand(3).tolist()

    expected = draw()
    assert draw() != expected
    restore_random_state(load_tree(tmp_path / "random"))
    assert draw() == expected


def test_a_run_on_the_cpu_leaves_a_gpu_alone(monkeypatch):
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "get_rng_state_all", lambda: pytest.fail("asked of a GPU that the run has not used"))
    assert "cuda" not in random_state()
    monkeypatch.setattr(th.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(th.cuda, "get_rng_state_all", lambda: ["first"])
    assert random_state()["cuda"] == ["first"]


def test_a_machine_of_fewer_gpus_takes_the_random_states_of_as_many(monkeypatch):
    taken, state = [], random_state()
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(th.cuda, "set_rng_state_all", taken.extend)
    restore_random_state({**state, "cuda": ["first", "second"]})
    assert taken == ["first"]
