"""Let trained agents play, and log the true states as a dataset to learn from."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch as th
from huggingface_sb3 import EnvironmentName
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm import tqdm

from sb3_said.delays.space import (
    EXECUTED,
    UNDELAYED,
    center_and_half,
    check_spaces,
    holds_whole_numbers,
    scale_action,
    unscale_action,
    within_bounds,
)
from sb3_said.offline.datasets import Dataset
from sb3_said.offline.scores import normalized_score, reference_returns
from sb3_said.offline.writing import check_target, write_dataset
from sb3_said.zoo.algorithms import ALGOS
from sb3_said.zoo.arguments import add_delay, add_playing, check_positive, explained, make_parser, read_delay
from sb3_said.zoo.record import import_packages
from sb3_said.zoo.runs import LoadedRun, answering, load_run, origin

#: Keeps noise and random actions apart from what the task and its delays draw from the same seed.
NOISE_STREAM = 2

EPILOG = """\
examples:
  # 300,000 steps of a trained agent, a third of them at each noise level, into an .npz
  sb3-said collect logs/sadr/Hopper-v5-seed1_1 --noise 0 0.1 0.3 --steps 300000 -o hopper_medium.npz

  # half an agent's, half random actions, into a Minari dataset; an agent named twice has twice the share
  sb3-said collect logs/sadr/Hopper-v5-seed1_1 random -o hopper/mixed-v0

  # an agent of Stable-Baselines3, which reads what a vecnormalize.pkl beside it normalises, where rl_zoo3 leaves one;
  # opening either file runs what is pickled in it
  sb3-said collect ppo_hopper.zip --algo ppo --env Hopper-v5 -o hopper_ppo.npz

  # an agent of ours that acts under delay: the log has the true states all the same
  sb3-said collect logs/said/Hopper-v5-delay4-seed1_1 --delay 2 -o hopper_d2.npz

  sb3-said train --algo said --env Hopper-v5 --delay 8 --dataset hopper_medium.npz

Each agent has an equal share of the steps at each noise level; the last episode of a share is cut off where it is full.
Noise is Gaussian, in units of half the range between an action's bounds; random actions get none. Episode i of an agent
at a noise level starts from reset seed --seed + i, by default where neither training nor evaluation nor tuning begins.
"""


@dataclass
class Episode:
    """One episode, as the task itself saw it."""

    states: list[np.ndarray]
    """s_0 and the state after each step"""
    actions: list[np.ndarray] = field(default_factory=list)
    """as they were executed, scaled to [-1, 1]"""
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    seed: int = 0
    """of its reset"""
    is_whole: bool = False
    """whether it has ended, and was not cut off"""

    def cut(self, n_steps: int) -> Episode:
        """Return its first steps."""
        is_whole = self.is_whole and n_steps >= len(self.rewards)
        kept = self.states[: n_steps + 1], self.actions[:n_steps], self.rewards[:n_steps]
        return Episode(*kept, self.terminated and is_whole, self.seed, is_whole)


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Adds each episode to a list, with the true states of a delayed task.

    An episode is added when it begins, so the list is in the order of seeds.

    :param on_step: called after each step
    """

    def __init__(self, env: gym.Env[Any, Any], episodes: list[Episode], on_step: Callable[[], None] | None = None):
        super().__init__(env)
        self.episodes, self.on_step = episodes, on_step

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self.episode = Episode([true_state(observation, info)], seed=kwargs.get("seed") or 0)
        self.episodes.append(self.episode)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        is_delayed = isinstance(observation, dict)
        assert isinstance(self.action_space, gym.spaces.Box)  # check_spaces has seen to it
        executed = info[EXECUTED] if is_delayed and EXECUTED in info else scale_action(action, self.action_space)
        self.episode.states.append(true_state(observation, info))
        self.episode.actions.append(np.asarray(executed, np.float32))
        self.episode.rewards.append(float(reward))
        self.episode.terminated, self.episode.is_whole = terminated, terminated or truncated
        if self.on_step is not None:
            self.on_step()
        return observation, reward, terminated, truncated, info


