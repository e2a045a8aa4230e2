"""The ways to decide in which a planner is tried after its training."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.config import SAMPLING_SETTINGS, PlannerConfig
from sb3_said.sac.policies import settings_of
from sb3_said.said.agent import PlannerAgent

NAME_LENGTH = 25  # of a way; SB3's log takes longer names that begin alike for the same

DEFAULT_WAY: dict[str, Any] = {
    "decided_by": "plan",
    "temperature": 0.0,
    "sampling_steps": PlannerConfig.sampling_steps,
}
#: What a trial compares with an agent's own settings. "weighed": the mean of all candidates, weighed by the critics.
#: "actor": the expert's actor on the guessed present. "default": the plan in the default's steps. "one_step": in one.
#: "inpainted": the present is inpainted with the plan, since a guess may go wrong at old observations. "own_ages":
#: another planner, of decisions made at the age that it is shown. Where an expert does one thing on new observations
#: and another on old ones, the agent's own planner learns the mean of both (results/own_mask.md has where "own_ages"
#: gains, and where it loses). Which way is best depends on task, delay and budget (measured,
#: results/what_diffusion_buys.md and results/settings.md). Where the trial cannot tell, the first way is taken:
#: "weighed" was best or second with each of seven planners.
WAYS: dict[str, dict[str, Any]] = {
    "weighed": {"decided_by": "plan", "temperature": 1.0, "sampling_steps": 2, "choice_factor": 1.0},
    "actor": {"decided_by": "actor"},
    "default": DEFAULT_WAY,
    "one_step": {**DEFAULT_WAY, "sampling_steps": 1},
    "inpainted": {**DEFAULT_WAY, "present": "inpainted"},
    "own_ages": {**DEFAULT_WAY, "present": "inpainted", "mask": "own"},
}
WAY_SETTINGS = (*SAMPLING_SETTINGS, "mask")


def ways_of(
    given: dict[str, dict[str, Any]] | None, planner_kwargs: dict[str, Any], value: str
) -> dict[str, dict[str, Any]]:
    """Return the ways to compare: those given, or ``WAYS``; none where ``planner_kwargs`` says how to decide.

    :param value: who scores candidates, as of :class:`~sb3_said.said.SAID`
    :raises ValueError: for other settings than ``mask`` and those of ``set_planner``, and for values outside their
        range, or that this planner cannot have
    """
    own = settings_of(PlannerConfig, planner_kwargs, "The planner")
    if given is None:
        if set(SAMPLING_SETTINGS) & set(planner_kwargs):
            return {}
        guesses = own.present == "guessed"
        is_another = {
            "actor": guesses,
            "inpainted": guesses and own.mask != "none",
            "own_ages": own.mask == "random",
        }
        ways = {name: way for name, way in WAYS.items() if is_another.get(name, True)}
        return _on_the_first(ways, own) if "own_ages" in ways else ways
    for name, settings in given.items():
        if len(name) > NAME_LENGTH:
            raise ValueError(f"planner_ways has the name {name!r}; expected at most {NAME_LENGTH} letters.")
        if name in ("planner", "expert") or not set(settings) <= set(WAY_SETTINGS):
            raise ValueError(
                f"planner_ways has {name!r}: {settings}; expected another name than 'planner' and 'expert', with "
                f"settings from {', '.join(WAY_SETTINGS)}."
            )
        in_way(own, settings)
        check_scored(settings, value == "iql")
    return _on_the_first(given, own) if any("mask" in way for way in given.values()) else given


def _on_the_first(ways: dict[str, dict[str, Any]], own: PlannerConfig) -> dict[str, dict[str, Any]]:
    """Write mask and present of the agent's own planner into ways, lest they change once it has the second planner.

    A way's own mask and present stand, and no present is written that contradicts the way.
    """
    return {name: {"mask": own.mask, **way, "present": in_way(own, way).present} for name, way in ways.items()}


def in_way(own: PlannerConfig, settings: dict[str, Any]) -> PlannerConfig:
    """Return a planner's settings changed to a way to decide.

    If ``decided_by`` and ``present`` contradict each other, the one that the way has stands; the other is the default.

    :raises ValueError: for values outside their range, or that this planner cannot have
    """
    try:
        return replace(own, **settings)
    except ValueError:  # such as for the actor, where the agent inpaints the present now
        return replace(own, **{"decided_by": "plan", "present": PlannerConfig.present, **settings})


def untried(config: PlannerConfig, ways: Collection[dict[str, Any]]) -> PlannerConfig:
    """Return a planner's settings as they were before a trial chose one of the ways.

    If they are a way's, all settings that ways name get their defaults. Else they are the user's own, and stay.
    ``mask="own"`` gets its default in both cases.
    """
    mask = PlannerConfig.mask if config.mask == "own" else config.mask
    is_a_way = any(config == in_way(config, way) for way in ways)
    named = set(SAMPLING_SETTINGS) & set().union(*ways) if is_a_way else set()
    return replace(config, **{name: getattr(PlannerConfig, name) for name in named}, mask=mask)


def _configs(model: PlannerAgent) -> dict[str, PlannerConfig]:
    """Return the planner's settings in each of the agent's ways to decide."""
    return {name: in_way(model.policy.planner.config, settings) for name, settings in model.planner_ways.items()}


def other_planners(model: PlannerAgent) -> list[PlannerConfig]:
    """Return the settings of the planners that the agent's ways to decide need beside its own, one for each mask.

    Each has those of the first way of its mask, in which it is measured.

    Where not every age of 0..D was trained on, or ages are not known, as in logs, ``"own"`` is left out: without
    decisions at each age such a planner would serve some delays alone.
    """
    own, max_delay = model.policy.planner.config.mask, model.policy.max_delay
    knows_ages = max_delay > 0 and set(range(max_delay + 1)) <= set(model.trained_ages or [])
    knows_ages &= not model.replay_buffer.holds_logs
    without = set() if knows_ages else {"own"}
    if model.trained_ages != [max_delay]:
        without |= {"fixed"}  # which plans at the largest age alone
    firsts = {config.mask: config for config in reversed(_configs(model).values())}
    return [firsts[mask] for mask in sorted(firsts.keys() - {own} - without)]


def players_of(
    model: PlannerAgent, planners: Sequence[InpaintingPlanner]
) -> dict[str, tuple[InpaintingPlanner, PlannerConfig]]:
    """Return a planner and its settings for each of the agent's ways that these planners, or its own, can play.

    Without delay the present is seen. So a way that inpaints it is left out where another differs in that alone.
    """
    by_mask = {planner.config.mask: planner for planner in (*planners, model.policy.planner)}
    configs = {name: way for name, way in _configs(model).items() if way.mask in by_mask}
    if model.policy.max_delay == 0:
        guessing = [way for way in configs.values() if way.decided_by == "plan" and way.present == "guessed"]
        twins = [replace(way, present="inpainted") for way in guessing if way.mask != "none"]
        configs = {name: way for name, way in configs.items() if way not in twins}
    return {name: (by_mask[way.mask], way) for name, way in configs.items()}


def check_scored(settings: dict[str, Any], is_by_state: bool) -> None:
    """Refuse ways to score candidates in which V(s) would see no difference.

    :param settings: of :meth:`~sb3_said.said.SAID.set_planner`
    :param is_by_state: whether V(s) scores, and not Q(s, a)
    :raises ValueError: for ``scored_states="decision"`` where V(s) scores
    """
    if settings.get("scored_states") == "decision" and is_by_state:
        raise ValueError(
            "scored_states='decision' scores candidates at the present that they share, where V(s) tells no action "
            "from another: use 'future' or 'all'."
        )
