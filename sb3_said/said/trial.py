"""Episodes of the training environment that tell how a new planner decides best, and whether its expert does better."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from tqdm.auto import tqdm

from sb3_said.files.normalization import get_statistics, set_statistics
from sb3_said.planner import InpaintingPlanner
from sb3_said.said.agent import PlannerAgent
from sb3_said.said.ways import players_of

MakeEnv = Callable[[int], VecEnv]  # makes as many environments as it is told

CUT_AT = 10  # times the longest stored episode: a good policy may never end one
FIRST_PART = 0.25  # of a trial's episodes, which all ways play
AT_ONCE = 5  # environments: a CPU core decides for each in .25 to .39 of the time (measured, results/settings.md)
GO_ON = 3  # ways that play the remaining ones, too (simulated with episodes of 30 planners, results/settings.md)
LATER = "train_planner() plays one later, and so does --resume with as many steps (-n) as the run had."


class TrialStopped(KeyboardInterrupt):
    """Raised where ``should_stop`` ends a trial, and not Ctrl-C."""


@contextmanager
def stopped_alone() -> Iterator[None]:
    """Let Ctrl-C, or an error of task or planner, end the trial that is played inside, and nothing else."""
    try:
        yield
    except TrialStopped:
        raise
    except KeyboardInterrupt:
        print(f"The trial was interrupted: the planner answers as it is. {LATER}")
    except Exception as error:  # from any simulator; it must not lose what was learned
        warnings.warn(
            f"The trial has failed, and the planner answers as it is: {type(error).__name__}: {error} {LATER}",
            stacklevel=4,
        )


@dataclass(frozen=True)
class Trial:
    """What :func:`play_trial` measured."""

    returns: dict[str, np.ndarray]
    """(n_episodes,) of each of ``planner_ways``, in their order; of "planner", after them or in place of the way that
    has its settings; and of "expert". Undiscounted, in the task's own rewards. A way that was given up has fewer"""
    ages: np.ndarray
    """(n_episodes,) age of each episode's observations once it has settled, in control steps. An episode that ends
    before an action shows has the largest age, since the one that answers there begins every episode. If the age
    changes within some episode, no age belongs to an episode, and all are 0"""
    n_steps: int
    """steps of all players together, with those of environments that wait for the others"""


def play_trial(
    model: PlannerAgent,
    n_episodes: int,
    progress_bar: bool = False,
    should_stop: Callable[[], bool] | None = None,
    planners: Sequence[InpaintingPlanner] = (),
    make_env: MakeEnv | None = None,
) -> Trial:
    """Play the training environment with the planner, in each of its ways, and with the expert, from the same seeds.

    All of them play the first quarter of the episodes, in whole rounds of the environments. Then the three best ways
    and the expert play on. The score of a way includes the expert, at the ages at which the expert does better.

    The steps come on top of ``learn``'s. The actor does not play on a guessed present where the expert has not learned
    at age 0, as with a fixed delay.

    :param model: with a trained planner and an environment; stays as it is
    :param n_episodes: of each player that plays to the end
    :param progress_bar: show one
    :param should_stop: asked after every step
    :param planners: other trained planners, for the ways of their masks; ways whose mask no planner has are left out
    :param make_env: makes environments like the training's, to play in several at once. Without it, or where the
        training has as many, its own are used
    :raises TrialStopped: when ``should_stop`` has ended the trial
    """
    policy, seed = model.policy, int(np.random.randint(2**31))
    own = policy.planner, policy.planner.config
    players = players_of(model, planners)
    named = {"planner" if player == own else name: player for name, player in players.items()} | {"planner": own}
    can_act = model.has_expert and 0 in (model.trained_ages or [])
    can_act &= policy.max_delay > 0  # without delay the actor is the expert
    ways = {name: how for name, how in named.items() if name == "planner" or how[1].decided_by == "plan" or can_act}
    everyone = {**ways, "expert": own}
    returns: dict[str, np.ndarray] = {name: np.zeros(0) for name in everyone}
    ages, n_steps = np.zeros(0), 0

    def play_on(env: VecEnv, names: list[str], n: int) -> None:
        nonlocal ages, n_steps
        first, met = len(ages), []
        for name in names:
            policy.take_planner(*everyone[name])
            bar = tqdm(total=n, desc=name, disable=not progress_bar)
            with bar, policy.answering("expert" if name == "expert" else "planner", at_once=True):
                found, met_ages, n_played = _play(model, env, n, seed + first, bar, should_stop)
            returns[name] = np.append(returns[name], found)
            met.append(met_ages)
            n_steps += n_played
        ages = np.append(ages, np.min(met, axis=0))  # a player that falls at once shows the largest age instead

    try:
        with _env_of(model, n_episodes, make_env) as env:
            n_first = n_episodes if len(ways) <= GO_ON else int(np.ceil(FIRST_PART * n_episodes))
            # In whole rounds, as delays of environments may differ, and those without an episode would step on anyway
            n_first = min(n_episodes, int(np.ceil(n_first / env.num_envs)) * env.num_envs)
            play_on(env, [*everyone], n_first)
            if n_first < n_episodes:
                shares = {name: best_share(returns[name], returns["expert"], _if_settled(ages))[0] for name in ways}
                best = sorted(ways, key=lambda name: -shares[name])[:GO_ON]  # of equal ones, the first
                play_on(env, [name for name in everyone if name in (*best, "expert")], n_episodes - n_first)
    finally:
        policy.take_planner(*own)
    return Trial(returns, _if_settled(ages), n_steps)


