"""Checkpoints: a run that was killed goes on from one as if from a save in a game."""

import copy
import errno
import random
import shutil
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from kill import Kill, Killed
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.files import checkpoint
from sb3_said.files.archive import SavedFileError, load_tree, save_tree
from sb3_said.files.checkpoint import (
    CHECKPOINT_NAME,
    TrainingCheckpointCallback,
    checksum,
    restore_training,
    training_state,
)
from sb3_said.files.random_states import random_state, restore_random_state

PLANNER = {"d_model": 32, "depth": 1, "horizon": 3, "batch_size": 16, "sampling_steps": 2, "n_candidates": 3}


def delayed():
    return DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=15), 2)


def normalized(n_envs=2):
    return VecNormalize(make_vec_env(delayed, n_envs=n_envs, seed=0), norm_obs_keys=["observation"])


def make(env=None, cls=DelayedSAC, **kwargs):
    arguments = {"learning_starts": 30, "batch_size": 16, "buffer_size": 300, "seed": 0, "device": "cpu"}
    if cls is SAID:
        arguments |= {"planner_kwargs": PLANNER, "planner_gradient_steps": 4, "planner_train_freq": 20}
        arguments["planner_trial_episodes"] = 4
    env = delayed() if env is None else env
    return cls("MlpPolicy", env, **(arguments | {"policy_kwargs": {"net_arch": [16]}} | kwargs))


collecting = partial(make, learning_starts=1000)  # makes no update


def evaluation(folder, env=None):
    env = Monitor(delayed()) if env is None else env
    return EvalCallback(env, eval_freq=20, n_eval_episodes=2, log_path=str(folder / "evaluations"), verbose=0)


def run_and_kill(model, folder, at=52, save_freq=50, callbacks=()):
    with pytest.raises(Killed):
        model.learn(100, [*callbacks, TrainingCheckpointCallback(folder, save_freq), Kill(at)])
    return folder / CHECKPOINT_NAME


def everything(model):
    """Return what decides how a run goes on, copied."""
    state = training_state(model)
    del state["random"]
    return copy.deepcopy(state)


def assert_same(first, second):
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    elif isinstance(first, (np.ndarray, th.Tensor)):
        np.testing.assert_array_equal(np.asarray(first), np.asarray(second))
    else:
        assert first == second


@pytest.fixture(scope="module")
def path_of_a_run(tmp_path_factory):
    """The checkpoint of a run, which tests leave as it is; ``path`` is a copy."""
    return run_and_kill(make(), tmp_path_factory.mktemp("run"))


@pytest.fixture
def path(path_of_a_run, tmp_path):
    return shutil.copy(path_of_a_run, tmp_path / CHECKPOINT_NAME)


# ---------------------------------------------------------------------------------------------------- resuming


@pytest.mark.parametrize(
    ("make_env", "kwargs"),
    [
        (delayed, {}),
        (normalized, {"ent_coef": 0.2, "gradient_steps": 2}),
        (lambda: gym.make("Pendulum-v1", max_episode_steps=15), {"use_sde": True}),
        (delayed, {"cls": SAID}),
        (normalized, {"cls": SAID, "buffer_size": 40}),
    ],
    ids=["DelayedSAC", "VecNormalize", "gSDE, plain", "SAID", "SAID, VecNormalize, full buffer"],
)
def test_two_resumes_from_one_checkpoint_are_the_same(make_env, kwargs, tmp_path):
    path = run_and_kill(make(make_env(), **kwargs), tmp_path)
    ends = []
    for noise in (1, 2):
        model = make(make_env(), **kwargs)
        np.random.seed(noise), th.manual_seed(noise), random.seed(noise)
        restore_training(model, path)
        assert model.num_timesteps == 50
        model.learn(30, reset_num_timesteps=False)
        assert model.num_timesteps == 80 and model._total_timesteps == 80
        ends.append((model, everything(model)))
    assert_same(ends[0][1], ends[1][1])
    assert ends[0][1]["counters"]["_n_updates"] > 0


