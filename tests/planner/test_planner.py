"""The planner: loss, plans, selection, refusals."""

import math

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from small_planner import (
    ACT,
    DELAY,
    LENGTH,
    OBS,
    SMALL,
    FakeNetwork,
    existing,
    good,
    make_batch,
    make_planner,
    make_windows,
    seeded,
)
from torch.utils.flop_counter import FlopCounterMode

from sb3_said.planner import InpaintingPlanner, precision
from sb3_said.planner.diffusion import alpha_sigma, draw_times
from sb3_said.planner.selection import choose

# --- loss ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
@pytest.mark.parametrize("schedule", ["cosine", "linear"])
@pytest.mark.parametrize("relative", [True, False])
def test_loss_against_a_naive_computation(prediction, schedule, relative):
    changes = {"prediction": prediction, "schedule": schedule, "relative_states": relative, "decision_weight": 3.0}
    planner, windows = make_planner(**changes, first_guess="none"), make_windows()
    planner.normalizer.move_std.uniform_(0.5, 2.0, generator=seeded(5))
    n = len(windows.states)
    delay, weight = th.tensor([0, 1, 2, 3, 4, 4]), th.rand(n)
    planner.network = network = FakeNetwork(th.randn(n, LENGTH, OBS + ACT))
    loss = planner.loss(windows, delay, weight, seeded())

    generator = seeded()
    noise = th.randn(n, LENGTH, OBS + ACT, generator=generator)
    t = draw_times(n, schedule, planner.config.time_sampling, planner.config.end_time_probability, generator)
    normalizer, total, count = planner.normalizer, 0.0, 0
    exists = existing(windows, delay)
    assert not th.equal(exists, windows.valid)
    for b in range(n):
        alpha, sigma = alpha_sigma(t[b], schedule)
        for k in range(LENGTH):
            state = (windows.states[b, k] - normalizer.state_mean) / normalizer.state_std
            if relative and k > 0:
                moved = (windows.states[b, k] - windows.states[b, 0]) / normalizer.state_std
                state = moved / normalizer.move_std[k - 1]
            action = (windows.actions[b, k] - normalizer.action_mean) / normalizer.action_std
            clean = th.cat([state, action])
            for j in range(OBS + ACT):
                if not exists[b, k]:
                    assert not network.known[b, k, j]
                    continue
                known = k == 0 if j < OBS else k < delay[b]
                assert network.known[b, k, j] == known
                noisy = alpha * clean[j] + sigma * noise[b, k, j]
                th.testing.assert_close(network.x[b, k, j], clean[j] if known else noisy)
                if not known:
                    v = alpha * noise[b, k, j] - sigma * clean[j]
                    target = {"v": v, "epsilon": noise[b, k, j]}[prediction]
                    share = 3.0 if k == delay[b] else 1.0
                    total += weight[b] * share * (network.output[b, k, j] - target) ** 2
                    count += share
    th.testing.assert_close(loss, total / count, atol=1e-5, rtol=1e-5)
    assert th.equal(network.valid, exists) and th.equal(network.t, t)


def test_loss_has_no_gradient_at_known_and_padded_entries():
    planner, windows = make_planner(), make_windows()
    planner.network = network = FakeNetwork(th.randn(6, LENGTH, OBS + ACT, requires_grad=True))
    delay = th.tensor([0, 1, 2, 3, 4, 4])
    planner.loss(windows, delay, generator=seeded()).backward()
    learned = existing(windows, delay)[..., None] & ~network.known
    assert th.equal(network.output.grad != 0, learned) and not learned.all()


def test_loss_does_not_depend_on_what_pads():
    planner, windows = make_planner(), make_windows()
    behind = ~windows.valid[..., None]
    other = windows._replace(
        states=th.where(behind, 1e3, windows.states), actions=th.where(behind, -1.0, windows.actions)
    )
    delay = th.full((6,), DELAY)
    losses = [planner.loss(batch, delay, generator=seeded()).item() for batch in (windows, other)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5) and behind.any()


def test_weight_scales_the_loss_and_each_window():
    planner, windows = make_planner(), make_windows()
    delay = th.full((6,), 2)
    plain = planner.loss(windows, delay, generator=seeded())
    th.testing.assert_close(planner.loss(windows, delay, th.full((6,), 0.25), seeded()), 0.25 * plain)
    parts = [planner.loss(windows, delay, weight, seeded()) for weight in th.eye(6)]
    th.testing.assert_close(sum(parts), plain)


