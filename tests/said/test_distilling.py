"""How a student learns: its labels, and where it goes itself."""

import numpy as np
import pytest
import torch as th
from small_agent import make
from small_student import QUICK, with_answers
from small_task import Drift, delayed
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from watching import watch_adam, watch_samples

from sb3_said.sac.extractors import StateAugmentedExtractor
from sb3_said.said import distillation
from sb3_said.said.student import Student


def replayed(model, generator):
    source = model.replay_buffer.window_source(model.newest_fraction, model.get_vec_normalize_env())
    return distillation._replayed(model, source, generator)


def test_its_error_is_over_rows_that_it_did_not_learn_from_and_its_rate_falls_to_0(pupil, monkeypatch):
    learned_from, answer, steps = [], Student.answer, watch_adam(monkeypatch)

    def recorded(student, inputs):
        learned_from.append(inputs)
        return answer(student, inputs)

    monkeypatch.setattr(Student, "answer", recorded)
    pupil.planner_newest_fraction = 0.5  # of 60 steps
    try:
        error = pupil.distill(**{**QUICK, "own_steps": 0, "gradient_steps": 100}, learning_rate=0.01)
        generator = th.Generator().manual_seed(pupil.seed)
        parts = [replayed(pupil, generator) for _ in range(2)]
    finally:
        pupil.planner_newest_fraction = 1.0
    inputs, labels = (th.cat(part)[:700] for part in zip(*parts, strict=True))
    newest = pupil.replay_buffer.observations[30:60, 0]
    assert {tuple(x) for x in inputs[:, :2].tolist()} <= {tuple(x) for x in newest.tolist()}
    student = pupil.policy.student
    th.testing.assert_close(student.mean, inputs[35:].mean(0))
    with th.no_grad():
        assert error == pytest.approx((student.answer(inputs[:35]) - labels[:35]).square().mean().sqrt().item())
    drawn = th.randint(665, (64,), generator=generator)  # of the first batch
    assert th.equal(learned_from[0], inputs[35:][drawn])
    rates = [rate for (rate,), _ in steps]
    np.testing.assert_allclose(rates, 0.01 * (1 - np.arange(100) / 100), atol=1e-9)


def test_the_labels_are_the_planners_at_temperature_0_at_every_age(taught, monkeypatch):
    model, seen = taught, []
    plan = model.policy.planner.plan

    def recorded(*args, **kwargs):
        made = plan(*args, **kwargs)
        seen.append((args, kwargs, made.action))
        return made

    monkeypatch.setattr(model.policy.planner, "plan", recorded)
    inputs, labels = replayed(model, th.Generator().manual_seed(0))
    ((states, history, delay), kwargs, action) = seen[0]
    assert kwargs == {"temperature": 0.0} and sorted(set(delay.tolist())) == [0, 1, 2]
    assert th.equal(labels, action)
    reader = StateAugmentedExtractor(model.observation_space)
    obs = {"observation": states, "action_history": history, "delay": delay[:, None].float()}
    assert th.equal(inputs, reader(obs))
    # Each row is a place of the replay: the state, and the actions from there on, which end no episode
    buffer, stored = model.replay_buffer, model.replay_buffer.observations[:, 0]
    for k in range(20):
        age, (place, *_) = int(delay[k]), np.flatnonzero((stored == states[k].numpy()).all(1))
        np.testing.assert_array_equal(history[k, 2 - age :], buffer.actions[place : place + age, 0])
        assert not history[k, : 2 - age].any() and not buffer.dones[place : place + age].any()


@pytest.mark.parametrize("is_delayed", [True, False])
def test_the_labels_are_the_actors_where_it_decides_on_the_guess(is_delayed):
    model = make(env=None if is_delayed else Drift(length=30)).learn(25)
    model.set_planner(decided_by="actor")
    model.policy.make_student(8)
    _, labels = distillation._visited(model, "planner", 25, th.Generator().manual_seed(0))
    with model.borrowed_env() as env, model.policy.answering("planner"):
        env.seed(int(th.randint(2**31, (), generator=th.Generator().manual_seed(0))))
        obs = env.reset()
        for label in labels:
            action = model.predict(obs, deterministic=True)[0]
            np.testing.assert_allclose(model.policy.scale_action(action)[0], label, atol=1e-5)
            obs = env.step(action)[0]


