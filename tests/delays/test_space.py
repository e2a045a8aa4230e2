"""Which spaces are served, what is read off them, and why others are refused."""

import itertools

import numpy as np
import pytest
from counting_task import OBS_DIM, CountingTask
from gymnasium import spaces
from small_task import Drift, LateDelay, OwnDelay, delayed
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said.delays import DelayedObservationWrapper, TotalDelay
from sb3_said.delays.space import ages_of, check_spaces, delayed_space, has_state_history, written_ages


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
        (spaces.Box(-1, 1, (3,)), spaces.Discrete(2), "1-D Box action with finite bounds"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, np.inf, (2,)), "1-D Box action with finite bounds"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2, 2)), "1-D Box action with finite bounds"),
        (spaces.Box(-1, 1, (0,)), spaces.Box(-1, 1, (2,)), "The observation has no entries"),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (0,)), "The action has no entries"),
        (with_parts(action_history=spaces.Box(-1, 1, (5, 1))), spaces.Box(-1, 1, (2,)), r"have the shapes .*\(5, 1\)"),
        (with_parts(action_history=spaces.Box(-1, 1, (10**9, 0))), spaces.Box(-1, 1, (2,)), "expected"),
        (with_parts(delay=spaces.Box(0, 5, (2,))), spaces.Box(-1, 1, (2,)), r"have the shapes .*\(2,\)"),
    ],
)
def test_other_spaces_are_refused_with_a_reason(observation_space, action_space, reason):
    with pytest.raises(ValueError, match=reason) as refused:
        check_spaces(observation_space, action_space)
    assert "RescaleAction" not in str(refused.value)  # which needs finite bounds itself


@pytest.mark.parametrize(("delay", "max_delay"), [(0, 0), (3, 3), ((1, 2), 2)])
@pytest.mark.parametrize("state_history", [False, True])
def test_a_delayed_task_tells_its_states_and_its_largest_delay(delay, max_delay, state_history):
    task = CountingTask(itertools.count(), max_length=3)
    env = DelayedObservationWrapper(task, delay, state_history=state_history)
    states = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
    assert check_spaces(env.observation_space, env.action_space) == (states, max_delay)
    assert has_state_history(env.observation_space) == state_history
    assert check_spaces(task.observation_space, task.action_space) == (states, 0)
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
