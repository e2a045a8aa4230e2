"""Beliefs of the present: right where they can be, compounding where they are rolled out, and acted on."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from linear_system import make_source
from small_agent import make, observe
from small_planner import make_batch, make_planner
from small_task import Drift, delayed
from test_bc import demonstrations
from test_bc import make as make_bc
from watching import watch_adam, watch_samples

from sb3_said import DelayedObservationWrapper, DelayedSAC
from sb3_said.evaluation import rollout
from sb3_said.offline.belief import (
    BeliefOnly,
    PlannerBelief,
    RegressedPresent,
    RolledOutModel,
    belief_error,
    train_belief,
)
from sb3_said.planner.plain import FARTHEST

DELAY = 3


class Truth:
    """Knows the task of the demonstrations: s' = 0.9 s + 0.3 a."""

    max_delay = DELAY

    def present(self, state, action_history, delay):
        for k in range(DELAY):
            is_since = (DELAY - k <= delay)[:, None]
            state = th.where(is_since, 0.9 * state + 0.3 * action_history[:, k], state)
        return state


@pytest.fixture(scope="module")
def source():
    replay = make_bc()
    replay.take_dataset(demonstrations(60))
    return replay.replay_buffer.window_source()


@pytest.fixture(scope="module", params=[RolledOutModel, RegressedPresent])
def learned(request, source):
    th.manual_seed(0)
    belief = request.param(2, 1, DELAY)
    train_belief(belief, source, 300, batch_size=64)
    return belief


def held_out():
    replay = make_bc()
    replay.take_dataset(demonstrations(20, seed=1))
    return replay.replay_buffer.window_source().gather(th.arange(500), DELAY + 1)


def test_a_learned_belief_knows_a_deterministic_task(learned):
    errors = [belief_error(learned, held_out(), delay) for delay in range(DELAY + 1)]
    stale = [belief_error(Stale(), held_out(), delay) for delay in range(DELAY + 1)]
    assert max(errors) < 0.15 and all(e < 0.25 * s for e, s in zip(errors[1:], stale[1:], strict=True))
    if isinstance(learned, RolledOutModel):
        assert errors[0] == pytest.approx(0, abs=1e-6) and errors == sorted(errors)  # they compound


@pytest.mark.parametrize("kind", [RegressedPresent, RolledOutModel])
def test_without_delay_the_present_is_what_was_seen(kind):
    belief = kind(2, 1, 0)
    replay = make_bc()
    replay.take_dataset(demonstrations(4))
    train_belief(belief, replay.replay_buffer.window_source(), 3)
    state = th.ones(1, 2)
    present = belief.present(state, th.zeros(1, 0, 1), th.zeros(1, dtype=th.int64)).detach()
    assert present.shape == (1, 2) and (kind is RegressedPresent or th.allclose(present, state))


@th.no_grad()
def test_a_model_that_runs_away_is_stopped():
    belief = RolledOutModel(2, 1, DELAY)
    belief.model.net[-1].weight *= 1e30
    present = belief.present(th.randn(4, 2), th.rand(4, DELAY, 1), th.arange(4))
    assert present[1:].abs().min() == present[1:].abs().max() == FARTHEST


class Stale(Truth):
    def present(self, state, action_history, delay):
        return state


def test_the_truth_has_no_error_and_each_row_its_own_delay(learned):
    windows = held_out()
    assert max(belief_error(Truth(), windows, delay) for delay in range(DELAY + 1)) < 1e-6
    history, delay = th.rand(4, DELAY, 1), th.tensor([0, 1, 2, 3])
    state = th.randn(4, 2)
    with th.no_grad():
        together = learned.present(state, history, delay)
        alone = [learned.present(state[i : i + 1], history[i : i + 1], delay[i : i + 1]) for i in range(4)]
        th.testing.assert_close(together, th.cat(alone))
        other = history.clone()
        other[1, : DELAY - 1] = 9.0  # sent before the observation of age 1: it holds all that they did
        th.testing.assert_close(learned.present(state, other, delay), together)


