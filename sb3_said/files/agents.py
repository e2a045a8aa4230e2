"""Saving and loading of Stable-Baselines3 algorithms and policies without pickle: a stranger's file runs no code."""

from __future__ import annotations

import contextlib
import os
import pathlib
import warnings
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr, recursive_setattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import (
    ConstantSchedule,
    check_for_correct_spaces,
    get_device,
    get_system_info,
)

from sb3_said.files.archive import (
    Decoder,
    Encoder,
    PathOrFile,
    PickleRefusedError,
    SavedFileError,
    load_metadata,
    load_tree,
    read_file,
    readable,
    save_tree,
    write_file,
)
from sb3_said.files.registry import ObjectDecoder, ObjectEncoder

__all__ = [
    "PickleRefusedError",
    "SafePolicyMixin",
    "SafeSaveMixin",
    "SavedFileError",
    "explained_refusal",
    "load_algorithm_file",
    "load_metadata",
    "load_tree",
    "save_algorithm",
    "save_tree",
]

SelfSafeSave = TypeVar("SelfSafeSave", bound="SafeSaveMixin")
SelfSafePolicy = TypeVar("SelfSafePolicy", bound="SafePolicyMixin")


def save_algorithm(
    path: PathOrFile, model: BaseAlgorithm, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
) -> None:
    """Write an SB3 algorithm to a zip of JSON and tensors, in the way and with the choices of its own ``save``.

    Neither the environment nor the replay buffer is written. An attribute that holds a function or an object of an
    unregistered class cannot be written without pickle: it is named in one warning and in the file.

    :param path: where to write; without a suffix, ``.zip`` is added. Or a binary file object.
    :param exclude: attributes to leave out besides those the algorithm leaves out itself
    :param include: attributes to write although the algorithm leaves them out
    """
    state_dict_names, variable_names = model._get_torch_save_params()
    excluded = set(exclude or ()) | set(model._excluded_save_params())
    excluded -= set(include or ())
    excluded |= {name.split(".")[0] for name in state_dict_names + variable_names}
    excluded.add("lr_schedule")  # made from learning_rate by _setup_model, in every algorithm

    data: dict[str, Any] = {}
    blobs: dict[str, Any] = {}
    missing: dict[str, str] = {}
    for name, value in vars(model).items():
        if name in excluded:
            continue
        encoder = ObjectEncoder()
        try:
            data[name] = encoder.encode(value, name)
        except (ValueError, RecursionError) as error:
            missing[name] = str(error)
        else:
            blobs |= encoder.blobs
    if missing:
        warnings.warn(
            "Attributes that are not in the saved file, because functions and objects of unregistered classes cannot be"
            f" written without pickle: {'; '.join(missing.values())}. To load the file with them, use load(...,"
            f" custom_objects={{{', '.join(f'{name!r}: ...' for name in missing)}}}); a class of your own can be"
            " registered with sb3_said.files.registry.register_class.",
            stacklevel=3,
        )
    variables = {name: recursive_getattr(model, name) for name in variable_names}
    tensors = Encoder()
    root = {
        "data": data,
        "missing": sorted(missing),
        "params": tensors.encode(model.get_parameters(), "params"),
        "pytorch_variables": tensors.encode(variables, "pytorch_variables"),
    }
    if isinstance(path, (str, os.PathLike)) and pathlib.Path(path).suffix == "":
        path = f"{os.fspath(path)}.zip"
    write_file(path, "algorithm", root, blobs | tensors.blobs, {"algorithm": type(model).__name__})


def load_algorithm_file(
    path: PathOrFile,
    device: th.device | str = "auto",
    custom_objects: dict[str, Any] | None = None,
    allow_pickle: bool = False,
    load_data: bool = True,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any] | None]:
    """Read what :func:`save_algorithm` wrote, running no code from the file.

    :param path: path, with or without its ``.zip``, or a seekable binary file object
    :param device: where attributes and variables that are tensors go. State dicts stay on the CPU:
        ``load_state_dict`` copies them to where the networks are.
    :param custom_objects: attributes to take instead of those in the file, which are then not even decoded
    :param allow_pickle: also read Stable-Baselines3's own files, which can run any code: only for files you trust
    :param load_data: False skips the attributes and reads only parameters
    :return: attributes, state dicts by name, and other PyTorch variables by name
    :raises ValueError: if the file is damaged, foreign, newer than this package, names an unregistered class, or holds
        a pickle and ``allow_pickle`` is False
    """
    path = _existing(path)
    custom_objects = custom_objects or {}
    if allow_pickle and _holds_pickle(path):
        pickled, params, variables = load_from_zip_file(path, load_data, custom_objects, device)  # type: ignore[arg-type]
        return pickled or {}, params, variables
    with explained_refusal("load"):
        saved = read_file(path, "algorithm")
    decoder = ObjectDecoder(saved.blobs, get_device(device))
    with readable(path):
        nodes, missing = saved.root["data"] if load_data else {}, saved.root["missing"]
        supplied = {name: value for name, value in custom_objects.items() if name in nodes or name in missing}
        data = {name: decoder.decode(node) for name, node in nodes.items() if name not in supplied} | supplied
        variables = decoder.decode(saved.root["pytorch_variables"])
        params = Decoder(saved.blobs).decode(saved.root["params"])
    absent = [name for name in missing if name not in supplied]
    if absent and load_data:
        warnings.warn(
            f"The file lacks {', '.join(absent)}, which could not be written without pickle: the algorithm's defaults"
            f" are used. To supply them, use load(..., custom_objects={{{', '.join(f'{n!r}: ...' for n in absent)}}}).",
            stacklevel=3,
        )
    return data, params, variables


