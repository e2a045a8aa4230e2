"""The first guess: against a naive loop and a system in closed form, and what it must not see."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_system import ACTION_DIM, BEHAVIOUR_GAIN, STATE_DIM, make_source, next_state, present
from watching import watch_adam, watch_samples

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner import first_guess as first_guess_module
from sb3_said.planner import trainer as trainer_module
from sb3_said.planner.first_guess import CLONE_LEARNING_RATE, ROLLED_EACH, ROLLED_RATE, FirstGuess, fit_first_guess
from sb3_said.planner.normalizer import Normalizer
from sb3_said.planner.plain import FARTHEST, OneStepModel
from sb3_said.planner.trainer import PlannerTrainer

D, HORIZON = 4, 3
L = D + HORIZON


def make_guess() -> FirstGuess:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        return FirstGuess(STATE_DIM, ACTION_DIM)


def make_windows(n: int, seed: int) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
    generator = th.Generator().manual_seed(seed)
    states = th.randn(n, L, STATE_DIM, generator=generator)
    actions = 2 * th.rand(n, L, ACTION_DIM, generator=generator) - 1
    delay = th.randint(D + 1, (n,), generator=generator)
    known = (th.rand(n, L, generator=generator) < 0.3) & (th.arange(L) <= delay[:, None])
    known[:, 0] = True
    return states, actions, delay, known


@pytest.mark.parametrize("scale", [1.0, 1e4])
@th.no_grad()
def test_it_is_a_naive_loop_over_each_window(scale: float):
    """Also where the model runs away, and where the clone wants more than actions can be."""
    guess = make_guess().double()  # a model that runs away makes roundings, which differ between processors, large
    for network in (guess.model.net[-1], guess.clone[-1]):
        network.weight *= scale
    states, actions, delay, known = make_windows(20, seed=1)
    states, actions = states.double(), actions.double()
    made = guess(states, actions, delay, known, longest=D)
    for i, d in enumerate(delay.tolist()):
        expected, state = [], states[i, 0]
        for k in range(L):
            if 0 < k <= d:
                state = states[i, k] if known[i, k] else guess.model(state, actions[i, k - 1])
            expected.append(state)
        th.testing.assert_close(made[i, :, :STATE_DIM], th.stack(expected))
        action = guess.clone(expected[-1]).clamp(-1, 1)
        th.testing.assert_close(made[i, d:, STATE_DIM:], action.expand(L - d, -1))
        assert not made[i, :d, STATE_DIM:].any()
    assert made.abs().max() <= FARTHEST and made[..., STATE_DIM:].abs().max() <= 1


@given(seed=st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_it_sees_nothing_that_is_hidden(seed: int):
    guess = make_guess()
    states, actions, delay, known = make_windows(5, seed)
    hidden_action = th.arange(L) >= delay[:, None]
    others = states + ~known[..., None] * 3.0, actions + hidden_action[..., None] * 1.0
    assert th.equal(guess(states, actions, delay, known, D), guess(*others, delay, known, D))


@th.no_grad()
def test_a_fall_of_a_narrow_log_is_not_cut_off():
    """Walker2d-v5's expert log has states 31 standard deviations from its mean."""
    guess = make_guess()
    for parameter in guess.model.parameters():
        parameter.zero_()  # nothing moves
    states, known = th.full((1, L, STATE_DIM), 31.0), th.arange(L)[None] == 0
    made = guess(states, th.zeros(1, L, ACTION_DIM), th.tensor([D]), known, longest=D)
    assert th.equal(made[0, D, :STATE_DIM], states[0, 0])


