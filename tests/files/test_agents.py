"""Saved agents and policies: what goes in comes out bit for bit, and nothing in a file can run."""

import contextlib
import io
import os
import pickle
import pickletools
import resource
import warnings
import zipfile
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from saving import make_sac, same
from small_task import delayed
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedSAC
from sb3_said.files.agents import agent_state, restore_agent
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree, save_tree
from sb3_said.files.arguments import as_data, from_data, space_as_data, space_from_data
from sb3_said.sac.policies import DelayedSACPolicy
from sb3_said.said.policies import SAIDPolicy

PLANNER = {"d_model": 32, "depth": 1, "horizon": 3, "batch_size": 8, "sampling_steps": 2, "n_candidates": 3}


class OwnPolicy(DelayedSACPolicy):
    pass


def trip(tree):
    file = io.BytesIO()
    save_tree(file, tree)
    return load_tree(file)


@pytest.fixture(scope="module")
def trained():
    return make_sac().learn(20)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "agent")
    return tmp_path / "agent.zip"


# --- arguments and spaces ---


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


# --- algorithms ---


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": 0.2, "use_sde": True},
        {"learning_rate": LinearSchedule(1e-3, 1e-4, 1.0), "train_freq": (2, "step"), "stats_window_size": 7},
        {"policy_kwargs": {"activation_fn": th.nn.ELU, "net_arch": {"pi": [8], "qf": [4, 4]}}},
        {"policy_kwargs": {"net_arch": [8], "optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"eps": 1e-5}}},
        {"action_noise": NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)), "ent_coef": "auto_0.1", "gamma": 0.9},
    ],
    ids=["plain", "sde", "schedule", "activation", "optimizer", "noise"],
)
def test_an_agent_comes_back_whole(kwargs, tmp_path):
    model = make_sac(**kwargs).learn(20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.save(tmp_path / "agent")
        loaded = DelayedSAC.load(tmp_path / "agent", env=gym.make("Pendulum-v1"), device="cpu")
    assert same(agent_state(model), agent_state(loaded))
    assert model.ent_coef_optimizer is None or loaded.log_ent_coef.requires_grad
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
    unlike = {"action_noise", "learning_rate"}  # objects of their own, looked at above
    for name in {*model._argument_names(), "_stats_window_size"} - unlike - {"stats_window_size"}:
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.lr_schedule(0.5) == model.lr_schedule(0.5)
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40 and loaded._n_updates > model._n_updates


@pytest.mark.parametrize("optimizer_class", [th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.Adafactor])
def test_gradient_steps_after_loading_are_the_same(optimizer_class, tmp_path):
    model = make_sac(policy_kwargs={"net_arch": [8], "optimizer_class": optimizer_class}).learn(20)
    model.save(tmp_path / "agent")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    loaded = DelayedSAC.load(tmp_path / "agent", device="cpu")
    loaded.replay_buffer, loaded._logger = model.replay_buffer, model.logger
    for agent in (model, loaded):
        th.manual_seed(0)
        np.random.seed(0)
        agent.train(3, batch_size=8)
    assert same(model.get_parameters(), loaded.get_parameters())
    assert same(model.log_ent_coef.detach(), loaded.log_ent_coef.detach())
    assert not same(before, dict(loaded.policy.state_dict()))


def test_an_adafactor_loads_on_a_machine_with_a_gpu(tmp_path, monkeypatch):
    """A copied optimizer asks there whether its step can be recorded, and PyTorch's Adafactor does not know."""
    model = make_sac(policy_kwargs={"net_arch": [8], "optimizer_class": th.optim.Adafactor}).learn(20)
    model.save(tmp_path / "agent")
    monkeypatch.setattr("torch.accelerator.current_accelerator", lambda check_available=False: th.device("cuda"))
    monkeypatch.setattr("torch.accelerator.current_stream", lambda: SimpleNamespace(is_capturing=lambda: False))
    loaded = DelayedSAC.load(tmp_path / "agent", device="cpu")
    assert same(model.get_parameters(), loaded.get_parameters())


def test_file_objects_and_any_name(trained, tmp_path):
    file = io.BytesIO()
    trained.save(file)
    assert same(trained.get_parameters(), DelayedSAC.load(file, device="cpu").get_parameters())
    trained.save(tmp_path / "agent.v1")
    assert [path.name for path in tmp_path.iterdir()] == ["agent.v1"]
    assert load_metadata(tmp_path / "agent.v1")["kind"] == "DelayedSAC"
    with open(tmp_path / "agent.v1", "rb") as opened:
        assert DelayedSAC.load(opened, device="cpu").num_timesteps == 20


def test_vec_normalize_and_another_number_of_environments(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    model = make_sac(VecNormalize(make_vec_env("Pendulum-v1", n_envs=2)), action_noise=noise).learn(20)
    model.save(tmp_path / "agent.zip")
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=3))
    loaded = DelayedSAC.load(tmp_path / "agent.zip", env=env, device="cpu")
    assert loaded.n_envs == 3 and loaded._last_obs is None and loaded.get_vec_normalize_env() is env
    loaded.learn(12)
    assert DelayedSAC.load(tmp_path / "agent.zip", device="cpu").n_envs == 2


