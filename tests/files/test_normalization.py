"""VecNormalize in a file without pickle: it comes back as it was, and what no VecNormalize has is refused."""

import numpy as np
import pytest
from small_task import delayed
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said.files.archive import SavedFileError, load_tree, save_tree
from sb3_said.files.normalization import KIND, load_normalization, save_normalization


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("normalization") / "agent.normalize.zip"
    env = VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"], gamma=0.9, clip_obs=5.0)
    env.seed(0)
    env.reset()
    for _ in range(20):
        env.step(np.ones((1, 1), np.float32))
    save_normalization(path, env)
    return path, env


def test_it_normalises_as_before(saved):
    path, env = saved
    loaded = load_normalization(path, make_vec_env(delayed))
    observation = {
        "observation": np.array([[3.0, -1.0]]),
        "action_history": np.zeros((1, 2, 1)),
        "delay": np.zeros((1, 1)),
    }
    for key, value in env.normalize_obs(observation).items():
        np.testing.assert_array_equal(loaded.normalize_obs(observation)[key], value)
    assert (loaded.gamma, loaded.clip_obs, loaded.training) == (0.9, 5.0, False)


def test_without_clips_it_comes_back_too(tmp_path):
    env = VecNormalize(make_vec_env(delayed), norm_obs_keys=["observation"], clip_obs=np.inf, clip_reward=np.inf)
    save_normalization(tmp_path / "agent.normalize.zip", env)
    loaded = load_normalization(tmp_path / "agent.normalize.zip", make_vec_env(delayed))
    assert loaded.clip_obs == loaded.clip_reward == np.inf


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("epsilon", -5.0),
        ("epsilon", float("inf")),
        ("clip_obs", -float("inf")),
        ("epsilon", 0.0),
        ("epsilon", float("nan")),
        ("clip_obs", float("nan")),
        ("clip_obs", -1.0),
        ("clip_obs", "x"),
        ("clip_reward", 0.0),
        ("gamma", "g"),
        ("gamma", 1.5),
        ("norm_obs", "no"),
        ("norm_obs_keys", ["velocity"]),
    ],
)
def test_forged_settings_are_refused(name, value, saved, tmp_path):
    tree = load_tree(saved[0], KIND)
    tree["settings"][name] = value
    save_tree(tmp_path / "forged.zip", tree, kind=KIND)
    with pytest.raises(SavedFileError):
        load_normalization(tmp_path / "forged.zip", make_vec_env(delayed))
