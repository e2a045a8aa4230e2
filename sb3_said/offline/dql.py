"""Diffusion Q-learning (Wang et al., ICLR 2023, https://arxiv.org/abs/2208.06193), also with state augmentation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import Actor
from torch import nn
from torch.nn import functional as F

from sb3_said.offline.learning import OfflineAlgorithm
from sb3_said.planner.checks import check_settings
from sb3_said.sac.policies import DelayedSACPolicy, each_part, rows_of, seed_of, settings_of

#: More is a slip, and would cost memory or hours, perhaps of whoever loads a file
AT_MOST = {"denoising_steps": 1000, "n_candidates": 10_000, "hidden": 16_384, "time_embedding": 16_384}
NOISE_SETTINGS = "denoising_steps", "beta_min", "beta_max"  # what the weights mean depends on these


@dataclass(frozen=True)
class DQLConfig:
    """Settings of the diffusion policy; "code" is github.com/Zhendong-Wang/Diffusion-Policies-for-Offline-RL."""

    denoising_steps: int = 5
    """T (paper, section 4: N = 5)"""
    beta_min: float = 0.1
    beta_max: float = 10.0
    """of the variance-preserving schedule (paper, appendix B; code)"""
    hidden: int = 256
    """width of the three layers of each network, with Mish (paper, appendix B)"""
    time_embedding: int = 16
    """entries that tell the denoising step (code)"""
    eta: float = 1.0
    """weight of the Q loss; that of the imitation loss is 1 (paper, Table 4: 1.0 for all MuJoCo tasks)"""
    n_candidates: int = 50
    """actions drawn for a decision; one is taken with probability softmax(Q) (code, ``sample_action``)"""
    max_grad_norm: float | None = 9.0
    """of actor and critics (paper, Table 4: 1 to 9, by task and dataset; 9.0 for hopper-medium); None: no clipping"""
    ema_decay: float = 0.995
    ema_start: int = 1000
    ema_every: int = 5
    """of the averaged actor, which gives the actions in Q's targets; start and interval in gradient steps. Before the
    start, the initial weights give them (code)"""

    def __post_init__(self) -> None:
        low = {"denoising_steps": 1, "hidden": 1, "time_embedding": 4, "eta": 0, "n_candidates": 1}
        check_settings(self, low | {"ema_start": 0, "ema_every": 1}, AT_MOST, may_lack=("max_grad_norm",))
        if self.time_embedding % 2:
            raise ValueError(f"time_embedding is {self.time_embedding}, expected an even number: of sines and cosines.")
        if self.max_grad_norm is not None and not self.max_grad_norm > 0:
            raise ValueError(f"max_grad_norm is {self.max_grad_norm}, expected a number above 0, or None.")
        if not 0 < self.beta_min < self.beta_max or not 0 <= self.ema_decay < 1:
            raise ValueError(
                f"beta_min, beta_max and ema_decay are {self.beta_min}, {self.beta_max} and {self.ema_decay}, expected "
                "0 < beta_min < beta_max and 0 <= ema_decay < 1."
            )


class DiffusionActor(Actor):
    """Denoises actions, given what the actor may read of an observation.

    :param config: settings
    :param actor_kwargs: of SB3's ``Actor``, whose Gaussian head is not used
    """

    def __init__(self, config: DQLConfig, **actor_kwargs: Any):
        super().__init__(**actor_kwargs)
        del self.mu, self.log_std, self.latent_pi
        self.config = config
        n, t_dim, act_dim = config.hidden, config.time_embedding, self.action_space.shape[0]
        self.time_net = nn.Sequential(nn.Linear(t_dim, 2 * t_dim), nn.Mish(), nn.Linear(2 * t_dim, t_dim))
        sizes = [self.features_dim + act_dim + t_dim, n, n, n]
        layers = [[nn.Linear(a, b), nn.Mish()] for a, b in itertools.pairwise(sizes)]
        self.noise_net = nn.Sequential(*(module for layer in layers for module in layer), nn.Linear(n, act_dim))
        alphas, frequencies = schedule(config), th.exp(-math.log(10_000) * th.arange(t_dim // 2) / (t_dim // 2 - 1))
        self.register_buffer("alphas", alphas, persistent=False)  # alpha_i: (T,)
        self.register_buffer("products", alphas.cumprod(0), persistent=False)  # alpha-bar_i: (T,)
        self.register_buffer("frequencies", frequencies, persistent=False)

    alphas: th.Tensor
    products: th.Tensor
    frequencies: th.Tensor

    def noise_of(self, features: th.Tensor, action: th.Tensor, step: th.Tensor) -> th.Tensor:
        """Return the noise that the network predicts in noised actions: (B, act_dim).

        :param features: (B, features_dim)
        :param action: (B, act_dim) a^i
        :param step: (B,) int64 i - 1
        """
        angles = step[:, None] * self.frequencies  # (B, t_dim / 2)
        time = self.time_net(th.cat([angles.sin(), angles.cos()], dim=1))
        return self.noise_net(th.cat([action, time, features], dim=1))

    def imitation_loss(self, obs: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """Return the mean squared error of the noise predicted in the data's noised actions (equation 2).

        :param action: (B, act_dim), in [-1, 1]
        """
        step = th.randint(len(self.alphas), (len(action),), device=action.device)
        noise, product = th.randn_like(action), self.products[step, None]
        noised = product.sqrt() * action + (1.0 - product).sqrt() * noise
        return F.mse_loss(self.noise_of(self._features(obs), noised, step), noise)

    def sample(self, obs: PyTorchObs, n: int = 1, generator: th.Generator | None = None) -> th.Tensor:
        """Draw n actions for each of B observations (equation 1), through which gradients flow: (B * n, act_dim).

        :param generator: of the CPU; torch's global one of the device by default
        """
        features = self._features(obs).repeat_interleave(n, 0)  # (B * n, features_dim)
        shape = (len(features), self.action_space.shape[0])

        def draw() -> th.Tensor:
            device = features.device if generator is None else "cpu"
            return th.randn(shape, generator=generator, device=device).to(features.device)

        action = draw()
        for i in reversed(range(len(self.alphas))):
            step = th.full((len(features),), i, device=features.device)
            alpha, product = self.alphas[i], self.products[i]
            before = self.products[i - 1] if i > 0 else th.ones_like(product)
            clean = (action - (1.0 - product).sqrt() * self.noise_of(features, action, step)) / product.sqrt()
            # The posterior of a^{i-1} given a^i and the clean action, which is clipped to the bounds (code)
            action = before.sqrt() * (1.0 - alpha) * clean.clamp(-1.0, 1.0) + alpha.sqrt() * (1.0 - before) * action
            action = action / (1.0 - product)
            if i > 0:
                action = action + ((1.0 - alpha) * (1.0 - before) / (1.0 - product)).sqrt() * draw()
        return action.clamp(-1.0, 1.0)

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Draw one action for each observation."""
        return self.sample(obs)

    def _features(self, obs: PyTorchObs) -> th.Tensor:
        return self.extract_features(obs, self.features_extractor)


