"""Which classes and objects a saved file may name, and how they are written and built again."""

from __future__ import annotations

import dataclasses
import pathlib
from collections import deque
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import buffers, noise, policies, torch_layers
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.dqn import policies as dqn_policies
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.td3 import policies as td3_policies
from torch.nn.modules import activation

from sb3_said.files.archive import Decoder, Encoder, SavedFileError, torch_dtype

ClassType = TypeVar("ClassType", bound=type)

# Files name classes, and these names are all that a file can name: nothing is ever imported because a file says so.
_CLASS_OF_NAME: dict[str, type] = {}
_NAME_OF_CLASS: dict[type, str] = {}


def register_class(cls: ClassType, name: str | None = None) -> ClassType:
    """Allow saved files to hold this class, and, if it is a dataclass, its instances. Usable as a decorator.

    Needed for policies, features extractors and replay buffers of your own. The file keeps only the name: the module
    that registers the class has to be imported before loading. Loading may call a registered class with arguments from
    the file, so register none whose constructor does harm.

    :param cls: the class
    :param name: its name in files; by default module and qualified name. A class that moved can be registered a second
        time under its old name, so that old files still load.
    """
    name = name or f"{cls.__module__}.{cls.__qualname__}"
    _CLASS_OF_NAME[name] = cls
    _NAME_OF_CLASS.setdefault(cls, name)
    return cls


def _register_libraries() -> None:
    for name in activation.__all__:
        register_class(getattr(activation, name), f"torch.nn.{name}")
    register_class(th.nn.Identity, "torch.nn.Identity")
    for cls in _classes_in(th.optim, th.optim.Optimizer):
        register_class(cls, f"torch.optim.{cls.__name__}")
    register_class(RMSpropTFLike)
    register_class(HerReplayBuffer)
    kinds = (BasePolicy, buffers.BaseBuffer, torch_layers.BaseFeaturesExtractor)
    for module in (policies, buffers, torch_layers, sac_policies, td3_policies, dqn_policies):
        for cls in _classes_in(module, *kinds):
            register_class(cls)
    for kind in (bool, int, float):
        register_class(kind)
    for name in ("bool", "int8", "int16", "int32", "int64", "uint8", "float16", "float32", "float64"):
        register_class(np.dtype(name).type, f"numpy.{name}")


def _classes_in(module: ModuleType, *kinds: type) -> list[type]:
    # Python 3.10 takes an alias such as dict[str, int] for an instance of type, but its own type is none.
    return [value for value in vars(module).values() if issubclass(type(value), type) and issubclass(value, kinds)]


_register_libraries()


def _load_generator(state: Any) -> np.random.Generator:
    # Only NumPy's default kind: the state of others holds positions in memory that NumPy does not check.
    bit_generator = np.random.PCG64()
    bit_generator.state = state
    return np.random.Generator(bit_generator)


