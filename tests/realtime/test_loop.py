"""The loop's threads: who waits for whom, what becomes of answers, and what is counted."""

import threading
import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces
from recorder import Gated, Planning, Recorder, assert_honest, plan_of
from small_agent import make
from small_task import Drift, delayed

from sb3_said.delays import UniformDelay
from sb3_said.evaluation import rollout
from sb3_said.realtime import ControlLoop, LoopedModel, LoopStatistics, NoAnswer, ticks

TASK = Drift()
ZEROS = np.zeros(2, np.float32)


class Sees(Planning):
    """Plans the number that it sees."""

    def predict_plan(self, observation, deterministic=False):
        return np.tile(observation["observation"][:, None, :1], (1, 4, 1))


def in_steps(model, n=0, **kwargs):
    """Return a loop that counts steps, whose answers take n."""
    loop = ControlLoop(model, 1, simulate=lambda seconds: n, **{"answer_steps": n, **kwargs})
    model.asked.clear()
    return loop


def test_act_does_not_wait_for_the_model():
    model = Gated(TASK, 4)
    with ControlLoop(model, 1, answer_steps=0) as loop:
        model.gate.clear()
        model.is_computing.clear()
        loop.observe(ZEROS, n_executed=0)
        assert model.is_computing.wait(60)
        np.testing.assert_array_equal([loop.act(t) for t in range(3)], np.zeros((3, 1)))  # and the model still computes
        assert not loop.wait(0)
        model.gate.set()
        assert loop.wait(60)
        found = loop.statistics()
        assert (found.waiting_steps, found.late_answers) == (3, 1)
        assert found.answer_steps == {3: 1, 0: 1}  # then it was asked again, since nothing else was heard
        assert [int(asked["delay"][0]) for asked in model.asked[-2:]] == [0, 3]
        np.testing.assert_array_equal(loop.act(3), plan_of(model.asked[-1], TASK.action_space, 1)[0])


def test_an_answer_of_another_episode_is_dropped():
    model = Gated(TASK, 4)
    with ControlLoop(model, 1) as loop:
        model.gate.clear()
        model.is_computing.clear()
        loop.observe(ZEROS + 5, n_executed=0)
        assert model.is_computing.wait(60)
        loop.reset()
        model.gate.set()
        assert loop.wait(60)
        assert loop.act(0) == 0 and loop.statistics().answer_steps == {} and loop.n_sent == 1


def test_an_observation_that_comes_while_the_model_computes_is_answered_next():
    model = Gated(TASK, 4)
    with ControlLoop(model, 1, answer_steps=0) as loop:
        model.asked.clear()
        model.gate.clear()
        model.is_computing.clear()
        loop.observe(ZEROS, n_executed=0)
        assert model.is_computing.wait(60)
        for k in (1, 2, 3):
            loop.observe(ZEROS + k, n_executed=0)
        model.gate.set()
        assert loop.wait(60)
        assert [asked["observation"][0] for asked in model.asked] == [0, 3]  # those between are out of date


def test_where_no_observation_comes_the_last_is_asked_about_again_a_step_older():
    model = Recorder(TASK, 2)
    with ControlLoop(model, 1, answer_steps=0) as loop:
        model.asked.clear()
        loop.observe(ZEROS, capture_time=0)
        for t in range(5):
            loop.wait(60)
            loop.act(t)
        assert loop.wait(60)
    assert [int(asked["delay"][0]) for asked in model.asked] == [0, 1, 2]  # 3 is too old


@pytest.mark.parametrize("every", [1, 2, 3])
@pytest.mark.parametrize("simulate", [None, lambda seconds: 0])
def test_a_slow_sensor_makes_no_step_go_without_an_answer(every, simulate):
    """Of a model of one action: the step after an observation is asked for, too."""
    with ControlLoop(Recorder(TASK, 8), 1, answer_steps=0, simulate=simulate) as loop:
        loop.reset(now=-1)
        for t in range(12):
            if t % every == 0:
                loop.observe(ZEROS + t, n_executed=t)
            loop.wait(60)
            loop.act(t)
        assert loop.statistics().held_steps == 0


