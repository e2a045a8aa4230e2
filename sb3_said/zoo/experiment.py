"""Our algorithms, delays and presets inside rl_zoo3's ``ExperimentManager``."""

from __future__ import annotations

import argparse
import re
import shutil
import zlib
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium as gym
from filelock import FileLock
from rl_zoo3 import exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecNormalize

from sb3_said import SAID
from sb3_said.delays.space import ages_of
from sb3_said.files.arguments import with_given
from sb3_said.files.checkpoint import CHECKPOINT_NAME
from sb3_said.files.normalization import load_normalization, normalization_file
from sb3_said.offline import OfflineAlgorithm
from sb3_said.offline.datasets import is_file
from sb3_said.zoo.algorithms import ALGORITHMS, NESTED
from sb3_said.zoo.arguments import Delay, ages_under, ending_training, largest_delay, reading_settings
from sb3_said.zoo.folder import claim_folder, find_agent, find_normalization, hold_folder
from sb3_said.zoo.presets import config_file, preset_overrides
from sb3_said.zoo.record import EVALUATED, GIVEN_NAME, Record, make_wrapper, options_of, with_delay
from sb3_said.zoo.stopping import Stopping, shield

LONGEST_NAME = 100  # of what a folder's name says of delays and logs; file systems allow 255

CONFIG_SUFFIXES = ".yml", ".yaml", ".py"  # rl_zoo3 takes anything else for a module
EXPECTED = ". Expected YAML of settings by task, or Python that has them as hyperparams."
VEC_WRAPPERS = "frame_stack", "vec_env_wrapper"  # of rl_zoo3; no command of ours could play their agents
for _name in ALGORITHMS:
    HYPERPARAMS_SAMPLER[_name] = HYPERPARAMS_SAMPLER["sac"]
    HYPERPARAMS_CONVERTER[_name] = HYPERPARAMS_CONVERTER["sac"]


@dataclass(frozen=True)
class Run:
    """What our command line adds to rl_zoo3's.

    :param delay: what the wrapper is given; None for no wrapper
    :param preset: see ``preset_overrides``
    :param checkpoint_freq: environment steps between checkpoints; by default time decides
    :param resume: folder of the run to continue
    :param expert_delay: delay that the expert learns under, ``delay`` by default; the planner always serves ``delay``
    :param record: of the run to continue
    :param dataset: logs to learn from instead of an environment: paths, and ids of Minari datasets
    """

    delay: Delay
    preset: str
    checkpoint_freq: int | None = None
    resume: Path | None = None
    expert_delay: Delay = None
    record: Record | None = None
    dataset: Sequence[str] = ()

    @property
    def name(self) -> str:
        """Its name in paths, e.g. ``-delay4``, ``-delayUniformDelay-0-8``, ``-delay0-8-expert0``, ``-medium-v0``."""
        parts = [("delay", self.delay), ("expert", self.expert_delay)]
        words = {name: "-".join(re.findall(r"[\w.]+", str(delay))) for name, delay in parts if delay is not None}
        logs = [Path(source).stem if is_file(source) else source.rpartition("/")[2] for source in self.dataset]
        plain = [re.sub(r"[^\w.-]+", "-", log) for log in logs]
        text = "".join(f"-{name}{text}" for name, text in words.items()) + "".join(f"-{log}" for log in plain)
        return text if len(text) <= LONGEST_NAME else f"{text[:LONGEST_NAME]}-{zlib.crc32(text.encode()):08x}"

    @property
    def max_delay(self) -> int:
        """Largest delay that planner or expert will meet."""
        return max(largest_delay(self.delay), largest_delay(self.expert_delay))


