"""The transformer: embeddings, adaLN-zero, masks, and the parts of a call that are shared."""

import math

import pytest
import torch as th

from sb3_said.planner.dit import DiT1d, DiTBlock, sinusoidal_positions

OBS, ACT, DELAY, LENGTH = 3, 2, 4, 10


def make_network(randomised=True, **kwargs):
    th.manual_seed(0)
    settings = {"depth": 2, "embed_known": True, "extra_states": False, "first_guess": False}
    network = DiT1d(OBS, ACT, DELAY, LENGTH, d_model=64, **(settings | kwargs))
    if randomised:  # the initial zeros would hide everything
        for parameter in network.parameters():
            th.nn.init.normal_(parameter, std=0.1)
    return network


def make_inputs(n=6):
    x = th.randn(n, LENGTH, OBS + ACT)
    known = th.zeros(n, LENGTH, OBS + ACT, dtype=th.bool)
    known[:, 0, :OBS] = True
    known[:, :2, OBS:] = True
    return x, known, th.linspace(0.1, 0.9, n)


def test_nothing_is_computed_from_memory_that_was_never_written(monkeypatch):
    """beta=0 does not keep a NaN out on every device (https://github.com/pytorch/pytorch/issues/187521)."""
    network, (x, known, t) = make_network(), make_inputs()
    context, modulations = network.context(x, known), network.modulations(t)
    expected = network(x, context, modulations)
    monkeypatch.setattr(th, "baddbmm", lambda out, a, b, beta, alpha: beta * out + alpha * th.bmm(a, b))
    monkeypatch.setattr(th.Tensor, "new_empty", lambda self, *size: self.new_full(size, math.nan))
    th.testing.assert_close(network(x, context, modulations), expected)