def test_loss_draws_mask_lengths_from_its_generator():
    planner, windows = make_planner(), make_windows()
    assert planner.loss(windows, generator=seeded(3)) == planner.loss(windows, generator=seeded(3))
    planner.network = network = FakeNetwork(th.zeros(6, LENGTH, OBS + ACT))
    full = windows._replace(valid=th.ones(6, LENGTH, dtype=th.bool))
    lengths = set()
    for seed in range(20):
        planner.loss(full, generator=seeded(seed))
        lengths |= set(network.known[:, :, -1].sum(1).tolist())
    assert lengths == set(range(DELAY + 1))


def test_window_that_is_all_known_gives_zero_not_nan():
    windows = make_windows(1)._replace(valid=th.arange(LENGTH)[None] < 1)
    assert make_planner().loss(windows, th.tensor([DELAY])) == 0.0


def test_bfloat16_keeps_loss_gradients_and_state_in_float32():
    planner, reference = make_planner(precision="bfloat16"), make_planner()
    windows, delay = make_windows(), th.tensor([0, 1, 2, 3, 4, 4])
    loss = planner.loss(windows, delay, generator=seeded())
    assert loss.dtype == th.float32
    assert loss.item() == pytest.approx(reference.loss(windows, delay, generator=seeded()).item(), rel=0.02)
    loss.backward()
    assert all(p.grad.dtype == th.float32 and p.grad.isfinite().all() for p in planner.network.parameters())
    batch = make_batch(8)
    plan, exact = (p.plan(*batch, n_candidates=4, generator=seeded()) for p in (planner, reference))
    assert plan.states.dtype == th.float32 and not th.equal(plan.states, exact.states)
    scale = planner.normalizer.state_std
    assert ((plan.states - exact.states) / scale).abs().mean() < 0.05 * (exact.states / scale).std()


def test_autocast_follows_the_precision():
    cpu = th.device("cpu")
    seen = {}
    for name in ("float32", "bfloat16", "auto"):
        with precision.autocast(name, cpu):
            seen[name] = th.nn.Linear(2, 2)(th.zeros(1, 2)).dtype
    auto = th.bfloat16 if precision.has_bfloat16(cpu) else th.float32
    assert seen == {"float32": th.float32, "bfloat16": th.bfloat16, "auto": auto}
    assert not precision.has_bfloat16(th.device("mps"))
    assert precision.compute_dtype("auto", cpu, precision.SMALL) == auto
    assert precision.compute_dtype("auto", cpu, precision.SMALL - 1) == th.float32
    assert precision.compute_dtype("bfloat16", cpu, 1) == th.bfloat16


def test_a_small_decision_is_made_in_float32_at_every_age(monkeypatch):
    monkeypatch.setattr(precision, "has_bfloat16", lambda device: True)
    planner, reference = make_planner(precision="auto"), make_planner(precision="float32")
    n_large = math.ceil(precision.SMALL / (LENGTH * SMALL.d_model))
    for n, is_small in ((1, True), (n_large - 1, True), (n_large, False)):
        batch = make_batch(n)
        for delay in (0, DELAY):
            ages = th.full((n,), delay)
            plans = [p.plan(*batch[:2], ages, temperature=0.0).action for p in (planner, reference)]
            assert th.equal(*plans) == is_small


def test_windows_that_begin_at_the_present_are_learned_as_those_of_age_0():
    planners = [make_planner(mask=mask, present="guessed") for mask in ("random", "none")]
    windows = make_windows()
    delays = th.zeros(len(windows.states), dtype=th.int64)
    noise = th.randn(len(windows.states), SMALL.horizon, OBS + ACT, generator=seeded(2))
    for planner in planners:  # noise is drawn for as many steps as are computed
        planner._noise = lambda shape, _: F.pad(noise, (0, 0, 0, shape[1] - noise.shape[1]))
    losses = [planner.loss(windows, delays, generator=seeded()) for planner in planners]
    th.testing.assert_close(*losses, atol=1e-6, rtol=1e-5)
    drawn = planners[1].loss(windows, generator=seeded())
    th.testing.assert_close(drawn, losses[1], atol=1e-6, rtol=1e-5)


