"""In real time, beside a robot in another process, and with the model in one; what is asserted holds under any load."""

from __future__ import annotations

import multiprocessing
import threading
import time
from functools import partial

import numpy as np
import pytest
from recorder import Planning, assert_honest
from robot import PERIOD, Sum, fail, live, make_task

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
        sent, times, began = [], [], time.monotonic()
        for now in ticks(PERIOD):
            times.append(now)
            sent.append(loop.act(now))
            ours.send((loop.n_sent, sent[-1]))
            if loop.n_sent == N_STEPS:
                break
        ours.send(None)
        listener.join(60)
    robot.join(60)
    found = loop.statistics()
    record_property("jitter", str(found))
    print(f"\n{found}\nobservations arrived after {1e3 * np.median(late):.0f} ms (median)")

    assert not listener.is_alive() and robot.exitcode == 0
    assert found.steps == N_STEPS and len(requests) >= 3 and max(executed) > 0
    assert min(late) >= LATENCY
    assert_honest(requests, np.array(sent) / 3, lambda observation: received[tuple(observation)], found)  # actions to 3
    assert found.answer_steps.total() == len(requests)
    # No burst makes up for ticks that the machine missed: so many steps take at least so long.
    assert times[-1] - began >= (N_STEPS - 1) * PERIOD


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


def test_a_model_that_cannot_be_loaded_says_why():
    with pytest.raises(RuntimeError, match="FileNotFoundError: no such agent"):
        ModelProcess(fail)
