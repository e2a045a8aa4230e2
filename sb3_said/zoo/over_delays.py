"""Play trained agents under several delays, and report return over delay."""

from __future__ import annotations

import argparse
import itertools
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th

from sb3_said.delays import FixedDelay
from sb3_said.delays.text import age_range, make_process
from sb3_said.evaluation import plots
from sb3_said.files.atomic import check_writable
from sb3_said.zoo.arguments import TRUST, add_playing, check_positive, explained, make_parser, read_delay
from sb3_said.zoo.cells import AGE, Cell, Results
from sb3_said.zoo.playing import at_any_age, digest_of, play_all
from sb3_said.zoo.runs import ANSWERS, LoadedRun, answers, delay_name, load_run, longest_delay, origin
from sb3_said.zoo.tables import make_table, print_manners, print_scores, print_seeds, print_table, unpaired

EPILOG = f"""\
examples:
  # an agent trained for all delays beside one trained for a single delay: a table, the numbers, a plot
  sb3-said over-delays any=logs/said/Hopper-v5-delay0-16-seed1_1 d8=logs/sadr/Hopper-v5-delay8-seed1_1 --workers 2 \\
      --delays 0 2 4 8 12 16 "UniformDelay(0, 8)" WIFI_20MS --json hopper.json --plot hopper.png

  # training seeds of one setting share a label: they are one row, with intervals over the seeds
  sb3-said over-delays d4=logs/said/Hopper-v5-delay4-seed1_1 d4=logs/said/Hopper-v5-delay4-seed2_1 \\
      d4=logs/said/Hopper-v5-delay4-seed3_1 --delays 0 2 4 --json seeds.json

  # runs of several delays that share a label are one row, too: each plays the delay that it was trained under
  sb3-said over-delays any=logs/said/Hopper-v5-delay0-16-seed1_1 each=logs/said/Hopper-v5-delay0-seed1_1 \\
      each=logs/said/Hopper-v5-delay4-seed1_1 each=logs/said/Hopper-v5-delay16-seed1_1 --delays 0 4 16 \\
      --json hopper.json

  # some rows and delays again, under names for readers; without runs nothing is played
  sb3-said over-delays --json hopper.json --rows "any planner=one agent" "each planner=an agent for each delay" \\
      --delays 0 4 16 --plot hopper.png

A delay longer than an agent was built for leaves an empty cell. One that it was not trained with is played, without a
warning. Episode i starts from reset seed --seed + i in every cell. A row of one agent has intervals over these starts,
a row of several training seeds over the seeds: by BCa bootstrap, or by Student's t where there are fewer than 10.
A call plays only the cells that --json lacks, so the same command goes on after a stop. An agent whose file has changed
is played again. The file keeps the cells of other agents and delays, and several calls may add to it at a time.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("runs", nargs="*", metavar="[LABEL=]RUN_OR_ZIP", help="run folders, or agents' .zip files; "
                        "without any, the contents of --json are shown")  # fmt: skip
    parser.add_argument("--delays", nargs="+", metavar="DELAY", help="each a number of control steps, or a process of "
                        "docs/delays.md in quotes, such as 'DroppedPackets(4, p=0.1)'")  # fmt: skip
    parser.add_argument("--age-errors", type=int, nargs="+", default=[], metavar="STEPS", help="play each delay also "
                        "with the age told wrong by so many steps, such as -2 -1 1 2")  # fmt: skip
    parser.add_argument("--answer", choices=ANSWERS, help="who acts in SAID agents (default: "
                        "everyone who can, each as a row)")  # fmt: skip
    parser.add_argument("--json", type=Path, required=True, help="file of the numbers, read and written")
    parser.add_argument("--plot", type=Path, help="draw return over delay to this .png or .pdf")
    parser.add_argument("--rows", nargs="+", metavar="ROW[=NAME]", help="rows of table and plot, in this order: "
                        "each a label, with who acts in a SAID agent, such as 'LABEL planner', shown as NAME "
                        "(default: all)")  # fmt: skip
    add_playing(parser, episodes=50)
    parser.add_argument("--n-envs", type=int, default=8, help="episodes played side by side (default: 8)")
    parser.add_argument("--workers", type=int, default=1, help="cells played at once, in processes (default: 1)")
    args = parser.parse_args(argv)
    with explained(parser, goes_on=True):
        check_positive(args, "episodes", "n_envs", "workers", "num_threads")
        th.set_num_threads(args.num_threads)
        if args.plot is not None:
            plots.check_file(args.plot)  # refuse now what cannot be drawn, not after the episodes
            check_writable(args.plot)
        # By process: one that is written in two ways is played once and has one column
        named: dict[str, int | str] = {}
        for name in map(read_name, args.delays or ()):
            named.setdefault(repr(make_process(name)), name)
        delays = list(named.values())
        playing = "algo", "env", "episodes", "seed", "device", "gym_packages", "n_envs", "workers"
        unused = [name.replace("_", "-") for name in playing if getattr(args, name) != parser.get_default(name)]
        if unused and not args.runs:
            raise ValueError(f"--{', --'.join(unused)}: without runs to play this has no effect; leave it out.")
        shown = play_missing(args, delays) if args.runs else known_cells(args, delays)
        shown = [replace(cell, delay=named.setdefault(repr(make_process(cell.delay)), cell.delay)) for cell in shown]
        rows = choose_rows(args.rows, shown)
        show(shown, rows, delays, Results(args.json).settings, args.plot)


def show(
    cells: list[Cell], rows: dict[str, str], delays: list[int | str], settings: dict[str, Any], plot: Path | None
) -> None:
    """Print the tables of cells that were played, and draw them.

    :param rows: agents, each with the name that the table shows
    :param delays: in the order of the columns; by default that of the cells
    :param settings: what all cells have in common
    :param plot: where to draw to
    """
    table = make_table(cells, rows)
    order = delays or list(dict.fromkeys(cell.delay for cell in cells))
    in_order = sorted(cells, key=lambda cell: (cell.age_error != 0, order.index(cell.delay), cell.age_error))
    columns = list(dict.fromkeys(cell.column for cell in in_order))
    others = unpaired(cells, rows)
    print_table(table, columns, others)
    print_seeds(cells, rows)
    changed = {rows[cell.agent] for cell in cells if cell.is_changed and cell.agent in rows}
    print_scores({row: x for row, x in table.items() if row not in changed}, columns, settings["env"], others)
    print_manners(cells, rows)
    if plot is not None and not any(table.values()):
        print(f"Nothing was played that {plot} could show.")
    elif plot is not None:
        title = f"{settings['env']} under delay: means of {settings['n_episodes']} episodes, 95 % intervals"
        told_right = {row: {c: x for c, x in of_row.items() if AGE not in str(c)} for row, of_row in table.items()}
        plots.save(plots.plot_over_delays(told_right, title)[0], plot)
        print(f"Wrote {plot}")


def read_name(word: str) -> int | str:
    """Return the number of a fixed delay, and another process as it is written.

    :raises ValueError: for a word that is no delay
    """
    delay = read_delay([word])
    assert delay is not None  # for mypy: there is a word
    process = make_process(delay)
    return process.delay if isinstance(process, FixedDelay) else word


def choose_rows(words: list[str] | None, cells: list[Cell]) -> dict[str, str]:
    """Return the rows of the table, all by default, each with the name that the table shows.

    :param words: each a row, or ROW=NAME
    :raises ValueError: for a row that does not exist, and for a name given twice
    """
    known = list(dict.fromkeys(cell.agent for cell in cells))
    pairs = [(word, "=", word) if word in known else word.partition("=") for word in words or known]
    rows = {row: name or row for row, _, name in pairs}
    if unknown := [row for row in rows if row not in known]:
        raise ValueError(f"--rows names {', '.join(unknown)}, but the rows are {', '.join(known)}.")
    if len(set(rows.values())) < len(pairs):
        raise ValueError(f"--rows names a row twice, or two rows alike: {', '.join(words or known)}.")
    return rows


def known_cells(args: argparse.Namespace, delays: list[int | str]) -> list[Cell]:
    """Return those cells of a file that the command line asks for, all by default.

    :param delays: those of interest, in this order, however the file writes them
    :raises ValueError: without the file, or when it holds nothing of these delays
    """
    results = Results(args.json)
    print_settings(results.settings)
    cells = [
        cell
        for cell in results.cells
        if (not args.answer or cell.answer in (None, args.answer))
        and (not args.age_errors or cell.age_error in (0, *args.age_errors))
    ]
    if delays:
        pairs = [(delay, cell) for delay in delays for cell in cells]
        same = [(delay, cell) for delay, cell in pairs if make_process(cell.delay) == make_process(delay)]
        cells = [replace(cell, delay=delay) for delay, cell in same]
    if not cells:
        asked = f" of the delays {delays}" if delays else " of what is asked for" if results.cells else ""
        raise ValueError(f"{args.json} holds nothing{asked}: name runs to play.")
    return cells


def play_missing(args: argparse.Namespace, delays: list[int | str]) -> list[Cell]:
    """Play the cells of the command line that are not known yet, and write each as it is done.

    :return: all cells of the command line
    :raises ValueError: for runs that cannot be opened or compared, without a delay, and where nobody can play
    """
    if not delays:
        raise ValueError("--delays is missing: name the delays that the runs are to play.")
    check_writable(args.json)
    runs = open_runs(args)
    first = next(iter(runs.values()))[0]
    settings = {"env": first.info["env"], "n_episodes": args.episodes, "seed": args.seed, "deterministic": True}
    results = Results(args.json, settings)
    errors = [0, *(error for error in dict.fromkeys(args.age_errors) if error)]
    cells = [
        cell
        for error in errors
        for label, row in runs.items()
        for cell in cells_of(label, row, delays, args.answer, error)
    ]
    idle = [*not_playing(runs, delays, args.answer)]
    if not cells:
        raise ValueError(f"There is nothing to play: {'; '.join(idle)}.")
    if args.answer and all(answers(run.model) == [None] for row in runs.values() for run in row):
        raise ValueError(f"--answer {args.answer} has no effect, as no run is of SAID: leave it out.")
    for row, n in Counter(row for row, _ in {(cell.agent, cell.lineage[1]) for cell in cells}).items():
        if n > 1:
            raise ValueError(f"Agents of two labels would both be the row {row!r}: give one another label.")
    choose_rows(args.rows, cells)
    for (file, label), n in Counter(cell.lineage for cell in results.ask(cells)).items():
        print(f"{n} results of {label} are dropped: {file} has changed since.")
    todo = [cell for cell in cells if cell.result is None and cell.obstacle is None]
    print_settings(settings)
    print(*(f"Left out: {reason}.\n" for reason in idle), sep="", end="")
    for cell in cells:
        if cell.obstacle is not None:
            print(f"{cell.agent} cannot play delay {cell.column}: {cell.obstacle}.")
    print(f"{len(todo)} of {len(cells)} cells to play")
    made = origin(first)
    with closing(play_all(todo, settings["env"], args)) as played:
        for done, (cell, summary) in enumerate(played, 1):
            result = summary.to_dict()
            del result["label"]  # another call may give the agent another label
            results.add(cell, result, made)
            print(f"{done}/{len(todo)} {cell.agent}, delay {cell.column}: {summary.mean_return}", flush=True)
    results.write()
    print(f"Wrote {args.json}")
    return cells


def print_settings(settings: dict[str, Any]) -> None:
    """Print what all cells have in common."""
    n, seed = settings["n_episodes"], settings["seed"]
    print(f"{settings['env']}, {n} episodes a cell, reset seeds {seed}..{seed + n - 1}")


def open_runs(args: argparse.Namespace) -> dict[str, list[LoadedRun]]:
    """Return what each label names: one run, training seeds of one delay, or runs of several delays.

    :raises ValueError: for what cannot be opened, an agent that stands twice under a label, or runs of several tasks
    """
    runs: dict[str, list[LoadedRun]] = {}
    for text in args.runs:
        given, path = re.fullmatch(r"(?:([^=/]+)=)?(.*)", text, re.DOTALL).groups()  # type: ignore[union-attr]  # fits all
        if given and Path(text).exists():  # a path with "=", such as lr=0.1
            given, path = None, text
        label = given or "/".join(Path(path).absolute().parts[-2:]).removesuffix(".zip")
        with at_any_age():
            run = load_run(path, args.algo, args.env, None, args.device, gym_packages=args.gym_packages)
        row = runs.setdefault(label, [])
        if any(digest_of(run) == digest_of(other) for other in row):
            raise ValueError(
                f"The label {label} has the agent {run.info['file']} twice: give it other training seeds of the same "
                f"setting, or give each run its own label, as in {shlex.quote(f'LABEL={path}')}."
            )
        if row and not given:
            raise ValueError(
                f"{path} and {row[0].info['file']} would both be called {label}: give each its own label, as in "
                f"{shlex.quote(f'LABEL={path}')}, or one label to training seeds of one setting."
            )
        row.append(run)
    tasks = sorted({run.info["env"] for row in runs.values() for run in row})
    if len(tasks) > 1:
        raise ValueError(f"Returns of several tasks cannot be compared: {tasks}. Give runs of one task, or --env.")
    settings = {label: [run.setting for run in row] for label, row in runs.items()}
    for label, given in settings.items():
        if len(set(given)) > 1:
            raise ValueError(
                f"The runs of {label} change their task in different ways, {', '.join(given)}, so they are no training "
                "seeds of one setting: give each its own label."
            )
    if len({given for row in settings.values() for given in row}) > 1:
        told = "; ".join(f"{label} has {row[0]}" for label, row in settings.items())
        print(f"These are not the same task, beside the delay: {told}")
    return runs


def cells_of(
    label: str, row: list[LoadedRun], delays: list[int | str], only: str | None = None, age_error: int = 0
) -> Iterator[Cell]:
    """Make the cells of a label: for each run, everyone who can answer, under each delay.

    :param row: runs of one delay, which all play every delay; or runs of several delays, which each play their own
    :param only: who of a SAID agent is to answer; by default everyone who can
    :param age_error: control steps by which the age is told wrong
    """
    digests = [digest_of(run) for run in row]
    who = [asked_of(run, only) for run in row]
    for answer, delay in itertools.product(dict.fromkeys(itertools.chain(*who)), delays):
        for run, digest, can_answer in zip(row, digests, who, strict=True):
            if answer not in can_answer or not is_played(delay, run, row):
                continue
            yield Cell(
                agent=f"{label} {answer}" if answer else label,
                answer=answer,
                delay=delay,
                sha256=digest,
                obstacle=obstacle(run, answer, delay, age_error),
                age_error=age_error,
                is_changed=bool(run.changes),
                **{key: run.info[key] for key in ("algo", "file", "trained_steps")},
            )


def asked_of(run: LoadedRun, only: str | None) -> list[str | None]:
    """Return who can answer in an agent, of a SAID agent ``only`` that one, if it is given."""
    return [answer for answer in answers(run.model) if not (answer and only) or answer == only]


def is_played(delay: int | str, run: LoadedRun, row: list[LoadedRun]) -> bool:
    """Tell whether a run plays a delay: all of them, or its own where the runs of its label have several."""
    return len({one.info["delay"] for one in row}) == 1 or run.info["delay"] == delay_name(make_process(delay))


def not_playing(runs: dict[str, list[LoadedRun]], delays: list[int | str], only: str | None) -> Iterator[str]:
    """Say which runs play nothing, and which delays nobody plays, and why.

    :param runs: by label
    :param only: who of a SAID agent is to answer
    """
    pairs = [(run, row) for row in runs.values() for run in row if asked_of(run, only)]
    for label, row in runs.items():
        for run in row:
            if not asked_of(run, only):
                yield f"{run.info['file']}, which cannot answer as {only}"
            elif not any(is_played(delay, run, row) for delay in delays):
                others = f"other runs of {label} have another, so that each plays its own"
                yield f"{run.info['file']}, whose delay {run.info['delay']} is none of --delays; {others}"
    for delay in delays:
        if pairs and not any(is_played(delay, *pair) for pair in pairs):
            yield f"delay {delay}, which is no run's own; under a label with several delays each run plays its own"


def obstacle(run: LoadedRun, answer: str | None, delay: int | str, age_error: int = 0) -> str | None:
    """Say why an agent cannot play under a delay; None where it can.

    :param run: the agent; its task's action delay, if any, is added
    :param answer: who acts in a SAID agent
    :param age_error: control steps by which the age is told wrong
    """
    if age_error and longest_delay(run.model) is None:
        return "it reads no age, so none can be told wrong"
    if run.own_delay is not None and make_process(delay) != run.own_delay:
        return f"its task is registered with a delay of its own, {delay_name(run.own_delay)}"
    longest, policy = longest_delay(run.model) or 0, run.model.policy
    action_delay = run.changes.get("action_delay", 0)
    low, high = (sum(ends) for ends in zip(age_range(delay), age_range(action_delay), strict=True))
    if high > longest:
        added = f", and its task delays actions by {action_delay}" if action_delay else ""
        return f"it was built for delays 0..{longest}{added}"
    if answer not in (None, "expert"):
        try:
            told = {min(max(age + error, 0), longest) for age in range(low, high + 1) for error in (0, age_error)}
            policy.planner.check_ages(sorted(told))  # type: ignore[union-attr,operator]  # of SAID
        except ValueError as error:
            return str(error).removesuffix(".")
    return None
