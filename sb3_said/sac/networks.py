"""Actor and critics whose layers lie in one tensor: SB3's networks, at a fraction of the calls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor
from torch import nn

from sb3_said.files.registry import register_class

SQUASH_EPSILON = 1e-6  # of SB3's SquashedDiagGaussianDistribution
Layers = list[tuple[th.Tensor, th.Tensor]]
NamedLayer = tuple[tuple[str, nn.Linear], ...]  # linear maps of one input, whose outputs are concatenated


@register_class
class FusedAdam(th.optim.Adam):
    """Adam in one kernel, which tells PyTorch that the weights have changed; the kernel alone does not (2.13).

    Autograd's check for weights that changed under it, and the copies of ``StackedMLP``, rest on being told.

    :param adam_kwargs: of :class:`torch.optim.Adam`
    """

    def __init__(self, params: Any, **adam_kwargs: Any) -> None:
        super().__init__(params, **{"fused": True, **adam_kwargs})

    def step(self, closure: Any = None) -> Any:
        """Make one step; see :meth:`torch.optim.Adam.step`."""
        loss = super().step(closure)
        for group in self.param_groups:
            th.autograd.graph.increment_version(group["params"])
        return loss


class StackedMLP(nn.Module):
    """n MLPs of one shape, evaluated side by side, with all their weights in one parameter.

    A small network's update on a CPU costs about as much in calls as in arithmetic. One parameter makes optimizer,
    averaging and conversion to bfloat16 one call each, and a batched product serves all n networks.

    The actor and critics made of it keep SB3's names in their state dicts, so that weights stay exchangeable.
    Inside ``torch.autocast`` the products between hidden layers, nearly all there is to compute, run in its number
    format. First and last layer stay float32: with its 8 bits, bfloat16 would make steps of 1 in values near 200, of
    which a TD error is a small difference, and steps of 0.01 in an observed height near 1.3.

    :param networks: for each network, its layers from input to output, each with its names
    :param activation: between layers
    """

    def __init__(self, networks: Sequence[Sequence[NamedLayer]], activation: type[nn.Module]) -> None:
        super().__init__()
        self.activation = activation()
        self._is_relu = activation is nn.ReLU
        self.shapes: list[tuple[int, ...]] = []
        self._names: list[tuple[str, int, int, slice]] = []  # name, index in shapes, network, rows of the output
        parts = []
        for depth, layers in enumerate(zip(*networks, strict=True)):
            weights, biases = [], []
            for network, layer in enumerate(layers):
                row = 0
                for name, linear in layer:
                    rows = slice(row, row := row + linear.out_features)
                    self._names += [(f"{name}.weight", 2 * depth, network, rows)]
                    self._names += [(f"{name}.bias", 2 * depth + 1, network, rows)]
                weights.append(th.cat([linear.weight for _, linear in layer]))  # (n_out, n_in)
                biases.append(th.cat([linear.bias for _, linear in layer]))  # (n_out,)
            parts += [th.stack(weights), th.stack(biases)]
            self.shapes += [tuple(parts[-2].shape), tuple(parts[-1].shape)]
        self.sizes = [math.prod(shape) for shape in self.shapes]
        self._copies: dict[th.dtype, _Copy] = {}
        self.flat = nn.Parameter(th.cat([part.detach().flatten() for part in parts]))

    def forward(self, x: th.Tensor, frozen: bool = False) -> th.Tensor:
        """Return the output of every network: (n, B, n_out) float32.

        :param x: (B, n_in)
        :param frozen: spare the gradients of the weights, which leave those of ``x`` as they are
        """
        flat = self.flat.detach() if frozen else self.flat
        kind = x.device.type
        dtype = th.get_autocast_dtype(kind) if th.is_autocast_enabled(kind) else flat.dtype
        with th.autocast(kind, enabled=False):  # it would convert every product
            if self._is_relu:
                return _StackedReLU.apply(x, flat, self, dtype)
            h = x.expand(self.shapes[0][0], -1, -1)  # (n, B, n_in)
            for i, (weight, bias) in enumerate(self.layers(flat, self.inner(flat).to(dtype))):
                h = th.baddbmm(bias, (h if i == 0 else self.activation(h)).to(weight.dtype), weight)
            return h

    def inner(self, flat: th.Tensor) -> th.Tensor:
        """Return the part of ``flat`` that lies between first and last layer, as a view."""
        return flat[sum(self.sizes[:2]) : flat.numel() - sum(self.sizes[-2:])]

    def layers(self, flat: th.Tensor, inner: th.Tensor | None = None) -> Layers:
        """Return weights (n, n_in, n_out) and biases (n, 1, n_out) of every layer, as views.

        :param flat: of all layers, laid out as the parameter
        :param inner: of those between first and last, where they are not to be views of ``flat``
        """
        parts = list(flat.split(self.sizes))
        if inner is not None:
            parts[2:-2] = inner.split(self.sizes[2:-2])
        parts = [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return [(w.transpose(1, 2), b[:, None]) for w, b in zip(parts[::2], parts[1::2], strict=True)]

    def converted_layers(self, dtype: th.dtype) -> Layers:
        """Return the layers, inner ones in another number format, converted only when the weights have changed."""
        if dtype == self.flat.dtype:
            return self.layers(self.flat.detach())
        copy = self._copies.get(dtype)
        if copy is None or copy.inner.device != self.flat.device:
            copy = self._copies[dtype] = _Copy(self, dtype)
        copy.follow(self)
        return copy.layers

    def named_views(self, flat: th.Tensor) -> dict[str, th.Tensor]:
        """Return every layer's weight (n_out, n_in) and bias (n_out,) under its own name, as views."""
        parts = [part.view(shape) for part, shape in zip(flat.split(self.sizes), self.shapes, strict=True)]
        return {name: parts[index][network, rows] for name, index, network, rows in self._names}


