"""Trains the planner while or after an expert learns."""

from __future__ import annotations

import warnings
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback
from tqdm.auto import tqdm

from sb3_said.files.archive import load_tree, save_tree
from sb3_said.planner.trainer import worse_than_regression

if TYPE_CHECKING:
    from sb3_said.said.said import SAID

PLANNER_CHECKPOINT_NAME = "planner_checkpoint.zip"


class PlannerTrainingCallback(BaseCallback):
    """Train SAID's planner when learning ends, and every ``planner_train_freq`` steps where the agent says so.

    How long and on what is the agent's to say (``planner_gradient_steps``, ``planner_newest_fraction``); the networks
    are the agent's too. Interrupting (Ctrl-C) ends the training early and keeps the planner as far as it got.

    :param log_interval: updates between two rows of losses in the log
    :param eval_interval: updates between two measurements of the held-out errors, beside the regression's
    :param folder: keep a checkpoint there and continue from it if it is of the same training
    :param save_interval: updates between two checkpoints
    :param progress_bar: show one
    """

    model: SAID

    def __init__(
        self,
        log_interval: int = 500,
        eval_interval: int = 2_000,
        folder: str | Path | None = None,
        save_interval: int = 1_000,
        progress_bar: bool = False,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.log_interval = log_interval
        self.eval_interval = eval_interval
        self.checkpoint = None if folder is None else Path(folder) / PLANNER_CHECKPOINT_NAME
        self.save_interval = save_interval
        self.progress_bar = progress_bar

    def _on_training_start(self) -> None:
        if self.model.num_timesteps < self.model._planner_trained_at:  # counting began anew
            self.model._planner_trained_at = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # Here, and not in on_step, the replay buffer holds every step taken.
        freq, now = self.model.planner_train_freq, self.model.num_timesteps
        if freq is not None and now // freq > self.model._planner_trained_at // freq:
            self.train_planner()

    def _on_training_end(self) -> None:
        # A training that took no steps since the last one, or was ended twice, has nothing new to learn from.
        is_new = self.model._planner_trained_at != self.model.num_timesteps
        if is_new and self.model.replay_buffer.size() > 0:
            self.train_planner()

    def train_planner(self, gradient_steps: int | None = None) -> None:
        """Train the planner on the agent's replay buffer now.

        :param gradient_steps: the agent's ``planner_gradient_steps`` by default
        """
        model = self.model
        trainer = model.make_planner_trainer(gradient_steps)
        buffer = model.replay_buffer
        data = {"num_timesteps": model.num_timesteps, "replay": zlib.crc32(buffer.actions[: buffer.size()].data)}
        if self.checkpoint is not None and self.checkpoint.exists():
            state = load_tree(self.checkpoint)
            if all(state.get(key, value) == value for key, value in data.items()):
                trainer.load_state_dict(state["trainer"])
        total = trainer.gradient_steps
        bar = tqdm(total=total, initial=trainer.n_updates, desc="planner", disable=not self.progress_bar)
        try:
            while trainer.n_updates < total:
                trainer.step()
                bar.update()
                done = trainer.n_updates
                if done % self.log_interval == 0 or done == total:
                    losses = trainer.pop_losses()
                    bar.set_postfix(loss=losses["planner/loss"])
                    errors = trainer.evaluate() if done % self.eval_interval == 0 or done == total else {}
                    for key, value in {**losses, **errors, "planner/n_updates": done}.items():
                        model.logger.record(key, value)
                    model.logger.dump(model.num_timesteps + done)
                    if done == total and (worse := worse_than_regression(errors)):
                        warnings.warn(
                            f"On held-out windows the planner is still worse than a small regression: {worse}. It is "
                            "undertrained; give it more planner_gradient_steps, or more data.",
                            stacklevel=2,
                        )
                if self.checkpoint is not None and (done % self.save_interval == 0 or done == total):
                    save_tree(self.checkpoint, {**data, "trainer": trainer.state_dict()})
        except KeyboardInterrupt:
            print(f"Planner training interrupted after {trainer.n_updates} of {total} updates; its weights are kept.")
        finally:
            bar.close()
        if trainer.n_updates > 0:  # else an earlier training's stays
            model.policy.planner_updates.fill_(float(trainer.n_updates))
        model._planner_trained_at = model.num_timesteps
