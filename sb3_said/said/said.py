"""SAID: a delay-aware expert collects, a diffusion planner trained on its replay answers."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import unwrap_vec_normalize
from tqdm.auto import tqdm

from sb3_said.delays.space import ages_of, has_state_history
from sb3_said.files.archive import load_tree, readable, save_tree
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.planner.trainer import PlannerTrainer, worse_than_regression
from sb3_said.planner.values import returns_to_go
from sb3_said.sac import DelayedSAC
from sb3_said.said.callbacks import PlannerTrainingCallback
from sb3_said.said.policies import Answer, SAIDPolicy
from sb3_said.said.trial import let_the_better_answer

HELD_OUT = 0.05  # of the planner's data
PLANNER_CHECKPOINT_NAME = "planner_checkpoint.zip"

SelfSAID = TypeVar("SelfSAID", bound="SAID")


class SAID(DelayedSAC):
    """State-Action Inpainting Diffuser, online (paper, Algorithm 1).

    ``learn`` runs the expert (SADR), then trains a diffusion transformer on windows of its replay buffer. ``predict``
    asks the expert until the planner is trained, and then whoever of the two does better in a few episodes. The planner
    inpaints what the delay hides and the plan behind it; at a temperature above 0 many times, and the critics choose.
    Collection always uses the expert.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of the expert
    :param planner_kwargs: fields of :class:`~sb3_said.planner.PlannerConfig`; the attribute has all of them
    :param planner_gradient_steps: updates of one planner training; the paper makes 1,000,000
    :param planner_train_freq: also train the planner every so many environment steps; the paper only at the end (None)
    :param planner_newest_fraction: train on the newest part of the buffer only. The paper takes all of it (Algorithm 1)
        and finds the newest 20 % as good; here they are better, where policies change fast
    :param planner_terminal_penalty: replaces the reward of a terminating step in the values that weigh windows. The
        paper's Table 3 has -100, for tasks that end by falling, and the presets of such tasks have it too; None keeps
        the reward, for tasks that may end because they are done
    :param planner_trial_episodes: of the training environment, played with the planner after its training and as many
        with the expert; the better one answers. They come on top of ``learn``'s steps. 0: the planner answers
    :param sac_kwargs: every other argument of :class:`~sb3_said.sac.DelayedSAC` and of SB3's ``SAC``
    :raises ValueError: as ``DelayedSAC`` does, for planner settings outside their range, and for a ``state_history``
        in the observations that the planner is not trained to read or that ``VecNormalize`` leaves unscaled
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": SAIDPolicy, "MultiInputPolicy": SAIDPolicy}
    counters = (*DelayedSAC.counters, "_planner_trained_at")
    policy: SAIDPolicy

    def __init__(
        self,
        policy: str | type[SAIDPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        planner_kwargs: dict[str, Any] | None = None,
        planner_gradient_steps: int = 25_000,
        planner_train_freq: int | None = None,
        planner_newest_fraction: float = 0.2,
        planner_terminal_penalty: float | None = None,
        planner_trial_episodes: int = 5,
        **sac_kwargs: Any,
    ):
        for name, value in (("gradient_steps", planner_gradient_steps), ("train_freq", planner_train_freq)):
            if value is not None and value < 1:
                raise ValueError(f"planner_{name} must be at least 1, got {value}.")
        if not 0.0 < planner_newest_fraction <= 1.0:
            raise ValueError(
                f"planner_newest_fraction is a part of the buffer in (0, 1], got {planner_newest_fraction}."
            )
        if planner_trial_episodes < 0:
            raise ValueError(f"planner_trial_episodes must be 0 or more, got {planner_trial_episodes}.")
        self._given_planner_kwargs = planner_kwargs or {}
        self.planner_gradient_steps = planner_gradient_steps
        self.planner_train_freq = planner_train_freq
        self.planner_newest_fraction = planner_newest_fraction
        self.planner_terminal_penalty = planner_terminal_penalty
        self.planner_trial_episodes = planner_trial_episodes
        self._planner_trained_at = 0  # num_timesteps of the last planner training
        super().__init__(policy, env, learning_rate, **sac_kwargs)

    @property
    def planner_kwargs(self) -> dict[str, Any]:
        """Every setting of the planner, which keeps them: see :meth:`set_planner`."""
        policy = getattr(self, "policy", None)
        return self._given_planner_kwargs if policy is None else policy.planner.config.to_dict()

    def _check_env(self, env: GymEnv) -> None:
        super()._check_env(env)
        vec_normalize = unwrap_vec_normalize(env)  # type: ignore[arg-type]  # None for one that is no VecEnv
        if has_state_history(env.observation_space) and vec_normalize is not None and vec_normalize.norm_obs:
            raise ValueError(
                "VecNormalize scales the observation and not the state_history, which must have the same units; use "
                "VecNormalize(..., norm_obs=False), or leave state_history=False in DelayedObservationWrapper."
            )

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.trained_ages is None and self.env is not None:  # else it was loaded, and check_ages says it
            try:
                self.policy.planner.check_ages(ages_of(self.env))
            except ValueError as error:  # no error yet: the expert may learn under another delay
                warnings.warn(str(error), stacklevel=3)

    def _policy_flags(self) -> dict[str, Any]:
        return {**super()._policy_flags(), "planner_kwargs": self.planner_kwargs}

    def _adapt_parameters(self, params: dict[str, Any]) -> dict[str, Any]:
        """Keep this agent's own planner where the given one was never trained and has other settings."""
        given, own = params.get("policy", {}), self.policy.state_dict()
        shapes = [
            {name: value.shape for name, value in state.items() if name.startswith("planner.")}
            for state in (given, own)
        ]
        if given.get("planner_updates") == 0 and shapes[0] != shapes[1]:
            kept = {name: value for name, value in given.items() if not name.startswith("planner.")}
            params = {**params, "policy": kept | {name: own[name] for name in shapes[1]}}
        return params

    def learn(
        self: SelfSAID,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SAID",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSAID:
        """Run the expert for ``total_timesteps``, then train the planner on what it stored.

        A :class:`PlannerTrainingCallback` among the callbacks trains the planner, and otherwise one that is added. The
        expert answers all callbacks, such as ``EvalCallback``, also when the planner has been trained before.
        """
        if not isinstance(callback, (BaseCallback, list, tuple)):
            callback = [] if callback is None else ConvertCallback(callback)
        callbacks = list(callback) if isinstance(callback, (list, tuple)) else [callback]
        callbacks.append(PlannerTrainingCallback(progress_bar=progress_bar))  # after the user's it has nothing to do
        with self.policy.answering("expert"):
            return super().learn(
                total_timesteps,
                callbacks,
                log_interval,  # type: ignore[arg-type]  # SB3 takes None and says so in its docstring
                tb_log_name,
                reset_num_timesteps,
                progress_bar,
            )

    def set_planner(self, **settings: Any) -> None:
        """Change how the planner answers, also after training or loading; ``save`` keeps the change.

        ``model.set_planner(temperature=0.3, n_candidates=50)``

        :param settings: ``sampling_steps``, ``n_candidates``, ``temperature``, ``scored_states`` or ``choice_factor``
            of :class:`~sb3_said.planner.PlannerConfig`
        :raises ValueError: for other settings, which the weights depend on, and for values outside their range
        """
        if others := sorted(set(settings) - set(SAMPLING_SETTINGS)):
            raise ValueError(
                f"Only {', '.join(SAMPLING_SETTINGS)} can be changed, got {', '.join(others)}; "
                "give it as planner_kwargs of a new agent."
            )
        self.policy.planner.config = replace(self.policy.planner.config, **settings)

    def set_answer(self, who: Answer) -> None:
        """Let the planner or the expert answer ``predict`` from now on: see :meth:`SAIDPolicy.set_answer`."""
        self.policy.set_answer(who)

    def check_ages(self, ages: list[int]) -> None:
        """Refuse ages that the planner cannot plan at, where it answers; warn as ``DelayedSAC`` where the expert does.

        :param ages: that it will meet amid episodes, in control steps
        :raises ValueError: as :meth:`InpaintingPlanner.check_ages`
        """
        if self.policy.who_answers == "planner":  # its masks were drawn from all of 0..D, so it has met every age
            self.policy.planner.check_ages(ages)
        else:
            super().check_ages(ages)

    def warmup(self, batch_size: int = 1) -> None:
        """Run a few dummy predictions: see :meth:`SAIDPolicy.warmup`. A control loop calls it once before it starts.

        :param batch_size: observations of a later ``predict``
        """
        self.policy.warmup(batch_size)

    def make_planner_trainer(self, gradient_steps: int | None = None) -> PlannerTrainer:
        """Return a trainer of this agent's planner on its replay buffer.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :raises ValueError: when the buffer is empty, as it is after ``load``
        """
        source = self.replay_buffer.window_source(self.planner_newest_fraction, self._vec_normalize_env)
        values = returns_to_go(source, self.gamma, self.planner_terminal_penalty, self._stored_values)
        return PlannerTrainer(
            self.policy.planner,
            replace(source, values=values),
            self.planner_gradient_steps if gradient_steps is None else gradient_steps,
            held_out=HELD_OUT if len(source) > 1 else 0.0,
            seed=self.seed or 0,
        )

    @th.no_grad()
    def _stored_values(self, states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return values as the environment's rewards would sum up, of states as windows have them: (B,)."""
        self.critic.set_training_mode(False)  # until the next update; batch norm must not learn from this
        values = self.policy.value(states.to(self.device), actions.to(self.device)).cpu()
        env = self._vec_normalize_env
        return values if env is None else th.from_numpy(env.unnormalize_reward(values.numpy()))

    def train_planner(
        self,
        gradient_steps: int | None = None,
        folder: str | Path | None = None,
        progress_bar: bool = False,
        log_interval: int = 500,
        eval_interval: int = 2_000,
        save_interval: int = 1_000,
        trial_episodes: int | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> None:
        """Train the planner anew on the replay buffer, without running the expert; then see who answers better.

        Interrupting (Ctrl-C) ends the training early and keeps the planner as far as it got. Until the training ends,
        and where it fails, the planner answers as before. Without ``verbose`` and a bar, one line says that it begins.

        A row of the log is written at ``num_timesteps`` plus the updates made; with ``planner_train_freq`` at
        ``num_timesteps`` alone, since the expert's rows go on from there.

        :param gradient_steps: ``planner_gradient_steps`` by default
        :param folder: keep a checkpoint there, and continue from it if it is of the same training
        :param progress_bar: show one
        :param log_interval: updates between two rows of losses in the log
        :param eval_interval: updates between two measurements of the held-out errors, beside the regression's
        :param save_interval: updates between two checkpoints
        :param trial_episodes: ``planner_trial_episodes`` by default; none are played where there is no environment
        :param should_stop: asked after every update; where it says so, a checkpoint is written and the training ends
        :raises KeyboardInterrupt: when ``should_stop`` has ended the training
        :raises ValueError: when the buffer is empty, or the checkpoint is of a training with other settings
        :raises FloatingPointError: when an update was not finite
        """
        if not hasattr(self, "_logger"):  # not set_logger: learn() makes its own
            self._logger = configure_logger(self.verbose, self.tensorboard_log, "SAID", reset_num_timesteps=False)
        trainer = self.make_planner_trainer(gradient_steps)
        total = trainer.gradient_steps
        checkpoint = None if folder is None else Path(folder) / PLANNER_CHECKPOINT_NAME
        replay = self.replay_buffer.actions[: self.replay_buffer.size()]
        data = {"num_timesteps": self.num_timesteps, "replay": zlib.crc32(replay.data)}
        if checkpoint is not None and checkpoint.exists():
            state = load_tree(checkpoint)
            with readable(checkpoint, explained=(ValueError,)):
                if {key: state[key] for key in data} == data:
                    trainer.load_state_dict(state["trainer"])

        def on_update(trainer: PlannerTrainer) -> bool:
            bar.update()
            done = trainer.n_updates
            is_end = done == total
            if done % log_interval == 0 or is_end:
                losses = trainer.pop_losses()
                bar.set_postfix(loss=losses["planner/loss"])
                errors = trainer.evaluate() if done % eval_interval == 0 or is_end else {}
                self._log_planner({**losses, **errors, "planner/n_updates": done}, done)
                if is_end and (worse := worse_than_regression(errors)):
                    warnings.warn(
                        f"On held-out windows the planner is still worse than a small regression: {worse}. It is "
                        "undertrained; give it more planner_gradient_steps, or more data.",
                        stacklevel=4,
                    )
            is_stopped = should_stop is not None and should_stop()
            if checkpoint is not None and (done % save_interval == 0 or is_end or is_stopped):
                _save_or_warn(checkpoint, {**data, "trainer": trainer.state_dict()})
            return not is_stopped

        if trainer.n_updates < total and not progress_bar and self.verbose == 0:
            print(
                f"Training the planner: {total} updates. progress_bar=True or verbose=1 shows how far it is.",
                flush=True,
            )
        with tqdm(total=total, initial=trainer.n_updates, desc="planner", disable=not progress_bar) as bar:
            is_done = True
            try:
                is_done = trainer.train(callback=on_update)
            except KeyboardInterrupt:
                trainer.hand_over()
                outcome = "keeps what it learned" if trainer.n_updates > 0 else "stays as it was"
                print(f"Planner training interrupted after {trainer.n_updates} of {total} updates; it {outcome}.")
                trial_episodes = 0
        if trainer.n_updates > 0:
            self._settle_answer(trainer.n_updates, trial_episodes if is_done else 0, progress_bar)
        if not is_done:
            raise KeyboardInterrupt
        self._planner_trained_at = self.num_timesteps

    def _settle_answer(self, n_updates: int, n_episodes: int | None, progress_bar: bool) -> None:
        """Let the newly trained planner answer, or whoever is better in a trial."""
        self.policy.planner_updates.fill_(float(n_updates))
        n_episodes = self.planner_trial_episodes if n_episodes is None else n_episodes
        self.set_answer("planner")
        if n_episodes > 0 and self.env is not None:
            returns = let_the_better_answer(self, n_episodes, progress_bar)
            self._log_planner(returns, n_updates)

    def _log_planner(self, values: dict[str, float], n_updates: int) -> None:
        """Write a row with a logger of its own, to the same places: the user's keeps what it holds for its next row."""
        log = Logger(self.logger.dir, self.logger.output_formats)
        log.set_level(self.logger.level)
        for key, value in values.items():
            log.record(key, value)
        log.dump(self.num_timesteps + (n_updates if self.planner_train_freq is None else 0))


def _save_or_warn(checkpoint: Path, tree: dict[str, Any]) -> None:
    """Write a checkpoint of the planner; a full disk is no reason to lose the planner itself."""
    try:
        save_tree(checkpoint, tree)
    except OSError as error:
        warnings.warn(
            f"The planner's checkpoint could not be written to {checkpoint} ({error}). Training goes on, and the agent "
            "keeps its planner; make room, so that it can be saved.",
            stacklevel=5,
        )
