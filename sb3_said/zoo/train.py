"""Train SAID or one of its baselines on a delayed task, with rl_zoo3's command line."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import rl_zoo3.train

from sb3_said.zoo.manager import (
    ALGORITHMS,
    PRESETS,
    DelayedExperimentManager,
    Run,
    add_delay,
    default_preset,
    read_arguments,
    read_delay,
)

EXAMPLES = """
examples:
  python scripts/train.py --algo said --env Hopper-v5 --delay 4
  python scripts/train.py --algo said --env Ant-v5 --delay 8 --preset paper --seed 1
  python scripts/train.py --algo sadr --env HalfCheetah-v5 --delay 0 8 -n 300000 -P
  python scripts/train.py --algo said --env Hopper-v5 --delay "DroppedPackets(UniformDelay(0, 8), p=0.1)"
  python scripts/train.py --algo said --env Hopper-v5 --delay 0 16 --expert-delay 0
  python scripts/train.py --resume logs/said/Hopper-v5-delay4_1

Runs go to LOG_FOLDER/ALGO/ENV-delayN_K (-f sets LOG_FOLDER); scripts/evaluate.py and scripts/enjoy.py take that folder.
Below: the options of rl_zoo3, all of which work here.
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options that rl_zoo3 does not have."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter, add_help=False
    )
    parser.add_argument("-h", "--help", action="store_true", help="show this help, then that of rl_zoo3")
    parser.add_argument("--algo", choices=list(ALGORITHMS), default="said", help="default: said")
    add_delay(parser, default="no delay")
    add_delay(
        parser, "that of --delay", "--expert-delay", "delay that SAID's expert learns under; the planner serves --delay"
    )
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        default=default_preset(),
        help="cpu: hours on two cores; paper: the paper's table, with a planner for every delay (mask='random') where "
        "--delay varies; quick, smoke: minutes (default here: %(default)s)",
    )
    parser.add_argument(
        "--checkpoint-freq",
        type=int,
        default=25_000,
        metavar="STEPS",
        help="steps between checkpoints (default: 25000)",
    )
    parser.add_argument("--resume", type=Path, metavar="RUN_DIR", help="go on with a run from its last checkpoint")
    return parser


def main(argv: list[str] | None = None) -> None:
    """Train as the command line says."""
    argv = sys.argv[1:] if argv is None else argv
    options, zoo_argv = parser().parse_known_args(argv)
    if options.help:
        parser().print_help()
    if options.resume is not None:
        argv = [*read_arguments(options.resume), *without_resume(argv)]
        resume, (options, zoo_argv) = options.resume, parser().parse_known_args(argv)
        options.resume = resume
    try:
        delay, expert_delay = read_delay(options.delay), read_delay(options.expert_delay)
    except ValueError as error:
        parser().error(str(error))
    if expert_delay is not None and (options.algo != "said" or delay is None):
        parser().error("--expert-delay is for --algo said with a --delay: who has no planner acts as it has learned")
    run = Run(argv, delay, options.preset, options.checkpoint_freq, options.resume, expert_delay)

    def make_manager(*args: Any, **kwargs: Any) -> DelayedExperimentManager:
        try:
            return DelayedExperimentManager(run, *args, **kwargs)
        except ValueError as error:
            parser().error(str(error))

    rl_zoo3.train.ExperimentManager = make_manager  # type: ignore[misc,assignment]
    zoo_argv = joined_settings(zoo_argv)
    sys.argv = [sys.argv[0], "--algo", options.algo, *zoo_argv, *(["--help"] if options.help else [])]
    rl_zoo3.train.train()


def joined_settings(argv: list[str]) -> list[str]:
    """Return a command line in which each option of KEY:VALUE words stands once, last, with the words of all its uses.

    rl_zoo3 reads only the last use, by which a resume that changes one setting would drop the others. Of one key given
    twice, rl_zoo3 takes the later value.
    """
    settings = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # "--env" is not short for "--env-kwargs"
    for names in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        settings.add_argument(*names, dest=names[0], nargs="+", action="extend", default=[])
    given, rest = settings.parse_known_args(argv)
    return [*rest, *(word for name, words in vars(given).items() if words for word in (name, *words))]


def without_resume(argv: list[str]) -> list[str]:
    """Return a command line without ``--resume RUN_DIR``."""
    kept, skip = [], False
    for word in argv:
        if not (skip or word == "--resume" or word.startswith("--resume=")):
            kept.append(word)
        skip = word == "--resume"
    return kept