# --- plan ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transform", ["standard", "tanh"])
@pytest.mark.parametrize("max_delay", [0, DELAY])
def test_known_entries_come_back_exactly_at_mixed_delays(max_delay, transform):
    planner = make_planner(max_delay, action_transform=transform)
    delay = th.arange(max_delay + 1).repeat(2)
    observation, history, _ = make_batch(len(delay), max_delay)
    plan = planner.plan(observation, history, delay, n_candidates=3)
    length = max_delay + SMALL.horizon
    assert plan.states.shape == (len(delay), 3, length, OBS) and plan.actions.shape[-2:] == (length, ACT)
    assert plan.action.shape == (len(delay), ACT) and (plan.values == 0).all()
    for b, d in enumerate(delay):
        for n in range(3):
            assert th.equal(plan.states[b, n, 0], observation[b])
            assert th.equal(plan.actions[b, n, :d], history[b, max_delay - d :])
        assert th.equal(plan.action[b], plan.actions[b, 0, d])
    assert plan.actions.abs().max() <= 1 and plan.states.isfinite().all()
    assert not th.equal(plan.states[:, 0, 1:], plan.states[:, 1, 1:])  # candidates differ where nothing is known


def test_unknown_part_depends_on_all_that_is_known_and_on_nothing_else():
    planner = make_planner(temperature=0.0)
    observation, history, _ = make_batch(1)

    def present(observation, history, d):
        return planner.plan(observation, history, th.tensor([d])).states[0, 0, d]

    for d in range(1, DELAY + 1):
        base = present(observation, history, d)
        for k in range(DELAY):
            changed = history.clone()
            changed[0, k] *= -1
            assert th.equal(present(observation, changed, d), base) == (k < DELAY - d)  # too old to matter, or known
        assert not th.equal(present(observation + 1, history, d), base)


def test_every_network_call_sees_the_known_entries_clean():
    planner = make_planner()
    observation, history, delay = make_batch(5)
    clean = planner.plan(observation, history, delay, temperature=0.0, sampling_steps=1)
    normal = th.cat(
        [planner.normalizer.normalize_states(clean.states), planner.normalizer.normalize_actions(clean.actions)], -1
    )
    known = th.zeros(5, 1, LENGTH, OBS + ACT, dtype=th.bool)
    known[:, :, 0, :OBS] = True
    for b, d in enumerate(delay):
        known[b, :, :d, OBS:] = True
    seen = []
    planner.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    planner.plan(observation, history, delay, n_candidates=3, sampling_steps=4)
    assert len(seen) == 4
    for x in seen:
        x = x.unflatten(0, (5, 3))
        th.testing.assert_close(x[known.expand_as(x)], normal.expand_as(x)[known.expand_as(x)])


@pytest.mark.parametrize("scored_states", ["future", "all"])
def test_selection_scores_the_right_states_and_takes_the_best(scored_states):
    planner = make_planner(scored_states=scored_states)
    observation, history, delay = make_batch(20)

    def value_fn(states, actions):
        return states.sin().sum(-1) + actions.prod(-1)

    plan = planner.plan(observation, history, delay, value_fn, n_candidates=7, generator=seeded())
    best = []
    for b, d in enumerate(delay.tolist()):
        first = d + 1 if scored_states == "future" else 1
        scores = []
        for n in range(7):
            marks = [value_fn(plan.states[b, n, k], plan.actions[b, n, k]) for k in range(first, d + SMALL.horizon)]
            scores.append(sum(marks) / len(marks))
        th.testing.assert_close(plan.values[b], th.stack(scores), atol=1e-5, rtol=1e-4)
        best.append(int(th.stack(scores).argmax()))
        assert th.equal(plan.action[b], plan.actions[b, best[-1], d])
    assert len(set(best)) > 2  # otherwise the first could have been taken every time


@pytest.mark.parametrize("factor", [0.0, 0.7, 3.0])
def test_candidates_can_be_averaged_by_their_values(factor):
    planner, batch = make_planner(choice_factor=factor), make_batch(6)
    plan = planner.plan(*batch, value_fn=lambda s, a: s.sum(-1) + a[..., 0], generator=seeded())
    for b, d in enumerate(batch[2].tolist()):
        values, actions = plan.values[b].double().numpy(), plan.actions[b, :, d].double().numpy()
        weights = np.exp(factor * (values - values.mean()) / values.std())
        np.testing.assert_allclose(plan.action[b], np.average(actions, axis=0, weights=weights), rtol=1e-4, atol=1e-6)


