"""Soft actor-critic for delayed observations."""

from __future__ import annotations

import inspect
import io
import pathlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecMonitor,
    unwrap_vec_normalize,
    unwrap_vec_wrapper,
)

from sb3_said.delays.space import (
    WRAPPER_ORDER,
    ages_of,
    check_one_max_delay,
    check_spaces,
    has_attribute,
    holds_whole_numbers,
    written_ages,
)
from sb3_said.delays.wrapper import DelayedObservationWrapper
from sb3_said.files.agents import SafeSaveMixin
from sb3_said.files.archive import existing, load_tree, readable, save_tree, with_suffix
from sb3_said.files.checks import RANGES, check_argument, declared
from sb3_said.files.state import agent_state
from sb3_said.replay.buffer import DelayedReplayBuffer, rows_for_logs
from sb3_said.sac.policies import SERVED, DelayedSACPolicy, as_array

REPLAY = "replay buffer"  # kind of its file


class DelayedSAC(SafeSaveMixin, SAC):
    """SAC whose actor knows the actions sent since its observation, and whose critics know the true state (SADR).

    Two flags span the baselines of "Addressing Signal Delay in Deep RL" (Wang et al., ICLR 2024):

    ============= ============= =======================
    name          augment_state delay_reconciled_critic
    ============= ============= =======================
    SAC           False         False
    SA            True          False
    DR            False         True
    SADR          True          True
    ============= ============= =======================

    The critics' true states come from replay (they arrive a few steps later on a real system too); acting needs none.
    On a task without ``DelayedObservationWrapper`` this is SB3's SAC, update for update.

    :param policy: ``"MultiInputPolicy"`` or ``"MlpPolicy"``, which name the same class
    :param env: a task in a ``DelayedObservationWrapper``, or one with a 1-D Box observation (delay 0)
    :param learning_rate: of actor, critics and entropy coefficient; a number or a schedule
    :param learning_starts: environment steps of random actions before the first update; the default is that of rl_zoo3
        and Wang et al. for MuJoCo, SB3's is 100
    :param augment_state: the actor reads [observation, action history, age]
    :param delay_reconciled_critic: the critics read the true state
    :param relabelled_ages: part of an update's transitions, in [0, 1], that are shown at the age of another one. So
        where delays vary, each step teaches the actor what to do under other delays, too. Measured at delays 0..16
        (results/any_delay_halfcheetah.md); 0 is SADR as published. Under one fixed delay nothing changes
    :param sac_kwargs: every other argument of :class:`stable_baselines3.SAC`
    :raises ValueError: for other spaces, a ``VecNormalize`` of more than the observation, numbers out of range, or
        options that need another replay buffer (``n_steps`` > 1) or policy
    :raises TypeError: for an unknown argument
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": DelayedSACPolicy,
        "MultiInputPolicy": DelayedSACPolicy,
    }
    counters = (*SafeSaveMixin.counters, "trained_ages")
    own_classes = (DelayedReplayBuffer,)
    learns_from_logs: ClassVar[bool] = False
    action_space: spaces.Box
    policy: DelayedSACPolicy
    replay_buffer: DelayedReplayBuffer
    _left_at: list[tuple[int, int]] | None = None  # what Monitors of a task without delay had counted after learn()

    def __init__(
        self,
        policy: str | type[DelayedSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        learning_starts: int = 10_000,
        augment_state: bool = True,
        delay_reconciled_critic: bool = True,
        relabelled_ages: float = 0.5,
        **sac_kwargs: Any,
    ):
        self._refuse_unknown(sac_kwargs, set(inspect.signature(SAC).parameters))
        if sac_kwargs.get("n_steps", 1) != 1:
            raise ValueError(
                f"DelayedSAC learns from one-step targets, got n_steps={sac_kwargs['n_steps']}; leave it 1."
            )
        self.trained_ages: list[int] | None = None  # amid episodes, in the latest call of learn()
        self.augment_state = augment_state
        self.delay_reconciled_critic = delay_reconciled_critic
        self.relabelled_ages = relabelled_ages
        if isinstance(policy, str):  # SB3 takes one name for Box spaces and the other for Dict
            if policy not in self.policy_aliases:
                raise ValueError(
                    f"{type(self).__name__} has the policies {', '.join(self.policy_aliases)}, got {policy!r}: it "
                    "reads a vector, as gymnasium.wrappers.FlattenObservation makes of an image."
                )
            policy = self.policy_aliases[policy]  # type: ignore[assignment]  # a subclass names its own
        super().__init__(policy, env, learning_rate, learning_starts=learning_starts, **sac_kwargs)

    def _setup_model(self) -> None:
        name, policy_class = type(self).__name__, self.policy_aliases["MlpPolicy"]
        if not issubclass(self.policy_class, policy_class):
            raise ValueError(
                f"{name} needs a {policy_class.__name__}, got {self.policy_class.__name__}: give 'MlpPolicy', or load "
                "a file with the class that saved it."
            )
        self.replay_buffer_class = self.replay_buffer_class or DelayedReplayBuffer
        if not issubclass(self.replay_buffer_class, DelayedReplayBuffer):
            raise ValueError(
                f"{name} learns from a DelayedReplayBuffer, got {self.replay_buffer_class.__name__}; "
                "leave replay_buffer_class out."
            )
        for setting in [name for name in RANGES if hasattr(self, name)]:
            value = getattr(self, setting)
            check_argument(setting, value, type(self))
            hint = declared(setting, type(self))
            if isinstance(value, float) and int in (hint, *get_args(hint)) and float not in get_args(hint):
                setattr(self, setting, int(value))  # such as 1e6
        own, given = {*self._policy_flags(), "relabelled_ages"}, {*self.policy_kwargs, *self.replay_buffer_kwargs}
        if twice := sorted(own & given):
            raise ValueError(f"Give {', '.join(twice)} to {name} itself, not in policy_kwargs or replay_buffer_kwargs.")
        if unserved := sorted({*SERVED} & {*self.policy_kwargs}):
            raise ValueError(
                f"{name} does not serve {', '.join(unserved)} of policy_kwargs; leave it out, or take StableSAC."
            )
        if self.env is not None:
            self._check_env(self.env)
        if self.replay_buffer is None:
            self.replay_buffer = self._new_replay_buffer()
        users, self.policy_kwargs = self.policy_kwargs, {**self.policy_kwargs, **self._policy_flags()}
        super()._setup_model()
        self.policy_kwargs = users
        self._note_task()

    def _note_task(self) -> None:
        """Remember what files name: the task's id, and whether its observations are normalised.

        Environments without delay in other processes do not tell the id; whoever makes them may set ``task``.
        """
        self.reads_normalized = self._vec_normalize_env is not None and self._vec_normalize_env.norm_obs
        env = None if self.env is None else self.env.unwrapped
        if isinstance(env, DummyVecEnv) and env.envs[0].spec is not None:
            self.task = env.envs[0].spec.id
        elif env is not None and has_attribute(env, "task_id"):
            found = env.get_attr("task_id", 0)[0]  # our wrapper's; a task's own may mean something else
            self.task = found if isinstance(found, str) else self.task

    def _check_env(self, env: VecEnv) -> None:
        """:raises ValueError: for spaces that are not served, and for faults of an environment that no space shows"""
        check_spaces(env.observation_space, env.action_space)
        if isinstance(env.observation_space, spaces.Box) and any(_are_wrapped(env, DelayedObservationWrapper)):
            raise ValueError(
                "A wrapper around DelayedObservationWrapper made one array of its observation, in which an agent finds "
                f"neither age nor actions: {env.observation_space}. {WRAPPER_ORDER}"
            )
        check_one_max_delay(env)
        vec_normalize = unwrap_vec_normalize(env)
        keys = [] if vec_normalize is None or not vec_normalize.norm_obs else vec_normalize.norm_obs_keys or []
        if not set(keys) <= {"observation"}:
            raise ValueError(
                f"VecNormalize must leave actions and ages as they are, but normalises {', '.join(sorted(keys))}; "
                "use VecNormalize(..., norm_obs_keys=['observation'])."
            )

    def _adapt_saved(self, saved: dict[str, Any], changed: set[str]) -> dict[str, Any]:
        """Leave the file's entropy coefficient out where the caller has given another."""
        if "ent_coef" not in changed:
            return saved
        own, optimizer = agent_state(self), "ent_coef_optimizer"
        parameters = {name: part for name, part in saved["parameters"].items() if name != optimizer}
        parameters |= {optimizer: own["parameters"][optimizer]} if optimizer in own["parameters"] else {}
        return {**saved, "parameters": parameters, "variables": own["variables"]}

    def _policy_flags(self) -> dict[str, Any]:
        """Return what the policy's constructor needs of this algorithm's own arguments."""
        return {"augment_state": self.augment_state, "delay_reconciled_critic": self.delay_reconciled_critic}

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "SAC",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        obs = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        # Begin anew if the replay was emptied or not loaded with the agent, or if somebody has played the environments
        if obs is not None and not (self.replay_buffer.knows_past(obs).all() and self._are_at(obs)):
            self._last_obs = None  # SB3 then resets the environments
        if (reset_num_timesteps or self._last_obs is None) and self.env is not None:
            for monitor in self._strict_monitors():
                monitor.needs_reset = True
        self._note_task()
        name = type(self).__name__ if tb_log_name == "SAC" else tb_log_name  # SB3's default would name all algorithms
        learn = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, name, progress_bar)
        self.trained_ages = ages_of(self.env)
        return learn

    def _are_at(self, obs: np.ndarray | dict[str, np.ndarray]) -> bool:
        """Tell whether the environments handed out these observations last, and nobody has played them since."""
        assert self.env is not None
        if not isinstance(obs, dict) or not has_attribute(self.env, "handed_out"):
            return self._left_at is not None and self._left_at == self._steps_counted()
        last = self.env.get_attr("handed_out")
        return all(np.array_equal(obs[key][i], part) for i, parts in enumerate(last) for key, part in parts.items())

    def _steps_counted(self) -> list[tuple[int, int]] | None:
        """Return the steps that SB3's ``Monitor`` has counted in each environment, in all and in this episode.

        None without Monitors, and if no episode has a step yet: a Monitor does not tell one reset from another.
        """
        assert self.env is not None
        if not all(_are_wrapped(self.env, Monitor)):
            return None
        in_episode = [len(rewards) for rewards in self.env.get_attr("rewards")]
        return [*zip(self.env.get_attr("total_steps"), in_episode, strict=True)] if any(in_episode) else None

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """Collect as SB3 does, and start new episodes in the next ``learn`` if this was broken off.

        SB3 does not store the step at which a callback or an exception ends training, so the last observation is gone.
        """
        rollout = None
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            return rollout
        finally:
            if rollout is None or not rollout.continue_training:
                self._last_obs = None
            elif self.num_timesteps >= self._total_timesteps and not isinstance(self.observation_space, spaces.Dict):
                self._left_at = self._steps_counted()  # after the last rollout of this call

    def _sample_action(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, np.ndarray]:
        if self._last_obs is None:  # a callback has played the environment, as a trial does
            assert self.env is not None
            self._last_obs = self.env.reset()  # type: ignore[assignment]  # as SB3 does where learning begins
            self._last_episode_starts = np.ones((self.env.num_envs,), dtype=bool)
            if self._vec_normalize_env is not None:
                self._last_original_obs = self._vec_normalize_env.get_original_obs()
        action, scaled = super()._sample_action(*args, **kwargs)
        is_whole = holds_whole_numbers(self.action_space)  # then the rounded action is stored, as it was sent
        return action, self.policy.scale_action(action) if is_whole else scaled

    def _store_transition(self, *args: Any, **kwargs: Any) -> None:
        if self._last_obs is not None:  # else a callback has played at this step, and its observation is gone
            super()._store_transition(*args, **kwargs)

    def _monitors(self) -> list[Monitor | VecMonitor]:
        """Return SB3's monitors in this process."""
        assert self.env is not None
        envs = getattr(self.env.unwrapped, "envs", [])
        found = [unwrap_vec_wrapper(self.env, VecMonitor), *(unwrap_wrapper(env, Monitor) for env in envs)]
        return [monitor for monitor in found if isinstance(monitor, (Monitor, VecMonitor))]

    def _strict_monitors(self) -> list[Monitor]:
        """Return the monitors that refuse a reset amid an episode unless ``needs_reset`` is set."""
        return [x for x in self._monitors() if isinstance(x, Monitor) and not x.allow_early_resets]

    @contextmanager
    def borrowed_env(self) -> Iterator[VecEnv]:
        """Hand out the training environment for steps that teach nothing.

        ``VecNormalize`` keeps its statistics and does not scale rewards. Files of SB3's ``Monitor`` get no rows of
        these steps, except those of environments in other processes. If learning goes on, it starts a new episode.
        """
        assert self.env is not None
        monitors, strict = self._monitors(), self._strict_monitors()
        writers = [monitor.results_writer for monitor in monitors]
        normalizer = self._vec_normalize_env
        before = None if normalizer is None else (normalizer.training, normalizer.norm_reward)
        if normalizer is not None:
            normalizer.training = normalizer.norm_reward = False
        for monitor in monitors:
            monitor.results_writer = None
        for monitor in strict:
            monitor.allow_early_resets = True
        try:
            yield self.env
        finally:
            for monitor, writer in zip(monitors, writers, strict=True):
                monitor.results_writer = writer
            for monitor in strict:
                monitor.needs_reset, monitor.allow_early_resets = True, False
            self._last_obs = None  # SB3 then resets the environments
            if normalizer is not None and before is not None:
                normalizer.training, normalizer.norm_reward = before

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Take another environment, as SB3 does; see :meth:`check_ages` for one with another delay.

        :raises ValueError: for other spaces, another ``max_delay`` or a ``VecNormalize`` of more than the observation
        """
        env = self._wrap_env(env, self.verbose)
        self._check_env(env)
        is_delayed = isinstance(self.observation_space, spaces.Dict)
        if is_delayed != isinstance(env.observation_space, spaces.Dict):
            remedy = f"give it DelayedObservationWrapper(..., max_delay={self.policy.max_delay})"
            raise ValueError(
                f"This {type(self).__name__} was built for a task {'in' if is_delayed else 'without'} a "
                f"DelayedObservationWrapper, got {env.observation_space}; {remedy if is_delayed else 'leave it out'}."
            )
        own, given = self.policy.max_delay, check_spaces(env.observation_space, env.action_space).max_delay
        if own != given:
            raise ValueError(
                f"This {type(self).__name__} was built for max_delay={own}, but this environment has max_delay={given};"
                f" where its delays allow, give it DelayedObservationWrapper(..., max_delay={own})."
            )
        self.check_ages(ages_of(env))
        learned_normalized = self.reads_normalized
        super().set_env(env, force_reset)
        self._note_task()
        if self.trained_ages is not None and learned_normalized != self.reads_normalized:
            self.reads_normalized = learned_normalized  # until it learns here
            told = "as they are, and VecNormalize normalises those of this environment: leave it out."
            if learned_normalized:
                told = (
                    "that VecNormalize had normalised, and those of this environment are not: give it "
                    "load_normalization(path, venv), or SB3's VecNormalize.load."
                )
            warnings.warn(f"This {type(self).__name__} learned from observations {told}", stacklevel=3)

    def check_ages(self, ages: list[int]) -> None:
        """Warn if an agent is to act, amid episodes, on observations of ages that it has not met in training.

        This is no error, since training can go on at these ages, but nothing was learned there yet.

        :param ages: that it will meet, in control steps (see :func:`ages_of`)
        """
        acts_at = self._acts_at(ages)
        if self.trained_ages is not None and (unmet := sorted(set(acts_at) - set(self.trained_ages))):
            warnings.warn(
                f"This {type(self).__name__} learned at ages {written_ages(self.trained_ages)} and is given "
                f"{written_ages(unmet)}: what it does at ages it has not met is undefined. Train it on a range, such "
                "as delay=(0, 8), or give it the delay it knows.",
                stacklevel=3,
            )

    def _acts_at(self, ages: list[int]) -> list[int]:
        """Return the ages that the actor meets if the agent meets these."""
        return ages

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Answer as SB3 does, and warn like :meth:`check_ages` where observations amid an episode have unmet ages."""
        answer = super().predict(observation, state, episode_start, deterministic)
        if isinstance(observation, dict) and self.trained_ages is not None:
            ages = np.ravel(as_array(observation["delay"]))  # (B,)
            if not set(ages.tolist()) <= set(self.trained_ages):
                # A full history only: before, the age may be small just because the episode has begun.
                history = as_array(observation["action_history"]).reshape(len(ages), self.policy.max_delay, -1)
                self.check_ages(sorted({int(age) for age in ages[history[:, 0].any(1)]}))
        return answer

    def _new_replay_buffer(self, size: int | None = None, n_envs: int | None = None) -> DelayedReplayBuffer:
        """Return an empty replay of this agent's environments.

        :param size: rows, ``buffer_size`` by default
        """
        made: Any = self.replay_buffer_class  # as _setup_model saw to
        return made(
            self.buffer_size if size is None else size,
            self.observation_space,
            self.action_space,
            self.device,
            self.n_envs if n_envs is None else n_envs,
            self.optimize_memory_usage,
            relabelled_ages=self.relabelled_ages,
            **self.replay_buffer_kwargs,
        )

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Write the replay buffer to a file without pickle.

        :param path: of the file, to which ``.pkl`` is added where it has no suffix, or a binary file object
        :raises ValueError: where the agent has no replay buffer any more
        """
        if self.replay_buffer is None:
            raise ValueError("This agent's replay_buffer is None: save the replay before it is taken away.")
        file = with_suffix(path, ".pkl")  # type: ignore[arg-type]  # io.BufferedIOBase is IO, as in loading
        save_tree(file, self.replay_buffer.state_dict(), kind=REPLAY)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Read what ``save_replay_buffer`` wrote into this agent's buffer, running no code from the file.

        :param path: of the file, with or without the ``.pkl`` that SB3's callbacks give it, or a binary file object
        :param truncate_last_traj: of SB3's ``HerReplayBuffer``, without effect here
        :raises SavedFileError: when the file is no replay, is damaged or forged, or was made with another task,
            ``buffer_size`` or ``n_envs``, or of logs that this algorithm does not learn from
        """
        found = existing(path, ".pkl")  # type: ignore[arg-type]  # io.BufferedIOBase is IO
        state = load_tree(found, REPLAY)
        replay = self.replay_buffer
        with readable(found, explained=(ValueError,)):
            if state["holds_logs"] is True:  # in a buffer of their own length
                if not self.learns_from_logs:
                    raise ValueError(
                        f"It holds logs, from which {type(self).__name__} does not learn; SAID, BC and DQL do"
                    )
                replay = self._new_replay_buffer(rows_for_logs(len(state["rewards"]), self.policy.max_delay), n_envs=1)
            elif replay is None or replay.holds_logs:  # a buffer of logs is only as long as its logs
                replay = self._new_replay_buffer()
            replay.load_state_dict(state)
        self.replay_buffer, replay.device = replay, self.device


def _are_wrapped(env: VecEnv, wrapper: type[gym.Wrapper[Any, Any, Any, Any]]) -> list[bool]:
    """Tell which environments have a wrapper; False for a simulator that is not Gymnasium's and cannot be asked."""
    try:
        return env.env_is_wrapped(wrapper)
    except (NotImplementedError, AttributeError):
        return [False] * env.num_envs
