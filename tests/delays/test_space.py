"""Which spaces are served, what is read off them, and why others are refused."""

import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from counting_task import OBS_DIM, CountingTask
from gymnasium import spaces
from gymnasium.wrappers import ClipAction, FlattenObservation, FrameStackObservation, TransformAction
from small_task import Drift, LateDelay, LateSimulator, OwnDelay, TellingSimulator, delayed
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_said.delays import DelayedObservationWrapper, TotalDelay, scale_action, unscale_action
from sb3_said.delays.space import (
    ages_of,
    check_one_max_delay,
    check_spaces,
    delayed_space,
    has_state_history,
    within_bounds,
    written_ages,
)


def with_parts(**parts):
    """The space of a delayed task, of 3 numbers and 2 actions, with other parts."""
    return spaces.Dict({**delayed_space(spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,)), 5).spaces, **parts})


@pytest.mark.parametrize(
    ("observation_space", "action_space", "reason"),
    [
        (spaces.Box(-1, 1, (3, 3)), spaces.Box(-1, 1, (2,)), "FlattenObservation"),
        (spaces.Discrete(3), spaces.Box(-1, 1, (2,)), "FlattenObservation"),
        (spaces.Dict(observation=spaces.Box(-1, 1, (3,))), spaces.Box(-1, 1, (2,)), "wrap the task"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, -1, (2,)), "low and high are equal"),
        (spaces.Sequence(spaces.Discrete(3)), spaces.Box(-1, 1, (2,)), "of a fixed length"),
        (spaces.Box(-1, 1, (3,)), spaces.Discrete(2), "discrete actions is not supported"),
        (spaces.Box(-1, 1, (3,)), spaces.MultiDiscrete([2, 2]), "discrete actions is not supported"),
        (spaces.Box(-1, 1, (3,)), spaces.Dict(a=spaces.Box(-1, 1, (2,))), "let the agent see one, with .*TransformA"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, np.inf, (2,)), "must be finite.*TransformAction"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2, 2)), r"1-D Box action.*action\.reshape"),
        (spaces.Box(-1, 1, (0,)), spaces.Box(-1, 1, (2,)), "The observation has no entries"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (0,)), "The action has no entries"),
        (with_parts(action_history=spaces.Box(-1, 1, (5, 1))), spaces.Box(-1, 1, (2,)), r"gives the shape \(5, 2\)"),
        (with_parts(action_history=spaces.Box(-1, 1, (10**9, 0))), spaces.Box(-1, 1, (2,)), "gives the shape"),
        (with_parts(observation=spaces.Box(-1, 1, (4, 3))), spaces.Box(-1, 1, (2,)), "1-D Box. Wrappers .* go below"),
        (with_parts(delay=spaces.Box(0, 5, (2,))), spaces.Box(-1, 1, (2,)), r"delay was changed to .*\(2,\)"),
    ],
)
def test_other_spaces_are_refused_with_a_reason(observation_space, action_space, reason):
    with pytest.raises(ValueError, match=reason) as refused:
        check_spaces(observation_space, action_space)
    assert "RescaleAction" not in str(refused.value)  # which needs finite bounds itself


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.Box(-1, 1, ()), spaces.Box(0, 255, (2, 2, 3), np.uint8),
              spaces.Dict(a=spaces.Box(-1, 1, (3,)), b=spaces.Discrete(2))], ids=str
)  # fmt: skip
def test_an_observation_is_served_once_it_is_flattened(space):
    task = CountingTask(itertools.count(), max_length=3)
    task.observation_space, task._new_state = space, space.sample
    env = DelayedObservationWrapper(FlattenObservation(task), 1)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs) and env.observation_space.contains(
        env.step(env.action_space.sample())[0]
    )


BOUNDS = [
    ([-2, 0], [2, 8], np.float32),
    ([-1, -1], [1, 1], np.float32),
    ([-0.4, 0.1], [0.4, 0.3], np.float64),
    ([-3e38, -3e38], [3e38, 3e38], np.float32),
]


