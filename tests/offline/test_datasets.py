"""Every source gives the same trajectories, and what is no log of the task is refused with its row."""

import warnings
from dataclasses import replace

import gymnasium as gym
import h5py
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from small_task import delayed
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from tqdm.auto import tqdm

from sb3_said.delays.space import delayed_space
from sb3_said.offline import Dataset, load_dataset, sources, write_dataset

STATES = spaces.Box(-np.inf, np.inf, (3,), np.float32)
ACTIONS = spaces.Box(np.float32([-2.0, 0.0]), np.float32([2.0, 1.0]))


def make_log(lengths=(5, 1, 7), terminated=(True, False, False), seed=0):
    """Return columns with next observations; actions in the task's own units."""
    rng = np.random.default_rng(seed)
    columns = {key: [] for key in ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")}
    for length, is_terminal in zip(lengths, terminated, strict=True):
        states = rng.normal(size=(length + 1, 3)).astype(np.float32)
        last = np.arange(length) == length - 1
        columns["observations"].append(states[:-1])
        columns["next_observations"].append(states[1:])
        columns["actions"].append(rng.uniform(ACTIONS.low, ACTIONS.high, (length, 2)).astype(np.float32))
        columns["rewards"].append(rng.normal(size=length).astype(np.float32))
        columns["terminals"].append(last & is_terminal)
        columns["timeouts"].append(last & (not is_terminal))
    return {key: np.concatenate(parts) for key, parts in columns.items()}


def scale(actions):
    """Map [-2, 2] and [0, 1] to [-1, 1]."""
    return actions * np.float32([0.5, 2.0]) - np.float32([0.0, 1.0])


def load(source, **kwargs):
    return load_dataset(source, STATES, ACTIONS, **kwargs)


def same(first, second):
    for name in ("states", "actions", "rewards", "terminated", "ends", "finals"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=0, atol=1e-6, err_msg=name)


@pytest.fixture
def log():
    return make_log()


def write(path, columns):
    if path.suffix == ".npz":
        np.savez_compressed(path, **columns)
    else:
        with h5py.File(path, "w") as file:
            for key, value in columns.items():
                file[key] = value
            file["metadata/algorithm"] = "none"  # D4RL's files hold groups, too
    return path


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
def test_a_file_keeps_ends_and_terminal_states_apart(suffix, log, tmp_path):
    data = load(write(tmp_path / f"log{suffix}", log))
    assert data.lengths.tolist() == [5, 1, 7]
    assert data.terminated.nonzero()[0].tolist() == [4]
    np.testing.assert_array_equal(data.states, log["observations"])
    np.testing.assert_allclose(data.actions, scale(log["actions"]), atol=1e-6)
    np.testing.assert_array_equal(data.finals, log["next_observations"][[4, 5, 12]])
    np.testing.assert_allclose(data.returns, [log["rewards"][:5].sum(), log["rewards"][5], log["rewards"][6:].sum()])


def test_without_next_observations_a_time_limit_costs_its_last_step(log, tmp_path):
    del log["next_observations"]
    data = load(write(tmp_path / "log.npz", log))
    assert data.lengths.tolist() == [5, 6] and data.terminated.nonzero()[0].tolist() == [4]
    np.testing.assert_array_equal(data.finals[1], log["observations"][12])  # its own last state ends it
    np.testing.assert_array_equal(data.finals[0], log["observations"][4])  # what followed the terminal step is unknown
    np.testing.assert_array_equal(data.states, np.delete(log["observations"], [5, 12], axis=0))


@pytest.mark.parametrize("rounded", [False, True])
def test_with_next_observations_time_limits_need_not_be_told(rounded, log, tmp_path):
    """As in what ``d4rl.qlearning_dataset`` returns."""
    whole = load(write(tmp_path / "whole.npz", log))
    del log["timeouts"]
    if rounded:
        log["next_observations"] = log["next_observations"] + 1e-5
    same(load(write(tmp_path / "log.npz", log)), replace(whole, finals=whole.finals + 1e-5 * rounded))


@pytest.mark.parametrize(("unit", "offset"), [(1e-6, 0.0), (1e-4, 1.0), (1e6, 0.0), (0.1, 1000.0)])
def test_episodes_are_told_apart_in_any_unit(unit, offset, log, tmp_path):
    whole = load(write(tmp_path / "whole.npz", log))
    del log["timeouts"]
    for name in ("observations", "next_observations"):
        log[name] = (unit * log[name] + offset).astype(np.float32)
    found = load(write(tmp_path / "log.npz", log))
    assert found.lengths.tolist() == whole.lengths.tolist() and len(whole.lengths) > 1


def test_other_names_mean_the_same(log, tmp_path):
    renamed = dict(
        zip(("obs", "actions", "rewards", "terminations", "truncations", "next_obs"), log.values(), strict=True)
    )
    same(load(write(tmp_path / "a.npz", log)), load(write(tmp_path / "b.npz", renamed)))


@pytest.mark.parametrize("delay", [0, 2])
def test_a_replay_gives_back_what_it_was_filled_with(delay, log, tmp_path):
    data = load(write(tmp_path / "log.npz", log))
    space = delayed_space(STATES, ACTIONS, delay) if delay else STATES
    buffer = data.to_replay(space, ACTIONS)
    same(load(buffer), data)
    source = buffer.window_source()
    assert sorted(source.remaining.tolist()) == sorted([*range(1, 6), 1, *range(1, 8)])
    np.testing.assert_array_equal(source.start_states().numpy(), data.states)


def test_a_replay_samples_what_followed_each_step(log, tmp_path):
    data = load(write(tmp_path / "log.npz", log))
    buffer = data.to_replay(delayed_space(STATES, ACTIONS, 2), ACTIONS, lambda n: np.minimum(np.arange(n + 1), 2))
    followed = {
        x.tobytes(): (y, d)
        for x, y, d in zip(log["observations"], log["next_observations"], log["terminals"], strict=True)
    }
    where = {x.tobytes(): i for i, x in enumerate(log["observations"])}
    batch = buffer.sample(200)
    starts = np.repeat([0, 5, 6], data.lengths)
    for i, state in enumerate(batch.observations["undelayed_observation"].cpu().numpy()):
        next_state, is_terminal = followed[state.tobytes()]
        np.testing.assert_array_equal(batch.next_observations["undelayed_observation"][i].cpu(), next_state)
        assert bool(batch.dones[i]) == is_terminal
        row = where[state.tobytes()]
        age = min(row - starts[row], 2)
        assert batch.observations["delay"][i] == age
        np.testing.assert_array_equal(batch.observations["observation"][i].cpu(), log["observations"][row - age])
        assert batch.next_observations["delay"][i] == min(row - starts[row] + 1, 2)


@pytest.mark.parametrize("delay", [1, 4])
def test_a_replay_samples_every_step_and_has_every_window(delay, log, tmp_path):
    """The first ones, too: nothing before them has been overwritten."""
    data = load(write(tmp_path / "log.npz", log))
    buffer = data.to_replay(delayed_space(STATES, ACTIONS, delay), ACTIONS)
    sampled = {x.tobytes() for x in buffer.sample(500).observations["undelayed_observation"].cpu().numpy()}
    assert sampled == {x.tobytes() for x in data.states}
    source = buffer.window_source()
    assert source.start_states().numpy().tobytes() == data.states.tobytes()
    windows = source.gather(source.rows, 9)
    assert windows.valid.sum(1).tolist() == source.remaining.tolist() == [*range(5, 0, -1), 1, *range(7, 0, -1)]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 6), st.booleans()), min_size=1, max_size=6), st.integers(0, 3))
