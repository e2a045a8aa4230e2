"""DelayedSAC: what each flag makes actor and critics read, SB3's SAC where nothing is delayed, and what it refuses."""

import copy
import inspect
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from kill import Kill, Killed
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from small_agent import make as make_agent
from small_task import Drift, LateDelay, OwnDelay, Simulator, delayed
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
)
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC, StableSAC
from sb3_said.delays import TotalDelay, UniformDelay
from sb3_said.delays.space import UNDELAYED
from sb3_said.files.archive import SavedFileError, save_tree
from sb3_said.sac.policies import DelayedSACPolicy

AUGMENTED = {"observation", "action_history", "delay"}


def make(env=None, cls=DelayedSAC, policy="MlpPolicy", **kwargs):
    arguments = {"learning_starts": 20, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    env = delayed() if env is None else env
    return cls(policy, env, **(arguments | {"policy_kwargs": {"net_arch": [16]}} | kwargs))


def observe(n_steps=5, **kwargs):
    env = delayed(**kwargs)
    obs, _ = env.reset(seed=0)
    for k in range(n_steps):
        obs = env.step(np.array([0.5 + 0.1 * k], np.float32))[0]
    return obs


def assert_same_parameters(first, second, **tolerance):
    first, second = first.get_parameters(), second.get_parameters()
    assert first.keys() == second.keys()
    th.testing.assert_close(first, second, **({"rtol": 0, "atol": 0} | tolerance))


# ---------------------------------------------------------------------------------------------------- what is read


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
    model = make(augment_state=augment_state, delay_reconciled_critic=delay_reconciled_critic).learn(40)
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
    policy, obs = make(delayed(3)).policy, observe(delay=3)
    answer = policy.predict(obs, deterministic=True)[0]
    for key, values in obs.items():
        for index in np.ndindex(values.shape):
            changed = values.copy()
            changed[index] = 2.0 if key == "delay" else -0.5 * values[index]
            assert policy.predict(obs | {key: changed}, deterministic=True)[0] != answer, (key, index)


# ---------------------------------------------------------------------------------------------------- as SB3's SAC


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
        model = make(make_env(), cls, **kwargs)
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
        wrap(Drift(length=5, truncates=truncates)), gamma=0.8, ent_coef=0.0, tau=0.1, learning_rate=1e-2, batch_size=64
    )
    model.learn(250)
    batch = model.replay_buffer.sample(200)
    with th.no_grad():
        values = th.cat(model.critic(batch.observations, batch.actions), dim=1).numpy()
    if truncates:  # reward 1 for ever
        assert batch.dones.sum() == 0
        np.testing.assert_allclose(values, 1 / (1 - 0.8), rtol=0.1)
    else:  # 1 before the end, 3.4 with five steps to go
        assert batch.dones.sum() > 0
        assert values.mean() < 3.4


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


# ---------------------------------------------------------------------------------------------------- SB3's contract


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
    models = [make(env(), policy=name).learn(40) for name in ("MlpPolicy", "MultiInputPolicy")]
    assert_same_parameters(*models)


def test_ages_that_it_has_not_met_are_never_taken_silently(tmp_path):
    model = make(delayed(2))
    model.set_env(delayed((0, 2)))  # has learned nothing yet
    assert model.trained_ages is None
    model.learn(30)
    assert model.trained_ages == [0, 1, 2]
    model.save(tmp_path / "agent")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env in (delayed((0, 2)), delayed(UniformDelay(0, 2)), delayed(1, max_delay=2), delayed(TotalDelay(1, 1))):
            model.set_env(env)
            DelayedSAC.load(tmp_path / "agent", env=env)
        DelayedSAC.load(tmp_path / "agent")
        make(Drift()).learn(30).set_env(Drift())
    model = make(delayed(1, max_delay=2)).learn(30)
    model.save(tmp_path / "agent")
    another = r"DelayedSAC learned at ages 1 and is given 0, 2:"
    with pytest.warns(UserWarning, match=another):
        model.set_env(delayed((0, 2)))
    with pytest.warns(UserWarning, match=another):
        loaded = DelayedSAC.load(tmp_path / "agent", env=delayed(UniformDelay(0, 2)))
    loaded.learn(30)  # goes on under the new delays, and knows them from then on
    assert loaded.trained_ages == [0, 1, 2]