def test_an_answer_that_waits_for_an_observation_is_not_asked_for_twice():
    """A plan goes on where the next observation may come any moment, for which the model is to be idle."""
    model = Planning(TASK, 4)
    with ControlLoop(model, 1, answer_steps=0) as loop:
        model.asked.clear()
        loop.observe(ZEROS, n_executed=0)
        loop.wait(60)
        loop.act(0)
        assert loop.wait(60) and len(model.asked) == 1


@pytest.mark.parametrize("simulate", [None, lambda seconds: 3])
def test_a_robot_that_was_moved_before_it_starts_begins_with_what_it_saw_last(simulate):
    with ControlLoop(Sees(TASK, 4), 1, answer_steps=3, simulate=simulate) as loop:
        loop.reset()
        for seen in (1.0, 2.0):
            loop.observe(ZEROS + seen, n_executed=0)
            assert loop.wait(60)
        assert [float(loop.act(t)[0]) for t in range(6)] == [2.0] * 6


@pytest.mark.parametrize("simulate", [None, lambda seconds: 0])
def test_what_normalises_in_place_is_given_the_observation_itself_each_time(simulate):
    def normalize(observation):
        observation["observation"] -= 5.0
        return observation

    model = Recorder(TASK, 4)
    with ControlLoop(model, 1, answer_steps=0, normalize=normalize, simulate=simulate) as loop:
        model.asked.clear()
        loop.observe(ZEROS + 25, n_executed=0)
        for t in range(3):
            loop.wait(60)
            loop.act(t)
    assert {float(asked["observation"][0]) for asked in model.asked} == {20.0} and len(model.asked) >= 3


@pytest.mark.parametrize("safe", [-10, 300, 256, np.nan, [1, 2]])
def test_a_safe_action_that_whole_numbers_cannot_hold_is_refused(safe):
    task = SimpleNamespace(observation_space=TASK.observation_space, action_space=spaces.Box(0, 255, (1,), np.uint8))
    model = Recorder(task, 4)
    with pytest.raises(ValueError, match=r"safe_action is .* expected an action of"):
        ControlLoop(model, 1, safe_action=np.atleast_1d(np.array(safe)), simulate=lambda seconds: 0)
    with ControlLoop(model, 1, safe_action=[99.6], simulate=lambda seconds: 0) as loop:
        assert loop.safe_action.tolist() == [100] and loop.safe_action.dtype == np.uint8


def test_a_robot_that_stands_until_the_plan_is_there_begins_with_it():
    model = Planning(TASK, 4)
    with ControlLoop(model, 1, answer_steps=2) as loop:
        for _ in range(2):
            loop.reset()
            model.asked.clear()
            assert loop.wait(60) and model.asked == []  # nothing has been seen
            loop.observe(ZEROS, n_executed=0)
            assert loop.wait(60) and loop.wait(60)
            assert [int(asked["delay"][0]) for asked in model.asked] == [2, 0]  # on the move, and standing
            wanted = plan_of(model.asked[-1], TASK.action_space, 4)
            np.testing.assert_array_equal([loop.act(t) for t in range(2)], wanted[:2])
            assert loop.wait(60) and int(model.asked[-1]["delay"][0]) == 4
        assert loop.statistics().waiting_steps == 0


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_simulated_robot_that_waits_begins_with_the_plan_too(n):
    model = Planning(TASK, 4)
    loop = in_steps(model, n)
    for _ in range(2):
        loop.reset()
        loop.observe(ZEROS, n_executed=0)
        assert loop.wait()
        wanted = plan_of(model.asked[-1], TASK.action_space, 4)
        assert int(model.asked[-1]["delay"][0]) == 0
        np.testing.assert_array_equal(loop.act(), wanted[0])
        loop.observe(ZEROS + 1, n_executed=1)
        assert loop.wait() and float(model.asked[-1]["observation"][0]) == 1  # whatever the answer is due at
    assert loop.statistics().waiting_steps == 0
    loop.close()
    with pytest.raises(RuntimeError, match="The loop is closed"):
        loop.wait()