def test_it_learns_a_linear_system_and_its_behaviour():
    source = make_source(process_noise=0.0)
    normalizer = Normalizer(STATE_DIM, ACTION_DIM, L, "standard", relative_states=True)
    normalizer.fit(source.start_states(), source.start_actions())
    generator = th.Generator().manual_seed(0)
    windows = source.sample(2_000, L, generator)
    normalizer.fit_moves(windows)
    guess = make_guess()
    fit_first_guess(guess, source, normalizer, PlannerConfig(weight_factor=0.0), 150, generator, D)
    reaches = windows.valid[:, D]
    states, actions = windows.states[reaches], windows.actions[reaches]
    n = len(states)
    z, known = normalizer.normalize_states(states), th.arange(L).expand(n, -1) == 0
    made = guess(z, actions, th.full((n,), D), known, D)
    truth = normalizer.normalize_states(present(states[:, 0], actions[:, :D], th.full((n,), D)))
    assert (made[:, D, :STATE_DIM] - truth).abs().mean() < 0.05
    behaviour = -(states[:, D] @ BEHAVIOUR_GAIN.T).clamp(-1, 1)  # its noise has mean 0, but where it is clipped
    assert (made[:, D, STATE_DIM:] - behaviour).abs().mean() < 0.1
    assert (made[:, D, STATE_DIM:] - behaviour).abs().mean() < 0.3 * behaviour.abs().mean()


def test_the_model_learns_from_its_own_answers_and_the_clone_does_not(monkeypatch):
    """From one guess on, so many steps at once bring the model nearer after so many."""
    monkeypatch.setattr(first_guess_module, "ROLLED_EACH", 1)
    source, windows_of = make_source(), th.Generator().manual_seed(1)
    normalizer = Normalizer(STATE_DIM, ACTION_DIM, L, "standard", relative_states=True)
    normalizer.fit(source.start_states(), source.start_actions())
    windows = source.sample(4_000, D + 1, windows_of)
    normalizer.fit_moves(source.sample(2_000, L, windows_of))
    states = normalizer.normalize_states(windows.states)
    losses, clones = [], []
    for longest in (1, D):
        guess, generator = make_guess(), th.Generator().manual_seed(0)
        assert fit_first_guess(guess, source, normalizer, PlannerConfig(), 150, generator, longest)
        with th.no_grad():
            losses.append(guess.model.loss(states, windows.actions[:, :-1], windows.valid[:, 1:]).item())
        clones.append(guess.clone.state_dict())
    assert losses[1] < 0.9 * losses[0], losses
    assert all(th.equal(weight, clones[1][name]) for name, weight in clones[0].items())


def test_the_clone_does_what_weighs_more_and_moves_are_the_data_s():
    """Half of the windows do 0.8 at value 1, the others -0.8 at value 0: at beta 3 the first weigh 20 times as much."""
    source, generator = make_source(40, 20), th.Generator().manual_seed(0)
    is_good = source.envs % 2 == 0
    actions = th.where(th.arange(40) % 2 == 0, 0.8, -0.8)[None, :, None].expand_as(source.actions).clone()
    source = replace(source, actions=actions, values=is_good.float())
    normalizer = Normalizer(STATE_DIM, ACTION_DIM, L, "standard", relative_states=True)
    normalizer.fit(source.start_states(), source.start_actions())
    normalizer.fit_moves(source.sample(1_000, L, generator))
    guess = make_guess()
    fit_first_guess(guess, source, normalizer, PlannerConfig(weight_factor=3.0), 150, generator, D)
    assert th.equal(guess.model.move_std, normalizer.move_std[0]) and not th.allclose(guess.model.move_std, th.ones(2))
    with th.no_grad():
        done = guess.clone(normalizer.normalize_states(source.start_states())).mean()
    share = 1 / (1 + th.e**-3)
    th.testing.assert_close(done, th.tensor(0.8 * (2 * share - 1)), atol=0.1, rtol=0)


def test_older_steps_teach_the_model_and_not_the_clone():
    """They have another behaviour, and move as the task does."""
    newest, older = make_source(2, 6), make_source(100, 20, seed=1)
    actions = (older.actions - 0.7).clamp(-1.0, 1.0)
    states = older.states.clone()
    for t in range(1, len(states)):
        states[t] = next_state(states[t - 1], actions[t - 1])
    older = replace(older, states=states, actions=actions)
    normalizer = Normalizer(STATE_DIM, ACTION_DIM, L, "standard", relative_states=True)
    normalizer.fit(older.start_states(), older.start_actions())
    errors, clones = {}, {}
    for name, given_older in (("newest alone", None), ("both", older)):
        guess, generator = make_guess(), th.Generator().manual_seed(0)
        fit_first_guess(guess, newest, normalizer, PlannerConfig(), 70, generator, D, older=given_older)
        states, actions = (2 * th.rand(500, n, generator=generator) - 1 for n in (STATE_DIM, ACTION_DIM))
        with th.no_grad():
            z = normalizer.normalize_states(states)
            moved = guess.model(z, actions) - normalizer.normalize_states(next_state(states, actions))
            errors[name] = moved.abs().mean()
            clones[name] = guess.clone(normalizer.normalize_states(newest.start_states()))
    assert errors["both"] < 0.5 * errors["newest alone"]
    th.testing.assert_close(clones["both"], clones["newest alone"], atol=0.1, rtol=0)


