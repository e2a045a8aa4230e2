"""Saved agents and policies: what goes in comes out bit for bit, and nothing in a file can run."""

import contextlib
import io
import json
import os
import pickle
import pickletools
import warnings
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from saving import SafeSAC, edit, make_sac, same
from small_task import delayed
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedSAC
from sb3_said.files.agents import (
    SafePolicyMixin,
    SafeSaveMixin,
    load_algorithm_file,
    load_metadata,
    load_tree,
    save_algorithm,
)
from sb3_said.files.registry import register_class


class SafePPO(SafeSaveMixin, PPO):
    pass


@register_class
class SafePolicy(SafePolicyMixin, SACPolicy):
    pass


@register_class
class SafeActorCriticPolicy(SafePolicyMixin, ActorCriticPolicy):
    pass


class UnregisteredPolicy(SACPolicy):
    pass


@pytest.fixture(scope="module")
def trained():
    return make_sac().learn(20)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "agent")
    return tmp_path / "agent.zip"


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


def test_parameters_hold_no_objects(saved):
    def change(members):
        return members | {
            "tree.json": members["tree.json"].replace(b'"lr": 0.0003', b'"lr": {"!class": "torch.nn.ReLU"}')
        }

    edit(saved, change)
    for load in (SafeSAC.load, make_sac().set_parameters):
        with pytest.raises(ValueError, match="unknown entry '!class'"):
            load(saved, device="cpu")
