"""A run's planners of several depths, each trained once, however many workers and trials ask for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_said.files.archive import load_tree, readable, save_tree
from sb3_said.files.checkpoint import crc32
from sb3_said.files.checks import check_tensors
from sb3_said.planner.checks import check_same
from sb3_said.planner.trainer import seeded
from sb3_said.said import SAID
from sb3_said.said.training import planner_checkpoint
from sb3_said.zoo.folder import log_suffix, resuming
from sb3_said.zoo.stopping import Stopping


class DepthPlanners:
    """Trains planners of any depth on a run's replay, and puts them into its agent.

    A depth's weights are kept in ``FOLDER/planner_depthN.zip``, for all workers. The run's own planner serves its depth
    if it had as many updates. The agent gets each planner in turn; its expert stays as it is.

    :param model: the run's agent
    :param checkpoint: the run's ``checkpoint.zip`` with the replay; read when a planner has to be trained
    :param folder: for the planners
    :param gradient_steps: updates of each planner; the agent's ``planner_gradient_steps`` by default
    :param progress_bar: show one while training
    :param dataset: logs that the run learned from; they are read instead of the checkpoint
    """

    def __init__(
        self,
        model: SAID,
        checkpoint: Path,
        folder: Path,
        gradient_steps: int | None = None,
        progress_bar: bool = False,
        dataset: Sequence[str] = (),
    ):
        self.dataset = dataset
        self.model, self.checkpoint, self.folder, self.progress_bar = model, checkpoint, folder, progress_bar
        self.gradient_steps = gradient_steps or model.planner_gradient_steps
        self.config = replace(model.policy.planner.config, decided_by="plan")  # else all trials would be alike
        serves = int(model.policy.planner_updates) == self.gradient_steps
        self._own = model.policy.planner if serves else None
        self._agent = f"{crc32(weight.numpy(force=True) for weight in model.policy.parameters()):08x}"

    def path(self, depth: int) -> Path:
        """Where the planner of a depth is kept."""
        return self.folder / f"planner_depth{depth}.zip"

    def training(self, depth: int) -> dict[str, Any]:
        """Return what decides a planner's weights, in JSON types. The agent's checksum stands for the replay."""
        return {
            "agent": self._agent,
            "gradient_steps": self.gradient_steps,
            # With logs it is 1.0. The agent says so only once they are loaded; they are not if nothing is left to train
            "newest_fraction": 1.0 if self.dataset else self.model.newest_fraction,
            "terminal_penalty": self.model.planner_terminal_penalty,
            "training_seed": self.model.seed or 0,
            "trained_steps": self.model.num_timesteps,
            **replace(self.config, depth=depth).weight_settings(),
        }

    def train(self, depths: Sequence[int]) -> None:
        """Train each depth that is not there yet: first those that no other worker trains. Then wait for the rest.

        A killed training goes on from its checkpoint.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for waits in (False, True):
            for depth in depths:
                try:
                    with FileLock(self.folder / f"planner_depth{depth}.lock").acquire(blocking=waits):
                        if not self.path(depth).exists():
                            self._train(depth)
                except Timeout:
                    print(f"Another worker trains the planner of depth {depth}.", flush=True)

    def put(self, depth: int, **sampling: Any) -> None:
        """Let the agent answer with the planner of this depth, which is trained.

        :param sampling: settings of :meth:`~sb3_said.said.SAID.set_planner`; the run's own by default
        :raises ValueError: when the planner in the folder is of another training
        """
        saved = load_tree(self.path(depth))
        advice = "Tune as before, or into another folder, or delete the file to train anew."
        with readable(self.path(depth), explained=(ValueError,)):
            check_same(f"{self.path(depth)} was trained", saved["settings"], self.training(depth), advice)
        policy = self.model.policy
        policy.make_planner(replace(self.config, depth=depth, **sampling))
        with readable(self.path(depth)):
            check_tensors("planner", saved["planner"], policy.planner.state_dict())
            policy.planner.load_state_dict(saved["planner"])
        policy.planner_updates.fill_(float(self.gradient_steps))
        policy.set_answer("planner")  # in place of whoever answers in the run

    def _train(self, depth: int) -> None:
        planner = self._own
        if planner is None or planner.config.depth != depth:
            with seeded(self.model.seed or 0):  # the first weights are the same, whichever worker trains
                self.model.policy.make_planner(replace(self.config, depth=depth))
            self._load_replay()
            self._update_planner(depth)
            planner = self.model.policy.planner
        save_tree(self.path(depth), {"settings": self.training(depth), "planner": dict(planner.state_dict())})

    def _load_replay(self) -> None:
        buffer = self.model.replay_buffer
        if buffer.size() > 0:
            return
        if self.dataset:
            self.model.take_dataset([*self.dataset], self.progress_bar)
            return
        state = load_tree(self.checkpoint)
        with readable(self.checkpoint, explained=(ValueError,)):
            steps = state["counters"]["num_timesteps"]
            if steps != self.model.num_timesteps:
                raise ValueError(
                    f"the agent has seen {self.model.num_timesteps} steps, the replay is of step {steps}; finish the "
                    f"run first: sb3-said train {resuming(self.checkpoint.parent)}"
                )
            buffer.load_state_dict(state["replay_buffer"])

    def _update_planner(self, depth: int) -> None:
        folder = self.folder / f"planner_depth{depth}"
        folder.mkdir(exist_ok=True)
        log = make_output_format("csv", str(folder), log_suffix(folder, 0))
        self.model.set_logger(Logger(str(folder), [log]))
        print(f"Training the planner of depth {depth}: {self.gradient_steps} updates", flush=True)
        policy = self.model.policy
        values, policy.values = policy.values, None  # all depths share the run's V(s): None trains no other
        stopping = Stopping()
        try:
            with stopping.listening():
                self.model.train_planner(self.gradient_steps, folder, self.progress_bar, should_stop=stopping)
        finally:
            policy.values = values
        self.model.logger.close()
        if int(self.model.policy.planner_updates) < self.gradient_steps:
            raise KeyboardInterrupt  # half a planner serves no comparison
        planner_checkpoint(folder, self.config.mask).unlink(missing_ok=True)
