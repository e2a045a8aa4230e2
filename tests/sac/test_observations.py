"""What ``predict`` takes: observations in any dtype, never bad ones, and unknown ages not in silence."""

import copy
import warnings
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_agent import make as make_agent
from small_agent import observation
from small_task import Drift, delayed

from sb3_said import SAID, DelayedSAC
from sb3_said.sac.policies import DelayedSACPolicy

make = partial(make_agent, cls=DelayedSAC)


def changed(**parts):
    return {**observation(), **parts}


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (changed(observation=np.array([np.nan, 0.0], np.float32)), "observation has entries that are NaN"),
        (changed(observation=np.array([0.0, np.inf], np.float32)), "observation has entries that are NaN or infinite"),
        (changed(action_history=np.full((2, 1), np.nan, np.float32)), "action_history has entries that are NaN"),
        (changed(delay=np.array([np.nan], np.float32)), "delay has entries that are NaN"),
        (changed(delay=np.array([3.0], np.float32)), r"0\.\.2: the agent was built for max_delay=2"),
        (changed(delay=np.array([-1.0], np.float32)), r"whole numbers in 0\.\.2"),
        (changed(delay=np.array([0.5], np.float32)), r"whole numbers in 0\.\.2"),
        (changed(action_history=np.full((2, 1), 1.5, np.float32)), r"scaled to \[-1, 1\]"),
        (changed(observation=np.zeros(3, np.float32)), r"observation has the shape \(3,\), expected \(2,\)"),
        (observation(delay=3), r"action_history has the shape \(3, 1\).*another task, or for another largest delay"),
        (changed(delay=np.zeros((4, 1), np.float32)), "differ in how many"),
        ({"observation": np.zeros(2, np.float32)}, "DelayedObservationWrapper"),
        (changed(undelayed_observation=np.zeros(2, np.float32)), "undelayed_observation"),
        (np.zeros(2, np.float32), "got ndarray"),
        ((observation(), {}), "tuple"),
        (changed(observation=np.array([0.0, 1e300])), "observation has entries that are NaN or infinite"),
        (changed(observation=np.array(["0.5", "a"])), "observation holds <U3, expected real numbers"),
        (changed(observation=np.array([0.5, None])), "observation holds object, expected real numbers"),
        (changed(action_history=[["0.5"], ["0.5"]]), "action_history holds <U3, expected real numbers"),
        (changed(delay=[None]), "delay holds object, expected real numbers"),
        (changed(observation=[0.5, [0.5]]), "observation cannot be made an array"),
        ({key: value[None][:0] for key, value in observation().items()}, "empty batch"),
        ({**observation(), 3: np.zeros(2)}, "with the keys"),
    ],
)
def test_bad_observations_are_refused_before_anything_is_computed(obs, message, monkeypatch):
    model = make()

    def computed(*_, **__):
        raise AssertionError("the actor was asked")

    monkeypatch.setattr(model.policy.actor, "forward", computed)
    state = th.get_rng_state()
    for deterministic in (True, False):
        with pytest.raises(ValueError, match=message):
            model.predict(obs, deterministic=deterministic)
    assert th.equal(state, th.get_rng_state())


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (np.array([np.nan, 0.0]), "NaN"),
        (np.zeros(3), r"shape \(3,\), expected \(2,\)"),
        (np.zeros((2, 3, 2)), "shape"),
        (observation(), "without delay"),
        ({3: 0, "a": 0}, "without delay"),
        (np.array([0.0, 1e300]), "NaN or infinite"),
        (["0.5", "0.5"], "observation holds <U3, expected real numbers"),
        ([0.5, None], "observation holds object, expected real numbers"),
        (None, "observation holds object, expected real numbers"),
        ([0.5, [0.5]], "observation cannot be made an array"),
        (np.zeros((0, 2)), "empty batch"),
    ],
)
def test_bad_observations_are_refused_without_delay_too(obs, message):
    with pytest.raises(ValueError, match=message):
        make(Drift()).predict(obs)


def own_dtypes(obs):
    """Yield what a user may hand in for the same float32 observations: other dtypes, lists, other layouts in memory."""
    yield {key: value.astype(np.float64) for key, value in obs.items()}
    yield {key: value.astype(np.int64) if key == "delay" else value for key, value in obs.items()}
    yield {key: value.tolist() for key, value in obs.items()}
    yield {key: np.asfortranarray(value) for key, value in obs.items()}
    yield {key: np.flip(np.flip(value).copy()) for key, value in obs.items()}
    yield {key: np.frombuffer(value.tobytes(), np.float32).reshape(value.shape) for key, value in obs.items()}


@pytest.mark.filterwarnings("error", "ignore:On held-out windows:UserWarning")
@pytest.mark.parametrize("make_env", [Drift, delayed], ids=["plain", "delayed"])
@pytest.mark.parametrize("cls", [DelayedSAC, SAID])
def test_the_same_numbers_get_the_same_answer_in_any_dtype(make_env, cls):
    planner = {"d_model": 32, "depth": 1, "horizon": 3, "sampling_steps": 2, "n_candidates": 4, "temperature": 0.5}
    planner = {"planner_kwargs": planner, "planner_gradient_steps": 2} if cls is SAID else {}
    model = make(make_env(), cls=cls, **planner).learn(25)
    assert cls is DelayedSAC or model.policy.planner_is_trained

    def answer(obs):
        return model.predict(obs if make_env is delayed else obs["observation"], deterministic=True)[0]

    one = observation() if make_env is delayed else {"observation": observation()["observation"]}
    for obs in (one, {key: np.stack([value, value, value]) for key, value in one.items()}):
        expected, before = answer(obs), copy.deepcopy(obs)
        for same in own_dtypes(obs):
            np.testing.assert_array_equal(answer(same), expected)
        for key in obs:
            np.testing.assert_array_equal(obs[key], before[key])


@pytest.mark.parametrize("n", [None, 1, 3])
def test_ages_that_it_has_not_met_are_noticed_in_its_observations(n):
    """``evaluate_policy`` and a robot's control loop hand over no environment to be checked."""
    model = make(delayed(1, max_delay=2)).learn(30)
    history = np.full((2, 1), 0.5, np.float32)
    obs = {"observation": np.zeros(2, np.float32), "action_history": history, "delay": np.ones(1, np.float32)}
    start = {**obs, "action_history": np.array([[0.0], [0.5]], np.float32), "delay": np.zeros(1, np.float32)}
    rows = [obs, start] if n is None else [obs] * (n - 1) + [start]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for row in rows:
            model.predict(row)  # younger than ever amid an episode, but two actions have not been sent yet
    late = {**obs, "delay": np.full(1, 2, np.float32)}
    batch = late if n is None else {key: np.stack([row[key] for row in (*rows, late)]) for key in obs}
    with pytest.warns(UserWarning, match="learned at ages 1 and is given 2: what it does"):
        model.predict(batch)


def test_an_answer_that_is_not_finite_is_refused():
    wide = spaces.Box(-3e38, 3e38, (1,), np.float32)  # finite, but high - low is not
    policy = DelayedSACPolicy(spaces.Box(-1, 1, (2,)), wide, lambda _: 1e-3, net_arch=[8])
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="action is not finite"):
        policy.predict(np.zeros(2, np.float32), deterministic=True)