@given(st.floats(0.01, 100), st.floats(-1000, 1000), st.sampled_from([1e-12, 1.0, 1e12]))
def test_weights_do_not_depend_on_the_scale_of_values(scale, shift, unit):
    actions, values = th.rand(3, 8, 2, generator=seeded()), th.randn(3, 8, generator=seeded(1))
    scaled = (unit * (scale * values.double() + shift)).float()
    th.testing.assert_close(choose(actions, scaled, 1.0), choose(actions, values, 1.0), rtol=1e-2, atol=1e-2)


def test_an_average_lies_between_no_choice_and_the_best():
    actions, values = th.rand(3, 8, 2, generator=seeded()), th.randn(3, 8, generator=seeded(1))
    rows, best = th.arange(3), values.argmax(1)
    assert th.equal(choose(actions, values, None), actions[rows, best])
    th.testing.assert_close(choose(actions, values, 1e4), actions[rows, best])
    th.testing.assert_close(choose(actions, values, 0.0), actions.mean(1))
    alike = 300 + 3e-5 * th.arange(8.0).expand(3, 8)  # one differs from the rest, by float32's rounding
    for values_alike in (th.ones(3, 8), th.zeros(3, 8), alike):  # nothing to tell them apart by
        th.testing.assert_close(choose(actions, values_alike, 1.0), actions.mean(1))
    th.testing.assert_close(choose(actions[:, :1], values[:, :1], 1.0), actions[:, 0])


def test_the_decision_alone_is_scored_at_the_present_that_all_candidates_share():
    planner = make_planner(scored_states="decision", n_candidates=5)
    observation, history, delay = make_batch(6)
    seen = []

    def value_fn(states, actions):
        seen.append((states, actions))
        return states.sum(-1) + actions[..., 0]

    plan = planner.plan(observation, history, delay, value_fn=value_fn, generator=seeded())
    (states, actions), rows = seen[0], th.arange(6)
    present, decisions = plan.states[rows, :, delay].mean(1), plan.actions[rows, :, delay]  # (6, OBS), (6, 5, ACT)
    th.testing.assert_close(plan.present, present)
    th.testing.assert_close(states, present[:, None, None].expand(6, 5, 1, OBS))
    th.testing.assert_close(actions, decisions[:, :, None])
    best = decisions[..., 0].argmax(1)  # the present is the same for all, so the actions decide
    assert th.equal(plan.action, decisions[rows, best]) and len(set(best.tolist())) > 1


def test_value_function_must_give_one_number_per_state():
    planner, batch = make_planner(), make_batch(2)
    with pytest.raises(ValueError, match="drop a last dimension of 1"):
        planner.plan(*batch, value_fn=lambda states, actions: states[..., :1])
    with pytest.raises(ValueError, match="value_fn returned NaN"):
        planner.plan(*batch, value_fn=lambda states, actions: states[..., 0] * th.nan)


@pytest.mark.parametrize("factor", [None, 1.5])
def test_a_value_of_minus_infinity_forbids_a_candidate(factor):
    settings = {"n_candidates": 9, "temperature": 1.0, "scored_states": "decision"}
    planner, batch = make_planner(choice_factor=factor, **settings), make_batch(4)

    def allowed_value(states, actions):
        middle = actions[..., 0].median(1, keepdim=True).values
        return th.where(actions[..., 0] < middle, states.sum(-1) + actions[..., 1], -th.inf)

    with pytest.raises(ValueError, match="-inf for all, so that no candidate is the best"):
        planner.plan(*batch, value_fn=lambda states, _: th.full_like(states[..., 0], -th.inf))
    plan, rows = planner.plan(*batch, value_fn=allowed_value, generator=seeded()), th.arange(4)
    assert plan.values.isinf().any() and plan.values.isfinite().any(1).all()
    for row in rows:
        is_allowed, decisions = plan.values[row].isfinite(), plan.actions[row, :, batch[2][row]]
        values = plan.values[row][is_allowed]
        z = (values - values.mean()) / values.std(correction=0).clamp(min=1e-6)
        expected = decisions[is_allowed][values.argmax()]
        if factor is not None:
            expected = (factor * z).softmax(0) @ decisions[is_allowed]
        th.testing.assert_close(plan.action[row], expected)
    for value in (-th.inf, th.inf):
        with pytest.raises(ValueError, match="-inf for all, so that no candidate is the best"):
            make_planner(choice_factor=1.0).plan(*batch, value_fn=lambda states, _, x=value: states[..., 0] * 0 + x)
    with pytest.raises(ValueError, match="temperature inf, expected"):
        planner.plan(*batch, temperature=float("inf"))


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_the_default_dtype_of_torch_is_no_matter(temperature):
    planner, batch = make_planner(temperature=temperature), make_batch(3)
    expected = planner.plan(*batch, generator=seeded())
    th.set_default_dtype(th.float64)
    try:
        found = planner.plan(*batch, generator=seeded())
    finally:
        th.set_default_dtype(th.float32)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == th.float32 and th.equal(one, other)


