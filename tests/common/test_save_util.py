"""Saved files: what goes in comes out bit for bit, and nothing in a file can run."""

import contextlib
import io
import json
import math
import os
import pathlib
import pickle
import pickletools
import warnings
import zipfile
from collections import OrderedDict, deque
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.torch import load as load_safetensors
from small_task import delayed
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedSAC
from sb3_said.common import registry, tree_file
from sb3_said.common.registry import register_class
from sb3_said.common.save_util import (
    SafePolicyMixin,
    SafeSaveMixin,
    load_algorithm_file,
    load_metadata,
    load_tree,
    save_algorithm,
    save_tree,
)


class SafeSAC(SafeSaveMixin, SAC):
    pass


class SafePPO(SafeSaveMixin, PPO):
    pass


@register_class
class SafePolicy(SafePolicyMixin, SACPolicy):
    pass


@register_class
class SafeActorCriticPolicy(SafePolicyMixin, ActorCriticPolicy):
    pass


@register_class
@dataclass
class Settings:
    width: int
    scale: tuple[float, ...] = (1.0, math.inf)


class UnregisteredPolicy(SACPolicy):
    pass


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


def round_trip(tree):
    file = io.BytesIO()
    save_tree(file, tree)
    return load_tree(file)


def make_sac(env="Pendulum-v1", policy="MlpPolicy", cls=SafeSAC, **kwargs):
    arguments = {"learning_starts": 10, "batch_size": 8, "buffer_size": 200, "seed": 0, "device": "cpu"}
    return cls(policy, env, **(arguments | {"policy_kwargs": {"net_arch": [8]}} | kwargs))


@pytest.fixture(scope="module")
def trained():
    return make_sac().learn(20)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "agent")
    return tmp_path / "agent.zip"


