"""Open a trained agent and its task again, from an rl_zoo3 log folder or a single file."""

from __future__ import annotations

import json
import os
import platform
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.backends.cpu import get_cpu_capability

from sb3_said import SAID, DelayedSAC, __version__
from sb3_said.delays import DelayedObservationWrapper, DelayProcess, FixedDelay
from sb3_said.delays.space import ages_of, has_state_history
from sb3_said.delays.text import make_process
from sb3_said.evaluation.rollout import Observation, Rollout, rollout
from sb3_said.files.agents import task_of
from sb3_said.files.archive import SavedFileError, load_metadata
from sb3_said.files.normalization import load_normalization, normalization_file
from sb3_said.said.policies import Answer
from sb3_said.zoo.algorithms import ALGORITHMS
from sb3_said.zoo.arguments import Delay, largest_delay
from sb3_said.zoo.folder import find_agent, find_normalization, resuming
from sb3_said.zoo.record import ENDED_NAME, WRAPPER, Record, entry_of, import_packages, is_delay_wrapper, make_wrapper

ANSWERS = get_args(Answer)
DELAYS = {"delay", "max_delay", "state_history"}  # of our wrapper: what an agent plays under, and what it reads


@dataclass(frozen=True)
class LoadedRun:
    """A trained agent, ready to play."""

    model: BaseAlgorithm
    make_env: Callable[[], gym.Env[Any, Any]]
    """makes the task as it was trained on, delay included"""
    normalize: Callable[[Observation], Observation] | None
    """VecNormalize's frozen normalisation of batched observations, where training used it"""
    folder: Path
    """of the run, for results"""
    info: dict[str, Any]
    """what was loaded, in JSON types: algo, env, delay, file, trained_steps"""
    changes: dict[str, Any] = field(default_factory=dict)
    """what its run changes in the task besides the observation delay: other arguments of our wrapper, those of other
    wrappers by the wrapper's name, and ``env_kwargs`` of ``gymnasium.make``"""
    statistics: Path | None = None
    """file of the statistics that ``normalize`` uses"""
    own_delay: DelayProcess | None = None
    """the delay that the task is registered with; it can be played under no other"""

    @property
    def setting(self) -> str:
        """``changes`` as text."""
        return json.dumps(self.changes, sort_keys=True, default=repr)

    @property
    def scored_task(self) -> str:
        """The task whose D4RL reference returns apply; empty where the run changes the task."""
        return "" if self.changes else str(self.info["env"])

    def play(
        self,
        n_episodes: int,
        seed: int,
        n_envs: int = 1,
        age_error: int = 0,
        answer: str | None = None,
        **kwargs: Any,
    ) -> Rollout:
        """Play whole episodes, see :func:`~sb3_said.evaluation.rollout`.

        :param age_error: control steps by which the age is told wrong, within the ages that the agent was built for
        :param answer: who answers, see :func:`answering`; decides for the ``n_envs`` episodes at once
        :raises ValueError: for an ``age_error`` where the agent is told no age, and for an answer that it does not have
        """
        if age_error and longest_delay(self.model) is None:
            raise ValueError(f"This {type(self.model).__name__} reads no age, so none can be told wrong.")

        def read(observation: Observation) -> Observation:
            if age_error:
                age = np.clip(observation["delay"] + age_error, 0, longest_delay(self.model))
                observation = {**observation, "delay": age.astype(np.float32)}
            return observation if self.normalize is None else self.normalize(observation)

        with answering(self.model, answer, at_once=True):
            return rollout(self.model, self.make_env, n_episodes, seed, n_envs, normalize=read, **kwargs)