@contextmanager
def _env_of(model: PlannerAgent, n_episodes: int, make_env: MakeEnv | None) -> Iterator[VecEnv]:
    """Give the environments of a trial: the training's own, or new ones, which are closed after it."""
    n_envs = min(AT_ONCE, n_episodes)
    assert model.env is not None  # a trial is of an agent that has one
    made = None if make_env is None or model.env.num_envs >= n_envs else _made(model, make_env, n_envs)
    if made is None:
        with model.borrowed_env() as env:
            yield env
        return
    try:
        yield made
    finally:
        _close(made)


def _made(model: PlannerAgent, make_env: MakeEnv, n_envs: int) -> VecEnv | None:
    """Make environments with the observations of the training's; where that fails, warn, and return None."""
    own, env = model.get_vec_normalize_env(), None
    try:
        env = make_env(n_envs)
        if model.env is not None and env.unwrapped is model.env.unwrapped:
            return None  # the training's own, which stay open
        normalizer = unwrap_vec_normalize(env)
        if own is not None and normalizer is None:
            env = normalizer = VecNormalize(env, norm_obs=own.norm_obs, norm_obs_keys=own.norm_obs_keys)
        check_for_correct_spaces(env, model.observation_space, model.action_space)
        set_statistics(normalizer, get_statistics(own))
        if own is not None and normalizer is not None:
            normalizer.clip_obs, normalizer.epsilon = own.clip_obs, own.epsilon
            normalizer.training = normalizer.norm_reward = False
        return env
    except Exception as error:  # from any simulator; it must not lose what was learned
        warnings.warn(
            f"The trial is played in the training's own environment: {type(error).__name__}: {error}", stacklevel=6
        )
        if isinstance(env, VecEnv):
            _close(env)
        return None


def _close(env: VecEnv) -> None:
    """Close environments that were made; their errors, as of processes that have ended, must not lose the trial."""
    try:
        env.close()
    except Exception as error:  # from any simulator
        warnings.warn(f"The trial's environments could not be closed: {type(error).__name__}: {error}", stacklevel=6)


def _if_settled(ages: np.ndarray) -> np.ndarray:
    """Return episodes' ages; or 0 for all where one is NaN, that is, changed within an episode."""
    return np.zeros(len(ages)) if np.isnan(ages).any() else ages


def _settled_age(ages: np.ndarray, max_delay: int) -> float:
    """Return an episode's age, from those (T,) of its steps; NaN where it changes."""
    if np.all(ages == np.arange(len(ages))):  # s_0 is all that has arrived
        return max_delay
    settled = ages[min(max_delay, len(ages) - 1) :]
    return float(settled[0]) if np.all(settled == settled[0]) else np.nan


