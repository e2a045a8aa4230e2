"""Training: formulas, determinism, resuming, held-out data."""

from __future__ import annotations

import copy
import dataclasses
import json
import math

import numpy as np
import pytest
import torch as th
from linear_system import ACTION_DIM, STATE_DIM, make_source

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.planner.diffusion import alpha_sigma, draw_times
from sb3_said.planner.dit import HEAD_DIM
from sb3_said.planner.held_out import held_out_errors
from sb3_said.planner.inpainting import draw_delays
from sb3_said.planner.trainer import (
    YARDSTICK_LEARNING_RATE,
    PlannerTrainer,
    ema_decay,
    learning_rate,
)
from sb3_said.planner.values import VALUE_SCALES, scaled_values

D = 3


def make_trainer(
    gradient_steps=12, held_out=0.1, seed=0, source=None, max_delay=D, device="cpu", guess_steps=1, **config
) -> PlannerTrainer:
    defaults = dict(depth=1, d_model=32, horizon=3, batch_size=16, warmup_steps=4, learning_rate=1e-3, sampling_steps=2)
    defaults |= dict(first_guess="none")  # test_first_guess.py has those with one
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        planner = InpaintingPlanner(STATE_DIM, ACTION_DIM, max_delay, PlannerConfig(**{**defaults, **config}))
    source = source or make_source(40, 20)
    return PlannerTrainer(planner.to(device), source, gradient_steps, held_out, seed, guess_steps=guess_steps)


