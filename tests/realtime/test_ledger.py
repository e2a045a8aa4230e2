"""What an age is, what is promised to a model, and what is sent when no answer comes."""

import math

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_said.realtime.ledger import Ledger

STATES, ACTIONS = spaces.Box(-np.inf, np.inf, (1,), np.float32), spaces.Box(-2.0, 2.0, (1,), np.float32)
SAFE = np.array([-2.0], np.float32)


def make(max_delay=4, max_age=None, action_delay=0.0, hold_steps=2):
    max_age = max_delay if max_age is None else max_age
    return Ledger(STATES, ACTIONS, 1.0, max_delay, max_age, action_delay, hold_steps, SAFE)


def send(ledger, n=1, now=None):
    """Send as planned, and return what was sent."""
    sent = []
    for _ in range(n):
        step = ledger.next_step()
        ledger.send(step, ledger.n_sent if now is None else now)
        sent.append(float(step.action[0]))
    return sent


def plan(*actions):
    return np.array(actions, np.float32)[:, None]


def test_the_age_counts_actions_that_had_acted_for_half_a_period_or_less():
    ledger = make(action_delay=1.5)
    send(ledger, 4)  # at 0, 1, 2 and 3; they take effect at 1.5, 2.5, 3.5 and 4.5
    assert ledger.observe([0.0], 1.6, None) and ledger.age == 4  # the first has acted for a tenth, and hardly shows
    assert ledger.observe([0.0], 2.0, None) and ledger.age == 4
    assert ledger.observe([0.0], 2.1, None) and ledger.age == 3
    assert ledger.observe([0.0], 3.1, None) and ledger.age == 2
    assert ledger.observe([0.0], 9.0, None) and ledger.age == 0
    send(ledger)
    assert ledger.age == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float64, np.int64])
def test_numbers_of_a_packet_are_read_whatever_their_type(dtype):
    ledger = make()
    send(ledger, 300)
    assert ledger.observe([1.0], None, dtype(255 if dtype == np.uint8 else 260))
    assert ledger.age in (45, 40) and type(ledger.age) is int
    send(ledger)
    assert ledger.age in (46, 41)
    with pytest.raises(ValueError, match=r"2\.5 actions were executed"):
        ledger.observe([1.0], None, 2.5)


def test_a_frozen_sensor_ages_and_an_overtaken_packet_is_dropped():
    ledger = make()
    assert ledger.observe([1.0], 0, None)
    send(ledger, 3)
    assert not ledger.observe([2.0], 0, None) and not ledger.observe([2.0], -1, None)
    assert ledger.age == 3 and ledger.observation == 1.0
    assert ledger.observe([3.0], None, 2) and not ledger.observe([4.0], None, 1)
    assert ledger.age == 1 and ledger.observation == 3.0
    assert ledger.observe([5.0], None, 2) and ledger.observation == 5.0  # a robot that executed nothing in between


def test_an_observation_from_before_the_episode_is_dropped():
    ledger = make()
    ledger.observe([1.0], 7, None)
    ledger.start_episode(10.0)
    assert ledger.observation is None and ledger.n_sent == 0
    assert not ledger.observe([1.0], 9.9, None)
    assert not ledger.observe([1.0], 9.9, 60)  # its count is of that episode, too
    assert ledger.observe([1.0], 10.0, None)


def test_a_stamp_later_than_it_can_be_is_dropped_and_spoils_nothing():
    ledger = make()
    assert ledger.observe([1.0], 0, None) and not ledger.observe([2.0], 9, None, latest=2)
    assert ledger.observation == 1.0 and ledger.observe([3.0], 2, None, latest=2)


def test_a_stamp_does_not_bring_back_what_an_unstamped_observation_has_overtaken():
    ledger = make()
    send(ledger, 4)  # at 0, 1, 2 and 3
    assert ledger.observe([1.0], 0.5, None) and ledger.observe([2.0], None, 4)
    assert not ledger.observe([3.0], 2.0, None)  # two actions: younger than the stamped one, older than the other
    assert (ledger.observation, ledger.age) == (np.float32(2.0), 0)
    assert ledger.observe([4.0], 9.0, None)
    send(ledger, 1, now=9.5)
    assert not ledger.observe([5.0], None, 3)
    assert ledger.observe([6.0], 9.2, None) and ledger.age == 1


def test_a_sensor_that_freezes_is_known_without_stamps_by_number_and_state():
    ledger = make()
    assert ledger.observe([1.0], None, 0) and ledger.observe([1.0], None, 0)  # a robot that stands
    send(ledger)
    assert not ledger.observe([1.0], None, 0) and ledger.observe([1.1], None, 0) and ledger.observe([1.1], None, 1)


@given(st.lists(st.floats(0, 2), min_size=1, max_size=60), st.integers(0, 4), st.floats(0, 60))
def test_an_age_beyond_what_the_model_reads_is_counted_in_full(gaps, max_delay, stamp):
    ledger, times = make(max_delay), np.cumsum(gaps)
    for now in times:
        send(ledger, 1, now)
    ledger.observe([1.0], stamp, None)
    assert ledger.age == (times >= stamp - 0.5).sum()