class SafeSaveMixin(BaseAlgorithm):
    """Makes an SB3 algorithm save to and load from files without pickle. Name it before the algorithm.

    >>> from stable_baselines3 import SAC
    >>> class SafeSAC(SafeSaveMixin, SAC):
    ...     pass
    """

    def save(  # type: ignore[override]
        self, path: PathOrFile, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """Write the agent to a file; see :func:`save_algorithm`."""
        save_algorithm(path, self, exclude, include)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfSafeSave],
        path: PathOrFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        allow_pickle: bool = False,
        **kwargs: Any,
    ) -> SelfSafeSave:
        """Build an agent from a file, running no code from it.

        The arguments are those of SB3's ``load``, and one more.

        :param path: path, with or without its ``.zip``, or a seekable binary file object
        :param env: the environment to go on learning in; None is enough for ``predict``
        :param device: where the agent computes
        :param custom_objects: attributes to take instead of those in the file, by name
        :param print_system_info: print library versions, here and where the file was written
        :param force_reset: reset ``env`` before learning goes on
        :param allow_pickle: also load files of SB3's own ``save``, which can run any code: only for files you trust
        :param kwargs: attributes to set to other values than the file has
        :raises ValueError: if the file cannot be loaded safely (see :func:`load_algorithm_file`), or its spaces or
            policy arguments differ from those given
        """
        path = _existing(path)
        if allow_pickle and _holds_pickle(path):
            return super().load(
                path,  # type: ignore[arg-type]
                env,
                device,
                custom_objects,
                print_system_info,
                force_reset,
                **kwargs,
            )
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
            print("== SAVED MODEL SYSTEM INFO ==", load_metadata(path)["versions"], sep="\n")
        data, params, variables = load_algorithm_file(path, device, custom_objects)
        _check_data(data, kwargs)
        if env is not None:
            env = cls._wrap_env(env, data.get("verbose", 0))
            cls._check_spaces(env, data["observation_space"], data["action_space"])
            if force_reset:
                data["_last_obs"] = None
            data["n_envs"] = env.num_envs

        model = cls(policy=data["policy_class"], env=env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
        vars(model).update(data | kwargs)
        model._setup_model()
        try:
            model.set_parameters(params, exact_match=True, device=device)
        except (RuntimeError, ValueError) as error:
            raise ValueError(
                f"The parameters in the file do not fit {cls.__name__} with policy_kwargs {model.policy_kwargs}:"
                f" {error}. Load it with the class that saved it; policy_kwargs that could not be written are given as"
                " load(..., custom_objects={'policy_kwargs': ...})."
            ) from error
        for name, value in (variables or {}).items():
            # None: the algorithm has this variable only in another configuration (SAC's fixed or learned entropy).
            if value is not None:
                recursive_setattr(model, f"{name}.data", value)
        if model.use_sde:
            model.policy.reset_noise()  # type: ignore[operator]
        model._check_loaded()
        return model

    @classmethod
    def _check_spaces(cls, env: GymEnv, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        """:raises ValueError: for an environment of other spaces than the agent's"""
        check_for_correct_spaces(env, observation_space, action_space)

    def _check_loaded(self) -> None:
        """Look at an agent that was just loaded, and at its environment where it was given one."""

    def set_parameters(
        self,
        load_path_or_dict: PathOrFile | dict[str, Any],
        exact_match: bool = True,
        device: th.device | str = "auto",
        allow_pickle: bool = False,
    ) -> None:
        """As SB3's, where a path has to be that of a file without pickles, unless ``allow_pickle`` is True."""
        if not isinstance(load_path_or_dict, dict):
            load_path_or_dict = load_algorithm_file(load_path_or_dict, device, None, allow_pickle, load_data=False)[1]
        super().set_parameters(self._adapt_parameters(load_path_or_dict), exact_match, device)

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Return the state dicts to take over from those given; an algorithm may leave its own in their place."""
        return params


class SafePolicyMixin(BasePolicy):
    """Makes an SB3 policy save to and load from files without pickle. Name it before the policy, and register it.

    >>> from stable_baselines3.sac.policies import SACPolicy
    >>> from sb3_said.files.registry import register_class
    >>> @register_class
    ... class SafePolicy(SafePolicyMixin, SACPolicy):
    ...     pass
    """

    def save(self, path: PathOrFile) -> None:
        """Write networks and constructor arguments, all that ``predict`` needs; optimizers are the algorithm's.

        :param path: where to write, as it is. Or a binary file object.
        :raises ValueError: if a constructor argument is a function or an object of an unregistered class, or the
            policy's own class is unregistered
        """
        arguments = self._get_constructor_parameters()
        if "lr_schedule" in arguments:  # a method in SB3's files too that only stands in: no policy learns by itself
            arguments["lr_schedule"] = ConstantSchedule(0.0)
        encoder = ObjectEncoder()
        try:
            root = {
                "class": encoder.encode(type(self), "its class"),
                "arguments": encoder.encode(arguments, "arguments"),
                "state_dict": encoder.encode(self.state_dict(), "state_dict"),
            }
        except ValueError as error:
            raise ValueError(
                f"Cannot save this {type(self).__name__}: {error}. Functions and objects of unregistered classes cannot"
                " be written without pickle; register a class of your own with"
                " sb3_said.files.registry.register_class."
            ) from error
        write_file(path, "policy", root, encoder.blobs, {"policy": type(self).__name__})

    @classmethod
    def load(
        cls: type[SelfSafePolicy], path: PathOrFile, device: th.device | str = "auto", allow_pickle: bool = False
    ) -> SelfSafePolicy:
        """Build a policy from a file, running no code from it.

        :param path: of the file, or a seekable binary file object
        :param device: where the policy computes
        :param allow_pickle: also load files of SB3's own ``save``, which can run any code: only for files you trust
        :raises ValueError: if the file is damaged, foreign, newer than this package, of another class of policy, names
            an unregistered class, or holds a pickle and ``allow_pickle`` is False
        """
        if allow_pickle and _holds_pickle(path):
            return super().load(path, device)  # type: ignore[arg-type]
        with explained_refusal("load"):
            saved = read_file(path, "policy")
        decoder = ObjectDecoder(saved.blobs)
        with readable(path):
            saved_class = decoder.decode(saved.root["class"])
            if saved_class is not cls:
                name = saved_class.__name__
                raise SavedFileError(f"it holds a {name}, where {cls.__name__} was expected: load it with {name}.load")
            arguments = decoder.decode(saved.root["arguments"])
            policy = cls(**arguments)
            policy.load_state_dict(Decoder(saved.blobs).decode(saved.root["state_dict"]))
        policy.to(get_device(device))
        if arguments.get("use_sde"):  # its noise was drawn before the parameters were there
            policy.reset_noise()  # type: ignore[operator]
        return policy


@contextlib.contextmanager
def explained_refusal(method: str) -> Iterator[None]:
    """Add to the refusal of a pickle why it is refused, and how to load the file all the same.

    :param method: that takes ``allow_pickle``
    """
    try:
        yield
    except PickleRefusedError as error:
        raise PickleRefusedError(
            f"{error} Unpickling runs whatever code the file's author put there, so files with pickles, such as those"
            " that Stable-Baselines3 itself saves, are refused. If you trust the author, use"
            f" {method}(path, allow_pickle=True), and save again to get a file without pickles."
        ) from error


def _existing(path: PathOrFile) -> PathOrFile:
    """Add ``.zip`` where the path alone is no file, as SB3 does."""
    if not isinstance(path, (str, os.PathLike)) or os.path.isfile(path):
        return path
    if os.path.isfile(f"{os.fspath(path)}.zip"):
        return f"{os.fspath(path)}.zip"
    raise FileNotFoundError(f"There is no file '{os.fspath(path)}' and no '{os.fspath(path)}.zip'.")


def _holds_pickle(path: PathOrFile) -> bool:
    try:
        load_metadata(path)
    except PickleRefusedError:
        return True
    return False


def _check_data(data: dict[str, Any], kwargs: dict[str, Any]) -> None:
    """:raises ValueError: if attributes from a file do not suffice to build an agent, or contradict the given ones"""
    if absent := [name for name in ("policy_class", "observation_space", "action_space") if name not in data]:
        raise ValueError(
            f"The file lacks {', '.join(absent)}, without which no agent can be built. Give them as"
            " load(..., custom_objects={name: value})."
        )
    kinds = {
        "policy_class": type,
        "observation_space": spaces.Space,
        "action_space": spaces.Space,
        "policy_kwargs": dict,
    }
    for name, kind in kinds.items():
        if not isinstance(data.get(name, kwargs.get(name)), (kind, type(None))):
            raise ValueError(f"The file's {name} is {data[name]!r:.100}, not a {kind.__name__}: it has been damaged.")
    stored = data.get("policy_kwargs", {})
    stored.pop("device", None)
    if "policy_kwargs" in data and kwargs.get("policy_kwargs", stored) != stored:
        raise ValueError(
            f"The given policy_kwargs {kwargs['policy_kwargs']} differ from {stored} in the file, which the saved"
            " networks were built with. Leave them out of the call."
        )
