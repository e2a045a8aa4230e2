"""Which ages an environment's observations have, and how they are written."""

import pytest
from small_task import Drift, LateDelay, OwnDelay, delayed
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said.delays import TotalDelay
from sb3_said.delays.ages import ages_of, written_ages


@pytest.mark.parametrize(
    ("env", "ages"),
    [
        (None, [0]),
        (Drift(), [0]),
        (delayed(2), [2]),
        (delayed(1, max_delay=2), [1]),
        (delayed((0, 2)), [0, 1, 2]),
        (delayed(TotalDelay(1, 1)), [2]),
        (delayed(OwnDelay()), [0, 1, 2]),  # does not say its smallest
        (delayed(LateDelay()), [1, 2]),
    ],
    ids=str,
)
def test_of_one_environment_and_of_several_alike(env, ages):
    assert ages_of(env) == ages
    if env is not None:
        assert ages_of(DummyVecEnv([lambda: env])) == ages


@pytest.mark.parametrize("first", [0, 1])
def test_each_of_several_environments_has_ages_of_its_own(first):
    envs = [lambda: delayed(0, max_delay=3), lambda: delayed((2, 3))]
    assert ages_of(DummyVecEnv([envs[first], envs[1 - first]])) == [0, 2, 3]


@pytest.mark.parametrize(("ages", "text"), [([3], "3"), ([2, 3], "2, 3"), ([0, 1, 2], "0..2"), ([0, 2, 3], "0, 2, 3")])
def test_written_ages(ages, text):
    assert written_ages(ages) == text
