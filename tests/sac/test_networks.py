"""Stacked networks against the layers they were made of, and their gradients against autograd's."""

import copy
import itertools

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_said.sac.networks import FusedAdam, StackedActor, StackedCritic, StackedMLP

STATES, ACTIONS = spaces.Box(-1, 1, (5,)), spaces.Box(-1, 1, (2,))
BATCH = 33


def build(cls, net_arch=(16, 8), activation_fn=nn.ReLU, **kwargs):
    """The same seed gives the same layers, in SB3's class and in ours."""
    th.manual_seed(0)
    return cls(
        STATES, ACTIONS, net_arch=list(net_arch), features_extractor=FlattenExtractor(STATES), features_dim=5,
        activation_fn=activation_fn, **kwargs,
    )  # fmt: skip


def pair(kind, **kwargs):
    sb3, ours = {"actor": (Actor, StackedActor), "critic": (ContinuousCritic, StackedCritic)}[kind]
    if kind == "critic":
        kwargs = {"share_features_extractor": False, "n_critics": 3} | kwargs
    return build(sb3, **kwargs), build(ours, **kwargs)


def batch():
    generator = th.Generator().manual_seed(1)
    return th.randn(BATCH, 5, generator=generator), th.rand(BATCH, 2, generator=generator) * 2 - 1


@pytest.mark.parametrize("net_arch", [(16, 8), (7,), ()], ids=str)
@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh, nn.ELU])
def test_critics_and_all_their_gradients_are_sb3s(net_arch, activation_fn):
    theirs, ours = pair("critic", net_arch=net_arch, activation_fn=activation_fn)
    states, actions = batch()
    weights = th.randn(3, BATCH, generator=th.Generator().manual_seed(2))
    grads = []
    for critic in (theirs, ours):
        inputs = states.clone().requires_grad_(), actions.clone().requires_grad_()
        q = th.cat(critic(*inputs), dim=1).T  # (n_critics, B)
        (q * weights).sum().backward()
        grads.append((q.detach(), *(x.grad for x in inputs)))
    th.testing.assert_close(grads[1], grads[0], rtol=1e-5, atol=1e-6)
    of_layers = {name: p.grad for name, p in theirs.named_parameters()}
    th.testing.assert_close(ours.net.named_views(ours.net.flat.grad), of_layers, rtol=1e-5, atol=1e-6)
    th.testing.assert_close(ours.q1_forward(states, actions), theirs.q1_forward(states, actions))


def test_frozen_critics_pass_gradients_on_and_keep_none():
    critic = pair("critic")[1]
    states, actions = batch()
    found = []
    for frozen in (False, True):
        of = actions.clone().requires_grad_()
        critic.zero_grad()
        critic.q_values(states, of, frozen=frozen).amin(0).sum().backward()
        assert (critic.net.flat.grad is None) == frozen
        found.append(of.grad)
    th.testing.assert_close(*found, rtol=0, atol=0)


def test_the_actor_and_all_its_gradients_are_sb3s():
    theirs, ours = pair("actor")
    states, _ = batch()
    weights = th.randn(BATCH, 2, generator=th.Generator().manual_seed(2))
    found = []
    for actor in (theirs, ours):
        th.manual_seed(3)
        actions, log_prob = actor.action_log_prob(states)
        ((actions * weights).sum() + (log_prob * weights[:, 0]).sum()).backward()
        found.append((actions.detach(), log_prob.detach(), actor(states, deterministic=True).detach()))
    th.testing.assert_close(found[1], found[0], rtol=1e-5, atol=1e-5)
    of_layers = {name: p.grad for name, p in theirs.named_parameters()}
    th.testing.assert_close(ours.net.named_views(ours.net.flat.grad), of_layers, rtol=1e-4, atol=1e-5)


def test_log_probabilities_of_squashed_actions_integrate_to_one():
    """Over a grid of one action entry, exp(log pi(a)) is a density; SB3's own class agrees on each point."""
    actor = pair("actor")[1]
    state = batch()[0][:1]
    mean, log_std, _ = actor.get_action_dist_params(state)
    th.manual_seed(0)
    actions, log_prob = actor.action_log_prob(state.expand(200_000, -1))
    theirs = SquashedDiagGaussianDistribution(2).proba_distribution(mean, log_std)
    inner = (actions.abs() < 0.999).all(1)  # where atanh is exact enough in float32
    th.testing.assert_close(theirs.log_prob(actions[inner]), log_prob[inner], rtol=1e-3, atol=1e-3)
    # E[1 / pi(a)] over samples is the volume of the actions, 2 ** act_dim
    assert (-log_prob[inner]).exp().mean().item() == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("kind", ["actor", "critic"])