@pytest.mark.parametrize(("low", "high", "dtype"), BOUNDS)
def test_scaled_actions_go_to_one_and_back(low, high, dtype):
    space = spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    ends = np.stack([space.low, space.high])
    np.testing.assert_allclose(scale_action(ends, space), [[-1, -1], [1, 1]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(unscale_action(np.array([[-1, -1], [1, 1]]), space), ends, rtol=1e-15)
    np.testing.assert_allclose(unscale_action(np.array([-7.0, 7.0]), space), [space.low[0], space.high[1]], rtol=1e-15)
    space.seed(0)
    actions = np.stack([space.sample() for _ in range(100)])
    back = unscale_action(scale_action(actions, space), space)
    assert back.dtype == space.dtype and all(space.contains(action) for action in back)
    assert np.all(np.abs(back.astype(float) - actions) <= 1e-7 * (space.high.astype(float) - space.low))


@pytest.mark.parametrize(
    ("low", "high", "dtype"), [(0, 10, np.int64), (-128, 127, np.int8), (-100, 100, np.int8), (0, 255, np.uint8)]
)
def test_whole_numbers_come_back(low, high, dtype):
    space = spaces.Box(low, high, (1,), dtype)
    actions = np.arange(low, high + 1)[:, None].astype(dtype)
    scaled = scale_action(actions, space).astype(np.float32)
    np.testing.assert_array_equal(unscale_action(scaled, space), actions)
    np.testing.assert_array_equal(
        within_bounds(np.array([low - 3.0, high - 0.1, high + 3.0]), space), [low, high, high]
    )


@pytest.mark.parametrize(("low", "high", "dtype"), BOUNDS[:3])
def test_actions_are_scaled_as_by_sb3(low, high, dtype):
    space = spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    policy = SACPolicy(spaces.Box(-1, 1, (3,)), space, lambda _: 1e-3, net_arch=[4])
    space.seed(1)
    actions = np.stack([space.sample() for _ in range(100)])
    np.testing.assert_allclose(scale_action(actions, space), policy.scale_action(actions), atol=1e-5)
    scaled = scale_action(actions, space)
    np.testing.assert_allclose(unscale_action(scaled, space), policy.unscale_action(scaled), rtol=1e-6, atol=1e-6)


class Boundless(Drift):
    action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)


class Matrix(Drift):
    action_space = spaces.Box(-2.0, 2.0, (1, 1), np.float32)

    def step(self, action):
        assert action.shape == (1, 1)
        return super().step(action[0])


@pytest.mark.parametrize(
    ("task", "wrap"),
    [
        (Boundless, lambda task: TransformAction(task, lambda action: action, spaces.Box(-2.0, 2.0, (1,)))),
        (Matrix, lambda task: TransformAction(task, lambda action: action.reshape(1, 1), spaces.Box(-2.0, 2.0, (1,)))),
    ],
)
def test_what_is_advised_where_actions_do_not_fit_helps(task, wrap):
    with pytest.raises(ValueError, match=r"gymnasium\.wrappers\.TransformAction"):
        DelayedObservationWrapper(task())
    with pytest.raises(ValueError, match="bounds"):
        DelayedObservationWrapper(ClipAction(Boundless()))
    env, expected = DelayedObservationWrapper(wrap(task()), 1), delayed(1)
    for each in (env, expected):
        each.reset(seed=0)
    answers = [each.step(np.array([0.5], np.float32))[0] for each in (env, expected)]
    np.testing.assert_equal(*answers)


def stacked(**kwargs):
    return VecFrameStack(DummyVecEnv([lambda: delayed(**kwargs)]), 3)


class Renamed(gym.ObservationWrapper):
    """Adds an entry of its own."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({**env.observation_space.spaces, "battery": spaces.Box(0, 1, (1,))})

    def observation(self, observation):
        return {**observation, "battery": np.ones(1, np.float32)}


@pytest.mark.parametrize(
    ("env", "changed"),
    [
        (stacked(), r"action_history was changed to Box\(-1.0, 1.0, \(2, 3\)"),
        (stacked(delay=0), r"action_history was changed to .*\(0, 3\)"),
        (Renamed(delayed()), "got the keys .*battery"),
    ],
)
def test_wrappers_around_ours_are_told_their_place(env, changed):
    with pytest.raises(ValueError, match=f"{changed}.* go below DelayedObservationWrapper"):
        check_spaces(env.observation_space, env.action_space)


def test_what_is_advised_instead_of_a_stack_of_frames_helps():
    env = DelayedObservationWrapper(FlattenObservation(FrameStackObservation(Drift(), 3)), 2)
    assert check_spaces(env.observation_space, env.action_space).state.shape == (6,)
    normalized = VecNormalize(DummyVecEnv([delayed]), norm_obs_keys=["observation"])
    assert check_spaces(normalized.observation_space, normalized.action_space).max_delay == 2


def test_environments_of_one_batch_have_one_max_delay():
    def vec(*max_delays):
        return DummyVecEnv([partial(delayed, 1, max_delay=max_delay) for max_delay in max_delays])

    with pytest.raises(ValueError, match=r"\[2, 4, 2\]; give each of them .*max_delay=4\)"):
        check_one_max_delay(vec(2, 4, 2))
    for env in (vec(3, 3), delayed(2), Drift(), DummyVecEnv([Drift, Drift])):
        check_one_max_delay(env)


@pytest.mark.parametrize(("delay", "max_delay"), [(0, 0), (3, 3), ((1, 2), 2)])
@pytest.mark.parametrize("state_history", [False, True])
def test_a_delayed_task_tells_its_states_and_its_largest_delay(delay, max_delay, state_history):
    task = CountingTask(itertools.count(), max_length=3)
    env = DelayedObservationWrapper(task, delay, state_history=state_history)
    states = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
    assert check_spaces(env.observation_space, env.action_space) == (states, task.action_space, max_delay)
    assert has_state_history(env.observation_space) == state_history
    assert check_spaces(task.observation_space, task.action_space) == (states, task.action_space, 0)
    assert not has_state_history(task.observation_space)


@pytest.mark.parametrize(
    ("env", "ages"),
    [
        (None, [0]),
        (Drift(), [0]),
        (delayed(2), [2]),
        (delayed(1, max_delay=2), [1]),
        (delayed((0, 2)), [0, 1, 2]),
        (delayed(TotalDelay(1, 1)), [2]),
        (delayed(OwnDelay()), [0, 1, 2]),  # does not say its smallest
        (delayed(LateDelay()), [1, 2]),
        (LateSimulator(), [0, 1, 2]),  # does not say either
        (TellingSimulator(), [2]),
    ],
    ids=str,
)
def test_of_one_environment_and_of_several_alike(env, ages):
    assert ages_of(env) == ages
    if env is not None:
        assert ages_of(DummyVecEnv([lambda: env])) == ages


@pytest.mark.parametrize("first", [0, 1])
def test_each_of_several_environments_has_ages_of_its_own(first):
    envs = [lambda: delayed(0, max_delay=3), lambda: delayed((2, 3))]
    assert ages_of(DummyVecEnv([envs[first], envs[1 - first]])) == [0, 2, 3]


@pytest.mark.parametrize(("ages", "text"), [([3], "3"), ([2, 3], "2, 3"), ([0, 1, 2], "0..2"), ([0, 2, 3], "0, 2, 3")])
def test_written_ages(ages, text):
    assert written_ages(ages) == text