def schedule(config: DQLConfig) -> th.Tensor:
    """Return alpha_i = 1 - beta_i of the variance-preserving schedule: (T,).

    Their products are exp(-beta_min i/T - (beta_max - beta_min) (i/T)^2 / 2), i = 1..T (paper, appendix B).
    """
    n = config.denoising_steps
    i = th.arange(1, n + 1, dtype=th.float64)
    slope = config.beta_max - config.beta_min
    return th.exp(-config.beta_min / n - 0.5 * slope * (2 * i - 1) / n**2).float()


class DQLPolicy(DelayedSACPolicy):
    """A diffusion policy, and critics that choose among its actions where they can.

    :param diffusion_kwargs: fields of :class:`DQLConfig`
    :param policy_kwargs: of :class:`~sb3_said.sac.DelayedSACPolicy`
    """

    actor: DiffusionActor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        diffusion_kwargs: dict[str, Any] | None = None,
        **policy_kwargs: Any,
    ):
        self.config: DQLConfig = settings_of(DQLConfig, diffusion_kwargs, "DQL")
        critics: dict[str, Any] = {"net_arch": [self.config.hidden] * 3, "activation_fn": nn.Mish}
        super().__init__(observation_space, action_space, lr_schedule, **(critics | policy_kwargs))

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_target = self.make_actor().requires_grad_(False)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.set_training_mode(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> DiffusionActor:
        features_extractor = features_extractor or self._extractor("observation")
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return DiffusionActor(self.config, **kwargs).to(self.device)

    @property
    def chooses(self) -> bool:
        """Whether the critics read what a deployed agent has, so that they can choose among candidates."""
        return self.replay_space is None or not self.delay_reconciled_critic

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if not deterministic:
            return self.decide(observation)
        # Row by row, so that no answer depends on the batch; the observation seeds its own draws.
        generators = (th.Generator().manual_seed(seed_of(row)) for row in rows_of(observation))
        return th.cat([self.decide(*pair) for pair in zip(rows_of(observation), generators, strict=True)])

    def decide(self, observation: PyTorchObs, generator: th.Generator | None = None) -> th.Tensor:
        """Draw candidates and take one with probability softmax(Q), Q of the target critics: (B, act_dim)."""
        n = self.config.n_candidates if self.chooses else 1
        actions = self.actor.sample(observation, n, generator)  # (B * n, act_dim)
        if n == 1:
            return actions
        repeated = each_part(lambda x: x.repeat_interleave(n, 0), observation)
        values = th.cat(self.critic_target(repeated, actions), dim=1).amin(1).view(-1, n)  # (B, n)
        drawn = th.multinomial(values.softmax(1).cpu(), 1, generator=generator).to(actions.device)  # (B, 1)
        return actions.view(*values.shape, -1)[th.arange(len(drawn), device=actions.device), drawn[:, 0]]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "diffusion_kwargs": asdict(self.config)}