# The constructor's arguments that rebuild an instance, by exact class: a subclass would come back as its parent.
_ARGUMENTS: dict[type, Callable[[Any], dict[str, Any]]] = {
    spaces.Box: lambda s: {"low": s.low, "high": s.high, "shape": s.shape, "dtype": s.dtype},
    # Older versions of gymnasium know only int64, and take no dtype.
    spaces.Discrete: lambda s: {"n": s.n, "start": s.start} | ({} if s.dtype == np.int64 else {"dtype": s.dtype}),
    spaces.MultiBinary: lambda s: {"n": s.n},
    spaces.MultiDiscrete: lambda s: {"nvec": s.nvec, "dtype": s.dtype, "start": s.start},
    spaces.Tuple: lambda s: {"spaces": s.spaces},
    # Pairs, because a dict would be sorted, and the order of the keys is the order of a network's inputs.
    spaces.Dict: lambda s: {"spaces": list(s.spaces.items())},
    FloatSchedule: lambda f: {"value_schedule": f.value_schedule},
    ConstantSchedule: lambda f: {"val": f.val},
    LinearSchedule: lambda f: {"start": f.start, "end": f.end, "end_fraction": f.end_fraction},
    TrainFreq: lambda t: t._asdict(),
    TrainFrequencyUnit: lambda e: {"value": e.value},
    GoalSelectionStrategy: lambda e: {"value": e.value},
    # The state of a noise process is left out: ``learn`` resets it.
    noise.NormalActionNoise: lambda n: {"mean": n._mu, "sigma": n._sigma, "dtype": n._dtype},
    noise.OrnsteinUhlenbeckActionNoise: lambda n: {
        "mean": n._mu,
        "sigma": n._sigma,
        "theta": n._theta,
        "dt": n._dt,
        "initial_noise": n.initial_noise,
        "dtype": n._dtype,
    },
    noise.VectorizedActionNoise: lambda n: {"base_noise": n.base_noise, "n_envs": n.n_envs},
    deque: lambda d: {"items": list(d), "maxlen": d.maxlen},
    np.dtype: lambda d: {"dtype": d.str},
    np.random.Generator: lambda g: {"state": g.bit_generator.state},
    th.device: lambda d: {"name": str(d)},
    th.dtype: lambda d: {"name": str(d).removeprefix("torch.")},
    type(pathlib.Path()): lambda p: {"path": str(p)},
}
# What to call with these arguments, where it is not the class itself.
_BUILDERS: dict[type, Callable[..., Any]] = {
    deque: lambda items, maxlen: deque(items, maxlen),
    np.random.Generator: _load_generator,
    th.device: lambda name: th.device(name),
    th.dtype: torch_dtype,
    type(pathlib.Path()): lambda path: pathlib.Path(path),
}
_NAME_OF_OBJECT = {cls: f"{cls.__module__.split('.')[0]}.{cls.__qualname__}" for cls in _ARGUMENTS}
_NAME_OF_OBJECT[type(pathlib.Path())] = "pathlib.Path"  # a file from Windows loads elsewhere, and back
_OBJECT_OF_NAME = {name: cls for cls, name in _NAME_OF_OBJECT.items()}


class ObjectEncoder(Encoder):
    """Adds the objects and classes that the attributes of an algorithm consist of."""

    def encode_other(self, value: Any, where: str) -> Any:
        cls = type(value)
        if isinstance(value, np.dtype):
            cls = np.dtype  # every NumPy dtype has a class of its own
        if cls is np.random.Generator and type(value.bit_generator) is not np.random.PCG64:
            raise ValueError(f"{where} is a {value.bit_generator}, and only PCG64 generators can be written")
        if cls in _ARGUMENTS:
            return {"!object": [_NAME_OF_OBJECT[cls], self._arguments(_ARGUMENTS[cls](value), where)]}
        if isinstance(value, type) and value in _NAME_OF_CLASS:
            return {"!class": _NAME_OF_CLASS[value]}
        if dataclasses.is_dataclass(cls) and cls in _NAME_OF_CLASS:
            args = {field.name: getattr(value, field.name) for field in dataclasses.fields(cls) if field.init}
            return {"!dataclass": [_NAME_OF_CLASS[cls], self._arguments(args, where)]}
        raise ValueError(f"{where} is {value!r:.100} of type {cls.__name__}")

    def _arguments(self, args: dict[str, Any], where: str) -> dict[str, Any]:
        return {name: self.encode(value, f"{where}.{name}") for name, value in args.items()}


class ObjectDecoder(Decoder):
    """Builds them again, from the names in this module and nothing else."""

    def decode_other(self, tag: str, content: Any) -> Any:
        if tag == "!class":
            return self._registered(content)
        if tag == "!object":
            name, args = content
            if name not in _OBJECT_OF_NAME:
                raise SavedFileError(f"it holds an object of class {name!r}, which this sb3_said does not load")
            cls = _OBJECT_OF_NAME[name]
            return _BUILDERS.get(cls, cls)(**{key: self.decode(arg) for key, arg in args.items()})
        if tag == "!dataclass":
            name, args = content
            cls = self._registered(name)
            if not dataclasses.is_dataclass(cls):
                raise SavedFileError(f"it holds an instance of {name!r}, which is not a dataclass")
            return cls(**{key: self.decode(arg) for key, arg in args.items()})
        return super().decode_other(tag, content)

    @staticmethod
    def _registered(name: str) -> type:
        if name not in _CLASS_OF_NAME:
            raise SavedFileError(
                f"it names the class {name!r}, which is not registered. If you trust that class, import the module that"
                " registers it or call sb3_said.files.registry.register_class on it; or replace the attribute that"
                " holds it with load(..., custom_objects={name: value})"
            )
        return _CLASS_OF_NAME[name]