def test_a_checkpoint_holds_the_whole_run(tmp_path):
    model, callback = make(normalized()), evaluation(tmp_path, normalized(1))
    path = run_and_kill(model, tmp_path, at=72, save_freq=70, callbacks=[callback])  # killed one step later
    resumed, callback_again = make(normalized(), seed=9), evaluation(tmp_path, normalized(1))
    before = everything(resumed)
    restore_training(resumed, path, CallbackList([callback_again, TrainingCheckpointCallback(tmp_path, 70)]))
    state = load_tree(path)
    after = everything(resumed)
    for part in ("parameters", "variables", "counters", "replay_buffer", "vec_normalize"):
        assert_same(after[part], state[part])
        with pytest.raises(AssertionError):  # it was another model before
            assert_same(before[part], state[part])
    optimizer = resumed.actor.optimizer.state_dict()["state"]
    assert optimizer[0]["step"] == resumed._n_updates == 20  # a rollout is a step of two environments
    assert callback_again.evaluations_timesteps == callback.evaluations_timesteps == [40]
    assert_same(callback_again.evaluations_results, callback.evaluations_results)
    assert callback_again.best_mean_reward == callback.best_mean_reward > -np.inf
    assert callback_again.n_calls == 35
    python, numpy, torch = random.random(), np.random.rand(), th.rand(1)
    restore_random_state(state["random"])
    assert (python, numpy, torch) == (random.random(), np.random.rand(), th.rand(1))


def test_a_run_that_was_stopped_at_once_has_no_checkpoint_before_it_is_written(tmp_path):
    callback = TrainingCheckpointCallback(tmp_path, should_stop=lambda: True)
    with pytest.raises(KeyboardInterrupt):
        make().learn(100, callback)
    assert not callback.path.exists()
    assert callback.save() and callback.path.exists()


@pytest.mark.parametrize("name", ["observations", "actions", "rewards", "dones", "timeouts"])
def test_any_number_of_a_replay_tells_it_from_another(name):
    model = collecting().learn(40)
    before, column = checksum(model), getattr(model.replay_buffer, name)
    kept = column[39].copy()
    column[39] = 1 - kept
    assert checksum(model) != before
    column[39] = kept
    column[40:] = 7  # what is not stored yet
    assert checksum(model) == before


def test_the_last_states_of_episodes_tell_replays_apart():
    """Values of what a time limit cut off are learned from them."""
    model = collecting().learn(40)
    before, tails = checksum(model), model.replay_buffer.tails
    place, (state, age) = next(iter(tails.items()))
    tails[place] = state + 1, age
    assert checksum(model) != before
    tails[place] = state, age
    assert checksum(model) == before
    model.replay_buffer._next_states += 1
    assert checksum(model) != before


def test_a_resumed_environment_starts_a_new_episode(path_of_a_run):
    first, starts = load_tree(path_of_a_run)["replay_buffer"]["observations"][0, 0], []
    for seed in (0, 0, 1):
        resumed = make(seed=seed)
        restore_training(resumed, path_of_a_run)
        resumed.learn(2, reset_num_timesteps=False)
        buffer = resumed.replay_buffer
        assert buffer.steps[50, 0] == 0 and buffer.steps[51, 0] == 1
        starts.append(buffer.observations[50, 0])
    assert np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0], starts[2]) and not np.array_equal(starts[0], first)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_resumed_environment_meets_no_episode_of_another_use(tmp_path, n_envs):
    """Evaluation takes the seeds from 10000 on and tuning those from 20000 on: small numbers, as a user's own are."""
    path, seeds = run_and_kill(collecting(make_vec_env(delayed, n_envs=n_envs), seed=1), tmp_path), []
    for seed, steps in ((1, 50), (1, 50), (1, 9999), (51, 50), (50, 51)):
        state = load_tree(path)
        state["counters"]["num_timesteps"] = steps
        save_tree(path, state)
        resumed = make(make_vec_env(delayed, n_envs=n_envs), seed=seed)
        restore_training(resumed, path)
        seeds.append(tuple(resumed.env._seeds))
    assert seeds[0] == seeds[1] and len(set(seeds)) == 4
    assert all(2**30 <= seed < 2**32 for each in seeds for seed in each)