def test_number_of_candidates_and_steps_can_be_set_per_call():
    planner, batch, calls = make_planner(), make_batch(2), []
    planner.network.register_forward_hook(lambda *_: calls.append(1))

    def value_fn(states, actions):
        return states[..., 0]

    assert planner.plan(*batch, value_fn).values.shape == (2, 5) and len(calls) == 3
    assert planner.plan(*batch, value_fn, n_candidates=2, sampling_steps=6).values.shape == (2, 2) and len(calls) == 9
    assert planner.plan(*batch).values.shape == (2, 1)  # nothing to choose by


def test_temperature_zero_draws_one_candidate_and_no_noise():
    planner, batch = make_planner(), make_batch(3)
    plans = [planner.plan(*batch, n_candidates=9, temperature=0.0, generator=seeded(seed)) for seed in (0, 1)]
    assert plans[0].states.shape[1] == 1
    assert all(th.equal(a, b) for a, b in zip(*plans, strict=True))
    assert th.equal(planner.plan(*batch, temperature=0.0, noise=th.randn(4, LENGTH, OBS + ACT)).action, plans[0].action)


def test_noise_and_generator_repeat_a_plan():
    planner, batch = make_planner(), make_batch(3)
    noise = th.randn(4, LENGTH, OBS + ACT)
    for kwargs in ({"noise": noise}, {"n_candidates": 4, "generator": None}):
        plans = []
        for _ in range(2):
            if "generator" in kwargs:
                kwargs["generator"] = seeded()
            plans.append(planner.plan(*batch, **kwargs))
        assert plans[0].states.shape[1] == 4 and th.equal(plans[0].states, plans[1].states)
    other = planner.plan(*batch, n_candidates=4, generator=seeded(1))
    assert not th.equal(other.states, plans[0].states)
    # Temperature is a factor on the initial noise and on nothing else
    twice, half = (planner.plan(*batch, noise=noise * f, temperature=0.5 / f).states for f in (2.0, 0.5))
    th.testing.assert_close(twice, half, atol=1e-4, rtol=1e-4)


def test_each_decision_can_have_noise_of_its_own():
    planner, noise = make_planner(), th.randn(6, 3, LENGTH, OBS + ACT)
    batch = make_batch(6)
    together = planner.plan(*batch, noise=noise)
    for b in range(6):
        alone = planner.plan(*(x[b : b + 1] for x in batch), noise=noise[b])
        length = alone.states.shape[2]
        th.testing.assert_close(alone.states[0], together.states[b, :, :length], atol=1e-4, rtol=1e-4)
    with pytest.raises(ValueError, match=r"noise has the shape \(5, 3"):
        planner.plan(*batch, noise=noise[:5])


def test_decisions_and_candidates_do_not_disturb_each_other():
    planner, noise = make_planner(), th.randn(3, LENGTH, OBS + ACT)
    observation, history, delay = make_batch(6)
    together = planner.plan(observation, history, delay, noise=noise)
    order = th.tensor([3, 0, 5, 1, 4, 2])
    permuted = planner.plan(observation[order], history[order], delay[order], noise=noise[[2, 0, 1]])
    th.testing.assert_close(permuted.states, together.states[order][:, [2, 0, 1]], atol=1e-4, rtol=1e-4)
    for b in range(6):
        alone = planner.plan(observation[b : b + 1], history[b : b + 1], delay[b : b + 1], noise=noise)
        length = int(delay[b]) + SMALL.horizon  # the others' larger delays make its window no longer
        assert alone.states.shape[2] == length
        th.testing.assert_close(alone.states[0], together.states[b, :, :length], atol=1e-4, rtol=1e-4)


