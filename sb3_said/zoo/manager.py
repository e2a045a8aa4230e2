"""Our algorithms, delays and resumable runs inside rl_zoo3's ``ExperimentManager``."""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecEnv

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC, PlannerTrainingCallback
from sb3_said.delays.text import make_process
from sb3_said.files.atomic import write_json
from sb3_said.files.checkpoint import CHECKPOINT_NAME, TrainingCheckpointCallback, restore_training
from sb3_said.zoo.arguments import Delay, largest_delay
from sb3_said.zoo.presets import config_file, preset_overrides

ARGUMENTS_NAME = "train_args.json"
WRAPPER = "sb3_said.delays.DelayedObservationWrapper"

#: What each name on the command line is: a class and the flags that make it so.
ALGORITHMS: dict[str, tuple[type[DelayedSAC], dict[str, bool]]] = {
    "said": (SAID, {}),
    "sac": (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": False}),
    "sa": (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": False}),
    "dr": (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": True}),
    "sadr": (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": True}),
}
for _name, (_class, _) in ALGORITHMS.items():
    ALGOS[_name] = _class
    HYPERPARAMS_SAMPLER[_name] = HYPERPARAMS_SAMPLER["sac"]
    HYPERPARAMS_CONVERTER[_name] = HYPERPARAMS_CONVERTER["sac"]


@dataclass(frozen=True)
class Run:
    """What our command line adds to rl_zoo3's.

    :param argv: the command line, so that a resumed run can be set up as it was
    :param delay: what the wrapper is given; None for no wrapper
    :param preset: see ``preset_overrides``
    :param checkpoint_freq: environment steps between checkpoints
    :param resume: folder of the run to continue
    :param expert_delay: what the expert learns under, ``delay`` by default; the planner serves ``delay`` in any case
    """

    argv: list[str]
    delay: Delay
    preset: str
    checkpoint_freq: int
    resume: Path | None = None
    expert_delay: Delay = None

    @property
    def delay_name(self) -> str:
        """Name of the delays in paths, e.g. ``-delay4``, ``-delayUniformDelay-0-8`` or ``-delay0-8-expert0``."""
        parts = [("delay", self.delay), ("expert", self.expert_delay)]
        words = {name: "-".join(re.findall(r"[\w.]+", str(delay))) for name, delay in parts if delay is not None}
        return "".join(f"-{name}{text}" for name, text in words.items())

    @property
    def max_delay(self) -> int:
        """Largest delay that planner or expert will meet."""
        return max(largest_delay(self.delay), largest_delay(self.expert_delay))


class DelayedExperimentManager(ExperimentManager):
    """rl_zoo3's manager with delays, presets and resumable runs.

    :param run: what our command line adds
    :param args: rl_zoo3's parsed arguments, then its own parameters
    """

    def __init__(self, run: Run, args: argparse.Namespace, algo: str, env_id: str, *zoo_args: Any, **zoo_kwargs: Any):
        zoo_kwargs["config"] = zoo_kwargs.get("config") or str(config_file(algo))
        super().__init__(args, algo, env_id, *zoo_args, **zoo_kwargs)
        self.run = run
        name = f"{self.env_name}{run.delay_name}"
        run_id = get_latest_run_id(self.log_path, name) + 1
        new_path = str(Path(self.log_path) / f"{name}_{run_id}") + zoo_kwargs.get("uuid_str", "")
        self.save_path = new_path if run.resume is None else str(run.resume)
        self.params_path = f"{self.save_path}/{self.env_name}"

        overrides = preset_overrides(self.config, run.preset, env_id, run.delay, run.max_delay)
        overrides |= ALGORITHMS[algo][1]
        if run.delay is not None:
            largest = {} if run.expert_delay is None else {"max_delay": run.max_delay}
            overrides["env_wrapper"] = [{WRAPPER: {"delay": run.delay, **largest}}]
        if run.expert_delay is not None and "env_wrapper" in (self.custom_hyperparams or {}):
            raise ValueError("--expert-delay sets the wrapper itself; leave env_wrapper out of -params.")
        self.custom_hyperparams = {**overrides, **(self.custom_hyperparams or {})}

    def create_envs(self, *args: Any, **kwargs: Any) -> VecEnv:
        """Make environments of the expert's delay, in training as in the evaluations beside it.

        The run's settings on disk keep the delay that the agent is for.
        """
        if self.run.expert_delay is not None:
            process = make_process(self.run.expert_delay)
            self.env_wrapper = functools.partial(DelayedObservationWrapper, delay=process, max_delay=self.run.max_delay)
        return super().create_envs(*args, **kwargs)

    @property
    def checkpoint(self) -> Path:
        """File that a killed run goes on from."""
        return Path(self.save_path) / CHECKPOINT_NAME

    def create_log_folder(self) -> None:
        super().create_log_folder()
        self.monitor_kwargs["override_existing"] = not self.checkpoint.exists()
        drawn = [] if "--seed" in self.run.argv else ["--seed", str(self.seed)]
        write_json(Path(self.save_path) / ARGUMENTS_NAME, [*self.run.argv, *drawn])

    def create_callbacks(self) -> None:
        super().create_callbacks()
        self.callbacks.append(TrainingCheckpointCallback(self.save_path, self.run.checkpoint_freq))
        if self.algo == "said":
            self.callbacks.append(PlannerTrainingCallback(folder=self.save_path, progress_bar=self.show_progress))

    def learn(self, model: BaseAlgorithm) -> None:
        """Train, from the last checkpoint if there is one; Ctrl-C ends the training and keeps what was learned.

        :param model: newly made
        """
        resumes = self.checkpoint.exists()
        if resumes:
            restore_training(model, self.checkpoint, CallbackList(self.callbacks))  # type: ignore[arg-type]
            print(f"Resuming {self.save_path} at step {model.num_timesteps}")
            drop_undone_episodes(Path(self.save_path), model.num_timesteps // model.n_envs)
        taken = model.num_timesteps if resumes else 0  # learn() counts the steps of an agent given with -i anew
        model.set_logger(self._logger(taken))
        # rl_zoo3: -1 is the default, anything below logs nothing by itself
        log_interval = {-1: 4}.get(self.log_interval, self.log_interval if self.log_interval > 0 else None)
        try:
            model.learn(
                max(self.n_timesteps - taken, 0),
                callback=self.callbacks,
                log_interval=log_interval,  # type: ignore[arg-type]  # SB3 takes None and says so in its docstring
                reset_num_timesteps=not resumes,
            )
        except KeyboardInterrupt:
            print(f"Interrupted at step {model.num_timesteps}; go on with --resume {self.save_path}")
        finally:
            if model.env is not None:
                model.env.close()

    def _logger(self, steps: int) -> Logger:
        """Log to the screen, to progress.csv (one file per resume) and to TensorBoard if asked for.

        :param steps: environment steps the run has taken
        """
        formats = [make_output_format("csv", self.save_path, log_suffix(Path(self.save_path), steps))]
        if self.verbose > 0:
            formats.append(make_output_format("stdout", self.save_path))
        if self.tensorboard_log is not None:
            formats.append(make_output_format("tensorboard", f"{self.tensorboard_log}/{Path(self.save_path).name}"))
        return Logger(self.save_path, formats)


def log_suffix(folder: Path, steps: int) -> str:
    """Return a suffix of ``progress.csv`` that no log has yet.

    :param folder: of the run
    :param steps: environment steps that the run has taken
    """
    names = ["" if steps == 0 else f"_{steps}", *(f"_{steps}_{k}" for k in range(2, 1000))]
    return next(name for name in names if not (folder / f"progress{name}.csv").exists())


def drop_undone_episodes(run_dir: Path, steps: int) -> None:
    """Cut from SB3's monitor files the episodes that a resume undoes: those that ended after the checkpoint.

    The episode during which the checkpoint was written is missing from the files.

    :param steps: environment steps up to the checkpoint, of each environment
    """
    for file in run_dir.glob("*.monitor.csv"):
        lines = file.read_bytes().splitlines(keepends=True)
        size, taken = len(b"".join(lines[:2])), 0  # a comment and the header: r,l,t
        for line in lines[2:]:
            taken += int(line.split(b",")[1]) if line.endswith(b"\n") else steps + 1  # unfinished: undone, too
            if taken > steps:
                break
            size += len(line)
        os.truncate(file, size)  # in place: the environments have opened it, to append to it


def read_arguments(run_dir: Path) -> list[str]:
    """Return the command line that a run was started with.

    :raises ValueError: when the folder holds no run
    """
    path = run_dir / ARGUMENTS_NAME
    if not path.exists():
        raise ValueError(
            f"{run_dir} holds no run: {path} is missing. Give the folder that the training printed as 'Log path'."
        )
    return list(json.loads(path.read_text()))