def test_a_resume_amid_the_random_actions_repeats_none(tmp_path):
    model = make(learning_starts=90)
    path = run_and_kill(model, tmp_path)
    resumed = make(learning_starts=90)
    restore_training(resumed, path)
    resumed.learn(30, reset_num_timesteps=False)
    actions = resumed.replay_buffer.actions[:80].ravel()
    assert len(np.unique(actions)) == 80


def test_a_resume_starts_a_new_episode_in_a_model_that_was_amid_one(path_of_a_run):
    fresh, used = make(), make().learn(50)
    for model in (fresh, used):
        restore_training(model, path_of_a_run)
        model.learn(10, reset_num_timesteps=False)
    assert_same(everything(fresh), everything(used))


def test_a_resume_after_a_callback_has_ended_training_joins_no_two_episodes(tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 40

    collecting().learn(100, [TrainingCheckpointCallback(tmp_path, 1000), Stop()])
    model = collecting()
    restore_training(model, tmp_path / CHECKPOINT_NAME)
    buffer = model.replay_buffer
    assert (model.num_timesteps, buffer.size()) == (40, 39)  # SB3 does not store the last
    model.learn(20, reset_num_timesteps=False)
    assert buffer.steps[:59, 0].tolist() == [*range(15), *range(15), *range(9), *range(15), *range(5)]


# ---------------------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize(("n_envs", "save_freq", "expected"), [(1, 30, [30, 60, 90, 100]), (3, 30, [30, 60, 90, 102])])
def test_when_checkpoints_are_written(tmp_path, monkeypatch, n_envs, save_freq, expected):
    written = []

    def save(path, state, metadata):
        written.append((path, state["counters"]))
        save_tree(path, state, metadata)

    monkeypatch.setattr(checkpoint, "save_tree", save)
    model = collecting(make_vec_env(delayed, n_envs=n_envs)).learn(100, TrainingCheckpointCallback(tmp_path, save_freq))
    assert [counters["num_timesteps"] for _, counters in written] == expected
    assert {path for path, _ in written} == {tmp_path / CHECKPOINT_NAME}
    model.learn(0, TrainingCheckpointCallback(tmp_path, save_freq), reset_num_timesteps=False)
    assert len(written) == len(expected)  # nothing new


def test_checkpoints_are_spread_by_time_and_size(tmp_path, monkeypatch):
    """Ten minutes apart, and 2,000 s apart once the file has a gigabyte."""
    written, now, size = [], [0.0], [10]

    def save(path, state, _):
        written.append(now[0])
        with open(path, "wb") as file:
            file.truncate(size[0])

    class Clock(BaseCallback):
        def _on_step(self):
            now[0] += 100.0
            size[0] = 10**9 if now[0] > 1500 else 10
            return True

    monkeypatch.setattr(checkpoint, "save_tree", save)
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    collecting().learn(60, [Clock(), TrainingCheckpointCallback(tmp_path)])
    assert written == [600, 1200, 1800, 3800, 5800, 6000]


def test_a_stop_is_granted_before_a_rollout(tmp_path):
    callback = TrainingCheckpointCallback(tmp_path, should_stop=lambda: model.num_timesteps >= 40)
    model = make()
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback)
    assert callback.save()
    counters = load_tree(tmp_path / CHECKPOINT_NAME)["counters"]
    assert (counters["num_timesteps"], counters["_n_updates"]) == (40, 10)


def test_a_full_disk_ends_no_training(path, tmp_path, monkeypatch):
    before, original, full = path.read_bytes(), checkpoint.save_tree, [True]

    def save(path, state, _):
        if full.pop() if full else False:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        original(path, state)

    monkeypatch.setattr(checkpoint, "save_tree", save)
    model = collecting()
    callback = TrainingCheckpointCallback(tmp_path, 60)
    with pytest.warns(UserWarning, match=r"could not be written to .*checkpoint.zip .*No space left on device"):
        model.learn(61, callback)  # at 60 the disk is full, at the end there is room again
    assert path.read_bytes() != before and load_tree(path)["counters"]["num_timesteps"] == 61
    full.append(True)
    model.num_timesteps = 62
    with pytest.warns(UserWarning, match="step 62 could not be written"):
        assert not callback.save()
    assert callback.save()


