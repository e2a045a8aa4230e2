"""The loop counts as the wrapper does: the same observations and actions bit for bit, whatever happens to packets."""

from __future__ import annotations

from collections import defaultdict

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_processes import processes
from recorder import Planning, Recorder, assert_same, plan_of
from small_agent import answer, make
from small_task import Drift

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    DroppedPackets,
    FixedDelay,
    PeriodicPackets,
    UniformDelay,
    estimate_delay,
    in_steps,
    unscale_action,
)
from sb3_said.delays.processes import packet_delays
from sb3_said.delays.wrapper import DELAY_STREAM
from sb3_said.realtime import ControlLoop

SEED = 3


def play_wrapper(task, process, n, max_delay, n_steps, decide):
    """Return the observations of the wrapper, and the actions of an agent that decides every n steps.

    :param n: steps that an answer takes, which to the wrapper is an action delay; until then the action is 0
    :param decide: maps an observation to a plan (K, act_dim), K >= n
    """
    env = DelayedObservationWrapper(task, process, n, max_delay=max_delay)
    observations, actions, plan = [env.reset(seed=SEED)[0]], [], []
    for t in range(n_steps):
        if t >= n and t % max(n, 1) == 0:
            plan = list(decide(observations[-1]))
        zero = unscale_action(np.zeros(env.action_space.shape), env.action_space)
        actions.append(zero if t < n else plan.pop(0))
        observations.append(env.step(actions[-1])[0])
    return observations, actions


def play_between_the_steps(latency: float, phase: float, period: float = 0.02, n_steps: int = 800):
    """Return the log of a robot that captures amid its steps, and the ages of a loop that it tells when that was.

    The robot is x' = 25 (u - x), with random u.

    :param latency: seconds from a capture to its arrival
    :param phase: seconds from an action to the capture after it
    """
    task = Drift()
    loop = ControlLoop(Recorder(task, 8), period, simulate=lambda seconds: 0)
    rng, state, newest, packets = np.random.default_rng(SEED), 0.0, 0.0, []
    observations, actions = [], []
    for t in period * np.arange(n_steps):
        while packets and packets[0][0] + latency <= t + 1e-9:
            captured, newest = packets.pop(0)
            loop.observe([newest, 0.0], captured)
        loop.act(t)
        action = rng.uniform(-1, 1)
        observations.append([newest])
        actions.append([action])
        at_capture, state = (action + (state - action) * np.exp(-25 * seconds) for seconds in (phase, period))
        packets.append((t + phase, at_capture))
    return observations, actions[:-1], loop.statistics().ages


def play_loop(task, process, loop, n_steps, by_number):
    """Return the actions of a loop whose observations travel as packets, which may overtake each other or get lost.

    :param by_number: let packets say how many actions were executed, else when they were captured
    """
    delays = packet_delays(process, np.random.default_rng([SEED, DELAY_STREAM]))
    arriving = defaultdict(list, {0: [0]})
    states, actions, newest = [task.reset(seed=SEED)[0]], [], 0
    loop.reset()
    for t in range(n_steps):
        if t > 0:
            delay = next(delays)
            if delay is not None:
                arriving[t + delay].append(t)
        packets = arriving.pop(t, [])
        if max([newest, *packets]) < t - process.max_delay:  # the wrapper delivers this one after all
            packets.append(t - process.max_delay)
        for packet in packets:
            loop.observe(states[packet], **_label(packet, by_number))
        newest = max([newest, *packets])
        actions.append(loop.act(t))
        states.append(task.step(actions[-1])[0])
    return actions


def _label(packet, by_number):
    return {"n_executed": packet} if by_number else {"capture_time": packet}


PROCESSES = [
    FixedDelay(0),
    FixedDelay(3),
    UniformDelay(0, 4),
    WIFI_20MS,
    DroppedPackets(UniformDelay(0, 3), p=0.4, max_losses=3),
    PeriodicPackets(1, period=4),
]


