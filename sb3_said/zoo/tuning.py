"""A run's planners of several depths, each trained once, however many workers and trials ask for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th
from filelock import FileLock
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_said.files.archive import load_tree, save_tree
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.config import SAMPLING_SETTINGS, weight_settings
from sb3_said.said.callbacks import PLANNER_CHECKPOINT_NAME, PlannerTrainingCallback
from sb3_said.said.said import SAID
from sb3_said.zoo.locks import try_acquire, work_lock

TRIED_SETTINGS = ("depth", "temperature", "sampling_steps")  # of the planner, what a search varies


class DepthPlanners:
    """Puts planners of any depth into an agent, training each at most once for all workers.

    A depth's weights are kept in ``FOLDER/planner_depthN.zip``. Where that is missing, the worker that gets the lock
    trains it on the run's replay; others that need it wait. A training that died is continued from its checkpoint. The
    run's own planner serves its depth when it had as many updates.

    :param model: the run's agent; its planner is replaced in place, its expert stays as it is
    :param checkpoint: the run's ``checkpoint.zip``, which holds the replay; read when a planner has to be trained
    :param folder: for the planners
    :param gradient_steps: updates of each planner; the agent's ``planner_gradient_steps`` by default
    :param progress_bar: show one while training
    """

    def __init__(
        self,
        model: SAID,
        checkpoint: str | Path,
        folder: str | Path,
        gradient_steps: int | None = None,
        progress_bar: bool = False,
    ):
        self.model = model
        self.checkpoint = Path(checkpoint)
        self.folder = Path(folder)
        self.gradient_steps = gradient_steps or model.planner_gradient_steps
        self.progress_bar = progress_bar
        self.config = model.policy.planner.config
        self._depth: int | None = None
        own = self.config.depth
        if int(model.policy.planner_updates) == self.gradient_steps and not self.is_ready(own):
            self._save(own)

    def path(self, depth: int) -> Path:
        """Where the planner of a depth is kept."""
        return self.folder / f"planner_depth{depth}.zip"

    def is_ready(self, depth: int) -> bool:
        """Whether a depth is trained."""
        return self.path(depth).exists()

    def lock(self, depth: int) -> FileLock:
        """Return the lock that a worker holds while it trains a depth."""
        return work_lock(self.folder / "locks" / f"planner_depth{depth}.lock")

    def put(self, depth: int, **sampling: Any) -> None:
        """Let the agent answer with the planner of this depth, after training it if nobody has.

        :param sampling: how it answers, see :meth:`~sb3_said.said.SAID.set_planner`
        :raises ValueError: when the planner or the replay in the folder is of another training
        """
        if self._depth != depth:
            self._replace_planner(depth)
            if not self.is_ready(depth):
                self._train_once(depth)
            self._load(depth)
            self._depth = depth
        self.model.set_planner(**sampling)

    def training_settings(self, depth: int) -> dict[str, Any]:
        """Return what decides a depth's weights, in JSON types: how the planner answers does not."""
        model, config = self.model, replace(self.config, depth=depth).to_dict()
        return {
            "gradient_steps": self.gradient_steps,
            "newest_fraction": model.planner_newest_fraction,
            "terminal_penalty": model.planner_terminal_penalty,
            "training_seed": model.seed or 0,
            "trained_steps": model.num_timesteps,
            "config": {key: value for key, value in config.items() if key not in SAMPLING_SETTINGS},
        }

    def trial_settings(self) -> dict[str, Any]:
        """Return what trials must share to be compared, in JSON types: all but what they try.

        How the planner answers is part of it: more candidates, for one, earn other returns with the same weights.
        """
        config = {key: value for key, value in self.config.to_dict().items() if key not in TRIED_SETTINGS}
        return {**self.training_settings(self.config.depth), "config": config}

    def _replace_planner(self, depth: int) -> None:
        model, policy = self.model, self.model.policy
        old = policy.planner
        with th.random.fork_rng(devices=[]):
            th.manual_seed(model.seed or 0)
            planner = InpaintingPlanner(old.obs_dim, old.act_dim, old.max_delay, replace(self.config, depth=depth))
        policy.planner = planner.to(model.device).requires_grad_(False)
        policy.planner_updates.zero_()
        policy.planner_kwargs = {**policy.planner_kwargs, "depth": depth}
        model.planner_kwargs = {**(model.planner_kwargs or {}), "depth": depth}
        policy.set_training_mode(False)
        self._depth = None

    def _train_once(self, depth: int) -> None:
        """Train a depth, or wait for the worker that does."""
        lock = self.lock(depth)
        if not try_acquire(lock):
            print(f"Another worker trains the planner of depth {depth}; waiting.", flush=True)
            lock.acquire(poll_interval=1.0)
        try:
            if not self.is_ready(depth):
                self._train(depth)
        finally:
            lock.release()

    def _train(self, depth: int) -> None:
        self._load_replay()
        folder = self.folder / f"planner_depth{depth}"
        folder.mkdir(parents=True, exist_ok=True)
        n_before = len(list(folder.glob("progress*.csv")))
        log = make_output_format("csv", str(folder), f"_{n_before}" if n_before else "")
        self.model.set_logger(Logger(str(folder), [log]))
        callback = PlannerTrainingCallback(folder=folder, progress_bar=self.progress_bar)
        callback.init_callback(self.model)
        print(f"Training the planner of depth {depth}: {self.gradient_steps} updates", flush=True)
        try:
            callback.train_planner(self.gradient_steps)
        except ValueError as error:
            raise ValueError(f"{error} The checkpoint is {folder / PLANNER_CHECKPOINT_NAME}.") from error
        finally:
            self.model.logger.close()
        if int(self.model.policy.planner_updates) < self.gradient_steps:
            raise KeyboardInterrupt  # the callback keeps what was learned, but half a planner serves no comparison
        self._save(depth)
        (folder / PLANNER_CHECKPOINT_NAME).unlink(missing_ok=True)

    def _load_replay(self) -> None:
        buffer = self.model.replay_buffer
        if buffer.size() > 0:
            return
        state = load_tree(self.checkpoint)
        steps = state["counters"]["num_timesteps"]
        if steps != self.model.num_timesteps:
            raise ValueError(
                f"The agent has seen {self.model.num_timesteps} steps, the replay in {self.checkpoint} is of step "
                f"{steps}; finish the run first: python scripts/train.py --resume {self.checkpoint.parent}"
            )
        buffer.load_state_dict(state["replay_buffer"])

    def _save(self, depth: int) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        planner = dict(self.model.policy.planner.state_dict())
        save_tree(self.path(depth), {"settings": self.training_settings(depth), "planner": planner})

    def _load(self, depth: int) -> None:
        saved = load_tree(self.path(depth))
        old, now = weight_settings(saved["settings"]), weight_settings(self.training_settings(depth))
        if differing := [key for key in now if old.get(key) != now[key]]:
            raise ValueError(
                f"{self.path(depth)} is of another training: "
                + "; ".join(f"{key} was {old.get(key)} and is now {now[key]}" for key in differing)
                + ". Tune as before, or into another folder, or delete the file to train anew."
            )
        policy = self.model.policy
        policy.planner.load_state_dict(saved["planner"])
        policy.planner_updates.fill_(float(self.gradient_steps))
