"""Runs that learn from logs. Their environment gives spaces and delay; the training takes no step in it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_said.files.checkpoint import TrainingCheckpointCallback
from sb3_said.offline import OfflineAlgorithm
from sb3_said.said import SAID
from sb3_said.said.training import planner_checkpoint
from sb3_said.zoo.experiment import Run
from sb3_said.zoo.manager import DelayedExperimentManager


class OfflineExperimentManager(DelayedExperimentManager):
    """The manager for ``--dataset``. Steps are gradient steps; in SAID, those of the planner.

    :param run: what our command line adds
    :param args: rl_zoo3's parsed arguments; the parameters after it are those of rl_zoo3's manager
    :raises ValueError: for a run that another process trains or that cannot go on, and for an option without effect
    """

    LOG_INTERVAL = 500  # gradient steps

    def __init__(self, run: Run, args: argparse.Namespace, algo: str, env_id: str, *zoo_args: Any, **zoo_kwargs: Any):
        super().__init__(run, args, algo, env_id, *zoo_args, **zoo_kwargs)
        given = {"-params planner_gradient_steps": "planner_gradient_steps" in (self.custom_hyperparams or {})}
        given |= {"--save-replay-buffer": self.save_replay_buffer}
        if unused := [name for name, is_given in given.items() if is_given]:
            self.release()
            raise ValueError(
                f"{', '.join(unused)} has no place in a training from logs, whose steps -n sets and whose replay the "
                "dataset is: leave it out."
            )

    def _set_up(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Make the agent as rl_zoo3 does, and read the dataset."""
        made = super()._set_up()
        assert made is not None and isinstance(made[0], OfflineAlgorithm)  # the constructor refuses -optimize
        model = made[0]
        model.take_dataset([*self.run.dataset], self.show_progress)
        replay = model.replay_buffer
        print(f"Learning from {replay.size():,} logged steps; no environment is stepped but in evaluations.")
        return made

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        made = super()._preprocess_hyperparams(hyperparams)
        if self.algo == "said":
            made[0]["planner_gradient_steps"] = self.n_timesteps
        return made

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Make environments that write no monitor file."""
        return super().create_envs(n_envs, eval_env, no_log=True)

    def create_callbacks(self) -> None:
        n_envs, self.n_envs = self.n_envs, 1  # rl_zoo3 divides intervals by it; a gradient step is one step
        super().create_callbacks()
        self.n_envs = n_envs
        # rl_zoo3's progress bar counts the steps of environments
        self.callbacks = [c for c in self.callbacks if not isinstance(c, ProgressBarCallback)]

    def _evaluated_in(self) -> Path:
        return self.folder  # there is no expert: evaluations are of the agent

    def _add_checkpoints(self) -> None:
        freq, stopping = self.run.checkpoint_freq, self.stopping
        self.checkpointing = TrainingCheckpointCallback(self.folder, freq, stopping, keeps_replay=False)
        if self.algo != "said":  # SAID's planner writes its own
            self.callbacks.append(self.checkpointing)

    def _learn(self, model: Any, steps: int, **how: Any) -> None:
        if isinstance(model, SAID):
            how |= {"folder": self.folder, "should_stop": self.stopping, "save_interval": self.run.checkpoint_freq}
        model.learn_offline(None, steps, progress_bar=self.show_progress, **how)

    def _save_checkpoint(self, model: Any) -> bool:
        if self.algo != "said":
            return super()._save_checkpoint(model)
        mask = model.policy.planner.config.mask
        return planner_checkpoint(self.folder, mask).is_file()  # written when the planner was asked to stop