def load_run(
    path: str | Path,
    algo: str | None = None,
    env_id: str | None = None,
    delay: Delay = None,
    device: str = "auto",
    env_kwargs: dict[str, Any] | None = None,
    gym_packages: Sequence[str] = (),
    answer: str | None = None,
) -> LoadedRun:
    """Open a run.

    No code in its files is run. To make the task, the installed modules that ``run.json`` names are imported.

    :param path: a run folder such as ``logs/said/Hopper-v5-delay4-seed1_1``, or an agent's ``.zip``
    :param algo: name of the algorithm, where neither a run folder nor the file says it
    :param env_id: task to play; the one of the run folder or of the file by default
    :param delay: observation delay to play under; the trained one by default, and outside a run folder the largest that
        the agent was built for
    :param device: torch device
    :param env_kwargs: more arguments for ``gymnasium.make``, such as ``render_mode``
    :param gym_packages: modules that register the task, beside those that the run remembers
    :param answer: who is to play in a SAID agent, and is checked for the delay; by default as the file says
    :raises ImportError: for a module that is not there
    :raises ValueError: when the files do not say what to load, the agent does not fit the task, or the task cannot be
        made with these arguments
    """
    file, record = find_agent(Path(path))
    hyperparams = record.hyperparams if record is not None else {}
    algo, env_id = _algorithm_and_task(file, record, algo, env_id)
    if record is not None:
        record.require("env_wrapper", "env_kwargs")
    import_packages([*(record.gym_packages if record is not None else ()), *gym_packages])

    model = ALGORITHMS[algo][0].load(file, device=device)
    _warn_if_unfinished(model, file, record)
    kwargs = {**(record.env_kwargs if record is not None else {}), **(env_kwargs or {})}

    def make_task() -> gym.Env[Any, Any]:
        try:
            return gym.make(env_id, **kwargs)
        except TypeError as error:
            raise ValueError(f"{env_id} cannot be made with {kwargs}: {error}") from error

    task, wrappers = make_task(), record.wrappers if record is not None else []
    own_delay = _process_of(task)
    if own_delay is None:
        wrappers = wrappers if delay is None and record is not None else _with_delay(wrappers, delay, model)
    elif delay is not None and make_process(delay) != own_delay:
        raise ValueError(
            f"{env_id} is registered with a delay of its own, {delay_name(own_delay)}, and can be played under no "
            "other: register it without, and train with --delay."
        )
    wrap = make_wrapper(wrappers) or (lambda task: task)

    def make_env() -> gym.Env[Any, Any]:
        return wrap(Monitor(make_task()))  # below wrappers that change rewards, to count the task's own

    env = wrap(task)
    _check_spaces(model, env, file)
    delay_process = _process_of(env) or FixedDelay(0)
    if isinstance(model, DelayedSAC):
        with answering(model, answer):
            model.check_ages(ages_of(env))
    env.close()
    info = {"algo": algo, "env": env_id, "delay": delay_name(delay_process)}
    info |= {"file": str(file), "trained_steps": model.num_timesteps}
    is_normalized = bool(hyperparams.get("normalize")) or getattr(model, "reads_normalized", False)
    statistics = find_normalization(file, record)
    normalize = _load_normalize(file, statistics, make_env, is_normalized)
    return LoadedRun(model, make_env, normalize, file.parent, info, changes(kwargs, wrappers), statistics, own_delay)


def _algorithm_and_task(file: Path, record: Record | None, algo: str | None, env_id: str | None) -> tuple[str, str]:
    """Return the algorithm and the task of an agent.

    The algorithm is what its run or its file says, else the given one. The task is the given one, else what they say.

    :raises ValueError: where nobody says it, and for an algorithm that is not ours
    """
    own_algo, own_task = described(file) if record is None else (record.algo, record.env)
    unknown = [name for name in (own_algo or algo, algo or own_algo) if name not in ALGORITHMS]
    if unknown:  # to load an agent of SB3 itself would run code in its file
        names = ", ".join(ALGORITHMS)
        told = f" ({unknown[0]})" if unknown[0] else ""
        raise ValueError(
            f"The algorithm of {file} is not known{told}: give --algo, one of {names}. What Stable-Baselines3 itself "
            "has saved, sb3-said collect alone opens."
        )
    if own_algo and algo not in (None, own_algo):
        warnings.warn(f"{file} is of {own_algo!r}, as it says itself: --algo {algo} changes nothing.", stacklevel=3)
    env_id = env_id or own_task
    if env_id is None:
        raise ValueError(f"The task of {file} is not known: no run folder is around it, and it names none. Give --env.")
    return str(own_algo or algo), env_id


def _warn_if_unfinished(model: BaseAlgorithm, file: Path, record: Record | None) -> None:
    is_last = record is not None and file.name == record.agent_name  # and not the best one, saved during the training
    if not is_last or not isinstance(model, SAID) or model.planner_is_current or (file.parent / ENDED_NAME).is_file():
        return
    has_some = model.policy.planner_is_trained
    what = "trained to the end, and tried: it plays as it is" if has_some else "trained: its expert plays"
    warnings.warn(
        f"This run stopped after {model.num_timesteps} steps, before its planner was {what}. sb3-said train "
        f"{resuming(file.parent)} goes on.",
        stacklevel=3,
    )


def changes(env_kwargs: dict[str, Any], wrappers: list[Any]) -> dict[str, Any]:
    """Return what a run changes in its task but the observation delay, see :class:`LoadedRun`.

    :param env_kwargs: of ``gymnasium.make``
    :param wrappers: as rl_zoo3's ``env_wrapper`` has them
    """
    changed: dict[str, Any] = {"env_kwargs": env_kwargs} if env_kwargs else {}
    for name, given in map(entry_of, wrappers):
        changed |= {x: given[x] for x in given.keys() - DELAYS} if is_delay_wrapper(name) else {str(name): given}
    return changed


def described(file: Path) -> tuple[str | None, str | None]:
    """Return the algorithm and the task that an agent's file names, None for what it does not name."""
    try:
        metadata = load_metadata(file)
    except SavedFileError:  # a file of SB3's own algorithms
        return None, None
    names = [name for name, (kind, _) in ALGORITHMS.items() if kind.__name__ == metadata["kind"]]
    return (names[0] if len(names) == 1 else None), task_of(metadata)


def delay_name(process: DelayProcess) -> int | str:
    """Return the number of a fixed delay, and any other process as text."""
    return process.delay if isinstance(process, FixedDelay) else str(process)


