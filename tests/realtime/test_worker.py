"""The loop's worker: what it is asked, when, and what becomes of answers that are slow, late, wrong or missing."""

import threading
import time

import numpy as np
import pytest
from recorder import Gated, Planning, Recorder
from small_task import Drift

from sb3_said.realtime import ControlLoop, NoAnswer

TASK = Drift()
ZEROS = np.zeros(2, np.float32)


class Plain(Gated):
    """Reads the state alone."""

    def __init__(self, task, max_delay):
        super().__init__(task, max_delay)
        self.observation_space = task.observation_space

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        none = np.zeros((1, 0, 1), np.float32)
        return super().predict({"observation": observation, "action_history": none, "delay": np.zeros((1, 1))})


class Answering(Recorder):
    """Answers with what it is told."""

    def __init__(self, answers, max_delay=4):
        super().__init__(TASK, max_delay)
        self.answers = answers

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return self.answers(observation), None


@pytest.mark.parametrize(("kind", "max_delay"), [(Plain, 0), (Gated, 0), (Gated, 1), (Gated, 3)])
def test_who_observes_and_acts_in_one_thread_is_answered_at_every_age(kind, max_delay):
    """As in a simulation whose answers take a step: an action sent before the worker wakes makes nothing too old."""

    def play(loop, model, gate):
        model.asked.clear()
        sent = []
        for t in range(50):
            gate.clear()
            loop.observe(ZEROS + t, n_executed=max(t - max_delay, 0))
            sent.append(loop.act(t))
            gate.set()
            loop.wait(60)
        return sent, model.asked[:50], loop.statistics()

    model = kind(TASK, max_delay)
    wanted, asked, _ = play(ControlLoop(model, 1, answer_steps=0, simulate=lambda seconds: 1), model, threading.Event())
    model = kind(TASK, max_delay)
    with ControlLoop(model, 1, answer_steps=0) as loop:
        sent, asked_here, found = play(loop, model, model.gate)
    np.testing.assert_array_equal(sent, wanted)
    assert len(asked_here) == len(asked) == 50
    for ours, theirs in zip(asked_here, asked, strict=True):
        for key in theirs:
            np.testing.assert_array_equal(ours[key], theirs[key])
    assert (found.waiting_steps, found.held_steps, found.safe_steps) == (1, 49, 0)


def test_a_slow_warm_up_is_forgotten_with_the_first_answer():
    class Waking(Recorder):
        def predict(self, *args, **kwargs):
            time.sleep(0.2 * (len(self.asked) < 2))  # both of the warm-up
            return super().predict(*args, **kwargs)

    with ControlLoop(Waking(TASK, 8), 0.02) as loop:
        assert loop.answer_steps >= 10
        loop.observe(ZEROS, n_executed=0)
        loop.wait(60)
        loop.act()
        loop.observe(ZEROS, n_executed=1)
        assert loop.wait(60) and loop.answer_steps == 0


def test_answers_while_the_robot_stands_tell_nothing_of_their_time():
    with ControlLoop(Recorder(TASK, 8), 1, answer_steps=None) as loop:
        loop.answer_steps = 3
        for k in range(30):
            loop.observe(ZEROS + k, n_executed=0)
            assert loop.wait(60)
        assert loop.statistics().answer_steps == {} and loop.answer_steps == 3
        loop.act()
        loop.observe(ZEROS, n_executed=1)
        assert loop.wait(60) and loop.statistics().answer_steps == {0: 1} and loop.answer_steps == 0


@pytest.mark.parametrize("threaded", [True, False])
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.float32([[np.nan]]), r"answers \[\[nan\]\].* and finite"),
        (np.float32([[np.inf]]), "and finite"),
        (np.zeros((1, 2), np.float32), r"shape \(1, 2\), expected \(K, 1\)"),
        (np.zeros(1, np.float32), r"shape \(1,\), expected"),
    ],
)
def test_what_is_no_action_is_never_sent(answer, message, threaded):
    model = Answering(lambda obs: answer if obs["observation"].any() else np.zeros((1, 1), np.float32))
    with ControlLoop(model, 1, simulate=None if threaded else lambda seconds: 0) as loop:
        loop.observe(ZEROS + 1, n_executed=0)
        with pytest.raises((RuntimeError, ValueError), match=message):
            loop.wait(60)
            loop.act(0)
        assert loop.n_sent == 0


