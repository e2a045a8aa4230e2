"""Objects beside trees: those of known classes come back, and a name in a file finds no other class."""

import json
import math
import pathlib
from collections import deque
from dataclasses import dataclass

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from saving import SafeSAC, edit, make_sac, same
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_said.files import archive as tree_file
from sb3_said.files import registry
from sb3_said.files.registry import register_class


@register_class
@dataclass
class Settings:
    width: int
    scale: tuple[float, ...] = (1.0, math.inf)


def space_trip(value):
    encoder = registry.ObjectEncoder()
    node = json.loads(json.dumps(encoder.encode(value, "value")))
    blobs = {name: np.frombuffer(tree_file._bytes_of(blob), np.uint8).copy() for name, blob in encoder.blobs.items()}
    return registry.ObjectDecoder(blobs).decode(node)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (2, 3)),
        spaces.Box(np.array([-np.inf, 0.1]), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Box(0, 255, (3, 4, 4), np.uint8),
        spaces.Discrete(5, start=-2),
        spaces.Discrete(5, dtype=np.int32),
        spaces.MultiBinary(4),
        spaces.MultiBinary([2, 3]),
        spaces.MultiDiscrete([3, 4]),
        spaces.Tuple((spaces.Discrete(2), spaces.Box(0, 1, (1,)))),
        spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Dict({"c": spaces.Box(-1, 1, (0,))})}),
    ],
    ids=str,
)
def test_spaces(space):
    loaded = space_trip(space)
    assert type(loaded) is type(space) and loaded == space and loaded.dtype == space.dtype


def test_the_order_of_a_dict_space_is_kept():
    assert list(space_trip(spaces.Dict([("b", spaces.Discrete(2)), ("a", spaces.Discrete(3))])).keys()) == ["b", "a"]


@pytest.mark.parametrize(
    "value",
    [
        TrainFreq(3, TrainFrequencyUnit.EPISODE),
        th.device("cuda:1"),
        th.bfloat16,
        np.dtype(">f4"),
        np.float32,
        th.nn.ReLU,
        th.optim.AdamW,
        SACPolicy,
        Settings(3),
        pathlib.Path("logs") / "said",
        deque([{"r": 1.5}], maxlen=7),
        {"activation_fn": th.nn.Tanh, 3: [TrainFrequencyUnit.STEP]},
    ],
    ids=str,
)
def test_other_objects(value):
    loaded = space_trip(value)
    assert type(loaded) is type(value) and loaded == value
    assert getattr(loaded, "maxlen", None) == getattr(value, "maxlen", None)


def test_schedules_noise_and_generators():
    schedule = space_trip(FloatSchedule(LinearSchedule(1e-3, 1e-4, 0.7)))
    for progress in (1.0, 0.6, 0.0):
        assert schedule(progress) == LinearSchedule(1e-3, 1e-4, 0.7)(progress)
    assert space_trip(ConstantSchedule(0.25))(0.3) == 0.25

    zeros, ones = np.zeros(2), np.ones(2)
    for noise in (
        NormalActionNoise(zeros, ones),
        OrnsteinUhlenbeckActionNoise(zeros, ones, theta=0.3, initial_noise=ones),
        VectorizedActionNoise(NormalActionNoise(zeros, ones), 3),
    ):
        draws = []
        for each in (noise, space_trip(noise)):
            np.random.seed(0)
            draws.append(np.stack([each() for _ in range(3)]))
        assert same(*draws)

    generator = np.random.default_rng(3)
    generator.random(5)
    assert space_trip(generator).random() == generator.random()
    with pytest.raises(ValueError, match="PCG64"):
        space_trip(np.random.Generator(np.random.MT19937(0)))


def test_a_subclass_is_not_flattened_to_its_parent():
    class CleverBox(spaces.Box):
        pass

    with pytest.raises(ValueError, match=r"value is .* of type CleverBox"):
        space_trip(CleverBox(-1, 1, (2,)))


def test_registered_classes_load_only_while_registered(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_CLASS_OF_NAME", dict(registry._CLASS_OF_NAME))
    monkeypatch.setattr(registry, "_NAME_OF_CLASS", dict(registry._NAME_OF_CLASS))

    @register_class
    class OwnPolicy(SACPolicy):
        pass

    make_sac(policy=OwnPolicy).save(tmp_path / "agent")
    assert type(SafeSAC.load(tmp_path / "agent", device="cpu").policy) is OwnPolicy
    name = registry._NAME_OF_CLASS[OwnPolicy]
    del registry._CLASS_OF_NAME[name]
    with pytest.raises(ValueError, match=r"OwnPolicy', which is not registered.*register_class"):
        SafeSAC.load(tmp_path / "agent", device="cpu")
    supplied = {"policy_class": OwnPolicy}
    assert type(SafeSAC.load(tmp_path / "agent", custom_objects=supplied, device="cpu").policy) is OwnPolicy
    register_class(OwnPolicy, name)
    assert type(SafeSAC.load(tmp_path / "agent", device="cpu").policy) is OwnPolicy


@pytest.mark.parametrize(
    "node",
    [
        {"!class": "os.system"},
        {"!class": "subprocess.Popen"},
        {"!class": "builtins.eval"},
        {"!class": "torch.nn.Module"},
        {"!class": ["os.system"]},
        {"!object": ["stable_baselines3.sac.policies.SACPolicy", {}]},
        {"!object": ["subprocess.Popen", {"args": "true"}]},
        {"!dataclass": ["torch.nn.ReLU", {}]},
        {"!dataclass": [f"{Settings.__module__}.Settings", {"width": 1, "evil": 1}]},
        {"!dataclass": [f"{Settings.__module__}.Settings", {"width": 1}]},
        {"!object": ["collections.deque", {"items": [], "maxlen": 1, "evil": 1}]},
        {":serialized:": "gAWVIQAAAAAAAAA="},
    ],
    ids=str,
)
def test_tampered_names_are_refused(node, tmp_path):
    def change(members):
        tree = json.loads(members["tree.json"])
        tree["data"]["policy_class"] = node
        return members | {"tree.json": json.dumps(tree)}

    make_sac().save(tmp_path / "agent")
    saved = edit(tmp_path / "agent.zip", change)
    with pytest.raises(ValueError, match=r"Cannot load|file's policy_class is"):
        SafeSAC.load(saved, device="cpu")
    SafeSAC.load(saved, custom_objects={"policy_class": SACPolicy}, device="cpu")
