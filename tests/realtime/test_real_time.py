"""In real time, beside a robot in another process, and with the model in one; what is asserted holds under any load."""

from __future__ import annotations

import multiprocessing
import threading
import time
from contextlib import ExitStack
from functools import partial

import numpy as np
import pytest
from recorder import Planning, assert_honest
from robot import PERIOD, Cold, Sum, fail, live, make_task

from sb3_said.realtime import ControlLoop, ModelProcess, ticks

N_STEPS, LATENCY = 75, 0.015


def test_a_loop_beside_a_robot_at_50_hz(record_property):
    """Observations take 15 to 30 ms, answers 30 ms. Every question to the model agrees with the robot's own books."""

    class Slow(Planning):
        def predict_plan(self, observation, deterministic=False):
            time.sleep(0.03)
            return super().predict_plan(observation)

    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    robot = multiprocessing.get_context("spawn").Process(target=live, args=(theirs, LATENCY), daemon=True)
    robot.start()
    model, received, late = Slow(make_task(), 12), {}, []
    executed = []

    def listen():
        while not isinstance(packet := ours.recv(), list):
            state, number, stamp = packet
            received[tuple(np.float32(state))] = number
            late.append(time.monotonic() - stamp)
            loop.observe(state, stamp, number)
        executed.extend(packet)

    with ControlLoop(model, PERIOD) as loop:
        model.asked.clear()
        requests, take = [], loop._take
        loop._take = lambda request, actions: (requests.append(request), take(request, actions))
        listener = threading.Thread(target=listen)
        assert ours.recv() == "ready"
        ours.send("go")
        listener.start()
        sent, times, bare, began = [], [], [], time.monotonic()

        def only_tick():
            bare.extend(time.monotonic() for _, _ in zip(range(N_STEPS), ticks(PERIOD), strict=False))

        beside = threading.Thread(target=only_tick)
        beside.start()
        for now in ticks(PERIOD):
            sent.append(loop.act(now))
            ours.send((loop.n_sent, sent[-1]))
            times.append(time.monotonic())
            if loop.n_sent == N_STEPS:
                break
        ours.send(None)
        listener.join(60)
        beside.join(60)
    robot.join(60)
    found = loop.statistics()
    gaps = [np.percentile(np.diff(each), (50, 95, 100)) / PERIOD for each in (times, bare)]
    jitter = "gaps in periods, p50/p95/max: {:.3f}/{:.3f}/{:.3f}, of the machine without a loop {:.3f}/{:.3f}/{:.3f}"
    jitter = f"{found}; {jitter.format(*gaps[0], *gaps[1])}"
    record_property("jitter", jitter)
    print(f"\n{jitter}\nobservations arrived after {1e3 * np.median(late):.0f} ms (median)")

    assert not listener.is_alive() and robot.exitcode == 0
    assert found.steps == N_STEPS and len(requests) >= 3 and max(executed) > 0
    assert min(late) >= LATENCY
    assert_honest(requests, np.array(sent) / 3, lambda observation: received[tuple(observation)], found)  # actions to 3
    assert found.answer_steps.total() == len(requests)
    # No burst makes up for ticks that the machine missed: so many steps take at least so long.
    assert times[-1] - began >= (N_STEPS - 1) * PERIOD
    # The period is held as well as this machine, loaded as it is, lets a thread hold it that does nothing else.
    assert gaps[0][0] <= gaps[1][0] + 0.25


def test_a_model_in_a_process_answers_as_here():
    observations = np.arange(8, dtype=np.float64).reshape(2, 4) / 10
    with ModelProcess(partial(Sum, 0.5)) as model:
        np.testing.assert_array_equal(model.predict(observations)[0], Sum(0.5).predict(observations)[0])
        assert model.predict_plan(observations).shape == (2, 1, 1) and model.warmup() is None
        with pytest.raises(RuntimeError, match="ValueError: nine is too much"):
            model.predict(observations + 9)
        with ControlLoop(model, 1, answer_steps=0) as loop:
            loop.observe(observations[0], n_executed=0)
            assert loop.wait(60)
            np.testing.assert_array_equal(loop.act(0), Sum(0.5).predict(observations[:1])[0][0])
        with pytest.raises(RuntimeError, match="ended with exit code 3"):
            model.predict(observations + 99)
        with pytest.raises(RuntimeError, match="has ended"):
            model.predict(observations)


@pytest.mark.parametrize("where", ["here", "in a process"])
def test_the_first_answer_is_not_what_later_ones_are_expected_to_take(where):
    with ExitStack() as stack:
        model = Cold(0.5) if where == "here" else stack.enter_context(ModelProcess(partial(Cold, 0.5)))
        loop = stack.enter_context(ControlLoop(model, 0.1))  # 10 steps a second
        loop.observe(np.zeros(4), n_executed=0)
        assert loop.wait(60) and loop.answer_steps < 5


def test_a_model_that_cannot_be_loaded_says_why():
    with pytest.raises(RuntimeError, match="FileNotFoundError: no such agent"):
        ModelProcess(fail)
