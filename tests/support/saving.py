"""What tests of saved files share."""

import zipfile

import numpy as np
import torch as th

from sb3_said import DelayedSAC
from sb3_said.files.archive import load_metadata, load_tree, save_tree, seal
from sb3_said.sac.policies import DelayedSACPolicy


class OwnPolicy(DelayedSACPolicy):
    """A policy of nobody's, which no file may name."""


def make_sac(env="Pendulum-v1", policy="MlpPolicy", cls=DelayedSAC, **kwargs):
    arguments = {"learning_starts": 10, "batch_size": 8, "buffer_size": 200, "seed": 0, "device": "cpu"}
    return cls(policy, env, **(arguments | {"policy_kwargs": {"net_arch": [8]}} | kwargs))


def make_policy(use_sde=False, **policy_kwargs):
    """A policy with weights that no constructor gives."""
    model = make_sac(use_sde=use_sde, policy_kwargs={"net_arch": [8]} | policy_kwargs)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.1)
    return model.policy


def same(first, second):
    """Equal in type, dtype, shape and every bit; NaN equals NaN."""
    if isinstance(first, th.Tensor):
        return (
            isinstance(second, th.Tensor)
            and first.dtype == second.dtype
            and first.shape == second.shape
            and raw(first) == raw(second)
        )
    if isinstance(first, (np.ndarray, np.generic)):
        return (
            type(first) is type(second)
            and first.dtype == second.dtype
            and first.shape == second.shape
            and first.tobytes() == second.tobytes()
        )
    if isinstance(first, dict):
        return isinstance(second, dict) and same(list(first.items()), list(second.items()))
    if isinstance(first, (list, tuple)):
        return type(first) is type(second) and len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, float):
        return type(second) is float and repr(first) == repr(second)
    return type(first) is type(second) and first == second


def raw(tensor):
    tensor = tensor.detach().resolve_conj().contiguous().reshape(-1)
    return tensor.view(th.uint8).numpy().tobytes() if len(tensor) else b""


def edit(path, change, sealed=True):
    """Rewrite the members, and seal them anew as an attacker would."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members = change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        archive.comment = seal(archive) if sealed else b""
    return path


def forge(path, place, value):
    """Write a file anew with another value in one place."""
    kind = load_metadata(path)["kind"]
    part = tree = load_tree(path, kind)
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    save_tree(path, tree, kind=kind)
