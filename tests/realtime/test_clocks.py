"""Stamps that cannot be: of another episode, of another clock, ahead of now."""

import math
import threading
import time
import warnings

import numpy as np
import pytest
from recorder import Recorder
from small_task import Drift

from sb3_said.realtime import ControlLoop

TASK = Drift()
ZEROS = np.zeros(2, np.float32)
FREE = {"simulate": lambda seconds: 0}


def asked_for(model):
    return [float(asked["observation"][0]) for asked in model.asked]


def test_a_packet_on_its_way_at_a_reset_does_not_open_the_new_episode():
    model = Recorder(TASK, 4)
    with ControlLoop(model, 0.02) as loop:
        captured = time.monotonic()
        loop.act()
        loop.reset()
        model.asked.clear()
        loop.observe(ZEROS + 1, captured)
        assert loop.wait(60) and model.asked == [] and loop.statistics().stale_observations == 1
        loop.observe(ZEROS + 2)
        assert loop.wait(60) and set(asked_for(model)) == {2}


def test_in_a_simulation_or_with_a_time_given_a_reset_knows_no_clock():
    loop = ControlLoop(Recorder(TASK, 4), 1, **FREE)
    loop.act(100)
    loop.reset()
    loop.observe(ZEROS, capture_time=3)
    assert loop.act(3) != 0
    with ControlLoop(Recorder(TASK, 4), 1) as loop:
        loop.reset(100.0)
        loop.observe(ZEROS, capture_time=99.0)
        assert loop.statistics().stale_observations == 1
        loop.observe(ZEROS, capture_time=100.0)
        assert loop.wait(60) and loop.act(100.5) != 0


def test_a_stamp_ahead_of_now_is_refused_and_said_once():
    model, period = Recorder(TASK, 4), 0.02
    with ControlLoop(model, period) as loop:
        loop.reset()
        loop.observe(ZEROS + 1)
        loop.wait(60)
        loop.act()
        with pytest.warns(UserWarning, match="another clock") as heard:
            for k in range(3):
                loop.observe(ZEROS + 9, time.monotonic() + 60 + k)
        assert len(heard) == 1 and loop.statistics().stale_observations == 3
        loop.observe(ZEROS + 2)  # the sensor is heard as before
        assert loop.wait(60) and 9 not in asked_for(model) and asked_for(model)[-1] == 2
        loop.observe(ZEROS + 3, time.monotonic() + period)  # clocks differ a little
        assert loop.wait(60) and asked_for(model)[-1] == 3


def test_what_is_captured_after_an_act_that_had_to_wait_is_heard():
    with ControlLoop(Recorder(TASK, 4), 0.01) as loop:
        held, slow = threading.Event(), 0.1  # ten periods

        def hold():
            with loop._changed:
                held.set()
                time.sleep(slow)

        other, began = threading.Thread(target=hold), time.monotonic()
        other.start()
        held.wait()
        loop.act()
        assert time.monotonic() - began >= slow
        loop.observe(ZEROS)
        other.join()
        assert loop.statistics().stale_observations == 0
        assert min(loop._ledger._effects) - began >= slow  # when it was sent, and not when it was asked for


def test_a_robot_that_stands_for_long_is_heard(monkeypatch):
    """Time goes on without ``act``, on whatever clock."""
    model = Recorder(TASK, 4)
    with ControlLoop(model, 0.02) as loop:
        loop.reset(1000.0)
        clock = time.monotonic
        monkeypatch.setattr(time, "monotonic", lambda: clock() + 30)
        loop.observe(ZEROS + 1, 1029.9)
        assert loop.wait(60) and asked_for(model)[-1] == 1


def test_stamps_far_behind_are_said_once():
    with ControlLoop(Recorder(TASK, 4), 0.02) as loop:
        loop.act()
        with pytest.warns(UserWarning, match="another clock") as heard:
            for k in range(3):
                loop.observe(ZEROS + k, 0.01 * k)  # of a computer that has just started
        assert len(heard) == 1


def test_usual_delays_are_not_worth_a_word():
    with warnings.catch_warnings(), ControlLoop(Recorder(TASK, 4), 0.02) as loop:
        warnings.simplefilter("error")
        for reset in (False, True):
            if reset:
                loop.reset()
            for late in (0.0, 0.05, 0.5, 0.1):
                loop.observe(ZEROS + late, time.monotonic() - late)
                loop.act()


def test_the_first_action_tells_of_stamps_of_another_clock():
    for kwargs in ({}, FREE):
        with ControlLoop(Recorder(TASK, 4), 0.02, **kwargs) as loop:
            loop.observe(ZEROS, time.monotonic() + 10)
            with pytest.raises(ValueError, match="one clock"):
                loop.act()


def test_an_action_whose_tick_is_a_little_older_than_the_observation_is_sent():
    """Such as the first, of who waits for the first answer after the tick."""
    with ControlLoop(Recorder(TASK, 4), 0.02) as loop:
        now = time.monotonic()
        loop.observe(ZEROS, now + 0.5)
        assert loop.wait(60) and loop.act(now) != 0
        loop.observe(ZEROS + 1, now + 0.01)
        assert loop.statistics().stale_observations == 0


def test_a_clock_that_goes_back_costs_no_observation_and_no_memory():
    model = Recorder(TASK, 4)
    with ControlLoop(model, 0.02) as loop:
        for k in range(50):
            now = 1000.0 - 10 * k
            loop.observe(ZEROS + k, now - 0.005)  # refused until act tells that the clock went back, but for the first
            loop.act(now)
            loop.observe(ZEROS + k, now + 0.001)
            assert loop.wait(60) and asked_for(model)[-1] == k
    assert loop.statistics().gaps == {0.0: 49}


def test_a_simulated_clock_that_goes_back_is_followed_too():
    model = Recorder(TASK, 4)
    loop = ControlLoop(model, 0.02, **FREE)
    for k, now in enumerate([100.0, 100.02, 90.04, 90.06, 80.0]):  # a log of a robot, played again
        loop.observe(ZEROS + k, now)
        loop.act(now)
        loop.observe(ZEROS + k + 0.5, now + 0.001)
    loop.act(80.02)
    assert asked_for(model)[-1] == 4.5


def test_a_clock_that_goes_back_leaves_the_age_as_it_is():
    """Also where actions take effect later than observations are captured."""
    loop, ages = ControlLoop(Recorder(TASK, 8), 0.02, action_delay=0.025, answer_steps=0, **FREE), []
    now = 1000.0
    for k in range(30):
        now -= 10.0 * (k == 15)
        loop.observe(ZEROS + k, now - 0.001)
        loop.act(now)
        ages.append(loop._ledger.age)
        now += 0.02
    assert set(ages[5:15]) == set(ages[17:]) == {2}
    assert max(ages) == 3  # of the step in which it went back, whose observation is refused


@pytest.mark.parametrize("now", [math.nan, math.inf])
def test_what_is_no_time_is_refused_before_it_counts(now):
    loop = ControlLoop(Recorder(TASK, 4), 1, **FREE)
    loop.act(0)
    with pytest.raises(ValueError, match=f"now is {now}"):
        loop.act(now)
    assert loop.n_sent == loop.statistics().steps == 1
    with pytest.raises(ValueError, match=f"now is {now}"):
        loop.reset(now)
    assert loop.n_sent == 1