def test_weights_go_to_and_from_sb3s_networks(kind):
    theirs, ours = pair(kind)
    state = ours.state_dict()
    assert state.keys() == theirs.state_dict().keys()
    th.testing.assert_close(state, theirs.state_dict(), rtol=0, atol=0)
    with th.no_grad():
        theirs.load_state_dict({name: value + 1.0 for name, value in state.items()})
    ours.load_state_dict(theirs.state_dict())
    th.testing.assert_close(ours.state_dict(), theirs.state_dict(), rtol=0, atol=0)
    twin = copy.deepcopy(ours)
    with th.no_grad():
        ours.net.flat.zero_()
    th.testing.assert_close(twin.state_dict(), theirs.state_dict(), rtol=0, atol=0)


def test_weights_that_do_not_fit_are_named():
    state = build(StackedCritic, net_arch=(16, 9), share_features_extractor=False).state_dict()
    critic = build(StackedCritic, share_features_extractor=False)
    with pytest.raises(RuntimeError, match=r"size mismatch for qf0\.2\.weight: \(9, 16\) is given, expected \(8, 16\)"):
        critic.load_state_dict(state)
    with pytest.raises(RuntimeError, match=r"Missing key.*qf1\.4\.bias"):
        critic.load_state_dict({k: v for k, v in critic.state_dict().items() if k != "qf1.4.bias"})
    with pytest.raises(RuntimeError, match=r"Unexpected key.*qf2"):
        critic.load_state_dict(critic.state_dict() | {"qf2.0.weight": th.zeros(1)})


def layers(*sizes):
    return [((f"{i}", nn.Linear(*pair)),) for i, pair in enumerate(itertools.pairwise(sizes))]


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh])
def test_bfloat16_rounds_and_no_more(activation):
    """Eight bits of mantissa: outputs and gradients within 3 % of their size, over both networks."""
    net = StackedMLP([layers(6, 64, 64, 3), layers(6, 64, 64, 3)], activation)
    x = th.randn(128, 6)
    found = []
    for enabled in (False, True):
        inputs = x.clone().requires_grad_()
        net.zero_grad()
        with th.autocast("cpu", th.bfloat16, enabled=enabled):
            out = net(inputs)
        assert out.dtype == th.float32
        out.square().sum().backward()
        found.append((out.detach(), inputs.grad, net.flat.grad))
    for exact, rounded in zip(*found, strict=True):
        assert rounded.dtype == th.float32
        error = (rounded - exact).norm() / exact.norm()
        assert 1e-4 < error < 0.03


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh])
def test_bfloat16_keeps_small_differences_of_large_inputs_and_outputs(activation):
    """A value near 200 is known to far less than 1, an observation near 10 to far less than 0.06."""
    net = StackedMLP([layers(6, 64, 64, 1)], activation)
    with th.no_grad():
        dict(net.named_views(net.flat))["2.bias"].fill_(200.0)
        dict(net.named_views(net.flat))["0.bias"].sub_(dict(net.named_views(net.flat))["0.weight"].sum(1) * 10)
    x = 10 + 0.03 * th.randn(512, 6)
    exact = net(x)
    with th.autocast("cpu", th.bfloat16):
        rounded = net(x)
    assert (rounded - exact).abs().max() < 0.01
    found, expected = rounded - rounded.mean(), exact - exact.mean()
    assert th.corrcoef(th.stack([found.flatten(), expected.flatten()]))[0, 1] > 0.99


def test_bfloat16_follows_every_change_of_the_weights():
    net = StackedMLP([layers(6, 8, 8, 1)], nn.ReLU)
    x = th.randn(4, 6)

    def outputs():
        with th.autocast("cpu", th.bfloat16), th.no_grad():
            return net(x), copy.deepcopy(net)(x)  # a copy has no converted weights yet

    optimizer = FusedAdam(net.parameters(), lr=0.1)
    state = {name: value.clone() for name, value in net.state_dict().items()}

    def step():
        net(x).sum().backward()
        optimizer.step()

    def set_data():
        net.flat.data = th.randn_like(net.flat)

    before = outputs()[0]
    for change in (step, step, lambda: net.load_state_dict(state), set_data, step):
        change()
        now, fresh = outputs()
        assert th.equal(now, fresh)
        assert not th.equal(now, before)
        before = now


def test_weights_changed_between_forward_and_backward_are_noticed():
    net = StackedMLP([layers(6, 8, 1)], nn.ReLU)
    x = th.randn(4, 6, requires_grad=True)
    net(x).sum().backward()
    out = net(x).sum()
    FusedAdam(net.parameters(), lr=0.1).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.backward()


def test_fused_adam_is_adam():
    theirs, ours = (nn.Parameter(th.linspace(-1, 1, 50)) for _ in range(2))
    optimizers = (
        th.optim.Adam([theirs], lr=0.01, betas=(0.8, 0.9), weight_decay=0.1),
        FusedAdam([ours], lr=0.01, betas=(0.8, 0.9), weight_decay=0.1),
    )
    for k in range(5):
        for p, optimizer in zip((theirs, ours), optimizers, strict=True):
            p.grad = th.sin(k + p.detach())
            optimizer.step()
    th.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-7)
