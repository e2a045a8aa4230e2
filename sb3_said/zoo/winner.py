"""Write the winner of a search as the YAML that train.py and evaluate.py read."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3.utils import get_saved_hyperparams

from sb3_said.files.atomic import write_text
from sb3_said.zoo.manager import PRESETS, WRAPPER


@dataclass(frozen=True)
class RunConfig:
    """What rl_zoo3 keeps of a run's settings. Its YAML can run code: read only runs that you trust."""

    folder: Path
    """of config.yml and args.yml"""
    hyperparams: dict[str, Any]
    args: dict[str, Any]

    @classmethod
    def read(cls, run: Path) -> RunConfig:
        """Read the settings of a run folder."""
        folder = next(run.glob("*/args.yml")).parent
        # rl_zoo3 writes Python objects into this file, so that no safe loader reads it.
        args = yaml.load((folder / "args.yml").read_text(), Loader=yaml.UnsafeLoader)
        return cls(folder, dict(get_saved_hyperparams(str(folder))[0]), dict(args))

    @property
    def env_id(self) -> str:
        """The task."""
        return str(getattr(self.args["env"], "gym_id", self.args["env"]))

    @property
    def delay(self) -> list[int | str]:
        """The words given to ``--delay``: one number, low and high, one process, or none."""
        for wrapper in self._wrappers():
            if isinstance(wrapper, dict) and WRAPPER in wrapper:
                delay = wrapper[WRAPPER]["delay"]
                return list(delay) if isinstance(delay, (list, tuple)) else [delay]
        return []

    def train_command(self, folder: Path) -> str:
        """Return the command that trains anew with the best.yml of a folder."""
        words = ["python", "scripts/train.py", "--algo", "said", "--env", self.env_id]
        words += ["--delay", *map(str, self.delay)] if self.delay else []
        return shlex.join([*words, "-conf", str(folder / "best.yml")])

    def write_best(self, folder: Path, planner: dict[str, Any], choice: str) -> list[str]:
        """Write best.yml for train.py, and the YAML that evaluate.py reads beside best.zip.

        :param folder: to write to
        :param planner: its settings that were tried
        :param choice: how they were chosen, for a comment
        :return: names of hyper-parameters that YAML cannot hold
        """
        block, left_out = self.block(planner)
        document = {self.env_id: block, "presets": {name: {"default": {}} for name in PRESETS if name != "cpu"}}
        lines = [
            f"{', '.join(planner)}: {choice}; see results.json.",
            self.train_command(folder),
            *(f"Left out, as YAML cannot hold it: {name}" for name in left_out),
            "The block is whole: presets change nothing in it.",
        ]
        text = "".join(f"# {line}\n" for line in lines) + yaml.safe_dump(document, sort_keys=False)
        write_text(folder / "best.yml", text)

        target = folder / self.folder.name
        shutil.copytree(self.folder, target, dirs_exist_ok=True)
        config = yaml.load((self.folder / "config.yml").read_text(), Loader=yaml.UnsafeLoader)
        config["planner_kwargs"] = {**(config.get("planner_kwargs") or {}), **planner}
        write_text(target / "config.yml", yaml.dump(config))
        return left_out

    def block(self, planner: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
        """Return the run's hyper-parameters with the tuned planner, as rl_zoo3 reads them from YAML.

        The wrapper of the delay is left out, since ``--delay`` adds it; what the command line set beside the
        hyper-parameters is taken in.

        :param planner: its settings that were tried
        :return: the block, and the names of hyper-parameters that YAML cannot hold
        """
        block, left_out = {}, []
        given = {**self.hyperparams, "env_wrapper": [w for w in self._wrappers() if _name(w) != WRAPPER]}
        given |= {"env_kwargs": self.args["env_kwargs"]} if self.args.get("env_kwargs") else {}
        given |= {"n_timesteps": self.args["n_timesteps"]} if self.args.get("n_timesteps", -1) > 0 else {}
        given["planner_kwargs"] = {**(self.hyperparams.get("planner_kwargs") or {}), **planner}
        for name, value in given.items():
            by_reading = name == "normalize_kwargs" or (name in ("normalize", "env_wrapper") and not value)
            if by_reading:  # rl_zoo3 adds these when it reads a run
                continue
            try:
                block[name] = plain(value)
            except TypeError:
                left_out.append(name)
        return block, left_out

    def _wrappers(self) -> list[Any]:
        wrappers = self.hyperparams.get("env_wrapper") or []
        return wrappers if isinstance(wrappers, list) else [wrappers]


def plain(value: Any) -> Any:
    """Return a value as dicts, lists, numbers and strings.

    :raises TypeError: when it is more than that
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{value!r} is not plain")


def _name(wrapper: Any) -> str:
    return str(next(iter(wrapper)) if isinstance(wrapper, dict) else wrapper)
