"""Delays of actions: which action each step executes, and what the observations then show."""

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logged_task import LoggedTask, delay_of_episode
from random_processes import processes

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    FixedDelay,
    HeldDelay,
    TotalDelay,
    UniformDelay,
    scale_action,
)
from sb3_said.delays.receivers import RECEIVERS


class Robot:
    """A task as it is: actions queue up on their way to it, observations on their way back."""

    def __init__(self, name, n_there, n_back, seed):
        self.env = gym.make(name, terminate_when_unhealthy=False)
        self.state = self.env.reset(seed=seed)[0]
        self.there = deque([None] * n_there)
        self.back = deque([self.state] * n_back)

    def step(self, action):
        """One control step: the newest action sets off, the oldest on its way is executed."""
        self.there.append(action)
        executed = self.there.popleft()
        if executed is not None:  # the task starts when the first action arrives
            self.state = self.env.step(executed)[0]
        self.back.append(self.state)
        return self.back.popleft()


@pytest.mark.parametrize(("d", "k"), [(0, 3), (3, 0), (2, 4), (4, 2)])
def test_d_observation_steps_and_k_action_steps_are_d_plus_k_observation_steps(d, k):
    def policy(observation, t):  # in closed loop, so that a difference would grow
        return np.clip(np.sin(5 * observation[-3:] + t), -1, 1).astype(np.float32)

    robot = Robot("Hopper-v5", k, d, seed=1)
    delays: list[Any] = [(d, k), (d + k,), (FixedDelay(d), (k, k))]
    tasks = [gym.make("Hopper-v5", terminate_when_unhealthy=False) for _ in delays]
    wrappers = [DelayedObservationWrapper(task, *delay) for task, delay in zip(tasks, delays, strict=True)]
    observations = [env.reset(seed=1)[0] for env in wrappers]
    observation = np.asarray(robot.state, np.float32)
    for t in range(15):
        for obs in observations:
            np.testing.assert_array_equal(obs["observation"], observation)
            np.testing.assert_array_equal(obs["action_history"], observations[0]["action_history"])
            assert obs["delay"].item() == min(t, d + k) and obs["action_history"].shape == (d + k, 3)
        action = policy(observation, t)
        observation = np.asarray(robot.step(action), np.float32)
        observations = [env.step(action)[0] for env in wrappers]


def test_action_delays_are_drawn_anew_each_episode():
    env = DelayedObservationWrapper(LoggedTask(), 2, (0, 5))
    env.reset(seed=0)
    drawn = []
    for _ in range(60):
        env.reset()
        drawn.append(delay_of_episode(env.receiver))
    assert set(drawn) == set(range(2, 8)) and env.max_delay == 7


