"""The delayed world: exact ages, histories and true states at every step of whole episodes."""

import copy
from collections import deque
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from hypothesis import given, settings
from hypothesis import strategies as st
from random_processes import processes
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_said.delays import (
    WIFI_20MS,
    DelayedObservationWrapper,
    DroppedPackets,
    EpisodeDelay,
    FixedDelay,
    HeldDelay,
    TotalDelay,
    UniformDelay,
)
from sb3_said.delays.receivers import RECEIVERS, IndependentDraw

LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 8.0], np.float32)


class LoggedTask(gym.Env):
    """Random states and lop-sided action bounds; logs what it was really in and given, an episode a list."""

    def __init__(self, length=12, low=LOW, high=HIGH, dtype=np.float64):
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), dtype)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self.length = length
        self.states, self.actions = [], []
        self.buffer = np.zeros(3, dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.states.append([])
        self.actions.append([])
        return self._state(), {"options": options}

    def step(self, action):
        self.actions[-1].append(np.array(action))
        ended = len(self.actions[-1]) == self.length
        return self._state(), float(action[0]), ended, False, {"t": len(self.actions[-1])}

    def _state(self):
        self.buffer[:] = self.np_random.normal(size=3)  # in place, as some simulators do
        self.states[-1].append(self.buffer.astype(np.float32))  # a copy
        return self.buffer


class TableDelay:
    """A user's own process."""

    def __init__(self, max_delay, draws):
        self.max_delay = max_delay
        self.draws = iter(draws)

    def sample(self, rng):
        return next(self.draws)


def delay_of_episode(receiver):
    """Of a process that draws one delay for all packets of an episode."""
    return next(receiver._delays)


def assert_observation(obs, task, delay, max_delay):
    """Compare with the log: s_{t-min(t, d)}, the actions a_{t-D..t-1} and nothing younger or older."""
    assert_age(obs, task, min(len(task.actions[-1]), delay), max_delay)


def assert_age(obs, task, age, max_delay):
    states, actions = task.states[-1], task.actions[-1]
    t = len(actions)
    assert obs["delay"].tolist() == [age]
    np.testing.assert_array_equal(obs["observation"], states[t - age])
    history = np.zeros((max_delay, 2))
    for k in range(1, min(t, max_delay) + 1):
        history[-k] = 2 * (actions[t - k] - LOW) / (HIGH - LOW) - 1
    np.testing.assert_allclose(obs["action_history"], history, atol=1e-6)
    assert {key: (x.dtype, x.shape) for key, x in obs.items()} == {
        "observation": (np.float32, (3,)),
        "action_history": (np.float32, (max_delay, 2)),
        "delay": (np.float32, (1,)),
    }


@pytest.mark.parametrize(
    ("delay", "max_delay"),
    [(0, 0), (1, 1), (4, 4), (4, 7), (0, 3), (11, 11), (12, 12), (40, 40), ((0, 5), 5), ((2, 3), 9)],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_step_of_whole_episodes(delay, max_delay, dtype):
    task = LoggedTask(dtype=dtype)
    env = DelayedObservationWrapper(task, delay, max_delay=max_delay)
    env.action_space.seed(0)
    drawn = set()
    for episode in range(12):
        obs, info = env.reset(seed=0 if episode == 0 else None, options={"n": episode})
        episode_delay = delay_of_episode(env.receiver)
        drawn.add(episode_delay)
        assert_observation(obs, task, episode_delay, max_delay)
        assert info["options"] == {"n": episode}
        np.testing.assert_array_equal(info["undelayed_observation"], task.states[-1][0])
        for t in range(1, task.length + 1):
            action = env.action_space.sample()
            obs, reward, terminated, truncated, info = env.step(action)
            assert_observation(obs, task, episode_delay, max_delay)
            # the reward and the end are this step's, as old as the observation may be
            assert (reward, terminated, truncated, info["t"]) == (float(action[0]), t == task.length, False, t)
            np.testing.assert_array_equal(info["undelayed_observation"], task.states[-1][-1])
    low, high = delay if isinstance(delay, tuple) else (delay, delay)
    assert drawn <= set(range(low, high + 1))
    assert len(drawn) > 1 or low == high


@settings(deadline=None)
@given(processes(), st.sampled_from(sorted(RECEIVERS)), st.integers(0, 2), st.integers(0, 2**16))
def test_every_step_under_any_process(process, receiver, spare, seed):
    task = LoggedTask(length=25)
    max_delay = process.max_delay + spare
    env = DelayedObservationWrapper(task, process, max_delay=max_delay, receiver=receiver)
    log = RECEIVERS[receiver](process)  # itself tested against a log of arrivals
    rng = np.random.default_rng([seed, 1])
    env.action_space.seed(seed)
    for episode in range(3):
        obs, info = env.reset(seed=seed if episode == 0 else None)
        log.reset(rng)
        assert_age(obs, task, 0, max_delay)
        assert info["forced_deliveries"] == 0
        for _ in range(task.length):
            obs, *_, info = env.step(env.action_space.sample())
            assert_age(obs, task, log.step(), max_delay)
            assert info["forced_deliveries"] == log.forced_deliveries
            np.testing.assert_array_equal(info["undelayed_observation"], task.states[-1][-1])


@settings(deadline=None)
@given(processes(), st.sampled_from(sorted(RECEIVERS)), st.integers(0, 2), st.integers(0, 2**16))
def test_every_state_that_was_handed_out_is_remembered(process, receiver, spare, seed):
    tasks = [LoggedTask(length=25), LoggedTask(length=25)]
    max_delay = process.max_delay + spare
    plain, env = (
        DelayedObservationWrapper(task, process, max_delay=max_delay, receiver=receiver, state_history=remembers)
        for task, remembers in zip(tasks, (False, True), strict=True)
    )
    env.action_space.seed(seed)
    for episode in range(2):
        plain_obs, _ = plain.reset(seed=seed + episode)
        obs, _ = env.reset(seed=seed + episode)
        handed_out = set()
        for t in range(26):
            assert env.observation_space.contains(obs)
            for key, value in plain_obs.items():
                np.testing.assert_array_equal(obs[key], value)
            age = int(obs["delay"].item())
            handed_out.add(t - age)
            known, states = np.zeros(max_delay, np.float32), np.zeros((max_delay, 3), np.float32)
            for k in range(max_delay):
                if t - max_delay + 1 + k in handed_out:
                    known[k], states[k] = 1.0, tasks[1].states[-1][t - max_delay + 1 + k]
            np.testing.assert_array_equal(obs["state_known"], known)
            np.testing.assert_array_equal(obs["state_history"], states)
            if receiver == "newest":
                assert not known[max_delay - age :].any()  # none is younger than the observation
            if t < 25:
                action = env.action_space.sample()
                plain_obs, obs = plain.step(action)[0], env.step(action)[0]


def test_an_older_observation_that_follows_a_younger_one():
    class Table:
        max_delay = 3

        def sample(self, rng):
            return iter([1, 0, 2, 3, 3])

    task = LoggedTask()
    env = DelayedObservationWrapper(task, Table(), receiver="independent", state_history=True)
    observations = [env.reset(seed=0)[0]] + [env.step(env.action_space.sample())[0] for _ in range(5)]
    # Read at t = 0..5: s_0, s_0, s_2, s_1, s_1, s_2; known of s_{t-2}, s_{t-1}, s_t:
    known = [[0, 0, 1], [0, 1, 0], [1, 0, 1], [1, 1, 0], [1, 0, 0], [0, 0, 0]]
    assert [obs["state_known"].tolist() for obs in observations] == known
    np.testing.assert_array_equal(observations[3]["state_history"][1], task.states[0][2])  # while s_1 is handed out
    assert observations[3]["delay"] == 2
    kept = observations[2]["state_history"].copy()
    env.reset()
    np.testing.assert_array_equal(observations[2]["state_history"], kept)


def test_unknown_states_lie_in_a_space_that_leaves_out_zero():
    task = LoggedTask()
    task.observation_space = spaces.Box(np.float32([1, -3, -1]), np.float32([2, -2, 1]))
    env = DelayedObservationWrapper(task, 2, state_history=True)
    box = env.observation_space["state_history"]
    np.testing.assert_array_equal(box.low, [[0, -3, -1]] * 2)
    np.testing.assert_array_equal(box.high, [[2, 0, 1]] * 2)
    assert env.observation_space["observation"] == task.observation_space


def test_losses_that_were_delivered_are_counted():
    env = DelayedObservationWrapper(LoggedTask(length=100), DroppedPackets(1, p=1.0, max_losses=2))
    env.reset(seed=0)
    steps = [env.step(env.action_space.sample()) for _ in range(6)]
    assert [obs["delay"].item() for obs, *_ in steps] == [1, 2, 3, 3, 3, 3]
    assert [info["forced_deliveries"] for *_, info in steps] == [0, 0, 0, 1, 2, 3]


def test_tasks_of_the_same_seed_do_not_depend_on_the_delay():
    states = []
    for delay in (0, 3, (0, 8), UniformDelay(0, 8), DroppedPackets(WIFI_20MS, p=0.3)):
        task = LoggedTask()
        env = DelayedObservationWrapper(task, delay)
        env.reset(seed=5)
        for _ in range(task.length):
            env.step(np.zeros(2, np.float32))
        states.append(np.array(task.states))
    for others in states[1:]:
        np.testing.assert_array_equal(others, states[0])


def test_earlier_observations_do_not_change():
    env = DelayedObservationWrapper(LoggedTask(), 2)
    obs, info = env.reset(seed=0)
    outputs = [{**obs, "info": info["undelayed_observation"]}]
    for _ in range(5):
        obs, *_, info = env.step(env.action_space.sample())
        outputs.append({**obs, "info": info["undelayed_observation"]})
    copies = copy.deepcopy(outputs)
    env.reset()
    env.step(env.action_space.sample())
    for output, kept in zip(outputs, copies, strict=True):
        for key, value in output.items():
            np.testing.assert_array_equal(value, kept[key])


def test_history_holds_what_was_executed():
    env = DelayedObservationWrapper(LoggedTask(), 1)
    env.reset(seed=0)
    pairs = [(LOW, [-1, -1]), (HIGH, [1, 1]), ([0, 4], [0, 0]), ([9, -9], [1, -1]), ([1, 2], [0.5, -0.5])]
    for action, scaled in pairs:
        obs = env.step(np.array(action, np.float32))[0]
        np.testing.assert_array_equal(obs["action_history"], [scaled])


@pytest.mark.parametrize(
    "space",
    [spaces.Box(-100, 100, (1,), np.int8), spaces.Box(-128, 127, (1,), np.int8), spaces.Box(-3e38, 3e38, (1,))],
)
def test_bounds_whose_span_their_own_type_cannot_hold(space):
    task = LoggedTask()
    task.action_space = space
    env = DelayedObservationWrapper(task, 1)
    env.reset(seed=0)
    for action, scaled in ((space.low, -1), (space.high, 1), (space.high // 2, 0.5)):
        np.testing.assert_allclose(env.step(action)[0]["action_history"], [[scaled]], atol=0.01)


def test_history_is_bit_for_bit_the_action_where_bounds_are_one():
    env = DelayedObservationWrapper(LoggedTask(low=-np.ones(2, np.float32), high=np.ones(2, np.float32)), 1)
    env.reset(seed=0)
    for _ in range(10):
        action = env.action_space.sample()
        np.testing.assert_array_equal(env.step(action)[0]["action_history"], [action])


def test_seeds():
    def delays(seed, n=30):
        env = DelayedObservationWrapper(LoggedTask(), (0, 8))
        drawn = []
        for episode in range(n):
            obs, _ = env.reset(seed=seed if episode == 0 else None)
            drawn.append((delay_of_episode(env.receiver), *obs["observation"]))
        return drawn

    assert delays(1) == delays(1)
    assert delays(1) != delays(2)
    assert {delay for delay, *_ in delays(1)} == set(range(9))  # a new delay each episode, all of the range


def test_parallel_environments_draw_their_own_delays():
    vec = make_vec_env(lambda: DelayedObservationWrapper(LoggedTask(), (0, 50)), n_envs=4, seed=0)
    vec.reset()
    assert len(set(map(delay_of_episode, vec.get_attr("receiver")))) > 1


@pytest.mark.parametrize("delay", [0, 3, (0, 8), DroppedPackets(UniformDelay(0, 4), p=0.2)])
@pytest.mark.parametrize("name", ["Pendulum-v1", "Hopper-v5"])
@pytest.mark.filterwarnings("ignore::UserWarning")  # both recommend other bounds, of the tasks themselves
def test_checkers_of_gymnasium_and_sb3(name, delay):
    for kwargs in ({}, {"receiver": "independent", "state_history": True}):
        env = DelayedObservationWrapper(gym.make(name).unwrapped, delay, **kwargs)
        check_gymnasium_env(env, skip_render_check=True)
        check_sb3_env(DelayedObservationWrapper(gym.make(name), delay, **kwargs), warn=False)


def test_made_again_from_its_spec():
    env = gym.make(DelayedObservationWrapper(gym.make("Pendulum-v1"), (1, 3), max_delay=5).spec)
    assert isinstance(env, DelayedObservationWrapper)
    assert (env.process, env.max_delay) == (EpisodeDelay(1, 3), 5)
    env = gym.make(
        DelayedObservationWrapper(gym.make("Pendulum-v1"), WIFI_20MS, receiver="independent", state_history=True).spec
    )
    assert (env.process, type(env.receiver)) == (WIFI_20MS, IndependentDraw)
    assert "state_known" in env.reset()[0]


def make_pendulum(delay):
    return Monitor(DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=7), delay))


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
@pytest.mark.parametrize("delay", [0, 3])
def test_in_vectorised_normalised_monitored_environments(vec_env_cls, delay):
    vec = make_vec_env(partial(make_pendulum, delay), n_envs=2, seed=3, vec_env_cls=vec_env_cls)
    vec = VecNormalize(vec, norm_obs_keys=["observation"])
    vec.reset()
    log = [np.stack([info["undelayed_observation"] for info in vec.venv.reset_infos])]
    for t in range(1, 8):
        obs, _, dones, infos = vec.step(np.full((2, 1), 1.0))
        log.append(np.stack([info["undelayed_observation"] for info in infos]))
        assert dones.all() == (t == 7)
        arrived = log[t - min(t, delay)]
        if t == 7:  # VecNormalize normalises this one in place
            last = vec.unnormalize_obs(infos[0]["terminal_observation"])
            np.testing.assert_allclose(last["observation"], arrived[0], atol=1e-5)
        else:  # ages and actions are not normalised
            np.testing.assert_array_equal(vec.get_original_obs()["observation"], arrived)
            np.testing.assert_array_equal(obs["delay"], np.full((2, 1), min(t, delay)))
            n_sent = min(t, delay)
            np.testing.assert_array_equal(obs["action_history"][:, delay - n_sent :], np.full((2, n_sent, 1), 0.5))
    assert infos[0]["episode"]["l"] == 7
    vec.close()


def test_wide_bounds_become_infinite():
    task = LoggedTask()
    task.observation_space = spaces.Box(-1e300, 1e300, (3,), np.float64)  # more than float32 can hold
    box = DelayedObservationWrapper(task).observation_space["observation"]
    assert np.all(box.low == -np.inf) and np.all(box.high == np.inf)


@pytest.mark.parametrize(
    ("attribute", "space", "remedy"),
    [
        ("observation_space", spaces.Box(-1, 1, (3, 3)), "FlattenObservation"),
        ("observation_space", spaces.Box(-1, 1, ()), "FlattenObservation"),
        ("observation_space", spaces.Discrete(3), "FlattenObservation"),
        ("observation_space", spaces.Dict(a=spaces.Box(-1, 1, (3,))), "FlattenObservation"),
        ("action_space", spaces.Discrete(3), "RescaleAction"),
        ("action_space", spaces.Box(-np.inf, 1, (2,)), "RescaleAction"),
        ("action_space", spaces.Box(-1, 1, (2, 2)), "RescaleAction"),
    ],
)
def test_other_spaces_are_refused_with_a_remedy(attribute, space, remedy):
    task = LoggedTask()
    setattr(task, attribute, space)
    with pytest.raises(ValueError, match=remedy):
        DelayedObservationWrapper(task)


def test_wrapping_twice_is_refused():
    with pytest.raises(ValueError, match="1-D Box observation"):
        DelayedObservationWrapper(DelayedObservationWrapper(LoggedTask(), 1), 1)


def test_max_delay_below_the_delay_is_refused():
    with pytest.raises(ValueError, match="max_delay=3 is smaller than the largest delay 4"):
        DelayedObservationWrapper(LoggedTask(), (0, 4), max_delay=3)
    for bad in (4.5, "5", -1):
        with pytest.raises(ValueError, match=f"max_delay is a whole number >= 0, got {bad}"):
            DelayedObservationWrapper(LoggedTask(), 0, max_delay=bad)


# ---------------------------------------------------------------------------------------------------- action delay


class Robot:
    """A task as it is: actions queue up on their way to it, observations on their way back."""

    def __init__(self, name, n_there, n_back, seed):
        self.env = gym.make(name)
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
    wrappers = [
        DelayedObservationWrapper(gym.make("Hopper-v5"), d, k),
        DelayedObservationWrapper(gym.make("Hopper-v5"), d + k),
        DelayedObservationWrapper(gym.make("Hopper-v5"), FixedDelay(d), (k, k)),
    ]
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
    env = DelayedObservationWrapper(
        task, observation, action, max_delay=max_delay, receiver=receiver, state_history=True
    )
    twin = DelayedObservationWrapper(LoggedTask(length=25), process, max_delay=max_delay, receiver=receiver)
    there, back = RECEIVERS[receiver](action), RECEIVERS[receiver](observation)  # themselves tested against arrivals
    env.action_space.seed(seed)
    for episode in range(2):
        obs, info = env.reset(seed=seed + episode)
        twin.reset(seed=seed + episode)
        rng = np.random.default_rng([seed + episode, 1])
        there.reset(rng.spawn(1)[0])
        back.reset(rng)
        sent, arrived_as, handed_out = [], [], {0}  # arrived_as: which of those sent each step executed
        for t in range(1, task.length + 1):
            sent.append(env.action_space.sample())
            arrived_as.append(t - 1 - (there.step() if t > 1 else 0))
            obs, *_, info = env.step(sent[-1])
            for key, value in twin.step(sent[-1])[0].items():
                np.testing.assert_array_equal(value, obs[key])  # one process says the same as two
            np.testing.assert_array_equal(task.actions[-1][-1], sent[arrived_as[-1]])
            np.testing.assert_allclose(env._scale(task.actions[-1][-1]), info["executed_action"])
            shown = t - back.step()
            np.testing.assert_array_equal(obs["observation"], task.states[-1][shown])
            newest = arrived_as[shown - 1] if shown > 0 else -1  # that shows in the observation
            assert obs["delay"].item() == t - 1 - newest <= process.max_delay
            n_sent = min(t, max_delay)
            newest_sent = np.reshape([env._scale(a) for a in sent[t - n_sent :]], (n_sent, 2))
            np.testing.assert_allclose(obs["action_history"][max_delay - n_sent :], newest_sent)
            assert not obs["action_history"][: max_delay - n_sent].any()
            assert info["forced_deliveries"] == there.forced_deliveries + back.forced_deliveries
            np.testing.assert_array_equal(info["undelayed_observation"], task.states[-1][-1])
            handed_out.add(shown)
            # the row of the first action that does not show in it is the one after the observation's
            offset = shown + int(obs["delay"].item()) - max_delay + 1
            known = np.array([offset + row in handed_out for row in range(max_delay)], np.float32)
            np.testing.assert_array_equal(obs["state_known"], known)
            for row in np.flatnonzero(known):
                np.testing.assert_array_equal(obs["state_history"][row], task.states[-1][offset + row])
            assert not obs["state_history"][known == 0].any()
            assert env.observation_space.contains(obs)


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
    env = DelayedObservationWrapper(LoggedTask(), HeldDelay(TotalDelay(2, WIFI_20MS)))
    env.reset()
    with pytest.raises(ValueError, match=r"draws a delay for every action, .* not inside another process"):
        env.step(env.action_space.sample())
    with pytest.raises(ValueError, match="delay"):
        DelayedObservationWrapper(LoggedTask(), 2, -1)


def test_an_unknown_receiver_is_refused():
    with pytest.raises(ValueError, match=r"receiver is 'oldest', expected one of \('newest', 'independent'\)"):
        DelayedObservationWrapper(LoggedTask(), 2, receiver="oldest")


def test_a_users_own_process():
    env = DelayedObservationWrapper(LoggedTask(), TableDelay(3, [3, 0, 2]))
    assert env.max_delay == 3
    for delay in [3, 0, 2]:
        env.reset()
        ages = [env.step(env.action_space.sample())[0]["delay"].item() for _ in range(6)]
        assert ages == [min(t, delay) for t in range(1, 7)]


@pytest.mark.parametrize("draw", [-1, 4])
def test_a_process_outside_its_range_is_refused(draw):
    # A negative delay would hand out the oldest state as the newest.
    env = DelayedObservationWrapper(LoggedTask(), TableDelay(3, [draw]))
    with pytest.raises(ValueError, match=f"drew a delay of {draw}"):
        env.reset()


def test_fixed_process_equals_integer():
    assert DelayedObservationWrapper(LoggedTask(), 6).process == FixedDelay(6)


def test_an_action_that_cannot_vary_is_refused():
    env = gym.make("Pendulum-v1")
    env.action_space = spaces.Box(np.float32([-1.0, 0.5]), np.float32([1.0, 0.5]))
    with pytest.raises(ValueError, match="low and high are equal"):
        DelayedObservationWrapper(env, delay=1)
