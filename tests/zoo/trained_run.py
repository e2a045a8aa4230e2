"""Runs that the command line left, which here were hardly trained."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from small_run import ENV

from sb3_said import SAID
from sb3_said.zoo import evaluate, train, tune
from sb3_said.zoo.arguments import Delay
from sb3_said.zoo.experiment import Run
from sb3_said.zoo.manager import DelayedExperimentManager

NETWORKS = "policy_kwargs:dict(net_arch=[16])"
PLANNER = "dict(depth=1, d_model=32, horizon=4, sampling_steps=1, n_candidates=2, batch_size=8)"


def train_here(folder: Path, command: str, *more: str | Path) -> None:
    """Train in this process, quickly and quietly."""
    common = "--num-threads 1 --eval-freq -1 --device cpu --verbose 0 -f".split()
    train.main([*command.split(), *common, str(folder), *map(str, more)])


def train_run(folder: Path, algo: str, *params: str, delay: Sequence[int] = (2,), options: Sequence[str] = ()) -> Path:
    train.main(
        ["--algo", algo, "--env", ENV, "--delay", *map(str, delay), "-f", str(folder), "--seed", "3",
         "--num-threads", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0", "-n", "120", *options,
         "-params", "learning_starts:80", "buffer_size:400", NETWORKS, *params]
    )  # fmt: skip
    return next((folder / algo).iterdir())


def train_said(folder: Path, *params: str, delay: Sequence[int] = (2,)) -> Path:
    planner = ("planner_gradient_steps:3", "planner_trial_episodes:1", f"planner_kwargs:{PLANNER}")
    return train_run(folder, "said", *planner, *params, delay=delay)


def report_quickly(patch: pytest.MonkeyPatch) -> None:
    """Let a search's report time few decisions and draw no plot."""
    patch.setattr(tune, "evaluate", lambda *how, latency_calls: evaluate.evaluate(*how, latency_calls=2))
    patch.setattr(tune, "save_plot", lambda *_: None)


def read_by_train(best: Path, delay: Delay, folder: Path) -> dict[str, Any]:
    """Return the hyper-parameters that a training gets from a best.yml."""
    run = Run(delay, "cpu")
    manager = DelayedExperimentManager(run, Namespace(), "said", ENV, str(folder), config=str(best), verbose=0)
    return manager.read_hyperparameters()[0]


def config_of(run: Path) -> dict[str, Any]:
    """Return the hyper-parameters that a run was last trained with."""
    (file,) = run.glob("*/config.yml")
    return dict(yaml.load(file.read_text(), Loader=yaml.UnsafeLoader))


def same_agents(left: Path, right: Path) -> bool:
    one, other = (SAID.load(run / f"{ENV}.zip", device="cpu").policy.state_dict() for run in (left, right))
    return all((one[key] == other[key]).all() for key in one)
