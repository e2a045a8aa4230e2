"""Train SAID or one of its baselines on a delayed task, with rl_zoo3's command line."""

from __future__ import annotations

import argparse
import os
import secrets
import shlex
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rl_zoo3.train

from sb3_said.offline import OfflineAlgorithm
from sb3_said.offline.datasets import is_file
from sb3_said.zoo.algorithms import ALGORITHMS, ALGOS
from sb3_said.zoo.arguments import (
    CODE_ERRORS,
    Delay,
    add_delay,
    check_positive,
    device,
    explained,
    make_parser,
    read_delay,
    told,
)
from sb3_said.zoo.experiment import Run
from sb3_said.zoo.folder import TUNED_SETTINGS
from sb3_said.zoo.manager import DelayedExperimentManager
from sb3_said.zoo.offline import OfflineExperimentManager
from sb3_said.zoo.presets import PRESETS
from sb3_said.zoo.record import ENDED_NAME, TO_IMPORT, Record

EXAMPLES = """
examples:
  sb3-said train --algo said --env Hopper-v5 --delay 4 --seed 1
  sb3-said train --algo said --env Ant-v5 --delay 8 --preset paper --seed 1
  sb3-said train --algo sadr --env HalfCheetah-v5 --delay 0 8 -n 300000 -P
  sb3-said train --algo said --env Hopper-v5 --delay "DroppedPackets(UniformDelay(0, 8), p=0.1)"
  sb3-said train --algo said --env Hopper-v5 --delay 0 16 --expert-delay 0
  sb3-said train --resume logs/said/Hopper-v5-delay4-seed1_1

  # from logs, without an environment's steps; -n counts gradient steps, and evaluations alone play episodes
  sb3-said train --algo said --env Hopper-v5 --delay 0 16 --dataset mujoco/hopper/medium-v0 -n 100000
  sb3-said train --algo bc --env Hopper-v5 --delay 4 --dataset mine.npz yours.hdf5

Runs go to LOG_FOLDER/ALGO/ENV-delayN-seedS_K (-f sets LOG_FOLDER); sb3-said evaluate and sb3-said enjoy take that
folder. Ctrl-C, SIGTERM and SIGHUP write a checkpoint before they end the training; --resume goes on from there.
Below: the options of rl_zoo3. -optimize is for sac, sa, dr, sadr and stable, --save-replay-buffer not for logs.
"""

TYPED = "<string>"  # the file that code comes from which eval was given
TEXT = "A VALUE is Python, so that text has quotes of its own: -params \"policy:'MlpPolicy'\"."


def budget(word: str) -> int:
    """Return the number of steps, or rl_zoo3's -1, which leaves it to the preset."""
    if (not word.isdecimal() and word != "-1") or word.strip("0") == "":
        raise argparse.ArgumentTypeError(f"steps are a whole number, at least 1; -1 takes the preset's, got {word}")
    return int(word)


#: Options of rl_zoo3 that are read here first: paths, so that a resume finds them from anywhere, and values that
#: rl_zoo3 would misread.
PASSED_ON: dict[tuple[str, ...], Callable[[str], Any]] = {
    ("-i", "--trained-agent"): os.path.abspath,
    ("-tb", "--tensorboard-log"): lambda word: word and os.path.abspath(word),  # "" is none; a resume finds the others
    ("-n", "--n-timesteps"): budget,
    ("--device",): device,
}


def own_parser() -> argparse.ArgumentParser:
    """Return the parser of the options that rl_zoo3 does not have, or that mean more here."""
    parser = make_parser(__doc__, EXAMPLES, add_help=False)
    parser.add_argument("-h", "--help", action="store_true", help="show this help, then that of rl_zoo3")
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="default: said")
    parser.add_argument("--env", help="task, of continuous actions, or MODULE:TASK, which MODULE registers (default: "
                        "Pendulum-v1)")  # fmt: skip
    add_delay(parser, default="no delay")
    add_delay(
        parser,
        "that of --delay",
        "--expert-delay",
        "delay that SAID's expert learns under; the planner serves --delay, and no trial is played, as that would be "
        "under the expert's",
    )
    parser.add_argument("--dataset", nargs="+", default=[], metavar="ID_OR_FILE", help="logs to learn from instead of "
                        "an environment, with --algo said, bc or dql: ids of Minari datasets, D4RL's .hdf5 files, .npz "
                        "files; -n then counts gradient steps")  # fmt: skip
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        help="cpu: hours on one core; paper: the paper's table, 5 M steps and 1 M updates, with one planner for all "
        "delays where --delay varies; quick, smoke: minutes (default: cpu)",
    )
    parser.add_argument("--seed", type=int, help="of everything drawn; part of the folder's name (default: drawn)")
    parser.add_argument(
        "--num-threads", type=int, metavar="N", help="torch threads; two are a quarter faster on an idle machine, and "
        "thirty times slower beside one other process; -1 leaves it to torch (default: 1)",
    )  # fmt: skip
    parser.add_argument(
        "--checkpoint-freq", type=int, metavar="N", help="steps between checkpoints (default: by time, every ten "
        "minutes, and less often the larger the replay is)",
    )  # fmt: skip
    parser.add_argument("--resume", type=Path, metavar="RUN_DIR", help="go on with a run from its last checkpoint")
    for names, kind in PASSED_ON.items():
        parser.add_argument(*names, type=kind, help=argparse.SUPPRESS)
    return parser