@pytest.mark.parametrize("by_number", [False, True])
@pytest.mark.parametrize("n", [0, 1, 3])
@pytest.mark.parametrize("process", PROCESSES, ids=str)
def test_loop_and_wrapper_side_by_side(process, n, by_number):
    """Answers that take n steps are to the wrapper actions that do; by stamps and by numbers of executed actions."""
    _compare("HalfCheetah-v5", process, n, by_number, n_steps=40)


@settings(deadline=None, max_examples=15)
@given(processes(), st.integers(0, 3), st.booleans())
def test_side_by_side_under_any_process(process, n, by_number):
    _compare("Pendulum-v1", process, n, by_number, n_steps=40)


def _compare(name, process, n, by_number, n_steps):
    max_delay = process.max_delay + n + 1
    task = gym.make(name)
    model = (Planning if n > 1 else Recorder)(task, max_delay)
    n_planned = 4 if n > 1 else 1
    observations, wanted = play_wrapper(
        gym.make(name), process, n, max_delay, n_steps, lambda obs: plan_of(obs, task.action_space, n_planned)
    )
    loop = ControlLoop(model, period=1, answer_steps=n, simulate=lambda seconds: n)
    model.asked.clear()  # the warm-up
    actions = play_loop(task, process, loop, n_steps, by_number)
    np.testing.assert_array_equal(actions, wanted)
    targets = range(n, n_steps + n, max(n, 1))
    assert len(model.asked) == len(targets)
    for target, asked in zip(targets, model.asked, strict=True):
        if target < n_steps:
            assert_same(asked, observations[target])


@pytest.mark.parametrize(
    ("latency", "phase"), [(0.036, 0.001), (0.036, 0.004), (0.036, 0.019), (0.012, 0.001), (0.012, 0.015)]
)
def test_stamps_tell_the_age_that_the_robots_log_has(latency, phase):
    """Which is what its agent was trained for: one too small costs far more than one too large."""
    observations, actions, ages = play_between_the_steps(latency, phase)
    found = estimate_delay([np.array(observations)], [np.array(actions)])
    assert set(ages) == {found.delay} == {in_steps(latency, 0.02)}


@pytest.fixture(scope="module")
def agent():
    return make().learn(30)


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_an_agent_in_the_loop_answers_as_behind_the_wrapper(agent, who):
    with agent.policy.answering(who):
        _, wanted = play_wrapper(Drift(length=1000), FixedDelay(1), 1, 2, 12, lambda obs: answer(agent, obs)[None])
        loop = ControlLoop(agent, period=1, answer_steps=1, simulate=lambda seconds: 1)
        np.testing.assert_array_equal(play_loop(Drift(length=1000), FixedDelay(1), loop, 12, False), wanted)


def test_the_plan_serves_between_answers(agent):
    """Two steps to an answer, so that every other action is the second of a plan."""
    _, wanted = play_wrapper(
        Drift(length=1000),
        FixedDelay(0),
        2,
        2,
        12,
        lambda obs: agent.predict_plan({key: value[None] for key, value in obs.items()}, deterministic=True)[0],
    )
    loop = ControlLoop(agent, period=1, answer_steps=2, simulate=lambda seconds: 2)
    np.testing.assert_array_equal(play_loop(Drift(length=1000), FixedDelay(0), loop, 12, False), wanted)
    assert loop.statistics().held_steps == 0


def test_another_action_shows(agent):
    """The comparison sees a difference in the last bit of one action."""
    task = gym.make("Pendulum-v1")
    model = Recorder(task, 2)
    loop = ControlLoop(model, period=1, answer_steps=0, simulate=lambda seconds: 0)
    wanted = play_loop(gym.make("Pendulum-v1"), FixedDelay(1), loop, 5, False)
    loop.act = lambda now, act=loop.act: np.nextafter(act(now), np.float32(9)) if now == 1 else act(now)
    assert not np.array_equal(play_loop(task, FixedDelay(1), loop, 5, False), wanted)
