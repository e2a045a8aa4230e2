"""Agents that learn a small task in a moment, and what to ask them."""

import numpy as np
import torch as th
from small_task import delayed

from sb3_said import SAID
from sb3_said.said.student import Student

PLANNER = {
    "d_model": 32,
    "depth": 1,
    "horizon": 3,
    "batch_size": 16,
    "sampling_steps": 2,
    "n_candidates": 4,
    "temperature": 0.5,
    "scored_states": "future",
}


def make(env=None, cls=SAID, policy="MlpPolicy", planner_kwargs=(), **kwargs):
    arguments = {"learning_starts": 20, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    arguments["policy_kwargs"] = {"net_arch": [32]}
    if cls is SAID:
        arguments |= {
            "planner_kwargs": PLANNER | dict(planner_kwargs),
            "planner_gradient_steps": 5,
            "planner_newest_fraction": 1.0,
            "planner_trial_episodes": 0,
        }
    return cls(policy, delayed() if env is None else env, **(arguments | kwargs))


def teach(model, width=16):
    """Give a model a student that is scaled as by :meth:`distill`, and has learned nothing else."""
    student = Student(model.observation_space, model.action_space, width)
    student.scale_to(th.randn(9, len(student.mean), generator=th.Generator().manual_seed(0)))
    model.policy.student, model.student_width = student.to(model.device), width
    return model


def observe(n=7, env=None):
    """Return n observations of one episode, as a batch."""
    env = delayed() if env is None else env
    rows = [env.reset(seed=1)[0]]
    rows += [env.step(np.array([0.3 * k - 1.0], np.float32))[0] for k in range(n - 1)]
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


def rows_of(batch):
    return [{key: value[i] for key, value in batch.items()} for i in range(len(batch["delay"]))]


def observation(**kwargs):
    """Return one observation amid an episode of ``delayed(**kwargs)``."""
    return rows_of(observe(6, delayed(**kwargs)))[-1]


def answer(model, obs, deterministic=True):
    return model.predict(obs, deterministic=deterministic)[0]


def same_replay(first, second):
    first, second = first.replay_buffer.state_dict(), second.replay_buffer.state_dict()
    keys = ("observations", "actions", "rewards", "ages", "steps")
    return all(np.array_equal(first[key], second[key]) for key in keys)