def main(argv: list[str] | None = None) -> None:
    """Train as the command line says; exit with 130 when a signal has ended it."""
    parser = own_parser()
    argv = sys.argv[1:] if argv is None else argv
    with explained(parser):
        run, algo, zoo_argv = read_command_line(argv)
    is_alone = len([word for word in argv if word not in ("-P", "--progress")]) <= 2  # --resume RUN_DIR
    if run.resume is not None and is_alone and (run.resume / ENDED_NAME).is_file():
        play = shlex.join(["sb3-said", "evaluate", str(run.resume)])
        print(f"{run.resume} has ended, and nothing is left to do. {play} plays its agent.")
        if algo == "said" and run.dataset:
            print("For more updates of a planner from logs start a new run: its learning rate falls over all of them.")
        else:
            print("With -n and more steps than it had, --resume trains it for longer.")
        return
    if "--help" in zoo_argv:
        parser.print_help()
    made: list[DelayedExperimentManager] = []

    def make_manager(*args: Any, **kwargs: Any) -> DelayedExperimentManager:
        with explained(parser):
            manager = OfflineExperimentManager if run.dataset else DelayedExperimentManager
            made.append(manager(run, *args, **kwargs))
        return made[0]

    rl_zoo3.train.ExperimentManager = make_manager  # type: ignore[misc,assignment]
    rl_zoo3.train.ALGOS = {name: ALGOS[name] for name in ALGORITHMS}  # what its help lists
    sys.argv = [sys.argv[0], "--algo", algo, *zoo_argv]
    try:
        rl_zoo3.train.train()
    except (AssertionError, ImportError, ValueError, *CODE_ERRORS) as error:
        if made:
            raise
        mend = f": {TO_IMPORT}" * isinstance(error, ImportError)
        mend += f". {TEXT}" * is_of_an_option(error)
        parser.error(f"{told(error)}{mend}")  # from the options that rl_zoo3 reads or evaluates
    except KeyboardInterrupt:  # before or after the training, which handles it itself
        parser.exit(130, "\nInterrupted.\n")
    finally:
        for manager in made:
            manager.release()
    if made and made[0].stopping.is_asked:
        sys.exit(130)


def is_of_an_option(error: Exception) -> bool:
    """Tell whether a value on the command line is not the Python that rl_zoo3 takes it for."""
    if isinstance(error, SyntaxError):
        return error.filename == TYPED
    return isinstance(error, NameError) and traceback.extract_tb(error.__traceback__)[-1].filename == TYPED