@settings(deadline=None)
@given(
    processes(),
    processes().filter(lambda p: TotalDelay(0, p).action_varies),
    st.sampled_from(sorted(RECEIVERS)),
    st.integers(0, 2),
    st.integers(0, 2**16),
)
def test_actions_that_take_a_time_each(observation, action, receiver, spare, seed):
    task = LoggedTask(length=25)
    process = TotalDelay(observation, action)
    max_delay = process.max_delay + spare
    env = DelayedObservationWrapper(task, observation, action, max_delay=max_delay, receiver=receiver)
    twin = DelayedObservationWrapper(LoggedTask(length=25), process, max_delay=max_delay, receiver=receiver)
    there, back = RECEIVERS[receiver](action), RECEIVERS[receiver](observation)  # themselves tested against arrivals
    env.action_space.seed(seed)
    for episode in range(2):
        obs, info = env.reset(seed=seed + episode)
        twin.reset(seed=seed + episode)
        rng = np.random.default_rng([seed + episode, 1])
        there.reset(rng.spawn(1)[0])
        back.reset(rng)
        sent, scaled, arrived_as = [], [], []  # arrived_as: which of those sent each step executed
        for t in range(1, task.length + 1):
            sent.append(env.action_space.sample())
            scaled.append(scale_action(sent[-1], env.action_space))
            arrived_as.append(t - 1 - (there.step() if t > 1 else 0))
            obs, *_, info = env.step(sent[-1])
            for key, value in twin.step(sent[-1])[0].items():
                np.testing.assert_array_equal(value, obs[key])  # one process says the same as two
            np.testing.assert_array_equal(task.actions[-1][-1], sent[arrived_as[-1]])
            np.testing.assert_allclose(scaled[arrived_as[-1]], info["executed_action"])
            shown = t - back.step()
            np.testing.assert_array_equal(obs["observation"], task.states[-1][shown])
            newest = max(arrived_as[:shown], default=-1)  # that shows in the observation
            assert obs["delay"].item() == t - 1 - newest <= process.max_delay
            n_sent = min(t, max_delay)
            newest_sent = np.reshape(scaled[t - n_sent :], (n_sent, 2))
            np.testing.assert_allclose(obs["action_history"][max_delay - n_sent :], newest_sent)
            assert not obs["action_history"][: max_delay - n_sent].any()
            assert info["forced_deliveries"] == there.forced_deliveries + back.forced_deliveries
            np.testing.assert_array_equal(info["undelayed_observation"], task.states[-1][-1])
            assert env.observation_space.contains(obs)


def test_what_was_sent_is_no_history_where_every_action_takes_a_time_of_its_own():
    """An action that is held or overtaken is no step of the task between two states that are handed out."""
    with pytest.raises(ValueError, match="actions sent between two states are not those executed"):
        DelayedObservationWrapper(LoggedTask(), 2, WIFI_20MS, state_history=True)
    DelayedObservationWrapper(LoggedTask(), 2, (0, 3), state_history=True).reset(seed=0)


class Telling(LoggedTask):
    """A task whose ``info`` has names of the wrapper's."""

    def step(self, action):
        state, reward, terminated, truncated, info = super().step(action)
        return state, reward, terminated, truncated, {**info, "executed_action": 7, "undelayed_observation": 8}


def test_the_tasks_own_info_is_not_taken_for_the_wrappers():
    for action_delay in (0, 2, WIFI_20MS):
        env, twin = (DelayedObservationWrapper(task(), 1, action_delay) for task in (Telling, LoggedTask))
        env.reset(seed=0), twin.reset(seed=0)
        for _ in range(5):
            action = np.array([0.1, 0.2])
            info, expected = env.step(action)[-1], twin.step(action)[-1]
            assert info.keys() == expected.keys()
            for key, value in expected.items():
                np.testing.assert_array_equal(info[key], value)


def test_equal_delays_of_every_action_become_one_delay():
    robot = LoggedTask(length=40)
    env = DelayedObservationWrapper(robot, 2, UniformDelay(3, 3))
    env.action_space.seed(0)
    env.reset(seed=0)
    sent = [env.action_space.sample() for _ in range(30)]
    delays = [env.step(action)[0]["delay"].item() for action in sent]
    # a_0 is there from the start and is held until a_1 arrives, so that s_3 at t = 5 still shows no other
    assert delays == [1, 2, 2, 3, 4, *[5] * 25]
    np.testing.assert_array_equal(robot.actions[-1], [sent[max(t - 3, 0)] for t in range(30)])


def test_one_delay_for_each_action_is_refused_inside_another_process():
    with pytest.raises(ValueError, match=r"draws a delay for every action, .* not inside another process"):
        DelayedObservationWrapper(LoggedTask(), HeldDelay(TotalDelay(2, WIFI_20MS)))
    with pytest.raises(ValueError, match=r"draws a delay for every action, .* not inside another process"):
        DelayedObservationWrapper(LoggedTask(), TotalDelay(2, WIFI_20MS), action_delay=1)
    with pytest.raises(ValueError, match="delay"):
        DelayedObservationWrapper(LoggedTask(), 2, -1)