def test_a_planners_belief_repeats_and_keeps_what_is_known():
    planner = make_planner(DELAY)
    state, history, delay = make_batch(6, DELAY)
    delay[0] = 0
    belief = PlannerBelief(planner)
    present = belief.present(state, history, delay)
    th.testing.assert_close(belief.present(state, history, delay), present, rtol=0, atol=0)
    th.testing.assert_close(present[0], state[0])  # nothing is hidden at age 0
    guessed = PlannerBelief(planner, "guessed").present(state, history, delay)
    planner.config = replace(planner.config, present="guessed", decided_by="actor")
    th.testing.assert_close(PlannerBelief(planner).present(state, history, delay), present, rtol=0, atol=0)
    planner.config = replace(planner.config, present="inpainted", decided_by="plan")
    plan = planner.plan(state, history, delay, n_candidates=1, temperature=0.0)  # as it was set before
    th.testing.assert_close(present, plan.states[th.arange(6), 0, delay])
    assert th.equal(guessed[0], state[0]) and (guessed[delay > 0] - present[delay > 0]).abs().min(1).values.max() > 1e-3


def test_moves_are_those_within_episodes_whatever_stands_side_by_side():
    """Episodes far apart, a step in each of three environments in a row."""
    source = make_source(3, 20)
    apart = source.states.clone()
    apart[..., 0] = 0.01 * th.arange(20.0)[:, None] + 100 * th.arange(3.0)
    belief = RolledOutModel(2, 1, DELAY)
    belief.fit_scale(replace(source, states=apart))
    th.testing.assert_close(belief.model.move_std[0], 0.01 / belief.std[0], rtol=1e-2, atol=0)


def test_an_entry_that_never_moves_stays_finite():
    belief, source = RolledOutModel(2, 1, DELAY), make_source(1, 9)
    states = th.stack([th.arange(9.0), th.full((9,), 4.0)], dim=1)[:, None]
    belief.fit_scale(replace(source, states=states))
    assert belief.model.move_std[1] == 1.0 and belief.model.move_std[0] > 0
    assert belief.present(th.tensor([[3.0, 4.0]]), th.zeros(1, DELAY, 1), th.tensor([DELAY])).isfinite().all()


def test_an_error_is_in_deviations_of_states_that_are_in_an_episode():
    """Rows behind an end repeat the last one."""
    windows = held_out()
    states, valid = windows.states.clone(), windows.valid.clone()
    valid[:100, 2:], states[:100, 2:] = False, 1e3
    spread = states[valid].std(0, correction=0)
    expected = (((states[:, 0] - states[:, 2]) / spread) ** 2)[valid[:, 2]].mean().sqrt()
    found = belief_error(Stale(), windows._replace(states=states, valid=valid), 2)
    assert found == pytest.approx(expected.item(), rel=1e-5)


def test_an_entry_that_never_moves_does_not_blow_an_error_up():
    windows = held_out()
    error = belief_error(Stale(), windows, 2)
    states = th.cat([windows.states, th.full_like(windows.states[..., :1], 5.0)], -1)

    class Nearly(Stale):
        def present(self, state, action_history, delay):
            return state + 1e-3 * th.tensor([0.0, 0.0, 1.0])

    assert belief_error(Nearly(), windows._replace(states=states), 2) == pytest.approx((2 / 3) ** 0.5 * error, rel=1e-3)


def test_no_window_reaches_a_delay_that_no_episode_does():
    windows = held_out()
    with pytest.raises(ValueError, match="No window has 4 steps of one episode"):
        belief_error(Truth(), windows._replace(valid=windows.valid & (th.arange(4) < 3)), DELAY)


class Sees:
    """An actor without delay that keeps what it was shown, and answers a = -s / 2."""

    observation_space = Drift.observation_space

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.seen = observation
        return -0.5 * observation[:, :1], state