def true_state(observation: Any, info: dict[str, Any]) -> np.ndarray:
    """Return the state that a task is in, whatever a delay shows of it."""
    return np.array(info[UNDELAYED] if isinstance(observation, dict) else observation, np.float32)


class NoisyAgent:
    """An agent's actions with Gaussian noise, clipped to the bounds; or random ones.

    :param model: anything with SB3's ``predict``; None for actions uniform between the bounds
    :param space: of the actions
    :param noise: standard deviation, in units of half the range between the bounds
    :param seed: of noise and random actions
    """

    def __init__(self, model: Any, space: gym.spaces.Box, noise: float, seed: int):
        self.model, self.space, self.noise = model, space, noise
        self.policy = getattr(model, "policy", None)  # it tells a recurrent agent
        self.rng = np.random.default_rng([seed, NOISE_STREAM])

    def predict(self, observation: Any, state: Any = None, **how: Any) -> tuple[np.ndarray, Any]:
        if self.model is None:
            n = len(next(iter(observation.values())) if isinstance(observation, dict) else observation)
            if holds_whole_numbers(self.space):  # rounding would give each bound half of its share
                low, high, dtype = cast(Any, (self.space.low, self.space.high, self.space.dtype))
                return self.rng.integers(low, high, (n, *self.space.shape), dtype, endpoint=True), None
            return unscale_action(self.rng.uniform(-1.0, 1.0, (n, *self.space.shape)), self.space), None
        _, half = center_and_half(self.space)
        action, state = self.model.predict(observation, state=state, **how)
        return within_bounds(action + self.noise * half * self.rng.normal(size=action.shape), self.space), state


class ShareIsFull(Exception):
    """Ends a play before its episodes end: some never do."""


@dataclass(frozen=True)
class Share:
    """Who plays a part of the steps, and how."""

    name: str
    run: LoadedRun
    """its model is None for random actions"""
    noise: float


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("agents", nargs="+", metavar="AGENT", help="run folder, an agent's .zip, or the word random")
    parser.add_argument("-o", "--output", required=True, metavar="NPZ_OR_ID", help="file to write, ending in .npz, "
                        "or id of a Minari dataset, ending in -v0")  # fmt: skip
    parser.add_argument("--steps", type=int, default=300_000, help="steps of the dataset (default: 300000)")
    parser.add_argument(
        "--noise", type=float, nargs="+", default=[0.0], metavar="STD", help="noise levels (default: 0)"
    )
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the best")
    parser.add_argument("--n-envs", type=int, default=8, help="episodes played side by side (default: 8)")
    add_delay(parser, default="the trained one")
    add_playing(parser, episodes=None, seed=30_000)
    args = parser.parse_args(argv)
    with explained(parser):
        check_positive(args, "steps", "n_envs", "num_threads")
        if wrong := [noise for noise in args.noise if not 0 <= noise < math.inf]:
            raise ValueError(f"--noise is a standard deviation, 0 or more, got {wrong[0]}.")
        check_target(args.output)
        th.set_num_threads(args.num_threads)
        shares = list(open_agents(args))
        if args.steps < len(shares):
            raise ValueError(f"--steps is {args.steps}, fewer than there are shares, {len(shares)}.")
        parts: list[list[Episode]] = []
        unused: dict[tuple[str, float], int] = {}  # the next reset seed of each agent at a noise level
        with tqdm(total=args.steps, unit="step") as bar:
            for i, share in enumerate(shares):
                n_steps = args.steps * (i + 1) // len(shares) - args.steps * i // len(shares)
                who = os.path.abspath(share.name), share.noise  # a path may be given in two ways
                first = unused.get(who, args.seed)  # otherwise the same steps would come again
                parts.append(play(share, n_steps, first, args.n_envs, not args.stochastic, bar))
                unused[who] = 1 + max(episode.seed for episode in parts[-1])
        run = shares[0].run
        told = [describe(share, part) for share, part in zip(shares, parts, strict=True)]
        about = json.dumps({**origin(run), "seed": args.seed, "changes": json.loads(run.setting), "shares": told})
        data = join([episode for part in parts for episode in part])
        env = run.make_env()
        write_dataset(data, args.output, env, about, ", ".join(dict.fromkeys(share.name for share in shares)))
        env.close()
    print(f"Wrote {args.output}: {len(data):,} steps, {len(data.lengths):,} episodes")
    if run.changes:
        print(f"They are of {run.info['env']} changed by {run.setting}, which its id does not say.")