def test_a_decision_costs_what_its_age_costs():
    planner = make_planner(first_guess="none")  # whose steps are as many as the age has
    observation, history, _ = make_batch(1)
    costs = []
    for d in range(DELAY + 1):
        with FlopCounterMode(display=False) as counter:
            planner.plan(observation, history, th.tensor([d]), temperature=0.0)
        costs.append(counter.get_total_flops())
    # Linear in the window's length d + horizon, but for the attention's small square and what is made once
    slopes = np.diff(costs) / costs[-1]
    assert (slopes > 0.8 / (DELAY + SMALL.horizon)).all() and (slopes < 1.3 / (DELAY + SMALL.horizon)).all()


def test_state_dict_carries_weights_and_statistics():
    planner, batch = make_planner(), make_batch(3)
    other = InpaintingPlanner(OBS, ACT, DELAY, planner.config)
    other.load_state_dict(planner.state_dict())
    plans = [p.plan(*batch, n_candidates=2, generator=seeded()).states for p in (planner, other)]
    assert th.equal(*plans)


def test_plan_leaves_no_graph_and_works_with_frozen_weights():
    planner = make_planner().requires_grad_(False)
    assert not planner.plan(*make_batch(2)).states.requires_grad
    assert not make_planner().plan(*make_batch(2)).states.requires_grad


# --- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation": th.zeros(2, 4)}, r"observation has the shape \(2, 4\), expected \(any, 3\)"),
        ({"observation": th.tensor(1.0)}, r"observation has the shape \(\), expected \(any, 3\)"),
        ({"observation": th.zeros(0, 3)}, "observation is empty"),
        ({"observation": th.full((2, 3), th.nan)}, "observation has entries that are NaN or infinite"),
        ({"action_history": th.zeros(2, 3, 2)}, r"action_history has the shape \(2, 3, 2\), expected \(2, 4, 2\)"),
        ({"action_history": th.full((2, 4, 2), th.inf)}, "action_history has entries that are NaN or infinite"),
        ({"delay": th.tensor([0, 5])}, r"delay runs from 0 to 5, expected 0\.\.4"),
        ({"delay": th.tensor([-1, 0])}, r"delay runs from -1 to 0, expected 0\.\.4"),
        ({"delay": th.tensor([1.0, 2.0])}, "delay is torch.float32 .* expected integers"),
        ({"delay": th.tensor([1])}, r"delay is torch.int64 of the shape \(1,\), expected integers of the shape \(2,\)"),
        ({"n_candidates": 0}, "n_candidates is 0"),
        ({"temperature": -0.5}, "temperature -0.5"),
        ({"sampling_steps": 0}, "is 0, expected at least 1"),
        ({"noise": th.zeros(3, 1, 5)}, r"noise has the shape \(3, 1, 5\), expected \(any, 8, 5\)"),
        ({"noise": th.zeros(3, 8, 5), "n_candidates": 4}, r"noise has the shape \(3, 8, 5\), expected \(4, 8, 5\)"),
    ],
)
def test_plan_refuses_before_it_computes(changes, message):
    planner = make_planner()
    planner.network = None  # nothing may be computed
    with pytest.raises(ValueError, match=message):
        planner.plan(**(good() | changes))


def test_loss_and_normaliser_refuse():
    planner, windows = make_planner(), make_windows()
    with pytest.raises(ValueError, match=r"windows.states has the shape \(6, 5, 3\), expected \(any, 8, 3\)"):
        planner.loss(windows._replace(states=windows.states[:, :5]))
    with pytest.raises(ValueError, match=r"windows.actions has the shape"):
        planner.loss(windows._replace(actions=windows.actions[..., :1]))
    with pytest.raises(ValueError, match=r"weight has the shape \(6, 1\), expected \(6\)"):
        planner.loss(windows, weight=th.ones(6, 1))
    with pytest.raises(ValueError, match=r"delay runs from 9 to 9"):
        planner.loss(windows, th.full((6,), 9))
    with pytest.raises(ValueError, match="states has entries that are NaN"):
        planner.fit_normalizer(th.full((4, OBS), th.nan), th.zeros(4, ACT))
    with pytest.raises(ValueError, match="actions has the shape"):
        planner.fit_normalizer(th.zeros(4, OBS), th.zeros(5, ACT))
    with pytest.raises(ValueError, match="obs_dim, act_dim and max_delay are 3, 0 and -1"):
        InpaintingPlanner(3, 0, -1)