def test_threads_that_observe_act_and_answer_at_once_keep_the_books_right():
    """Whatever the interleaving: a model is told what has been and will be sent, and the age that follows from it."""

    class Tired(Planning):
        def predict(self, *args, **kwargs):
            time.sleep(next(naps))
            return super().predict(*args, **kwargs)

    naps = iter(np.random.default_rng(0).choice([0, 2e-4, 3e-3], 100_000))
    model, n_steps = Tired(TASK, 8), 400
    loop, stop, failures = ControlLoop(model, 1e-3), threading.Event(), []
    model.asked.clear()
    requests, n_counted, take = [], 0, loop._take

    def recorded(request, actions):
        nonlocal n_counted
        requests.append(request)
        n_counted += loop.n_sent > 0
        take(request, actions)

    loop._take = recorded

    def sense(seed):
        rng = np.random.default_rng(seed)
        while not stop.is_set():
            n = max(loop.n_sent - int(rng.integers(3)), 0)
            try:
                loop.observe(np.float32([n, seed]), n_executed=n)
            except Exception as error:
                failures.append(error)
            time.sleep(rng.choice([0, 1e-4, 2e-3]))

    threads = [threading.Thread(target=sense, args=(seed,)) for seed in range(2)]
    for thread in threads:
        thread.start()
    sent = []
    try:
        for _ in range(n_steps):
            sent.append(loop.act())
            time.sleep(5e-4)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        loop.close()
    assert failures == [] and len(requests) > 20 and loop.n_sent == n_steps
    found = loop.statistics()
    assert_honest(requests, np.array(sent) / 2, lambda observation: int(observation[0]), found)
    assert found.steps == n_steps and found.ages.total() > n_steps / 2 and found.answer_steps.total() == n_counted


def test_a_model_that_fails_is_heard_of_where_the_robot_is():
    class Failing(Recorder):
        def predict(self, observation, **kwargs):
            if observation["observation"][0, 0] > 0:
                raise ValueError("too hot")
            return super().predict(observation)

    with ControlLoop(Failing(TASK, 2), 1) as loop:
        loop.observe(ZEROS, n_executed=0)
        loop.wait(60)
        loop.act(0)
        loop.observe(ZEROS + 1, n_executed=1)
        with pytest.raises(RuntimeError, match="The model failed: too hot"):
            loop.wait(60)
        with pytest.raises(RuntimeError, match="too hot"):
            loop.act(1)
    with pytest.raises(RuntimeError, match="too hot"):
        ControlLoop(Failing(TASK, 2), 1, normalize=lambda obs: obs | {"observation": ZEROS[None] + 1})


def test_a_model_that_reads_normalised_observations_needs_their_scale():
    class Normalised(Recorder):
        reads_normalized = True

    with pytest.raises(ValueError, match=r"give normalize=venv\.normalize_obs"):
        ControlLoop(Normalised(TASK, 2), 1)
    ControlLoop(Normalised(TASK, 2), 1, normalize=lambda obs: obs).close()


def test_a_closed_loop_says_so_and_leaves_no_thread():
    loop = ControlLoop(Recorder(TASK, 2), 1)
    loop.close()
    loop.close()
    assert not loop._worker.is_alive()
    with pytest.raises(RuntimeError, match="closed"):
        loop.act(0)


def test_holding_the_safe_action_and_giving_up_are_counted():
    loop = in_steps(Recorder(TASK, 1), hold_steps=2, safe_steps=2, safe_action=[-1.0])
    loop.observe(ZEROS, n_executed=0)
    sent = [float(loop.act(t)[0]) for t in range(2)]  # of ages 0 and 1
    assert sent[0] != sent[1]
    assert [float(loop.act(t)[0]) for t in range(2, 6)] == [sent[1], sent[1], -1, -1]
    with pytest.raises(NoAnswer, match=r"No action was planned for 5 steps.*held 2, safe 2"):
        loop.act(6)
    assert loop.n_sent == 6
    loop.observe(ZEROS, n_executed=6)  # the sensor is back
    assert loop.act(7) not in (-1, sent[1])


