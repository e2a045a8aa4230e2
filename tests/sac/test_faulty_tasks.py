"""Tasks that break Gymnasium's rules: each is learned from as if it kept them, or refused, and none in silence."""

from functools import cache

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_agent import make, same_replay
from small_task import Drift
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said import DelayedObservationWrapper, DelayedSAC, StableSAC
from sb3_said.files.checkpoint import CHECKPOINT_NAME, TrainingCheckpointCallback, restore_training

FAULTY_STEP = 15  # of all steps, in the second episode


class Faulty(Drift):
    """Keeps the rules but for what ``breaks`` makes of the answers of ``step``, and ``breaks_reset`` of ``reset``."""

    def __init__(self, breaks=None, breaks_reset=None, from_step=1, **kwargs):
        super().__init__(**kwargs)
        self.breaks, self.breaks_reset, self.from_step = breaks, breaks_reset, from_step
        self.n_steps = 0

    def reset(self, **kwargs):
        answer = super().reset(**kwargs)
        is_faulty = self.breaks_reset is not None and self.n_steps >= self.from_step - 1
        return self.breaks_reset(*answer) if is_faulty else answer

    def step(self, action):
        answer = super().step(action)
        self.n_steps += 1
        is_faulty = self.breaks is not None and self.n_steps >= self.from_step
        return self.breaks(self, action, *answer) if is_faulty else answer


def changed(**parts):
    """Return what replaces parts of an answer by what functions make of them."""

    def breaks(task, action, obs, reward, terminated, truncated, info):
        answer = {"obs": obs, "reward": reward, "terminated": terminated, "truncated": truncated, "info": info}
        return tuple(parts[name](value) if name in parts else value for name, value in answer.items())

    return breaks


def wrapped(*args, **kwargs):
    return DelayedObservationWrapper(Faulty(*args, **kwargs), 2)


def learn(env, steps=40):
    return make(env, DelayedSAC, learning_starts=100).learn(steps)


@cache
def learned_of_a_whole_one(make_task, truncates):
    return learn(make_task(truncates=truncates))


# ---------------------------------------------------------------------------------------------------- harmless


def halved(task, action, *answer):
    action *= 0.5
    return answer


def in_place(task, action, obs, *rest):
    task.kept = getattr(task, "kept", obs)
    task.kept[:] = obs
    return task.kept, *rest


HARMLESS = {
    "the action is changed in place": halved,
    "observations are float64": changed(obs=lambda obs: obs.astype(np.float64)),
    "observations are lists": changed(obs=lambda obs: obs.tolist()),
    "rewards are float64": changed(reward=np.float64),
    "rewards are whole numbers": changed(reward=int),
    "rewards are an array": changed(reward=np.array),
    "terminated is a number": changed(terminated=int),
    "terminated is NumPy's": changed(terminated=np.bool_),
    "truncated is NumPy's": changed(truncated=np.bool_),
    "truncated is an array": changed(truncated=lambda end: np.array([end])),
    "both are arrays": changed(truncated=np.array, terminated=np.array),
    "info has names of ours": changed(
        info=lambda _: {"undelayed_observation": np.zeros(7), "executed_action": "none", "forced_deliveries": None}
    ),
    "info tells of a time limit": changed(info=lambda _: {"TimeLimit.truncated": np.array([True, False])}),
}


@pytest.mark.parametrize("truncates", [True, False])
@pytest.mark.parametrize("make_task", [Faulty, wrapped])
@pytest.mark.parametrize("fault", HARMLESS)
def test_what_can_be_understood_is_learned_from_as_if_it_kept_the_rules(fault, make_task, truncates):
    model = learn(make_task(HARMLESS[fault], truncates=truncates))
    expected = learned_of_a_whole_one(make_task, truncates)
    assert same_replay(model, expected)
    for name in ("dones", "timeouts"):
        np.testing.assert_array_equal(getattr(model.replay_buffer, name), getattr(expected.replay_buffer, name))


def test_one_array_for_all_observations():  # under SB3's own VecEnv the reset overwrites an episode's last one
    assert same_replay(learn(wrapped(in_place)), learned_of_a_whole_one(wrapped, True))


@pytest.mark.parametrize("make_task", [Faulty, wrapped])
def test_time_limits_told_by_arrays_in_some_of_several_environments(make_task):
    models = [
        learn(DummyVecEnv([make_task, lambda breaks=breaks: make_task(breaks, length=5), make_task]))
        for breaks in (None, HARMLESS["truncated is an array"])
    ]
    assert same_replay(*models)
    assert models[0].replay_buffer.timeouts[:14].sum() == 4


# ---------------------------------------------------------------------------------------------------- refused


NOT_FINITE = {
    "NaN reward": changed(reward=lambda _: np.nan),
    "infinite reward": changed(reward=lambda _: -np.inf),
    "reward beyond float32": changed(reward=lambda _: 1e300),
    "NaN observation": changed(obs=lambda obs: np.array([obs[0], np.nan], np.float32)),
    "infinite observation": changed(obs=lambda obs: np.array([np.inf, obs[1]], np.float32)),
    "observation beyond float32": changed(obs=lambda obs: np.array([1e300, obs[1]])),
}