def leaves(tree, path=""):
    """Walk a state dict, refusing what could not be written without pickle."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            assert isinstance(key, (str, int)), path
            yield from leaves(value, f"{path}/{key}")
    elif isinstance(tree, list):
        for i, value in enumerate(tree):
            yield from leaves(value, f"{path}/{i}")
    else:
        assert isinstance(tree, (int, float, str, th.Tensor)) or tree is None, f"{path}: {type(tree)}"
        yield path, tree


def assert_same(first, second):
    for (path, a), (other_path, b) in zip(leaves(first), leaves(second), strict=True):
        assert path == other_path
        assert th.equal(a, b) if isinstance(a, th.Tensor) else a == b, path


@pytest.mark.parametrize("scale", VALUE_SCALES)
def test_windows_are_weighed_on_any_scale(scale):
    source = make_source(40, 20)
    trainer = make_trainer(value_scale=scale, source=source)
    training, _ = source.split(0.1, 0)
    assert th.equal(trainer.source.values, scaled_values(training.values, scale))


def test_loss_receives_the_weights(monkeypatch):
    trainer = make_trainer(weight_factor=3.0)
    seen = {}

    def loss(windows, delay=None, weight=None, generator=None):
        seen.update(values=windows.values, weight=weight, delay=delay)
        return sum(parameter.sum() for parameter in trainer.online.parameters())

    monkeypatch.setattr(trainer.online, "loss", loss)
    trainer.step()
    np.testing.assert_allclose(seen["weight"], np.exp(3.0 * (seen["values"].numpy() - 1.0)), rtol=1e-6)
    assert seen["values"].unique().numel() > 1
    assert set(seen["delay"].tolist()) <= set(range(D + 1))


def test_learning_rate_is_linear_then_cosine():
    config = PlannerConfig(learning_rate=2.0, warmup_steps=10)
    rates = [learning_rate(step, 110, config) for step in range(111)]
    np.testing.assert_allclose(rates[:10], np.arange(1, 11) / 5)
    np.testing.assert_allclose(rates[10:], 1 + np.cos(np.pi * np.arange(101) / 100), atol=1e-12)
    assert learning_rate(0, 1, PlannerConfig(learning_rate=2.0, warmup_steps=0)) == 2.0


def test_a_constant_learning_rate_stays_after_its_warm_up():
    config = PlannerConfig(lr_schedule="constant", learning_rate=2.0, warmup_steps=4)
    assert [learning_rate(step, 9, config) for step in range(9)] == [0.5, 1.0, 1.5, *[2.0] * 6]


def test_an_average_without_warm_up_is_a_full_length_one_from_the_start():
    assert [ema_decay(step, PlannerConfig.paper()) for step in (0, 1, 10_000)] == [0.9999] * 3


#: Another value of every setting.
OTHER_SETTINGS = {
    "depth": 2,
    "d_model": 64,
    "horizon": 4,
    "embed_known": False,
    "first_guess": "prior",
    "prediction": "epsilon",
    "schedule": "linear",
    "time_sampling": "uniform",
    "end_time_probability": 0.9,
    "early_probability": 0.9,
    "mask": "fixed",
    "mask_end_probability": 0.0,
    "extra_state_probability": 0.9,
    "relative_states": False,
    "decision_weight": 1.0,
    "action_transform": "tanh",
    "sampling_steps": 4,
    "n_candidates": 3,
    "temperature": 0.5,
    "scored_states": "all",
    "present": "guessed",
    "choice_factor": 1.0,
    "learning_rate": 3e-3,
    "lr_schedule": "constant",
    "warmup_steps": 2,
    "weight_decay": 0.5,
    "betas": (0.5, 0.9),
    "batch_size": 8,
    "gradient_clip": 1e-3,
    "ema_decay": 0.05,
    "ema_warmup": False,
    "weight_factor": 0.5,
    "value_scale": "range",
    "precision": "bfloat16",
}


def train_and_plan(**config):
    trainer = make_trainer(
        6, **{"precision": "float32", "temperature": 1.0, "n_candidates": 16, "sampling_steps": 3, **config}
    )
    trainer.train()
    generator = th.Generator().manual_seed(0)
    observation, history = th.ones(4, STATE_DIM), th.zeros(4, D, ACTION_DIM)

    def value(states, actions):  # (..., obs_dim), (..., act_dim) -> (...)
        return (20 * states).sin().sum(-1) + actions.sum(-1)

    plan = trainer.planner.plan(observation, history, th.arange(4), value_fn=value, generator=generator)
    return np.concatenate([plan.action.ravel(), plan.present.ravel()])


@pytest.fixture(scope="module")
def planned():
    """Return what a planner of the usual settings decides, twice alike."""
    first, second = train_and_plan(), train_and_plan()
    assert np.array_equal(first, second)
    return first


# "decided_by" is an agent's: whose actor decides, it asks for no plan (tests/said/test_policies.py)
@pytest.mark.parametrize("name", sorted({field.name for field in dataclasses.fields(PlannerConfig)} - {"decided_by"}))
def test_every_setting_matters(name, planned):
    needs = {"first_guess": "prior", "present": "inpainted"} if name == "present" else {}
    usual = train_and_plan(**needs) if needs else planned
    assert not np.array_equal(usual, train_and_plan(**{**needs, name: OTHER_SETTINGS[name]}))


def test_optimizers_follow_the_schedule():
    trainer = make_trainer(gradient_steps=8, warmup_steps=4, learning_rate=2e-3)
    rates, yardsticks = [], []

    def note(trainer):
        rates.append(trainer.pop_losses()["planner/learning_rate"])
        yardsticks.append(trainer.yardstick_optimizer.param_groups[0]["lr"])

    trainer.train(callback=note)
    expected = [0.5e-3, 1e-3, 1.5e-3, 2e-3] + [1e-3 * (1 + math.cos(math.pi * k / 4)) for k in range(4)]
    np.testing.assert_allclose(rates, expected)
    np.testing.assert_allclose(yardsticks, np.array(expected) * YARDSTICK_LEARNING_RATE / 2e-3)


def test_planner_holds_the_average_of_the_online_weights():
    trainer = make_trainer(ema_decay=0.3)
    naive = [parameter.detach().clone() for parameter in trainer.average.parameters()]
    for step in range(6):
        trainer.train(1)
        decay = min(0.3, (1 + step) / (10 + step))
        assert ema_decay(step, trainer.config) == decay
        for mean, parameter in zip(naive, trainer.online.parameters(), strict=True):
            mean.mul_(decay).add_(parameter.detach(), alpha=1 - decay)
    for mean, averaged in zip(naive, trainer.planner.parameters(), strict=True):
        th.testing.assert_close(averaged, mean)
    online = th.cat([parameter.detach().flatten() for parameter in trainer.online.parameters()])
    assert (th.cat([mean.flatten() for mean in naive]) - online).abs().max() > 1e-5


# ------------------------------------------------------------------------------------------- a step the slow way


def layer_norm(x):
    centred = x - x.mean(-1, keepdim=True)
    return centred / (centred.pow(2).mean(-1, keepdim=True) + 1e-6).sqrt()


def naive_attention(block, x):
    """Attend token by token and head by head; x is (L, d_model), of valid tokens alone."""
    q, k, v = (x @ block.qkv.weight.T + block.qkv.bias).chunk(3, dim=-1)
    heads = []
    for h in range(0, x.shape[1], HEAD_DIM):
        mixed = []
        for query in q[:, h : h + HEAD_DIM]:
            score = th.stack([query @ key for key in k[:, h : h + HEAD_DIM]]) / math.sqrt(HEAD_DIM)
            weight = score.exp() / score.exp().sum()
            mixed.append(sum(w * value for w, value in zip(weight, v[:, h : h + HEAD_DIM], strict=True)))
        heads.append(th.stack(mixed))
    return block.attention_out(th.cat(heads, dim=-1))


def naive_network(network, x, known, t):
    """Predict one window; x is (n_valid, obs_dim + act_dim)."""
    angles = t * network.frequencies
    embedded = network.time_embedding(th.cat([angles.cos(), angles.sin()]))
    parts = network.modulation(embedded * embedded.sigmoid()).view(-1, network.d_model)
    flags = known[:, [0, network.obs_dim]].to(x.dtype)
    D, given = network.max_delay, th.where(known, x, 0.0)
    history, shown = (  # steps behind an episode's end are not known
        th.nn.functional.pad(part[:D], (0, 0, 0, D - len(part[:D])))
        for part in (given[:, network.obs_dim :], flags[:, 1:])
    )
    summary = network.known_embedding(th.cat([given[0, : network.obs_dim], history.flatten(), shown.flatten()]))
    tokens = network.token_embedding(x) + network.flag_embedding(flags) + network.positions[: len(x)] + summary
    for i, block in enumerate(network.blocks):
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = parts[6 * i : 6 * i + 6]
        tokens = tokens + gate_a * naive_attention(block, layer_norm(tokens) * (1 + scale_a) + shift_a)
        tokens = tokens + gate_m * block.mlp(layer_norm(tokens) * (1 + scale_m) + shift_m)
    return network.out(layer_norm(tokens) * (1 + parts[-1]) + parts[-2])


def naive_starts(source, config, generator):
    """Draw where the windows start, part of them early in an episode."""
    starts = th.randint(len(source), (config.batch_size,), generator=generator)
    is_early, place, step = (th.rand(config.batch_size, generator=generator) for _ in range(3))
    numbers = source.episodes.unique()
    for i in th.nonzero(is_early < config.early_probability)[:, 0].tolist():
        episode = th.nonzero(source.episodes == numbers[int(place[i] * len(numbers))])[:, 0].tolist()
        episode.sort(key=lambda start: -int(source.remaining[start]))
        starts[i] = episode[int((len(episode) + 1) ** step[i] - 1)]
    return starts


def naive_loss(planner, source, config, generator):
    """Draw as a step does, and add up the error window by window in float64."""
    n, length = config.batch_size, planner.window_length
    starts = naive_starts(source, config, generator)
    delays = draw_delays(n, planner.max_delay, config.mask, config.mask_end_probability, generator)
    noise = th.randn(n, length, STATE_DIM + ACTION_DIM, generator=generator)
    times = draw_times(n, config.schedule, config.time_sampling, config.end_time_probability, generator)
    error, total = 0.0, 0.0
    for start, d, eps, t in zip(starts.tolist(), delays.tolist(), noise.double(), times.double(), strict=True):
        steps = range(min(d + config.horizon, int(source.remaining[start])))
        row, env = int(source.rows[start]), source.envs[start]
        pairs = [(source.states[row + k, env], source.actions[row + k, env]) for k in steps]
        states, actions = (th.stack(part).double() for part in zip(*pairs, strict=True))
        clean = planner.normalizer.normalize(states, actions)
        known = th.zeros_like(clean, dtype=th.bool)
        known[0, :STATE_DIM], known[:d, STATE_DIM:] = True, True
        alpha, sigma = alpha_sigma(t, config.schedule)
        x, v = alpha * clean + sigma * eps[steps], alpha * eps[steps] - sigma * clean
        output = naive_network(planner.network, th.where(known, clean, x), known, t)
        share = (~known).double()
        if d in steps:
            share[d] *= config.decision_weight
        low, value, high = (float(x) for x in (source.values.min(), source.values[start], source.values.max()))
        place = 2 * (value - low) / (high - low) - 1
        error = error + ((output - v) ** 2 * share).sum() * math.exp(config.weight_factor * (place - 1))
        total += share.sum()
    return error / total


def naive_step(planner, source, config, generator, step, moments, gradient_steps):
    """Clip, AdamW as published, parameter by parameter; return the loss and the clipped gradient."""
    planner.zero_grad()
    loss = naive_loss(planner, source, config, generator)
    loss.backward()
    gradient = th.cat([p.grad.flatten() for p in planner.parameters()])
    clip = min(1.0, config.gradient_clip / float(gradient.norm()))
    rate, (beta1, beta2) = learning_rate(step, gradient_steps, config), config.betas
    with th.no_grad():
        for p, (m, v) in zip(planner.parameters(), moments, strict=True):
            m.mul_(beta1).add_((1 - beta1) * clip * p.grad)
            v.mul_(beta2).add_((1 - beta2) * (clip * p.grad) ** 2)
            p.mul_(1 - rate * config.weight_decay)
            p.sub_(rate * (m / (1 - beta1 ** (step + 1))) / ((v / (1 - beta2 ** (step + 1))).sqrt() + 1e-8))
    return loss.item(), clip * gradient


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-4), ("bfloat16", 3e-2)])
def test_steps_are_those_of_a_naive_float64_trainer(precision, tolerance):
    """Relative error of losses and gradients below the tolerance; the weights move the same way."""
    source = make_source(10, 7)  # windows of 6 steps: some episodes end before
    trainer = make_trainer(
        source=source, held_out=0.0, batch_size=6, precision=precision, relative_states=False, depth=2, d_model=64
    )
    generator = th.Generator().manual_seed(1)
    with th.no_grad():  # adaLN-zero would hide the blocks
        for parameter in trainer.online.parameters():
            parameter.add_(0.05 * th.randn(parameter.shape, generator=generator))
    naive = copy.deepcopy(trainer.online).double()
    begin = th.nn.utils.parameters_to_vector(naive.parameters()).detach()
    moments = [(th.zeros_like(p), th.zeros_like(p)) for p in naive.parameters()]
    generator.set_state(trainer.generator.get_state())
    for step in range(3):
        trainer.step()
        expected, gradient = naive_step(naive, source, trainer.config, generator, step, moments, trainer.gradient_steps)
        assert trainer.pop_losses()["planner/loss"] == pytest.approx(expected, rel=tolerance)
        got = th.nn.utils.parameters_to_vector(p.grad for p in trainer.online.parameters()).double()
        assert (got - gradient).norm() < tolerance * gradient.norm()
    moved = th.nn.utils.parameters_to_vector(trainer.online.parameters()).double() - begin
    naive_moved = th.nn.utils.parameters_to_vector(naive.parameters()).detach() - begin
    # Adam divides by the gradient's size, so that entries near 0 move as far as all others, if need be the other way
    assert (moved - naive_moved).norm() < 10 * tolerance * naive_moved.norm()


def test_a_training_goes_on_from_another_kind_of_device():
    first, second = make_trainer(), make_trainer()
    first.train(3)
    state = first.state_dict()
    state["generator"] = th.zeros(16, dtype=th.uint8)  # a GPU's generator says no more
    second.load_state_dict(state)
    assert second.n_updates == 3 and not th.equal(
        second.generator.get_state(), make_trainer().generator.get_state()
    )  # other draws than at the beginning
    second.train()
    assert second.n_updates == second.gradient_steps


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_recorded_updates_are_those_made_one_kernel_at_a_time():
    trainers = [make_trainer(precision="float32", device="cuda") for _ in range(2)]
    trainers[1]._recorded = None  # launches every kernel
    for trainer in trainers:
        trainer.train(8)
    for (path, recorded), (_, eager) in zip(*(leaves(t.state_dict()) for t in trainers), strict=True):
        if isinstance(recorded, th.Tensor) and recorded.is_floating_point():
            th.testing.assert_close(recorded, eager, rtol=1e-3, atol=1e-5, msg=path)
    assert th.equal(trainers[0].generator.get_state(), trainers[1].generator.get_state())
    saved = trainers[0].state_dict()
    trainers[0].train(2)
    trainers[0].load_state_dict(saved)  # recorded anew, over the loaded optimizer state
    for trainer in trainers:
        trainer.train()
    assert trainers[0].pop_losses()["planner/loss"] == pytest.approx(trainers[1].pop_losses()["planner/loss"], rel=1e-2)


@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_resumed_training_ends_bit_for_bit_the_same(precision):
    whole = make_trainer(precision=precision)
    whole.train()

    first = make_trainer(precision=precision)
    first.train(5)
    saved = first.state_dict()
    untouched = copy.deepcopy(saved)
    first.train(2)  # must not reach into what was saved
    assert_same(saved, untouched)

    second = make_trainer(precision=precision)
    second.train(3)  # whatever it did before is forgotten
    second.load_state_dict(saved)
    assert second.n_updates == 5
    second.train()
    assert second.n_updates == second.gradient_steps
    assert_same(second.state_dict(), whole.state_dict())
    assert second.evaluate() == whole.evaluate()
    assert second.pop_losses() == whole.pop_losses()
    assert_same(saved, untouched)


def test_settings_survive_json_and_others_are_refused():
    trainer = make_trainer()
    state = trainer.state_dict()
    state["settings"] = json.loads(json.dumps(state["settings"]))
    make_trainer().load_state_dict(state)
    for other in (
        make_trainer(gradient_steps=13),
        make_trainer(learning_rate=3e-3),
        make_trainer(seed=1),
        make_trainer(held_out=0.2),
        make_trainer(source=make_source(41, 20)),
    ):
        with pytest.raises(ValueError, match=r"was .* and is now"):
            other.load_state_dict(state)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_updates", -1),
        ("n_updates", 10**9),
        ("n_updates", "3"),
        ("n_losses", "3"),
        ("loss_sums", th.tensor([th.nan, 0.0])),
    ],
)
def test_a_stored_training_that_none_can_be_is_refused(name, value):
    trainer = make_trainer()
    with pytest.raises(ValueError, match="The stored training"):
        trainer.load_state_dict({**trainer.state_dict(), name: value})
    state = trainer.state_dict()
    next(iter(state["online"].values())).fill_(th.inf)
    with pytest.raises(ValueError, match="holds NaN or infinite numbers"):
        make_trainer().load_state_dict(state)


def test_held_out_episodes_are_never_trained_on():
    source = make_source(20, 15)
    # Every state tells its episode
    source.states[..., 0] = th.arange(20.0).expand(15, 20)
    trainer = make_trainer(source=source, held_out=0.25)
    held_out = {int(x) for x in trainer._held_out[0].states[..., 0].unique()}
    assert 5 <= len(held_out) < 20
    seen = set()
    gather = type(source).gather

    def spy(self, starts, length):
        windows = gather(self, starts, length)
        seen.update(int(x) for x in windows.states[..., 0].unique())
        return windows

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(source), "gather", spy)
        trainer.train()
    assert seen and not seen & held_out
    # The normaliser saw no held-out state either
    mean = th.tensor([x for x in range(20) if x not in held_out], dtype=th.float32).mean()
    th.testing.assert_close(trainer.planner.normalizer.state_mean[0], mean)


@pytest.mark.parametrize(
    ("max_delay", "mask", "delays"), [(3, "random", range(4)), (8, "random", range(9)), (8, "fixed", [8])]
)
def test_evaluation_covers_every_delay(max_delay, mask, delays):
    metrics = make_trainer(max_delay=max_delay, mask=mask).evaluate()
    expected = {
        f"planner/{what}_error{who}_d{d}" for what in ("present", "action") for who in ("", "_mlp") for d in delays
    }
    assert set(metrics) == expected
    assert all(len(key) <= 36 for key in metrics)  # longer ones are cut by the logger
    if mask == "random":
        assert metrics["planner/present_error_d0"] < 1e-5  # nothing is hidden there


def test_the_regression_meets_every_age_also_where_the_planner_meets_none(monkeypatch):
    trainer, met = make_trainer(mask="none", first_guess="prior"), []
    loss = trainer.yardstick.loss
    monkeypatch.setattr(
        trainer.yardstick,
        "loss",
        lambda windows, delay, weight: met.extend(delay.tolist()) or loss(windows, delay, weight),
    )
    trainer.train(3)
    assert set(met) == set(range(D + 1))


def test_errors_are_those_of_the_averaged_weights():
    trainer = make_trainer()
    trainer.train(5)
    errors = trainer.evaluate()
    assert errors == held_out_errors(trainer.average, trainer.yardstick, trainer._held_out)
    assert errors != held_out_errors(trainer.online, trainer.yardstick, trainer._held_out)


def test_global_generator_is_neither_read_nor_moved():
    states = []
    for seed in (0, 1):
        th.manual_seed(seed)
        trainer = make_trainer()
        before = th.random.get_rng_state()
        trainer.train()
        trainer.evaluate()
        assert th.equal(th.random.get_rng_state(), before)
        states.append(trainer.state_dict())
    assert_same(*states)


def test_errors_decrease():
    trainer = make_trainer(gradient_steps=80, batch_size=64, ema_decay=0.9, learning_rate=3e-3)
    before = trainer.evaluate()
    trainer.train(20)
    first_loss = trainer.pop_losses()
    trainer.train()
    last_loss, after = trainer.pop_losses(), trainer.evaluate()
    for name in ("planner/loss", "planner/loss_mlp"):
        assert last_loss[name] < 0.8 * first_loss[name]
    for name in ("present_error_d3", "present_error_mlp_d3"):
        assert after[f"planner/{name}"] < 0.5 * before[f"planner/{name}"]


def test_callback_can_stop():
    trainer = make_trainer()
    trainer.train(callback=lambda t: t.n_updates < 3)
    assert trainer.n_updates == 3


def test_no_held_out_data():
    trainer = make_trainer(held_out=0.0)
    trainer.train(2)
    assert trainer.evaluate() == {}


def test_delay_zero_planner_trains():
    trainer = make_trainer(max_delay=0)
    trainer.train()
    assert trainer.evaluate()["planner/action_error_d0"] > 0


def test_infinite_loss_names_its_update(monkeypatch):
    trainer = make_trainer(gradient_steps=200)
    loss = trainer.online.loss

    def breaks(*args, **kwargs):
        return loss(*args, **kwargs) * (math.nan if trainer.n_updates >= 3 else 1.0)

    monkeypatch.setattr(trainer.online, "loss", breaks)
    with pytest.raises(FloatingPointError, match=r"Update 3 \(of 200\)"):
        trainer.train()
    assert trainer.n_updates == 100  # looked at rarely, to keep a GPU busy
    with pytest.raises(FloatingPointError):
        trainer.state_dict()


@pytest.mark.parametrize("is_last", [False, True])
def test_no_bad_update_reaches_the_planner(monkeypatch, is_last):
    """Not even one whose loss was finite and whose gradient was not, and which no other loss follows."""
    trainer = make_trainer(gradient_steps=5)
    before, loss = copy.deepcopy(trainer.planner.state_dict()), trainer.online.loss

    def breaks(*args, **kwargs):
        zero = 0.0 * next(trainer.online.parameters()).sum()
        return loss(*args, **kwargs) + (zero.sqrt() if trainer.n_updates == (4 if is_last else 2) else zero)

    monkeypatch.setattr(trainer.online, "loss", breaks)
    with pytest.raises(FloatingPointError, match="of 5"):
        trainer.train()
    assert_same(dict(trainer.planner.state_dict()), dict(before))
    with pytest.raises(FloatingPointError):
        trainer.hand_over()
    assert_same(dict(trainer.planner.state_dict()), dict(before))


def test_the_planner_stays_as_it_is_until_a_training_hands_over():
    trainer = make_trainer()
    before = copy.deepcopy(trainer.planner.state_dict())
    trainer.hand_over()  # nothing was trained
    trainer.step()
    trainer.evaluate()
    assert_same(dict(trainer.planner.state_dict()), dict(before))
    trainer.train(callback=lambda t: t.n_updates < 3)
    assert_same(dict(trainer.planner.state_dict()), dict(trainer.average.state_dict()))
    assert not th.equal(trainer.planner.normalizer.state_mean, before["normalizer.state_mean"])


def test_no_training_goes_beyond_its_updates():
    trainer = make_trainer()
    total = trainer.gradient_steps
    trainer.train(total - 1)
    trainer.train(4)
    assert trainer.n_updates == total
    make_trainer().load_state_dict(trainer.state_dict())


def test_every_training_starts_anew():
    """Old weights would read new data through another normaliser."""
    source = make_source(40, 20)
    whole, other = make_trainer(source=source), make_trainer(source=source)
    whole.train()
    other.train()
    shifted = dataclasses.replace(source, states=3.0 * source.states + 1.0)
    PlannerTrainer(other.planner, shifted, 12, 0.1, seed=5).train()
    assert not th.equal(other.planner.normalizer.state_mean, whole.planner.normalizer.state_mean)
    PlannerTrainer(other.planner, source, 12, 0.1, seed=0).train()
    assert_same(dict(other.planner.state_dict()), dict(whole.planner.state_dict()))


@pytest.mark.parametrize(
    "arguments", [{"gradient_steps": 0}, {"held_out": 1.0}, {"held_out": -0.1}, {"guess_steps": 0}]
)
def test_bad_arguments(arguments):
    with pytest.raises(ValueError, match="gradient_steps >= 1, guess_steps >= 1 and held_out"):
        make_trainer(**arguments)


def test_data_of_other_sizes():
    planner = InpaintingPlanner(STATE_DIM + 1, ACTION_DIM, D, PlannerConfig(depth=1, d_model=32))
    with pytest.raises(ValueError, match=r"expects 3 observation .* have 2"):
        PlannerTrainer(planner, make_source(10, 10), 10)


def test_training_resumes_under_other_sampling_settings():
    first, second = make_trainer(), make_trainer(temperature=0.1, n_candidates=3, scored_states="decision")
    first.train(3)
    second.load_state_dict(first.state_dict())
    assert second.n_updates == 3


def test_training_with_extra_states_resumes_bit_for_bit():
    whole, first, second = (make_trainer(extra_state_probability=0.5) for _ in range(3))
    whole.train()
    first.train(5)
    second.load_state_dict(first.state_dict())
    second.train()
    assert_same(second.state_dict(), whole.state_dict())
    with pytest.raises(ValueError, match=r"extra_state_probability was 0\.5 and is now 0\.0"):
        make_trainer().load_state_dict(first.state_dict())


def test_each_seed_holds_out_episodes_of_its_own():
    source = make_source(40, 20)
    for seed in (1, 2):
        trainer, (training, _) = make_trainer(seed=seed, source=source), source.split(0.1, seed)
        assert th.equal(trainer.source.envs, training.envs) and th.equal(trainer.source.rows, training.rows)


def test_each_seed_begins_with_weights_of_its_own():
    trainers = [make_trainer(seed=seed) for seed in (0, 0, 1)]
    for name in ("average", "yardstick"):
        own, same, another = (th.nn.utils.parameters_to_vector(getattr(t, name).parameters()) for t in trainers)
        assert th.equal(own, same) and not th.equal(own, another)
