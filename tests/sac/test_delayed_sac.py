"""DelayedSAC: what each flag makes actor and critics read, SB3's SAC where nothing is delayed, saving and loading."""

import inspect
from functools import partial

import numpy as np
import pytest
import torch as th
from small_agent import make as make_agent
from small_agent import observation
from small_task import Drift, delayed
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.vec_env import (
    VecNormalize,
)

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.delays.space import UNDELAYED
from sb3_said.files.archive import SavedFileError, save_tree

AUGMENTED = {"observation", "action_history", "delay"}


make = partial(make_agent, cls=DelayedSAC)


def assert_same_parameters(first, second, **tolerance):
    first, second = first.get_parameters(), second.get_parameters()
    assert first.keys() == second.keys()
    th.testing.assert_close(first, second, **({"rtol": 0, "atol": 0} | tolerance))


@pytest.mark.parametrize(
    ("augment_state", "delay_reconciled_critic", "actor_reads", "critic_reads"),
    [
        (False, False, {"observation"}, {"observation"}),  # SAC
        (True, False, AUGMENTED, AUGMENTED),  # SA
        (False, True, {"observation"}, {UNDELAYED}),  # DR
        (True, True, AUGMENTED, {UNDELAYED}),  # SADR
    ],
)
def test_what_actor_and_critics_read(augment_state, delay_reconciled_critic, actor_reads, critic_reads):
    flags = {"augment_state": augment_state, "delay_reconciled_critic": delay_reconciled_critic}
    model = make(**flags, learning_starts=1000).learn(40)
    batch = model.replay_buffer.sample(8)
    assert set(batch.observations) == AUGMENTED | {UNDELAYED}

    def outputs(observation):
        policy = model.policy
        return {
            "actor": policy.actor(observation, deterministic=True),
            "critic": th.cat(policy.critic(observation, batch.actions)),
            "target": th.cat(policy.critic_target(observation, batch.actions)),
        }

    before, read = outputs(batch.observations), {"actor": set(), "critic": set(), "target": set()}
    for key in batch.observations:
        after = outputs(batch.observations | {key: batch.observations[key] + 0.5})
        for network in read:
            if not th.equal(before[network], after[network]):
                read[network].add(key)
    assert read == {"actor": actor_reads, "critic": critic_reads, "target": critic_reads}


def test_every_part_of_the_augmented_state_is_read():
    policy, obs = make(delayed(3)).policy, observation(delay=3)
    answer = policy.predict(obs, deterministic=True)[0]
    for key, values in obs.items():
        for index in np.ndindex(values.shape):
            changed = values.copy()
            changed[index] = 2.0 if key == "delay" else -0.5 * values[index]
            assert policy.predict(obs | {key: changed}, deterministic=True)[0] != answer, (key, index)


def normalized(n_envs):
    return VecNormalize(make_vec_env(Drift, n_envs=n_envs, seed=0), gamma=0.95)


@pytest.mark.parametrize(
    ("make_env", "kwargs"),
    [
        (Drift, {}),
        (lambda: Drift(truncates=False), {"buffer_size": 50, "ent_coef": 0.1}),  # the buffer wraps around
        (lambda: make_vec_env(Drift, n_envs=3, seed=0), {"gradient_steps": 2, "buffer_size": 60}),
        (lambda: normalized(2), {"target_update_interval": 2, "action_noise": NormalActionNoise([0.0], [0.3])}),
        (Drift, {"use_sde": True, "train_freq": (1, "episode"), "gradient_steps": -1}),
    ],
    ids=["plain", "terminations and a full buffer", "three environments", "VecNormalize", "gSDE"],
)
def test_without_delay_it_learns_as_sb3s_sac(make_env, kwargs):
    runs = []
    for cls in (SAC, DelayedSAC):
        model = make(make_env(), cls=cls, **kwargs)
        model.set_logger(Logger(None, []))
        model.learn(130, log_interval=None)
        runs.append((model, dict(model.logger.name_to_value)))
    (sac, expected), (ours, losses) = runs
    assert {"train/actor_loss", "train/critic_loss"} <= losses.keys()
    assert losses["train/n_updates"] > 50
    assert losses == expected
    assert_same_parameters(ours, sac)