@pytest.mark.parametrize(
    ("where", "spoil"),
    [
        ("replay_buffer.*rewards", lambda model: model.replay_buffer.rewards.__setitem__((3, 0), np.nan)),
        ("replay_buffer.*observations", lambda model: model.replay_buffer.observations.__setitem__((3, 0, 1), np.inf)),
        ("parameters.*actor.mu", lambda model: model.actor.mu.weight.data.fill_(np.nan)),
        ("vec_normalize.*obs/observation", lambda model: model.env.obs_rms["observation"].mean.fill(np.nan)),
    ],
)
def test_no_checkpoint_is_written_that_nothing_could_go_on_from(where, spoil, forgeable, tmp_path):
    path = shutil.copy(forgeable, tmp_path / CHECKPOINT_NAME)
    before = path.read_bytes()
    model, callback = make(normalized(1)), TrainingCheckpointCallback(tmp_path, 1000)
    callback.init_callback(model)
    model.learn(30)
    spoil(model)
    with pytest.raises(ValueError, match=f"{where}.* is not finite. No checkpoint is written of it"):
        callback.save()
    assert path.read_bytes() == before
    restore_training(make(normalized(1)), path, evaluation(tmp_path))


def test_a_checkpoint_has_every_step_and_its_updates(tmp_path):
    make().learn(40, TrainingCheckpointCallback(tmp_path, 25))
    state = load_tree(tmp_path / CHECKPOINT_NAME)
    assert len(state["replay_buffer"]["rewards"]) == state["counters"]["num_timesteps"] == 40
    assert state["counters"]["_n_updates"] == 10


def test_being_killed_while_writing_leaves_the_last_checkpoint(path, tmp_path, monkeypatch):
    before = path.read_bytes()

    def killed(*_, **__):
        raise Killed

    monkeypatch.setattr("numpy.lib.format.write_array", killed)
    run_and_kill(make(), tmp_path, at=99, save_freq=20)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_evaluations_are_found_behind_a_progress_bar(tmp_path):
    pytest.importorskip("rich")
    callbacks = [evaluation(tmp_path), TrainingCheckpointCallback(tmp_path, 30)]
    make().learn(50, callbacks, progress_bar=True)  # puts the list into another
    again = [evaluation(tmp_path), TrainingCheckpointCallback(tmp_path, 30)]
    restore_training(make(), tmp_path / CHECKPOINT_NAME, CallbackList([CallbackList(again)]))
    assert again[0].evaluations_timesteps == [20, 40]


def test_a_checkpoint_of_another_run_is_not_taken_for_this_one_s(path, tmp_path):
    run_and_kill(make(seed=7), tmp_path, at=30, save_freq=1000)
    assert load_tree(path)["counters"]["num_timesteps"] == 0


def test_nor_is_it_for_one_that_has_learned_before(path, tmp_path):
    mine = make(seed=7).learn(40)
    with pytest.raises(Killed):
        mine.learn(60, [TrainingCheckpointCallback(tmp_path, 1000), Kill(45)], reset_num_timesteps=False)
    again = make(seed=7)
    restore_training(again, path)
    assert again.num_timesteps == 40
    kept = path.read_bytes()
    with pytest.raises(Killed):  # and what it was restored from is not written again
        again.learn(60, [TrainingCheckpointCallback(tmp_path, 1000), Kill(45)], reset_num_timesteps=False)
    assert path.read_bytes() == kept


def test_the_patience_of_a_run_goes_on(tmp_path):
    def callbacks(folder):
        task = DummyVecEnv([lambda: Monitor(gym.wrappers.TransformReward(delayed(), lambda reward: 1.0))])
        stop = StopTrainingOnNoModelImprovement(3, 0)
        evaluated = EvalCallback(task, callback_after_eval=stop, eval_freq=20, n_eval_episodes=1, verbose=0)
        return [evaluated, TrainingCheckpointCallback(folder)]

    whole = collecting().learn(1000, callbacks(tmp_path))
    collecting().learn(75, callbacks(tmp_path / "parts"))
    again, others = collecting(), callbacks(tmp_path / "parts")
    restore_training(again, tmp_path / "parts" / CHECKPOINT_NAME, CallbackList(others))
    again.learn(925, others, reset_num_timesteps=False)
    assert again.num_timesteps == whole.num_timesteps == 100