def test_arguments_of_load(saved, trained, capsys):
    loaded = DelayedSAC.load(saved, device="cpu", gamma=0.5, tensorboard_log="logs", print_system_info=True)
    assert (loaded.gamma, loaded.tensorboard_log) == (0.5, "logs")
    assert th.__version__ in capsys.readouterr().out
    assert DelayedSAC.load(saved, custom_objects={"gamma": 0.4, "nonsense": 1}, device="cpu").gamma == 0.4
    DelayedSAC.load(saved, policy_kwargs=trained.policy_kwargs, device="cpu")
    with pytest.raises(ValueError, match="policy_kwargs"):
        DelayedSAC.load(saved, policy_kwargs={"net_arch": [3]}, device="cpu")
    with pytest.raises(ValueError, match="spaces do not match"):
        DelayedSAC.load(saved, env=gym.make("MountainCarContinuous-v0"), device="cpu")
    with pytest.raises(SavedFileError, match=r"'policy' does not fit: actor.* \(8, 3\).*expected .* \(3, 3\)"):
        DelayedSAC.load(saved, custom_objects={"policy_kwargs": {"net_arch": [3]}}, device="cpu")
    with pytest.raises(TypeError, match="DelayedSAC has no argument gama; did you mean gamma"):
        DelayedSAC.load(saved, gama=1, device="cpu")


@pytest.mark.parametrize("count", [6e1, np.int64(60), np.float32(60)])
def test_an_agent_that_learned_a_number_of_any_type_of_steps_can_be_loaded(count, tmp_path):
    """``learn(1e6)`` is how many write it."""
    model = make_sac().learn(count)
    model.save(tmp_path / "agent.zip")
    loaded = DelayedSAC.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.num_timesteps == loaded._total_timesteps == 60 and type(loaded._total_timesteps) is int
    restore_agent(make_sac(), agent_state(model))


def test_set_parameters_from_a_file(saved, trained):
    model = make_sac(seed=5)
    assert not same(model.get_parameters(), trained.get_parameters())
    model.set_parameters(str(saved.with_suffix("")))
    assert same(model.get_parameters(), trained.get_parameters())
    with pytest.raises(SavedFileError, match="ent_coef_optimizer"):
        make_sac(ent_coef=0.1).set_parameters(saved)
    with pytest.raises(SavedFileError, match=r"policy.*expected .*\(9, 3\)"):
        make_sac(policy_kwargs={"net_arch": [9]}).set_parameters(saved, exact_match=False)
    smaller = make_sac(seed=5)
    forge(saved, ["parameters"], {"policy": trained.policy.state_dict()})
    with pytest.raises(SavedFileError, match="lacks"):
        smaller.set_parameters(saved)
    smaller.set_parameters(saved, exact_match=False)
    assert same(smaller.policy.state_dict(), trained.policy.state_dict())


