"""Which environments and arguments DelayedSAC takes, and what it says of those that cannot work."""

import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from small_agent import make as make_agent
from small_task import Drift, LateDelay, LateSimulator, OwnDelay, Simulator, delayed
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
)
from stable_baselines3.sac.policies import SACPolicy

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.delays import TotalDelay, UniformDelay, scale_action

make = partial(make_agent, cls=DelayedSAC)


def own():
    return delayed(OwnDelay())


@pytest.mark.parametrize(("make_env", "ages"), [(Simulator, [0]), (own, [0, 1, 2])])
def test_environments_in_processes_of_their_own(make_env, ages):
    vec = make_vec_env(make_env, 2, vec_env_cls=SubprocVecEnv)
    try:
        assert make(vec).learn(20).trained_ages == ages
    finally:
        vec.close()


class Steps(Drift):
    """Counts what it is sent, as a motor that knows whole steps alone."""

    def __init__(self, space):
        super().__init__()
        self.action_space, self.sent = space, []

    def step(self, action):
        self.sent.append(np.array(action))
        return super().step(np.asarray(action, float))


@pytest.mark.parametrize(("cls", "is_noisy"), [(DelayedSAC, False), (DelayedSAC, True), (SAID, False)])
@pytest.mark.parametrize(
    "space",
    [spaces.Box(-3, 5, (2,), np.int64), spaces.Box(-128, 127, (2,), np.int8), spaces.Box(0, 200, (2,), np.uint8)],
)
def test_whole_numbers_are_sent_stored_and_answered_as_they_are(cls, is_noisy, space):
    task = Steps(space)
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.3)) if is_noisy else None
    model = make_agent(DelayedObservationWrapper(task, 2), cls, action_noise=noise, learning_starts=35).learn(45)
    assert all(space.contains(action) for action in task.sent) and len(np.unique(task.sent)) > 3
    stored = model.replay_buffer._get_samples(np.arange(45))
    np.testing.assert_allclose(stored.actions, scale_action(np.array(task.sent), space), atol=1e-6)
    newest = stored.observations["action_history"][:, -1]
    np.testing.assert_allclose(newest[1:12], stored.actions[:11], atol=1e-6)  # of the first episode
    obs = {key: np.repeat(part[None], 3, axis=0) for key, part in model.observation_space.sample().items()}
    obs["delay"] = np.array([[0], [1], [2]])
    for deterministic in (True, False):
        answers = model.predict(obs, deterministic=deterministic)[0]
        assert answers.dtype == space.dtype and all(space.contains(answer) for answer in answers)


@pytest.mark.parametrize("task", [Drift, LateSimulator])
@pytest.mark.parametrize("error", [NotImplementedError, AttributeError])
def test_a_simulator_that_knows_no_wrappers_is_taken(error, task, monkeypatch):
    """As those whose environments are computed side by side on a GPU."""

    def refuse(*_):
        raise error("Asking an environment is not supported.")

    env = DummyVecEnv([task, task])
    monkeypatch.setattr(env, "env_is_wrapped", refuse)
    monkeypatch.setattr(env, "get_attr", refuse)
    model = make(env).learn(20)
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 40
    assert model.trained_ages == ([0] if task is Drift else [0, 1, 2])


