"""``mask="own"``: an agent that does one thing on new observations and another on old ones is imitated at each age."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.replay.windows import WindowSource

D, LENGTH, N_EPISODES = 2, 12, 80
QUICK = dict(
    depth=1,
    d_model=32,
    horizon=2,
    batch_size=64,
    warmup_steps=10,
    sampling_steps=2,
    first_guess="none",
    early_probability=0.0,
)


def make_source() -> WindowSource:
    """States drawn anew at every step; an agent does a = s at age 0, and a = -s_{t-d} at ages d of 1 and 2.

    Half of the episodes are of delay 0, and half of 2, where s_0 ages until a younger state arrives.
    """
    n = N_EPISODES * LENGTH
    states = 2 * th.rand(n, 1, 1, generator=th.Generator().manual_seed(0)) - 1
    rows, step = th.arange(n), th.arange(n) % LENGTH
    episodes = rows // LENGTH
    ages = th.where(episodes % 2 == 0, 0, step.clamp(max=D))
    actions = th.where((ages == 0)[:, None], states[:, 0], -states[rows - ages, 0])
    none = th.zeros(n, 1)
    starts = rows, th.zeros_like(rows), LENGTH - step, episodes, none[:, 0]
    return WindowSource(states, actions[:, None], none, none.bool(), *starts, ages)


def train(mask: str, source: WindowSource, n_steps: int = 150) -> PlannerTrainer:
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        planner = InpaintingPlanner(1, 1, D, PlannerConfig(**{**QUICK, "mask": mask}))
    trainer = PlannerTrainer(planner, source, n_steps, held_out=0.1, seed=0)
    trainer.train()
    return trainer


def slope(trainer: PlannerTrainer, age: int) -> float:
    """How the decision at an age goes with the state that is seen."""
    generator = th.Generator().manual_seed(1)
    seen = 1.6 * th.rand(200, 1, generator=generator) - 0.8
    history = th.zeros(200, D, 1)
    history[:, D - age :] = 1.6 * th.rand(200, age, 1, generator=generator) - 0.8
    action = trainer.planner.plan(seen, history, th.full((200,), age), temperature=0.0).action
    return float(np.polyfit(seen[:, 0], action[:, 0], 1)[0])


def test_each_age_has_its_own_answer_and_without_it_their_mean():
    source = make_source()
    own, mixed = train("own", source), train("random", source)
    assert slope(own, 0) == pytest.approx(1.0, abs=0.15) and slope(own, 2) == pytest.approx(-1.0, abs=0.15)
    assert 0.25 < slope(mixed, 0) < 0.8  # half, and what is known by heart
    errors, mean_errors = own.evaluate(), mixed.evaluate()
    for age in (0, 2):  # on held-out decisions of that age, and of any
        assert errors[f"planner/action_error_d{age}"] < 0.1 < mean_errors[f"planner/action_error_d{age}"]


def test_where_the_data_know_no_ages_delays_are_drawn_as_at_random():
    source = replace(make_source(), ages=None)
    weights = [train(mask, source, 5).planner.state_dict() for mask in ("own", "random")]
    assert all(th.equal(a, b) for a, b in zip(weights[0].values(), weights[1].values(), strict=True))


def test_the_present_is_inpainted_unless_asked():
    assert PlannerConfig(mask="own").present == "inpainted"
    assert PlannerConfig(mask="own", present="guessed").present == "guessed"