def edit(path, change):
    """Rewrite tree.json, as an attacker would."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members = change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def edit_data(path, name, node):
    def change(members):
        tree = json.loads(members["tree.json"])
        tree["data"][name] = node
        return members | {"tree.json": json.dumps(tree)}

    return edit(path, change)


# --- trees ---

arrays = hnp.arrays(
    st.one_of(
        hnp.boolean_dtypes(),
        hnp.integer_dtypes(endianness="?"),
        hnp.floating_dtypes(endianness="?"),
        hnp.complex_number_dtypes(),
        hnp.unicode_string_dtypes(),
        hnp.datetime64_dtypes(),
    ),
    hnp.array_shapes(min_dims=0, min_side=0, max_dims=3, max_side=4),
)
tensors = arrays.filter(
    lambda array: array.dtype.isnative and array.dtype.kind in "biufc" and array.dtype.char not in "gG"
).map(th.from_numpy)
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(st.characters()), arrays, tensors,
    arrays.filter(lambda array: array.ndim == 0).map(lambda array: array[()]),
)  # fmt: skip
trees = st.recursive(
    leaves,
    lambda children: st.one_of(
        st.lists(children, max_size=4),
        st.lists(children, max_size=4).map(tuple),
        st.dictionaries(st.one_of(st.text(max_size=5), st.integers(), st.just("!tuple")), children, max_size=4),
    ),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(trees)
def test_a_tree_comes_back_bit_for_bit(tree):
    assert same(tree, round_trip(tree))


@pytest.mark.filterwarnings("ignore:ComplexHalf", "ignore:torch.quantize_per_tensor")
@pytest.mark.parametrize(
    "dtype", sorted({value for value in vars(th).values() if isinstance(value, th.dtype)}, key=str)
)
def test_every_dtype(dtype):
    tensor = th.arange(24, dtype=th.uint8).tile(16)[: 24 * dtype.itemsize].clone()
    tensor = (tensor % 2).bool() if dtype == th.bool else tensor.view(dtype)
    tree = {"vector": tensor, "scalar": tensor[0], "empty": tensor[:0].reshape(0, 3)}
    assert same(tree, round_trip(tree))


def test_layouts_in_memory():
    base = th.arange(12.0).reshape(3, 4)
    parameter = th.nn.Parameter(base.clone())
    tree = {
        "transposed": base.T,
        "strided": base[:, ::2],
        "shared": base,
        "shared again": base[1],
        "expanded": th.ones(1).expand(4),
        "conjugate": th.tensor([1 + 2j]).conj(),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "reversed": np.arange(5)[::-1],
        "empty": np.zeros((0, 3)),
        "big endian": np.arange(3, dtype=">i4"),
    }
    assert same(tree, round_trip(tree))
    loaded = round_trip({"parameter": parameter})["parameter"]
    assert type(loaded) is th.Tensor and not loaded.requires_grad and loaded.equal(parameter)
    loaded += 1  # memory of its own, writable


def test_ordered_dicts_become_dicts_in_their_order():
    assert list(round_trip(OrderedDict(b=1, a=2)).items()) == [("b", 1), ("a", 2)]


@pytest.mark.parametrize(
    ("value", "place"),
    [
        (lambda: None, r"tree\['a'\]\[1\]"),
        ({1, 2}, r"tree\['a'\]\[1\]"),
        (np.array([None]), r"tree\['a'\]\[1\]"),
        ({(1, 2): 0}, r"tree\['a'\]\[1\].*keys"),
        (spaces.Discrete(2), r"tree\['a'\]\[1\]"),
        (th.zeros(3, device="meta"), r"tree\['a'\]\[1\]"),
        (th.eye(2).to_sparse(), r"tree\['a'\]\[1\]"),
        (deque([1]), r"tree\['a'\]\[1\]"),
        (np.zeros(2, [("x", "f4")]), r"tree\['a'\]\[1\]"),
    ],
)
def test_what_a_tree_cannot_hold_is_refused_with_its_place(value, place, tmp_path):
    with pytest.raises(ValueError, match=place):
        save_tree(tmp_path / "tree.zip", {"a": [0, value]})
    assert list(tmp_path.iterdir()) == []


def test_metadata(tmp_path):
    save_tree(tmp_path / "new" / "folder" / "tree", 1, {"step": 5})
    description = load_metadata(tmp_path / "new" / "folder" / "tree")
    assert description["metadata"] == {"step": 5}
    assert description["format"] == tree_file.FORMAT
    assert description["versions"]["torch"].split("+")[0] == th.__version__.split("+")[0]  # wheels may hide the build
    with pytest.raises(ValueError, match="metadata must be JSON"):
        save_tree(tmp_path / "tree", 1, {"array": np.zeros(1)})


def test_the_tensors_are_a_safetensors_file():
    file = io.BytesIO()
    tree = {"weight": th.randn(3, 4), "flags": th.tensor([True, False, True]), "half": th.randn(5).bfloat16()}
    save_tree(file, tree)
    with zipfile.ZipFile(file) as archive:
        loaded = load_safetensors(archive.read("tensors.safetensors"))
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
    assert same({f"tree[{name!r}]": tensor for name, tensor in sorted(tree.items())}, dict(sorted(loaded.items())))


def test_equal_trees_give_equal_bytes():
    first, second = io.BytesIO(), io.BytesIO()
    save_tree(first, {"a": th.ones(3)})
    save_tree(second, {"a": th.ones(3)})
    assert first.getvalue() == second.getvalue()


@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, th.optim.AdamW, th.optim.SGD])
def test_an_optimizer_goes_on_as_if_never_saved(optimizer_class, tmp_path):
    def step(network, optimizer):
        optimizer.zero_grad()
        network(th.linspace(-1, 1, 12).reshape(4, 3)).square().sum().backward()
        optimizer.step()

    def build():
        network = th.nn.Linear(3, 2)
        return network, optimizer_class(network.parameters(), lr=0.01)

    network, optimizer = build()
    for _ in range(3):
        step(network, optimizer)
    save_tree(tmp_path / "checkpoint", {"network": network.state_dict(), "optimizer": optimizer.state_dict()})

    tree = load_tree(tmp_path / "checkpoint")
    resumed_network, resumed_optimizer = build()
    resumed_network.load_state_dict(tree["network"])
    resumed_optimizer.load_state_dict(tree["optimizer"])
    assert same(optimizer.state_dict(), resumed_optimizer.state_dict())
    for _ in range(3):
        step(network, optimizer)
        step(resumed_network, resumed_optimizer)
    assert same(dict(network.state_dict()), dict(resumed_network.state_dict()))
    assert same(optimizer.state_dict(), resumed_optimizer.state_dict())


# --- files that are not what they should be ---


def test_every_truncation_is_a_clear_error(tmp_path):
    path = tmp_path / "tree"
    save_tree(path, {"a": th.ones(30), "b": "text"})
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="Cannot load"):
            load_tree(path)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_a_flipped_byte_is_an_error_or_harmless(data):
    file = io.BytesIO()
    tree = {"a": th.ones(5), "b": [1, "text"], "c": np.zeros(3, bool)}
    save_tree(file, tree)
    content = bytearray(file.getvalue())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        loaded = load_tree(io.BytesIO(content))
    except ValueError as error:
        assert "Cannot load" in str(error)
    else:
        assert same(tree, loaded)


@pytest.mark.parametrize(
    "tree",
    [
        {"!tensor": ["tree", "save", [1]]},
        {"!tensor": ["nothing", "float32", [1]]},
        {"!tensor": ["tree", "float32", [3]]},
        {"!array": ["tree", "O", []]},
        {"!array": ["tree", "V8", [1]]},
        {"!class": "torch.nn.ReLU"},
        {"!object": ["gymnasium.Discrete", {"n": 2}]},
        {"!unheard": 1},
        {"!dict": [[[], 1]]},
    ],
)
def test_forged_entries_are_refused(tree, tmp_path):
    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    edit(tmp_path / "tree", lambda members: members | {"tree.json": json.dumps(tree)})
    with pytest.raises(ValueError, match="Cannot load"):
        load_tree(tmp_path / "tree")


def test_bools_are_zero_or_one_whatever_the_file_says(tmp_path):
    save_tree(tmp_path / "tree", [th.zeros(2, dtype=th.bool), np.zeros(2, bool)])
    edit(
        tmp_path / "tree",
        lambda members: members | {"tensors.safetensors": members["tensors.safetensors"][:-4] + b"\x07\x00\x07\x00"},
    )
    tensor, array = load_tree(tmp_path / "tree")
    assert tensor.view(th.uint8).tolist() == [1, 0] and array.view(np.uint8).tolist() == [1, 0]


@pytest.mark.parametrize(
    "entry",
    [[0, 10**15], [8, 16], [-8, 0], [0, 4], "x", None],
    ids=["huge", "gap", "negative", "short", "text", "none"],
)
def test_forged_offsets_are_refused(entry, tmp_path):
    def change(members):
        header = json.dumps({"tree": {"dtype": "F64", "shape": [1], "data_offsets": entry}}).encode()
        return members | {"tensors.safetensors": len(header).to_bytes(8, "little") + header + bytes(8)}

    save_tree(tmp_path / "tree", th.zeros(1, dtype=th.float64))
    with pytest.raises(ValueError, match="Cannot load"):
        load_tree(edit(tmp_path / "tree", change))


def test_foreign_files(tmp_path, saved):
    with pytest.raises(FileNotFoundError, match=r"no 'nowhere\.zip'"):
        SafeSAC.load("nowhere")
    with pytest.raises(ValueError, match="kind 'algorithm', where 'tree' was expected"):
        load_tree(saved)
    (tmp_path / "text.zip").write_text("hello")
    with pytest.raises(ValueError, match="was not written by sb3_said"):
        SafeSAC.load(tmp_path / "text.zip")
    edit(tmp_path / "agent.zip", lambda members: members | {"extra.txt": b""})
    with pytest.raises(ValueError, match="expected an archive of"):
        SafeSAC.load(tmp_path / "agent.zip")


def test_zip_bombs_are_refused(tmp_path):
    save_tree(tmp_path / "tree", 1)
    with (
        zipfile.ZipFile(tmp_path / "tree") as old,
        zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(ValueError, match="compressed"):
        load_tree(tmp_path / "bomb")


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(tree_file, "FORMAT", 2)
    save_tree(tmp_path / "tree", 1)
    monkeypatch.setattr(tree_file, "FORMAT", 1)
    with pytest.raises(ValueError, match="format number is 2, this sb3_said reads up to 1: upgrade"):
        load_tree(tmp_path / "tree")


# --- attributes of algorithms ---


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


# --- algorithms ---


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": 0.2, "use_sde": True},
        {"learning_rate": LinearSchedule(1e-3, 1e-4, 1.0), "train_freq": (2, "step")},
        {"policy_kwargs": {"activation_fn": th.nn.ELU, "net_arch": {"pi": [8], "qf": [4, 4]}}},
        {"policy_kwargs": {"net_arch": [8], "optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"eps": 1e-5}}},
        {"action_noise": NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))},
        {"n_steps": 3},
    ],
    ids=["plain", "sde", "schedule", "activation", "optimizer", "noise", "n_steps"],
)
def test_an_agent_comes_back_whole(kwargs, tmp_path):
    model = make_sac(**kwargs).learn(20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "`n_steps=3` is ignored")  # SB3's own, for its own files too
        model.save(tmp_path / "agent")
        loaded = SafeSAC.load(tmp_path / "agent", env=gym.make("Pendulum-v1"), device="cpu")
    assert same(model.get_parameters(), loaded.get_parameters())
    if model.ent_coef_optimizer is not None:
        assert same(model.log_ent_coef.detach(), loaded.log_ent_coef.detach()) and loaded.log_ent_coef.requires_grad
    observations = np.stack([model.observation_space.sample() for _ in range(5)])
    for deterministic in (True, False):
        actions = []
        for agent in (model, loaded):
            th.manual_seed(1)
            agent.policy.set_training_mode(False)
            if agent.use_sde:
                agent.policy.reset_noise()
            actions.append(agent.predict(observations, deterministic=deterministic)[0])
        assert same(*actions)
    for name in ("num_timesteps", "_n_updates", "gamma", "train_freq", "policy_kwargs", "target_entropy", "seed"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.lr_schedule(0.5) == model.lr_schedule(0.5)
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40 and loaded._n_updates > model._n_updates


def test_gradient_steps_after_loading_are_the_same(tmp_path):
    model = make_sac().learn(20)
    model.save(tmp_path / "agent")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    loaded = SafeSAC.load(tmp_path / "agent", device="cpu")
    loaded.replay_buffer, loaded._logger = model.replay_buffer, model.logger
    for agent in (model, loaded):
        th.manual_seed(0)
        np.random.seed(0)
        agent.train(3, batch_size=8)
    assert same(model.get_parameters(), loaded.get_parameters())
    assert same(model.log_ent_coef.detach(), loaded.log_ent_coef.detach())
    assert not same(before, dict(loaded.policy.state_dict()))


def test_file_objects_and_on_policy(tmp_path):
    model = SafePPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu").learn(8)
    file = io.BytesIO()
    model.save(file)
    loaded = SafePPO.load(file, device="cpu")
    assert same(model.get_parameters(), loaded.get_parameters())
    with open(tmp_path / "agent", "wb") as opened:
        model.save(opened)
    with open(tmp_path / "agent", "rb") as opened:
        assert SafePPO.load(opened, device="cpu").clip_range(1.0) == 0.2


def test_vec_normalize_and_another_number_of_environments(tmp_path):
    model = make_sac(VecNormalize(make_vec_env("Pendulum-v1", n_envs=2))).learn(20)
    model.save(tmp_path / "agent.zip")
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=3))
    loaded = SafeSAC.load(tmp_path / "agent.zip", env=env, device="cpu")
    assert loaded.n_envs == 3 and loaded._last_obs is None and loaded.get_vec_normalize_env() is env
    loaded.learn(12)
    assert SafeSAC.load(tmp_path / "agent.zip", device="cpu").n_envs == 2


def test_arguments_of_load(saved, trained, capsys):
    loaded = SafeSAC.load(saved, device="cpu", gamma=0.5, print_system_info=True)
    assert loaded.gamma == 0.5
    assert th.__version__ in capsys.readouterr().out
    assert SafeSAC.load(saved, custom_objects={"gamma": 0.4, "nonsense": 1}, device="cpu").gamma == 0.4
    SafeSAC.load(saved, policy_kwargs=trained.policy_kwargs, device="cpu")
    with pytest.raises(ValueError, match="policy_kwargs"):
        SafeSAC.load(saved, policy_kwargs={"net_arch": [3]}, device="cpu")
    with pytest.raises(ValueError, match="spaces do not match"):
        SafeSAC.load(saved, env=gym.make("MountainCarContinuous-v0"), device="cpu")
    with pytest.raises(ValueError, match="do not fit SafeSAC"):
        SafeSAC.load(saved, custom_objects={"policy_kwargs": {"net_arch": [3]}}, device="cpu")


def test_exclude_and_include(trained, tmp_path):
    trained.save(tmp_path / "agent", exclude=["gamma"], include=["device"])
    data, params, variables = load_algorithm_file(tmp_path / "agent", "cpu")
    assert "gamma" not in data and data["device"] == th.device("cpu")
    assert set(params) == {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}
    assert set(variables) == {"log_ent_coef"}
    assert not {"env", "replay_buffer", "_logger", "policy", "actor", "critic"} & set(data)


def test_set_parameters_from_a_file(saved, trained):
    model = make_sac(seed=5)
    assert not same(model.get_parameters(), trained.get_parameters())
    model.set_parameters(str(saved))
    assert same(model.get_parameters(), trained.get_parameters())


# --- policies ---


def draws(policy, observations):
    """Answers of a policy: the deterministic one, and one at random."""
    th.manual_seed(1)
    return [policy.predict(observations, deterministic=deterministic)[0] for deterministic in (True, False)]


def make_policy(cls=SafePolicy, use_sde=False, **policy_kwargs):
    """A policy with weights that no constructor gives."""
    model = make_sac(cls=SAC, policy=cls, use_sde=use_sde, policy_kwargs={"net_arch": [8]} | policy_kwargs)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.1)
    return model.policy


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {},
        {"activation_fn": th.nn.ELU, "net_arch": {"pi": [8], "qf": [4, 4]}, "n_critics": 3},
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"eps": 1e-5}, "normalize_images": False},
    ],
    ids=["plain", "networks", "optimizer"],
)
def test_a_policy_comes_back_whole(policy_kwargs, tmp_path):
    policy = make_policy(**policy_kwargs)
    policy.save(tmp_path / "policy")
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]  # as SB3, which adds no suffix
    assert load_metadata(tmp_path / "policy")["metadata"] == {"policy": "SafePolicy"}
    loaded = SafePolicy.load(tmp_path / "policy", device="cpu")
    assert type(loaded) is SafePolicy and same(dict(policy.state_dict()), dict(loaded.state_dict()))
    assert (loaded.observation_space, loaded.action_space) == (policy.observation_space, policy.action_space)
    arguments, expected = loaded._get_constructor_parameters(), policy._get_constructor_parameters()
    del arguments["lr_schedule"], expected["lr_schedule"]  # of the algorithm
    assert arguments == expected
    observations = np.stack([policy.observation_space.sample() for _ in range(5)])
    assert same(draws(policy, observations), draws(loaded, observations))


def test_the_noise_of_a_loaded_policy_is_that_of_its_parameters(tmp_path):
    policy = make_policy(use_sde=True)
    with th.no_grad():
        policy.actor.log_std.fill_(-20.0)
    policy.save(tmp_path / "policy")
    loaded = SafePolicy.load(tmp_path / "policy", device="cpu")
    certain, noisy = draws(loaded, np.zeros((4, 3), np.float32))
    np.testing.assert_allclose(noisy, certain, atol=1e-5)


def test_policies_in_file_objects_and_on_policy():
    policy, file = SafePPO(SafeActorCriticPolicy, "CartPole-v1", device="cpu").policy, io.BytesIO()
    policy.save(file)
    loaded = SafeActorCriticPolicy.load(file, device="cpu")
    observations = np.stack([policy.observation_space.sample() for _ in range(5)])
    assert same(draws(policy, observations), draws(loaded, observations))


@pytest.mark.parametrize(
    ("cls", "flags"),
    [
        (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": True}),
        (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": False}),
        (SAID, {"augment_state": True, "delay_reconciled_critic": True}),
    ],
    ids=["DR", "SA", "SAID"],
)
def test_the_policies_of_this_package(cls, flags, tmp_path):
    planner = {"d_model": 32, "depth": 1, "horizon": 3, "batch_size": 8, "sampling_steps": 2, "n_candidates": 3}
    kwargs = {"planner_kwargs": planner, "planner_gradient_steps": 3} if cls is SAID else {}
    env = delayed(2, max_delay=3)
    model = make_sac(env, cls=cls, **flags, **kwargs).learn(30)
    policy = model.policy
    policy.save(tmp_path / "policy")
    loaded = type(policy).load(tmp_path / "policy", device="cpu")
    assert same(dict(policy.state_dict()), dict(loaded.state_dict()))
    assert loaded.observation_space == model.observation_space and loaded.max_delay == 3
    assert {name: getattr(loaded, name) for name in flags} == flags
    first = env.reset(seed=1)[0]
    second = env.step(np.ones(1, np.float32))[0]
    observations = {key: np.stack([first[key], second[key]]) for key in first}
    for answer in ("expert", "planner") if cls is SAID else (None,):
        answers = []
        for each in (policy, loaded):
            with each.answering(answer) if answer else contextlib.nullcontext():
                answers.append(draws(each, observations))
        assert same(*answers)
    if cls is SAID:
        assert loaded.planner_is_trained and loaded.planner.config == policy.planner.config
        with pytest.raises(
            ValueError, match=r"it holds a SAIDPolicy, where DelayedSACPolicy was expected: load it with"
        ):
            DelayedSAC.policy_aliases["MlpPolicy"].load(tmp_path / "policy")


def test_policies_of_another_class_or_kind_are_refused(saved, tmp_path):
    make_policy().save(tmp_path / "policy")
    with pytest.raises(ValueError, match=r"a SafePolicy, where SafeActorCriticPolicy was expected.*SafePolicy\.load"):
        SafeActorCriticPolicy.load(tmp_path / "policy")
    with pytest.raises(ValueError, match="kind 'algorithm', where 'policy' was expected"):
        SafePolicy.load(saved)
    with pytest.raises(ValueError, match="kind 'policy', where 'algorithm' was expected"):
        SafeSAC.load(tmp_path / "policy")
    with pytest.raises(FileNotFoundError):
        SafePolicy.load(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("member", "node", "message"),
    [
        ("class", {"!class": "os.system"}, "which is not registered"),
        ("class", "SafePolicy", "damaged"),
        ("arguments", {"net_arch": [8]}, "damaged"),
        ("state_dict", {}, "Missing key"),
        ("state_dict", {"actor": {"!class": "torch.nn.ReLU"}}, "unknown entry '!class'"),
    ],
    ids=str,
)
def test_tampered_policies_are_refused(member, node, message, tmp_path):
    def change(members):
        return members | {"tree.json": json.dumps(json.loads(members["tree.json"]) | {member: node})}

    make_policy().save(tmp_path / "policy")
    edit(tmp_path / "policy", change)
    with pytest.raises(ValueError, match=f"(?s)Cannot load.*{message}"):
        SafePolicy.load(tmp_path / "policy")


def test_a_policy_that_cannot_be_written_leaves_the_old_file(tmp_path):
    make_policy().save(tmp_path / "policy")
    before = (tmp_path / "policy").read_bytes()
    with pytest.raises(ValueError, match=r"arguments\['activation_fn'\] is <function.*register_class"):
        make_policy(activation_fn=lambda: th.nn.ReLU()).save(tmp_path / "policy")

    class OwnPolicy(SafePolicyMixin, SACPolicy):
        pass

    with pytest.raises(ValueError, match=r"Cannot save this OwnPolicy: its class is .*register_class"):
        make_policy(OwnPolicy).save(tmp_path / "policy")
    assert (tmp_path / "policy").read_bytes() == before


def test_policies_of_sb3_are_refused_until_trusted(tmp_path):
    policy, target = make_policy(), tmp_path / "harm"
    SACPolicy.save(policy, tmp_path / "policy")
    with pytest.raises(ValueError, match=r"hold pickles.*runs whatever code.*load\(path, allow_pickle=True\)"):
        SafePolicy.load(tmp_path / "policy")
    loaded = SafePolicy.load(tmp_path / "policy", device="cpu", allow_pickle=True)
    assert type(loaded) is SafePolicy and same(dict(policy.state_dict()), dict(loaded.state_dict()))
    policy.save(tmp_path / "safe")
    assert same(policy.state_dict(), SafePolicy.load(tmp_path / "safe", "cpu", allow_pickle=True).state_dict())

    policy.optimizer_kwargs = {"eps": Bomb(target)}
    SACPolicy.save(policy, tmp_path / "policy")
    with pytest.raises(ValueError, match="pickle"):
        SafePolicy.load(tmp_path / "policy")
    assert not target.exists()
    with contextlib.suppress(TypeError):  # the optimizer cannot be made of it
        SafePolicy.load(tmp_path / "policy", allow_pickle=True, device="cpu")
    assert target.exists()  # the bomb works: the refusal is what held it back


# --- attributes that cannot be written ---


def test_a_function_is_named_and_can_be_supplied(tmp_path):
    model = make_sac(learning_rate=lambda progress: 1e-3 * progress)
    with pytest.warns(
        UserWarning, match=r"learning_rate is <function.*custom_objects={'learning_rate': \.\.\.}"
    ) as caught:
        model.save(tmp_path / "agent")
    assert len(caught) == 1 and caught[0].filename == __file__
    with pytest.warns(UserWarning, match="lacks learning_rate"):
        loaded = SafeSAC.load(tmp_path / "agent", device="cpu")
    assert loaded.learning_rate == 3e-4
    observation = model.observation_space.sample()
    assert same(model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = SafeSAC.load(tmp_path / "agent", custom_objects={"learning_rate": 0.1}, device="cpu")
    assert loaded.lr_schedule(1.0) == 0.1


def test_policies_and_their_arguments_can_be_supplied(tmp_path):
    model = make_sac(policy=UnregisteredPolicy, policy_kwargs={"net_arch": [8], "activation_fn": lambda: th.nn.ReLU()})
    with pytest.warns(UserWarning, match=r"policy_class is .*policy_kwargs.*activation_fn.*register_class"):
        save_algorithm(tmp_path / "agent", model)
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="lacks policy_class"):
        SafeSAC.load(tmp_path / "agent", device="cpu")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match=r"custom_objects={'policy_kwargs'"):
        SafeSAC.load(tmp_path / "agent", custom_objects={"policy_class": UnregisteredPolicy}, device="cpu")
    supplied = {"policy_class": UnregisteredPolicy, "policy_kwargs": {"net_arch": [8]}}
    assert type(SafeSAC.load(tmp_path / "agent", custom_objects=supplied, device="cpu").policy) is UnregisteredPolicy


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


# --- no pickle ---


class Bomb:
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_loading_never_unpickles(trained, saved, monkeypatch):
    def boom(*args, **kwargs):
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, boom)
    monkeypatch.setattr(th, "load", boom)
    monkeypatch.setattr("cloudpickle.loads", boom)
    monkeypatch.setattr("builtins.eval", boom)
    loaded = SafeSAC.load(saved, device="cpu")
    make_sac().set_parameters(saved)
    assert same(trained.get_parameters(), loaded.get_parameters())
    file = io.BytesIO()
    make_policy().save(file)
    SafePolicy.load(file, device="cpu")


def test_no_member_is_a_pickle(saved):
    with zipfile.ZipFile(saved) as archive:
        assert sorted(archive.namelist()) == ["metadata.json", "tensors.safetensors", "tree.json"]
        for name in archive.namelist():
            content = archive.read(name)
            assert b"serialized" not in content
            with pytest.raises(ValueError):
                list(pickletools.genops(content))


def test_pickles_are_refused_and_not_run(tmp_path):
    target = tmp_path / "harm"
    with open(tmp_path / "raw.zip", "wb") as file:
        pickle.dump(Bomb(target), file)
    th.save({"a": Bomb(target)}, tmp_path / "torch.zip")
    th.save({"a": Bomb(target)}, tmp_path / "old_torch.zip", _use_new_zipfile_serialization=False)
    for name in ("raw.zip", "torch.zip", "old_torch.zip"):
        for load in (SafeSAC.load, load_tree, load_algorithm_file, make_sac().set_parameters):
            with pytest.raises(ValueError, match="pickle"):
                load(tmp_path / name)
    assert not target.exists()


def test_files_of_sb3_are_refused_until_trusted(tmp_path):
    target = tmp_path / "harm"
    model = make_sac(cls=SAC, learning_rate=lambda progress: 0.01)
    model.save(tmp_path / "agent")
    for load in (SafeSAC.load, load_algorithm_file, make_sac().set_parameters):
        with pytest.raises(
            ValueError, match=r"data, .*policy\.pth.*runs whatever code.*load\(path, allow_pickle=True\)"
        ):
            load(tmp_path / "agent")
    loaded = SafeSAC.load(tmp_path / "agent", allow_pickle=True, device="cpu", gamma=0.3)
    assert same(model.get_parameters(), loaded.get_parameters()) and loaded.lr_schedule(0.0) == 0.01
    assert type(loaded) is SafeSAC and loaded.gamma == 0.3
    other = make_sac(seed=5)
    other.set_parameters(tmp_path / "agent", allow_pickle=True)
    assert same(model.get_parameters(), other.get_parameters())
    assert load_algorithm_file(tmp_path / "agent", "cpu", allow_pickle=True)[0]["tau"] == model.tau

    model.tensorboard_log = Bomb(target)
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="pickle"):
        SafeSAC.load(tmp_path / "agent")
    assert not target.exists()
    SafeSAC.load(tmp_path / "agent", allow_pickle=True, device="cpu")
    assert target.exists()  # the bomb works: the refusal is what held it back


def test_safe_files_stay_safe_with_allow_pickle(saved, monkeypatch):
    monkeypatch.setattr(SAC, "load", None)
    assert SafeSAC.load(saved, allow_pickle=True, device="cpu").num_timesteps == 20


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
def test_tampered_names_are_refused(node, saved):
    edit_data(saved, "policy_class", node)
    with pytest.raises(ValueError, match=r"Cannot load|file's policy_class is"):
        SafeSAC.load(saved, device="cpu")
    SafeSAC.load(saved, custom_objects={"policy_class": SACPolicy}, device="cpu")


def test_parameters_hold_no_objects(saved):
    def change(members):
        return members | {
            "tree.json": members["tree.json"].replace(b'"lr": 0.0003', b'"lr": {"!class": "torch.nn.ReLU"}')
        }

    edit(saved, change)
    for load in (SafeSAC.load, make_sac().set_parameters):
        with pytest.raises(ValueError, match="unknown entry '!class'"):
            load(saved, device="cpu")