def test_any_trajectories_survive_the_replay(trajectories, delay):
    lengths, terminated = zip(*trajectories, strict=True)
    columns = make_log(lengths, terminated)
    ends = columns["terminals"] | columns["timeouts"]
    data = Dataset(
        columns["observations"],
        scale(columns["actions"]),
        columns["rewards"],
        columns["terminals"],
        ends,
        columns["next_observations"][ends],
    )
    space = delayed_space(STATES, ACTIONS, delay) if delay else STATES
    same(load(data.to_replay(space, ACTIONS)), data)


@pytest.mark.parametrize("n_added", [6, 20], ids=["filling", "wrapped"])
def test_a_buffer_of_sb3_is_read_oldest_first(n_added):
    log, rng = make_log((9, 11), (True, False)), np.random.default_rng(0)
    buffer = ReplayBuffer(28, STATES, ACTIONS, n_envs=2, device="cpu")  # 14 steps of each environment
    other = rng.normal(size=(21, 3)).astype(np.float32)
    scaled = scale(log["actions"])
    for i in range(n_added):
        done = np.array([log["terminals"][i] or log["timeouts"][i], False])
        infos = [{"TimeLimit.truncated": bool(log["timeouts"][i])}, {}]
        obs = np.stack([log["observations"][i], other[i]])
        next_obs = np.stack([log["next_observations"][i], other[i + 1]])
        buffer.add(obs, next_obs, np.stack([scaled[i]] * 2), np.full(2, log["rewards"][i]), done, infos)
    data, first = load(buffer), max(0, n_added - 14)
    n = n_added - first
    assert len(data) == 2 * n
    np.testing.assert_array_equal(
        data.states, np.concatenate([log["observations"][first:n_added], other[first:n_added]])
    )
    np.testing.assert_allclose(data.actions[:n], scaled[first:n_added], atol=1e-6)
    expected = (log["terminals"] | log["timeouts"])[first:n_added]
    expected[-1] = True
    assert (
        data.ends[:n].tolist() == expected.tolist()
        and data.terminated[:n].tolist() == log["terminals"][first:n_added].tolist()
    )


