"""Sampling against a naive planner, in bfloat16, and as one recorded graph."""

import copy
import dataclasses
import itertools
import math

import pytest
import torch as th
import torch.nn.functional as F

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner import planner as planner_module
from sb3_said.planner.diffusion import END_TIMES, START_TIME

OBS, ACT, DELAY, N = 4, 2, 3, 8
CONFIG = PlannerConfig(
    depth=2,
    d_model=64,
    horizon=4,
    sampling_steps=4,
    n_candidates=N,
    temperature=0.5,
    precision="float32",
    scored_states="future",
    first_guess="prior",
    present="inpainted",
)
LENGTH = DELAY + CONFIG.horizon


def make_planner(**changes):
    """A planner as it is made, but for random numbers in the layers that begin as zeros."""
    with th.random.fork_rng():
        th.manual_seed(0)
        planner = InpaintingPlanner(OBS, ACT, DELAY, dataclasses.replace(CONFIG, **changes))
        for layer in (planner.network.modulation, planner.network.out):
            th.nn.init.normal_(layer.weight, std=0.1)
        planner.fit_normalizer(3 + 2 * th.randn(50, OBS), th.rand(50, ACT) * 2 - 1)
        if planner.prior is not None:
            planner.prior.slope.uniform_(0.0, 1.0)
            planner.prior.std.uniform_(0.1, 1.0)
    return planner.requires_grad_(False)


def make_inputs(n=3, seed=0):
    g = th.Generator().manual_seed(seed)
    history = th.rand(n, DELAY, ACT, generator=g) * 2 - 1
    noise = th.randn(N, LENGTH, OBS + ACT, generator=g)
    return 3 + 2 * th.randn(n, OBS, generator=g), history, th.arange(n) % (DELAY + 1), noise


def value(states, actions):
    return states.sin().sum(-1) + actions.prod(-1)


def answer(planner, inputs=None, **kwargs):
    observation, history, delay, noise = make_inputs() if inputs is None else inputs
    return planner.plan(observation, history, delay, **({"value_fn": value, "noise": noise} | kwargs))


def same(first, second):
    return all(th.equal(a, b) for a, b in zip(first, second, strict=True))


# --- against a naive planner -----------------------------------------------------------------------------------------