def answers(model: BaseAlgorithm) -> list[str | None]:
    """Return who can answer in a SAID agent; ``[None]`` for another agent.

    An expert that has learned nothing, as in training from logs, answers only where there is nobody else.
    """
    if not isinstance(model, SAID):
        return [None]
    return [who for who in model.policy.answers if who != "expert" or model.has_expert] or [*model.policy.answers]


def answering(model: BaseAlgorithm, answer: str | None, at_once: bool = False) -> AbstractContextManager[Any]:
    """Let one of ``answers(model)`` answer inside the context; None leaves the model as it is.

    :param at_once: see :meth:`SAIDPolicy.answering`
    :raises ValueError: for an answer that the model does not have
    """
    if answer is None:
        return nullcontext()
    policy: Any = model.policy  # SB3's own have no answering
    if not hasattr(policy, "answering"):
        raise ValueError(f"This {type(model).__name__} cannot answer as {answer!r}: only a SAID agent has an expert.")
    context: AbstractContextManager[Any] = policy.answering(answer, at_once)
    return context


def longest_delay(model: BaseAlgorithm) -> int | None:
    """Return the largest delay that an agent was built for, None for one that reads undelayed observations."""
    space = model.observation_space
    if not isinstance(space, spaces.Dict) or "action_history" not in space.spaces:
        return None
    return int(space["action_history"].shape[0])  # type: ignore[index]  # a Box has a shape


def control_period(run: LoadedRun) -> float | None:
    """Return the control step of a simulated robot, in seconds; None where the task does not tell it."""
    env = run.make_env()
    try:
        dt = getattr(env.unwrapped, "dt", None)
        return float(dt) if isinstance(dt, (int, float, np.number)) and 0 < dt < np.inf else None  # not a method
    finally:
        env.close()


def origin(run: LoadedRun) -> dict[str, Any]:
    """Say what a reader needs to judge and repeat the numbers: command, date, machine, versions."""
    program = sys.argv[0] if sys.argv[0].startswith("sb3-said ") else f"python {sys.argv[0]}"
    packages = ("stable_baselines3", "torch", "gymnasium", "mujoco", "numpy")
    return {
        "command": f"{program} {shlex.join(sys.argv[1:])}",
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        # With other instructions, AVX2 or AVX512, sums round differently, and the same training ends elsewhere
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPU cores, {get_cpu_capability()}",
        "device": str(getattr(run.model, "device", "cpu")),  # random actions have none
        "torch_threads": th.get_num_threads(),
        "versions": {"python": platform.python_version(), "sb3_said": __version__, **{p: version(p) for p in packages}},
    }


def _process_of(env: gym.Env[Any, Any]) -> DelayProcess | None:
    """Return a task's delay process, None without. Only our wrapper is asked: another ``process`` may be anything."""
    wrapper = unwrap_wrapper(env, DelayedObservationWrapper)
    return wrapper.process if isinstance(wrapper, DelayedObservationWrapper) else None


def _with_delay(wrappers: list[Any], delay: Delay, model: BaseAlgorithm) -> list[Any]:
    """Set the delay to play under, keeping the length of the action history that the model reads."""
    max_delay = longest_delay(model)
    if max_delay is None:
        if largest_delay(delay) > 0:
            space = model.observation_space
            raise ValueError(f"This agent reads {space}, not delayed observations: leave out --delay {delay}.")
        return wrappers
    if largest_delay(delay) > max_delay:
        raise ValueError(f"This agent was built for delays 0..{max_delay}, got --delay {delay}.")
    kwargs: dict[str, Any] = {"delay": max_delay if delay is None else delay, "max_delay": max_delay}
    if has_state_history(model.observation_space):
        kwargs["state_history"] = True
    given = [entry_of(wrapper) for wrapper in wrappers]
    if not any(is_delay_wrapper(name) for name, _ in given):
        given.append((WRAPPER, {}))
    return [{name: {**old, **kwargs} if is_delay_wrapper(name) else old} for name, old in given]


def _check_spaces(model: BaseAlgorithm, env: gym.Env[Any, Any], file: Path) -> None:
    def shapes(space: spaces.Space[Any]) -> Any:
        return {key: s.shape for key, s in space.spaces.items()} if isinstance(space, spaces.Dict) else space.shape

    for what in ("observation_space", "action_space"):
        expected, given = shapes(getattr(model, what)), shapes(getattr(env, what))
        if expected != given:
            raise ValueError(f"{file} expects {what} shapes {expected}, the task has {given}: check --env and --delay.")
    if model.action_space != env.action_space:
        raise ValueError(
            f"{file} sends actions in {model.action_space}, the task takes {env.action_space}: check --env. An agent "
            "of a run whose wrapper changes actions plays in that run's folder, which names the wrapper."
        )


def _load_normalize(
    file: Path, found: Path | None, make_env: Callable[[], gym.Env[Any, Any]], is_needed: bool
) -> Callable[[Observation], Observation] | None:
    if found is None:
        if is_needed:
            raise ValueError(
                f"{file} reads normalised observations, but {normalization_file(file)} is missing. The two belong "
                "together: put it there."
            )
        return None
    statistics = load_normalization(found, DummyVecEnv([make_env]))
    statistics.close()
    return statistics.normalize_obs