def test_a_minari_dataset_is_read_by_its_id(log, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes, start = [], 0
    for i, length in enumerate((5, 1, 7)):
        rows = slice(start, start + length)
        start += length
        states = np.concatenate([log["observations"][rows], log["next_observations"][rows][-1:]])
        episodes.append(
            EpisodeBuffer(
                id=i,
                seed=0,
                observations=states,
                actions=log["actions"][rows],
                rewards=list(log["rewards"][rows]),
                terminations=list(log["terminals"][rows]),
                truncations=list(log["timeouts"][rows]),
            )
        )
    minari.create_dataset_from_buffers(
        "test/log-v0", episodes, observation_space=STATES, action_space=ACTIONS, env="Pendulum-v1"
    )
    same(load("test/log-v0"), load(write(tmp_path / "log.npz", log)))
    episodes[2].rewards[3] = np.nan
    minari.create_dataset_from_buffers(
        "test/broken-v0", episodes, observation_space=STATES, action_space=ACTIONS, env="Pendulum-v1"
    )
    with pytest.raises(ValueError, match="Row 3 of episode 2 of test/broken-v0: rewards must be finite"):
        load("test/broken-v0")
    with pytest.raises(ValueError, match="Row 3 of episode 2 of test/broken-v0"):  # its own number
        load(minari.load_dataset("test/broken-v0").filter_episodes(lambda episode: episode.id == 2))
    with pytest.raises(ValueError, match="test/log-v0 is of Pendulum-v1, and the task is Hopper-v5"):
        load("test/log-v0", env_id="Hopper-v5")
    (tmp_path / "test/broken-v0/data/main_data.hdf5").write_bytes(b"no HDF5 at all")
    with pytest.raises(ValueError, match=r"The dataset test/broken-v0 in .*data cannot be read; it is damaged"):
        load("test/broken-v0")
    with pytest.raises(ValueError, match=r"no dataset 'test/nothing-v0'.*test/log-v0"):
        monkeypatch.setattr(minari, "load_dataset", lambda *_, **__: (_ for _ in ()).throw(FileNotFoundError("none")))
        load("test/nothing-v0")


def test_a_minari_dataset_says_the_time_limit_of_its_environment(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = gym.make("Pendulum-v1", max_episode_steps=15)
    states = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)
    nothing, last = np.zeros(15, bool), np.arange(15) == 14
    data = Dataset(states[:-1], np.zeros((15, 1), np.float32), np.zeros(15, np.float32), nothing, last, states[-1:])
    write_dataset(data, "mine/short-v0", env)
    assert minari.load_dataset("mine/short-v0").env_spec.max_episode_steps == 15


def test_a_combined_minari_dataset_has_all_episodes(log, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    task = gym.Env()
    task.observation_space, task.action_space = STATES, ACTIONS
    first, second = (
        load(write(tmp_path / "log.npz", log)),
        load(write(tmp_path / "b.npz", make_log((3, 4), (True, True)))),
    )
    for name, data in (("mine/first-v0", first), ("mine/second-v0", second)):
        write_dataset(data, name, task)
    minari.combine_datasets([minari.load_dataset("mine/first-v0"), minari.load_dataset("mine/second-v0")], "both-v0")
    same(load("both-v0"), load([first, second]))


@pytest.mark.parametrize("name", ["Walker2d-v5", ["Walker2d-v5"]])
@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
def test_a_file_of_another_task_is_refused(suffix, name, log, tmp_path):
    """Walker2d and HalfCheetah have the same shapes."""
    path = write(tmp_path / f"log{suffix}", log | ({"env": np.array(name)} if suffix == ".npz" else {}))
    if suffix == ".hdf5":
        with h5py.File(path, "a") as file:
            file.attrs["env"] = name
    with pytest.raises(ValueError, match=rf"log{suffix} is of Walker2d-v5, and the task is HalfCheetah-v5; give"):
        load(path, env_id="HalfCheetah-v5")
    with pytest.warns(UserWarning, match="of Walker2d-v5, and the task is Walker2d-v4: versions may differ"):
        load(path, env_id="Walker2d-v4")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same(load(path, env_id="Walker2d-v5"), load(path))
        load(write(tmp_path / f"silent{suffix}", log), env_id="HalfCheetah-v5")  # as D4RL's, it says nothing


def test_tasks_without_a_version_differ_by_their_names(log, tmp_path):
    path = write(tmp_path / "log.npz", log | {"env": np.array("Mine")})
    with pytest.raises(ValueError, match="is of Mine, and the task is Yours"):
        load(path, env_id="Yours")


def test_a_written_file_names_its_task(log, tmp_path):
    env = gym.make("Pendulum-v1")
    data = Dataset(*(np.zeros(s, np.float32) for s in ((2, 3), (2, 1), 2)), *np.eye(2, dtype=bool), np.zeros((1, 3)))
    write_dataset(data, tmp_path / "a.npz", env)
    with pytest.raises(ValueError, match=r"a\.npz is of Pendulum-v1"):
        load_dataset(tmp_path / "a.npz", env.observation_space, env.action_space, "Hopper-v5")


def test_in_a_written_file_an_end_is_one_of_both_kinds(log, tmp_path):
    env, data = gym.make("Pendulum-v1"), load(write(tmp_path / "log.npz", log))
    write_dataset(replace(data, actions=data.actions[:, :1]), tmp_path / "a.npz", env)
    with np.load(tmp_path / "a.npz") as written:
        for key in ("terminals", "timeouts"):
            np.testing.assert_array_equal(written[key], log[key])


def test_a_slow_file_shows_a_bar(log, tmp_path, monkeypatch, capsys):
    path = write(tmp_path / "log.npz", log)
    load(path, progress_bar=True)
    assert capsys.readouterr().err == ""  # it took no second
    monkeypatch.setattr(sources, "tqdm", lambda *args, **kwargs: tqdm(*args, **kwargs | {"delay": 0}))
    load(path)
    assert capsys.readouterr().err == ""
    load(path, progress_bar=True)
    assert "log.npz: 100%" in capsys.readouterr().err


def test_several_sources_are_joined(log, tmp_path):
    path = write(tmp_path / "log.npz", log)
    joined = load([path, load(path)])
    assert joined.lengths.tolist() == [5, 1, 7] * 2 and len(joined.finals) == 6


def twice(column):
    return np.stack([column] * 2, axis=1)


def untold(log, next_observations):
    return {key: x for key, x in log.items() if key != "timeouts"} | {"next_observations": next_observations}


def broken(log, key, row, value):
    log[key] = np.array(log[key], np.float64)
    log[key][row] = value
    return log


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: broken(log, "rewards", 7, np.nan), r"Row 7 of .*log\.npz: rewards must be finite, got nan"),
        (lambda log: broken(log, "observations", (3, 1), np.inf), "Row 3 of .*: observations must be .*inf"),
        (lambda log: broken(log, "actions", (2, 0), 2.5), r"Row 2 of .*: the action is outside .*, got \[2.5"),
        (lambda log: broken(log, "actions", (slice(4, 6), 1), -0.5), r"Row 4 .*\(2 rows like this\)"),
        (lambda log: broken(log, "timeouts", 5, False), "Row 5 of .*: its next observation is not that"),
        (lambda log: broken(log, "next_observations", (1, 2), log["observations"][2, 2] + 0.01), "Row 1 of .*: its"),
        (lambda log: log | {"rewards": log["rewards"][:-1]}, "differ in length"),
        (lambda log: log | {"observations": log["observations"][:, :2]}, r"of shape \(2,\), and the task \(3,\)"),
        (lambda log: {k: v for k, v in log.items() if k != "actions"}, "none of actions"),
        (lambda log: {{"terminals": "dones"}.get(k, k): v for k, v in log.items()}, "'dones' do not say"),
        (lambda log: {k: v[:0] for k, v in log.items()}, "or are empty"),
        (lambda log: broken(log, "rewards", 1, 1e300), "Row 1 of .*: rewards must be finite"),  # in float32
        (lambda log: broken(log, "terminals", 3, np.nan), r"Row 3 of .*log\.npz: terminals must be 0 or 1, got nan"),
        (lambda log: broken(log, "timeouts", 2, 7), "Row 2 of .*: timeouts must be 0 or 1, got 7"),
        (lambda log: log | {"rewards": twice(log["rewards"])}, r"log\.npz has rewards of shape \(2,\), expected one"),
        (lambda log: log | {"terminals": twice(log["terminals"])}, r"log\.npz has terminals of shape \(2,\)"),
        (lambda log: log | {"actions": log["actions"].astype(str)}, "has actions of type <U"),
        (lambda log: untold(log, log["observations"][:, :2]), r"observations of \(13, 3\), and next_.* of \(13, 2\)"),
        (lambda log: untold(log, log["observations"].astype(str)), "has next_observations of type <U"),
    ],
)  # fmt: skip
def test_what_is_no_log_of_the_task_is_refused(change, message, log, tmp_path):
    with pytest.raises(ValueError, match=message):
        load(write(tmp_path / "log.npz", change(log)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: replace(d, states=np.where(np.arange(13)[:, None] == 3, np.nan, d.states)), "Row 3 of Dataset: obs"),
        (lambda d: replace(d, actions=2 * d.actions), "the action is outside the bounds"),
        (lambda d: replace(d, rewards=d.rewards[:-1]), "The columns of Dataset differ in length"),
        (lambda d: replace(d, rewards=twice(d.rewards)), r"rewards of shape \(2,\)"),
        (lambda d: replace(d, finals=d.finals[:2]), r"finals of shape \(2, 3\), expected .* \(3, 3\)"),
        (lambda d: replace(d, ends=d.ends & (np.arange(13) < 12)), "the last step to be such an end"),
        (lambda d: replace(d, terminated=~d.ends), "Row 0 of Dataset: the task ended, and the trajectory goes on"),
    ],
)
def test_a_dataset_in_memory_is_checked_too(change, message, log, tmp_path):
    data = load(write(tmp_path / "log.npz", log))
    same(load(data), data)
    with pytest.raises(ValueError, match=message):
        load(change(data))