@pytest.mark.parametrize("is_late", [False, True])  # told from the second evaluation on, as of a goal that is reached
def test_successes_go_on_where_they_were(is_late, tmp_path):
    class Told(gym.Wrapper):
        n_resets = 0

        def reset(self, **kwargs):
            self.n_resets += 1
            return super().reset(**kwargs)

        def step(self, action):
            *others, info = super().step(action)
            is_told = not is_late or self.n_resets > 3
            return *others, {**info, "is_success": bool(action[0] > 0)} if is_told else info

    def evaluated():
        return EvalCallback(Monitor(Told(delayed())), eval_freq=20, n_eval_episodes=2, log_path=tmp_path, verbose=0)

    before, after = evaluated(), evaluated()
    model = collecting().learn(50, [before, TrainingCheckpointCallback(tmp_path, 30)])
    restore_training(model, tmp_path / CHECKPOINT_NAME, CallbackList([after, TrainingCheckpointCallback(tmp_path)]))
    assert after.evaluations_successes == before.evaluations_successes != []
    assert (len(before.evaluations_successes) < len(before.evaluations_results)) == is_late
    if is_late:
        return  # SB3's own file holds as many of both
    model.learn(30, [after], reset_num_timesteps=False)
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["successes"].shape == (len(saved["timesteps"]), 2) == (4, 2)


def test_evaluations_within_another_event_go_on_as_well(tmp_path):
    def evaluated():
        often = EvalCallback(Monitor(delayed()), eval_freq=1, n_eval_episodes=1, log_path=tmp_path, verbose=0)
        return often, EveryNTimesteps(20, often)

    (before, event), (after, other) = evaluated(), evaluated()
    model = collecting().learn(50, [event, TrainingCheckpointCallback(tmp_path, 30)])
    restore_training(model, tmp_path / CHECKPOINT_NAME, CallbackList([other, TrainingCheckpointCallback(tmp_path)]))
    assert after.evaluations_timesteps == before.evaluations_timesteps != []
    assert after.best_mean_reward == before.best_mean_reward


# ---------------------------------------------------------------------------------------------------- misfits


def test_the_planner_may_change_until_it_is_trained(tmp_path):
    path = run_and_kill(make(cls=SAID, planner_train_freq=None), tmp_path)
    model = make(cls=SAID, planner_train_freq=None, planner_kwargs={**PLANNER, "depth": 2})
    restore_training(model, path)
    assert model.learn(20, reset_num_timesteps=False).policy.planner_updates == 4
    other = run_and_kill(make(cls=SAID, planner_train_freq=40), tmp_path / "other")
    with pytest.raises(ValueError, match="'policy' does not fit"):
        restore_training(make(cls=SAID, planner_kwargs={**PLANNER, "depth": 2}), other)


@pytest.mark.parametrize(
    ("run", "resumed", "message"),
    [
        (collecting, lambda: make(buffer_size=40), "does not fit a buffer"),
        (collecting, lambda: make(policy_kwargs={"net_arch": [8]}), "'policy' does not fit: actor"),
        (collecting, lambda: make(ent_coef=0.1), "unknown .'ent_coef_optimizer'"),
        (
            collecting,
            lambda: make(normalized(1)),
            "normalised nothing, in this model's environment return, obs/observation;",
        ),
        (
            lambda: collecting(normalized(1)),
            make,
            "normalised return, obs/observation, in this model's environment nothing;",
        ),
        (collecting, lambda: make(cls=SAID), "'counters' does not fit: it lacks .'_planner_trained_at'"),
    ],
)
def test_another_runs_checkpoint_is_refused(run, resumed, message, tmp_path):
    path = run_and_kill(run(), tmp_path)
    with pytest.raises(ValueError, match=message):
        restore_training(resumed(), path)


