"""Set how a trained SAID agent decides, and save it under another name; nothing is trained."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from sb3_said import SAID
from sb3_said.delays.space import written_ages
from sb3_said.files.archive import SavedFileError, load_metadata
from sb3_said.files.atomic import check_writable
from sb3_said.files.normalization import normalization_file
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.said.policies import Answer
from sb3_said.zoo.arguments import TRUST, explained, make_parser
from sb3_said.zoo.folder import find_agent, find_normalization
from sb3_said.zoo.runs import ANSWERS, changes

EPILOG = f"""\
examples:
  # how the agent decides now
  sb3-said decide logs/said/Hopper-v5-delay4-seed1_1

  # the critics weigh 16 candidates; beside the run's own agent, so that the other commands know its task
  sb3-said decide logs/said/Hopper-v5-delay4-seed1_1 --temperature 1 --n-candidates 16 --choice-factor 1 \\
      -o logs/said/Hopper-v5-delay4-seed1_1/weighed.zip
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1/weighed.zip

  # two fifths of the size, to hand on: weights as float16, and nothing that only training needs
  sb3-said decide logs/said/Hopper-v5-delay4-seed1_1 --compact -o hopper.zip

  # the expert while the observation is at most 4 steps old, the planner beyond
  sb3-said decide hopper.zip --answer both --expert-up-to 4 -o hopper_both.zip

  # the planner up to 8 steps, the expert beyond: whichever is better where
  sb3-said decide ant.zip --answer both --expert-from 9 -o ant_both.zip

  # the fastest plan: one candidate, one denoising step; faster still is --decided-by actor, which plans nothing
  sb3-said decide hopper.zip --decided-by plan --temperature 0 --sampling-steps 1 -o hopper_fast.zip

At temperature 0 the planner draws one candidate from no noise, and no critic is asked. Above 0 it draws several: the
critics score them, and the best decides (--choice-factor none), or the mean of all does, each weighed by
exp(factor * its score in standard deviations). sb3-said tune searches for temperature, steps and choice factor.
What was not given stays as it is, but --compact has to be given again. The file given is left as it is, unless -o
names it.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("agent", type=Path, metavar="RUN_OR_ZIP", help="run folder of a training, or an agent's .zip")
    parser.add_argument("--temperature", type=float, metavar="T", help="factor on the initial noise, >= 0")
    parser.add_argument("--sampling-steps", type=int, metavar="N", help="denoising steps; time grows with them")
    parser.add_argument("--n-candidates", type=int, metavar="N", help="plans to draw at a temperature above 0")
    parser.add_argument("--choice-factor", type=number_or_none, metavar="BETA", help="how much the critics' scores "
                        "weigh among the candidates, >= 0; none: the best one alone decides")  # fmt: skip
    parser.add_argument("--scored-states", metavar="WHICH", help="states of a plan that the critics score: decision, "
                        "future or all")  # fmt: skip
    parser.add_argument("--present", metavar="WHICH", help="where a plan starts: inpainted, with the plan, or guessed "
                        "before it")  # fmt: skip
    parser.add_argument("--decided-by", metavar="WHO", help="who decides at the present: plan, or actor: the expert "
                        "on the guessed present")  # fmt: skip
    parser.add_argument("--answer", choices=ANSWERS, help="who acts; both: the expert at some ages of the observation, "
                        "and the planner at the others")  # fmt: skip
    parser.add_argument("--expert-up-to", type=int, metavar="AGE", help="with --answer both: the largest age at which "
                        "the expert acts, in control steps")  # fmt: skip
    parser.add_argument("--expert-from", type=int, metavar="AGE", help="in its place, the smallest age at which the "
                        "expert acts")  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="ZIP", help="where to save the agent with its new settings"
    )
    parser.add_argument("--compact", action="store_true", help="write weights as float16, and no optimizers")
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix != ".zip" and not args.output.is_dir():
        args.output = Path(f"{args.output}.zip")  # as SB3 names agents
    given = {name: getattr(args, name) for name in SAMPLING_SETTINGS if getattr(args, name) is not None}
    settings: dict[str, Any] = {name: None if value == "none" else value for name, value in given.items()}
    expert_ages = args.expert_up_to, args.expert_from
    sets_answer = args.answer is not None or expert_ages != (None, None)
    is_changed = bool(settings) or sets_answer
    with explained(parser):
        if is_changed and args.output is None:
            raise ValueError("-o is missing: name the file of the agent with its new settings.")
        if args.output is not None and not (is_changed or args.compact):
            raise ValueError("-o saves an agent with new settings, and none is given: add --temperature, for instance.")
        if args.compact and args.output is None:
            raise ValueError("-o is missing: name the file of the compact agent.")
        model = load_said(args.agent)
        model.set_planner(**settings)
        if sets_answer:
            let_answer(model, args.answer or model.policy.who_answers, *expert_ages)
        if args.output is not None:
            check_target(args.output)
        show(model, settings, sets_answer)
        if args.output is not None:
            hand_on(model, args.agent, args.output, args.compact)


