"""The delayed world: exact ages, histories and true states at every step of whole episodes."""

import copy
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from gymnasium.wrappers import Autoreset, RecordVideo
from hypothesis import given, settings
from hypothesis import strategies as st
from logged_task import HIGH, LOW, LoggedTask, delay_of_episode
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
    UniformDelay,
)
from sb3_said.delays.receivers import RECEIVERS, IndependentDraw


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


class Halving(LoggedTask):
    """Changes the action that it is given in place, as some simulators do."""

    def step(self, action):
        answer = super().step(action)
        action *= 0.5
        return answer


@pytest.mark.parametrize("action_delay", [0, 1, UniformDelay(1, 3)])
@pytest.mark.parametrize("low", [LOW, -np.ones(2, np.float32)])
def test_a_task_that_changes_the_action_it_is_given(action_delay, low):
    observations, actions = [], []
    for cls in (LoggedTask, Halving):
        task = cls(low=low, high=HIGH if low is LOW else -low)
        env = DelayedObservationWrapper(task, 1, action_delay)
        env.action_space.seed(0)
        env.reset(seed=0)
        sent = [env.action_space.sample() for _ in range(10)]
        kept = copy.deepcopy(sent)
        observations.append([env.step(action) for action in sent])
        np.testing.assert_array_equal(sent, kept)  # the caller's stay, too
        actions.append(task.actions)
    np.testing.assert_equal(observations[1], observations[0])
    np.testing.assert_array_equal(actions[1], actions[0])


@pytest.mark.parametrize(
    ("state", "info", "message"),
    [
        (np.zeros(4), {}, r"observation of shape \(4,\).*expected shape \(3,\)"),
        (np.zeros(1), {}, r"observation of shape \(1,\)"),  # which NumPy would broadcast
        (0.0, {}, r"observation of shape \(\)"),
        (np.zeros((1, 3)), {}, r"observation of shape \(1, 3\)"),
        (np.array([0.0, None, 1.0]), {}, "holds object"),
        (np.array(["0", "1", "2"]), {}, "holds <U1"),
        (np.zeros(3, complex), {}, "holds complex128"),
        (np.zeros(3), None, "info of type NoneType"),
        ([[1.0], 2.0, 3.0], {}, "inhomogeneous"),
    ],
)
def test_malformed_answers_of_a_task_are_refused(state, info, message):
    task = LoggedTask()
    env = DelayedObservationWrapper(task, 1)
    env.reset(seed=0)
    task.reset = lambda **_: (state, info)
    with pytest.raises(ValueError, match=message):
        env.reset()
    task.step = lambda action: (state, 0.0, False, False, info)
    with pytest.raises(ValueError, match=message):
        env.step(env.action_space.sample())


@pytest.mark.parametrize("n", [2, 3])
def test_a_reset_without_info_is_refused(n):
    task = LoggedTask()
    task.observation_space = spaces.Box(-1, 1, (n,))
    env = DelayedObservationWrapper(task, 1)
    task.reset = lambda **_: np.zeros(n, np.float32)
    with pytest.raises(ValueError, match="info of type NoneType"):
        env.reset()


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


@pytest.mark.parametrize(
    "delay",
    [3, (1, 3), WIFI_20MS, UniformDelay(0, 2), DroppedPackets((0, 4), p=0.1), "UniformDelay(0, 2)", np.int64(2)],
    ids=str,
)
def test_made_again_from_a_spec_in_a_file(delay):
    env = DelayedObservationWrapper(gym.make("Pendulum-v1"), delay, action_delay=delay)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.process == env.process


class OwnProcess:
    """A user's own, which no text can name."""

    max_delay = 1

    def sample(self, rng):
        return 1


def test_a_process_of_ones_own_is_made_again_from_its_spec():
    env = gym.make(DelayedObservationWrapper(gym.make("Pendulum-v1"), OwnProcess()).spec)
    assert isinstance(env.process, OwnProcess)


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


def delayed_pendulum(env):
    return DelayedObservationWrapper(env, UniformDelay(0, 3))


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_in_vectorised_environments_of_gymnasium(mode):
    vec = gym.make_vec("Pendulum-v1", 2, mode, max_episode_steps=9, wrappers=[delayed_pendulum])
    single = [DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=9), UniformDelay(0, 3))] * 2
    obs, _ = vec.reset(seed=4)
    assert vec.observation_space.contains(obs)
    action = np.full((2, 1), 0.5, np.float32)
    rows = [obs] + [vec.step(action)[0] for _ in range(8)]
    vec.close()
    for i, env in enumerate(single):  # each as it would be alone, from the seeds 4 and 5
        alone = [env.reset(seed=4 + i)[0]] + [env.step(action[0])[0] for _ in range(8)]
        for row, expected in zip(rows, alone, strict=True):
            np.testing.assert_equal({key: value[i] for key, value in row.items()}, expected)


