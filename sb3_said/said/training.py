"""One training of SAID's planner: values beside it, rows in the log, and a checkpoint to go on from."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from tqdm.auto import tqdm

from sb3_said.files.archive import load_tree, readable
from sb3_said.files.checkpoint import CheckpointClock, checksum
from sb3_said.files.checks import check_optimizer_state
from sb3_said.files.evaluations import evaluations_of, restore_evaluations
from sb3_said.offline.iql import IQL
from sb3_said.planner.checks import check_same
from sb3_said.planner.config import PlannerConfig
from sb3_said.planner.held_out import worse_than_regression
from sb3_said.planner.trainer import GUESS_UPDATES, GUESS_UPDATES_EACH, PlannerTrainer
from sb3_said.said.agent import PlannerAgent

PLANNER_CHECKPOINT_NAME = "planner_checkpoint.zip"
SECOND_CHECKPOINT_NAME = "planner_{mask}_checkpoint.zip"  # of a planner with another mask than the default


def planner_checkpoint(folder: Path, mask: str) -> Path:
    """Return a planner's checkpoint. It is named by the mask, as a trial may make another planner the agent's own."""
    is_first = mask == PlannerConfig.mask
    return folder / (PLANNER_CHECKPOINT_NAME if is_first else SECOND_CHECKPOINT_NAME.format(mask=mask))


class PlannerTraining:
    """Runs a trainer of the planner, and one of its values, to their end.

    :param model: whose planner it is
    :param trainer: of the planner
    :param value_trainer: trained beside it, None for none
    :param row: maps the number of updates made to where their row stands in the log
    :param folder: this and the next three as of :meth:`~sb3_said.said.SAID.train_planner`
    :param watcher: callbacks, whose ``EvalCallback`` evaluations the checkpoint keeps, too
    :raises SavedFileError: when the checkpoint is damaged, of a training with other settings, or of one on other logs
    """

    def __init__(
        self,
        model: PlannerAgent,
        trainer: PlannerTrainer,
        value_trainer: IQL | None,
        row: Callable[[int], int],
        folder: str | Path | None,
        log_interval: int | None,
        eval_interval: int | None,
        save_interval: int | None,
        watcher: BaseCallback | None = None,
    ):
        self.model, self.trainer, self.value_trainer, self.row = model, trainer, value_trainer, row
        self.log_interval, self.eval_interval, self.save_interval = log_interval, eval_interval, save_interval
        self.is_agents = trainer.planner is model.policy.planner  # else it is another one, for a trial
        mask = trainer.config.mask
        self.name = "planner" if self.is_agents else f"planner of mask={mask!r}"
        self._clock = None if folder is None else CheckpointClock(planner_checkpoint(Path(folder), mask))
        self.watcher = watcher
        self.has_handed_over = False
        self._data = {"num_timesteps": model.num_timesteps, "replay": checksum(model)}
        self._weighed = {name: getattr(model, name) for name in ("gamma", "planner_terminal_penalty", "value")}
        self._value_losses: dict[str, th.Tensor] = {}  # of the last update; read at log times only
        if self._clock is not None and self._clock.path.exists():
            state = load_tree(self._clock.path)
            with readable(self._clock.path, explained=(ValueError,)):
                if {key: state[key] for key in self._data} == self._data:
                    advice = "Give what it began with, or another folder."
                    check_same("The planner's training was begun", state["weighed"], self._weighed, advice)
                    for name, optimizer in trainer.optimizers.items():
                        check_optimizer_state(name, state["trainer"][name], optimizer)
                    trainer.load_state_dict(state["trainer"])
                    if value_trainer is not None:
                        check_optimizer_state("values", state["values"]["optimizer"], value_trainer.optimizer)
                        value_trainer.load_state_dict(state["values"])
                    restore_evaluations(watcher, state["evaluations"])
                elif watcher is not None:  # on logs, where a folder has one training alone
                    raise ValueError("it is of a training on other data; give the same logs, or another folder")

    def run(
        self,
        progress_bar: bool = False,
        should_stop: Callable[[], bool] | None = None,
        on_step: Callable[[int], bool] | None = None,
    ) -> Literal["done", "interrupted", "stopped"]:
        """Make all updates that are left, and hand over. Ctrl-C ends the training early and keeps what was learned.

        :param should_stop: asked after every update; if it returns True, a checkpoint is written and the training ends.
            While the first guess learns, which takes minutes, no checkpoint is written
        :param on_step: called after each update with the number made; the training ends when it returns False
        :return: ``"interrupted"`` after Ctrl-C, ``"stopped"`` where ``should_stop`` asked for the end
        """
        trainer, total = self.trainer, self.trainer.gradient_steps
        outcome: Literal["done", "interrupted", "stopped"] = "done"

        def on_update(trainer: PlannerTrainer) -> bool:
            nonlocal outcome
            bar.update()
            done = trainer.n_updates
            is_end = done == total
            self._train_values()
            if is_end or (self.log_interval is not None and done % self.log_interval == 0):
                evaluates = is_end or (self.eval_interval is not None and done % self.eval_interval == 0)
                bar.set_postfix(loss=self._log_row(evaluates))
            goes_on = on_step is None or on_step(done)  # before the checkpoint, which keeps what callbacks counted
            outcome = "stopped" if should_stop is not None and should_stop() else "done"
            clock = self._clock
            if clock is not None and (self._is_due(clock, done) or is_end or outcome == "stopped"):
                clock.save("The planner's checkpoint", self._state())
            return outcome == "done" and goes_on

        try:
            if trainer.make_first_guess(progress_bar, should_stop):
                with tqdm(total=total, initial=trainer.n_updates, desc=self.name, disable=not progress_bar) as bar:
                    trainer.train(callback=on_update)
            else:
                outcome = "stopped"
        except KeyboardInterrupt:
            outcome = "stopped" if should_stop is not None and should_stop() else "interrupted"
            result = "keeps what it learned" if trainer.n_updates > 0 else "stays as it was"
            result = result if self.is_agents else "is left out, and no trial is played"
            print(f"Training of the {self.name} interrupted after {trainer.n_updates} of {total} updates; it {result}.")
        self.hand_over()
        return outcome

    def hand_over(self) -> None:
        """Give the planner its weights, and the agent V(s), as far as trained; before the first update, change nothing.

        An agent's own planner answers from then on.

        :raises FloatingPointError: when an update was not finite; all stays as it was
        """
        if self.value_trainer is not None:
            self.value_trainer.check_finite()
        self.trainer.hand_over()
        self.has_handed_over = self.trainer.n_updates > 0
        if self.has_handed_over and self.is_agents:
            self.model.policy.planner_updates.fill_(float(self.trainer.n_updates))
            self.model.policy.set_answer("planner")
            if self.value_trainer is not None:
                values = self.model.policy.values
                assert values is not None  # else it would have no trainer
                values.load_state_dict(self.value_trainer.values.state_dict())

    def log(self, values: Mapping[str, float | str]) -> None:
        """Write a row to the agent's logger. What the logger holds already stays for its next row."""
        logger = self.model.logger
        pending: list[tuple[Any, Any]] = [
            (x, x.copy()) for x in (logger.name_to_value, logger.name_to_count, logger.name_to_excluded)
        ]
        for entries, _ in pending:
            entries.clear()
        for key, value in values.items():
            logger.record(key, value)
        row = self.row(self.trainer.n_updates)
        logger.record("time/total_timesteps", row, exclude="tensorboard")  # as SB3's evaluations do: a CSV has no other
        logger.dump(row)
        for entries, before in pending:
            entries.clear()  # a disabled logger has not cleared them
            entries.update(before)

    def _is_due(self, clock: CheckpointClock, n_updates: int) -> bool:
        return clock.is_due() if self.save_interval is None else n_updates % self.save_interval == 0

    def _train_values(self) -> None:
        if self.value_trainer is None:
            return
        for _ in range(self.value_trainer.values.config.updates):
            self._value_losses = self.value_trainer.step()

    def _log_row(self, evaluates: bool) -> float:
        """Write losses, and the held-out errors if asked for; return the loss."""
        losses = self.trainer.pop_losses()
        errors = self.trainer.evaluate() if evaluates else {}
        value_losses = {f"iql/{name}": loss.item() for name, loss in self._value_losses.items()}
        self.log({**losses, **value_losses, **errors, "planner/n_updates": self.trainer.n_updates})
        is_end = self.trainer.n_updates == self.trainer.gradient_steps
        if is_end and (worse := worse_than_regression(errors)):
            # A guessed present is the first guess's, whose updates end at a number of their own
            is_guess = self.trainer.config.present == "guessed" and "action_error" not in worse
            has_all = self.trainer.gradient_steps * GUESS_UPDATES_EACH >= GUESS_UPDATES
            more = "data" if is_guess and has_all else "planner_gradient_steps, or more data"
            warnings.warn(
                f"On held-out windows the {self.name} is still worse than a small regression: {worse}. It is "
                f"undertrained; give it more {more}.",
                stacklevel=6,
            )
        return losses["planner/loss"]

    def _state(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        values = None if self.value_trainer is None else self.value_trainer.state_dict()
        state = {**self._data, "weighed": self._weighed, "trainer": self.trainer.state_dict(), "values": values}
        return {**state, "evaluations": evaluations_of(self.watcher)}