def show(model: SAID, settings: dict[str, Any], sets_answer: bool) -> None:
    """Print how an agent decides, and who answers in it.

    :param settings: those that are new
    :param sets_answer: whether who answers is new
    """
    config = model.policy.planner.config
    for name in SAMPLING_SETTINGS:
        print(f"{name:14} {getattr(config, name)}" + "  (new)" * (name in settings))
    if config.decided_by == "actor":
        print(
            "The expert acts on the guessed present, and nothing is planned: the settings above present change nothing."
        )
    elif config.temperature == 0:
        print("At temperature 0 there is one candidate: n_candidates, scored_states and choice_factor change nothing.")
    if not model.policy.planner_is_trained:
        print("The planner of this agent is not trained yet.")
    who, ages = model.policy.who_answers, written_ages([*model.policy.expert_ages])
    print(f"{'answers':14} {who}{f': the expert at ages {ages}' * (who == 'both')}{'  (new)' * sets_answer}")


def let_answer(model: SAID, who: Answer, up_to: int | None, since: int | None) -> None:
    """Set who answers; with ``both``, expert and planner answer at ages of their own.

    :raises ValueError: for ``both`` without an age, or an age without ``both``
    """
    if (who == "both") != (up_to is not None or since is not None):
        raise ValueError("--answer both and --expert-up-to or --expert-from need each other.")
    model.set_answer(who, up_to, since)


def check_target(path: Path) -> None:
    """Refuse a target that cannot be written, or holds something else than a SAID agent, such as a checkpoint.

    :raises ValueError: for such a target
    """
    check_writable(path)
    if path.is_file():
        try:
            kind = load_metadata(path)["kind"]
        except SavedFileError:
            kind = None
        if kind != SAID.__name__:
            raise ValueError(f"{path} is no agent of SAID, and would be replaced: give another -o.")


def hand_on(model: SAID, agent: Path, output: Path, compact: bool) -> None:
    """Save an agent with what belongs to it. Print what its run changes in the task, which the file does not keep.

    :param agent: the run's folder or the file that it was opened from
    :param output: where to save it
    """
    model.save(output, compact=compact)
    print(f"Wrote {output}")
    keep_normalization(agent, output)
    record = find_agent(agent)[1]
    changed = {} if record is None else changes(record.env_kwargs, record.wrappers)
    if changed and find_agent(output)[1] != record:
        print(
            f"Its run changes the task beside its delay, which the file does not keep: {changed}. It plays right in "
            "its run's folder, or in an environment of yours with these."
        )


def keep_normalization(agent: Path, output: Path) -> None:
    """Copy the statistics of ``VecNormalize``, if the run has any, beside its new file. Leave no others there."""
    found, target = find_normalization(*find_agent(agent)), normalization_file(output)
    if found is None and target.exists():
        target.unlink()
        print(f"Removed {target}, which belonged to another agent of that name")
    elif found is not None and not (target.exists() and target.samefile(found)):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found, target)
        print(f"Wrote {target}, which belongs to it: what VecNormalize learned of its observations")


def number_or_none(word: str) -> float | str:
    """Return the number that a word is, or the word ``none``."""
    try:
        return word if word == "none" else float(word)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"a number, or none, got {word}") from error


def load_said(path: Path) -> SAID:
    """Open an agent without making its task.

    :raises ValueError: when it is not a SAID agent
    """
    file, record = find_agent(path)
    algo = "said" if record is None else record.algo
    if algo != "said":
        raise ValueError(f"{path} is a run of '{algo}', which has no planner; give one of --algo said.")
    return SAID.load(file, device="cpu")
