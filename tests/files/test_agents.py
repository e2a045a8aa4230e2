"""Saved agents and policies: what goes in comes out bit for bit, and nothing in a file can run."""

import contextlib
import io
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from saving import OwnPolicy, forge, make_policy, make_sac, same
from small_agent import make as make_agent
from small_task import Drift, delayed
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said import SAID, DelayedSAC
from sb3_said.files.archive import SavedFileError, load_metadata, load_tree
from sb3_said.files.state import agent_state, restore_agent
from sb3_said.sac.policies import DelayedSACPolicy
from sb3_said.said.policies import SAIDPolicy

PLANNER = {"d_model": 32, "depth": 1, "horizon": 3, "batch_size": 8, "sampling_steps": 2, "n_candidates": 3}


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
    loaded.learn(6, reset_num_timesteps=False)
    assert loaded.num_timesteps == 26 and loaded._n_updates > model._n_updates


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


def ent_coef_of(model):
    return model.ent_coef_tensor.item() if model.ent_coef_optimizer is None else model.log_ent_coef.exp().item()


@pytest.mark.parametrize("how", ["kwargs", "custom_objects"])
@pytest.mark.parametrize(("before", "after"), [(0.1, 0.5), ("auto_0.1", "auto_0.5"), ("auto_0.1", 0.5), (0.1, "auto")])
def test_another_entropy_coefficient_is_the_one_that_is_learned_with(how, before, after, tmp_path):
    make_sac(ent_coef=before).learn(12).save(tmp_path / "agent")
    given = {"ent_coef": after} if how == "kwargs" else {"custom_objects": {"ent_coef": after}}
    loaded = DelayedSAC.load(tmp_path / "agent", env="Pendulum-v1", device="cpu", **given)
    wanted = 1.0 if after == "auto" else 0.5
    assert loaded.ent_coef == after and ent_coef_of(loaded) == pytest.approx(wanted)
    loaded.learn(5, reset_num_timesteps=False)
    same_as_saved = DelayedSAC.load(tmp_path / "agent", device="cpu", ent_coef=before)
    assert ent_coef_of(same_as_saved) == pytest.approx(0.1, abs=0.01)


def test_networks_with_another_activation_are_refused(tmp_path):
    make_sac(policy_kwargs={"net_arch": [8], "activation_fn": th.nn.Tanh}).learn(20).save(tmp_path / "agent")
    model = make_sac(policy_kwargs={"net_arch": [8]})
    with pytest.raises(
        SavedFileError,
        match=r"its policy_kwargs are \{'activation_fn': .*Tanh.*, and this agent's \{'use_sde': False\}",
    ):
        model.set_parameters(tmp_path / "agent")
    make_sac(policy_kwargs={"net_arch": [8], "activation_fn": th.nn.Tanh}).set_parameters(tmp_path / "agent")


def test_what_is_no_fault_of_the_file_is_not_told_as_one(tmp_path, monkeypatch):
    make_sac().save(tmp_path / "agent")
    with pytest.raises(ValueError, match="learning_starts is '2', which is not of the type") as error:
        DelayedSAC.load(tmp_path / "agent", device="cpu", learning_starts="2")
    assert not isinstance(error.value, SavedFileError)

    def full(*_, **__):
        raise th.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(DelayedSAC.policy_aliases["MlpPolicy"], "to", full)
    with pytest.raises(th.OutOfMemoryError):
        DelayedSAC.load(tmp_path / "agent", device="cpu")


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
    other = {"env": gym.make("MountainCarContinuous-v0"), "custom_objects": {"policy_kwargs": {"net_arch": [3]}}}
    with pytest.raises(ValueError, match="spaces do not match"):  # which is why no network fits, either
        DelayedSAC.load(saved, device="cpu", **other)
    with pytest.raises(SavedFileError, match=r"'policy' does not fit: actor.* \(8, 3\).*expected .* \(3, 3\)"):
        DelayedSAC.load(saved, custom_objects={"policy_kwargs": {"net_arch": [3]}}, device="cpu")
    with pytest.raises(TypeError, match="DelayedSAC has no argument gama; did you mean gamma"):
        DelayedSAC.load(saved, gama=1, device="cpu")