@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")  # where the task's 1e300 is stored
@pytest.mark.parametrize("cls", [DelayedSAC, StableSAC])
@pytest.mark.parametrize("make_task", [Faulty, wrapped])
@pytest.mark.parametrize("fault", NOT_FINITE)
def test_what_is_not_finite_ends_learning_with_the_environments_number(fault, make_task, cls):
    breaks, part = NOT_FINITE[fault], "reward" if "reward" in fault else "observation after the action"
    envs = [make_task, lambda: make_task(breaks, from_step=FAULTY_STEP)]
    model = make(DummyVecEnv(envs), cls)
    with pytest.raises(ValueError, match=f"The {part} of environment 1 is not finite.*VecCheckNan"):
        model.learn(60)
    assert model.replay_buffer.size() == FAULTY_STEP - 1
    assert np.isfinite(model.replay_buffer.rewards).all() and np.isfinite(model.replay_buffer.observations).all()
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())


@pytest.mark.parametrize("make_task", [Faulty, wrapped])
@pytest.mark.parametrize(
    ("learning_starts", "message"),
    [
        (100, "The observation before the action of environment 0 is not finite"),
        (0, "observation has entries that are"),
    ],
)
def test_a_reset_to_what_is_not_finite(learning_starts, message, make_task):
    env = make_task(breaks_reset=lambda obs, info: (obs * np.nan, info), from_step=12)
    model = make(env, DelayedSAC, learning_starts=learning_starts)
    with pytest.raises(ValueError, match=message):
        model.learn(60)
    assert model.replay_buffer.size() == 12


def test_a_run_goes_on_from_the_checkpoint_before_it(tmp_path):
    def callback():
        return TrainingCheckpointCallback(tmp_path, 10)

    broken = changed(reward=lambda _: np.nan)
    with pytest.raises(ValueError, match="reward of environment 0"):
        make(wrapped(broken, from_step=35), DelayedSAC).learn(60, callback())
    model = make(wrapped(), DelayedSAC)
    restore_training(model, tmp_path / CHECKPOINT_NAME)
    assert model.num_timesteps == 30
    model.learn(30, callback(), reset_num_timesteps=False)
    assert model.num_timesteps == 60 and model.replay_buffer.size() == 60


REFUSED = {
    "a longer observation": (changed(obs=lambda obs: np.append(obs, 0)), "shape"),
    "a shorter observation": (changed(obs=lambda obs: obs[:1]), r"shape \(1,\)"),
    "a number for an observation": (changed(obs=lambda obs: obs[0]), r"shape \(\)"),
    "a matrix": (changed(obs=lambda obs: obs[None]), r"shape \(1, 2\)"),
    "words": (changed(obs=lambda obs: np.array(["a", "b"])), "holds <U1"),
    "nothing": (changed(obs=lambda obs: np.array([None, None])), "holds object"),
    "complex numbers": (changed(obs=lambda obs: obs + 1j), "holds complex64"),
    "no info": (changed(info=lambda _: None), "info of type NoneType"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_cannot_be_understood_is_refused(fault):
    breaks, message = REFUSED[fault]
    with pytest.raises(ValueError, match=message):
        learn(wrapped(breaks, from_step=FAULTY_STEP))


def test_a_reset_without_info():
    with pytest.raises(ValueError, match="info of type NoneType"):
        learn(wrapped(breaks_reset=lambda obs, info: obs, from_step=FAULTY_STEP))


SB3_REFUSES = {
    "a longer observation": changed(obs=lambda obs: np.append(obs, 0)),
    "words": changed(obs=lambda _: np.array(["a", "b"])),
    "no info": changed(info=lambda _: None),
    "two rewards": changed(reward=lambda _: np.zeros(2)),
    "no reward": changed(reward=lambda _: None),
    "two ends": changed(terminated=lambda _: np.zeros(2, bool)),
}


@pytest.mark.parametrize("fault", SB3_REFUSES)
def test_sb3_refuses_the_rest_of_them_without_our_wrapper(fault):
    breaks = SB3_REFUSES[fault]
    model = make(Faulty(breaks, from_step=FAULTY_STEP), DelayedSAC)
    with pytest.raises((ValueError, TypeError)):
        model.learn(60)
    assert model.replay_buffer.size() == FAULTY_STEP - 1


def test_a_plain_task_whose_info_has_names_of_ours_is_no_delayed_one():
    task = Faulty(HARMLESS["info has names of ours"])
    assert learn(task).replay_buffer.observations.shape == (500, 1, 2)
    task.observation_space = spaces.Dict(observation=task.observation_space)
    with pytest.raises(ValueError, match="wrap the task in it"):
        make(task, DelayedSAC)