def test_an_actor_is_shown_the_present(source):
    """On the true belief, it acts under delay as it does without."""

    class Drifting(Truth):
        def present(self, state, action_history, delay):
            for k in range(DELAY):
                is_since = (DELAY - k <= delay)[:, None]
                moved = 0.9 * state + 0.1 * th.cat([2 * action_history[:, k], state[:, :1]], 1)
                state = th.where(is_since, moved, state)
            return state

    env, plain, agent = delayed(DELAY), Drift(), BeliefOnly(Drifting(), Sees())
    obs, state = env.reset(seed=3)[0], plain.reset(seed=3)[0]
    for _ in range(8):
        action, _ = agent.predict(obs)
        np.testing.assert_allclose(action, -0.5 * state[:1], atol=1e-5)
        obs, state = env.step(action)[0], plain.step(action)[0]
    batch = {key: np.stack([value] * 2) for key, value in obs.items()}
    assert agent.predict(batch)[0].shape == (2, 1)
    played = rollout(agent, lambda: delayed(DELAY), 3, seed=0, n_envs=2)
    assert len(played.returns) == 3


@pytest.mark.parametrize("state_history", [False, True])
def test_an_actor_of_ours_is_asked_at_age_0(state_history, recwarn):
    env = DelayedObservationWrapper(Drift(), (0, 2), state_history=state_history)
    actor = DelayedSAC("MlpPolicy", env, buffer_size=100, device="cpu", policy_kwargs={"net_arch": [8]})
    actor.trained_ages = [0]
    obs = delayed(DELAY).reset(seed=0)[0] | {"delay": np.array([2.0]), "action_history": np.full((DELAY, 1), 0.5)}
    agent = BeliefOnly(Truth(), actor)
    action, _ = agent.predict(obs, deterministic=True)
    present = agent.present({key: value[None] for key, value in obs.items()})[0]
    shown = {"observation": present, "action_history": np.zeros((2, 1)), "delay": np.zeros(1)}
    shown |= {"state_history": np.zeros((2, 2)), "state_known": np.zeros(2)} if state_history else {}
    np.testing.assert_array_equal(action, actor.predict(shown, deterministic=True)[0])
    assert not [w for w in recwarn if "learned at ages" in str(w.message)]


@pytest.mark.parametrize("actors_delay", [2, 5])
def test_an_actor_of_two_is_asked_as_amid_the_episode(actors_delay):
    """No actions at all are how an episode begins, where the one of the largest age decides."""
    actor = make(delayed(delay=(0, actors_delay)), planner_kwargs={"temperature": 0.0}, planner_gradient_steps=1)
    actor.learn(30)
    actor.set_answer("both", expert_up_to=1)
    agent, obs = BeliefOnly(Truth(), actor), observe(env=delayed(delay=DELAY))
    found = agent.predict(obs, deterministic=True)[0]
    none = np.zeros((len(found), actors_delay, 1), np.float32)
    shown = {"observation": agent.present(obs), "action_history": none, "delay": np.zeros((len(found), 1), np.float32)}
    with actor.policy.answering("expert"):
        experts = actor.predict(shown, deterministic=True)[0]
    with actor.policy.answering("planner"):
        planners = actor.predict(shown, deterministic=True)[0]
    begins = (obs["action_history"][:, -actors_delay:] == 0).all((1, 2))
    assert begins.any() and not begins.all()
    np.testing.assert_allclose(found, np.where(begins[:, None], planners, experts), atol=1e-6)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="expected states, or those of a DelayedObservationWrapper"):
        BeliefOnly(Truth(), type("Other", (), {"observation_space": None})())
    with pytest.raises(ValueError, match="The actor learned with VecNormalize"):
        BeliefOnly(Truth(), type("Scaled", (Sees,), {"reads_normalized": True})())
    with pytest.raises(ValueError, match=r"serves delays up to 3, but the action history has 2 rows"):
        BeliefOnly(Truth(), Sees()).predict(delayed(2).reset(seed=0)[0])


def test_a_belief_draws_by_its_seed_and_its_rate_falls_to_0(monkeypatch):
    replay = make_bc()
    replay.take_dataset(demonstrations(4))
    drawn, steps = watch_samples(monkeypatch), watch_adam(monkeypatch)
    train_belief(RolledOutModel(2, 1, 3), replay.replay_buffer.window_source(), 10, seed=7)
    assert [generator.initial_seed() for _, generator, _ in drawn] == [7] * 10
    rates = [rate for (rate,), _ in steps]
    np.testing.assert_allclose(rates, RolledOutModel.learning_rate * (0.5 + 0.5 * np.cos(np.pi * np.arange(10) / 10)))