def naive_network(net, x, context, t):
    """The transformer for one window (L, in_dim) at one time, head by head, with the modulations of this call."""
    embedded = net.modulation(
        F.silu(net.time_embedding(th.cat([(t * net.frequencies).cos(), (t * net.frequencies).sin()])))
    )
    parts = iter(embedded.view(-1, net.d_model))

    def norm(h, shift, scale):
        centred = h - h.mean(-1, keepdim=True)
        return centred / (centred.square().mean(-1, keepdim=True) + 1e-6).sqrt() * (1 + scale) + shift

    tokens = net.token_embedding(x) + context
    for block in net.blocks:
        shift, scale, gate, shift_m, scale_m, gate_m = (next(parts) for _ in range(6))
        q, k, v = block.qkv(norm(tokens, shift, scale)).chunk(3, dim=-1)
        heads = []
        for head in range(net.d_model // 32):
            part = slice(32 * head, 32 * head + 32)
            heads.append((q[:, part] @ k[:, part].T / math.sqrt(32)).softmax(-1) @ v[:, part])
        tokens = tokens + gate * block.attention_out(th.cat(heads, -1))
        h = block.mlp[0](norm(tokens, shift_m, scale_m))
        tokens = tokens + gate_m * block.mlp[2](h * 0.5 * (1 + th.erf(h / math.sqrt(2))))
    return net.out(norm(tokens, next(parts), next(parts)))


def naive_guess(planner, observation, history, d):
    """What the network is shown of the plain networks' window, step after step: (d + horizon, OBS + ACT)."""
    rows, state = [], planner.normalizer.normalize_states(observation)
    for k in range(d + planner.config.horizon):
        action = planner.first_guess.clone(state).clamp(-1, 1) if k >= d else th.zeros(ACT)
        rows.append(th.cat([state, action]))
        if k < d:
            state = planner.first_guess.model(state, history[DELAY - d + k])
    return th.stack(rows)


@th.no_grad()
def naive_plan(planner, observation, history, d, noise):
    """DDIM, window after window of d + horizon steps: (N, d + horizon, OBS + ACT), in the planner's units."""
    length = d + planner.config.horizon
    times = th.linspace(END_TIMES["cosine"], START_TIME, planner.config.sampling_steps + 1, dtype=th.float64)
    known = th.zeros(length, OBS + ACT, dtype=th.bool)
    known[0, :OBS], known[:d, OBS:] = True, True
    given = th.zeros(length, OBS + ACT)
    given[0, :OBS] = observation
    given[:d, OBS:] = history[DELAY - d :]
    clean = planner.normalizer.normalize(given[:, :OBS], given[:, OBS:])
    guess = naive_guess(planner, observation, history, d)
    context = planner.network.context(clean[None], known[None], guess[None])[0]
    guessed = planner.normalizer.denormalize_states(guess[:, :OBS])
    mean = planner.prior.slope[d, :length] * planner.normalizer.normalize(guessed, guess[:, OBS : OBS + ACT])
    std = planner.prior.std[d, :length]
    windows = []
    for x in planner.config.temperature * noise[:, :length]:
        x = th.where(known, clean, x)
        for now, after in itertools.pairwise(times):
            output = naive_network(planner.network, x, context, now.float())
            (alpha, sigma), (alpha_next, sigma_next) = (
                (math.cos(math.pi / 2 * float(s)), math.sin(math.pi / 2 * float(s))) for s in (now, after)
            )
            # Of the prior, the clean window's best guess at x and its deviation (Bayes), and both in terms of v
            variance = alpha**2 * std**2 + sigma**2
            best, off = mean + alpha * std**2 / variance * (x - alpha * mean), std * sigma / variance.sqrt()
            v = (alpha * x - best) / sigma + off / sigma * output
            x = alpha_next * (alpha * x - sigma * v) + sigma_next * (sigma * x + alpha * v)
            x = th.where(known, clean, x)
        windows.append(x)
    return th.stack(windows)


def test_fast_path_gives_what_a_naive_one_gives():
    # Tolerance: 1e-4 standard deviations, of sums in another order; the same candidates are chosen.
    planner = make_planner()
    observation, history, delay, noise = make_inputs(4)
    plan = answer(planner, (observation, history, delay, noise))
    chosen = []
    for b, d in enumerate(delay.tolist()):
        x = naive_plan(planner, observation[b], history[b], d, noise)
        states, actions = planner.normalizer.denormalize(x)
        assert ((plan.states[b, :, : states.shape[1]] - states) / planner.normalizer.state_std).abs().max() < 1e-4
        th.testing.assert_close(plan.actions[b, :, : states.shape[1]], actions, atol=1e-4, rtol=1e-4)
        values = value(states, actions)[:, d + 1 :].mean(1)
        th.testing.assert_close(plan.values[b], values, atol=1e-3, rtol=1e-3)
        chosen.append(int(values.argmax()))
        th.testing.assert_close(plan.action[b], actions[chosen[-1], d], atol=1e-4, rtol=1e-4)
    assert len(set(chosen)) > 1


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
def test_bfloat16_stays_close_and_chooses_as_well(prediction):
    # Tolerances: plans differ by 0.01 of their own spread on average; the chosen candidate's value, computed in
    # float32, falls short of the best one's by at most a tenth of the candidates' spread on average.
    inputs = make_inputs(40)
    exact, half = (answer(make_planner(precision=p, prediction=prediction), inputs) for p in ("float32", "bfloat16"))
    for a, b in ((exact.states, half.states), (exact.actions, half.actions)):
        assert b.dtype == th.float32 and not th.equal(a, b)
        assert (a - b).abs().mean() < 0.01 * a.std()
    of_chosen = exact.values.gather(1, half.values.argmax(1, keepdim=True))[:, 0]
    shortfall = (exact.values.amax(1) - of_chosen) / (exact.values.amax(1) - exact.values.amin(1))
    assert shortfall.mean() < 0.1


# --- CUDA graphs -----------------------------------------------------------------------------------------------------


class FakeGraph:
    """Holds its inputs in place and runs on them the function that it was first given."""

    made = 0

    def __init__(self, device):
        FakeGraph.made += 1
        self.function, self.inputs = None, None

    def __call__(self, function, *inputs):
        self.function = self.function or function
        self.inputs = [x.clone() for x in inputs] if self.inputs is None else self.inputs
        for static, x in zip(self.inputs, inputs, strict=True):
            static.copy_(x)
        return self.function(*self.inputs)


class Value(th.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = th.nn.Parameter(th.ones(OBS))

    def forward(self, states, actions):
        return states.sin() @ self.weight + actions.prod(-1)

    score = forward


def test_a_decision_is_recorded_once_for_its_sizes_settings_and_weights(monkeypatch):
    monkeypatch.setattr(planner_module, "Recording", FakeGraph)
    monkeypatch.setattr(FakeGraph, "made", 0)
    planner, eager, module = make_planner(), make_planner(), Value()
    monkeypatch.setattr(planner, "_can_be_recorded", lambda value_fn: True)

    def check(made, **kwargs):
        with th.no_grad():
            plans = [answer(p, **({"value_fn": module.score} | kwargs)) for p in (planner, eager)]
        th.testing.assert_close(plans[0], plans[1])
        assert FakeGraph.made == made

    check(1)
    for seed in (1, 2):
        check(1, inputs=make_inputs(seed=seed))  # other ages too
    check(1, temperature=0.2)
    check(2, inputs=make_inputs(2))
    check(3, noise=make_inputs()[3][:5])
    check(4, value_fn=None)
    check(4)
    for p in (planner, eager):
        p.config = dataclasses.replace(p.config, scored_states="all")
    check(5)
    module.weight.data.mul_(-1.0)  # read where it is, at every replay
    check(5)
    module.weight.data = th.full((OBS,), 0.5)
    check(6)
    for p in (planner, eager):
        with th.no_grad():
            p.network.blocks[0].qkv.bias += 0.5  # read where they are, too
    check(6)
    for n in range(1, planner_module.MAX_GRAPHS + 2):
        check(6 + n, inputs=make_inputs(n), noise=make_inputs()[3][:2])
    assert len(planner._graphs) == planner_module.MAX_GRAPHS


@pytest.mark.parametrize(
    ("first_guess", "present"), [("none", "inpainted"), ("prior", "inpainted"), ("prior", "guessed")]
)
def test_one_graph_serves_all_ages(first_guess, present, monkeypatch):
    monkeypatch.setattr(planner_module, "Recording", FakeGraph)
    monkeypatch.setattr(FakeGraph, "made", 0)
    planner, eager, module = (*(make_planner(first_guess=first_guess, present=present) for _ in range(2)), Value())
    monkeypatch.setattr(planner, "_can_be_recorded", lambda value_fn: True)
    observation, history, _, noise = make_inputs(2)
    for age in range(DELAY + 1):
        inputs = observation, history, th.full((2,), age), noise
        plans = [answer(p, inputs, value_fn=module.score) for p in (planner, eager)]
        assert plans[0].states.shape[2] == age + planner.config.horizon
        th.testing.assert_close(plans[0], plans[1])
    assert FakeGraph.made == 1


def test_a_copy_records_its_own_graphs(monkeypatch):
    monkeypatch.setattr(planner_module, "Recording", FakeGraph)
    planner = make_planner()
    monkeypatch.setattr(InpaintingPlanner, "_can_be_recorded", lambda self, value_fn: True)
    before = answer(planner, value_fn=None)
    twin = copy.deepcopy(planner)
    assert planner._graphs and not twin._graphs
    with th.no_grad():
        planner.network.out.bias += 0.5
    assert same(answer(twin, value_fn=None), before) and not same(answer(planner, value_fn=None), before)
    assert not any("graph" in name for name in planner.state_dict())


def make_extra(n=3, seed=0):
    g = th.Generator().manual_seed(seed)
    known = th.rand(n, DELAY, generator=g) < 0.5
    return {"state_history": 3 + 2 * th.randn(n, DELAY, OBS, generator=g), "state_known": known}


def test_a_recorded_decision_reads_the_extra_states_of_each_call(monkeypatch):
    monkeypatch.setattr(planner_module, "Recording", FakeGraph)
    monkeypatch.setattr(FakeGraph, "made", 0)
    planner, eager = (make_planner(extra_state_probability=0.5) for _ in range(2))
    monkeypatch.setattr(planner, "_can_be_recorded", lambda value_fn: True)
    answers = []
    for extra in (make_extra(), make_extra(seed=1), {}, make_extra(seed=2)):
        plans = [answer(p, value_fn=None, **extra) for p in (planner, eager)]
        th.testing.assert_close(plans[0], plans[1])
        answers.append(plans[0].states)
    assert FakeGraph.made == 1 and not any(th.equal(answers[0], other) for other in answers[1:])


def test_only_modules_on_a_gpu_are_recorded(monkeypatch):
    planner = make_planner()
    assert not planner._can_be_recorded(None)
    monkeypatch.setattr(InpaintingPlanner, "device", property(lambda self: th.device("cuda")))
    module = Value()
    assert all(planner._can_be_recorded(f) for f in (None, module, module.score))
    assert not planner._can_be_recorded(value) and not planner._can_be_recorded(lambda states, actions: states[..., 0])


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("probability", [0.0, 0.5])
def test_a_recorded_decision_is_the_eager_one(precision, probability, monkeypatch):
    planner = make_planner(precision=precision, extra_state_probability=probability).cuda()
    module = Value().cuda()
    for inputs, extra in ((make_inputs(), make_extra()), (make_inputs(seed=1), {}), (make_inputs(2), make_extra(2))):
        inputs = [x.cuda() for x in inputs]
        extra = extra if probability > 0 else {}
        for _ in range(5):  # the fourth records, and the fifth replays
            recorded = answer(planner, inputs, value_fn=module.score, **extra)
        with monkeypatch.context() as patch:
            patch.setattr(planner_module.InpaintingPlanner, "_can_be_recorded", lambda self, value_fn: False)
            eager = answer(planner, inputs, value_fn=module.score, **extra)
            th.testing.assert_close(eager, recorded, atol=1e-4, rtol=1e-4)
    assert planner._graphs