def _play(
    model: PlannerAgent, env: VecEnv, n_episodes: int, seed: int, bar: tqdm, should_stop: Callable[[], bool] | None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the returns and ages of the episodes from the resets seed, seed + 1, ..., and the steps taken.

    In each round every environment plays one episode and waits for the longest. An age that changes within its episode
    is NaN.
    """
    returns, settled_ages, n_steps = np.zeros(n_episodes), np.zeros(n_episodes), 0
    longest = CUT_AT * (int(model.replay_buffer.steps.max()) + 1)
    for first in range(0, n_episodes, env.num_envs):
        env.seed(seed + first)  # each environment gets one more than the one before it
        obs, ages = cast(Any, env.reset()), []
        sums = np.zeros(env.num_envs)
        is_played = first + np.arange(env.num_envs) < n_episodes
        while is_played.any():
            ages.append(obs["delay"][:, 0] if isinstance(obs, dict) else np.zeros(env.num_envs))
            obs, rewards, dones, infos = env.step(model.predict(obs, deterministic=True)[0])
            sums, n_steps = sums + rewards, n_steps + env.num_envs
            for i in np.flatnonzero(is_played & (dones | (len(ages) == longest))):
                seen = infos[i].get("episode") or {}  # a Monitor sees the task's own rewards
                returns[first + i] = seen.get("r", sums[i])
                if not np.isfinite(returns[first + i]):
                    raise ValueError(f"A reward of the trial is not finite: an episode returned {returns[first + i]}.")
                settled_ages[first + i] = _settled_age(np.stack(ages)[:, i], model.policy.max_delay)
                is_played[i] = False
                bar.update()
            if should_stop is not None and should_stop():
                raise TrialStopped
    return returns, settled_ages, n_steps


def best_share(planner: np.ndarray, expert: np.ndarray, ages: np.ndarray) -> tuple[float, float, bool]:
    """Return the best mean return of the two together, the age that parts them, and whether the expert is below.

    The age is -1 for the planner alone, and infinite for the expert alone. Between two ages that were played it is
    midway, and counts to the lower side.

    :param planner: (n,) returns of episodes
    :param expert: (n,) returns of the same episodes
    :param ages: (n,) their ages
    """
    played = np.unique(ages)
    between = np.floor((played[:-1] + played[1:]) / 2)
    cuts = [(-1.0, True), *((cut, below) for below in (True, False) for cut in between), (np.inf, True)]
    means = [float(np.where((ages <= cut) == is_below, expert, planner).mean()) for cut, is_below in cuts]
    best = int(np.argmax(means))
    return means[best], *cuts[best]


def gains_more_than_its_error(returns: np.ndarray, than: np.ndarray) -> bool:
    """Tell whether returns (n,) are better than others of the same episodes by more than the gain's standard error.

    Of many shares some look better by chance. One error is a low bar: where ten episodes of two equal players are
    compared, a share passes in a fifth of the cases, and loses nothing.
    """
    gain = returns - than
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    return bool(gain.mean() > error)


def best_answer(trial: Trial) -> tuple[str, float, bool]:
    """Return the way to decide that did best, the age that parts planner and expert, and whether the expert is below.

    If the best way gains no more than the error over some ways, the first of these is taken. Planner and expert both
    answer only if together they gain more than the error over the better one alone.

    :return: the age is -1 where the planner alone answers, and infinite where the expert does
    """
    expert = trial.returns["expert"]
    played = {name: returns for name, returns in trial.returns.items() if len(returns) == len(expert)}
    ways = [name for name in played if name != "expert"]
    shares = {name: best_share(played[name], expert, trial.ages) for name in ways}
    alone = max(played, key=lambda name: played[name].mean())
    way = max(ways, key=lambda name: shares[name][0])
    _, cut, is_below = shares[way]
    together = np.where((trial.ages <= cut) == is_below, expert, played[way])
    if gains_more_than_its_error(together, played[alone]):
        return way, cut, is_below
    best = played[max(ways, key=lambda name: played[name].mean())]
    way = next(name for name in ways if not gains_more_than_its_error(best, played[name]))
    return way, (np.inf if alone == "expert" else -1.0), True


def let_the_best_answer(
    model: PlannerAgent,
    n_episodes: int,
    progress_bar: bool = False,
    should_stop: Callable[[], bool] | None = None,
    planners: Sequence[InpaintingPlanner] = (),
    make_env: MakeEnv | None = None,
) -> dict[str, float | str]:
    """Let the planner in its best way answer, or the expert, or both, each at the ages at which it does better.

    :func:`best_answer` chooses. Warn where the expert alone answers.

    :param planners: beside the agent's own, as of :func:`play_trial`; the agent takes the one of the best way
    :param make_env: as of :func:`play_trial`
    :return: mean returns, the way that is taken, the expert's ages, and the number of steps played, for the log
    """
    own, players = (model.policy.planner, model.policy.planner.config), players_of(model, planners)
    trial = play_trial(model, n_episodes, progress_bar, should_stop, planners, make_env)
    way, cut, is_below = best_answer(trial)
    model.policy.take_planner(*players.get(way, own))
    if 0 <= cut < model.policy.max_delay:
        model.policy.set_answer("both", **({"expert_up_to": int(cut)} if is_below else {"expert_from": int(cut) + 1}))
    else:
        model.policy.set_answer("planner" if cut < 0 else "expert")
    if np.isinf(cut):
        warnings.warn(
            f"The planner is worse than its expert: mean returns of {trial.returns[way].mean():.5g} and "
            f"{trial.returns['expert'].mean():.5g} over {n_episodes} episodes each. So the expert answers. More "
            "planner_gradient_steps or more data may mend the planner; set_answer('planner') lets it answer all the "
            "same.",
            stacklevel=3,
        )
    means = {f"trial/{name}_return": float(returns.mean()) for name, returns in trial.returns.items()}
    ages = model.policy.expert_ages  # none: from 0 up to -1
    share = {"trial/expert_from": float(ages.start), "trial/expert_up_to": float(ages.stop - 1)}
    return {"trial/way": way, **means, **share, "trial/steps": float(trial.n_steps)}