@pytest.mark.parametrize("first", [0, 1])
def test_each_of_several_environments_has_ages_of_its_own(first):
    envs = [lambda: delayed(1, max_delay=2), lambda: delayed(2)]
    model = make(DummyVecEnv(envs[:1] * 2)).learn(30)
    with pytest.warns(UserWarning, match="learned at ages 1 and is given 2:"):
        model.set_env(DummyVecEnv([envs[first], envs[1 - first]]))


@pytest.mark.parametrize("n", [None, 1, 3])
def test_ages_that_it_has_not_met_are_noticed_in_its_observations(n):
    """``evaluate_policy`` and a robot's control loop hand over no environment to be checked."""
    model = make(delayed(1, max_delay=2)).learn(30)
    history = np.full((2, 1), 0.5, np.float32)
    obs = {"observation": np.zeros(2, np.float32), "action_history": history, "delay": np.ones(1, np.float32)}
    start = {**obs, "action_history": np.array([[0.0], [0.5]], np.float32), "delay": np.zeros(1, np.float32)}
    rows = [obs, start] if n is None else [obs] * (n - 1) + [start]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for row in rows:
            model.predict(row)  # younger than ever amid an episode, but two actions have not been sent yet
    late = {**obs, "delay": np.full(1, 2, np.float32)}
    batch = late if n is None else {key: np.stack([row[key] for row in (*rows, late)]) for key in obs}
    with pytest.warns(UserWarning, match="learned at ages 1 and is given 2: what it does"):
        model.predict(batch)


def test_own_delays_may_say_their_smallest():
    model = make(delayed(LateDelay())).learn(30)
    assert model.trained_ages == [1, 2]
    with pytest.warns(UserWarning, match=r"learned at ages 1, 2 and is given 0:"):
        model.set_env(delayed(OwnDelay()))


def test_the_seed_decides():
    def run(seed):
        env = VecNormalize(make_vec_env(delayed, n_envs=2, seed=seed), norm_obs_keys=["observation"])
        return make(env, seed=seed).learn(60)

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
    obs = observe()
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    assert (loaded.augment_state, loaded.num_timesteps) == (False, 40)
    assert_same_parameters(model, loaded)
    loaded.set_env(delayed())
    assert loaded.learn(40, reset_num_timesteps=False).num_timesteps == 80


def own():
    return delayed(OwnDelay())


@pytest.mark.parametrize(("make_env", "ages"), [(Simulator, [0]), (own, [0, 1, 2])])
def test_environments_in_processes_of_their_own(make_env, ages):
    vec = make_vec_env(make_env, 2, vec_env_cls=SubprocVecEnv)
    try:
        assert make(vec).learn(20).trained_ages == ages
    finally:
        vec.close()