@pytest.mark.parametrize(
    ("count", "steps", "total"),
    [
        (6e1, 60, 60),
        (np.int64(60), 60, 60),
        (np.float32(60), 60, 60),
        (0.57 * 1e2, 57, 57),  # 56.99999999999999
        (float("inf"), 200, 2**63 - 1),  # until a callback ends it
    ],
)
def test_an_agent_that_learned_a_number_of_any_type_of_steps_can_be_loaded(count, steps, total, tmp_path):
    """``learn(1e6)`` is how many write it."""
    model = make_sac(learning_starts=1000).learn(count, callback=StopTrainingOnMaxEpisodes(1))
    model.save(tmp_path / "agent.zip")
    loaded = DelayedSAC.load(tmp_path / "agent.zip", env=model.get_env(), device="cpu")
    assert loaded.num_timesteps == steps and type(loaded._total_timesteps) is int and loaded._total_timesteps == total
    restore_agent(make_sac(), agent_state(model))
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == steps + 20


class Passing(DelayedSAC):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


def test_an_algorithm_that_passes_its_arguments_on_is_saved(tmp_path):
    model = make_sac(cls=Passing, gamma=0.5).learn(20)
    model.save(tmp_path / "agent.zip")
    assert same(Passing.load(tmp_path / "agent.zip", device="cpu").get_parameters(), model.get_parameters())


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


def test_parameters_of_another_kind_of_file_are_said(trained, tmp_path):
    trained.policy.save(tmp_path / "policy.zip")
    trained.save_replay_buffer(tmp_path / "replay.pkl")
    for name in ("policy.zip", "replay.pkl"):
        with pytest.raises(SavedFileError, match="it holds no agent, which save"):
            make_sac().set_parameters(tmp_path / name)


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


def draws(policy, observations):
    """Answers of a policy: the deterministic one, and one at random."""
    th.manual_seed(1)
    return [policy.predict(observations, deterministic=deterministic)[0] for deterministic in (True, False)]


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
    kwargs = {"planner_kwargs": PLANNER, "planner_gradient_steps": 3, "planner_trial_episodes": 0}
    env = delayed(2, max_delay=3)
    model = make_sac(env, cls=cls, **flags, **(kwargs if cls is SAID else {})).learn(30)
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


def test_a_device_that_torch_does_not_know_is_no_fault_of_the_file(saved):
    with pytest.raises(RuntimeError, match="gpu"):
        DelayedSAC.load(saved, device="gpu")
    with pytest.raises(gym.error.NameNotFound, match="NoSuchTask"):
        DelayedSAC.load(saved, env="NoSuchTask-v0")


def test_a_policy_that_cannot_be_written_leaves_the_old_file(tmp_path):
    make_policy().save(tmp_path / "policy")
    before = (tmp_path / "policy").read_bytes()
    with pytest.raises(ValueError, match=r"arguments\['activation_fn'\] is <function.*without pickle"):
        make_policy(activation_fn=lambda: th.nn.ReLU()).save(tmp_path / "policy")
    assert (tmp_path / "policy").read_bytes() == before


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


def test_an_argument_that_loading_would_refuse_is_named_when_saving(tmp_path):
    model = make_sac()
    model.gamma = 1.5  # which the constructor would refuse
    with pytest.warns(UserWarning, match=r"lacks arguments: gamma is 1\.5, expected 0\.\.1\."):
        model.save(tmp_path / "agent")
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
    loaded.learn(12)
    progress = loaded._current_progress_remaining
    assert loaded.actor.optimizer.param_groups[0]["lr"] == model.lr_schedule(progress)