class _Copy:
    """The inner layers of a ``StackedMLP`` in another number format."""

    def __init__(self, net: StackedMLP, dtype: th.dtype) -> None:
        self.inner = th.empty_like(net.inner(net.flat.detach()), dtype=dtype)
        self.layers: Layers = []  # first and last are views of the parameter
        self.version: tuple[int, int] | None = None  # of what was copied

    def follow(self, net: StackedMLP) -> None:
        version = (net.flat.data_ptr(), net.flat._version)
        if version != self.version:
            flat = net.flat.detach()
            self.inner.copy_(net.inner(flat))
            self.layers = net.layers(flat, self.inner)
            self.version = version


class _StackedReLU(th.autograd.Function):
    """``StackedMLP.forward`` with ReLUs and its gradient, as one node instead of one for every operation."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, flat: th.Tensor, net: StackedMLP, dtype: th.dtype) -> th.Tensor:
        layers = net.converted_layers(dtype)
        hidden: list[th.Tensor] = []  # what every layer reads: (n, B, n_in), in its number format
        out = x.expand(net.shapes[0][0], -1, -1)
        for weight, bias in layers:
            hidden.append((_relu_(out) if hidden else out).to(weight.dtype))
            out = th.baddbmm(bias, hidden[-1], weight)
        ctx.save_for_backward(*hidden, *(weight for weight, _ in layers))
        ctx.net = net
        return out

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, grad_output: th.Tensor) -> tuple[th.Tensor | None, ...]:
        with th.autocast(grad_output.device.type, enabled=False):
            return _StackedReLU.gradients(ctx, grad_output)

    @staticmethod
    def gradients(ctx: Any, grad_output: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Return the gradients of what ``forward`` was given."""
        net, n_layers = ctx.net, len(ctx.net.sizes) // 2
        hidden, weights = ctx.saved_tensors[:n_layers], ctx.saved_tensors[n_layers:]
        grad = grad_output  # (n, B, n_out)
        of_flat = grad.new_empty(sum(net.sizes)) if ctx.needs_input_grad[1] else None
        of_layers = None if of_flat is None else net.layers(of_flat)
        for i in reversed(range(n_layers)):
            grad = grad.to(weights[i].dtype)
            if of_layers is not None:
                of_weight, of_bias = of_layers[i]
                of_weight.transpose(1, 2).copy_(th.bmm(grad.transpose(1, 2), hidden[i]))
                th.sum(grad, 1, keepdim=True, dtype=of_bias.dtype, out=of_bias)
            if i > 0:
                grad = th.bmm(grad, weights[i].transpose(1, 2))
                grad = th.ops.aten.threshold_backward(grad, hidden[i], 0)  # that of relu, from its output
        of_x = None
        if ctx.needs_input_grad[0]:
            of_x = th.bmm(grad, weights[0].transpose(1, 2)).sum(0)  # (B, n_in)
        return of_x, of_flat, None, None


def _relu_(x: th.Tensor) -> th.Tensor:
    if x.dtype == th.bfloat16 and x.device.type == "cpu":
        # A bfloat16 is negative where its bits are as an int16; that comparison is five times as fast on CPUs.
        x.view(th.int16).clamp_min_(0)
        return x
    return x.relu_()