class Stop(BaseCallback):
    """Ends training at a step."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        return self.num_timesteps < self.at


def record(model, monkeypatch):
    """Return a list that will hold, step for step, the observations that the replay is given and the true states."""
    rows, add = [], model.replay_buffer.add

    def note(obs, next_obs, action, reward, done, infos):
        obs, next_obs = copy.deepcopy((obs, next_obs))
        if not isinstance(obs, dict):
            obs, next_obs = {"observation": obs}, {"observation": next_obs}
        after = infos[0].get(UNDELAYED, next_obs["observation"][0])
        rows.append((obs, next_obs, after))
        add(obs, next_obs, action, reward, done, infos)

    monkeypatch.setattr(model.replay_buffer, "add", note)
    return rows


def assert_replay_is_what_happened(model, rows):
    """Compare every row, and the steps of the task itself, with what the replay makes of them."""
    buffer = model.replay_buffer
    assert buffer.size() == len(rows) and buffer.n_envs == 1
    batch = buffer._get_samples(np.arange(len(rows)))
    states, history = batch.observations, "action_history"
    if not buffer.is_delayed:
        states = {"observation": states, UNDELAYED: states}
    for t, (obs, next_obs, after) in enumerate(rows):
        for key, value in obs.items():
            np.testing.assert_array_equal(states[key][t], value[0], err_msg=f"{key} at {t}")
        if history in obs:
            np.testing.assert_array_equal(next_obs[history][0, :-1], obs[history][0, 1:], err_msg=f"at {t}")
        state, action = states[UNDELAYED][t].numpy(), 2.0 * batch.actions[t].numpy()
        np.testing.assert_allclose(after, 0.9 * state + 0.1 * np.array([action[0], state[0]]), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4), lambda: delayed(1)], ids=["plain", "4", "1"])
@pytest.mark.parametrize("end", [lambda: StopTrainingOnMaxEpisodes(2), lambda: Stop(15), lambda: Kill(15)])
def test_learning_goes_on_after_a_rollout_that_was_cut_short(make_env, end, monkeypatch):
    model = make(make_env(), learning_starts=100)
    rows = record(model, monkeypatch)
    try:
        model.learn(100, callback=end())
    except Killed:
        pass
    stopped = model.num_timesteps  # with the step that SB3 has not stored
    assert len(rows) == stopped - 1
    model.learn(30, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)
    steps = model.replay_buffer.steps[: len(rows), 0]
    assert steps.max() == 11 and steps[stopped - 1] == 0
    assert model.replay_buffer.window_source().remaining.max() == 12


def test_consecutive_learning_goes_on_amid_an_episode(monkeypatch):
    model = make(delayed(4), learning_starts=100)
    rows = record(model, monkeypatch)
    for _ in range(4):
        model.learn(10, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)
    assert model.replay_buffer.steps[:40, 0].tolist() == [*range(12), *range(12), *range(12), *range(4)]


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4)], ids=["plain", "delayed"])
def test_learning_goes_on_where_the_replay_has_not_seen_the_episode(make_env, normalize, monkeypatch, tmp_path):
    env = make_vec_env(make_env, n_envs=1)
    env = VecNormalize(env, norm_obs_keys=["observation"] if make_env is not Drift else None) if normalize else env
    model = make(env, learning_starts=100).learn(20)
    model.save(tmp_path / "agent")
    model.replay_buffer.reset()
    rows = record(model, monkeypatch)
    model.learn(30, reset_num_timesteps=False)
    assert_replay_is_what_happened(model, rows)

    model.learn(20)
    loaded = DelayedSAC.load(tmp_path / "agent", env=model.env, force_reset=False, device="cpu")
    rows = record(loaded, monkeypatch)
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.num_timesteps == 50 and len(rows) == 30
    if make_env is not Drift:  # where nothing is delayed, force_reset=False is the caller's promise, as in SB3
        assert_replay_is_what_happened(loaded, rows)


@pytest.mark.parametrize("make_env", [Drift, lambda: delayed(4)], ids=["plain", "4"])
@pytest.mark.parametrize("cls", [DelayedSAC, StableSAC])
def test_a_callback_may_play_the_environment_after_a_step(make_env, cls, monkeypatch):
    class Play(BaseCallback):
        def _on_step(self):
            if self.n_calls % 15 == 0:
                with self.model.borrowed_env() as env:
                    env.reset()
                    env.step(np.array([env.action_space.sample()]))
            return True

    model = make(make_env(), cls=cls)
    rows = record(model, monkeypatch)
    model.learn(70, callback=Play())
    assert model.num_timesteps == 70 and len(rows) == 70 - 4  # whose observations are gone
    assert_replay_is_what_happened(model, rows)


def test_a_replay_emptied_during_training_is_refused_with_what_to_do():
    class Forget(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 30:
                self.model.replay_buffer.reset()
            return True

    with pytest.raises(ValueError, match=r"between two calls of learn\(\)"):
        make(delayed(4)).learn(60, callback=Forget())


def test_parameters_are_taken_over(tmp_path):
    trained, other = make().learn(40), make(seed=5)
    other.set_parameters(trained.get_parameters())
    assert_same_parameters(trained, other)
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy", device="cpu")
    np.testing.assert_array_equal(
        policy.predict(observe(), deterministic=True)[0], trained.predict(observe(), deterministic=True)[0]
    )


def test_evaluation_and_a_wrapper_without_delay():
    model = make(delayed(0)).learn(40)
    for policy in (model, model.policy):
        assert evaluate_policy(policy, delayed(0), n_eval_episodes=2)[0] == pytest.approx(12.0)
    batch = {key: np.stack([value] * 3) for key, value in observe(delay=0).items()}
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
    with pytest.raises(ValueError, match="holds a pickle"):
        make().load_replay_buffer(tmp_path / "pickled.pkl")
    for state in ({}, [], {**model.replay_buffer.state_dict(), "rewards": 3}):
        save_tree(tmp_path / "forged", state)
        with pytest.raises(SavedFileError, match="Cannot load"):
            other.load_replay_buffer(tmp_path / "forged")


def test_an_answer_that_is_not_finite_is_refused():
    wide = spaces.Box(-3e38, 3e38, (1,), np.float32)  # finite, but high - low is not
    policy = DelayedSACPolicy(spaces.Box(-1, 1, (2,)), wide, lambda _: 1e-3, net_arch=[8])
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="action is not finite"):
        policy.predict(np.zeros(2, np.float32), deterministic=True)


def test_a_replay_is_loaded_where_there_is_none(tmp_path):
    model = make(delayed((0, 2)), relabelled_ages=0.2, replay_buffer_kwargs={"handle_timeout_termination": False})
    model.learn(30).save_replay_buffer(tmp_path / "replay")
    before = model.replay_buffer
    model.replay_buffer, device = None, model.device
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "another")
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


# ---------------------------------------------------------------------------------------------------- refusals


class DictTask(gym.ObservationWrapper):
    """A plain task with a dict observation, which is none of ours."""

    def __init__(self):
        super().__init__(Drift())
        self.observation_space = spaces.Dict(vec=self.env.observation_space)

    def observation(self, observation):
        return {"vec": observation}


ABOVE = "go below DelayedObservationWrapper"
UNFIT = {
    "all normalised": (lambda: VecNormalize(make_vec_env(delayed)), r"norm_obs_keys=\['observation'\]"),
    "stacked": (lambda: VecFrameStack(make_vec_env(delayed), 3), ABOVE),
    "one array": (lambda: gym.wrappers.FlattenObservation(delayed()), "made one array of its observation"),
    "its observation alone": (lambda: VecExtractDictObs(make_vec_env(delayed), "observation"), "made one array of its"),
    "a plain task": (Drift, "task in a DelayedObservationWrapper.*max_delay=2"),
    "another max_delay": (lambda: delayed(3), "built for max_delay=2, but this environment has max_delay=3"),
    "a history of states": (lambda: DelayedObservationWrapper(Drift(), 2, state_history=True), "do not match"),
    "a task of another size": (lambda: DelayedObservationWrapper(gym.make("Pendulum-v1"), 2), "do not match"),
}


@pytest.mark.parametrize("unfit", UNFIT)
def test_an_environment_that_does_not_fit_is_not_taken(unfit, tmp_path):
    make_env, message = UNFIT[unfit]
    model = make().learn(30)
    before = model.env
    with pytest.raises(ValueError, match=message):
        model.set_env(make_env())
    assert model.env is before and model.get_vec_normalize_env() is None
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=message):
        DelayedSAC.load(tmp_path / "agent", env=make_env())


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_a_delay_is_seen_below_what_makes_one_array_of_its_observation(vec_env_cls):
    vec = vec_env_cls([lambda: gym.wrappers.FlattenObservation(delayed())])
    try:
        with pytest.raises(ValueError, match=r"finds neither age nor actions.*go below DelayedObservationWrapper"):
            make(vec)
    finally:
        vec.close()


@pytest.mark.parametrize(
    ("policy", "message"),
    [("CnnPolicy", "has the policies MlpPolicy, MultiInputPolicy, got 'CnnPolicy'"), (SACPolicy, "give 'MlpPolicy'")],
)
def test_other_policies_are_refused_with_those_there_are(policy, message):
    with pytest.raises(ValueError, match=message):
        make(policy=policy)


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


def test_a_delayed_task_is_not_taken_where_there_was_none():
    model = make(Drift())
    for env in (delayed(0), delayed(2)):
        with pytest.raises(ValueError, match=r"without a DelayedObservationWrapper, .*; leave it out"):
            model.set_env(env)


def test_a_normalised_environment_is_taken():
    model = make(VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"])).learn(30)
    model.set_env(other := VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"]))
    assert model.learn(30).get_vec_normalize_env() is other


@pytest.mark.parametrize(
    ("vec_env_cls", "cls"), [(DummyVecEnv, DelayedSAC), (DummyVecEnv, SAID), (SubprocVecEnv, DelayedSAC)]
)
def test_environments_of_other_histories_are_refused_before_they_start(vec_env_cls, cls):
    vec = vec_env_cls([delayed, partial(delayed, 4)])
    try:
        with pytest.raises(ValueError, match=r"max_delay are \[2, 4\]; give each of them .*max_delay=4\)"):
            make(vec, cls)
    finally:
        vec.close()
    model = make(DummyVecEnv([partial(delayed, max_delay=4), partial(delayed, 4)])).learn(30)
    assert model.trained_ages == [2, 4]
    with pytest.raises(ValueError, match=r"max_delay are \[4, 2\]"):
        model.set_env(DummyVecEnv([partial(delayed, 4), delayed]))


class Noisy(gym.ObservationWrapper):
    def observation(self, observation):
        return {**observation, "observation": observation["observation"] + np.float32(0.01)}


@pytest.mark.parametrize("wrap", [TimeFeatureWrapper, Noisy])
def test_wrappers_of_observations_go_below_ours(wrap):
    with pytest.raises(ValueError, match=ABOVE):
        make(wrap(delayed())).learn(30)
    if wrap is TimeFeatureWrapper:
        env = DelayedObservationWrapper(TimeFeatureWrapper(gym.wrappers.TimeLimit(Drift(), 12)), 2)
        assert make(env).learn(30).replay_buffer.observations.shape[-1] == 3


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 3}, "one-step targets"),
        ({"replay_buffer_class": DictReplayBuffer}, "DelayedReplayBuffer"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"policy_kwargs": {"share_features_extractor": True}}, "share_features_extractor"),
        ({"policy_kwargs": {"features_extractor_class": CombinedExtractor}}, "features_extractor_class"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"size": 3}}}, "features_extractor_kwargs"),
        ({"policy_kwargs": {"augment_state": False}}, "augment_state to DelayedSAC itself"),
        ({"relabelled_ages": 2.0}, r"in \[0, 1\]"),
        ({"replay_buffer_kwargs": {"relabelled_ages": 1.0}}, "relabelled_ages to DelayedSAC itself"),
        ({"policy": "CnnPolicy"}, "CnnPolicy"),
        ({"buffer_size": 3}, "buffer_size"),
        ({"env": VecNormalize(make_vec_env(delayed))}, r"norm_obs_keys=\['observation'\]"),
        ({"env": VecNormalize(make_vec_env(DictTask))}, "wrap the task in it"),
    ],
)
def test_arguments_that_cannot_work_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_rewards_alone_may_be_normalized():
    assert make(VecNormalize(make_vec_env(delayed), norm_obs=False)).learn(30).num_timesteps == 30


def test_other_buffers_are_refused_without_delay_too():
    with pytest.raises(ValueError, match="DelayedReplayBuffer, got ReplayBuffer"):
        make(Drift(), replay_buffer_class=ReplayBuffer)


def changed(**parts):
    return {**observe(), **parts}


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (changed(observation=np.array([np.nan, 0.0], np.float32)), "observation has entries that are NaN"),
        (changed(observation=np.array([0.0, np.inf], np.float32)), "observation has entries that are NaN or infinite"),
        (changed(action_history=np.full((2, 1), np.nan, np.float32)), "action_history has entries that are NaN"),
        (changed(delay=np.array([np.nan], np.float32)), "delay has entries that are NaN"),
        (changed(delay=np.array([3.0], np.float32)), r"0\.\.2: the agent was built for max_delay=2"),
        (changed(delay=np.array([-1.0], np.float32)), r"whole numbers in 0\.\.2"),
        (changed(delay=np.array([0.5], np.float32)), r"whole numbers in 0\.\.2"),
        (changed(action_history=np.full((2, 1), 1.5, np.float32)), r"scaled to \[-1, 1\]"),
        (changed(observation=np.zeros(3, np.float32)), r"observation has the shape \(3,\), expected \(2,\)"),
        (observe(delay=3), r"action_history has the shape \(3, 1\).*another task or max_delay"),
        (changed(delay=np.zeros((4, 1), np.float32)), "differ in how many"),
        ({"observation": np.zeros(2, np.float32)}, "DelayedObservationWrapper"),
        (changed(undelayed_observation=np.zeros(2, np.float32)), "undelayed_observation"),
        (np.zeros(2, np.float32), "got ndarray"),
        ((observe(), {}), "tuple"),
        (changed(observation=np.array([0.0, 1e300])), "observation has entries that are NaN or infinite"),
        (changed(observation=np.array(["0.5", "a"])), "observation holds <U3, expected real numbers"),
        (changed(observation=np.array([0.5, None])), "observation holds object, expected real numbers"),
        (changed(action_history=[["0.5"], ["0.5"]]), "action_history holds <U3, expected real numbers"),
        (changed(delay=[None]), "delay holds object, expected real numbers"),
        (changed(observation=[0.5, [0.5]]), "observation cannot be made an array"),
        ({key: value[None][:0] for key, value in observe().items()}, "empty batch"),
        ({**observe(), 3: np.zeros(2)}, "with the keys"),
    ],
)
def test_bad_observations_are_refused_before_anything_is_computed(obs, message, monkeypatch):
    model = make()

    def computed(*_, **__):
        raise AssertionError("the actor was asked")

    monkeypatch.setattr(model.policy.actor, "forward", computed)
    state = th.get_rng_state()
    for deterministic in (True, False):
        with pytest.raises(ValueError, match=message):
            model.predict(obs, deterministic=deterministic)
    assert th.equal(state, th.get_rng_state())


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (np.array([np.nan, 0.0]), "NaN"),
        (np.zeros(3), r"shape \(3,\), expected \(2,\)"),
        (np.zeros((2, 3, 2)), "shape"),
        (observe(), "without delay"),
        ({3: 0, "a": 0}, "without delay"),
        (np.array([0.0, 1e300]), "NaN or infinite"),
        (["0.5", "0.5"], "observation holds <U3, expected real numbers"),
        ([0.5, None], "observation holds object, expected real numbers"),
        (None, "observation holds object, expected real numbers"),
        ([0.5, [0.5]], "observation cannot be made an array"),
        (np.zeros((0, 2)), "empty batch"),
    ],
)
def test_bad_observations_are_refused_without_delay_too(obs, message):
    with pytest.raises(ValueError, match=message):
        make(Drift()).predict(obs)


def own_dtypes(obs):
    """Yield what a user may hand in for the same float32 observations: other dtypes, lists, other layouts in memory."""
    yield {key: value.astype(np.float64) for key, value in obs.items()}
    yield {key: value.astype(np.int64) if key == "delay" else value for key, value in obs.items()}
    yield {key: value.tolist() for key, value in obs.items()}
    yield {key: np.asfortranarray(value) for key, value in obs.items()}
    yield {key: np.flip(np.flip(value).copy()) for key, value in obs.items()}
    yield {key: np.frombuffer(value.tobytes(), np.float32).reshape(value.shape) for key, value in obs.items()}


@pytest.mark.filterwarnings("error", "ignore:On held-out windows:UserWarning")
@pytest.mark.parametrize("make_env", [Drift, delayed], ids=["plain", "delayed"])
@pytest.mark.parametrize("cls", [DelayedSAC, SAID])
@pytest.mark.parametrize("batch", [False, True])
def test_the_same_numbers_get_the_same_answer_in_any_dtype(make_env, cls, batch):
    planner = {"d_model": 32, "depth": 1, "horizon": 3, "sampling_steps": 2, "n_candidates": 4, "temperature": 0.5}
    planner = {"planner_kwargs": planner, "planner_gradient_steps": 2} if cls is SAID else {}
    model = make(make_env(), cls=cls, **planner).learn(40)
    assert cls is DelayedSAC or model.policy.planner_is_trained
    obs = observe()
    if batch:
        obs = {key: np.stack([value, value, value]) for key, value in obs.items()}
    if make_env is Drift:
        obs = {"observation": obs["observation"]}

    def answer(obs):
        return model.predict(obs if make_env is delayed else obs["observation"], deterministic=True)[0]

    expected, before = answer(obs), copy.deepcopy(obs)
    for same in own_dtypes(obs):
        np.testing.assert_array_equal(answer(same), expected)
    for key in obs:
        np.testing.assert_array_equal(obs[key], before[key])
