"""A steadier expert: SADR on scaled rewards and normalised states, with a small entropy bonus and a slower actor."""

from __future__ import annotations

import io
import pathlib
import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update

from sb3_said.delays.space import UNDELAYED
from sb3_said.sac.delayed_sac import DelayedSAC
from sb3_said.sac.episodes import TrainingEpisodes
from sb3_said.sac.policies import DelayedSACPolicy
from sb3_said.sac.scaling import running_return

REFIT_GROWTH = 1.1  # the z-scores are fitted again after a tenth more environment steps
STATES_LOOKED_AT = 10_000
YOUTH = 4.0  # update n decays a young average by 1 - YOUTH / n, so it is n / 5 updates old: results/stable_expert.md


class StableSAC(DelayedSAC):
    """:class:`DelayedSAC` whose returns rise and stay: what the field has found since SAC, as far as it helps here.

    Five parts, measured in results/expert_parts.md:

    - rewards are divided by the size of the returns so far (SimbaV2, https://arxiv.org/abs/2502.15280, section 4.4), so
      that the critics' units stay the same while the policy improves;
    - states are z-scored, with the statistics of replay; actions and ages are in [-1, 1] as they are;
    - in units of scaled rewards the entropy coefficient starts at 0.01, and the target entropy is half of SAC's;
    - actor and entropy coefficient are updated every second step (TD3, https://arxiv.org/abs/1802.09477, section 5.2);
    - a running average of the actor's weights answers ``predict`` and is saved; the actor itself collects. One gradient
      step can move a return far (https://arxiv.org/abs/2309.14597), an average over thousands moves less. The average
      waits while the training episodes have lost half of what was learned (like TD7's checkpoints, sac/episodes.py).

    With ``scale_rewards=False, normalise_states=False, policy_delay=1, actor_averaging=0.0, ent_coef="auto",
    target_entropy="auto"`` it is ``DelayedSAC``, with two differences: an update changes the entropy coefficient
    last, and ``target_update_interval`` counts all gradient steps, where SB3 counts those of each ``train`` call anew.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of actor, critics and entropy coefficient; a number or a schedule
    :param scale_rewards: learn from rewards divided by :class:`~sb3_said.sac.scaling.ReturnScale`
    :param normalise_states: actor and critics read z-scores of states
    :param policy_delay: updates of the critics for each update of the actor
    :param actor_averaging: decay of the actor's average in each of its updates, in [0, 1); 0 for no average
    :param ent_coef: SAC's, in units of scaled rewards
    :param target_entropy: SAC's; ``"half"`` is -act_dim / 2, ``"auto"`` is -act_dim
    :param critic_layer_norm: a LayerNorm follows each hidden layer of the critics, so that these bear
        ``gradient_steps=2`` (DroQ, https://arxiv.org/abs/2110.02034). HalfCheetah-v5, whose episodes do not end by a
        fall, learns faster with it; Hopper-v5 does not, and Walker2d-v5 falls for longer (results/expert_parts.md)
    :param sac_kwargs: every other argument of :class:`DelayedSAC`
    :raises ValueError: as ``DelayedSAC`` does, and for a ``policy_delay`` or an ``actor_averaging`` out of range
    :raises TypeError: for an unknown argument
    """

    policy: DelayedSACPolicy

    def __init__(
        self,
        policy: str | type[DelayedSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        scale_rewards: bool = True,
        normalise_states: bool = True,
        policy_delay: int = 2,
        actor_averaging: float = 0.9998,
        ent_coef: str | float = "auto_0.01",
        target_entropy: str | float = "half",
        critic_layer_norm: bool = False,
        **sac_kwargs: Any,
    ):
        if policy_delay < 1 or policy_delay % 1 != 0:
            raise ValueError(f"policy_delay must be a whole number, at least 1, got {policy_delay}.")
        if not 0.0 <= actor_averaging < 1.0:
            raise ValueError(f"actor_averaging is a decay in [0, 1), got {actor_averaging}.")
        self.scale_rewards = scale_rewards
        self.normalise_states = normalise_states
        self.policy_delay = policy_delay
        self.actor_averaging = actor_averaging
        self.critic_layer_norm = critic_layer_norm
        self._running_returns = np.zeros(1)  # (n_envs,) G_t of the episodes that are being played
        self._paid = np.zeros(1)  # (n_envs,) the same, undiscounted and in the task's own rewards
        super().__init__(policy, env, learning_rate, ent_coef=ent_coef, target_entropy=target_entropy, **sac_kwargs)

    def _setup_model(self) -> None:
        if self.target_entropy == "half":
            self.target_entropy = -0.5 * float(np.prod(self.action_space.shape or ()))
        given = self.policy_kwargs
        if not {"optimizer_class", "optimizer_kwargs"} & set(given):
            self.policy_kwargs = {**given, "optimizer_kwargs": {"fused": True}}  # of Adam, saves a tenth of an update
        super()._setup_model()
        self.policy_kwargs = given
        if self.use_sde and self.policy.averaged_actor is not None:
            self.policy.averaged_actor.reset_noise()  # its noise does not move to a GPU with the networks

    def _policy_flags(self) -> dict[str, Any]:
        return {
            **super()._policy_flags(),
            "normalise_states": self.normalise_states,
            "scale_rewards": self.scale_rewards,
            "average_actor": self.actor_averaging > 0.0,
            "critic_layer_norm": self.critic_layer_norm,
        }

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Complete parameters without an average: their actor becomes it, their training episodes are empty."""
        params = super()._adapt_parameters(params)
        given = params.get("policy", {})
        if self.policy.averaged_actor is not None and any(name.startswith("actor.") for name in given):
            own = {f"averaged_{name}": x for name, x in given.items() if name.startswith("actor.")}
            unknown = {f"training_episodes.{name}": x for name, x in TrainingEpisodes().state_dict().items()}
            params = {**params, "policy": {**own, **unknown, **given}}
        return params

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps and self.policy.training_episodes is not None:
            self.policy.training_episodes.forget()  # another task may return less from now on
        vec_normalize = self.get_vec_normalize_env()
        if self.scale_rewards and vec_normalize is not None and vec_normalize.norm_reward:
            warnings.warn(
                f"VecNormalize normalises rewards, and {type(self).__name__} scales them by the largest return so far: "
                "one of the first steps, where VecNormalize knows no size yet. Give VecNormalize(..., "
                "norm_reward=False), or scale_rewards=False.",
                stacklevel=3,
            )
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read a replay as :class:`DelayedSAC` does; an agent that has seen no reward takes its scale from it."""
        super().load_replay_buffer(path, truncate_last_traj)
        scale, replay = self.policy.return_scale, self.replay_buffer
        if scale is None or scale.count >= 1.0 or replay.holds_logs or replay.size() == 0:
            return
        returns = [np.zeros(replay.n_envs)]
        for row in (replay.pos - replay.size() + np.arange(replay.size())) % replay.buffer_size:  # oldest first
            returns.append(running_return(replay.rewards[row], returns[-1], replay.steps[row] == 0, self.gamma))
        scale.update(np.concatenate(returns[1:]))

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        if self.policy.training_episodes is not None:
            for ended in (info["episode"] for info in infos if info.get("episode") is not None):
                self.policy.training_episodes.add(float(ended["r"]), int(ended["l"]))

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        with self.policy.without_average():
            return super()._sample_action(*args, **kwargs)

    def _store_transition(
        self,
        replay_buffer: Any,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        is_stored = self._last_obs is not None  # else a callback has played at this very step
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # refuses what is NaN
        if not is_stored:
            return
        row = replay_buffer.pos - 1
        begins = replay_buffer.steps[row] == 0  # (n_envs,), as the replay saw it
        if self.policy.return_scale is not None:
            reward = np.asarray(reward, np.float32)  # as a DummyVecEnv has them, and a SubprocVecEnv does not
            self._running_returns = running_return(reward, self._running_returns, begins, self.gamma)
            self.policy.return_scale.update(self._running_returns)
        if self.policy.training_episodes is not None:
            self._paid = running_return(replay_buffer.rewards[row], self._paid, begins)
            for i in np.flatnonzero(dones):
                if infos[i].get("episode") is None:  # no Monitor tells of it
                    self.policy.training_episodes.add(float(self._paid[i]), int(replay_buffer.steps[row, i]) + 1)

    def _look_at_states(self) -> None:
        """Fit the z-scores to the states in replay, once a tenth more environment steps have been taken than last time.

        A replay with fewer states than then is left out, unless it is full. An agent that goes on without its own
        replay would otherwise scale by a few states of random actions, and its networks would see another task
        (measured, results/stable_expert.md).
        """
        normalizer = self.policy.state_normalizer
        if normalizer is None:
            return
        replay, fitted_at = self.replay_buffer, float(normalizer.fitted_at)
        has_as_many = replay.size() * self.n_envs >= min(fitted_at, replay.buffer_size * self.n_envs)
        is_counted_anew = self.num_timesteps < fitted_at
        if has_as_many and (is_counted_anew or self.num_timesteps >= REFIT_GROWTH * fitted_at):
            n_states = min(STATES_LOOKED_AT, replay.size() * self.n_envs)
            seen = self.replay_buffer.sample(n_states, env=self._vec_normalize_env).observations
            normalizer.fit(seen[UNDELAYED] if isinstance(seen, dict) else seen, self.num_timesteps)

    def _average_actor(self, waits: bool = False) -> None:
        """Move the average towards the actor; a young average forgets faster.

        While young it is the power-function average of Karras et al. (https://arxiv.org/abs/2312.02696, section 3.1). A
        plain mean of the first updates would hold what an agent did before it had learned anything.

        :param waits: leave the average as it is, once it is of as many updates as it is to remember
        """
        average, n = self.policy.averaged_actor, self._n_updates // self.policy_delay
        decay = min(self.actor_averaging, max(0.0, 1.0 - YOUTH / n))
        if average is None or (waits and n * (1.0 - self.actor_averaging) >= 1.0):
            return
        polyak_update(self.actor.parameters(), average.parameters(), 1.0 - decay)
        for own, averaged in zip(self.actor.buffers(), average.buffers(), strict=True):
            averaged.copy_(own)  # of a batch norm
        if self.use_sde:
            average.reset_noise()  # with the spread that is learned by now

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update critics, and every ``policy_delay`` steps actor and entropy coefficient, on batches from replay."""
        self.policy.set_training_mode(True)
        learned = [self.actor.optimizer, self.critic.optimizer]
        self._update_learning_rate(learned if self.ent_coef_optimizer is None else [*learned, self.ent_coef_optimizer])
        self._look_at_states()
        scale = 1.0 if self.policy.return_scale is None else self.policy.return_scale.value
        episodes = self.policy.training_episodes
        waits = episodes is not None and episodes.have_collapsed  # no episode ends during the updates
        losses: dict[str, list[float]] = {"critic_loss": [], "actor_loss": [], "ent_coef_loss": []}

        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            ent_coef = self._ent_coef()
            if self.use_sde:
                self.actor.reset_noise()

            # Critics: soft Bellman targets, in units of scaled rewards
            with th.no_grad():
                next_actions, next_log_prob = self.actor.action_log_prob(batch.next_observations)  # (B, act_dim), (B,)
                next_q = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1)  # (B, n_critics)
                next_value = next_q.amin(1, keepdim=True) - ent_coef * next_log_prob.reshape(-1, 1)
                target = batch.rewards / scale + (1 - batch.dones) * self.gamma * next_value  # (B, 1)
            q = th.stack(self.critic(batch.observations, batch.actions))  # (n_critics, B, 1)
            critic_loss = 0.5 * (q - target).square().mean(1).sum()
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()
            losses["critic_loss"].append(critic_loss.item())

            self._n_updates += 1
            if self._n_updates % self.policy_delay == 0:
                # Actor
                actions, log_prob = self.actor.action_log_prob(batch.observations)
                log_prob = log_prob.reshape(-1, 1)  # (B, 1)
                value = th.cat(self.critic(batch.observations, actions), dim=1).amin(1, keepdim=True)  # (B, 1)
                actor_loss = (ent_coef * log_prob - value).mean()
                self.actor.optimizer.zero_grad()
                actor_loss.backward(inputs=[p for p in self.actor.parameters() if p.requires_grad])
                self.actor.optimizer.step()
                self._average_actor(waits)
                losses["actor_loss"].append(actor_loss.item())

                # Entropy coefficient
                if self.ent_coef_optimizer is not None:
                    assert self.log_ent_coef is not None and isinstance(self.target_entropy, float)
                    ent_coef_loss = -(self.log_ent_coef * (log_prob.detach() + self.target_entropy)).mean()
                    self.ent_coef_optimizer.zero_grad()
                    ent_coef_loss.backward()
                    self.ent_coef_optimizer.step()
                    losses["ent_coef_loss"].append(ent_coef_loss.item())

            if self._n_updates % self.target_update_interval == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        self.policy.forget_graph()
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/ent_coef", float(self._ent_coef()))
        self.logger.record("train/reward_scale", float(scale))
        if episodes is not None:
            self.logger.record("train/average_waits", float(waits))
        for name, values in losses.items():
            if values:
                self.logger.record(f"train/{name}", float(np.mean(values)))

    def _ent_coef(self) -> th.Tensor:
        if self.ent_coef_optimizer is None:
            return self.ent_coef_tensor
        assert self.log_ent_coef is not None
        return self.log_ent_coef.detach().exp()