class DQL(OfflineAlgorithm):
    """Diffusion Q-learning: a diffusion policy imitates the data and, weighed by eta, climbs Q.

    Under delay, actor and critics read [observation, action history, age] (DQL+SA, the baseline of the SAID paper);
    ``augment_state=False`` is DQL as published, on old observations. With ``delay_reconciled_critic=True`` the critics
    read the true states, which the logs have. Q is sharper then, but cannot choose in play, so one candidate is drawn.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of actor and critics (paper: 3e-4)
    :param lr_decay: let the learning rate fall to 0 by a cosine over the training, as CleanDiffuser's DQL does. The
        paper's commands have ``--lr_decay``, too, but its code makes only 40 of the schedule's 2,000 steps, by which
        the rate loses 0.1 %
    :param diffusion_kwargs: fields of :class:`DQLConfig`
    :param sac_kwargs: every other argument of :class:`~sb3_said.sac.DelayedSAC`; batch size 256, gamma 0.99 and tau
        0.005 are the paper's. The arguments of entropy and ``target_update_interval`` have no effect
    :raises ValueError: as ``DelayedSAC`` does, and for gSDE, other than two critics, or a ``net_arch`` of the actor
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": DQLPolicy, "MultiInputPolicy": DQLPolicy}
    settings_arguments = ("diffusion_kwargs",)
    policy: DQLPolicy
    actor: DiffusionActor

    def __init__(
        self,
        policy: str | type[DQLPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        lr_decay: bool = False,
        diffusion_kwargs: dict[str, Any] | None = None,
        delay_reconciled_critic: bool = False,
        **sac_kwargs: Any,
    ):
        policy_kwargs = sac_kwargs.get("policy_kwargs") or {}
        arch = policy_kwargs.get("net_arch")
        if (
            sac_kwargs.get("use_sde")
            or policy_kwargs.get("n_critics", 2) != 2
            or (isinstance(arch, dict) and "pi" in arch)
        ):
            raise ValueError(
                "DQL has two critics and a diffusion actor of its own, got "
                f"use_sde={sac_kwargs.get('use_sde', False)} and policy_kwargs={policy_kwargs}; leave use_sde and "
                "n_critics out, and give the actor's width as diffusion_kwargs={'hidden': ...}."
            )
        self.lr_decay = lr_decay
        self.diffusion_kwargs = diffusion_kwargs or {}
        sac_kwargs |= {"delay_reconciled_critic": delay_reconciled_critic}
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    def _policy_flags(self) -> dict[str, Any]:
        return {**super()._policy_flags(), "diffusion_kwargs": self.diffusion_kwargs}

    def _check_file(self, saved: dict[str, Any]) -> None:
        super()._check_file(saved)
        self._check_noise(saved)

    def _take_settings(self, saved: dict[str, Any]) -> None:
        super()._take_settings(saved)
        self._check_noise(saved)

    def _check_noise(self, saved: dict[str, Any]) -> None:
        """:raises ValueError: for weights that learned another noise than this agent's: they would fit, and mislead"""
        theirs = settings_of(DQLConfig, self._settings_in(saved, "diffusion_kwargs"), "DQL")
        given, own = ({name: getattr(x, name) for name in NOISE_SETTINGS} for x in (theirs, self.policy.config))
        if given != own and saved["counters"]["_n_updates"] > 0:
            raise ValueError(
                f"its actor has learned with {given}, and this agent has {own}: give it diffusion_kwargs={given}, or "
                "train anew"
            )

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        if self.lr_decay:
            self.lr_schedule = partial(_falling, self.lr_schedule)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Make gradient steps on batches of the replay buffer."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        config = self.policy.config
        losses: dict[str, list[float]] = {"critic_loss": [], "imitation_loss": [], "q_loss": []}
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            # Critics (equation 4)
            target_q = self.target_q(batch.rewards, batch.next_observations, batch.dones)  # (B, 1)
            critic_loss = sum(
                (F.mse_loss(q, target_q) for q in self.critic(batch.observations, batch.actions)),
                start=target_q.new_zeros(()),
            )
            self._descend(self.critic, critic_loss)
            # Actor (equation 3): Q of a randomly chosen critic, over the mean |Q| of the other
            imitation_loss = self.actor.imitation_loss(batch.observations, batch.actions)
            first, second = self.critic(batch.observations, self.actor.sample(batch.observations))
            if np.random.random() < 0.5:
                first, second = second, first
            q_loss = -first.mean() / second.abs().mean().detach()
            self._descend(self.actor, imitation_loss + config.eta * q_loss)
            # Targets
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            self._n_updates += 1
            if self._n_updates >= config.ema_start and self._n_updates % config.ema_every == 0:
                averaged = self.policy.actor_target.parameters()
                polyak_update(self.actor.parameters(), averaged, 1.0 - config.ema_decay)
            for name, loss in zip(losses, (critic_loss, imitation_loss, q_loss), strict=True):
                losses[name].append(loss.item())
        self.policy.set_training_mode(False)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in losses.items():
            self.logger.record_mean(f"train/{name}", float(np.mean(values)))

    @th.no_grad()
    def target_q(self, rewards: th.Tensor, next_observations: PyTorchObs, dones: th.Tensor) -> th.Tensor:
        """Return r + gamma min over the target critics of Q(s', a'), a' of the averaged actor: (B, 1).

        :param rewards: (B, 1)
        :param dones: (B, 1), 1 where the task itself ended
        """
        next_action = self.policy.actor_target.sample(next_observations)
        next_q = th.cat(self.critic_target(next_observations, next_action), dim=1).amin(1, keepdim=True)
        return rewards + (1.0 - dones) * self.gamma * next_q

    def _descend(self, network: Any, loss: th.Tensor) -> None:
        network.optimizer.zero_grad()
        loss.backward()
        if self.policy.config.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(network.parameters(), self.policy.config.max_grad_norm)
        network.optimizer.step()


def _falling(rate: Callable[[float], float], remaining: float) -> float:
    """Return a rate times a cosine that falls from 1 to 0. It is no lambda, since that could not be pickled."""
    return rate(remaining) * 0.5 * (1.0 - math.cos(math.pi * remaining))
