"""A model that answers with a function of what it is asked, and remembers all of it."""

import threading

import numpy as np

from sb3_said.delays.space import KEYS, check_task, delayed_space


class Recorder:
    """Answers as :func:`plan_of` does, in closed loop with the observation, so that any difference would grow."""

    def __init__(self, task, max_delay):
        state_space, self.action_space = check_task(task.observation_space, task.action_space)
        self.observation_space = delayed_space(state_space, self.action_space, max_delay)
        self.asked = []

    def warmup(self):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.asked.append({key: value[0].copy() for key, value in observation.items()})
        return plan_of(self.asked[-1], self.action_space, 1), None


class Planning(Recorder):
    """Plans 4 steps."""

    def predict_plan(self, observation, deterministic=False):
        self.predict(observation)
        return plan_of(self.asked[-1], self.action_space, 4)[None]


class Gated(Recorder):
    """Answers when it is let."""

    def __init__(self, task, max_delay):
        super().__init__(task, max_delay)
        self.gate, self.is_computing = threading.Event(), threading.Event()
        self.gate.set()

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.is_computing.set()
        assert self.gate.wait(60)
        return super().predict(observation)


def plan_of(obs, action_space, n_steps):
    """Return actions (n_steps, act_dim) that depend on every entry of an observation."""
    total = sum(np.sum(np.sin(obs[key].astype(np.float64) + i)) for i, key in enumerate(KEYS))
    grid = total + np.arange(n_steps)[:, None] + 0.3 * np.arange(action_space.shape[0])
    return (action_space.high * np.sin(grid)).astype(np.float32)


def assert_same(given, wanted):
    assert set(given) == set(wanted)
    for key, value in wanted.items():
        assert given[key].dtype == value.dtype, key
        np.testing.assert_array_equal(given[key], value, err_msg=key)


def assert_honest(requests, sent, shown_in, found):
    """Check what a loop with threads asked: the age, and the actions that were and would be sent before the target.

    Where answers get faster, a later one may be for an earlier action. It takes over from there on, and of the answer
    before nothing is sent: what that one was promised from there on need not have been kept.

    :param requests: of one episode, in the order of their answers
    :param sent: (n_sent, act_dim), in [-1, 1]
    :param shown_in: maps an observation to the number of actions that show in it
    :param found: the loop's statistics
    """
    taken_over = np.inf
    for request in reversed(requests):
        n, max_delay = request.target, len(request.history)
        assert request.age == n - shown_in(request.observation)
        taken_over = n = min(n, taken_over)
        if max(found.ages) > max_delay:  # threw away what was promised; so late are observations of a busy machine
            n = request.n_sent
        n = min(n, len(sent))
        known = request.history[: max_delay - (request.target - n)]
        wanted = np.concatenate([np.zeros((max_delay, sent.shape[1])), sent[:n]])
        np.testing.assert_allclose(known, wanted[len(wanted) - len(known) :], atol=1e-6)