def test_it_learns_where_it_goes_itself(pupil, monkeypatch):
    visits, visited = [], distillation._visited

    def recorded(model, who, n_steps, generator):
        visits.append((who, n_steps))
        return visited(model, who, n_steps, generator)

    monkeypatch.setattr(distillation, "_visited", recorded)
    pupil.distill(**{**QUICK, "n_labels": 100, "gradient_steps": 30})
    assert visits == [("student", 30), ("student", 30)]
    inputs, _ = visited(pupil, "student", 30, th.Generator())
    assert inputs.shape == (30, 2 + 2 + 1)
    with th.no_grad():  # in Drift the action moves the first entry of the state, and is the last of the next history
        states, history = inputs[:, :2], inputs[:, 2:4]
        own = pupil.policy.student.answer(inputs)
    follows = inputs[:-1, -1] <= inputs[1:, -1]  # where no episode ends
    th.testing.assert_close(history[1:, -1][follows], own[:-1, 0][follows], rtol=1e-5, atol=1e-6)
    assert states.std() > 0 and pupil._last_obs is None  # the next learn() starts a new episode


@pytest.mark.parametrize("normalized", [False, True])
def test_without_delay_and_with_normalized_observations(normalized):
    env = make_vec_env(delayed if normalized else Drift, 2)
    env = VecNormalize(env, norm_obs_keys=["observation"]) if normalized else env
    model = with_answers(make(env, planner_kwargs={"temperature": 0.0}).learn(30))
    before = env.obs_rms["observation"].mean.copy() if normalized else None
    assert model.distill(**QUICK) < 0.2
    if normalized:
        np.testing.assert_array_equal(env.obs_rms["observation"].mean, before)
        assert env.training


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 0}, "student_width must be a whole number, at least 1, got 0"),
        ({"batch_size": 0}, "batch_size is 0, expected at least 1"),
        ({"own_steps": -1}, "own_steps is -1, expected at least 0"),
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


@pytest.mark.parametrize(("gradient_steps", "rounds"), [(12, 10), (100, 30), (40, 10), (50, 0)])
def test_the_student_plays_as_often_as_asked_for(gradient_steps, rounds, pupil, monkeypatch):
    asked, visited = [], distillation._visited
    monkeypatch.setattr(distillation, "_visited", lambda *args: (asked.append(args[2]), visited(*args))[1])
    pupil.distill(**{**QUICK, "own_steps": 60, "gradient_steps": gradient_steps, "rounds": rounds})
    assert asked == [-(-60 // rounds)] * rounds if rounds else asked == []


def test_labels_are_of_windows_that_begin_early_as_often_as_the_planners(taught, monkeypatch):
    drawn = watch_samples(monkeypatch)
    replayed(taught, th.Generator().manual_seed(0))
    asked = [early_probability for _, _, early_probability in drawn]
    assert asked == [taught.policy.planner.config.early_probability] and asked[0] > 0


def test_it_begins_and_draws_by_the_agents_seed(pupil, monkeypatch):
    seeds, weights, made = [], [], distillation._replayed
    monkeypatch.setattr(distillation, "_replayed", lambda *args: seeds.append(args[-1].initial_seed()) or made(*args))
    for seed in (3, 4):
        monkeypatch.setattr(pupil, "seed", seed)
        pupil.distill(**{**QUICK, "n_labels": 100, "own_steps": 0, "gradient_steps": 1}, learning_rate=1e-9)
        weights.append(pupil.policy.student.network[0].weight.clone())
    assert seeds == [3, 4]
    assert not th.allclose(*weights, atol=1e-3)


def test_a_planner_of_one_age_teaches_at_that_age():
    kwargs = {"learning_starts": 100, "planner_gradient_steps": 1}
    model = make(planner_kwargs={"mask": "fixed", "temperature": 0.0}, **kwargs).learn(60)
    model.policy.make_student(8)
    ages = replayed(model, th.Generator().manual_seed(0))[0][:, -1]
    assert set(ages.tolist()) <= {0.0, 0.5, 1.0} and (ages == 1).float().mean() > 0.7  # smaller at an episode's end


def test_several_environments_take_as_many_steps_together():
    model = make(DummyVecEnv([delayed] * 2))
    model.policy.make_student(8)
    assert len(distillation._visited(model, "expert", 10, th.Generator())[0]) == 10
