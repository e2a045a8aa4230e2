"""States known beside the oldest: shown, imposed, learned around, refused."""

import dataclasses

import pytest
import torch as th
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

from sb3_said.planner import InpaintingPlanner
from sb3_said.replay.windows import Windows


def make_extra(n, max_delay=DELAY, seed=7):
    generator = th.Generator().manual_seed(seed)
    states = 5 * th.randn(n, max_delay, OBS, generator=generator)
    return {"state_history": states, "state_known": th.rand(n, max_delay, generator=generator) < 0.5}


def test_without_extra_states_everything_is_as_it_was_before_there_were_any():
    """Recorded with the planner as it was then, on a CPU."""
    th.manual_seed(3)
    planner = InpaintingPlanner(
        OBS, ACT, DELAY, dataclasses.replace(SMALL, end_time_probability=0.0, first_guess="none")
    )
    assert sum(p.numel() for p in planner.parameters()) == 44_037
    assert sum(p.double().abs().sum() for p in planner.parameters()).item() == pytest.approx(3163.8683, rel=1e-5)
    generator = seeded(1)
    for parameter in planner.parameters():
        th.nn.init.normal_(parameter, std=0.2, generator=generator)
    states, actions = th.randn(6, 8, 3, generator=generator), th.rand(6, 8, 2, generator=generator) * 2 - 1
    windows = Windows(states, actions, th.ones(6, 8, dtype=th.bool), th.ones(6))
    assert planner.loss(windows, generator=generator).item() == pytest.approx(2.797025, rel=1e-5)
    delay = th.tensor([0, 1, 2, 3, 4, 4])
    plan = planner.plan(states[:, 0], actions[:, :4], delay, n_candidates=3, generator=generator)
    assert plan.states.sum().item() == pytest.approx(-205.37096, rel=1e-4)
    assert th.rand(1, generator=generator).item() == pytest.approx(0.28567809)  # as many draws as then


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("embed_known", [True, False])
@pytest.mark.parametrize("max_delay", [0, DELAY])
def test_extra_states_come_back_exactly_in_every_candidate(max_delay, embed_known, relative):
    changes = {"relative_states": relative, "embed_known": embed_known}
    planner = make_planner(max_delay, extra_state_probability=0.5, **changes)
    delay = th.arange(max_delay + 1).repeat(4)
    observation, history, _ = make_batch(len(delay), max_delay)
    extra = make_extra(len(delay), max_delay)
    if max_delay > 0:
        extra["state_known"][-1] = True
    plan = planner.plan(observation, history, delay, n_candidates=3, **extra)
    exact = 0
    for b, d in enumerate(delay.tolist()):
        assert (plan.states[b, :, 0] == observation[b]).all()
        for k in range(max_delay - d, max_delay):
            given = (plan.states[b, :, k + 1 - (max_delay - d)] == extra["state_history"][b, k]).all()
            assert given == extra["state_known"][b, k]
            exact += int(given)
    if max_delay > 0:
        assert exact > 5
        assert (plan.states[-1, :, DELAY] == extra["state_history"][-1, -1]).all()  # s_t is known: the present is s_t


def test_every_network_call_sees_extra_states_clean_and_is_told():
    planner = make_planner(extra_state_probability=0.5, relative_states=True)
    planner.normalizer.move_std.uniform_(0.5, 2.0, generator=seeded(5))
    observation, history, _ = make_batch(4)
    delay, extra, seen = th.full((4,), DELAY), make_extra(4), []
    known = th.cat([th.ones(4, 1, dtype=th.bool), extra["state_known"]], 1)  # (4, D + 1), of indices 0..D
    states = th.cat([observation[:, None], extra["state_history"]], 1)
    normalizer = planner.normalizer
    moves = (states[:, 1:] - states[:, :1]) / normalizer.state_std / normalizer.move_std[:DELAY]
    clean = th.cat([normalizer.normalize_states(observation)[:, None], moves], 1)
    planner.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))

    def plan(state_history):
        given = {**extra, "state_history": state_history}
        return planner.plan(observation, history, delay, n_candidates=3, generator=seeded(), **given)

    base = plan(extra["state_history"])
    assert len(seen) == SMALL.sampling_steps
    for x in seen:
        shown = x.unflatten(0, (4, 3))[:, :, : DELAY + 1, :OBS]
        th.testing.assert_close(
            shown[known[:, None].expand(-1, 3, -1)], clean[:, None].expand_as(shown)[known[:, None].expand(-1, 3, -1)]
        )
    # What is not known has no influence; what is known has one on all that is not, and so has knowing it
    again = plan(extra["state_history"] + ~extra["state_known"][..., None])
    assert th.equal(again.states, base.states)
    again = plan(extra["state_history"] + extra["state_known"][..., None])
    assert (again.states[:, :, DELAY + 1 :] != base.states[:, :, DELAY + 1 :]).all(-1).all()