@pytest.mark.parametrize(("n", "expected"), [(0, 0), (1, 1), (2, 2)])
def test_it_expects_what_answers_took(n, expected):
    """So that each is planned for the step at which it arrives: none is late, and no step without a plan."""
    loop = in_steps(Planning(TASK, 4), n, answer_steps=None)
    for t in range(30):
        loop.observe(ZEROS, n_executed=t)
        loop.act(t)
    found = loop.statistics()
    assert loop.answer_steps == expected and set(found.answer_steps) == {n}
    assert found.waiting_steps == n and found.late_answers == found.held_steps == 0


@pytest.mark.parametrize(("n_slow", "expected"), [(4, 1), (6, 3)])
def test_it_expects_what_19_of_the_last_20_answers_took(n_slow, expected):
    model, took = Planning(TASK, 8), iter([3] * 100 + [1] * (100 - n_slow) + [3] * n_slow)
    loop = ControlLoop(model, 1, simulate=lambda seconds: next(took, 1))
    for t in range(300 + 100 + 2 * n_slow):
        loop.observe(ZEROS, n_executed=t)
        loop.act(t)
    assert loop.answer_steps == expected


def test_an_overrun_is_an_action_more_than_half_a_period_late():
    found = LoopStatistics()
    for gap in (0.5, 1.0, 1.49, 1.5, 1.51, 7.0):
        found.count_gap(gap)
    assert found.overruns == 2


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_model_is_asked_for_the_draws_that_the_loop_was_told(deterministic):
    class Noting(Planning):
        def predict_plan(self, observation, deterministic=False):
            noted.append(deterministic)
            return super().predict_plan(observation)

    noted = []
    loop = in_steps(Noting(TASK, 4), deterministic=deterministic)
    loop.observe(ZEROS, n_executed=0)
    loop.act(0)
    assert set(noted) == {deterministic}


@pytest.mark.parametrize("n", [0, 1, 2])
def test_it_recovers_from_a_sensor_that_was_silent_for_long(n):
    """While no action is sent, an answer is to begin with the one that is missing."""
    loop = in_steps(Planning(TASK, 4), n, hold_steps=1, safe_steps=1, max_age=1)
    heard = []
    for t in range(40):
        if t < 3 or t > 12:
            loop.observe(ZEROS + t, n_executed=loop.n_sent)
        try:
            loop.act(t)
            heard.append(True)
        except NoAnswer:
            heard.append(False)
    assert not any(heard[9:12]) and all(heard[13 + n :])


def test_it_recovers_beside_a_worker_too():
    with ControlLoop(Planning(TASK, 4), 1, answer_steps=1, hold_steps=1, safe_steps=1, max_age=1) as loop:
        loop.observe(ZEROS, n_executed=0)
        assert loop.wait(60)
        with pytest.raises(NoAnswer):
            for t in range(20):
                loop.act(t)
        n_sent = loop.n_sent
        loop.observe(ZEROS + 1, n_executed=n_sent)
        assert loop.wait(60)
        loop.act(20)
        assert loop.n_sent == n_sent + 1 and loop.answer_steps == 1


def test_an_answer_later_than_expected_is_spliced_by_what_was_consumed():
    model = Planning(TASK, 8)
    loop = in_steps(model, 2, answer_steps=1)
    sent = []
    for t in range(7):
        loop.observe(ZEROS + t, n_executed=t)
        sent.append(loop.act(t))
    plans = [model.predict_plan({key: value[None] for key, value in asked.items()})[0] for asked in model.asked[:3]]
    # Asked at 0, 2 and 4 for the actions from 1, 3 and 5 on; arrived at 2, 4 and 6
    np.testing.assert_array_equal(sent[2:], [plans[0][1], plans[0][2], plans[1][1], plans[1][2], plans[2][1]])
    assert loop.statistics().late_answers == 3
    assert [int(asked["delay"][0]) for asked in model.asked[:3]] == [1, 1, 1]