def test_a_compact_file_is_smaller_and_acts_alike(tmp_path):
    model = make_sac(policy_kwargs={"net_arch": [128, 128]}).learn(20)
    model.save(tmp_path / "whole.zip")
    model.save(tmp_path / "compact.zip", compact=True)
    assert 4 * (tmp_path / "compact.zip").stat().st_size < (tmp_path / "whole.zip").stat().st_size
    loaded = DelayedSAC.load(tmp_path / "compact.zip", env=gym.make("Pendulum-v1"), device="cpu")
    assert not loaded.actor.optimizer.state and loaded.num_timesteps == 20
    for name, value in model.policy.state_dict().items():
        ours = loaded.policy.state_dict()[name]
        assert ours.dtype == value.dtype
        th.testing.assert_close(ours, value, rtol=1e-3 if value.ndim > 1 else 0, atol=1e-6 if value.ndim > 1 else 0)
    obs = np.array([[0.6, 0.8, 1.0], [-1.0, 0.0, -3.0]], np.float32)
    answers = [agent.predict(obs, deterministic=True)[0] for agent in (model, loaded)]
    np.testing.assert_allclose(*answers, atol=0.02)
    assert not np.array_equal(*answers)
    loaded.learn(10)


def test_statistics_stay_whole_in_a_compact_file(tmp_path):
    model = make_agent(planner_kwargs={"first_guess": "prior"}).learn(30)
    model.save(tmp_path / "compact.zip", compact=True)
    loaded, learned = SAID.load(tmp_path / "compact.zip", device="cpu"), dict(model.policy.named_parameters())
    statistics = {name: value for name, value in model.policy.state_dict().items() if name not in learned}
    assert any(value.ndim > 1 for value in statistics.values())
    for name, value in statistics.items():
        th.testing.assert_close(loaded.policy.state_dict()[name], value, rtol=0, atol=0)


def test_what_is_too_large_for_half_precision_stays_whole(tmp_path):
    model = make_sac().learn(20)
    with th.no_grad():
        model.actor.mu.weight[0, 0] = 1e6
    model.save(tmp_path / "compact.zip", compact=True)
    assert DelayedSAC.load(tmp_path / "compact.zip", device="cpu").actor.mu.weight[0, 0] == 1e6


@pytest.mark.parametrize("cls", [DelayedSAC, SAID])
def test_the_recent_episodes_go_on_where_they_were(cls, tmp_path):
    """As in SB3, whose curves of the mean return would begin anew otherwise."""
    model = make_agent(Drift(length=7), cls=cls, learning_starts=1000).learn(45)
    model.ep_success_buffer.extend([True, False])  # as of a task that tells of them
    model.ep_info_buffer[0]["r"] = np.inf  # of a task that fails
    recent = [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]
    assert len(recent) == 6
    model.save(tmp_path / "agent.zip")
    loaded = cls.load(tmp_path / "agent.zip", env=model.get_env(), device="cpu")
    loaded.learn(7, reset_num_timesteps=False)
    found = [(episode["r"], episode["l"]) for episode in loaded.ep_info_buffer]
    assert found[:6] == recent and found[6:] == [(7.0, 7)] and list(loaded.ep_success_buffer) == [1.0, 0.0]
    short = cls.load(tmp_path / "agent.zip", device="cpu", stats_window_size=1)
    assert [len(short.ep_info_buffer), len(short.ep_success_buffer)] == [1, 1]
    loaded.learn(7)
    assert len(loaded.ep_info_buffer) == 1  # another training

    part = {"episodes": {"returns": [1.0], "lengths": ["7"], "successes": []}}
    with pytest.raises(SavedFileError, match="'episodes' holds more than numbers"):
        restore_agent(model, agent_state(model) | part)


def test_the_file_names_the_task(tmp_path):
    make_sac().learn(20).save(tmp_path / "agent.zip")
    assert load_metadata(tmp_path / "agent.zip")["metadata"] == {"task": "Pendulum-v1", "reads_normalized": False}
    loaded = DelayedSAC.load(tmp_path / "agent.zip", device="cpu")
    loaded.save(tmp_path / "again.zip")  # without an environment
    assert loaded.task == load_metadata(tmp_path / "again.zip")["metadata"]["task"] == "Pendulum-v1"
