"""The student answers as its planner, on what it was shown and where it goes itself; and lives in the agent's file."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from small_agent import answer, make, observe
from small_student import QUICK
from small_task import Drift, delayed
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_said import SAID
from sb3_said.delays.space import delayed_space
from sb3_said.files.archive import SavedFileError
from sb3_said.said.student import Student


def test_it_answers_as_the_planner_and_an_untaught_one_does_not(taught):
    obs = observe()
    with taught.policy.answering("planner"):
        wanted = answer(taught, obs)
    with taught.policy.answering("student"):
        found = answer(taught, obs)
        np.testing.assert_array_equal(answer(taught, {key: value[3] for key, value in obs.items()}), found[3])
        np.testing.assert_array_equal(taught.predict_plan(obs, deterministic=True)[:, 0], found)
    other = Student(taught.observation_space, taught.action_space, 32)
    untaught = other.answer(other.read(taught.policy.obs_to_tensor(obs)[0]))
    error, spread = np.abs(found - wanted).max(), np.abs(wanted - wanted.mean(0)).max()
    assert spread > 0.2 and error < 0.15 * spread < np.abs(2 * untaught.detach().numpy() - wanted).max()
    assert 0 < taught.error < 0.15
    assert not any(parameter.requires_grad for parameter in taught.policy.student.parameters())


@given(seed=st.integers(0, 2**31), max_delay=st.integers(0, 5), is_delayed=st.booleans())
@settings(max_examples=30, deadline=None)
def test_it_reacts_in_numpy_as_it_learned_in_torch(seed: int, max_delay: int, is_delayed: bool) -> None:
    generator, state, act_dim = th.Generator().manual_seed(seed), spaces.Box(-np.inf, np.inf, (3,)), 2
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        action_space = spaces.Box(-1.0, 1.0, (act_dim,))
        space = delayed_space(state, action_space, max_delay) if is_delayed else state
        student = Student(space, action_space, 16)
    obs: PyTorchObs = th.randn(1, 3, generator=generator)
    if is_delayed:
        history = 2 * th.rand(1, max_delay, act_dim, generator=generator) - 1
        age = th.randint(max_delay + 1, (1, 1), generator=generator).float()
        obs = {"observation": obs, "action_history": history, "delay": age}
    student.scale_to(student.read(obs) + th.randn(9, 1, generator=generator))
    arrays = {key: x.numpy() for key, x in (obs if isinstance(obs, dict) else {"observation": obs}).items()}
    th.testing.assert_close(
        th.from_numpy(student.react(arrays)), student.answer(student.read(obs)), atol=1e-6, rtol=1e-5
    )


def test_what_never_changes_is_read_as_it_is():
    student = Student(Drift.observation_space, Drift.action_space, 8)
    student.scale_to(th.tensor([[3.0, -1.0], [3.0, 1.0]]))
    assert student.std.tolist() == [1.0, 1.0] and student.mean.tolist() == [3.0, 0.0]


def test_a_file_keeps_it_and_who_answers(taught, tmp_path):
    assert taught.policy.who_answers == "planner" and taught.policy.answers == ["planner", "expert", "student"]
    taught.set_answer("student")
    try:
        wanted = answer(taught, observe())
        taught.save(tmp_path / "agent.zip")
        taught.policy.save(tmp_path / "policy.zip")
    finally:
        taught.set_answer("planner")
    assert taught.policy.who_answers == "planner"
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.who_answers == "student" and loaded.student_width == 32
    np.testing.assert_array_equal(answer(loaded, observe()), wanted)
    np.testing.assert_array_equal(answer(type(loaded.policy).load(tmp_path / "policy.zip"), observe()), wanted)
    with pytest.raises(ValueError, match="Nothing to learn from"):
        loaded.distill()
    again = SAID.load(tmp_path / "agent.zip", env=delayed(), device="cpu")
    assert again.distill(**{**QUICK, "n_labels": 100, "gradient_steps": 50}) < 1  # by the planner's own visits


def test_a_student_taught_again_goes_on_answering(pupil):
    pupil.set_answer("student")
    try:
        pupil.distill(**{**QUICK, "own_steps": 0, "gradient_steps": 5})
        assert pupil.policy.who_answers == "student"
    finally:
        pupil.set_answer("planner")
    pupil.distill(**{**QUICK, "own_steps": 0, "gradient_steps": 5})
    assert pupil.policy.who_answers == "planner"


@pytest.mark.parametrize(("width", "own"), [(None, "none"), (8, "one of 8")])
def test_parameters_with_a_student_ask_for_one_of_its_width(width, own, taught, tmp_path):
    taught.save(tmp_path / "taught.zip")
    kwargs = {"planner_kwargs": taught.planner_kwargs}
    with pytest.raises(SavedFileError, match=rf"width 32, and this agent {own}\. .* student_width=32"):
        make(student_width=width, **kwargs).set_parameters(tmp_path / "taught.zip")
    model = make(student_width=32, **kwargs)
    model.set_parameters(tmp_path / "taught.zip")
    obs = observe()
    with model.policy.answering("student"), taught.policy.answering("student"):
        assert np.array_equal(answer(model, obs), answer(taught, obs))


def test_its_width_may_be_written_as_a_float():
    space = delayed()
    assert Student(space.observation_space, space.action_space, 16.0).network[0].out_features == 16


def test_who_is_not_there_cannot_answer():
    model = make()
    assert model.policy.answers == ["expert"]
    with pytest.raises(ValueError, match=r"no student yet; call distill\(\)"):
        model.set_answer("student")
    with pytest.raises(ValueError, match="not trained yet"):
        model.distill()


def test_one_that_was_never_taught_cannot_answer_and_has_the_width_asked_for():
    model = make(student_width=8, planner_gradient_steps=1)
    assert model.policy.answers == ["expert"]
    with pytest.raises(ValueError, match=r"no student yet; call distill\(\)"):
        model.set_answer("student")
    model.learn(30).distill(**{**QUICK, "width": None, "gradient_steps": 2})
    assert model.policy.student.width == model.student_width == 8 and "student" in model.policy.answers


def test_it_is_small_and_reads_no_state_history():
    env = delayed()
    student = Student(env.observation_space, env.action_space, 256)
    assert sum(p.numel() for p in student.parameters()) < 100_000
    wider = delayed_space(Drift.observation_space, Drift.action_space, 2, state_history=True)
    assert Student(wider, env.action_space, 8).mean.shape == (5,)