def test_a_loop_that_ignores_its_latency_sends_what_was_meant_for_an_earlier_state():
    model = Planning(TASK, 8)
    loop = in_steps(model, 2, count_latency=False, hold_steps=None)
    sent = []
    for t in range(6):
        loop.observe(ZEROS + t, n_executed=t)
        sent.append(loop.act(t))
    assert [int(asked["delay"][0]) for asked in model.asked] == [0, 0, 0]
    first = [model.predict_plan({key: value[None] for key, value in asked.items()})[0][0] for asked in model.asked[:2]]
    np.testing.assert_array_equal(sent[2:], [first[0], first[0], first[1], first[1]])
    assert loop.statistics().held_steps == 2


def test_statistics_are_a_dict_a_line_and_rows_of_a_logger():
    loop = in_steps(Recorder(TASK, 4))
    for t, now in enumerate([0, 1, 2, 4, 5]):
        if t != 3:
            loop.observe(ZEROS, capture_time=now)
        loop.observe(ZEROS, capture_time=0)
        loop.act(now)
    found = loop.statistics()
    numbers = found.to_dict()
    assert (numbers["steps"], numbers["overruns"], numbers["stale_observations"]) == (5, 1, 5)
    assert [numbers[f"age_{key}"] for key in ("p50", "p95", "p99", "max")] == [0, 1, 1, 1]
    assert (numbers["gap_p50"], numbers["gap_max"], numbers["answer_steps_max"]) == (1, 2, 0)
    line = str(found)
    assert "age 0/1/1/1" in line and "overruns 1" in line and "stale 5" in line and "\n" not in line
    loop.act(6)
    assert found.steps == 5  # a copy
    assert "age -/-/-/-" in str(in_steps(Recorder(TASK, 4)).statistics())


def test_a_sensor_that_is_frozen_for_long_and_any_gap_take_bounded_memory():
    loop = in_steps(Recorder(TASK, 4))
    loop.observe(ZEROS, n_executed=0)
    now = 0.0
    for t in range(5_000):
        now += 1 + t  # no two gaps alike
        loop.act(now)
    found = loop.statistics()
    assert found.steps == 5_000 and found.ages.total() == 5_000 and found.gaps.total() == 4_999
    assert found.ages == Counter({**dict.fromkeys(range(1_000), 1), 1_000: 4_000})
    assert len(found.gaps) <= 1_001 and found.to_dict()["gap_max"] == 1_000


def test_statistics_go_to_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from stable_baselines3.common.logger import configure

    loop = in_steps(Recorder(TASK, 4))
    loop.observe(ZEROS, n_executed=0)
    loop.act(0)
    logger = configure(str(tmp_path), ["tensorboard"])
    loop.statistics().record(logger)
    logger.dump(7)
    logger.close()
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    (event,) = events.Scalars("realtime/steps")
    assert (event.step, event.value) == (7, 1) and "realtime/age_p99" in events.Tags()["scalars"]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"period": 0}, "period is 0"),
        ({"max_age": 5}, r"max_age is 5, but the model reads ages 0..4"),
        ({"hold_steps": -1}, "hold_steps is a whole number >= 0, got -1"),
        ({"answer_steps": 1.5}, "answer_steps is a whole number >= 0, got 1.5"),
        ({"safe_action": [3.0]}, "safe_action is"),
        ({"safe_action": [0.0, 0.0]}, "safe_action is"),
    ],
)
def test_settings_that_do_not_fit_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ControlLoop(Recorder(TASK, 4), **{"period": 1, "simulate": lambda seconds: 0, **kwargs})