def read_command_line(argv: list[str]) -> tuple[Run, str, list[str]]:
    """Return what the command line adds to rl_zoo3's, the algorithm, and what is left for rl_zoo3.

    :param argv: with ``--resume``, only what changes in the command line that started the run
    :raises ValueError: for a folder without a run, a bad delay, an expert's delay without a planner, a dataset that the
        algorithm does not learn from or lacks, or a resume of another task
    """
    options, zoo_argv = own_parser().parse_known_args(argv)
    zoo_argv = [*zoo_argv, *(["--help"] if options.help else [])]
    for name in (names[-1] for names in PASSED_ON):
        value = getattr(options, name[2:].replace("-", "_"))
        zoo_argv += [] if value is None else [f"{name}={value}"]
    if options.num_threads != -1:
        check_positive(options, "num_threads")
    if options.num_threads is not None or options.resume is None:  # else the run's own number holds
        zoo_argv.append(f"--num-threads={1 if options.num_threads is None else options.num_threads}")
    delay, expert_delay = read_delay(options.delay), read_delay(options.expert_delay)
    check_positive(options, "checkpoint_freq")
    if options.resume is not None:
        record = Record.read(options.resume)
        if (settings := options.resume / TUNED_SETTINGS).is_file():
            use = shlex.join(["-conf", str(settings)])
            raise ValueError(f"{options.resume} is what sb3-said tune found, and no training: give {use}.")
        fixed = {"--algo": options.algo, "--delay": delay, "--expert-delay": expert_delay, "--preset": options.preset}
        fixed |= {"--seed": options.seed, "--env": options.env, "--dataset": options.dataset or None}
        fixed |= of_the_start(zoo_argv)
        if given := [name for name, value in fixed.items() if value is not None]:
            raise ValueError(f"--resume goes on with the run's own {', '.join(given)}: leave them out.")
        freq = record.checkpoint_freq if options.checkpoint_freq is None else options.checkpoint_freq
        run = Run(record.delay, record.preset, freq, options.resume, record.expert_delay, record, record.dataset)
        return run, record.algo, joined_settings([*record.command_line(), *zoo_argv])
    algo = options.algo or "said"
    if expert_delay is not None and (algo != "said" or delay is None):
        raise ValueError("--expert-delay needs --algo said and a --delay: an agent without a planner is its expert.")
    check_dataset(algo, options.dataset, expert_delay)
    # Four digits are short enough for the folder's name. Evaluation and tuning take reset seeds from 10,000 on.
    seed = secrets.randbelow(10_000) if options.seed is None or options.seed < 0 else options.seed
    dataset = [os.path.abspath(source) if is_file(source) else source for source in options.dataset]
    run = Run(delay, options.preset or "cpu", options.checkpoint_freq, None, expert_delay, None, dataset)
    module, _, env = (options.env or "Pendulum-v1").rpartition(":")  # MODULE:TASK, where MODULE registers the task
    packages = ["--gym-packages", module] if module else []
    return run, algo, joined_settings([f"--env={env}", f"--seed={seed}", *zoo_argv, *packages])


def of_the_start(argv: list[str]) -> dict[str, Any]:
    """Return those of rl_zoo3's options that have no effect once a run has begun, with what they were given."""
    parser = argparse.ArgumentParser(add_help=False)
    options = (("-conf", "--conf-file"), ("-f", "--log-folder"), ("-i", "--trained-agent"))
    for names in (*options, ("--storage",), ("--study-name",), ("--trial-id",)):
        parser.add_argument(*names, dest=names[-1])
    parser.add_argument("-uuid", "--uuid", dest="--uuid", action="store_const", const=True)
    return vars(parser.parse_known_args(argv)[0])


def check_dataset(algo: str, dataset: list[str], expert_delay: Delay) -> None:
    """
    :raises ValueError: unless the algorithm learns from what it was given, logs or an environment
    """
    learners = [name for name, (cls, _) in ALGORITHMS.items() if issubclass(cls, OfflineAlgorithm)]
    if dataset and algo not in learners:
        raise ValueError(f"--dataset is for --algo {', '.join(learners)}: {algo} learns from its own steps.")
    if not dataset and algo in learners and algo != "said":
        raise ValueError(f"--algo {algo} learns from logs: name them with --dataset. sb3-said collect makes some.")
    if dataset and expert_delay is not None:
        raise ValueError("--expert-delay has no effect with --dataset, from which no expert is trained: leave it out.")
    if missing := [source for source in dataset if is_file(source) and not os.path.isfile(source)]:
        raise ValueError(f"--dataset names {', '.join(missing)}, which is not there.")


def joined_settings(argv: list[str]) -> list[str]:
    """Join the repeated uses of each option that takes KEY:VALUE words, and put it last.

    rl_zoo3 reads only the last use of an option, so a resume that changes one setting would drop the others. If a key
    is given twice, rl_zoo3 takes the later value.

    :raises ValueError: for a word without a colon, and an option without a word
    """
    # "--env" is not short for "--env-kwargs"
    settings = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for names in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",), ("--gym-packages",)):
        settings.add_argument(*names, dest=names[0], nargs="+", action="extend", default=[])
    try:
        given, rest = settings.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise ValueError(str(error)) from error
    pairs = [(name, word) for name, words in vars(given).items() if name != "--gym-packages" for word in words]
    for name, word in pairs:
        if ":" not in word:
            raise ValueError(f"{name} takes NAME:VALUE, got {word!r}. {TEXT}")
    return [*rest, *(word for name, words in vars(given).items() if words for word in (name, *words))]