def test_a_guess_is_shown_as_it_is_and_its_states_as_moves():
    network, (x, known, _) = make_network(first_guess=True), make_inputs()
    guess, nothing = th.randn_like(x), th.zeros_like(x)
    moves = th.stack([guess[:, k, :OBS] - guess[:, 0, :OBS] for k in range(LENGTH)], dim=1)
    weight = network.guess_embedding.weight  # (64, OBS + ACT + OBS)
    added = network.context(x, known, guess) - network.context(x, known, nothing)
    th.testing.assert_close(added, th.cat([guess, moves], dim=-1) @ weight.T, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("length", [2, 12, 24])
def test_sinusoidal_positions_are_distinct_and_all_features_alive(length):
    positions = sinusoidal_positions(length, 256)
    assert positions.shape == (length, 256) and positions.dtype == th.float32
    distances = th.cdist(positions, positions) + 100 * th.eye(length)
    assert distances.min() > 2.0
    sine, cosine = positions.chunk(2, dim=1)
    assert (sine.std(0) > 0.1).all() and (cosine.std(0) > 0.05).all()


def test_sinusoidal_positions_against_a_naive_loop():
    expected = th.tensor([[th.tensor(k * 5.0 ** -(j / 3)).sin().item() for j in range(4)] for k in range(5)])
    th.testing.assert_close(sinusoidal_positions(5, 8)[:, :4], expected)


@pytest.mark.parametrize("embed_known", [True, False])
def test_untrained_output_is_zero_but_learns(embed_known):
    network = make_network(randomised=False, embed_known=embed_known)
    x, known, t = make_inputs()
    output = network(x, network.context(x, known), network.modulations(t))
    assert output.shape == x.shape and (output == 0).all()
    (output - 1).square().mean().backward()
    assert network.out.weight.grad.abs().max() > 0


def test_block_is_the_identity_while_its_gates_are_closed():
    block, x = DiTBlock(64), 3 + 5 * th.randn(4, LENGTH, 64)
    modulation = th.randn(4, 6, 1, 64)
    modulation[:, [2, 5]] = 0.0
    assert th.equal(block(x, modulation.unbind(1)), x)
    # and adds to the very same stream when they open: the sum is linear in a gate
    outputs = []
    for gate in (1.0, 2.0):
        modulation[:, 2] = gate
        outputs.append(block(x, modulation.unbind(1)) - x)
    th.testing.assert_close(outputs[1], 2 * outputs[0], atol=1e-4, rtol=1e-4)


def test_attention_matches_a_naive_one():
    block, x = DiTBlock(64), th.randn(2, 5, 64)
    q, k, v = block.qkv(x).split(64, dim=-1)
    heads = [slice(0, 32), slice(32, 64)]
    mixed = [(q[..., h] @ k[..., h].mT / 32**0.5).softmax(-1) @ v[..., h] for h in heads]
    th.testing.assert_close(block._attention(x, None), block.attention_out(th.cat(mixed, -1)), atol=1e-5, rtol=1e-5)


def test_outputs_of_valid_tokens_do_not_depend_on_padding():
    network = make_network()
    x, known, t = make_inputs()
    valid = th.arange(LENGTH) < th.tensor([1, 3, 5, 7, 9, 10])[:, None]
    context, modulations = network.context(x, known & valid[..., None]), network.modulations(t)
    padded = th.where(valid[..., None], x, 100 * th.randn_like(x))
    outputs = [network(inputs, context, modulations, valid)[valid] for inputs in (x, padded)]
    th.testing.assert_close(outputs[0], outputs[1])
    unmasked = [network(inputs, context, modulations)[valid] for inputs in (x, padded)]
    assert (unmasked[0] - unmasked[1]).abs().max() > 0.01  # so the mask does something


def test_context_reads_known_entries_only():
    network = make_network()
    x, known, _ = make_inputs()
    base = network.context(x, known)
    assert th.equal(network.context(th.where(known, x, 9.0), known), base)
    for index in ((0, 0), (1, OBS)):  # the known state, the last known action
        changed = x.clone()
        changed[:, index[0], index[1]] += 1.0
        difference = (network.context(changed, known) - base).abs().amax((0, 2))
        assert (difference > 1e-3).all()  # every token is told
    assert (network.context(x, known) - network.context(x, th.zeros_like(known))).abs().amax(2).min() > 1e-3


def test_context_tells_every_token_of_extra_states():
    network = make_network(extra_states=True)
    x, known, _ = make_inputs()
    known[:, DELAY, :OBS] = True
    base = network.context(x, known)
    assert th.equal(network.context(th.where(known, x, 9.0), known), base)
    changed, fewer = x.clone(), known.clone()
    changed[:, DELAY, 0] += 1.0
    fewer[:, DELAY, :OBS] = False
    for other in (network.context(changed, known), network.context(x.where(known, 0.0), fewer)):
        assert ((other - base).abs().amax((0, 2)) > 1e-3).all()
    zero = x.clone()  # a state that is known to be 0 is not an unknown one
    zero[:, DELAY, :OBS] = 0.0
    assert ((network.context(zero, known) - network.context(zero, fewer)).abs().amax((0, 2)) > 1e-3).all()
    short = network.context(x[:, : DELAY - 1], known[:, : DELAY - 1])  # nothing is known behind a window's end
    known[:, DELAY - 1 :] = False
    th.testing.assert_close(network.context(x, known)[:, : DELAY - 1], short)


def test_sharing_modulations_and_contexts_changes_nothing():
    network = make_network(depth=3)
    x, known, _ = make_inputs()
    known = known.clone()
    known[3:, 2, OBS:] = True
    alone = th.cat(
        [
            network(
                x[i : i + 1], network.context(x[j : j + 1], known[j : j + 1]), network.modulations(th.tensor([0.3]))
            )
            for i, j in enumerate([0, 0, 0, 3, 3, 3])
        ]
    )
    context = network.context(x[[0, 3]], known[[0, 3]])  # each for three windows in a row
    shared = network(x, context, network.modulations(th.tensor([0.3]))[0])
    each = network(x, context, network.modulations(th.full((6,), 0.3)))
    th.testing.assert_close(shared, alone, atol=1e-5, rtol=1e-5)
    th.testing.assert_close(each, alone, atol=1e-5, rtol=1e-5)


def test_order_and_time_matter():
    network = make_network()
    x, known, t = make_inputs()
    context = network.context(x, known)
    output = network(x, context, network.modulations(t))
    assert (network(x, context, network.modulations(t + 0.05)) - output).abs().max() > 0.01
    # A set of tokens without places would be equivariant; no flag may tell the places apart here
    context = network.context(x, th.zeros_like(known))
    output, flipped = (network(inputs, context, network.modulations(t)) for inputs in (x, x.flip(1)))
    assert (flipped.flip(1) - output).abs().max() > 0.01
