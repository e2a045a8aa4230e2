"""Delays written as text."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hypothesis import given, settings
from random_processes import processes

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    HeldDelay,
    RandomWalkDelay,
    TotalDelay,
    UniformDelay,
)
from sb3_said.delays.processes import packet_delays
from sb3_said.delays.text import age_range, make_process, parse_process


@settings(deadline=None)
@given(processes())
def test_what_a_process_prints_reads_back(process):
    assert parse_process(repr(process)) == process


@pytest.mark.parametrize("number", [np.float64, np.float32])
def test_numbers_of_numpy_are_python_s(number):
    p = number(0.25)
    for process in (DroppedPackets(4, p), HeldDelay(4, hold_prob=p), RandomWalkDelay(0, 4, move_prob=p)):
        assert parse_process(repr(process)) == process
    env = DelayedObservationWrapper(gym.make("Pendulum-v1"), DroppedPackets(4, p))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space


def test_processes_of_processes():
    assert parse_process(" DroppedPackets(UniformDelay(0, high=8), p=1e-1) ") == DroppedPackets(
        UniformDelay(0, 8), p=0.1
    )
    held = parse_process("HeldDelay(TotalDelay(WIFI_20MS, (0, 2)), hold_prob=0.5)")
    assert held == HeldDelay(TotalDelay(WIFI_20MS, (0, 2)), hold_prob=0.5)
    assert make_process("DroppedPackets([0, 4], p=0.1)") == DroppedPackets(EpisodeDelay(0, 4), p=0.1)
    assert DroppedPackets(4, p=0.1) == DroppedPackets(
        FixedDelay(4), p=0.1
    )  # a number is the process that it stands for
    assert hash(DroppedPackets([0, 4], p=0.1)) == hash(DroppedPackets((0, 4), p=0.1))  # YAML has no tuples


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no delay"),
        ("UniformDelay(0,", "is no delay"),
        ("UniformDelay()", "missing 2 required positional arguments"),
        ("UniformDelay(0, 8, speed=2)", "unexpected keyword argument 'speed'"),
        ("UniformDelay(8, 0)", "0 <= low <= high"),
        ("DroppedPackets(4, p=True)", "'True' is no delay"),
        ("wifi", "expected numbers, WIFI_20MS, FixedDelay"),
        ("__import__('os').getcwd()", "is no delay"),
        ("UniformDelay(0, ().__class__)", "is no delay"),
        ("UniformDelay(*(0, 8))", "is no delay"),
        ("UniformDelay(**{'low': 0, 'high': 8})", "is no delay"),
        ("[x for x in (1, 2)]", "is no delay"),
        ("'4'", "is no delay"),
        ("FixedDelay(delay=4, delay=5)", "delay is given twice"),
        ("1000000000", "at most 10000 control steps, got 1000000000"),
        ("(0, 1000000000)", "at most 10000 control steps, got 1000000000"),
        ("PeriodicPackets(4, 1000000000)", "at most 10000 control steps"),
        ("DroppedPackets(4, p=0.1, max_losses=1000000000)", "at most 10000 control steps"),
        ("TotalDelay(6000, 6000)", "at most 10000 control steps, got 12000"),
        ("HeldDelay(4, update_period=1" + "0" * 30 + ")", "update_period is at most 1000000000"),
        ("-" * 100_000 + "4", "is no delay"),
        ("(" * 5_000 + "4" + ")" * 5_000, "is no delay"),
        ("HeldDelay(" * 5_000 + "4" + ")" * 5_000, "is no delay"),
        ("9" * 100_000, "is no delay"),
    ],
)
def test_anything_else_is_refused_and_not_run(text, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as caught:
        make_process(text)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "outer", ["HeldDelay({})", "DroppedPackets({}, p=0.1)", "PeriodicPackets({}, 2)", "TotalDelay({}, 1)"]
)
def test_nested_processes_take_no_longer_than_their_text(outer):
    text = "4"
    for _ in range(60):  # twice the time for each would be years
        text = outer.format(text)
    low, high = age_range(text)
    assert 4 <= low <= high < 4 + 60 * 4 + 1
    assert hash(make_process(text)) == hash(make_process(repr(make_process(text))))
    assert next(packet_delays(make_process(text), np.random.default_rng(0))) in (None, *range(high + 1))


def test_the_wrapper_takes_text():
    env = DelayedObservationWrapper(gym.make("Pendulum-v1"), "DroppedPackets(2, p=0.1)", "1")
    assert env.process == TotalDelay(DroppedPackets(2, p=0.1), FixedDelay(1))
    assert env.observation_space["action_history"].shape == (7, 1)