@pytest.mark.parametrize("period", [0.02, np.float64(0.02), np.float32(0.02)])
def test_numpys_numbers_of_a_log_are_counted_as_pythons(period):
    loop = ControlLoop(Recorder(TASK, 4), period, answer_steps=np.int64(1), simulate=lambda seconds: np.int64(3))
    for k, now in enumerate(np.arange(8) * 0.05):
        loop.observe(ZEROS, n_executed=np.uint32(k))
        loop.act(now)
    found = loop.statistics().to_dict()
    assert found["overruns"] == 7 and found["late_answers"] > 0 and found["steps"] == 8


def test_an_action_delay_of_few_digits_rounds_no_time_of_a_clock():
    model = Recorder(TASK, 4)
    loop = ControlLoop(model, 0.02, action_delay=np.float32(0.008), simulate=lambda seconds: 0)
    for k in range(20):
        now = 1.7e9 + 0.02 * k
        loop.observe(ZEROS, now)
        loop.act(now)
    assert loop.statistics().to_dict()["age_max"] == 0


def test_stamps_of_another_clock_are_refused():
    loop = ControlLoop(Recorder(TASK, 4), 0.02, simulate=lambda seconds: 0)
    loop.observe(ZEROS, capture_time=time.time())
    with pytest.raises(ValueError, match="one clock"):
        loop.act(time.monotonic())


def test_a_model_with_a_memory_is_refused():
    """Of SB3-contrib's recurrent ones each answer depends on those before, of which some come never."""

    class Recurrent(Recorder):
        def predict(self, *args, **kwargs):
            return super().predict(*args, **kwargs)[0], (ZEROS, ZEROS)

    with pytest.raises((ValueError, RuntimeError), match="Recurrent answers with a memory, of type tuple"):
        ControlLoop(Recurrent(TASK, 4), 1, simulate=lambda seconds: 0)


def test_an_agent_without_delay():
    plain = make(Drift(length=1000))  # untrained, so that the expert answers
    loop = ControlLoop(plain, 1, simulate=lambda seconds: 0)
    loop.observe(ZEROS, n_executed=0)
    np.testing.assert_array_equal(loop.act(0), plain.predict(ZEROS, deterministic=True)[0])


def test_ticks_come_once_a_period_and_make_up_for_none():
    now = [0.0]

    def sleep(seconds):
        now[0] += seconds

    beat = ticks(1.0, lambda: now[0], sleep)
    assert [next(beat), next(beat)] == [0, 1]
    now[0] += 0.75  # what the body of the loop takes
    assert next(beat) == 2
    now[0] += 3.5  # too long
    assert [next(beat), next(beat)] == [5.5, 6.5]
    with pytest.raises(ValueError, match="period is 0"):
        next(ticks(0))


def test_ticks_of_numpys_period_sleep_for_a_number():
    beat = ticks(np.float32(0.01))
    assert next(beat) < next(beat)


def test_a_looped_model_that_takes_no_time_is_asked_what_it_is_asked_without_a_loop():
    """In each of two episodes, under ages that its wrapper counts."""
    alone, looped = Recorder(TASK, 4), Recorder(TASK, 4)
    loop = in_steps(looped)
    for model in (alone, LoopedModel(loop)):
        rollout(model, lambda: delayed(UniformDelay(0, 4)), 2, seed=3)
    assert len(looped.asked) == len(alone.asked) == 24
    for ours, theirs in zip(looped.asked, alone.asked, strict=True):
        for key, value in theirs.items():
            np.testing.assert_array_equal(ours[key], value)


def test_a_looped_model_plays_one_environment():
    loop = in_steps(Recorder(TASK, 4))
    with pytest.raises(ValueError, match="one environment, got 2"):
        LoopedModel(loop).predict({"observation": np.zeros((2, 2)), "delay": np.zeros((2, 1))})


def test_who_sends_an_action_may_change_it():
    loop = in_steps(Recorder(TASK, 1))
    loop.observe(ZEROS, n_executed=0)
    sent = [loop.act(t) for t in range(2)]  # of ages 0 and 1; then it is held
    kept = sent[1].copy()
    sent[1][:] = 9.0
    np.testing.assert_array_equal(loop.act(2), kept)