def open_agents(args: argparse.Namespace) -> Iterator[Share]:
    """Open each agent, at each noise level.

    :raises ValueError: for what cannot be opened, agents of several tasks, random actions without a task, or a task
        whose spaces do not fit
    :raises gymnasium.error.Error: for a task that is not registered
    """
    import_packages(args.gym_packages)
    names = dict.fromkeys(args.agents)
    unused = [f"--{name}" for name in ("algo", "delay", "stochastic") if getattr(args, name)]
    unused += ["--noise"] * any(args.noise)
    if unused and [*names] == ["random"]:
        raise ValueError(f"{', '.join(unused)}: for random actions alone this has no effect; leave it out.")
    runs = {name: open_agent(name, args) for name in names if name != "random"}
    tasks = {run.info["env"]: run for run in runs.values()}
    if len(tasks) > 1:
        raise ValueError(f"A dataset is of one task, but the agents are of {', '.join(tasks)}.")
    settings = {run.setting: run.changes for run in runs.values()}
    if len(settings) > 1:
        raise ValueError(f"A dataset is of one task, but the agents change theirs differently: {'; '.join(settings)}.")
    if "random" in names:
        if not tasks and args.env is None:
            raise ValueError("Random actions are of no task: give --env.")
        make_env = next(iter(runs.values())).make_env if runs else lambda: gym.make(args.env)
        info = {"env": args.env or next(iter(tasks)), "algo": "random"}
        changes = next(iter(settings.values()), {})
        runs["random"] = LoadedRun(None, make_env, None, Path(), info, changes)  # type: ignore[arg-type]  # no model
    for run in runs.values():
        env = run.make_env()
        check_spaces(env.observation_space, env.action_space)
        env.close()
    for name in args.agents:
        for noise in args.noise if name != "random" else [0.0] * len(args.noise):
            yield Share(name, runs[name], noise)


def open_agent(name: str, args: argparse.Namespace) -> LoadedRun:
    """Open a run or agent of this package, or a file that an algorithm of Stable-Baselines3 saved.

    :raises ValueError: when the files do not say what to load
    """
    path = Path(name)
    if not (path.is_file() and zipfile.is_zipfile(path) and "policy.pth" in zipfile.ZipFile(path).namelist()):
        played = {"algo": args.algo, "env_id": args.env, "delay": read_delay(args.delay), "device": args.device}
        run = load_run(path, gym_packages=args.gym_packages, **played)
        # A log holds executed actions, so it does not show an action delay
        changes = {name: given for name, given in run.changes.items() if name != "action_delay"}
        return replace(run, changes=changes)
    if args.env is None or args.algo not in ALGOS:
        raise ValueError(f"{path} is of Stable-Baselines3: name its task with --env and its class with --algo.")
    if args.delay:
        raise ValueError(f"{path} is of Stable-Baselines3, whose agents know no delay: leave out --delay.")
    cls: Any = getattr(stable_baselines3, args.algo.upper(), ALGOS[args.algo])  # "sac" is ours in ALGOS
    try:
        model, info = cls.load(path, device=args.device), {"env": args.env, "algo": args.algo}
    except (AssertionError, AttributeError, KeyError, RuntimeError, TypeError) as error:  # SB3 checks nothing itself
        raise ValueError(f"{path} cannot be opened as an agent of --algo {args.algo}: {error!r}") from error
    return LoadedRun(model, partial(gym.make, args.env), normalization_beside(path, args.env), path.parent, info)