def test_foreign_files(tmp_path, saved):
    with pytest.raises(FileNotFoundError, match=r"no 'nowhere\.zip'"):
        DelayedSAC.load("nowhere")
    with pytest.raises(SavedFileError, match="kind 'DelayedSAC', where 'tree' was expected"):
        load_tree(saved)
    with pytest.raises(SavedFileError, match="kind 'DelayedSAC', where 'SAID' was expected"):
        SAID.load(saved)
    (tmp_path / "text.zip").write_text("hello")
    with pytest.raises(SavedFileError, match="was not written by sb3_said"):
        DelayedSAC.load(tmp_path / "text.zip")


# --- policies ---


def draws(policy, observations):
    """Answers of a policy: the deterministic one, and one at random."""
    th.manual_seed(1)
    return [policy.predict(observations, deterministic=deterministic)[0] for deterministic in (True, False)]


def make_policy(use_sde=False, **policy_kwargs):
    """A policy with weights that no constructor gives."""
    model = make_sac(use_sde=use_sde, policy_kwargs={"net_arch": [8]} | policy_kwargs)
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
    assert load_metadata(tmp_path / "policy")["kind"] == "DelayedSACPolicy"
    loaded = DelayedSACPolicy.load(tmp_path / "policy", device="cpu")
    assert type(loaded) is DelayedSACPolicy and same(dict(policy.state_dict()), dict(loaded.state_dict()))
    arguments, expected = loaded._get_constructor_parameters(), policy._get_constructor_parameters()
    del arguments["lr_schedule"], expected["lr_schedule"]  # of the algorithm
    assert arguments == expected
    observations = np.stack([policy.observation_space.sample() for _ in range(5)])
    assert same(draws(policy, observations), draws(loaded, observations))


def test_the_noise_of_a_loaded_policy_is_that_of_its_parameters():
    policy, file = make_policy(use_sde=True), io.BytesIO()
    with th.no_grad():
        policy.actor.log_std.fill_(-20.0)
    policy.save(file)
    certain, noisy = draws(DelayedSACPolicy.load(file, device="cpu"), np.zeros((4, 3), np.float32))
    np.testing.assert_allclose(noisy, certain, atol=1e-5)


@pytest.mark.parametrize(
    ("cls", "flags"),
    [
        (DelayedSAC, {"augment_state": False, "delay_reconciled_critic": True}),
        (DelayedSAC, {"augment_state": True, "delay_reconciled_critic": False}),
        (SAID, {"augment_state": True, "delay_reconciled_critic": True}),
    ],
    ids=["DR", "SA", "SAID"],
)
def test_policies_of_delayed_tasks(cls, flags, tmp_path):
    kwargs = {"planner_kwargs": PLANNER, "planner_gradient_steps": 3} if cls is SAID else {}
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


def test_policies_of_another_class_or_kind_are_refused(saved, tmp_path):
    make_policy().save(tmp_path / "policy")
    with pytest.raises(SavedFileError, match="kind 'DelayedSACPolicy', where 'SAIDPolicy' was expected"):
        SAIDPolicy.load(tmp_path / "policy")
    with pytest.raises(SavedFileError, match="kind 'DelayedSAC', where 'DelayedSACPolicy' was expected"):
        DelayedSACPolicy.load(saved)
    with pytest.raises(SavedFileError, match="kind 'DelayedSACPolicy', where 'DelayedSAC' was expected"):
        DelayedSAC.load(tmp_path / "policy")
    with pytest.raises(FileNotFoundError):
        DelayedSACPolicy.load(tmp_path / "nowhere")