@pytest.mark.parametrize(
    ("observation", "capture_time", "n_executed", "message"),
    [
        ([1.0, 2.0], 0, None, r"shape \(2,\)"),
        ([math.nan], 0, None, "finite"),
        ([1e300], 0, None, "finite"),
        ([1.0], math.nan, None, "capture_time is nan"),
        ([1.0], None, 1, "1 actions were executed, but 0 were sent"),
        ([1.0], None, -1, "-1 actions"),
    ],
)
def test_what_is_no_observation_is_refused(observation, capture_time, n_executed, message):
    with pytest.raises(ValueError, match=message):
        make().observe(observation, capture_time, n_executed)


def test_a_request_has_the_actions_that_will_be_sent_meanwhile():
    ledger = make()
    ledger.observe([1.0], 0, None)
    ledger.splice(plan(0.2, 0.4, 0.6), 0)
    send(ledger)
    request = ledger.request(3)
    assert (request.n_sent, request.target, request.age) == (1, 4, 4)
    np.testing.assert_array_equal(request.history, np.float32([[0.1], [0.2], [0.3], [0.3]]))  # scaled; the last is held
    assert send(ledger, 3) == pytest.approx([0.4, 0.6, 0.6])


def test_a_request_asks_for_no_age_that_the_model_cannot_read():
    ledger = make(max_delay=4)
    ledger.observe([1.0], 0, None)
    send(ledger, 2)
    assert (ledger.request(9).age, ledger.request(9).target) == (4, 4)
    send(ledger, 2)
    assert (ledger.request(9).age, ledger.request(9).target) == (4, 4)
    send(ledger)
    assert ledger.request(0) is None


def test_an_answer_begins_at_its_action_and_the_one_before_serves_until_then():
    ledger = make()
    ledger.splice(plan(0.1, 0.2, 0.3), 0)
    assert ledger.splice(plan(1.1, 1.2), 2) == 0
    assert send(ledger, 4) == pytest.approx([0.1, 0.2, 1.1, 1.2])


def test_of_a_late_answer_the_later_actions_serve():
    ledger = make()
    send(ledger, 3)
    assert ledger.splice(plan(0.1, 0.2, 0.3), 1) == 2
    assert send(ledger) == pytest.approx([0.3])
    assert ledger.splice(plan(0.7, 0.8), 1) == 3  # all of it is past, but it is still the newest that is known
    assert send(ledger, 2) == pytest.approx([0.8, -2.0])  # held for action 4; action 3 counts as held, too


def test_without_an_answer_it_holds_and_then_sends_the_safe_action():
    ledger = make(hold_steps=2)
    assert send(ledger) == [-2.0]  # nothing to hold yet
    ledger.splice(plan(0.5), 1)
    assert send(ledger, 5) == [0.5, 0.5, 0.5, -2.0, -2.0]
    assert ledger.next_step().n_missing == 5
    ledger.splice(plan(0.7), ledger.n_sent)
    assert ledger.next_step().n_missing == 0 and send(ledger, 2) == pytest.approx([0.7, 0.7])


def test_an_observation_that_is_too_old_discards_the_plan():
    ledger = make(max_age=1)
    ledger.observe([1.0], 0, None)
    ledger.splice(plan(0.1, 0.2, 0.3, 0.4), 0)
    promised = ledger.request(3)
    assert promised.era == ledger.era and promised.history[-3:, 0] == pytest.approx([0.05, 0.1, 0.15])  # scaled
    assert send(ledger, 4) == pytest.approx([0.1, 0.2, 0.2, 0.2])
    assert promised.era != ledger.era  # its answer would follow what was not sent
    assert ledger.request(0) is None


def test_without_delay_there_is_no_history():
    ledger = make(max_delay=0)
    ledger.observe([1.0], 0, None)
    assert ledger.request(3).history.shape == (0, 1) and ledger.request(3).target == 0
    ledger.splice(plan(0.1), 0)
    send(ledger)
    ledger.observe([1.0], None, 1)
    assert ledger.request(3).history.shape == (0, 1) and ledger.request(3).age == 0


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 3), st.integers(1, 4)), max_size=20), st.integers(0, 3))
def test_what_is_promised_is_sent(answers, hold_steps):
    """Of one worker: between a request and its answer, the actions in the request's history are those that go out."""
    ledger = make(max_delay=8, hold_steps=hold_steps)
    sent, value = [], 0.0
    for took, expected, n_planned in answers:
        ledger.observe([1.0], None, ledger.n_sent)
        request = ledger.request(expected)
        sent += send(ledger, took)
        value += 0.01
        ahead = send_copy(ledger, request.target - ledger.n_sent)
        padded = [0.0] * 8 + [x / 2 for x in sent + ahead]
        np.testing.assert_allclose(request.history[:, 0], padded[: 8 + request.target][-8:], rtol=1e-6)
        ledger.splice(plan(*[value] * n_planned), request.target)


def send_copy(ledger, n):
    """Return what the next n steps would send."""
    return [float(step.action[0]) for step in ledger._coming(max(n, 0))]


def test_who_is_asked_may_change_what_it_was_given():
    ledger = make()
    ledger.observe([1.0], 0, None)
    ledger.splice(plan(0.2), 0)
    send(ledger)
    request = ledger.request(0)
    request.observation[:] = request.history[:] = 9.0
    again = ledger.request(0)
    assert again.observation == 1.0
    np.testing.assert_array_equal(again.history[:, 0], np.float32([0, 0, 0, 0.1]))