def normalization_beside(path: Path, env_id: str) -> Callable[[Any], Any] | None:
    """Return how VecNormalize normalises an SB3 agent's observations, None where it does not. Print which it is.

    :param path: of the agent; ``vecnormalize.pkl`` lies beside it, or in the folder that is named after the task
    :raises ValueError: for a file that cannot be opened, or is of another task
    """
    folders = path.parent, path.parent / EnvironmentName(env_id)
    found = next((file for folder in folders if (file := folder / "vecnormalize.pkl").is_file()), None)
    seen = "as they are; no vecnormalize.pkl is beside it" if found is None else f"normalised by {found}"
    print(f"{path} sees observations {seen}.", file=sys.stderr)
    if found is None:
        return None
    env = DummyVecEnv([partial(gym.make, env_id)])
    try:
        statistics = VecNormalize.load(str(found), env)
    except Exception as error:  # pickle raises many kinds, and SB3 asserts what it needs
        raise ValueError(f"{found} cannot be opened, or is of another task: {error}") from error
    finally:
        env.close()
    statistics.training = False
    return statistics.normalize_obs


def play(share: Share, n_steps: int, seed: int, n_envs: int, deterministic: bool, bar: tqdm[Any]) -> list[Episode]:
    """Play episodes until there are ``n_steps`` steps, and cut off the last episode.

    :param bar: moves on with the steps
    """
    episodes: list[Episode] = []
    kept: list[Episode] = []
    used, left, n_taken = 0, n_steps, 0

    def on_step() -> None:
        nonlocal n_taken  # the bar counts nothing while it is not shown
        if n_taken < n_steps:  # the steps beyond are cut off
            n_taken += 1
            bar.update()
        if n_taken == n_steps and n_settled(episodes) >= left:
            raise ShareIsFull

    def make_env() -> gym.Env[Any, Any]:
        return Recorder(share.run.make_env(), episodes, on_step)

    env = share.run.make_env()
    agent = NoisyAgent(share.run.model, env.action_space, share.noise, seed)  # type: ignore[arg-type]  # it is a Box
    env.close()
    player = replace(share.run, model=agent, make_env=make_env)  # type: ignore[arg-type]  # it has predict
    who = getattr(getattr(share.run.model, "policy", None), "who_answers", None)
    while left > 0:
        lengths = [len(episode.rewards) for episode in kept]
        n_episodes = max(n_envs, math.ceil(left / np.mean(lengths))) if lengths else n_envs
        with answering(share.run.model, who, at_once=True), contextlib.suppress(ShareIsFull):
            player.play(n_episodes, seed + used, n_envs, deterministic=deterministic)
        used += n_episodes
        for episode in episodes:
            if left > 0:
                kept.append(episode.cut(left))
                left -= len(kept[-1].rewards)
        episodes.clear()
    return kept


def n_settled(episodes: list[Episode]) -> int:
    """Return how many steps are sure to be kept: those of all episodes up to the first that still plays, inclusive."""
    n_steps = 0
    for episode in episodes:
        n_steps += len(episode.rewards)
        if not episode.is_whole:
            break
    return n_steps


def join(episodes: list[Episode]) -> Dataset:
    """Lay episodes end to end."""
    ends = [np.arange(1, len(e.rewards) + 1) == len(e.rewards) for e in episodes]
    return Dataset(
        states=np.concatenate([e.states[:-1] for e in episodes]),
        actions=np.concatenate([e.actions for e in episodes]),
        rewards=np.concatenate([np.array(e.rewards, np.float32) for e in episodes]),
        terminated=np.concatenate([end & e.terminated for end, e in zip(ends, episodes, strict=True)]),
        ends=np.concatenate(ends),
        finals=np.stack([e.states[-1] for e in episodes]),
    )


def describe(share: Share, episodes: list[Episode]) -> dict[str, Any]:
    """Print what a share earned in its whole episodes, and return it in JSON types."""
    returns = [sum(episode.rewards) for episode in episodes if episode.is_whole]
    mean = float(np.mean(returns)) if returns else None
    told: dict[str, Any] = {"agent": share.name, "noise": share.noise, "episodes": len(episodes), "mean_return": mean}
    earned = "none of them whole" if mean is None else f"mean return {mean:,.1f}"
    if mean is not None and reference_returns(task := share.run.scored_task) is not None:
        told["normalized_score"] = float(normalized_score(mean, task))
        earned += f", normalised score {told['normalized_score']:.1f}"
    print(f"{share.name}, noise {share.noise:g}: {len(episodes)} episodes, {earned}", file=sys.stderr)
    return told
