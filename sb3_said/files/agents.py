"""Agents and policies in files without pickle: arguments, counters, recent episodes, state dicts, and nothing else."""

from __future__ import annotations

import contextlib
import inspect
import warnings
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import ConstantSchedule, get_device, get_system_info

from sb3_said.files.archive import (
    PathOrFile,
    SavedFileError,
    existing,
    load_metadata,
    load_tree,
    readable,
    save_tree,
    with_suffix,
)
from sb3_said.files.arguments import (
    as_data,
    check_noise,
    from_data,
    instead_of,
    replaced,
    space_as_data,
    space_from_data,
    with_given,
)
from sb3_said.files.checks import (
    check_argument,
    check_names,
    check_numbers,
    check_tensors,
    no_larger_than,
)
from sb3_said.files.state import (
    Learner,
    agent_state,
    check_counters,
    fitting_parameters,
    in_half,
    restore_agent,
    take_parameters,
)

SelfSafeSave = TypeVar("SelfSafeSave", bound="SafeSaveMixin")
SelfSafePolicy = TypeVar("SelfSafePolicy", bound="SafePolicyMixin")


class SafeSaveMixin(Learner):
    """Makes an SB3 off-policy algorithm save to and load from files without pickle. Name it before the algorithm.

    Every argument of the constructor after ``policy, env`` must be an attribute of the same name. A subclass adds to
    ``own_classes`` the classes that its constructor takes by default, and to ``settings_arguments`` those of its
    arguments that are dicts of settings; ``load`` merges these entry by entry.
    """

    own_classes: ClassVar[tuple[type, ...]] = ()
    settings_arguments: ClassVar[tuple[str, ...]] = ()

    task: str | None = None
    """id of the Gymnasium task that it was made for, where that is known"""
    reads_normalized: bool = False
    """whether its observations went through a ``VecNormalize``; its statistics have a file of their own"""

    def save(self, path: PathOrFile, compact: bool = False) -> None:  # type: ignore[override]  # no exclude, include
        """Write the agent to a file, without its environment and replay buffer.

        A constructor argument that cannot be written without pickle is named in a warning and in the file. The file's
        metadata names the task, where it is a registered one.

        :param path: where to write; without a suffix, ``.zip`` is added. Or a binary file object.
        :param compact: write matrices of weights as float16 and no state of optimizers: two fifths of the size, to hand
            on. Actions then differ in their last digits, and training goes on with fresh optimizers
        :raises ValueError: for spaces other than Box and Dict of Box
        """
        arguments: dict[str, Any] = {}
        missing: dict[str, str] = {}
        for name in sorted(self._argument_names()):
            value = getattr(self, {"stats_window_size": "_stats_window_size"}.get(name, name))
            if not any(value is own for own in (self.policy_aliases["MlpPolicy"], *self.own_classes)):
                try:
                    data = as_data(value, name)
                    check_numbers(name, data)
                    self._check_argument(name, from_data(data), self.policy_class)
                    arguments[name] = data
                except ValueError as error:
                    missing[name] = str(error)
        if missing:
            supplied = ", ".join(f"{name!r}: ..." for name in missing)
            warnings.warn(
                f"The saved file lacks arguments: {' '.join(missing.values())} To supply them, use"
                f" load(..., custom_objects={{{supplied}}}).",
                stacklevel=2,
            )
        tree = {
            "arguments": arguments,
            "missing": list(missing),
            "spaces": [space_as_data(self.observation_space), space_as_data(self.action_space)],
            "n_envs": self.n_envs,
            **agent_state(self),
        }
        if compact:
            parameters = tree["parameters"]
            tree["parameters"] = {name: {} if "optimizer" in name else part for name, part in parameters.items()}
            learned = {name for name, _ in self.policy.named_parameters()}
            tree["parameters"]["policy"] = {
                name: in_half(value) if name in learned else value for name, value in parameters["policy"].items()
            }
        metadata = {"task": self.task, "reads_normalized": self.reads_normalized}
        save_tree(with_suffix(path, ".zip"), tree, metadata, kind=type(self).__name__)

    @classmethod
    def load(  # type: ignore[override]  # of files, too, that are open
        cls: type[SelfSafeSave],
        path: PathOrFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSafeSave:
        """Build an agent from a file, running no code from it; with ``env=None`` it can ``predict``.

        The arguments are those of SB3's ``load``:

        :param path: path, with or without its ``.zip``, or a seekable binary file object
        :param custom_objects: constructor arguments to take instead of those in the file; other names are ignored
        :param force_reset: has no effect, as learning always starts a new episode after loading
        :param kwargs: constructor arguments to take instead of those in the file
        :raises TypeError: for arguments that the constructor does not have
        :raises SavedFileError: if the file is damaged, foreign, forged, newer than this package or of another class,
            or does not go with the environment or the arguments
        """
        path, device = existing(path), get_device(device)
        th.zeros(1).to(device)  # a device or a task that is not there is no fault of the file
        env = gym.make(env) if isinstance(env, str) else env
        if print_system_info:
            get_system_info()
            print("Saved with", load_metadata(path)["versions"])
        names = cls._argument_names()
        cls._refuse_unknown(kwargs, names | {"tensorboard_log"})
        given = {name: value for name, value in (custom_objects or {}).items() if name in names}
        saved = load_tree(path, cls.__name__)
        with readable(path):
            arguments = cls._read_arguments(saved["arguments"], given)
            observation_space, action_space = map(space_from_data, saved["spaces"])
            check_noise(arguments.get("action_noise"), action_space)
            if type(saved["n_envs"]) is not int or saved["n_envs"] < 1:
                raise SavedFileError(f"its n_envs is {saved['n_envs']!r:.50}, expected at least 1")
            if absent := [name for name in saved["missing"] if name not in given | kwargs]:
                warnings.warn(
                    f"The file lacks {', '.join(absent)}, so {cls.__name__} takes its defaults; custom_objects supplies"
                    " others.",
                    stacklevel=2,
                )
        cls._check_changes(arguments, kwargs)  # no fault of the file
        others = replaced(arguments, kwargs)
        arguments = with_given(arguments, kwargs, cls.settings_arguments)
        policy = arguments.pop("policy_class", cls.policy_aliases["MlpPolicy"])
        with readable(path, explained=(ValueError, AssertionError)):  # SB3 asserts what it needs of an environment
            arguments |= {"device": device, "_init_setup_model": False}
            model = cls(policy, env, **arguments)  # type: ignore[arg-type]  # SB3 takes no env, too
            check_counters(model, saved["counters"])
            for name in model.counters:  # _setup_model may ask whether the agent is new
                setattr(model, name, saved["counters"][name])
            model.observation_space, model.action_space = observation_space, action_space
            if model.env is None:
                model.n_envs = saved["n_envs"]
            # Where the caller asks for other networks, the file says nothing about their size.
            own_networks = not any(isinstance(value, (dict, type)) for value in (given | kwargs).values())
            with no_larger_than(saved["parameters"]["policy"]) if own_networks else contextlib.nullcontext():
                model._setup_model()
            model._check_file(saved)
            try:
                restore_agent(model, model._adapt_saved(saved, {*given, *others}))
            except SavedFileError as error:
                if model.env is not None:
                    model.set_env(model.env)  # says so where another task is why the networks do not fit
                told = ", ".join(f"{name}={value!r}" for name, value in others.items())
                remedy = f"; it was saved with {told}: leave out of the call what its networks depend on"
                raise SavedFileError(f"{error}{remedy if others else ''}") from error
            metadata = load_metadata(path)
            model.task, model.reads_normalized = task_of(metadata), metadata["metadata"].get("reads_normalized") is True
            if model.env is not None:
                model.set_env(model.env)
        if model.use_sde:  # its noise was drawn before the parameters were there
            model.policy.reset_noise()  # type: ignore[operator]  # policies with gSDE have it
        return model

    def set_parameters(
        self,
        load_path_or_dict: PathOrFile | dict[str, Any],
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """Take over networks and optimizers from state dicts, as SB3 does, or from a file of :meth:`save`.

        Settings stay this agent's own, also those of ``SAID.set_planner``. State dicts hold none, so give those of an
        agent with the same settings; a file is checked for them.

        :param exact_match: refuse parameters that lack a part; False takes those that are given
        :raises SavedFileError: if the file cannot be read or does not fit
        """
        if isinstance(load_path_or_dict, dict):
            super().set_parameters(self._adapt_parameters(load_path_or_dict), exact_match, device)
            return
        path = existing(load_path_or_dict)
        saved = load_tree(path, kind=None)
        with readable(path, explained=(ValueError,)):
            if not isinstance(saved, dict) or "parameters" not in saved:
                raise SavedFileError("it holds no agent, which save() or a checkpoint writes")
            self._check_file(saved)
            n_updates = saved["counters"]["_n_updates"]
            check_numbers("_n_updates", n_updates)
            take_parameters(self, fitting_parameters(self, saved["parameters"], exact_match), exact_match)
            self._n_updates = max(self._n_updates, int(n_updates))  # that made these; compact files tell it only here

    @classmethod
    def _read_arguments(cls, saved: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
        """Return the constructor arguments of a file; those that are given replace the file's.

        :raises ValueError: for names, types or numbers that the constructor does not take
        """
        check_names("arguments", saved, cls._argument_names(), exact=False)
        nodes = {name: node for name, node in saved.items() if name not in given}
        check_numbers("arguments", nodes)
        arguments = {name: from_data(node) for name, node in nodes.items()}
        cls._check_arguments(arguments, arguments)
        return arguments | given

    @classmethod
    def _check_changes(cls, arguments: dict[str, Any], changes: dict[str, Any]) -> None:
        """:raises ValueError: for other networks than a file's, and for what the constructor does not take"""
        stored = arguments.get("policy_kwargs")
        if stored is not None and changes.get("policy_kwargs", stored) != stored:
            raise ValueError(
                f"The given policy_kwargs {changes['policy_kwargs']} differ from {stored} in the file, which the saved"
                " networks were built with. Leave them out of the call."
            )
        cls._check_arguments(changes, arguments)

    @classmethod
    def _check_arguments(cls, values: dict[str, Any], arguments: dict[str, Any]) -> None:
        """:raises ValueError: for values that do not go with the constructor, or with the policy of the arguments"""
        policy_class = arguments.get("policy_class", cls.policy_aliases["MlpPolicy"])
        for name, value in values.items():
            cls._check_argument(name, value, policy_class)

    @classmethod
    def _check_argument(cls, name: str, value: Any, policy_class: type) -> None:
        """:raises ValueError: for an argument of another type than its constructor declares, or out of range"""
        check_argument(name, value, cls)
        if name == "policy_kwargs" and value is not None:
            for key, item in value.items():
                check_argument(key, item, policy_class)

    @classmethod
    def _argument_names(cls) -> set[str]:
        """Return the names of the arguments that a file holds: those of the constructors up to SB3's algorithm."""
        names = {"policy_class"}
        for base in cls.__mro__[: cls.__mro__.index(OffPolicyAlgorithm)]:
            if "__init__" in vars(base):
                parameters = inspect.signature(base).parameters.values()
                names |= {p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
        return names - {"self", "policy", "env", "device", "tensorboard_log", "_init_setup_model"}

    @classmethod
    def _refuse_unknown(cls, given: Iterable[str], known: set[str]) -> None:
        """:raises TypeError: for an argument that is not known, with the nearest known name"""
        for unknown in sorted(set(given) - known):
            names = sorted((cls._argument_names() | {"device", "tensorboard_log"}) - {"policy_class"})
            raise TypeError(f"{cls.__name__} has no argument {unknown}; {instead_of(unknown, names)}")

    def _check_file(self, saved: dict[str, Any]) -> None:
        """Check a file before its parameters are taken over; an algorithm may refuse more.

        :raises ValueError: for a file that does not go with this agent, such as one with another activation
        """

        def computes(policy_kwargs: dict[str, Any] | None) -> dict[str, Any]:
            of_shapes = ("net_arch", "optimizer_class", "optimizer_kwargs")  # or without effect on answers
            return {name: value for name, value in (policy_kwargs or {}).items() if name not in of_shapes}

        given = saved.get("arguments", {}).get("policy_kwargs", self.policy_kwargs)  # a checkpoint has no arguments
        theirs, own = computes(from_data(given)), computes(self.policy_kwargs)
        if repr(theirs) != repr(own):
            raise ValueError(f"its policy_kwargs are {theirs}, and this agent's {own}; make it with the same")

    @staticmethod
    def _settings_in(saved: dict[str, Any], name: str) -> dict[str, Any]:
        """Return one of ``settings_arguments`` as a checkpoint or a file of :meth:`save` has it."""
        return from_data((saved.get("settings") or saved.get("arguments", {})).get(name, {}))

    def _adapt_saved(self, saved: dict[str, Any], changed: set[str]) -> dict[str, Any]:
        """Return what to take over from a file if the caller of ``load`` has changed some arguments."""
        return saved

    def _take_settings(self, saved: dict[str, Any]) -> None:
        """Take over those settings of a checkpoint that training may have changed, before its parameters.

        :raises ValueError: for settings that do not go with this agent
        """


def task_of(metadata: dict[str, Any]) -> str | None:
    """Return the task that an agent's file names; None if its id names a module: ``gymnasium.make`` would import it.

    :param metadata: of the file, as :func:`~sb3_said.files.archive.load_metadata` returns it
    """
    task = metadata["metadata"].get("task")
    return task if isinstance(task, str) and ":" not in task else None


class SafePolicyMixin(BasePolicy):
    """Makes an SB3 policy save to and load from files without pickle. Name it before the policy."""

    def save(self, path: PathOrFile) -> None:
        """Write networks and constructor arguments, all that ``predict`` needs; optimizers are the algorithm's.

        :param path: where to write; no suffix is added. Or a binary file object.
        :raises ValueError: if a constructor argument cannot be written without pickle
        """
        arguments = self._get_constructor_parameters()
        arguments.pop("lr_schedule")  # the algorithm's
        own_spaces = [space_as_data(arguments.pop(name)) for name in ("observation_space", "action_space")]
        tree = {"arguments": as_data(arguments, "arguments"), "spaces": own_spaces, "state_dict": self.state_dict()}
        save_tree(path, tree, kind=type(self).__name__)

    @classmethod
    def load(cls: type[SelfSafePolicy], path: PathOrFile, device: th.device | str = "auto") -> SelfSafePolicy:
        """Build a policy from a file, running no code from it.

        :param path: of the file, or a seekable binary file object
        :param device: where the policy computes
        :raises SavedFileError: if the file is damaged, foreign, forged, newer than this package, or of another class
        """
        saved = load_tree(path, cls.__name__)
        with readable(path):
            check_numbers("arguments", saved["arguments"])
            arguments = from_data(saved["arguments"])
            for name, value in arguments.items():
                check_argument(name, value, cls)
            own_spaces = map(space_from_data, saved["spaces"])
            with no_larger_than(saved["state_dict"]):
                policy = cls(*own_spaces, ConstantSchedule(0.0), **arguments)
            check_tensors("state_dict", saved["state_dict"], policy.state_dict())
            policy.load_state_dict(saved["state_dict"])
        policy.to(get_device(device))
        if arguments.get("use_sde"):  # its noise was drawn before the parameters were there
            policy.reset_noise()  # type: ignore[operator]  # policies with gSDE have it
        return policy