class DelayedExperiment(ExperimentManager):
    """What is run: settings, environments and folder, with delays and presets, anew or as a run began.

    :param run: what our command line adds
    :param args: rl_zoo3's parsed arguments; the parameters after it are those of rl_zoo3's manager
    :raises ValueError: for a run that another process trains, or that cannot go on
    """

    def __init__(self, run: Run, args: argparse.Namespace, algo: str, env_id: str, *zoo_args: Any, **zoo_kwargs: Any):
        zoo_kwargs["config"] = config = zoo_kwargs.get("config") or str(config_file(algo, bool(run.dataset)))
        if Path(config).suffix in CONFIG_SUFFIXES and not Path(config).is_file():
            raise ValueError(f"--conf-file names {config}, which is not there.")
        super().__init__(args, algo, env_id, *zoo_args, **zoo_kwargs)
        if issubclass(ALGORITHMS[algo][0], OfflineAlgorithm) and self.optimize_hyperparameters:
            raise ValueError(
                "-optimize scores an expert in its environment. It would train a planner in each trial for nothing; "
                "bc and dql learn from logs. Search the expert's settings with --algo stable -optimize, and the "
                "planner's with sb3-said tune on a trained run."
            )
        for option, number in (("n-eval-envs", self.n_eval_envs), ("eval-episodes", self.n_eval_episodes)):
            if number < 1:
                raise ValueError(f"--{option} must be at least 1, got {number}.")
        self.run = run
        self.stopping = Stopping()
        self._under_expert_delay = True  # whether create_envs makes the expert's environments
        self._has_told_of_no_delay = False
        self.lock: FileLock | None = None
        self._uuid = zoo_kwargs.get("uuid_str", "")
        self._given = given = self.custom_hyperparams or {}
        if run.resume is not None and run.record is not None:
            if self.optimize_hyperparameters:
                raise ValueError("-optimize searches anew, and goes on with no run: leave --resume out.")
            if (evaluates := run.record.options.get("eval_freq", 1) > 0) != (self.eval_freq > 0):
                raise ValueError(
                    f"--resume goes on as the run began, {'with' if evaluates else 'without'} evaluations: --eval-freq "
                    f"{self.eval_freq} does not; leave it out{' or give another above 0' * evaluates}."
                )
            run.record.require(*(set(run.record.missing) - {*given}))
            run.record.check_hyperparams()
            self.lock = hold_folder(run.resume)  # after all that can fail: without a manager nobody could release it
            self._set_folder(run.resume)
            self.custom_hyperparams = with_given(run.record.hyperparams, given, NESTED)
            given_env, self.env_kwargs = self.env_kwargs, {**run.record.env_kwargs, **self.env_kwargs}
            as_training = run.record.eval_env_kwargs == run.record.env_kwargs
            given_eval = self._eval_env_kwargs_args or (given_env if as_training else {})
            self.eval_env_kwargs = {**run.record.eval_env_kwargs, **given_eval}
        else:
            overrides = preset_overrides(self.config, run.preset, env_id, run.delay, run.max_delay, run.dataset)
            # A trial would play under the expert's delay, and tell nothing of the planner's
            if run.expert_delay is not None:
                overrides["planner_trial_episodes"] = 0
            self.custom_hyperparams = with_given({**overrides, **ALGORITHMS[algo][1]}, given, NESTED)

    def release(self) -> None:
        """Let other processes train in the run's folder."""
        if self.lock is not None:
            self.lock.release()

    def _set_folder(self, folder: Path) -> None:
        self.save_path, self.params_path = str(folder), f"{folder}/{self.env_name}"

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read hyper-parameters as rl_zoo3 does.

        The delay goes around the user's own wrappers, and text that is code is evaluated.
        """
        reading_config = partial(reading_settings, self.config, EXPECTED)
        if self.run.record is None:  # rl_zoo3 would replace dicts of settings whole, instead of merging them
            given, self.custom_hyperparams = self.custom_hyperparams or {}, None
            with redirect_stdout(StringIO()), reading_config():
                of_file, _ = super().read_hyperparameters()
            of_file = {name: of_file[name] for name in NESTED if name in of_file}
            self.custom_hyperparams = with_given(of_file, given, NESTED)
        with reading_config():
            hyperparams, saved = super().read_hyperparameters()
        if self.n_timesteps <= 0 and "n_timesteps" not in hyperparams:
            raise ValueError(f"{self.config} says no n_timesteps for {self.env_name.gym_id}: add it, or give -n.")
        hyperparams.setdefault("n_timesteps", self.n_timesteps)
        if self.run.record is not None:  # the run has all its settings; what only today's YAML holds is none of it
            for settings in (hyperparams, saved):
                for name in set(settings) - set(self.custom_hyperparams or {}):
                    del settings[name]
        with reading_settings():
            for name in EVALUATED:
                if isinstance(text := saved.get(name), str):
                    saved[name], hyperparams[name] = (eval(text, vars(exp_manager)) for _ in range(2))
        for settings in (hyperparams, saved):
            settings |= {name: number_of(value) for name, value in settings.items()}
        steps = hyperparams["n_timesteps"]
        if self.n_timesteps <= 0 and (not isinstance(steps, int | float) or steps < 1 or steps % 1):
            raise ValueError(f"n_timesteps must be a whole number, at least 1, got {steps!r}.")
        rate = hyperparams.get("learning_rate")
        if isinstance(rate, str) and isinstance(number_of(rate.removeprefix("lin_")), str):
            raise ValueError(f"learning_rate must be a number, or fall from one as lin_1e-3 does, got {rate!r}.")
        self._own_wrappers = saved.pop("env_wrapper", None)
        wrappers = with_delay(self._own_wrappers, self.run.delay, self.run.expert_delay)
        if wrappers:
            saved["env_wrapper"] = hyperparams["env_wrapper"] = wrappers
            print(f"Wrappers, from the task outwards: {wrappers}")
        return hyperparams, saved

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        """Preprocess hyper-parameters as rl_zoo3 does; evaluations get the YAML's ``env_kwargs``, too."""
        if refused := [name for name in VEC_WRAPPERS if hyperparams.get(name)]:
            raise ValueError(
                f"{', '.join(refused)} wraps all environments at once, and no command could play the agent: put "
                "gymnasium.wrappers.FrameStackObservation and FlattenObservation into env_wrapper, or yours."
            )
        if "gymnasium.wrappers.Normalize" in str(self._own_wrappers):
            raise ValueError(
                "gymnasium.wrappers.NormalizeObservation and NormalizeReward keep statistics that no file holds, and "
                "each evaluation has others: take -params \"normalize:dict(norm_obs_keys=['observation'])\"."
            )
        if "ParallelTrainCallback" in str(hyperparams.get("callback")):
            raise ValueError(
                "rl_zoo3's ParallelTrainCallback trains a copy of the agent, whose file it reads with pickle, and ours "
                "have none: leave it out."
            )
        with reading_settings():
            made = super()._preprocess_hyperparams(hyperparams)
        if self.n_envs < 1:
            raise ValueError(f"n_envs must be at least 1, got {self.n_envs}.")
        if self.n_envs > 1 and "episode" in str(frequency := made[0].get("train_freq")):
            raise ValueError(f"train_freq={frequency} counts episodes, which takes n_envs=1, got {self.n_envs}.")
        before = self.n_envs if self.run.record is None else self.run.record.hyperparams.get("n_envs", 1)
        if self.n_envs != before and not self.run.dataset:
            raise ValueError(f"--resume goes on with n_envs={before}, as the replay has them, got {self.n_envs}.")
        if self._eval_env_kwargs_args is None and self.run.record is None:
            self.eval_env_kwargs = self.env_kwargs
        return made

    def _preprocess_action_noise(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        with reading_settings():
            return super()._preprocess_action_noise(*args, **kwargs)

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Make the agent as rl_zoo3 does. Settings that do not fit end the program, and leave no new folder behind.

        :raises SystemExit: for settings that do not fit
        """
        is_new, made = self.lock is None, None
        try:
            with ending_training(ValueError, TypeError, AssertionError, ImportError, OSError, gym.error.Error):
                made = self._set_up()
                return made
        finally:
            if made is None and is_new and self.lock is not None:  # it failed, or was -optimize, which writes elsewhere
                self.release()
                shutil.rmtree(self.folder)

    def _set_up(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        if self.tensorboard_log:
            Path(self.tensorboard_log).mkdir(parents=True, exist_ok=True)
        made = super().setup_experiment()
        if made is not None and isinstance(made[0], SAID):
            has_its_own = self.run.expert_delay is not None  # the environments now have the expert's delay
            ages = ages_under(self.run.delay) if has_its_own else ages_of(made[0].env)
            made[0].policy.planner.check_ages(ages)
        return made

    def create_envs(self, *args: Any, **kwargs: Any) -> VecEnv:
        """Make environments under the expert's delay, for training and for the evaluations beside it.

        The run's settings on disk keep the delay that the agent is for. The trained agent is evaluated under that one.
        """
        if self.run.expert_delay is not None:
            delays = self.run.expert_delay, self.run.delay
            self.env_wrapper = make_wrapper(
                with_delay(self._own_wrappers, *(delays if self._under_expert_delay else delays[::-1]))
            )
        if self.vec_env_class is SubprocVecEnv:
            shield()  # Ctrl-C must not end them before the training ends
        env = super().create_envs(*args, **kwargs)
        if not self._has_told_of_no_delay and "action_history" not in getattr(env.observation_space, "spaces", {}):
            self._has_told_of_no_delay = True  # by the spaces: a task may be registered with its delay
            print(f"NO DELAY: this trains on {self.env_name.gym_id} without any delay; --delay 4 adds one of 4 steps.")
        return env

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """Normalise as rl_zoo3 does, but read the statistics of a given agent (-i) from a file without pickle."""
        given = find_normalization(*find_agent(Path(self.trained_agent))) if self.continue_training else None
        if given is not None:
            env = load_normalization(given, env, training=not eval_env)
            env.norm_reward = env.norm_reward and not eval_env
        elif self.normalize:
            held = {"norm_reward": False, "training": False} if eval_env else {}
            env = VecNormalize(env, **(self.normalize_kwargs | held))
        return env

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return Path(self.save_path)

    @property
    def checkpoint(self) -> Path:
        """File that a killed run goes on from."""
        return self.folder / CHECKPOINT_NAME

    def create_log_folder(self) -> None:
        if self.lock is None:
            name = f"{self.env_name}{self.run.name}-seed{self.seed}"
            self._set_folder(claim_folder(Path(self.log_path), name, self._uuid))
            self.lock = hold_folder(self.folder)
            if self.continue_training:
                given, own = Path(self.trained_agent), self.folder / GIVEN_NAME
                shutil.copyfile(given, own)
                if (found := find_normalization(*find_agent(given))) is not None:
                    shutil.copyfile(found, normalization_file(own))
        super().create_log_folder()
        self.monitor_kwargs["override_existing"] = not self.checkpoint.exists()

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        """Write the run's settings. In a resume the training does, once it knows that the checkpoint fits."""
        self._to_save = saved_hyperparams
        if self.run.record is None:
            self._write_config()

    def _write_config(self) -> None:
        super()._save_config(self._to_save)
        hyperparams = {**self._to_save, "env_wrapper": self._own_wrappers}
        hyperparams.pop("env_kwargs", None)
        Record(
            self.algo,
            self.env_name.gym_id,
            self.seed,
            self.run.delay,
            self.run.expert_delay,
            self.run.preset,
            self.run.checkpoint_freq,
            getattr(self.args, "gym_packages", []),
            self.env_kwargs,
            self.eval_env_kwargs,
            hyperparams,
            options_of(self.args),
            dataset=[*self.run.dataset],
        ).write(self.folder)


def number_of(setting: Any) -> Any:
    """Return the number that a text stands for, anything else as it is. YAML reads ``1e-3`` as text."""
    if not isinstance(setting, str):
        return setting
    try:
        number = float(setting)
    except ValueError:
        return setting
    return int(number) if number.is_integer() else number