def test_actions_beyond_the_bounds_are_clipped_to_them():
    model = Answering(lambda obs: 1e300 * np.ones((1, 1)))
    loop = ControlLoop(model, 1, simulate=lambda seconds: 0)
    loop.observe(ZEROS, n_executed=0)
    assert TASK.action_space.contains(action := loop.act(0)) and action == TASK.action_space.high


def test_a_model_that_hangs_does_not_hang_the_program():
    model = Gated(TASK, 4)
    with ControlLoop(model, 1) as loop:
        model.gate.clear()
        model.is_computing.clear()
        loop.observe(ZEROS, n_executed=0)
        assert model.is_computing.wait(60)
        began = time.monotonic()
        loop.close(timeout=0.05)
        assert time.monotonic() - began < 5
        assert loop._worker.is_alive() and loop._worker.daemon
        model.gate.set()
    assert not loop._worker.is_alive()


def test_who_waits_hears_of_a_reset_from_another_thread():
    loop = ControlLoop(Recorder(TASK, 4), 1)
    loop.close()
    loop._is_closing = False  # a worker that has not woken yet
    loop.observe(ZEROS, n_executed=0)
    waiting = threading.Thread(target=loop.wait, args=(60,))
    waiting.start()
    time.sleep(0.05)
    loop.reset()
    waiting.join(30)
    assert not waiting.is_alive()


def test_waiting_ends_while_observations_keep_coming():
    """The worker is never idle. The robot stands, so the last answer is for the first action."""

    class Slow(Planning):
        def predict_plan(self, *args, **kwargs):
            time.sleep(0.01)
            return super().predict_plan(*args, **kwargs)

    model, stop = Slow(TASK, 4), threading.Event()
    with ControlLoop(model, 1, answer_steps=2) as loop:

        def sense():
            k = 0
            while not stop.is_set():
                loop.observe(ZEROS + (k := k + 1), n_executed=0)
                time.sleep(1e-4)

        sensor = threading.Thread(target=sense)
        sensor.start()
        try:
            for _ in range(3):
                loop.reset()
                time.sleep(0.02)
                assert loop.wait(60)
                loop.act()
        finally:
            stop.set()
            sensor.join()
        assert loop.statistics().waiting_steps == 0


def test_waiting_takes_no_longer_than_it_may():
    model = Gated(TASK, 4)
    with ControlLoop(model, 1, answer_steps=2) as loop:

        def slowly(*args, **kwargs):  # once, and then never
            if model.asked:
                model.gate.clear()
            time.sleep(0.1)
            return plain(*args, **kwargs)

        def recorded(predicate, timeout=None):
            if timeout is not None:
                given.append(timeout)
            return wait_for(predicate, timeout)

        model.asked.clear()
        plain, model.predict = model.predict, slowly
        given, wait_for, loop._changed.wait_for = [], loop._changed.wait_for, recorded
        loop.observe(ZEROS, n_executed=0)
        assert not loop.wait(0.5)  # one answer on the move, and one for a robot that stands
        assert given[0] <= 0.5 and given[-1] <= 0.5 - 0.1 * (len(given) - 1)
        model.gate.set()


def test_without_observation_nothing_is_asked_and_it_gives_up():
    model = Recorder(TASK, 4)
    with ControlLoop(model, 1, hold_steps=0, safe_steps=2) as loop:
        model.asked.clear()
        for t in range(2):
            loop.act(t)
        with pytest.raises(NoAnswer):
            loop.act(2)
        assert model.asked == []