def test_evaluations_must_be_those_of_the_run(tmp_path):
    path = run_and_kill(collecting(), tmp_path, callbacks=[evaluation(tmp_path)])
    with pytest.raises(ValueError, match=r"had 1 EvalCallback and is resumed with 0"):
        restore_training(make(), path)
    longer = evaluation(tmp_path)
    longer.n_eval_episodes = 3
    with pytest.raises(ValueError, match=r"are of 2 episodes and it is resumed with 3; resume with as many"):
        restore_training(make(), path, longer)
    assert longer.evaluations_results == []


def test_a_replay_that_an_agent_begins_with_is_kept_at_once(tmp_path):
    collecting().learn(60).save_replay_buffer(tmp_path / "replay_buffer.pkl")
    model = make()
    model.load_replay_buffer(tmp_path / "replay_buffer.pkl")
    path = run_and_kill(model, tmp_path, at=1)
    resumed = make()
    restore_training(resumed, path)
    assert resumed.num_timesteps == 0 and resumed.replay_buffer.size() == 60


def test_other_replay_buffers_are_refused():
    model = make()
    model.replay_buffer = SAC("MlpPolicy", "Pendulum-v1", buffer_size=100, device="cpu").replay_buffer
    with pytest.raises(ValueError, match="such as DelayedReplayBuffer, got ReplayBuffer"):
        training_state(model)


@pytest.fixture(scope="module")
def forgeable(tmp_path_factory):
    """The checkpoint of a run whose statistics and evaluations are in it, too."""
    folder = tmp_path_factory.mktemp("forgeable")
    return run_and_kill(make(normalized(1)), folder, callbacks=[evaluation(folder, normalized(1))])


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("random", "numpy", 2), 2**31),  # NumPy reads memory that is not its own there
        (("random", "numpy", 2), -1),
        (("random", "numpy", 0), "PCG64"),
        (("random", "torch"), th.zeros(3, dtype=th.uint8)),
        (("random", "python"), (3, (1, 2), None)),
        (("counters", "num_timesteps"), "50"),
        (("counters", "trained_ages"), [1, "2"]),
        (("counters", "learn"), 1),
        (("variables", "log_ent_coef"), th.full((1,), th.nan)),
        (("parameters", "policy", "actor.mu.bias"), th.zeros(1, dtype=th.float64)),
        (("parameters", "actor.optimizer", 0, "exp_avg"), th.zeros(7)),
        (("parameters", "actor.optimizer", 99), {}),
        (("replay_buffer", "rewards"), 3),
        (("replay_buffer", "ages"), np.full((50, 1), 100, np.int16)),
        (("vec_normalize", "return"), 1),
        (("vec_normalize", "return", 0), np.array(np.nan)),
        (("vec_normalize", "return", 1), np.array(-1.0)),
        (("vec_normalize", "obs/observation", 0), np.zeros(7)),
        (("vec_normalize", "obs/observation", 2), float("inf")),
        (("evaluations",), [{}]),
        (("evaluations", 0, "n_calls"), "3"),
        (("evaluations", 0, "best_mean_reward"), float("nan")),
        (("evaluations", 0, "evaluations_results"), [["a"]]),
        (("evaluations", 0, "evaluations_timesteps"), [1, 2, 3]),
        (("evaluations", 0, "evaluations_successes"), [[True]] * 9),
        (("evaluations", 0, "evaluations_successes"), "a"),
        (("random", "python", 2), float("nan")),
        (("random", "python", 2), "a"),
        (("random", "numpy", 4), float("inf")),
        (("random", "numpy", 2), 10**9),  # once a segmentation fault
    ],
    ids=str,
)
def test_forged_checkpoints_are_refused(place, value, forgeable, tmp_path):
    path, state = tmp_path / "checkpoint.zip", load_tree(forgeable)
    *folders, last = place
    part = state
    for key in folders:
        part = part[key]
    if isinstance(part, tuple):
        above = state["random"]
        above[folders[-1]] = (*part[:last], value, *part[last + 1 :])
    else:
        part[last] = value
    save_tree(path, state)
    model, kept = make(normalized(1)), random_state()
    before = everything(model)
    with pytest.raises(SavedFileError, match="Cannot load"):
        restore_training(model, path, evaluation(tmp_path, normalized(1)))
    assert_same(random_state(), kept)
    if folders[:1] != ["replay_buffer"]:  # which is taken over after the agent
        assert_same(everything(model), before)
