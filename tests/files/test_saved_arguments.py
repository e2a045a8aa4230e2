"""Arguments and spaces as data: what goes in comes out, and a name builds nothing but what is listed."""

import io
import os

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from saving import OwnPolicy, same
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.sac.policies import SACPolicy

from sb3_said.files.archive import load_tree, save_tree
from sb3_said.files.arguments import as_data, from_data, space_as_data, space_from_data


def trip(tree):
    file = io.BytesIO()
    save_tree(file, tree)
    return load_tree(file)


@pytest.mark.parametrize(
    "value",
    [
        {"activation_fn": th.nn.Tanh, "optimizer_class": th.optim.AdamW, "net_arch": {"pi": [8], "qf": (4, 4)}},
        [None, True, 3, 0.1, float("inf"), "auto_0.1", (1, "step"), np.arange(3.0), np.float32(0.1)],
        {"optimizer_kwargs": {"betas": (0.9, 0.99)}, 3: []},
    ],
    ids=str,
)
def test_arguments_come_back(value):
    assert same(from_data(trip(as_data(value, "value"))), value)


def test_a_text_of_numpy_is_pythons():
    given = {"mask": np.random.default_rng(0).choice(["own", "random"])}
    assert type(given["mask"]) is np.str_ and from_data(trip(as_data(given, "value"))) == {"mask": str(given["mask"])}


def test_schedules_and_noise_come_back():
    for schedule in (ConstantSchedule(0.25), LinearSchedule(1e-3, 1e-4, 0.7), FloatSchedule(LinearSchedule(1, 0, 1))):
        loaded = from_data(trip(as_data(schedule, "schedule")))
        assert type(loaded) is type(schedule)
        assert [loaded(x) for x in (1.0, 0.6, 0.0)] == [schedule(x) for x in (1.0, 0.6, 0.0)]
    zeros, ones = np.zeros(2), np.ones(2)
    for noise in (
        NormalActionNoise(zeros, ones, dtype=np.float64),
        OrnsteinUhlenbeckActionNoise(zeros, ones, theta=0.3, dt=0.1, initial_noise=ones),
    ):
        # learn() makes one for each environment again, however many there are then
        for kept in (noise, VectorizedActionNoise(noise, 3)):
            draws = []
            for each in (noise, from_data(trip(as_data(kept, "noise")))):
                np.random.seed(0)
                each.reset()
                draws.append(np.stack([each() for _ in range(3)]))
            assert same(*draws)


def test_the_zoos_schedule_is_kept_as_sb3s():
    schedule = pytest.importorskip("rl_zoo3.utils").linear_schedule("1e-3")
    loaded = from_data(trip(as_data(schedule, "learning_rate")))
    assert type(loaded) is LinearSchedule
    np.testing.assert_allclose([loaded(x) for x in (1, 0.3, 0)], [schedule(x) for x in (1, 0.3, 0)], atol=1e-18)


class OwnSchedule(LinearSchedule):
    pass


@pytest.mark.parametrize(
    "value", [lambda x: x, OwnSchedule(1, 0, 1), OwnPolicy, os.system, th.device("cpu"), {1, 2}, SACPolicy]
)
def test_what_has_no_name_is_refused_with_its_place(value):
    with pytest.raises(ValueError, match=r"^kwargs\['a'\]\[1\] is .* cannot be written without pickle"):
        as_data({"a": [0, value]}, "kwargs")


@pytest.mark.parametrize(
    "node",
    [["os.system"], ["os.system", "true"], ["torch.nn.Linear"], ["torch.nn.ReLU", True], ["builtins.eval", "1"], []],
    ids=str,
)
def test_other_names_build_nothing(node):
    with pytest.raises(ValueError):
        from_data({"a": [{"@": node}]})


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (2, 3)),
        spaces.Box(np.array([-np.inf, 0.1]), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Box(0, 255, (3,), np.uint8),
        spaces.Dict([("b", spaces.Box(-1, 1, (0, 2))), ("a", spaces.Dict({"low": spaces.Box(-1, 1, ())}))]),
    ],
    ids=str,
)
def test_spaces_come_back(space):
    loaded = space_from_data(trip(space_as_data(space)))
    assert type(loaded) is type(space) and loaded == space and loaded.dtype == space.dtype
    if isinstance(space, spaces.Dict):
        assert list(loaded.keys()) == ["b", "a"]  # their order is that of a network's inputs
    with pytest.raises(ValueError, match="Only Box"):
        space_as_data(spaces.Dict({"a": spaces.Discrete(2)}))
