"""What the command lines share: parsers, options, delays and error messages."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th

from sb3_said.delays.text import age_range, make_process

#: A delay as YAML has it: control steps, [low, high], or a process as text; None for a task without the wrapper.
Delay = int | list[int] | str | None

DELAY_HELP = (
    "age of the observations in control steps; with LOW HIGH, each episode draws one between them; or a process of "
    "docs/delays.md in quotes, such as 'DroppedPackets(4, p=0.1)'"
)

TRUST = "Opening a run runs no code from its files, but imports the installed packages that its run.json names."


def make_parser(description: str | None, epilog: str, **kwargs: Any) -> argparse.ArgumentParser:
    """Return a parser that shows an epilog as it is written."""
    return argparse.ArgumentParser(
        description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs
    )


def add_delay(parser: argparse.ArgumentParser, default: str, name: str = "--delay", help: str = DELAY_HELP) -> None:
    """Give a command line an option of a delay, to be read by ``read_delay``.

    :param default: what leaving it out means
    """
    parser.add_argument(name, nargs="+", default=[], metavar="STEPS", help=f"{help} (default: {default})")


def add_playing(parser: argparse.ArgumentParser, episodes: int | None, seed: int = 10_000) -> None:
    """Give a command line the options of how trained agents play; ``--episodes`` only where it has a default."""
    parser.add_argument("--algo", help="algorithm of a .zip without its run folder")
    parser.add_argument("--env", help="task to play (default: the trained one)")
    if episodes is not None:
        parser.add_argument(
            "--episodes", type=int, default=episodes, help=f"whole episodes to play (default: {episodes})"
        )
    parser.add_argument(
        "--seed", type=reset_seed, default=seed, help=f"reset seed of the first episode (default: {seed})"
    )
    parser.add_argument("--device", type=device, default="auto", help="torch device (default: auto)")
    parser.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import that "
                        "register the task, beside those that its run remembers")  # fmt: skip
    parser.add_argument("--num-threads", type=int, default=1, help="torch threads: one decision is too small for "
                        "several, which wait for each other on a busy machine (default: 1)")  # fmt: skip


def add_run(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Give a command line the options of one agent and how it plays."""
    parser.add_argument("run", metavar="RUN_OR_ZIP", help="run folder of a training, or an agent's .zip")
    add_delay(parser, default="the trained one; of a .zip without its run folder the largest that it was built for")
    add_playing(parser, episodes)
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the best")


def reset_seed(word: str) -> int:
    """Return a seed that Gymnasium takes."""
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"a reset seed is a whole number, 0 or more, got {word}")
    return int(word)


def device(word: str) -> str:
    """Return the name of a device that torch has here, or ``auto``."""
    try:
        if word != "auto":
            th.zeros(1, device=word)
    except (RuntimeError, AssertionError, ImportError) as error:  # each backend raises its own
        told = str(error).partition("\n")[0]
        raise argparse.ArgumentTypeError(f"auto, cpu, cuda or another that torch has, got {word}: {told}") from error
    return word


def check_positive(args: argparse.Namespace, *names: str) -> None:
    """
    :raises ValueError: for an option below 1
    """
    for name in names:
        value = getattr(args, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {value}.")


@contextmanager
def explained(parser: argparse.ArgumentParser, goes_on: bool = False) -> Iterator[None]:
    """Turn errors that a user can mend into a message without a traceback.

    :param goes_on: whether the same command, given again, goes on where it was interrupted
    """
    try:
        yield
    except gym.error.UnregisteredEnv as error:
        parser.error(f"{told(error)} A package that registers a task is named with --gym-packages.")
    except (ValueError, gym.error.Error) as error:
        parser.error(told(error))
    except (ImportError, OSError) as error:
        parser.exit(1, f"{told(error)}\n")
    except KeyboardInterrupt:
        parser.exit(130, "\nInterrupted." + " Give the same command again to go on." * goes_on + "\n")


@contextmanager
def ending_training(*errors: type[Exception]) -> Iterator[None]:
    """End the program with the message of an error that a user can mend, once the options are read.

    :param errors: of these kinds; all others are raised
    """
    try:
        yield
    except errors as error:
        sys.exit(f"sb3-said train: error: {told(error)}")


STANDARD, OURS = Path(traceback.__file__).parent, Path(__file__).parents[1]
INSTALLED = {"site-packages", "dist-packages"}  # names of folders of packages


def told(error: BaseException) -> str:
    """Return an error's message, with file and line if it arose in a task, a wrapper or a module of the user's own.

    :param error: caught around a call; code in the folder of that call is not the user's
    """
    catching = {Path(frame.filename).parent for frame in traceback.extract_tb(error.__traceback__)[:2]}
    cause: BaseException | None = error
    place = ""
    while cause is not None:
        for frame in traceback.extract_tb(cause.__traceback__):
            folders = Path(frame.filename).parents
            is_known = {STANDARD, OURS, *catching} & {*folders} or INSTALLED & {folder.name for folder in folders}
            if not is_known and Path(frame.filename).is_file():
                place = f" (in {frame.filename}, line {frame.lineno})"
        cause = cause.__cause__
    return f"{error}{place}"


#: What code in a setting may raise, beside ``ValueError`` and ``TypeError``.
CODE_ERRORS = (ArithmeticError, AttributeError, LookupError, NameError, RuntimeError, SyntaxError)


@contextmanager
def reading_settings(what: str = "A setting", expected: str = "") -> Iterator[None]:
    """
    :param what: what is read, for the error
    :param expected: end of its message
    :raises ValueError: for settings whose code fails, or names something that does not exist
    """
    try:
        yield
    except CODE_ERRORS as error:
        raise ValueError(f"{what} cannot be read: {error!r}{expected}") from error


def read_delay(words: list[str]) -> Delay:
    """Return the words of ``--delay`` in the form that YAML and the wrapper take.

    :raises ValueError: for anything but N, LOW HIGH or one process
    """
    if not words:
        return None
    numbers = [int(word) for word in words if word.removeprefix("-").isdecimal()]
    if len(words) > 1 and (len(words), len(numbers)) != (2, 2):
        raise ValueError(f"--delay takes N, or LOW HIGH, or one process in quotes, got {' '.join(words)}.")
    delay: int | list[int] | str = numbers if len(words) == 2 else numbers[0] if numbers else words[0]
    make_process(delay)
    return delay


def largest_delay(delay: Delay) -> int:
    """Return the largest age that a delay can bring, 0 without a delay."""
    return 0 if delay is None else make_process(delay).max_delay


def ages_under(delay: Delay) -> list[int]:
    """Return the ages that a delay can bring after the start of an episode, [0] without a delay."""
    low, high = age_range(0 if delay is None else delay)
    return [*range(low, high + 1)]
