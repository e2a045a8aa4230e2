"""Whatever ``predict`` is given, it refuses with a ``ValueError`` or answers with actions inside their space."""

import warnings

import numpy as np
import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_agent import make, observe
from small_task import Drift, delayed

from sb3_said import SAID, DelayedSAC

GOOD = observe(4)
# Up to 1e6: what a planner does far outside of what it has seen is tested with the planner.
numbers = st.floats(-1e6, 1e6) | st.integers(-3, 3) | st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 0.5, -0.0])
dtypes = st.sampled_from([np.float64, np.float32, np.float16, np.int64, np.int8, bool, np.complex64, object, str])
shapes = st.lists(st.integers(0, 3), max_size=4).map(tuple)


@st.composite
def arrays(draw):
    shape = draw(shapes | st.sampled_from([value.shape for value in GOOD.values()]))
    size = int(np.prod(shape))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values = np.array(draw(st.lists(numbers, min_size=size, max_size=size))).reshape(shape)
        return values.astype(draw(dtypes))


@st.composite
def changed(draw, good):
    """One of the good values, with an entry or a dtype of its own, as a list or a tensor."""
    value = np.array(good, np.float64)
    if draw(st.booleans()):
        value[tuple(draw(st.integers(0, n - 1)) for n in value.shape)] = draw(numbers)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        value = value.astype(draw(dtypes.filter(lambda dtype: dtype not in (object, str))))
    form = draw(st.sampled_from(["array", "list", "tensor", "gradient", "bfloat16", "row"]))
    if form == "list":
        return value.tolist()
    if form == "row":
        return value[0]
    if form in ("tensor", "gradient", "bfloat16"):
        tensor = th.as_tensor(value)
        tensor = tensor.bfloat16() if form == "bfloat16" and not tensor.is_complex() else tensor
        return tensor.requires_grad_() if form == "gradient" and tensor.is_floating_point() else tensor
    return value


things = st.sampled_from([None, 3, "a", b"a", [], {}, [[1.0], 2.0], [None], (1.0, 2.0), {1, 2}, object, th.zeros(0)])


@st.composite
def observations(draw):
    """One of a delayed task, or of a plain one, of which some parts are not what they should be."""
    rows = draw(st.sampled_from([1, 4]))
    good = {key: value[:rows] for key, value in GOOD.items()}
    if draw(st.integers(0, 9)) == 0:
        return draw(things | arrays() | changed(good["observation"]))
    obs = {key: draw(st.just(value) | changed(value) | arrays() | things) for key, value in good.items()}
    if draw(st.integers(0, 3)):  # else hardly any is understood
        kept = draw(st.lists(st.sampled_from([*good]), min_size=1, max_size=3))
        obs |= {key: good[key] for key in kept}
    if draw(st.integers(0, 9)) == 0:
        del obs[draw(st.sampled_from([*obs]))]
    if draw(st.integers(0, 9)) == 0:
        obs[draw(st.sampled_from(["undelayed_observation", "state_history", 3, ""]))] = draw(things)
    return obs


@pytest.fixture(scope="module")
def agents():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # trained for a moment
        said = make(delayed(1, max_delay=2)).learn(25)
        plain = make(Drift()).learn(25)
    return {"expert": said, "planner": said, "plain": plain, "DelayedSAC": make(cls=DelayedSAC).learn(25)}


def answer_or_refusal(agent, obs, deterministic):
    """Return the actions, or None for a refusal with a reason."""
    try:
        actions, _ = agent.predict(obs, deterministic=deterministic)
    except ValueError as error:
        assert len(str(error)) > 20 and "Expected parameter" not in str(error)
        return None
    assert actions.dtype == np.float32 and actions.shape[-1] == 1 and actions.size > 0
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 2.0
    return actions


@pytest.mark.filterwarnings("ignore:.*learned at ages.*:UserWarning")
@pytest.mark.parametrize("who", ["DelayedSAC", "expert", "planner", "plain"])
def test_malformed_observations_are_refused_or_answered_within_bounds(agents, who):
    agent, answers = agents[who], []

    @settings(
        max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], database=None
    )
    @given(observations() | arrays() | changed(GOOD["observation"]), st.booleans())
    def ask(obs, deterministic):
        with agent.policy.answering(who) if who in ("expert", "planner") else warnings.catch_warnings():
            answers.append(answer_or_refusal(agent, obs, deterministic))

    ask()
    refused = sum(answer is None for answer in answers)
    assert 0 < refused < len(answers)  # both happen


@pytest.mark.parametrize("requires_grad", [True, False])
@pytest.mark.parametrize("n", [None, 1, 3])
@pytest.mark.parametrize("delay", [1, 2])  # at 1 it has learned
@pytest.mark.parametrize("who", ["expert", "planner"])
def test_tensors_get_the_answer_of_arrays(agents, who, delay, n, requires_grad):
    one = {"observation": np.ones(2), "action_history": np.full((2, 1), 0.5), "delay": np.full(1, delay)}
    obs = {key: np.float32(value if n is None else [value] * n) for key, value in one.items()}
    tensors = {key: th.tensor(value, requires_grad=requires_grad) for key, value in obs.items()}
    with warnings.catch_warnings(record=True) as caught, agents[who].policy.answering(who):
        warnings.simplefilter("always")
        answers = [agents[who].predict(each, deterministic=True)[0] for each in (obs, tensors)]
    np.testing.assert_array_equal(*answers)
    told = ["learned at ages 1 and is given 2" in str(w.message) for w in caught]
    assert told == [True] * 2 * (delay == 2 and who == "expert")


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("cls", [DelayedSAC, SAID])
def test_an_expert_whose_networks_overflow_says_so(cls, deterministic):
    agent = make(cls=cls)
    with th.no_grad():
        actor = agent.policy.averaged_actor or agent.policy.actor
        actor.latent_pi[0].weight.mul_(1e38)  # as SAID cuts z-scored states at 10
    obs = {**{key: value[0] for key, value in GOOD.items()}, "observation": np.array([3e38, -3e38], np.float32)}
    with pytest.raises(ValueError, match=r"action is not finite"):
        agent.predict(obs, deterministic=deterministic)