def test_states_before_the_window_are_dropped():
    planner = make_planner(extra_state_probability=0.5, temperature=0.0)
    observation, history, _ = make_batch(1)
    everything, states = th.ones(1, DELAY), make_extra(1)["state_history"]
    for d in range(DELAY + 1):
        delay, plans = th.tensor([d]), []
        for k in (None, *range(DELAY)):
            changed = states.clone()
            if k is not None:
                changed[0, k] += 1.0
            plan = planner.plan(observation, history, delay, state_history=changed, state_known=everything)
            plans.append(plan.states)
        assert [th.equal(plan, plans[0]) for plan in plans[1:]] == [k < DELAY - d for k in range(DELAY)]
        if d == 0:
            assert th.equal(plans[0], planner.plan(observation, history, delay).states)


def test_no_extra_states_given_are_none_known():
    planner, batch = make_planner(extra_state_probability=0.5), make_batch(5)
    extra = make_extra(5)
    none = planner.plan(*batch, n_candidates=2, generator=seeded())
    unknown = {**extra, "state_known": th.zeros(5, DELAY)}
    assert th.equal(planner.plan(*batch, n_candidates=2, generator=seeded(), **unknown).states, none.states)
    some = planner.plan(*batch, n_candidates=2, generator=seeded(), **extra)
    assert not th.equal(some.states, none.states)


def test_extra_states_of_one_decision_do_not_disturb_another():
    planner, noise = make_planner(extra_state_probability=0.5), th.randn(3, LENGTH, OBS + ACT)
    batch, extra = make_batch(6), make_extra(6)
    together = planner.plan(*batch, noise=noise, **extra)
    for b in range(6):
        row = slice(b, b + 1)
        alone = planner.plan(*(x[row] for x in batch), noise=noise, **{key: x[row] for key, x in extra.items()})
        length = alone.states.shape[2]
        th.testing.assert_close(alone.states[0], together.states[b, :, :length], atol=1e-4, rtol=1e-4)


def test_loss_shows_drawn_states_clean_and_learns_the_others():
    planner, windows = make_planner(extra_state_probability=0.7), make_windows(400)
    delay = th.arange(400) % (DELAY + 1)
    planner.network = network = FakeNetwork(th.randn(400, LENGTH, OBS + ACT, requires_grad=True))
    planner.loss(windows, delay, generator=seeded()).backward()
    exists = existing(windows, delay)
    assert th.equal(network.output.grad != 0, exists[..., None] & ~network.known)
    clean = planner.normalizer.normalize(windows.states, windows.actions)
    assert th.equal(network.x[network.known], clean[network.known])
    shown = network.known[..., 0]  # (n, L)
    assert (network.known[..., :OBS] == shown[..., None]).all() and shown[:, 0].all()
    inside = exists & (th.arange(LENGTH) >= 1) & (th.arange(LENGTH) <= delay[:, None])
    assert not shown[:, 1:][~inside[:, 1:]].any()  # nothing behind the present, and nothing at all of d = 0
    # Each with probability 0.7 / 2; the numbers known of a window are spread much wider than a fixed share's
    assert shown[inside].float().mean().item() == pytest.approx(0.35, abs=0.06)
    full = inside.sum(1) == DELAY
    assert {0, DELAY} < set(shown[full][:, 1 : DELAY + 1].sum(1).tolist())
    assert (network.known[..., OBS:] == (exists & (th.arange(LENGTH) < delay[:, None]))[..., None]).all()


def test_state_dict_carries_what_extra_states_need():
    planner, batch, extra = make_planner(extra_state_probability=0.5), make_batch(3), make_extra(3)
    other = InpaintingPlanner(OBS, ACT, DELAY, planner.config)
    other.load_state_dict(planner.state_dict())
    assert th.equal(*(p.plan(*batch, generator=seeded(), **extra).states for p in (planner, other)))
    with pytest.raises(RuntimeError, match="size mismatch"):
        make_planner().load_state_dict(planner.state_dict())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state_history": None}, "Only one of state_history and state_known is given; give both or neither"),
        ({"state_known": None}, "Only one of state_history and state_known is given; give both or neither"),
        ({"state_history": th.zeros(2, 3, 3)}, r"state_history has the shape \(2, 3, 3\), expected \(2, 4, 3\)"),
        ({"state_history": th.full((2, 4, 3), th.nan)}, "state_history has entries that are NaN or infinite"),
        ({"state_known": th.zeros(2, 4, 1)}, r"state_known has the shape \(2, 4, 1\), expected \(2, 4\)"),
        ({"state_known": th.full((2, 4), 0.5)}, "state_known has entries other than 0 and 1"),
        ({"state_known": th.full((2, 4), th.nan)}, "state_known has entries that are NaN"),
    ],
)
def test_plan_refuses_bad_extra_states(changes, message):
    planner = make_planner(extra_state_probability=0.5)
    planner.network = None  # nothing may be computed
    with pytest.raises(ValueError, match=message):
        planner.plan(**(good() | make_extra(2) | changes))


def test_a_planner_trained_without_extra_states_refuses_them():
    planner = make_planner()
    with pytest.raises(ValueError, match=r"not trained with extra known states; .*extra_state_probability=0.5"):
        planner.plan(**good(), **make_extra(2))
