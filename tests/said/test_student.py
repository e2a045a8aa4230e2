"""The student answers as its planner, on what it was shown and where it goes itself; and lives in the agent's file."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from small_agent import answer, make, observe
from small_task import Drift, delayed
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional as F

from sb3_said import SAID
from sb3_said.delays.space import delayed_space
from sb3_said.files.archive import SavedFileError
from sb3_said.sac.extractors import StateAugmentedExtractor
from sb3_said.said import student as student_module
from sb3_said.said.student import Student

QUICK = {"width": 32, "n_labels": 700, "own_steps": 60, "rounds": 2, "gradient_steps": 400, "batch_size": 64}


@pytest.fixture(scope="module")
def taught():
    """An agent whose planner is at temperature 0, with its student; tests must leave it as it is.

    Without a first guess: on random weights it doubles how wild a function the small student has to learn.
    """
    model = with_answers(make(planner_kwargs={"temperature": 0.0, "first_guess": "none"}).learn(60))
    model.error = model.distill(**QUICK)
    return model


def with_answers(model):
    """Give the planner weights of which every input shows in the answer."""
    generator = th.Generator().manual_seed(1)
    for parameter in model.policy.planner.parameters():
        th.nn.init.normal_(parameter, std=0.15, generator=generator)
    return model


def replayed(model, generator):
    source = model.replay_buffer.window_source(model.newest_fraction, model.get_vec_normalize_env())
    return student_module._replayed(model, source, generator)


@pytest.fixture
def pupil(taught):
    """The same agent, for tests that distill another student."""
    before = taught.policy.student
    yield taught
    taught.policy.student, taught.student_width = before, before.width


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


def test_its_error_is_over_rows_that_it_did_not_learn_from_and_its_rate_falls_to_0(pupil, monkeypatch):
    learned_from, rates, loss, made = [], [], student_module._loss, th.optim.Adam

    class Watched(made):
        def step(self, closure=None):
            rates.append(self.param_groups[0]["lr"])
            return super().step(closure)

    def recorded(model, batch, q_weight):
        learned_from.append(batch.inputs)
        return loss(model, batch, q_weight)

    monkeypatch.setattr(student_module, "_loss", recorded)
    monkeypatch.setattr(th.optim, "Adam", Watched)
    pupil.planner_newest_fraction = 0.5  # of 60 steps
    try:
        error = pupil.distill(**{**QUICK, "own_steps": 0, "gradient_steps": 100}, learning_rate=0.01)
        generator = th.Generator().manual_seed(pupil.seed)
        parts = [replayed(pupil, generator) for _ in range(2)]
    finally:
        pupil.planner_newest_fraction = 1.0
    inputs, labels = (th.cat([getattr(part, name) for part in parts])[:700] for name in ("inputs", "labels"))
    newest = pupil.replay_buffer.observations[30:60, 0]
    assert {tuple(x) for x in inputs[:, :2].tolist()} <= {tuple(x) for x in newest.tolist()}
    student = pupil.policy.student
    th.testing.assert_close(student.mean, inputs[35:].mean(0))
    with th.no_grad():
        assert error == pytest.approx((student.answer(inputs[:35]) - labels[:35]).square().mean().sqrt().item())
    drawn = th.randint(665, (64,), generator=generator)  # of the first batch
    assert th.equal(learned_from[0], inputs[35:][drawn])
    np.testing.assert_allclose(rates, 0.01 * (1 - np.arange(100) / 100), atol=1e-9)


def test_the_labels_are_the_planners_at_temperature_0_at_every_age(taught, monkeypatch):
    model, seen = taught, []
    plan = model.policy.planner.plan

    def recorded(*args, **kwargs):
        made = plan(*args, **kwargs)
        seen.append((args, kwargs, made.action))
        return made

    monkeypatch.setattr(model.policy.planner, "plan", recorded)
    rows = replayed(model, th.Generator().manual_seed(0))
    ((states, history, delay), kwargs, action) = seen[0]
    assert kwargs == {"temperature": 0.0} and sorted(set(delay.tolist())) == [0, 1, 2]
    assert th.equal(rows.labels, action)
    reader = StateAugmentedExtractor(model.observation_space)
    obs = {"observation": states, "action_history": history, "delay": delay[:, None].float()}
    assert th.equal(rows.inputs, reader(obs))
    # Each row is a place of the replay: the state, the actions from there on, and the state that they lead to
    buffer, stored = model.replay_buffer, model.replay_buffer.observations[:, 0]
    for k in range(20):
        age, (place, *_) = int(delay[k]), np.flatnonzero((stored == states[k].numpy()).all(1))
        np.testing.assert_array_equal(rows.presents[k], stored[place + age])
        np.testing.assert_array_equal(history[k, 2 - age :], buffer.actions[place : place + age, 0])
        assert not history[k, : 2 - age].any()


@pytest.mark.parametrize("is_delayed", [True, False])
def test_the_labels_are_the_actors_where_it_decides_on_the_guess(is_delayed):
    model = make(env=None if is_delayed else Drift(length=30)).learn(60)
    model.set_planner(decided_by="actor")
    model.policy.make_student(8)
    rows = student_module._visited(model, "planner", 25, th.Generator().manual_seed(0))
    with model.borrowed_env() as env, model.policy.answering("planner"):
        env.seed(int(th.randint(2**31, (), generator=th.Generator().manual_seed(0))))
        obs = env.reset()
        for label in rows.labels:
            action = model.predict(obs, deterministic=True)[0]
            np.testing.assert_allclose(model.policy.scale_action(action)[0], label, atol=1e-5)
            obs = env.step(action)[0]


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


def test_it_learns_where_it_goes_itself(pupil, monkeypatch):
    visits, visited = [], student_module._visited

    def recorded(model, who, n_steps, generator):
        visits.append((who, n_steps))
        return visited(model, who, n_steps, generator)

    monkeypatch.setattr(student_module, "_visited", recorded)
    pupil.distill(**{**QUICK, "n_labels": 100, "gradient_steps": 30})
    assert visits == [("student", 30), ("student", 30)]
    rows = visited(pupil, "student", 30, th.Generator())
    assert rows.inputs.shape == (30, 2 + 2 + 1) and rows.presents.isnan().all()
    with th.no_grad():  # in Drift the action moves the first entry of the state, and is the last of the next history
        states, history = rows.inputs[:, :2], rows.inputs[:, 2:4]
        own = pupil.policy.student.answer(rows.inputs)
    follows = rows.inputs[:-1, -1] <= rows.inputs[1:, -1]  # where no episode ends
    th.testing.assert_close(history[1:, -1][follows], own[:-1, 0][follows], rtol=1e-5, atol=1e-6)
    assert states.std() > 0 and pupil._last_obs is None  # the next learn() starts a new episode


def test_the_critics_can_have_a_say(pupil):
    def taught_by(q_weight):
        pupil.distill(**{**QUICK, "own_steps": 0, "q_weight": q_weight})
        rows = replayed(pupil, th.Generator().manual_seed(1))
        with th.no_grad():
            answers = pupil.policy.student.answer(rows.inputs)
            return pupil.policy.q_value(rows.presents, answers).mean(), (answers - rows.labels).square().mean()

    (plain_q, plain_error), (q, error) = taught_by(0.0), taught_by(0.5)
    assert q > plain_q and error > plain_error


def test_their_say_is_in_mean_sizes_of_q(taught):
    rows = replayed(taught, th.Generator().manual_seed(1))
    unknown = student_module._Rows(rows.inputs[:9], rows.labels[:9], th.full_like(rows.presents[:9], th.nan))
    answers = taught.policy.student.answer(rows.inputs)
    q = taught.policy.q_value(rows.presents, answers)
    errors = [F.mse_loss(answers, rows.labels), F.mse_loss(answers[:9], rows.labels[:9])]
    th.testing.assert_close(student_module._loss(taught, rows, 0.3), errors[0] - 0.3 * q.mean() / q.abs().mean())
    th.testing.assert_close(student_module._loss(taught, unknown, 0.3), errors[1])


@pytest.mark.parametrize("normalized", [False, True])
def test_without_delay_and_with_normalized_observations(normalized):
    env = make_vec_env(delayed if normalized else Drift, 2)
    env = VecNormalize(env, norm_obs_keys=["observation"]) if normalized else env
    model = with_answers(make(env, planner_kwargs={"temperature": 0.0}).learn(30))
    before = env.obs_rms["observation"].mean.copy() if normalized else None
    assert model.distill(**{**QUICK, "gradient_steps": 400}) < 0.2
    if normalized:
        np.testing.assert_array_equal(env.obs_rms["observation"].mean, before)
        assert env.training


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


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 0}, "student_width must be a whole number, at least 1, got 0"),
        ({"batch_size": 0}, "batch_size is 0, expected at least 1"),
        ({"q_weight": -1.0}, "q_weight is -1.0, expected at least 0"),
        ({"n_labels": 1e2}, "n_labels is 100.0, expected a whole number"),
        ({"learning_rate": 0.0}, "learning_rate is 0.0, expected a number above 0"),
    ],
)
def test_settings_that_cannot_be_are_refused_and_the_student_stays(taught, settings, message):
    before = taught.policy.student
    with pytest.raises(ValueError, match=message):
        taught.distill(**{**QUICK, **settings})
    assert taught.policy.student is before and taught.student_width == 32


def test_a_bar_shows_labels_and_updates(taught, capsys):
    before = taught.policy.student
    try:
        taught.distill(**{**QUICK, "gradient_steps": 30}, progress_bar=True)
    finally:
        taught.policy.student = before
    shown = capsys.readouterr().err
    assert "the planner's answers: 100%" in shown and "student: 100%" in shown and "30/30" in shown


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


@pytest.mark.parametrize(("gradient_steps", "rounds"), [(12, 10), (100, 30), (40, 10), (50, 0)])
def test_the_student_plays_as_often_as_asked_for(gradient_steps, rounds, pupil, monkeypatch):
    asked, visited = [], student_module._visited
    monkeypatch.setattr(student_module, "_visited", lambda *args: (asked.append(args[2]), visited(*args))[1])
    pupil.distill(**{**QUICK, "own_steps": 60, "gradient_steps": gradient_steps, "rounds": rounds})
    assert asked == [-(-60 // rounds)] * rounds if rounds else asked == []