def test_a_policy_that_cannot_be_written_leaves_the_old_file(tmp_path):
    make_policy().save(tmp_path / "policy")
    before = (tmp_path / "policy").read_bytes()
    with pytest.raises(ValueError, match=r"arguments\['activation_fn'\] is <function.*without pickle"):
        make_policy(activation_fn=lambda: th.nn.ReLU()).save(tmp_path / "policy")
    assert (tmp_path / "policy").read_bytes() == before


# --- arguments that cannot be written ---


def test_a_function_is_named_and_can_be_supplied(tmp_path):
    model = make_sac(learning_rate=lambda progress: 1e-3 * progress)
    with pytest.warns(
        UserWarning, match=r"learning_rate is <function.*custom_objects={'learning_rate': \.\.\.}"
    ) as caught:
        model.save(tmp_path / "agent")
    assert len(caught) == 1 and caught[0].filename == __file__
    with pytest.warns(UserWarning, match="lacks learning_rate") as caught:
        loaded = DelayedSAC.load(tmp_path / "agent", device="cpu")
    assert loaded.learning_rate == 3e-4 and caught[0].filename == __file__
    observation = model.observation_space.sample()
    assert same(model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = DelayedSAC.load(tmp_path / "agent", custom_objects={"learning_rate": 0.1}, device="cpu")
    assert loaded.lr_schedule(1.0) == 0.1


def test_policies_and_their_arguments_can_be_supplied(tmp_path):
    model = make_sac(policy=OwnPolicy, policy_kwargs={"net_arch": [8], "activation_fn": lambda: th.nn.ReLU()})
    with pytest.warns(UserWarning, match=r"policy_class is .*OwnPolicy.*policy_kwargs|activation_fn.*OwnPolicy"):
        model.save(tmp_path / "agent")
    supplied = {"policy_class": OwnPolicy}
    with pytest.warns(UserWarning, match="lacks policy_kwargs"), pytest.raises(SavedFileError, match="does not fit"):
        DelayedSAC.load(tmp_path / "agent", custom_objects=supplied, device="cpu")
    supplied["policy_kwargs"] = {"net_arch": [8]}
    assert type(DelayedSAC.load(tmp_path / "agent", custom_objects=supplied, device="cpu").policy) is OwnPolicy


# --- no pickle, no code ---


def forge(path, place, value):
    """Write a file anew with another value in one place."""
    kind = load_metadata(path)["kind"]
    part = tree = load_tree(path, kind)
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    save_tree(path, tree, kind=kind)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (["arguments", "env"], "os:Pendulum-v1"),  # Gymnasium imports what stands before the colon
        (["arguments", "device"], "cpu"),
        (["arguments", "learn"], 1),
        (["arguments", "learning_rate"], {"@": ["os.system", "true"]}),
        (["arguments", "policy_class"], {"@": ["subprocess.Popen"]}),
        (["arguments", "policy_class"], {"@": ["torch.nn.ReLU"]}),
        (["arguments", "policy_kwargs"], {"net_arch": [8], "activation_fn": {"@": ["torch.nn.Module"]}}),
        (["arguments", "policy_kwargs"], {"evil": 1}),
        (["arguments", "policy_kwargs"], "net_arch"),
        (["arguments", "train_freq"], "x"),
        (["arguments", "buffer_size"], {}),
        (["arguments"], []),
        (["missing"], 3),
        (["spaces"], [{}, {}]),
        (["spaces"], [[1, 2], [3, 4]]),
        (["n_envs"], "two"),
        (["counters", "num_timesteps"], 1.5),
        (["counters", "trained_ages"], [[]]),
        (["counters", "predict"], 1),
        (["counters"], {}),
        (["parameters", "policy"], {}),
        (["parameters", "policy.__class__"], {}),
        (["parameters", "policy", "actor.mu.bias"], 0.0),
        (["parameters", "actor.optimizer", "__class__"], {}),
        (["variables"], {"log_ent_coef": 1.0}),
        (["variables", "learning_rate"], 1.0),
        (["variables", "log_ent_coef.__class__"], th.zeros(1)),  # would change torch.nn.Parameter
        (["parameters"], "/etc/passwd"),  # would be opened
        (["parameters", "actor.optimizer", 0, "exp_avg"], th.full((8, 3), th.nan)),
        (["parameters", "actor.optimizer", 0, "exp_avg"], th.zeros(8, 3, dtype=th.int32)),
        (["parameters", "actor.optimizer", 0, "exp_avg_sq"], -th.ones(8, 3)),
        (["parameters", "actor.optimizer", 0, "step"], th.tensor(-1.0)),
        (["parameters", "actor.optimizer", 0, "predict"], th.zeros(8, 3)),
        (["counters", "_n_updates"], -1),
        (["counters", "num_timesteps"], 10**30),
        (["counters", "_current_progress_remaining"], float("nan")),
        (["counters", "trained_ages"], [-1]),
        (["n_envs"], 10**9),
        (["spaces", 1], [np.array([np.nan], np.float32)] * 2),
        (["spaces", 1], [np.ones(1, np.float32), np.zeros(1, np.float32)]),
        (["spaces", 0], [np.zeros((10**9, 0), np.float32)] * 2),
        (["arguments", "gamma"], float("nan")),
        (["arguments", "gamma"], 2.0),
        (["arguments", "tau"], "0.5"),
        (["arguments", "use_sde"], 1),
        (["arguments", "buffer_size"], 10**12),
        (["arguments", "seed"], -1),
        (["arguments", "ent_coef"], "nan"),
        (["arguments", "train_freq"], (0, "step")),
        (["arguments", "learning_rate"], {"@": ["LinearSchedule", 1e-3, float("nan"), 1.0]}),
        (["arguments", "learning_rate"], {"@": ["FloatSchedule", {"@": ["torch.nn.ReLU"]}]}),
        (["arguments", "action_noise"], {"@": ["NormalActionNoise", 0.0, 1.0, "<U1000000000"]}),
        (["arguments", "action_noise"], {"@": ["NormalActionNoise", np.zeros(10**6), 1.0, "<f4"]}),
    ],
    ids=lambda value: str(value)[:40],
)
def test_forged_agents_are_refused(place, value, saved):
    forge(saved, place, value)
    with pytest.raises(SavedFileError, match="Cannot load"):
        DelayedSAC.load(saved, device="cpu")


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"n_critics": 10**9},
        {"net_arch": [10**5] * 3},
        {"net_arch": [8] * 10**5},
        {"net_arch": {"pi": [8], "qf": [3000] * 50}},
    ],
    ids=lambda value: str(value)[:40],
)
def test_networks_are_no_larger_than_what_the_file_holds(policy_kwargs, saved, tmp_path):
    forge(saved, ["arguments", "policy_kwargs"], {"net_arch": [8]} | policy_kwargs)
    make_policy().save(tmp_path / "policy")
    forge(tmp_path / "policy", ["arguments"], {"net_arch": [8]} | policy_kwargs)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for load, path in ((DelayedSAC.load, saved), (DelayedSACPolicy.load, tmp_path / "policy")):
        with pytest.raises(SavedFileError, match=r"ask for larger networks than it holds|not enough memory"):
            load(path, device="cpu")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB
    make_sac(policy_kwargs={"net_arch": [300, 300]})  # nothing is counted afterwards


