"""The planner against a system whose hidden present and best plan are known in closed form."""

from __future__ import annotations

import itertools

import pytest
import torch as th
from linear_system import (
    ACTION_DIM,
    BEHAVIOUR_GAIN,
    BEHAVIOUR_NOISE,
    STATE_DIM,
    delayed_cost,
    make_source,
    present,
    riccati,
)

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.replay.windows import WindowSource

pytestmark = pytest.mark.slow
D = 3
GRADIENT_STEPS = 400


def train(source: WindowSource, **changes) -> PlannerTrainer:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        config = PlannerConfig(
            scored_states="future",  # the value reads no action
            first_guess="none",  # what the network makes of a window alone
            depth=2,
            d_model=64,
            horizon=5,
            batch_size=64,
            learning_rate=2e-3,
            warmup_steps=100,
            ema_decay=0.99,
            weight_factor=0.0,
            sampling_steps=5,
            mask="random",
            precision="float32",
            **changes,
        )
        planner = InpaintingPlanner(STATE_DIM, ACTION_DIM, D, config)
    trainer = PlannerTrainer(planner, source, GRADIENT_STEPS)
    trainer.train()
    return trainer


@pytest.fixture(scope="module")
def trainer() -> PlannerTrainer:
    return train(make_source())


def test_every_delay_s_present_is_decoded(trainer):
    errors = trainer.evaluate()
    for d in range(D + 1):
        # Errors are in standard deviations of the states
        assert errors[f"planner/present_error_d{d}"] < 0.05
        assert errors[f"planner/present_error_d{d}"] < errors[f"planner/present_error_mlp_d{d}"] + 0.01
        assert errors[f"planner/action_error_d{d}"] < 1.05 * errors[f"planner/action_error_mlp_d{d}"]


def test_the_present_s_error_falls_with_the_age_of_the_youngest_known_state():
    """Of a noisy system the best guess starts from that state, and older ones add nothing to it."""
    trainer = train(make_source(process_noise=0.2), extra_state_probability=0.5)
    planner, windows = trainer.planner, trainer._held_out[D]
    states, actions = windows.states[:200, : D + 1], windows.actions[:200, :D]
    n, d = len(states), th.full((len(states),), D)

    def error(guess):
        return ((guess - states[:, D]).abs() / planner.normalizer.state_std).mean().item()

    best = [error(present(states[:, k], actions, d - k)) for k in range(D + 1)]  # from s_{t-D+k}
    errors: list[list[float]] = [[] for _ in best]
    for subset in itertools.product((0.0, 1.0), repeat=D):  # of s_{t-D+1..t}
        extra = {"state_history": states[:, 1:], "state_known": th.tensor(subset).expand(n, D)}
        plan = planner.plan(states[:, 0], actions, d, temperature=0.0, **extra)
        youngest = max((k + 1 for k in range(D) if subset[k]), default=0)
        errors[youngest].append(error(plan.states[:, 0, D]))
    for k in range(D + 1):
        assert 0.95 * best[k] <= min(errors[k]) <= max(errors[k]) <= best[k] + 0.05, (errors, best)
        assert k == D or max(errors[k + 1]) < min(errors[k])
    assert errors[D] == [0.0] * 4  # s_t itself


def test_selection_by_value_approaches_the_best_plan(trainer):
    K, P = riccati()
    generator = th.Generator().manual_seed(2)

    def behaviour(observation, history, delay):
        noise = BEHAVIOUR_NOISE * th.randn(len(observation), ACTION_DIM, generator=generator)
        return noise - present(observation, history, delay) @ BEHAVIOUR_GAIN.T

    def lqr(observation, history, delay):
        return -present(observation, history, delay) @ K.T

    def value(states, actions):
        return -(states @ P * states).sum(-1)

    def planned(observation, history, delay):
        plan = trainer.planner.plan(
            observation, history, delay, value_fn=value, n_candidates=16, temperature=1.0, generator=generator
        )
        return plan.action

    costs = {f.__name__: delayed_cost(f, D, n_episodes=32) for f in (behaviour, lqr, planned)}
    # Most of what there is to gain over the data
    assert costs["planned"] < costs["lqr"] + 0.4 * (costs["behaviour"] - costs["lqr"]), costs
