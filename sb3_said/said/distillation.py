"""How a student learns to answer as the planner does: from the replay, and from where it goes itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional as F
from tqdm.auto import tqdm

from sb3_said.delays.space import KEYS
from sb3_said.planner.checks import check_settings
from sb3_said.replay.windows import WindowSource
from sb3_said.said.agent import PlannerAgent
from sb3_said.said.policies import Answer
from sb3_said.said.student import Student, as_delayed

HELD_OUT = 0.05  # of the replay's labels
LABELLED_AT_ONCE = 512

Labelled = tuple[th.Tensor, th.Tensor]  # what the student reads, (M, n_inputs), and the answers, (M, act_dim)


@dataclass(frozen=True)
class Distillation:
    """How a student learns. The values are ours: they kept all of a Hopper-v5 planner's return, where a quarter of the
    visits and a third of the updates kept 81 % (results/student.md).
    """

    n_labels: int = 50_000
    """answers of the planner to observations from the replay, which are drawn like its windows, at any age that it
    plans at"""
    own_steps: int = 40_000
    """answers of the planner to observations that the student visits (DAgger, Ross et al. 2011), over all rounds"""
    rounds: int = 10
    """how often the student visits observations and learns on, after it has learned from the replay"""
    gradient_steps: int = 60_000
    """updates, over all rounds"""
    batch_size: int = 256
    learning_rate: float = 1e-3
    """of Adam; falls linearly to 0"""

    def __post_init__(self) -> None:
        check_settings(self, {"n_labels": 1, "own_steps": 0, "rounds": 0, "gradient_steps": 1, "batch_size": 1})
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate is {self.learning_rate}, expected a number above 0.")


def distill(model: PlannerAgent, config: Distillation, progress_bar: bool = False) -> float:
    """Train the policy's student, and return its error: the root mean square over labels that it did not learn from.

    :param model: with a trained planner, and a replay or an environment; without a replay, observations that the
        planner visits take its place
    :param progress_bar: show one
    """
    model.policy.set_training_mode(False)
    student, generator = _student_of(model), th.Generator().manual_seed(model.seed or 0)
    if model.replay_buffer is not None and model.replay_buffer.size() > 0:
        source = model.replay_buffer.window_source(model.newest_fraction, model.get_vec_normalize_env())
        n_parts = -(-config.n_labels // LABELLED_AT_ONCE)
        bar = tqdm(range(n_parts), desc="the planner's answers", disable=not progress_bar)
        read, labels = _joined([_replayed(model, source, generator) for _ in bar])
        read, labels = read[: config.n_labels], labels[: config.n_labels]
    else:
        read, labels = _visited(model, "planner", config.n_labels, generator)
    n_held_out = int(HELD_OUT * len(read))
    held_out = read[:n_held_out], labels[:n_held_out]
    read, labels = read[n_held_out:], labels[n_held_out:]
    student.scale_to(read)
    optimizer = th.optim.Adam(student.network.parameters(), lr=config.learning_rate)
    schedule = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, config.gradient_steps)
    rounds = config.rounds if model.env is not None and config.own_steps > 0 else 0
    visits = {*np.linspace(0, config.gradient_steps, rounds + 2, dtype=int)[1:-1].tolist()}
    for k in tqdm(range(config.gradient_steps), desc="student", disable=not progress_bar):
        if k in visits:
            visited = _visited(model, "student", -(-config.own_steps // rounds), generator)
            read, labels = _joined([(read, labels), visited])
        drawn = th.randint(len(read), (config.batch_size,), generator=generator).to(read.device)
        loss = F.mse_loss(student.answer(read[drawn]), labels[drawn])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with th.no_grad():
        read, labels = held_out if n_held_out else (read, labels)
        return float(F.mse_loss(student.answer(read), labels).sqrt())


def _joined(parts: list[Labelled]) -> Labelled:
    read, labels = map(th.cat, zip(*parts, strict=True))
    return read, labels


def _student_of(model: PlannerAgent) -> Student:
    student = model.policy.student
    assert student is not None  # SAID.distill has made it
    return student


@th.no_grad()
def _labelled(model: PlannerAgent, parts: dict[str, th.Tensor]) -> Labelled:
    """Ask the planner at temperature 0 about delayed observations, or the actor where the actor decides."""
    batches = zip(*(parts[key].split(LABELLED_AT_ONCE) for key in KEYS), strict=True)
    labels = [model.policy.answer_without_noise(dict(zip(KEYS, batch, strict=True))) for batch in batches]
    is_delayed = isinstance(model.observation_space, spaces.Dict)
    inputs = _student_of(model).read(parts if is_delayed else parts["observation"])
    return inputs, th.cat(labels)


def _replayed(model: PlannerAgent, source: WindowSource, generator: th.Generator) -> Labelled:
    """Label observations of the replay, seen at ages that the planner plans at."""
    planner, n, max_delay = model.policy.planner, LABELLED_AT_ONCE, model.policy.max_delay
    windows = source.sample(n, max_delay + 1, generator, planner.config.early_probability)
    ages = th.full((n,), max_delay)
    if planner.config.mask != "fixed":
        ages = th.randint(max_delay + 1, (n,), generator=generator)
    ages = th.minimum(ages, windows.valid.sum(1) - 1)  # (B,): s_t is in the window
    steps = th.arange(max_delay) - (max_delay - ages)[:, None]  # (B, D): index of each action in the window
    history = windows.actions.gather(1, steps.clamp(min=0)[..., None].expand(-1, -1, planner.act_dim))
    history = th.where(steps[..., None] >= 0, history, 0.0)
    parts = {"observation": windows.states[:, 0], "action_history": history, "delay": ages[:, None].float()}
    return _labelled(model, {key: part.to(model.device) for key, part in parts.items()})


def _visited(model: PlannerAgent, who: Answer, n_steps: int, generator: th.Generator) -> Labelled:
    """Play the training environment, and label the observations met there."""
    visited: list[dict[str, th.Tensor]] = []
    with model.borrowed_env() as env, model.policy.answering(who, at_once=True):
        env.seed(int(th.randint(2**31, (), generator=generator)))
        obs: Any = env.reset()
        for _ in range(-(-n_steps // env.num_envs)):
            visited.append(as_delayed(model.policy.obs_to_tensor(obs)[0], model.policy.planner.act_dim))
            obs = env.step(model.predict(obs, deterministic=True)[0])[0]
    return _labelled(model, {key: th.cat([each[key] for each in visited]) for key in KEYS})
