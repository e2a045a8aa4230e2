"""A few episodes of the training environment, which tell whether a new planner is better than its expert."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from tqdm.auto import tqdm

from sb3_said.said.policies import Answer

SAID = Any  # whose module imports this one
RIVALS: tuple[Answer, ...] = ("planner", "expert")


def play_trial(model: SAID, n_episodes: int, progress_bar: bool = False) -> dict[Answer, np.ndarray]:
    """Play the training environment with the planner and with the expert, from the same seed.

    These are environment steps beyond those of ``learn``.

    :param model: with a trained planner and an environment
    :param n_episodes: for each of the two
    :param progress_bar: show one
    :return: for each, (n_episodes,) undiscounted returns in the task's own rewards
    """
    seed, returns = int(np.random.randint(2**31)), {}
    with model.borrowed_env() as env:
        for who in RIVALS:
            with model.policy.answering(who), tqdm(total=n_episodes, desc=who, disable=not progress_bar) as bar:

                def show(played: dict[str, Any], _: dict[str, Any], bar: Any = bar) -> None:
                    bar.update(len(played["episode_rewards"]) - bar.n)

                env.seed(seed)
                played = evaluate_policy(model, env, n_episodes, callback=show, return_episode_rewards=True, warn=False)
                show({"episode_rewards": played[0]}, {})
                returns[who] = np.asarray(played[0])
    return returns


def let_the_better_answer(model: SAID, n_episodes: int, progress_bar: bool = False) -> dict[str, float]:
    """Let whoever has the higher mean return answer ``predict``, and warn where that is the expert.

    :return: both means, for the log
    """
    returns = play_trial(model, n_episodes, progress_bar)
    means = {who: float(played.mean()) for who, played in returns.items()}
    model.set_answer("planner" if means["planner"] >= means["expert"] else "expert")
    if means["planner"] < means["expert"]:
        warnings.warn(
            f"The planner is worse than its expert: mean returns of {means['planner']:.5g} and {means['expert']:.5g} "
            f"over {n_episodes} episodes each. So the expert answers. More planner_gradient_steps or more data may "
            "mend the planner; set_answer('planner') lets it answer all the same.",
            stacklevel=3,
        )
    return {f"trial/{who}_return": mean for who, mean in means.items()}