@pytest.mark.parametrize(
    "wrap", [lambda env: env, lambda env: DelayedObservationWrapper(env, 2)], ids=["plain", "delayed"]
)
@pytest.mark.parametrize("truncates", [True, False])
def test_a_time_limit_is_no_end(wrap, truncates):
    model = make(
        wrap(Drift(length=5, truncates=truncates)), gamma=0.7, ent_coef=0.0, tau=0.2, learning_rate=2e-2, batch_size=64
    )
    model.learn(120)
    batch = model.replay_buffer.sample(200)
    with th.no_grad():
        values = th.cat(model.critic(batch.observations, batch.actions), dim=1).numpy()
    if truncates:  # reward 1 for ever
        assert batch.dones.sum() == 0
        np.testing.assert_allclose(values, 1 / (1 - 0.7), rtol=0.1)
    else:  # 1 before the end, 2.8 with five steps to go
        assert batch.dones.sum() > 0
        assert values.mean() < 2.8


def test_the_last_state_of_an_episode_is_what_is_bootstrapped_from():
    model = make(delayed(length=4)).learn(40)
    buffer = model.replay_buffer
    ends = np.flatnonzero(buffer.timeouts[: buffer.size(), 0])
    batch = buffer._get_samples(ends)
    stepped = 0.9 * batch.observations[UNDELAYED] + 0.1 * th.stack(
        [2.0 * batch.actions[:, 0], batch.observations[UNDELAYED][:, 0]], dim=1
    )
    assert len(ends) == 10 and batch.dones.sum() == 0
    th.testing.assert_close(batch.next_observations[UNDELAYED], stepped)


def test_every_argument_has_a_default_and_is_an_attribute():
    parameters = list(inspect.signature(DelayedSAC.__init__).parameters.values())[3:]
    own = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    assert [p.name for p in own] == [
        "learning_rate", "learning_starts", "augment_state", "delay_reconciled_critic", "relabelled_ages"
    ]  # fmt: skip
    assert all(p.default is not p.empty for p in own)
    given = {"learning_rate": 0.01, "augment_state": False, "delay_reconciled_critic": False, "tau": 0.1, "gamma": 0.9}
    given |= {"learning_starts": 7, "relabelled_ages": 0.1}
    assert {name: getattr(make(**given), name) for name in given} == given


@pytest.mark.parametrize("env", [Drift, delayed])
def test_both_policy_names_are_the_same_policy(env):
    models = [make(env(), policy=name).learn(25) for name in ("MlpPolicy", "MultiInputPolicy")]
    assert_same_parameters(*models)


def test_the_seed_decides():
    def run(seed):
        env = VecNormalize(make_vec_env(delayed, n_envs=2, seed=seed), norm_obs_keys=["observation"])
        return make(env, seed=seed).learn(30)

    first, again, other = run(1), run(1), run(2)
    assert_same_parameters(first, again)
    with pytest.raises(AssertionError):
        assert_same_parameters(first, other)


@pytest.mark.parametrize("part", [0.0, 0.3])
def test_ages_are_exchanged_as_asked_also_after_loading(part, tmp_path):
    make(delayed(delay=(0, 2)), relabelled_ages=part).save(tmp_path / "agent.zip")
    model = DelayedSAC.load(tmp_path / "agent.zip", delayed(delay=(0, 2)), device="cpu")
    assert model.replay_buffer.relabelled_ages == part
    assert make(delayed(delay=(0, 2))).replay_buffer.relabelled_ages == 0.5
    assert model.replay_buffer_kwargs == {}  # as the user gave it


def test_save_and_load(tmp_path):
    model = make(augment_state=False, policy_kwargs={"net_arch": [8], "activation_fn": th.nn.Tanh}).learn(40)
    model.save(tmp_path / "agent")
    loaded = DelayedSAC.load(tmp_path / "agent", device="cpu")
    obs = observation()
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    assert (loaded.augment_state, loaded.num_timesteps) == (False, 40)
    assert_same_parameters(model, loaded)
    loaded.set_env(delayed())
    assert loaded.learn(5, reset_num_timesteps=False).num_timesteps == 45


def test_parameters_are_taken_over(tmp_path):
    trained, other = make().learn(40), make(seed=5)
    other.set_parameters(trained.get_parameters())
    assert_same_parameters(trained, other)
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy", device="cpu")
    np.testing.assert_array_equal(
        policy.predict(observation(), deterministic=True)[0], trained.predict(observation(), deterministic=True)[0]
    )


def test_evaluation_and_a_wrapper_without_delay():
    model = make(delayed(0)).learn(40)
    for policy in (model, model.policy):
        assert evaluate_policy(policy, delayed(0), n_eval_episodes=2)[0] == pytest.approx(12.0)
    batch = {key: np.stack([value] * 3) for key, value in observation(delay=0).items()}
    assert model.predict(batch)[0].shape == (3, 1)