def test_an_argument_that_loading_would_refuse_is_named_when_saving(tmp_path):
    with pytest.warns(UserWarning, match=r"lacks arguments: gamma is 1\.5, expected 0\.\.1\."):
        make_sac(gamma=1.5).save(tmp_path / "agent")
    with pytest.warns(UserWarning, match="lacks gamma"):
        assert DelayedSAC.load(tmp_path / "agent", device="cpu").gamma == 0.99


@pytest.mark.parametrize(
    ("schedule", "kind", "rates"),
    [
        ("lin_1e-3", LinearSchedule, [1e-3, 5e-4, 0.0]),
        (LinearSchedule(1e-3, 1e-4, 0.5), LinearSchedule, [1e-3, 1e-4, 1e-4]),
        (ConstantSchedule(2e-3), ConstantSchedule, [2e-3] * 3),
        (2e-3, float, [2e-3] * 3),
    ],
    ids=str,
)
def test_the_learning_rate_goes_on_as_it_was(schedule, kind, rates, tmp_path):
    if schedule == "lin_1e-3":  # what rl_zoo3 makes of the text
        schedule = pytest.importorskip("rl_zoo3.utils").linear_schedule("1e-3")
    model = make_sac(learning_rate=schedule)
    model.save(tmp_path / "agent")
    loaded = DelayedSAC.load(tmp_path / "agent", env=gym.make("Pendulum-v1"), device="cpu")
    assert type(loaded.learning_rate) is kind
    np.testing.assert_allclose([loaded.lr_schedule(x) for x in (1.0, 0.5, 0.0)], rates, atol=1e-18)
    loaded.learn(20)
    progress = loaded._current_progress_remaining
    assert loaded.actor.optimizer.param_groups[0]["lr"] == model.lr_schedule(progress)