def test_a_normalised_environment_is_taken():
    model = make(VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"])).learn(30)
    model.set_env(other := VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"]))
    assert model.learn(30).get_vec_normalize_env() is other


def test_rewards_alone_may_be_normalized():
    assert make(VecNormalize(make_vec_env(delayed), norm_obs=False)).learn(30).num_timesteps == 30


class DictTask(gym.ObservationWrapper):
    """A plain task with a dict observation, which is none of ours."""

    def __init__(self):
        super().__init__(Drift())
        self.observation_space = spaces.Dict(vec=self.env.observation_space)

    def observation(self, observation):
        return {"vec": observation}


class TwoActions(Drift):
    action_space = spaces.Box(-2.0, 2.0, (2,), np.float32)


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
    "a task of more actions": (lambda: DelayedObservationWrapper(TwoActions(), 2), "spaces do not match"),
}


@pytest.mark.parametrize("unfit", UNFIT)
def test_an_environment_that_does_not_fit_is_not_taken(unfit, tmp_path):
    make_env, message = UNFIT[unfit]
    model = make().learn(10)
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


def test_a_delayed_task_is_not_taken_where_there_was_none():
    model = make(Drift())
    for env in (delayed(0), delayed(2)):
        with pytest.raises(ValueError, match=r"without a DelayedObservationWrapper, .*; leave it out"):
            model.set_env(env)


@pytest.mark.parametrize(
    ("vec_env_cls", "cls"), [(DummyVecEnv, DelayedSAC), (DummyVecEnv, SAID), (SubprocVecEnv, DelayedSAC)]
)
def test_environments_of_other_histories_are_refused_before_they_start(vec_env_cls, cls):
    vec = vec_env_cls([delayed, partial(delayed, 4)])
    try:
        with pytest.raises(ValueError, match=r"max_delay are \[2, 4\]; give each of them .*max_delay=4\)"):
            make(vec, cls=cls)
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


def test_wrappers_that_change_actions_go_below_ours_too():
    narrow = spaces.Box(-1.0, 1.0, (1,), np.float32)
    above = gym.wrappers.TransformAction(delayed(), lambda action: action, narrow)
    with pytest.warns(UserWarning, match=r"changes actions on their way.*go below DelayedObservationWrapper") as caught:
        make(above).learn(30)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(DelayedObservationWrapper(gym.wrappers.TransformAction(Drift(), lambda action: action, narrow), 2)).learn(
            30
        )
        make(gym.wrappers.RescaleAction(delayed(), np.float32(-1), np.float32(1))).learn(30)  # bounds become bounds
        make(DelayedObservationWrapper(Drift(), 1, "UniformDelay(0, 2)")).learn(30)


def test_an_agent_of_normalised_observations_is_not_let_into_others_in_silence(tmp_path):
    model = make(VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"])).learn(30)
    model.save(tmp_path / "agent")
    said = r"DelayedSAC learned from observations that VecNormalize had normalised.*load_normalization"
    with pytest.warns(UserWarning, match=said):
        loaded = DelayedSAC.load(tmp_path / "agent", env=delayed())
    with pytest.warns(UserWarning, match=said):
        model.set_env(delayed())
    assert loaded.reads_normalized and model.reads_normalized
    loaded.save(tmp_path / "again")
    assert DelayedSAC.load(tmp_path / "again").reads_normalized
    assert not model.learn(30).reads_normalized  # of which it has learned by now


def test_an_agent_of_observations_as_they_are_is_not_let_into_normalised_ones_in_silence(tmp_path):
    model, env = make().learn(30), VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"])
    model.save(tmp_path / "agent")
    said = "DelayedSAC learned from observations as they are, and VecNormalize normalises those"
    with pytest.warns(UserWarning, match=said):
        loaded = DelayedSAC.load(tmp_path / "agent", env=env)
    with pytest.warns(UserWarning, match=said):
        model.set_env(env)
    assert not (loaded.reads_normalized or model.reads_normalized)
    assert model.learn(30).reads_normalized


@pytest.mark.parametrize("own", [np.int64(3), np.eye(2)[0], "one of many"])
def test_a_task_s_own_task_id_is_no_name_unless_it_is_text(own, tmp_path):
    env = Drift()
    env.task_id = own
    model = make(env)
    model.save(tmp_path / "agent")
    assert DelayedSAC.load(tmp_path / "agent").task == (own if isinstance(own, str) else None)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_environments_tell_their_task_from_other_processes_too(vec_env_cls):
    def make_env():
        task = gym.wrappers.TransformAction(gym.make("Pendulum-v1"), lambda action: action, None)
        return DelayedObservationWrapper(task, 2)

    vec = vec_env_cls([make_env])  # whose spec cannot be pickled
    try:
        assert make(vec).task == "Pendulum-v1"
    finally:
        vec.close()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 3}, "one-step targets"),
        ({"gamma": 1.5}, "gamma is 1.5, expected 0..1"),
        ({"gamma": -1}, "gamma is -1"),
        ({"tau": 5.0}, "tau is 5.0"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"learning_starts": -5}, "learning_starts is -5"),
        ({"train_freq": (0, "episode")}, "train_freq"),
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


@pytest.mark.parametrize(
    ("policy", "message"),
    [("CnnPolicy", "has the policies MlpPolicy, MultiInputPolicy, got 'CnnPolicy'"), (SACPolicy, "give 'MlpPolicy'")],
)
def test_other_policies_are_refused_with_those_there_are(policy, message):
    with pytest.raises(ValueError, match=message):
        make(policy=policy)


def test_other_buffers_are_refused_without_delay_too():
    with pytest.raises(ValueError, match="DelayedReplayBuffer, got ReplayBuffer"):
        make(Drift(), replay_buffer_class=ReplayBuffer)


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


def test_own_delays_may_say_their_smallest():
    model = make(delayed(LateDelay())).learn(30)
    assert model.trained_ages == [1, 2]
    with pytest.warns(UserWarning, match=r"learned at ages 1, 2 and is given 0:"):
        model.set_env(delayed(OwnDelay()))
