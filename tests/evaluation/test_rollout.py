"""Rollouts: against a hand-written loop, independent of the number of environments, exact in what they count."""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

from sb3_said.evaluation import collect_observations, measure_latency, rollout

SEED = 1000


class Countdown(gym.Env):
    """Episodes of 1..30 steps, drawn at reset; the reward adds what the agent says, so returns tell agents apart."""

    made = 0
    closed = 0

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (2,))
        self.action_space = gym.spaces.Box(-1, 1, (1,))
        type(self).made += 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 31))
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.left -= 1
        return self._observe(), float(action[0]) + self.left, self.left == 0, False, {}

    def _observe(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def close(self) -> None:
        type(self).closed += 1


class AsDict(gym.ObservationWrapper):
    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.observation_space = gym.spaces.Dict(observation=env.observation_space)

    def observation(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        return {"observation": observation}


class Model:
    """Sums what it has seen in an episode, in its state: it notices when rows are mixed up or starts are missed."""

    def __init__(self) -> None:
        self.batches: list[int] = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        x = observation["observation"] if isinstance(observation, dict) else observation
        memory = np.zeros(len(x)) if state is None else state[0]
        assert memory.shape == episode_start.shape == (len(x),)
        memory = np.where(episode_start, 0.0, memory) + x[:, 0]
        self.batches.append(len(x))
        return np.tanh(memory)[:, None], (memory,)


def by_hand(n_episodes: int) -> tuple[list[float], list[int]]:
    returns, lengths = [], []
    for episode in range(n_episodes):
        env, total, memory, length = Countdown(), 0.0, 0.0, 0
        observation, _ = env.reset(seed=SEED + episode)
        done = False
        while not done:
            memory += float(observation[0])  # the model's memory is float64
            observation, reward, done, _, _ = env.step(np.array([np.tanh(memory)]))
            total, length = total + reward, length + 1
        returns.append(total)
        lengths.append(length)
    return returns, lengths


@pytest.mark.parametrize("n_envs", [1, 3, 8, 50])
@pytest.mark.parametrize("as_dict", [False, True])
def test_returns_are_those_of_a_loop_by_hand_whatever_the_number_of_environments(n_envs: int, as_dict: bool) -> None:
    model = Model()
    result = rollout(model, (lambda: AsDict(Countdown())) if as_dict else Countdown, 13, SEED, n_envs)
    returns, lengths = by_hand(13)
    np.testing.assert_allclose(result.returns, returns, rtol=1e-12)
    np.testing.assert_array_equal(result.lengths, lengths)
    # Every decision belongs to an episode that counts: no environment is stepped for nothing.
    assert sum(model.batches) == sum(lengths)
    assert max(model.batches) == min(n_envs, 13)
    assert result.successes is None and result.summary("x").successes is None  # of which the task says nothing


@pytest.mark.parametrize("n_envs", [1, 3])
def test_successes_are_those_of_each_episodes_end(n_envs: int) -> None:
    class Goal(Countdown):
        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
            *rest, done, truncated, _ = super().step(action)
            return *rest, done, truncated, {"is_success": np.bool_(done and self.is_even)}

        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
            made = super().reset(**kwargs)
            self.is_even = self.left % 2 == 0
            return made

    result = rollout(Model(), Goal, 13, SEED, n_envs)
    np.testing.assert_array_equal(result.successes, result.lengths % 2 == 0)
    assert result.summary("x").successes == np.sum(result.lengths % 2 == 0) > 0


class Waves(Countdown):
    """Five steps; the third entry of the answer is what the task makes of an end."""

    def __init__(self, falls: bool) -> None:
        super().__init__()
        self.action_space = gym.spaces.Box(np.array([-2, 0], np.float32), np.array([2, 10], np.float32))
        self.falls, self.t = falls, 0

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += 1
        return self._observe(), 0.0, self.falls and self.t == 5, self.t == 5, {}


@pytest.mark.parametrize("falls", [True, False])
def test_falls_and_rough_actions(falls: bool) -> None:
    class Alternates:
        t = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self.t += 1
            return np.tile([[(-1.0) ** self.t, 5.0 + self.t]], (len(observation), 1)), None

    result = rollout(Alternates(), lambda: Waves(falls), 3, SEED, n_envs=3)
    assert result.terminated.tolist() == [falls] * 3
    np.testing.assert_allclose(result.action_changes, (2 / 2 + 1 / 5) / 2)  # of half ranges 2 and 5


def test_a_model_may_write_its_answers_into_one_array() -> None:
    class Alternates:
        answers = np.zeros((1, 2))

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self.answers[0, 0] = 1.0 - self.answers[0, 0]
            return self.answers, None

    np.testing.assert_allclose(rollout(Alternates(), lambda: Waves(False), 1, SEED).action_changes, 1 / 2 / 2)


def test_how_rough_whole_numbers_are() -> None:
    class Counts(Waves):
        def __init__(self) -> None:
            super().__init__(falls=False)
            self.action_space = gym.spaces.Box(0, 10, (2,), np.uint8)

    class Alternates:
        t = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self.t += 1
            return np.array([[self.t % 2, 4]], np.uint8), None  # whose difference of 0 and 1 would be 255

    np.testing.assert_allclose(rollout(Alternates(), Counts, 1, SEED).action_changes, 1 / 5 / 2)


def test_below_wrappers_that_change_rewards_a_monitor_counts_the_tasks_own() -> None:
    made = [lambda: gym.wrappers.TransformReward(Countdown(), lambda _: 7.0)]
    made.append(lambda: gym.wrappers.TransformReward(Monitor(Countdown()), lambda _: 7.0))
    returns, lengths = by_hand(5)
    changed, own = (rollout(Model(), make_env, 5, SEED, 2).returns for make_env in made)
    np.testing.assert_allclose(changed, 7.0 * np.array(lengths))
    np.testing.assert_allclose(own, returns)


def test_a_monitor_counts_also_where_a_wrapper_above_it_ends_the_episode() -> None:
    def make(factor: float) -> gym.Env[Any, Any]:
        env = gym.wrappers.TransformReward(Monitor(Countdown()), lambda reward: factor * float(reward))
        return gym.wrappers.TimeLimit(env, 2)

    own, changed = (rollout(Model(), lambda factor=factor: make(factor), 5, SEED, 2) for factor in (1.0, 7.0))
    assert own.lengths.max() == 2 and own.returns.all()
    np.testing.assert_array_equal(changed.returns, own.returns)


@pytest.mark.parametrize("own", [7, {"level": 2}])
def test_what_a_task_itself_calls_its_episode_is_no_monitors(own: Any) -> None:
    class Named(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            *rest, info = super().step(action)
            return *rest, {**info, "episode": own}

    def make(wrap: Any) -> Any:
        return lambda: wrap(gym.make("Pendulum-v1", max_episode_steps=5))

    model = SimpleNamespace(predict=lambda observation, *_, **__: (np.zeros((len(observation), 1), np.float32), None))
    np.testing.assert_array_equal(
        rollout(model, make(Named), 2, 0).returns, rollout(model, make(lambda env: env), 2, 0).returns
    )


def test_an_episode_that_may_have_no_end_is_warned_of_once(monkeypatch: pytest.MonkeyPatch) -> None:
    _, lengths = by_hand(6)
    long = sorted(lengths)[-2]  # which ends right there, and one goes on
    monkeypatch.setattr(importlib.import_module("sb3_said.evaluation.rollout"), "LONG", long)
    with pytest.warns(UserWarning, match="not ended after .*max_episode_steps") as said:
        result = rollout(Model(), Countdown, 6, SEED, n_envs=2)
    assert result.lengths.tolist() == lengths
    assert [str(w.message).split()[1] for w in said] == [str(i) for i, n in enumerate(lengths) if n > long]
    assert len(said) == 1


def test_environments_that_are_done_leave_the_batch() -> None:
    model = Model()
    result = rollout(model, Countdown, 4, SEED, n_envs=4)
    still_playing = [int(np.sum(result.lengths > t)) for t in range(result.lengths.max())]
    assert model.batches == still_playing and model.batches[-1] < 4


def test_hooks_normalisation_and_closing() -> None:
    Countdown.made = Countdown.closed = 0
    steps, ends = [], []
    result = rollout(
        Model(), Countdown, 5, SEED, n_envs=2, normalize=lambda x: 0.0 * x, on_step=steps.append,
        on_episode=lambda *end: ends.append(end),
    )  # fmt: skip
    assert len(steps) == result.lengths.sum()
    assert sorted(ends) == [(i, result.returns[i], result.lengths[i]) for i in range(5)]
    # Zeroed observations silence the agent: only the countdown is left.
    np.testing.assert_allclose(result.returns, [n * (n - 1) / 2 for n in result.lengths])
    assert Countdown.made == Countdown.closed == 2


def test_a_model_of_normalised_observations_needs_their_scale() -> None:
    model = Model()
    model.reads_normalized = True
    with pytest.raises(ValueError, match=r"normalize=venv\.normalize_obs"):
        rollout(model, Countdown, 1, SEED)
    assert len(rollout(model, Countdown, 1, SEED, normalize=lambda x: x).returns) == 1


def test_one_environment_is_not_played_twice_at_once() -> None:
    env = Countdown()
    with pytest.raises(ValueError, match="env returned one environment twice"):
        rollout(Model(), lambda: env, 2, SEED, n_envs=2)
    with pytest.raises(ValueError, match="env returned one environment twice"):
        rollout(Model(), lambda: Monitor(env), 2, SEED, n_envs=2)
    assert len(rollout(Model(), lambda: env, 2, SEED).returns) == 2


def test_a_registered_task_by_its_id() -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import DummyVecEnv

    model = PPO("MlpPolicy", "CartPole-v1", seed=0, device="cpu")
    ours = rollout(model, "CartPole-v1", 3, SEED, n_envs=2)
    env = DummyVecEnv([lambda: gym.make("CartPole-v1")])
    for episode in range(3):
        env.seed(SEED + episode)
        theirs, lengths = evaluate_policy(model, env, 1, return_episode_rewards=True, warn=False)
        assert ours.returns[episode] == theirs[0] and ours.lengths[episode] == lengths[0]


@pytest.mark.parametrize(("n_episodes", "n_envs"), [(0, 1), (1, 0)])
def test_rollout_refuses_counts_below_one(n_episodes: int, n_envs: int) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        rollout(Model(), Countdown, n_episodes, SEED, n_envs)


@pytest.mark.parametrize("lost", [float("nan"), float("inf")])
def test_a_return_that_is_not_finite_is_refused_where_it_was_played(lost: float) -> None:
    lengths = rollout(Model(), Countdown, 4, SEED, 2).lengths
    shortest = int(np.argmin(lengths))

    class Lost(Countdown):
        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
            observation, info = super().reset(**kwargs)
            self.is_lost = self.left == lengths[shortest]
            return observation, info

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
            observation, reward, *ended = super().step(action)
            return observation, lost if self.is_lost else reward, *ended

    with pytest.raises(ValueError, match=rf"Episode {shortest} \(seed {SEED + shortest}\) returned {lost}"):
        rollout(Model(), Lost, 4, SEED, 2)


def test_recurrent_states_of_sb3_contrib_are_cut_along_their_second_axis() -> None:
    class Lstm(Model):
        class policy:
            lstm_actor = object()

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            action, (memory,) = super().predict(observation, state and (state[0][1],), episode_start)
            return action, (np.stack([0 * memory, memory]),)  # (n_layers=2, n_envs)

    result = rollout(Lstm(), Countdown, 7, SEED, n_envs=3)
    np.testing.assert_allclose(result.returns, by_hand(7)[0], rtol=1e-12)


def test_latency_counts_every_call_but_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)  # no time depends on the machine
    monkeypatch.setattr(importlib.import_module("sb3_said.evaluation.rollout"), "time", clock)

    class Slow(Model):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            clock.now += (0.5, 0.25, 0.125)[min(len(self.batches), 2)]  # warm-up, first measured call, the rest
            return super().predict(observation, state, episode_start)

    model = Slow()
    observations = collect_observations(lambda: AsDict(Countdown()), 7, seed=0)
    assert observations["observation"].shape == (7, 2)
    latency = measure_latency(model, observations, n_calls=20)
    assert latency.n_calls == 20 and model.batches == [1] * 21
    assert (latency.p50_ms, latency.p95_ms, latency.max_ms) == pytest.approx((125.0, 131.25, 250.0))
    with pytest.raises(ValueError, match="at least 1"):
        measure_latency(model, observations, n_calls=0)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_latency_is_of_all_observations_in_turn_and_of_the_draws_asked_for(deterministic: bool) -> None:
    asked: list[tuple[float, bool]] = []

    class Noting(Model):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            asked.append((float(observation[0, 0]), deterministic))
            return super().predict(observation, state, episode_start)

    measure_latency(Noting(), np.arange(6.0).reshape(3, 2), n_calls=7, deterministic=deterministic)
    assert asked[1:] == [(2.0 * (k % 3), deterministic) for k in range(7)]
    asked.clear()
    rollout(Noting(), Countdown, 2, SEED, deterministic=deterministic)
    assert {drawn for _, drawn in asked} == {deterministic}


def test_latency_counts_the_first_call_of_a_model_that_warms_up() -> None:
    class Warm(Model):
        ready = False

        def warmup(self) -> None:
            self.ready = True

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            assert self.ready
            return super().predict(observation, state, episode_start)

    model = Warm()
    observations = collect_observations(lambda: AsDict(Countdown()), 7, seed=0)
    latency = measure_latency(model, observations, n_calls=20)
    assert latency.n_calls == 20 and model.batches == [1] * 20


def test_a_latency_is_of_normalised_observations_of_one_episode():
    asked = []

    class Noting(Model):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            asked.append((float(observation[0, 0]), state is None, episode_start.tolist()))
            return super().predict(observation, state, episode_start)

    measure_latency(Noting(), np.ones((3, 2)), n_calls=3, normalize=lambda observation: 5.0 * observation)
    assert asked == [(5.0, True, [True])] + [(5.0, False, [False])] * 3


def test_observations_repeat_with_their_seed():
    first, again, other = (collect_observations("Pendulum-v1", 20, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])


def test_how_rough_actions_without_bounds_are():
    class Boundless(Waves):
        def __init__(self) -> None:
            super().__init__(falls=False)
            self.action_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    class Alternates:
        t = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            self.t += 1
            return np.array([[self.t % 2, 4.0]]), None

    np.testing.assert_allclose(rollout(Alternates(), Boundless, 1, SEED).action_changes, 1 / 2)  # in their own units