@pytest.mark.parametrize("value", [np.nan, np.inf, "float64", "shape"])
def test_parameters_are_looked_at_before_they_are_taken(value, trained, saved):
    weight = trained.actor.mu.weight.detach()
    changed = {"float64": weight.double(), "shape": weight[None]}.get(value)
    place = ["parameters", "policy", "actor.mu.weight"]
    forge(saved, place, th.full_like(weight, value) if changed is None else changed)
    other = make_sac(seed=5)
    before = {name: value.clone() for name, value in other.policy.state_dict().items()}
    with pytest.raises(SavedFileError, match=r"'policy' does not fit: actor\.mu\.weight"):
        other.set_parameters(saved)
    assert same(before, dict(other.policy.state_dict()))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (["arguments"], {"net_arch": {"@": ["os.system"]}}, "names 'os.system'"),
        (["arguments"], {"evil": 1}, "damaged"),
        (["spaces"], [], "damaged"),
        (["state_dict"], {}, "it lacks"),
        (["state_dict", "actor"], {"@": ["torch.nn.ReLU"]}, "unknown"),
    ],
    ids=str,
)
def test_forged_policies_are_refused(place, value, message, tmp_path):
    make_policy().save(tmp_path / "policy")
    forge(tmp_path / "policy", place, value)
    with pytest.raises(SavedFileError, match=f"(?s)Cannot load.*{message}"):
        DelayedSACPolicy.load(tmp_path / "policy")


class Bomb:
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_loading_never_unpickles(trained, saved, monkeypatch):
    def boom(*args, **kwargs):
        raise AssertionError("something was unpickled")

    DelayedSAC.load(saved, device="cpu")  # reads, once, what types its constructor declares
    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, boom)
    monkeypatch.setattr(th, "load", boom)
    monkeypatch.setattr("cloudpickle.loads", boom)
    monkeypatch.setattr("builtins.eval", boom)
    loaded = DelayedSAC.load(saved, device="cpu")
    make_sac().set_parameters(saved)
    assert same(trained.get_parameters(), loaded.get_parameters())
    file = io.BytesIO()
    make_policy().save(file)
    DelayedSACPolicy.load(file, device="cpu")


def test_no_member_is_a_pickle(saved):
    with zipfile.ZipFile(saved) as archive:
        names = archive.namelist()
        assert set(names) == {"tree.json", *(f"{index}.npy" for index in range(len(names) - 1))}
        for name in names:
            with pytest.raises(ValueError):
                list(pickletools.genops(archive.read(name)))