class StackedActor(Actor):
    """SB3's actor with its layers in one tensor. gSDE needs the layers apart: with ``use_sde`` take SB3's own.

    :param actor_kwargs: of :class:`stable_baselines3.sac.policies.Actor`
    """

    def __init__(self, *actor_args: Any, **actor_kwargs: Any) -> None:
        super().__init__(*actor_args, **actor_kwargs)
        heads: Any = (("mu", self.mu), ("log_std", self.log_std))  # SB3 declares the log_std of gSDE, a parameter
        self.net = StackedMLP([[*_named_layers("latent_pi", self.latent_pi), heads]], self.activation_fn)
        del self.latent_pi, self.mu, self.log_std
        _keep_layer_names(self)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Return mean and logarithm of the standard deviation before squashing: (B, act_dim) each."""
        mean, log_std = self.net(self.extract_features(obs, self.features_extractor))[0].chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX), {}

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Draw squashed actions (B, act_dim) and return their log-probabilities (B,)."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        return _SquashedSample.apply(mean, log_std, th.randn_like(mean))


class _SquashedSample(th.autograd.Function):
    """a = tanh(u), u = mean + std * noise, and log pi(a) (Haarnoja et al. 2018, Appendix C), with their gradient.

    log pi(a) = sum over entries of log N(u; mean, std) - log(1 - a^2), and the noise stays fixed, so that
    d log pi / d mean = 2 a (1 - a^2) / (1 - a^2 + epsilon), and d log pi / d log_std = that * std * noise - 1.
    """

    @staticmethod
    def forward(ctx: Any, mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        spread = log_std.exp() * noise  # (B, act_dim)
        action = (mean + spread).tanh()
        slope = 1 - action * action
        ctx.save_for_backward(action, slope, spread)
        terms = (noise * noise).mul_(-0.5).sub_(log_std).sub_((slope + SQUASH_EPSILON).log_())
        return action, terms.sum(-1).sub_(0.5 * math.log(2 * math.pi) * mean.shape[-1])

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, of_action: th.Tensor, of_log_prob: th.Tensor) -> tuple[th.Tensor | None, ...]:
        action, slope, spread = ctx.saved_tensors
        of_log_prob = of_log_prob[:, None]  # (B, 1)
        of_mean = slope * (of_action + of_log_prob * (2 * action) / (slope + SQUASH_EPSILON))
        return of_mean, of_mean * spread - of_log_prob, None


class StackedCritic(ContinuousCritic):
    """SB3's critics, evaluated side by side.

    :param critic_kwargs: of :class:`stable_baselines3.common.policies.ContinuousCritic`
    """

    def __init__(self, *critic_args: Any, **critic_kwargs: Any) -> None:
        super().__init__(*critic_args, **critic_kwargs)
        self.net = StackedMLP(
            [_named_layers(f"qf{i}", network) for i, network in enumerate(self.q_networks)],
            critic_kwargs.get("activation_fn", nn.ReLU),
        )
        for i in range(self.n_critics):
            delattr(self, f"qf{i}")
        self.q_networks = []
        _keep_layer_names(self)

    def q_values(self, obs: PyTorchObs, actions: th.Tensor, frozen: bool = False) -> th.Tensor:
        """Return every critic's Q(s, a): (n_critics, B).

        :param obs: B observations of what the critics read
        :param actions: (B, act_dim), in [-1, 1]
        :param frozen: spare the gradients of the weights, which leave those of the actions as they are
        """
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        return self.net(th.cat([features, actions], dim=1), frozen).squeeze(-1)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return every critic's Q(s, a), (B, 1) each, as SB3 does."""
        return self.q_values(obs, actions).unsqueeze(-1).unbind(0)

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Return the first critic's Q(s, a): (B, 1)."""
        return self.forward(obs, actions)[0]


def _named_layers(name: str, network: nn.Module) -> list[NamedLayer]:
    return [((f"{name}.{i}", m),) for i, m in enumerate(network.children()) if isinstance(m, nn.Linear)]


def _keep_layer_names(module: nn.Module) -> None:
    """Let the state dict of ``module`` name the layers of its ``net`` as SB3 does, both ways."""
    module.register_state_dict_post_hook(_write_layer_names)
    module.register_load_state_dict_pre_hook(_read_layer_names)


def _write_layer_names(module: Any, state: dict[str, Any], prefix: str, _: Any) -> None:
    flat = state.pop(f"{prefix}net.flat")
    state.update({prefix + name: view for name, view in module.net.named_views(flat).items()})


def _read_layer_names(
    module: Any, state: dict[str, Any], prefix: str, _: Any, strict: bool, missing: Any, unexpected: Any, errors: Any
) -> None:
    flat = module.net.flat.detach().clone()
    for name, view in module.net.named_views(flat).items():
        given = state.pop(prefix + name, None)
        if given is None:
            missing.append(prefix + name)
        elif given.shape != view.shape:
            expected = tuple(view.shape)
            errors.append(f"size mismatch for {prefix}{name}: {tuple(given.shape)} is given, expected {expected}.")
        else:
            view.copy_(given)
    state[f"{prefix}net.flat"] = flat
