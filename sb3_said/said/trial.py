"""Episodes of the training environment that tell how a new planner decides best, and whether its expert does better."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from tqdm.auto import tqdm

from sb3_said.planner.config import SAMPLING_SETTINGS, PlannerConfig

SAID = Any  # whose module imports this one

#: What a trial compares with an agent's own settings: a single step, and the mean of all candidates, weighed by the
#: critics. Which is best depends on task, delay and budget (measured, results/settings.md).
WAYS: dict[str, dict[str, Any]] = {
    "one_step": {"temperature": 0.0, "sampling_steps": 1},
    "weighed": {"temperature": 1.0, "sampling_steps": 2, "choice_factor": 1.0},
}


def ways_of(given: dict[str, dict[str, Any]] | None, planner_kwargs: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the ways to compare: those given, or ``WAYS``; none where ``planner_kwargs`` says how to decide.

    :raises ValueError: for other settings than those of ``set_planner``, and for values outside their range
    """
    if given is None:
        return {} if set(SAMPLING_SETTINGS) & set(planner_kwargs) else WAYS
    for name, settings in given.items():
        if name in ("planner", "expert") or not set(settings) <= set(SAMPLING_SETTINGS):
            raise ValueError(
                f"planner_ways has {name!r}: {settings}; expected another name than 'planner' and 'expert', with "
                f"settings from {', '.join(SAMPLING_SETTINGS)}."
            )
        PlannerConfig(**settings)
    return given


def play_trial(model: SAID, n_episodes: int, progress_bar: bool = False) -> tuple[dict[str, np.ndarray], int]:
    """Play the training environment with the planner, in each of its ways, and with the expert, from the same seed.

    These are environment steps beyond those of ``learn``.

    :param model: with a trained planner and an environment; stays as it is
    :param n_episodes: for each
    :param progress_bar: show one
    :return: for "planner", each of ``planner_ways`` and "expert" (n_episodes,) undiscounted returns in the task's own
        rewards; and the number of steps played
    """
    seed, own, returns, n_steps = int(np.random.randint(2**31)), model.policy.planner.config, {}, 0
    try:
        with model.borrowed_env() as env:
            for name, settings in {"planner": {}, **model.planner_ways, "expert": {}}.items():
                model.policy.planner.config = own
                model.set_planner(**settings)
                who = "expert" if name == "expert" else "planner"
                with model.policy.answering(who), tqdm(total=n_episodes, desc=name, disable=not progress_bar) as bar:

                    def show(played: dict[str, Any], _: dict[str, Any], bar: Any = bar) -> None:
                        bar.update(len(played["episode_rewards"]) - bar.n)

                    env.seed(seed)
                    how = {"callback": show, "return_episode_rewards": True, "warn": False}
                    played, lengths = evaluate_policy(model, env, n_episodes, **how)  # type: ignore[arg-type]
                    show({"episode_rewards": played}, {})
                    returns[name], n_steps = np.asarray(played), n_steps + sum(lengths)  # type: ignore[arg-type]
    finally:
        model.policy.planner.config = own
    return returns, n_steps


def let_the_best_answer(model: SAID, n_episodes: int, progress_bar: bool = False) -> dict[str, float]:
    """Let the planner decide in its best way, and answer ``predict`` unless the expert does better; then warn.

    :return: mean returns and the number of steps played, for the log
    """
    returns, n_steps = play_trial(model, n_episodes, progress_bar)
    means = {name: float(played.mean()) for name, played in returns.items()}
    expert = means["expert"]
    way = max((name for name in means if name != "expert"), key=means.__getitem__)
    model.set_planner(**model.planner_ways.get(way, {}))
    model.set_answer("planner" if means[way] >= expert else "expert")
    if means[way] < expert:
        warnings.warn(
            f"The planner is worse than its expert: mean returns of {means[way]:.5g} and {expert:.5g} "
            f"over {n_episodes} episodes each. So the expert answers. More planner_gradient_steps or more data may "
            "mend the planner; set_answer('planner') lets it answer all the same.",
            stacklevel=3,
        )
    return {f"trial/{name}_return": mean for name, mean in means.items()} | {"trial/steps": float(n_steps)}