def test_pickles_and_files_of_sb3_are_refused_and_not_run(tmp_path):
    target = tmp_path / "harm"
    with open(tmp_path / "raw.zip", "wb") as file:
        pickle.dump(Bomb(target), file)
    th.save({"a": Bomb(target)}, tmp_path / "torch.zip")
    th.save({"a": Bomb(target)}, tmp_path / "old_torch.zip", _use_new_zipfile_serialization=False)
    model = make_sac(cls=SAC)
    SACPolicy.save(model.policy, tmp_path / "policy.zip")
    model.tensorboard_log = Bomb(target)
    model.save(tmp_path / "agent.zip")
    for name in ("raw.zip", "torch.zip", "old_torch.zip", "policy.zip", "agent.zip"):
        for load in (DelayedSAC.load, load_tree, make_sac().set_parameters, DelayedSACPolicy.load):
            with pytest.raises(
                SavedFileError, match=r"a pickle.*runs whatever code.*SAC\.load\(path\).*state_dict\(\)"
            ):
                load(tmp_path / name)
    assert not target.exists()
    trusted = SAC.load(tmp_path / "agent.zip", device="cpu")  # the bomb works: the refusal is what held it back
    assert target.exists()
    ours, other = make_sac(seed=5), make_sac(seed=6)
    ours.set_parameters(trusted.get_parameters())  # as the refusal says
    other.policy.load_state_dict(trusted.policy.state_dict())
    assert same(ours.get_parameters(), trusted.get_parameters())
    assert same(dict(other.policy.state_dict()), dict(trusted.policy.state_dict()))


def test_a_compact_file_is_smaller_and_acts_alike(tmp_path):
    model = make_sac(policy_kwargs={"net_arch": [128, 128]}).learn(40)
    model.save(tmp_path / "whole.zip")
    model.save(tmp_path / "compact.zip", compact=True)
    assert 4 * (tmp_path / "compact.zip").stat().st_size < (tmp_path / "whole.zip").stat().st_size
    loaded = DelayedSAC.load(tmp_path / "compact.zip", env=gym.make("Pendulum-v1"), device="cpu")
    assert not loaded.actor.optimizer.state and loaded.num_timesteps == 40
    for name, value in model.policy.state_dict().items():
        ours = loaded.policy.state_dict()[name]
        assert ours.dtype == value.dtype
        th.testing.assert_close(ours, value, rtol=1e-3 if value.ndim > 1 else 0, atol=1e-6 if value.ndim > 1 else 0)
    obs = np.array([[0.6, 0.8, 1.0], [-1.0, 0.0, -3.0]], np.float32)
    answers = [agent.predict(obs, deterministic=True)[0] for agent in (model, loaded)]
    np.testing.assert_allclose(*answers, atol=0.02)
    assert not np.array_equal(*answers)
    loaded.learn(10)


def test_what_is_too_large_for_half_precision_stays_whole(tmp_path):
    model = make_sac().learn(20)
    with th.no_grad():
        model.actor.mu.weight[0, 0] = 1e6
    model.save(tmp_path / "compact.zip", compact=True)
    assert DelayedSAC.load(tmp_path / "compact.zip", device="cpu").actor.mu.weight[0, 0] == 1e6


def test_the_file_names_the_task(tmp_path):
    make_sac().learn(20).save(tmp_path / "agent.zip")
    assert load_metadata(tmp_path / "agent.zip")["metadata"] == {"task": "Pendulum-v1", "reads_normalized": False}
    loaded = DelayedSAC.load(tmp_path / "agent.zip", device="cpu")
    loaded.save(tmp_path / "again.zip")  # without an environment
    assert loaded.task == load_metadata(tmp_path / "again.zip")["metadata"]["task"] == "Pendulum-v1"


@pytest.mark.parametrize("task", ["module:Task-v0", {"a": 1}, 3])
def test_a_task_that_would_import_a_module_is_none(task, tmp_path):
    model = make_sac().learn(20)
    model.task = task
    model.save(tmp_path / "agent.zip")
    assert load_metadata(tmp_path / "agent.zip")["metadata"] == {"task": task, "reads_normalized": False}
    assert DelayedSAC.load(tmp_path / "agent.zip", device="cpu").task is None