def test_one_number_a_row_may_stand_in_a_column(log, tmp_path):
    standing = {key: value[:, None] if value.ndim == 1 else value for key, value in log.items()}
    same(load(write(tmp_path / "a.npz", standing)), load(write(tmp_path / "b.npz", log)))


@pytest.mark.parametrize(
    ("box", "actions"),
    [
        (spaces.Box(-2.0, 2.0, (1,)), np.linspace(-2, 2, 201)),  # one action needs no column
        (spaces.Box(-100, 100, (1,), np.int8), np.arange(-100, 101, dtype=np.int8)[:, None]),  # whose span is none
    ],
)
def test_actions_of_one_entry_and_of_whole_numbers(box, actions, tmp_path):
    states, zeros = np.zeros((201, 3)), np.zeros(201)
    columns = {"observations": states, "next_observations": states, "rewards": zeros}
    columns |= {"terminals": zeros > 0, "timeouts": zeros > 0}
    path = write(tmp_path / "log.npz", columns | {"actions": actions})
    data = load_dataset(path, STATES, box)
    np.testing.assert_allclose(data.actions, np.linspace(-1, 1, 201)[:, None], atol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        (".npz", lambda content: content[: len(content) // 2]),
        (".npz", lambda content: b"no zip at all"),
        (".npz", lambda content: b""),
        (".npz", lambda content: content[:80] + bytes(40) + content[120:]),
        (".hdf5", lambda content: content[: len(content) // 2]),
        (".hdf5", lambda content: b"no HDF5 at all"),
    ],
)
def test_a_damaged_file_is_named(suffix, damage, log, tmp_path):
    path = write(tmp_path / f"log{suffix}", log)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=rf"log{suffix} cannot be read; it is damaged, or no {suffix} file"):
        load(path)


def test_pickled_columns_are_not_opened(log, tmp_path):
    with pytest.raises(ValueError, match=r"log\.npz cannot be read.*allow_pickle=False"):
        load(write(tmp_path / "log.npz", log | {"rewards": np.array([{}] * 13)}))
    same(load(write(tmp_path / "a.npz", log | {"infos": np.array([{}] * 13)})), load(write(tmp_path / "b.npz", log)))


def test_old_observations_are_no_states():
    """What SB3's own SAC stores under delay; and the goals of a HER buffer would be lost in the same way."""
    env = delayed(2)
    model = SAC("MultiInputPolicy", env, buffer_size=50, learning_starts=100, device="cpu").learn(20)
    with pytest.raises(ValueError, match="A DictReplayBuffer holds dicts, not the states of a task"):
        load_dataset(model.replay_buffer, env.observation_space, env.action_space)


def test_a_buffer_that_keeps_no_last_state_is_refused():
    kwargs = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    buffer = ReplayBuffer(10, STATES, ACTIONS, device="cpu", **kwargs)
    with pytest.raises(ValueError, match="optimize_memory_usage=True keeps neither the last state of an episode"):
        load(buffer)


@pytest.mark.parametrize(("done", "knows"), [(True, False), (True, True), (False, False)])
def test_a_buffer_that_knows_no_time_limits_says_that_dones_are_read_as_terminals(done, knows):
    buffer = ReplayBuffer(10, STATES, ACTIONS, device="cpu", handle_timeout_termination=knows)
    states = np.eye(5, 3, dtype=np.float32)
    for i in range(4):
        infos = [{"TimeLimit.truncated": i == 1}]
        buffer.add(states[i], states[i + 1], np.zeros((1, 2)), np.zeros(1), np.array([done and i == 1]), infos)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = load(buffer)
    assert data.ends.nonzero()[0].tolist() == ([1, 3] if done else [3])
    assert data.terminated.nonzero()[0].tolist() == ([1] if done and not knows else [])
    told = [("does not know which dones were time limits" in str(w.message), w.filename) for w in caught]
    assert told == [(True, __file__)] * (done and not knows)


@pytest.mark.parametrize("source", [3, None, [["a.npz", "b.npz"]], {}])
def test_what_is_no_dataset_is_said(source):
    with pytest.raises(ValueError, match="is no dataset; give the id of a Minari dataset"):
        load(source)


def test_no_file_and_no_step_are_said():
    with pytest.raises(FileNotFoundError, match=r"no dataset nothing\.npz"):
        load("nothing.npz")
    with pytest.raises(ValueError, match="list of datasets is empty"):
        load([])


def test_a_log_of_single_steps_without_what_followed_has_nothing(tmp_path):
    log = make_log((1, 1), (False, False))
    del log["next_observations"]
    with pytest.raises(ValueError, match="no step whose next state is known"):
        load(write(tmp_path / "log.npz", log))
