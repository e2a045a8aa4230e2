"""What slow answers cost an agent: episodes in which the task does not wait for them."""

from __future__ import annotations

import math
from typing import Any

from tqdm import tqdm

from sb3_said.evaluation import Summary, rollout
from sb3_said.realtime import ControlLoop, LoopedModel
from sb3_said.zoo.runs import LoadedRun, answering

#: Names of the rows, and whether the agent counts the time of its answers as delay.
REAL_TIME = {"in real time": True, "latency ignored": False}


def evaluate_in_real_time(
    run: LoadedRun, answer: str | None, n_episodes: int, seed: int, period: float, deterministic: bool = True
) -> list[tuple[Summary, dict[str, Any]]]:
    """Play episodes in which the task goes on while this machine answers. Without a new action the last is held.

    The time of every answer is measured and rounded up to whole periods. One row counts it as part of the delay. The
    other sends an answer whenever it arrives, as if it had taken no time.

    :param answer: who answers: one of :func:`~sb3_said.zoo.runs.answers`
    :param period: of the control loop, in seconds
    :return: for each row of ``REAL_TIME`` its episodes, and what its loop counted
    """
    rows = []
    for name, counts in REAL_TIME.items():
        label = f"{answer or run.info['algo']}, {name}"
        with answering(run.model, answer), tqdm(total=n_episodes, desc=label, unit="episode", leave=False) as bar:
            loop = ControlLoop(
                run.model,
                period,
                hold_steps=None,
                deterministic=deterministic,
                normalize=run.normalize,
                count_latency=counts,
                simulate=lambda seconds: math.ceil(seconds / period),
            )
            played = rollout(LoopedModel(loop), run.make_env, n_episodes, seed, on_episode=lambda *_: bar.update())
        rows.append((played.summary(label), loop.statistics().to_dict()))
    return rows