def make_trainer(
    gradient_steps: int = 12, n_episodes: int = 40, length: int = 20, max_delay: int = D, **changes
) -> PlannerTrainer:
    small = dict(depth=1, d_model=32, horizon=HORIZON, batch_size=16, warmup_steps=4)
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        planner = InpaintingPlanner(STATE_DIM, ACTION_DIM, max_delay, PlannerConfig(**{**small, **changes}))
    return PlannerTrainer(planner, make_source(n_episodes, length), gradient_steps, guess_steps=D)


def test_a_training_with_it_resumes_bit_for_bit():
    whole, first, second = (make_trainer() for _ in range(3))
    whole.train()
    first.train(5)
    second.load_state_dict(first.state_dict())
    second.train()
    for name, weight in second.planner.state_dict().items():
        assert th.equal(weight, whole.planner.state_dict()[name]), name
    with pytest.raises(ValueError, match="first_guess was prior and is now none"):
        make_trainer(first_guess="none").load_state_dict(first.state_dict())


def test_a_training_whose_guess_is_made_goes_on_with_it():
    whole, other, made = make_trainer(2), make_trainer(2), make_trainer(2)
    before = whole.state_dict()
    whole.make_first_guess()
    other.load_state_dict(whole.state_dict())
    for each in (whole, other):
        each.train()
    for name, weight in other.average.state_dict().items():
        assert th.equal(weight, whole.average.state_dict()[name]), name
    made.make_first_guess()
    made.load_state_dict(before)  # of one that has none
    made.train()
    assert made.average.prior.is_fitted


def test_it_is_made_once_and_then_stays():
    trainer = make_trainer()
    trainer.step()
    made = {name: weight.clone() for name, weight in trainer.average.first_guess.state_dict().items()}
    trainer.train()
    for planner in (trainer.planner, trainer.online):
        for name, weight in planner.first_guess.state_dict().items():
            assert th.equal(weight, made[name]), name


def test_of_data_too_few_for_a_prior_it_is_made_once_too(monkeypatch: pytest.MonkeyPatch):
    trainer, fits = make_trainer(n_episodes=1, length=L), []
    assert len(trainer.source) < 10
    monkeypatch.setattr(trainer_module, "fit_first_guess", lambda *_, **__: bool(fits.append(0)) or True)
    trainer.make_first_guess()
    trainer.step()
    other = make_trainer(n_episodes=1, length=L)
    other.take_first_guess(trainer.average)
    other.step()
    assert len(fits) == 1


@pytest.mark.parametrize(("gradient_steps", "most"), [(2, 10**9), (1000, 30), (1000, 10**9)])
def test_it_takes_no_more_updates_than_planner_and_data_are_worth(gradient_steps: int, most: int, monkeypatch):
    monkeypatch.setattr(trainer_module, "GUESS_UPDATES", most)
    trainer, asked = make_trainer(gradient_steps), []
    trainer.make_first_guess(should_stop=lambda: bool(asked.append(0)))
    n_updates = next(n for n in range(len(asked)) if n + math.ceil(n / ROLLED_EACH) == len(asked))
    passes = 256 * n_updates / len(trainer.source)
    assert n_updates == 5 * gradient_steps or n_updates == most or 50 <= passes < 50.5


def test_without_delay_it_has_no_model_to_train():
    """What is observed is the present: the clone's answer is all that a window is guessed from."""
    trainer = make_trainer(4, max_delay=0)
    before = {name: x.clone() for name, x in trainer.online.first_guess.state_dict().items()}
    trainer.make_first_guess()
    changed = {name for name, x in trainer.online.first_guess.state_dict().items() if not th.equal(x, before[name])}
    assert changed == {name for name in before if name.startswith("clone.")} | {"model.move_std"}


