"""A run's planners of several depths, each trained once, however many workers and temperatures ask for it."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_said.common.save_util import load_tree, save_tree
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.config import SAMPLING_SETTINGS, weight_settings
from sb3_said.said.callbacks import PLANNER_CHECKPOINT_NAME, PlannerTrainingCallback
from sb3_said.said.said import SAID

STALE_AFTER = 120.0  # seconds without a sign of life
HEARTBEAT = 10.0  # seconds between two signs of life
TRIED_SETTINGS = ("depth", "temperature")  # of the planner, what a search varies


class Claim:
    """A file that says which process does a piece of work, so that no other process starts it too.

    The file names host and process, and a thread touches it while the claim is held. The claim of a process that died
    is free again: at once on the same host, after ``stale_after`` seconds on another that shares the folder. As a
    context manager it waits until it is free.

    :param path: of the file; all processes that share the work name the same one
    :param stale_after: seconds without a touch after which the holder counts as dead
    :param what: the work, for the line that is printed while waiting; nothing is printed without it
    """

    def __init__(self, path: str | Path, stale_after: float = STALE_AFTER, what: str | None = None):
        self.path = Path(path)
        self.stale_after = stale_after
        self.what = what
        self._content = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "token": uuid.uuid4().hex})
        self._released = threading.Event()

    def holder(self) -> str | None:
        """Return who holds it, or None when nobody alive does."""
        content = _read(self.path)
        return None if content is None else self._living(content)

    def try_acquire(self) -> bool:
        """Take the claim if nobody alive holds it, and say whether that worked."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content = _read(self.path)
        if content is not None:
            if self._living(content) is not None:
                return False
            self._remove_stale(content)
        try:
            with open(self.path, "x") as file:
                file.write(self._content)
        except FileExistsError:
            return False
        self._released = threading.Event()
        threading.Thread(target=self._beat, args=(self._released,), daemon=True).start()
        return True

    def release(self) -> None:
        """Give the claim back; does nothing when it is not held."""
        self._released.set()
        if _read(self.path) == self._content:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Claim:
        told = self.what is None
        while not self.try_acquire():
            if not told and (holder := self.holder()) is not None:
                print(f"{self.what}: {holder} is at it; waiting.", flush=True)
                told = True
            time.sleep(0.05 if self.what is None else 1.0)
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def _living(self, content: str) -> str | None:
        try:
            silent = time.time() - self.path.stat().st_mtime
        except FileNotFoundError:
            return None
        try:
            holder = json.loads(content)
        except json.JSONDecodeError:  # just made, not yet written
            holder = {"host": "unknown", "pid": 0}
        is_dead = holder["host"] == socket.gethostname() and not _is_alive(holder["pid"])
        return None if is_dead or silent > self.stale_after else f"process {holder['pid']} on {holder['host']}"

    def _remove_stale(self, content: str) -> None:
        # Renamed first: of several processes that find it stale one gets it, and sees whether it is still the same.
        aside = self.path.with_name(f"{self.path.name}.{uuid.uuid4().hex}")
        try:
            self.path.rename(aside)
            if _read(aside) != content:
                os.link(aside, self.path)
        except (FileNotFoundError, FileExistsError):
            pass
        aside.unlink(missing_ok=True)

    def _beat(self, released: threading.Event) -> None:
        while not released.wait(min(HEARTBEAT, self.stale_after / 4)):
            if _read(self.path) != self._content:
                return
            try:
                os.utime(self.path)
            except FileNotFoundError:
                return


class DepthPlanners:
    """Puts planners of any depth and temperature into an agent, training each depth at most once for all workers.

    A depth's weights are kept in ``FOLDER/planner_depthN.zip``. Where that is missing, the worker that gets the claim
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

    def claim(self, depth: int) -> Claim:
        """Return the claim of the worker that trains a depth."""
        return Claim(self.folder / "locks" / f"planner_depth{depth}.lock", what=f"The planner of depth {depth}")

    def put(self, depth: int, temperature: float) -> None:
        """Let the agent answer with the planner of this depth and temperature, after training it if nobody has.

        :raises ValueError: when the planner or the replay in the folder is of another training
        """
        if self._depth != depth:
            self._replace_planner(depth)
            if not self.is_ready(depth):
                with self.claim(depth):
                    if not self.is_ready(depth):
                        self._train(depth)
            self._load(depth)
            self._depth = depth
        self.model.set_planner(temperature=temperature)

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
        """Return what trials must share to be compared, in JSON types: all but the depth and the temperature they try.

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


def _read(path: Path) -> str | None:
    try:
        return path.read_text()
    except FileNotFoundError:
        return None


def _is_alive(pid: int) -> bool:
    if os.name != "posix":  # elsewhere, os.kill does more than ask
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