class Filmed(LoggedTask):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def render(self):
        return np.full((32, 32, 3), 10 * len(self.actions[-1]), np.uint8)


@pytest.mark.parametrize("above", [True, False])
def test_videos_are_recorded(above, tmp_path):
    pytest.importorskip("moviepy")

    def record(env):
        return RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda _: True, disable_logger=True)

    task = Filmed(length=4)
    env = record(DelayedObservationWrapper(task, 2)) if above else DelayedObservationWrapper(record(task), 2)
    env.reset(seed=0)
    while not env.step(env.action_space.sample())[2]:
        pass
    env.close()
    assert [file.stat().st_size > 0 for file in (tmp_path / "videos").glob("*.mp4")] == [True]


def test_wide_bounds_become_infinite():
    task = LoggedTask()
    task.observation_space = spaces.Box(-1e300, 1e300, (3,), np.float64)  # more than float32 can hold
    box = DelayedObservationWrapper(task).observation_space["observation"]
    assert np.all(box.low == -np.inf) and np.all(box.high == np.inf)


def test_spaces_that_a_delayed_task_cannot_have_are_refused():
    task = LoggedTask()
    task.observation_space = spaces.Box(-1, 1, ())  # test_space.py has the others
    with pytest.raises(ValueError, match="FlattenObservation"):
        DelayedObservationWrapper(task)


@pytest.mark.parametrize("between", [lambda env: env, Monitor])
def test_wrapping_twice_is_refused(between):
    with pytest.raises(ValueError, match=r"already. One wrapper gives every delay") as refused:
        DelayedObservationWrapper(between(DelayedObservationWrapper(LoggedTask(), 1, state_history=True)), 1)
    assert "Flatten" not in str(refused.value)


def test_without_an_episode_the_task_is_not_stepped():
    task = LoggedTask(length=3)
    env = DelayedObservationWrapper(task, 2)
    with pytest.raises(gym.error.ResetNeeded, match=r"Call reset\(\) first"):
        env.step(env.action_space.sample())
    assert task.actions == []
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    with pytest.raises(gym.error.ResetNeeded, match=r"Autoreset, goes around DelayedObservationWrapper"):
        env.step(env.action_space.sample())
    assert len(task.actions[-1]) == 3


def test_a_task_that_resets_itself_goes_below_and_is_told():
    below = DelayedObservationWrapper(Autoreset(LoggedTask(length=3)), 2)
    above = Autoreset(DelayedObservationWrapper(LoggedTask(length=3), 2))
    for env in (below, above):
        env.reset(seed=0)
        for _ in range(3):
            env.step(env.action_space.sample())
    assert above.step(above.action_space.sample())[0]["delay"] == 0
    with pytest.raises(gym.error.ResetNeeded, match="Autoreset"):
        below.step(below.action_space.sample())


@pytest.mark.parametrize("action", [np.float32([0.5]), 0.5, np.zeros((2, 1), np.float32)])
def test_an_action_of_another_shape_is_refused(action):
    env = DelayedObservationWrapper(LoggedTask(), 2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"The action has the shape .*, expected \(2,\)"):
        env.step(action)


@pytest.mark.parametrize("kwargs", [{}, {"max_delay": 8}])
def test_the_largest_delay_of_ones_own_process_is_a_whole_number(kwargs):
    process = SimpleNamespace(max_delay=4.0, sample=lambda rng: 2)
    with pytest.raises(ValueError, match=r"max_delay of namespace.* is a whole number >= 0, got 4\.0"):
        DelayedObservationWrapper(LoggedTask(), process, **kwargs)


def test_max_delay_below_the_delay_is_refused():
    with pytest.raises(ValueError, match="max_delay=3 is smaller than the largest delay 4"):
        DelayedObservationWrapper(LoggedTask(), (0, 4), max_delay=3)
    for bad in (4.5, "5", -1):
        with pytest.raises(ValueError, match=f"max_delay is a whole number >= 0, got {bad}"):
            DelayedObservationWrapper(LoggedTask(), 0, max_delay=bad)
    with pytest.raises(ValueError, match="max_delay is at most 10000, got 1000000000"):
        DelayedObservationWrapper(LoggedTask(), 0, max_delay=10**9)


def test_an_unknown_receiver_is_refused():
    with pytest.raises(ValueError, match=r"receiver is 'oldest', expected one of \('newest', 'independent'\)"):
        DelayedObservationWrapper(LoggedTask(), 2, receiver="oldest")


def test_fixed_process_equals_integer():
    assert DelayedObservationWrapper(LoggedTask(), 6).process == FixedDelay(6)
