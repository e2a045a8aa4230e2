"""``run.json``: what our tools need to make a run's task again and to go on with its training. Reading it runs no code.

Beside it rl_zoo3 keeps the same as YAML of Python objects, for its own tools. None of ours reads that YAML.
"""

from __future__ import annotations

import argparse
import importlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import get_class_by_name, get_wrapper_class
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_said.files.archive import from_json, to_json
from sb3_said.files.arguments import as_data, from_data
from sb3_said.files.atomic import write_text
from sb3_said.zoo.arguments import Delay, largest_delay

RECORD_NAME = "run.json"
ENDED_NAME = "ended.json"  # of a training that was not interrupted
GIVEN_NAME = "given.zip"  # the agent that a run began with (-i): it may be moved, or written over, before a resume
WRAPPER = "sb3_said.delays.DelayedObservationWrapper"
TO_IMPORT = "install it, or name the folder that it lies in with PYTHONPATH."

#: rl_zoo3's options that a resume keeps, by their whole names. None is an option that rl_zoo3 evaluates or runs.
_OPTIONS = (
    "log_folder", "tensorboard_log", "trained_agent", "n_timesteps", "num_threads", "log_interval", "eval_freq",
    "eval_episodes", "n_eval_envs", "save_freq", "save_replay_buffer", "vec_env", "device", "verbose", "progress",
)  # fmt: skip
#: Hyper-parameters that rl_zoo3 evaluates where they are text.
EVALUATED = ("normalize", "monitor_kwargs", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs")
#: Hyper-parameters that name classes, and what these must derive from.
_NAMED: dict[str, type] = {"env_wrapper": gym.Wrapper, "vec_env_wrapper": VecEnvWrapper, "callback": BaseCallback}


@dataclass(frozen=True)
class Record:
    """What a run was started with.

    :param hyperparams: after YAML, preset and command line, as rl_zoo3 takes them; without the wrapper of the delay
    :param env_kwargs: of ``gymnasium.make``
    :param gym_packages: modules that register the task
    :param options: of rl_zoo3's command line
    :param missing: hyper-parameters that no plain file can hold, each with the reason
    :param dataset: logs that it learned from instead of an environment
    """

    algo: str
    env: str
    seed: int | None = None
    delay: Delay = None
    expert_delay: Delay = None
    preset: str = "cpu"
    checkpoint_freq: int | None = None
    gym_packages: list[str] = field(default_factory=list)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    hyperparams: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    dataset: list[str] = field(default_factory=list)

    @property
    def agent_name(self) -> str:
        """Name of the trained agent's file, as rl_zoo3 gives it."""
        return f"{EnvironmentName(self.env)}.zip"

    @property
    def n_timesteps(self) -> int | None:
        """The steps asked for on the command line, else in the hyper-parameters; None where neither says."""
        given = self.options.get("n_timesteps") or -1  # rl_zoo3's -1: as the hyper-parameters say
        return given if given > 0 else self.hyperparams.get("n_timesteps")

    def task_words(self) -> list[str]:
        """Return the words of a command line that name the task: what is played, under which delays, or which logs."""
        words = ["--env", self.env]
        for name, delay in (("--delay", self.delay), ("--expert-delay", self.expert_delay)):
            words += [name, *map(str, delay if isinstance(delay, list) else [delay])] if delay is not None else []
        for name, values in (("--dataset", self.dataset), ("--gym-packages", self.gym_packages)):
            words += [name, *values] if values else []
        return words

    def agent_words(self) -> list[str]:
        """Return the words of a command line that name the agent that the training began with, none for a new one."""
        agent = self.options.get("trained_agent")
        return ["-i", agent] if agent else []

    def write(self, folder: Path) -> None:
        """Write ``run.json`` into a folder. The file names the settings that it cannot hold."""
        hyperparams, missing = {}, dict(self.missing)
        for name, value in self.hyperparams.items():
            try:
                if name in _NAMED and value:
                    value = [{path: kwargs} for path, kwargs in named_classes(value, _NAMED[name])]
                hyperparams[name] = to_json(as_data(value, name))
            except (ValueError, ImportError) as error:
                missing[name] = str(error)
        kwargs = {}
        for name in ("env_kwargs", "eval_env_kwargs"):
            try:
                kwargs[name] = to_json(as_data(getattr(self, name), name))
            except ValueError as error:
                kwargs[name], missing[name] = {}, str(error)
        document = {**asdict(replace(self, hyperparams={}, env_kwargs={}, eval_env_kwargs={})), **kwargs}
        document |= {"hyperparams": hyperparams, "missing": missing}
        write_text(folder / RECORD_NAME, json.dumps(document, indent=2) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Record:
        """Read what :meth:`write` wrote.

        :raises ValueError: when the folder holds no run, or a damaged one
        """
        path = folder / RECORD_NAME
        if not path.is_file():
            raise ValueError(
                f"{folder} holds no run: {path} is missing. Give the folder that the training printed as 'Log path'."
            )
        try:
            document = json.loads(path.read_text())
            for name in ("hyperparams", "env_kwargs", "eval_env_kwargs"):
                document[name] = {key: from_data(from_json(node)) for key, node in document[name].items()}
            if (folder / GIVEN_NAME).is_file():  # the run's own copy
                document["options"]["trained_agent"] = str(folder / GIVEN_NAME)
            return cls(**document)
        except (TypeError, KeyError, AttributeError, ValueError) as error:
            raise ValueError(f"{path} is damaged, or of another version of sb3_said: {error!r}.") from error

    def require(self, *names: str) -> None:
        """Refuse a run if its file could not hold a setting that is needed.

        :param names: of the settings that are needed
        :raises ValueError: for one that is missing
        """
        for name in names:
            if name in self.missing:
                raise ValueError(
                    f"The run's {name} is not in its {RECORD_NAME}: {self.missing[name]} Write it as names and "
                    "numbers, or make the task yourself and load the agent with its class."
                )

    @property
    def wrappers(self) -> list[Any]:
        """What wraps the task, from the task outwards: the user's own wrappers, then the delay."""
        return with_delay(self.hyperparams.get("env_wrapper"), self.delay, self.expert_delay)

    def command_line(self) -> list[str]:
        """Return rl_zoo3's options as words.

        :raises ValueError: for an option that is not of a run
        """
        words = [f"--env={self.env}", f"--seed={self.seed}"]
        for name, value in self.options.items():
            if name not in _OPTIONS or not isinstance(value, (bool, int, str)):
                raise ValueError(f"{RECORD_NAME} has the option {name}={value!r:.50}, which no run of ours has.")
            option = f"--{name.replace('_', '-')}"
            words += [option] * value if isinstance(value, bool) else [f"{option}={value}"]
        if self.gym_packages:
            words += ["--gym-packages", *map(_module, self.gym_packages)]
        return words

    def check_hyperparams(self) -> None:
        """Check the hyper-parameters before rl_zoo3 reads them: it evaluates text, and calls what a name stands for.

        :raises ValueError: for text that would be evaluated, and for a name that is no class of its kind
        """
        for name in EVALUATED:
            if isinstance(self.hyperparams.get(name), str):
                raise ValueError(f"{RECORD_NAME} is damaged: {name} is text, which would run as code.")
        for name, base in _NAMED.items():
            named_classes(self.hyperparams.get(name) or [], base)


def evaluated(name: str, value: Any) -> str:
    """Write a hyper-parameter as the text that rl_zoo3 evaluates, such as ``{'activation_fn': th.nn.ReLU}``.

    :raises ValueError: for a hyper-parameter that rl_zoo3 does not evaluate, and for a value without a name there
    """
    if name not in EVALUATED:
        raise ValueError(f"{name} is {value!r:.100}, and rl_zoo3 evaluates no text of it.")
    return _as_code(value, name)


def _as_code(value: Any, where: str) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {_as_code(item, where)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        inner = ", ".join(_as_code(item, where) for item in value)
        return f"[{inner}]" if isinstance(value, list) else f"({inner}{',' * bool(value)})"
    if isinstance(value, type):
        module, _, name = as_data(value, where)["@"][0].rpartition(".")
        if not module:
            raise ValueError(f"{where} holds {value!r}, which rl_zoo3 has no name for.")
        return f"{module.replace('torch', 'th', 1)}.{name}"
    if value is None or isinstance(value, (bool, int, float, str)):
        return repr(value)
    raise ValueError(f"{where} holds {value!r:.100}, which no text stands for.")


def options_of(args: argparse.Namespace) -> dict[str, Any]:
    """Return what a resume keeps of rl_zoo3's parsed command line."""
    return {name: value for name, value in vars(args).items() if name in _OPTIONS}


def import_packages(names: Iterable[str]) -> None:
    """Import the modules that register a task.

    :raises ImportError: for a module that is not there; the message says what to do
    """
    for name in names:
        try:
            importlib.import_module(_module(name))
        except ModuleNotFoundError as error:
            if error.name != name.partition(".")[0]:
                raise
            raise ImportError(
                f"The task comes from the package {name!r}, which cannot be imported here: {TO_IMPORT}"
            ) from error


def make_wrapper(wrappers: Any) -> Callable[[gym.Env], gym.Env] | None:
    """Return a function that applies wrappers, from the task outwards; None for no wrappers.

    :param wrappers: as rl_zoo3's ``env_wrapper``: a name, {name: arguments}, or a list of these
    :raises ValueError: for a name that is no ``gymnasium.Wrapper``
    """
    listed = [{name: kwargs} for name, kwargs in named_classes(wrappers or [], gym.Wrapper)]
    wrap: Callable[[gym.Env], gym.Env] | None = get_wrapper_class({"env_wrapper": listed}) if listed else None
    return wrap


def with_delay(own: Any, delay: Delay, other: Delay = None) -> list[Any]:
    """Return rl_zoo3's ``env_wrapper`` with the delay around the user's own wrappers.

    :param own: as rl_zoo3's ``env_wrapper``
    :param delay: None adds no wrapper
    :param other: another delay; the action history is long enough for both
    :raises ValueError: for a delay that ``own`` holds already
    """
    listed = list(own) if isinstance(own, list) else [own] if own else []
    if delay is None:
        return listed
    if any(is_delay_wrapper(entry_of(wrapper)[0]) for wrapper in listed):
        raise ValueError(f"The delay is given twice, as --delay {delay} and in env_wrapper={listed}; leave one out.")
    largest = {} if other is None else {"max_delay": max(largest_delay(delay), largest_delay(other))}
    return [*listed, {WRAPPER: {"delay": delay, **largest}}]


def entry_of(wrapper: Any) -> tuple[Any, dict[str, Any]]:
    """Return name and arguments of an entry of rl_zoo3's ``env_wrapper``."""
    return next(iter(wrapper.items())) if isinstance(wrapper, dict) else (wrapper, {})


def is_delay_wrapper(name: Any) -> bool:
    """Tell whether a wrapper's name, or class, is the delay's."""
    return "DelayedObservationWrapper" in str(name)


def named_classes(given: Any, base: type) -> list[tuple[str, dict[str, Any]]]:
    """Return names and arguments of classes. Each class is checked: a file may name any function.

    :param given: a name, a class, {name: arguments}, or a list of these
    :param base: what the classes must derive from
    :raises ValueError: for anything else
    """
    found = []
    for name, kwargs in map(entry_of, given if isinstance(given, list) else [given]):
        cls: Any = get_class_by_name(name) if isinstance(name, str) and "." in name else name
        if not (isinstance(cls, type) and issubclass(cls, base)):
            raise ValueError(f"{name!r:.80} is no class that derives from {base.__module__}.{base.__name__}.")
        found.append((name if isinstance(name, str) else f"{cls.__module__}.{cls.__qualname__}", kwargs or {}))
    return found


def _module(name: str) -> str:
    if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{name!r} is no name of a module.")
    return name