def test_replay_is_saved_without_pickle(tmp_path):
    model, other = make().learn(30), make()
    model.save_replay_buffer(tmp_path / "replay.pkl")  # the name that rl_zoo3 gives
    other.load_replay_buffer(tmp_path / "replay.pkl")
    assert other.replay_buffer.size() == 30
    np.testing.assert_array_equal(other.replay_buffer.observations, model.replay_buffer.observations)
    with pytest.raises(ValueError, match="does not fit"):
        make(delayed(), buffer_size=20).load_replay_buffer(tmp_path / "replay.pkl")

    save_to_pkl(tmp_path / "pickled.pkl", model.replay_buffer)
    with pytest.raises(ValueError, match=r"holds a pickle.*Of a replay buffer, SAID\.learn_offline takes"):
        make().load_replay_buffer(tmp_path / "pickled.pkl")
    with pytest.raises(SavedFileError, match="of kind 'replay buffer', where 'DelayedSAC' was expected"):
        DelayedSAC.load(tmp_path / "replay.pkl")
    model.save(tmp_path / "agent.zip")
    with pytest.raises(SavedFileError, match="of kind 'DelayedSAC', where 'replay buffer' was expected"):
        other.load_replay_buffer(tmp_path / "agent.zip")
    for state in ({}, [], {**model.replay_buffer.state_dict(), "rewards": 3}):
        save_tree(tmp_path / "forged", state, kind="replay buffer")
        with pytest.raises(SavedFileError, match="Cannot load"):
            other.load_replay_buffer(tmp_path / "forged")


def test_a_replay_is_loaded_where_there_is_none(tmp_path):
    model = make(delayed((0, 2)), relabelled_ages=0.2, replay_buffer_kwargs={"handle_timeout_termination": False})
    model.learn(30).save_replay_buffer(tmp_path / "replay")
    before = model.replay_buffer
    model.replay_buffer, device = None, model.device
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "another")
    with pytest.raises(ValueError, match="replay_buffer is None: save the replay before"):
        model.save_replay_buffer(tmp_path / "another")
    assert model.replay_buffer is None
    model.load_replay_buffer(tmp_path / "replay")
    again = model.replay_buffer
    np.testing.assert_equal(again.state_dict(), before.state_dict())
    assert (again.relabelled_ages, again.handle_timeout_termination, again.device) == (0.2, False, device)
    model.device = th.device("meta")  # as in SB3, the replay follows its agent
    model.load_replay_buffer(tmp_path / "replay")
    assert model.replay_buffer is again and again.device == model.device
    model.device = again.device = device
    assert model.learn(20, reset_num_timesteps=False).replay_buffer.size() == 50


@pytest.mark.parametrize("cls", [DelayedSAC, SAID])
def test_runs_in_tensorboard_have_the_algorithm_s_name(cls, tmp_path):
    pytest.importorskip("tensorboard")
    make_agent(cls=cls, tensorboard_log=str(tmp_path)).learn(4)
    assert [path.name for path in tmp_path.iterdir()] == [f"{cls.__name__}_1"]


def test_a_replay_is_found_with_sb3_s_suffix_and_without(tmp_path):
    model = make().learn(30)
    model.save_replay_buffer(tmp_path / "replay.pkl")  # as SB3's CheckpointCallback names it
    other = make()
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer.size() == 30
    with pytest.raises(FileNotFoundError, match=r"no file '.*nothing' and no '.*nothing\.pkl'"):
        other.load_replay_buffer(tmp_path / "nothing")


def test_a_replay_may_have_the_agent_s_name(tmp_path):
    """SB3's own way, whose suffixes tell them apart."""
    model = make().learn(30)
    model.save(tmp_path / "agent")
    model.save_replay_buffer(tmp_path / "agent")
    assert {path.name for path in tmp_path.iterdir()} == {"agent.zip", "agent.pkl"}
    loaded = DelayedSAC.load(tmp_path / "agent", env=delayed(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "agent")
    assert loaded.replay_buffer.size() == 30


@pytest.mark.parametrize(("name", "given"), [("gamma", "0.9"), ("batch_size", 64.5), ("buffer_size", None)])
def test_a_setting_of_another_type_is_refused_by_its_name(name, given):
    with pytest.raises(ValueError, match=f"{name} is {given!r}, which is not of the type that DelayedSAC declares"):
        make(cls=DelayedSAC, **{name: given})


def test_a_count_may_be_written_as_a_float():
    model = make(cls=DelayedSAC, buffer_size=1e2, batch_size=16.0, seed=3.0).learn(25)
    assert (model.buffer_size, model.batch_size, model.seed) == (100, 16, 3) and isinstance(model.buffer_size, int)