def test_it_can_be_stopped():
    trainer, asked = make_trainer(), []
    assert not trainer.make_first_guess(should_stop=lambda: asked.append(0) or len(asked) == 3)
    assert len(asked) == 3 and trainer.n_updates == 0
    trainer, asked, late = make_trainer(), [], 61  # 60 are of single steps
    assert not trainer.make_first_guess(should_stop=lambda: asked.append(0) or len(asked) == late)
    assert len(asked) == late and trainer.n_updates == 0
    assert make_trainer().make_first_guess(should_stop=lambda: False)
    assert make_trainer(first_guess="none").make_first_guess(should_stop=lambda: True)  # there is nothing to make


def test_decisions_of_mixed_ages_are_those_one_by_one():
    trainer = make_trainer(precision="float32")
    trainer.train()
    planner = trainer.planner
    generator = th.Generator().manual_seed(1)
    observation = th.randn(D + 1, STATE_DIM, generator=generator)
    history = 2 * th.rand(D + 1, D, ACTION_DIM, generator=generator) - 1
    delay = th.arange(D + 1)
    together = planner.plan(observation, history, delay, temperature=0.0)
    for i in range(D + 1):
        alone = planner.plan(observation[i : i + 1], history[i : i + 1], delay[i : i + 1], temperature=0.0)
        th.testing.assert_close(alone.action[0], together.action[i], atol=1e-5, rtol=1e-5)
        th.testing.assert_close(alone.present[0], together.present[i], atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def guessing() -> InpaintingPlanner:
    trainer = make_trainer(precision="float32", present="guessed")
    trainer.train(5)
    return trainer.planner


@th.no_grad()
def test_a_plan_from_the_guessed_present_is_the_plan_of_who_sees_it(guessing: InpaintingPlanner):
    generator = th.Generator().manual_seed(1)
    observation = th.randn(D + 1, STATE_DIM, generator=generator)
    history = 2 * th.rand(D + 1, D, ACTION_DIM, generator=generator) - 1
    noise = th.randn(3, L, STATE_DIM + ACTION_DIM, generator=generator)
    made = guessing.plan(observation, history, th.arange(D + 1), noise=noise, temperature=1.0)
    assert made.states.shape == (D + 1, 3, L, STATE_DIM)
    for d in range(D + 1):
        past = [observation[d]]
        for action in history[d, D - d :]:
            z = guessing.normalizer.normalize_states(past[-1])
            past.append(guessing.normalizer.denormalize_states(guessing.first_guess.model(z, action)))
        plan = guessing.plan(past[-1][None], history[:1], th.tensor([0]), noise=noise, temperature=1.0)
        kept = slice(d, d + HORIZON)
        for found, expected in (
            (made.present[d], past[-1]),
            (made.action[d], plan.action[0]),
            (made.states[d, :, kept], plan.states[0]),
            (made.actions[d, :, kept], plan.actions[0]),
            (made.states[d, :, :d], th.stack(past)[:d].expand(3, -1, -1)),
            (made.actions[d, :, :d], history[d, D - d :].expand(3, -1, -1)),
        ):
            th.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@th.no_grad()
def test_a_guess_is_where_a_plan_begins_and_what_the_clone_does_there(guessing: InpaintingPlanner):
    observation, history = (
        th.randn(D + 1, STATE_DIM, generator=th.Generator().manual_seed(3)),
        th.ones(D + 1, D, ACTION_DIM),
    )
    present, action = guessing.guess(observation, history, th.arange(D + 1))
    plan = guessing.plan(observation, history, th.arange(D + 1), temperature=0.0)
    th.testing.assert_close(present, plan.present)
    assert th.equal(present[0], observation[0])
    clone = guessing.first_guess.clone(guessing.normalizer.normalize_states(present)).clamp(-1, 1)
    th.testing.assert_close(action, clone, atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="delay"):
        guessing.guess(observation, history, th.arange(D + 1) + 1)
    with pytest.raises(ValueError, match="no first guess"):
        make_trainer(first_guess="none").planner.guess(observation, history, th.arange(D + 1))


@th.no_grad()
def test_a_plan_from_the_guessed_present_is_another_one_and_its_candidates_are_chosen(guessing: InpaintingPlanner):
    observation, history, delay = th.ones(2, STATE_DIM), th.ones(2, D, ACTION_DIM), th.tensor([D, D])
    asked = dict(noise=th.randn(3, L, STATE_DIM + ACTION_DIM, generator=th.Generator().manual_seed(0)), temperature=1.0)
    by_action = guessing.plan(observation, history, delay, lambda _, actions: actions[..., 0], **asked)
    assert th.equal(by_action.action[:, 0], by_action.actions[:, :, D, 0].max(1).values)
    guessing.config = replace(guessing.config, present="inpainted")
    assert not th.allclose(guessing.plan(observation, history, delay, **asked).action, by_action.action, atol=1e-3)
    guessing.config = replace(guessing.config, present="guessed")


def test_a_planner_of_windows_that_begin_at_the_present_decides_at_every_age():
    trainer = make_trainer(precision="float32", mask="none")
    trainer.train()
    planner = trainer.planner
    planner.check_ages([0, D])
    observation, history = th.ones(D + 1, STATE_DIM), th.zeros(D + 1, D, ACTION_DIM)
    plan = planner.plan(observation, history, th.arange(D + 1))
    assert th.equal(plan.present[0], observation[0])
    for d in range(1, D + 1):
        alone = planner.plan(plan.present[d : d + 1], history[:1], th.tensor([0]))
        th.testing.assert_close(alone.action[0], plan.action[d], atol=1e-5, rtol=1e-5)
    errors = trainer.evaluate()
    assert {f"planner/present_error{who}_d{d}" for who in ("", "_mlp") for d in range(D + 1)} < set(errors)


def test_without_a_guess_no_present_can_be_guessed():
    for changes in ({"first_guess": "none"}, {"mask": "fixed"}):
        with pytest.raises(ValueError, match="expected a first_guess"):
            PlannerConfig(present="guessed", **changes)


def fitted(source):
    normalizer = Normalizer(STATE_DIM, ACTION_DIM, L, "standard", relative_states=True)
    normalizer.fit(source.start_states(), source.start_actions())
    return normalizer


def test_a_part_of_its_windows_begins_early_in_episodes(monkeypatch):
    drawn, source = watch_samples(monkeypatch), make_source(10, 8)
    config, older = PlannerConfig(early_probability=0.4), make_source(10, 8, seed=1)
    fit_first_guess(make_guess(), source, fitted(source), config, 2, th.Generator(), D, older=older)
    asked = {(one is source, early_probability) for one, _, early_probability in drawn}
    assert asked == {(True, 0.4), (False, 0.4)}  # of the newest and of the older steps


def test_its_rates_fall_to_0_and_many_steps_at_once_have_small_and_clipped_ones(monkeypatch):
    steps = watch_adam(monkeypatch)
    monkeypatch.setattr(first_guess_module, "ROLLED_CLIP", 1e-3)
    source = make_source(10, 8)
    fit_first_guess(make_guess(), source, fitted(source), PlannerConfig(), 32, th.Generator(), D)
    rates, norms = zip(*steps, strict=True)
    assert [len(each) for each in rates] == [2] * 32 + [1] * 2  # of model and clone, then of the model alone
    single, rolled = np.array(rates[:32]), np.array(rates[32:])[:, 0]
    falls = 0.5 + 0.5 * np.cos(np.pi * np.arange(32) / 32)
    np.testing.assert_allclose(single, np.outer(falls, [OneStepModel.learning_rate, CLONE_LEARNING_RATE]))
    np.testing.assert_allclose(rolled, ROLLED_RATE * OneStepModel.learning_rate * np.array([1.0, 0.5]))
    assert min(norms[:32]) > 1e-3 and max(norms[32:]) < 1.001e-3


def test_older_steps_are_handed_to_its_model(monkeypatch):
    older, given = make_source(5, 9, seed=1), []
    monkeypatch.setattr(trainer_module, "fit_first_guess", lambda *args, older, **kwargs: given.append(older) or True)
    planner = make_trainer().planner
    PlannerTrainer(planner, make_source(40, 20), 2, older=older).make_first_guess()
    assert th.equal(given[0].states, older.states)
