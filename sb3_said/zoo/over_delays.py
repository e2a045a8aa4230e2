"""Play trained agents under several delays, and report return over delay."""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import multiprocessing
import re
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_said.delays import FixedDelay
from sb3_said.delays.text import make_process
from sb3_said.evaluation import Summary, bootstrap_interval, plots, rollout
from sb3_said.files.atomic import write_json
from sb3_said.zoo.manager import Delay, largest_delay, read_delay
from sb3_said.zoo.runs import ANSWERS, LoadedRun, answering, answers, delay_name, load_run, longest_delay, origin

EPILOG = """\
examples:
  # one agent of all delays beside one of a single delay: a table, the numbers, a plot
  python scripts/over_delays.py logs/said/Hopper-v5-delay0-16_1 logs/sadr/Hopper-v5-delay8_1 \\
      --delays 0 2 4 8 12 16 "UniformDelay(0, 8)" WIFI_20MS "RandomWalkDelay(0, 16, move_prob=0.1)" \\
      --json hopper.json --plot hopper.png

  # the same call goes on where it was stopped; with another run or delay, only what is new is played
  python scripts/over_delays.py any=logs/said/Hopper-v5-delay0-16_1 d8=logs/sadr/Hopper-v5-delay8_1/best_model.zip \\
      --delays 0 2 4 8 12 16 20 --json hopper.json --workers 2

  # runs that share a label are one row: each plays the delay that it was trained under
  python scripts/over_delays.py any=logs/said/Hopper-v5-delay0-16_1 each=logs/said/Hopper-v5-delay0_1 \\
      each=logs/said/Hopper-v5-delay4_1 each=logs/said/Hopper-v5-delay16_1 --delays 0 4 16 --json hopper.json

  # the table and the plot once more, of some rows and delays: without runs nothing is played
  python scripts/over_delays.py --json hopper.json --rows "any planner" "each planner" --delays 0 4 16 --plot hopper.png

Of a SAID agent, the planner and the expert are played, or one of them (--answer). An agent cannot play delays that it
was not built for: such a cell stays empty. It does play delays that it was not trained with, which is the point here,
without a warning.
Episode i starts from reset seed --seed + i under every delay, so that all cells meet the same starts. An average over
delays has an interval over these starts, each with its mean over the delays.
What --json holds of the same agents (by the contents of their files) is not played again; an agent that has changed
is. Cells of other agents and delays are kept in it.
A run folder's YAML can run code (rl_zoo3 reads it so): open only folders that you trust.
"""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", metavar="[LABEL=]RUN_OR_ZIP", help="run folders, or agents' .zip files; "
                        "without any, what --json holds is shown")  # fmt: skip
    parser.add_argument("--delays", nargs="+", metavar="DELAY", help="each a number of control steps, or a process of "
                        "docs/delays.md in quotes, such as 'DroppedPackets(4, p=0.1)'")  # fmt: skip
    parser.add_argument("--answer", choices=ANSWERS, help="of SAID agents, play this one alone (default: both)")
    parser.add_argument("--json", type=Path, required=True, help="where to write the numbers, and to go on from them")
    parser.add_argument("--plot", type=Path, help="draw return over delay to this .png or .pdf")
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="rows of the table and the plot, in this order, each "
                        "a label, and 'LABEL planner' or 'LABEL expert' of a SAID agent (default: all)")  # fmt: skip
    parser.add_argument("--episodes", type=int, default=20, help="whole episodes for each cell (default: 20)")
    parser.add_argument("--seed", type=int, default=10_000, help="reset seed of the first episode (default: 10000)")
    parser.add_argument("--n-envs", type=int, default=8, help="episodes played side by side (default: 8)")
    parser.add_argument("--workers", type=int, default=1, help="cells played at once, in processes (default: 1)")
    parser.add_argument("--algo", help="algorithm of .zip files without their run folder")
    parser.add_argument("--env", help="task to play (default: the trained one)")
    parser.add_argument("--device", default="auto", help="torch device (default: auto)")
    parser.add_argument("--num-threads", type=int, default=1, help="torch threads of each worker (default: 1)")
    return parser


@dataclass(frozen=True)
class Cell:
    """One agent under one delay."""

    agent: str
    answer: str | None
    """planner or expert of a SAID agent"""
    delay: int | str
    """control steps, or a process as it was written"""
    algo: str
    file: str
    sha256: str
    """of the file"""
    trained_steps: int
    obstacle: str | None
    """why the agent cannot play this delay"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser()
    args = parser.parse_args(argv)
    if min(args.episodes, args.n_envs, args.workers, args.num_threads) < 1:
        parser.error("--episodes, --n-envs, --workers and --num-threads must be at least 1")
    th.set_num_threads(args.num_threads)
    try:
        if args.plot is not None:
            plots.panels()  # without matplotlib, fail now and not after the episodes
        delays = list(dict.fromkeys(read_name(word) for word in args.delays or ()))
        results = asked_results(args, delays) if args.runs else Results.read(args.json, delays)
        rows = choose_rows(args.rows, results.cells)
    except ValueError as error:
        parser.error(str(error))
    except ImportError as error:
        parser.exit(1, f"{error}\n")

    env_id, n_episodes, seed = (results.settings[key] for key in ("env", "n_episodes", "seed"))
    print(f"{env_id}, {n_episodes} episodes a cell, reset seeds {seed}..{seed + n_episodes - 1}")
    if args.runs:
        try:
            play_missing(results, args)
        except KeyboardInterrupt:
            parser.exit(130, "\nInterrupted; the same command goes on.\n")
        print(f"Wrote {args.json}")
    table = results.table(rows)
    print_table(table, delays or list(dict.fromkeys(cell.delay for cell in results.cells)))
    if args.plot is not None and any(table.values()):
        plots.save(plots.plot_over_delays(table)[0], args.plot)
        print(f"Wrote {args.plot}")


def read_name(word: str) -> int | str:
    """Return the number of a fixed delay, and another process as it is written.

    :raises ValueError: for no delay
    """
    delay = read_delay([word])
    assert delay is not None  # for mypy: there is a word
    process = make_process(delay)
    return process.delay if isinstance(process, FixedDelay) else word


def choose_rows(names: list[str] | None, cells: list[Cell]) -> list[str]:
    """Return the rows of the table: those asked for, or all.

    :raises ValueError: for a row that there is not
    """
    known = list(dict.fromkeys(cell.agent for cell in cells))
    if unknown := [name for name in names or () if name not in known]:
        raise ValueError(f"--rows names {', '.join(unknown)}, but the rows are {', '.join(known)}.")
    return names or known


def asked_results(args: argparse.Namespace, delays: list[int | str]) -> Results:
    """Return the results of the runs of the command line, as far as they are known.

    :raises ValueError: for runs that cannot be opened or compared, and without a delay
    """
    if not delays:
        raise ValueError("--delays is missing: name the delays that the runs are to play.")
    runs = open_runs(args)
    first = next(iter(runs.values()))[0]
    settings = {"env": first.info["env"], "n_episodes": args.episodes, "seed": args.seed, "deterministic": True}
    cells = [cell for label, row in runs.items() for cell in cells_of(label, row, delays, args.answer)]
    results = Results(args.json, settings, cells)
    if results.missing():
        results.origins.append(origin(first))
    return results


def play_missing(results: Results, args: argparse.Namespace) -> None:
    """Play the cells that are not known yet, and write each as it is done."""
    for cell in results.cells:
        if cell.obstacle is not None:
            print(f"{cell.agent} cannot play delay {cell.delay}: {cell.obstacle}.")
    todo = results.missing()
    print(f"{len(todo)} of {len(results.cells)} cells to play")
    for done, (cell, summary) in enumerate(play_all(todo, results.settings["env"], args), 1):
        results.add(cell, summary)
        print(f"{done}/{len(todo)} {cell.agent}, delay {cell.delay}: {summary.mean_return}", flush=True)
    results.write()


def open_runs(args: argparse.Namespace) -> dict[str, list[LoadedRun]]:
    """Return what each label names: one run, or one for each of several delays.

    :raises ValueError: for what cannot be opened, runs of one label and one delay, or runs of several tasks
    """
    runs: dict[str, list[LoadedRun]] = {}
    for text in args.runs:
        given, path = re.fullmatch(r"(?:([^=/]+)=)?(.*)", text, re.DOTALL).groups()  # type: ignore[union-attr]  # fits all
        label = given or "/".join(Path(path).absolute().parts[-2:]).removesuffix(".zip")
        run = open_run(path, args.algo, args.env, None, args.device)
        row = runs.setdefault(label, [])
        if any(run.info["delay"] == other.info["delay"] for other in row):
            raise ValueError(
                f"Two runs have the label {label} and the delay {run.info['delay']}: give each its own label, as in "
                f"LABEL={path}."
            )
        row.append(run)
    tasks = {label: sorted({run.info["env"] for run in row}) for label, row in runs.items()}
    if len({task for names in tasks.values() for task in names}) > 1:
        raise ValueError(f"Returns of several tasks cannot be compared: {tasks}. Give runs of one task, or --env.")
    return runs


def open_run(path: str, algo: str | None, env_id: str | None, delay: Delay, device: str) -> LoadedRun:
    """Open a run, whatever it was trained with."""
    with at_any_age():
        return load_run(path, algo, env_id, delay, device)


@contextmanager
def at_any_age() -> Iterator[None]:
    """Leave out the warning that an agent was not trained at some ages, which is what is measured here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"This \w+ learned at ages .* and is given", UserWarning)
        yield


def cells_of(label: str, row: list[LoadedRun], delays: list[int | str], only: str | None = None) -> Iterator[Cell]:
    """Make the cells of a label: each who can answer, under each delay.

    :param row: one run, which plays all delays, or several, of which each plays the delay it was trained under
    :param only: who of a SAID agent is to answer, planner or expert; both by default
    """
    files = [run.info["file"] for run in row]
    digests = {file: hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files}
    who: list[list[str | None]] = [[*answers(run.model)] or [None] for run in row]
    for answer in dict.fromkeys(itertools.chain(*who)):
        if None not in (answer, only) and answer != only:
            continue
        for delay in delays:
            for run, file, can_answer in zip(row, files, who, strict=True):
                plays = len(row) == 1 or run.info["delay"] == delay_name(make_process(delay))
                if not (plays and answer in can_answer):
                    continue
                yield Cell(
                    agent=f"{label} {answer}" if answer else label,
                    answer=answer,
                    delay=delay,
                    algo=run.info["algo"],
                    file=file,
                    sha256=digests[file],
                    trained_steps=run.info["trained_steps"],
                    obstacle=obstacle(run.model, answer, delay),
                )


def obstacle(model: Any, answer: str | None, delay: int | str) -> str | None:
    """Say why an agent cannot play under a delay; None where it can.

    :param model: an SB3 algorithm, whose policy has a planner where that answers
    """
    longest = longest_delay(model) or 0
    if largest_delay(delay) > longest:
        return f"it was built for delays 0..{longest}"
    if answer == "planner" and delay != longest and model.policy.planner.config.mask == "fixed":
        return f"its planner was trained for delay {longest} alone"
    return None


class Results:
    """What was played, in a JSON file that is whole at any time.

    :param path: of the file; what it holds of these cells is taken over, what it holds of others is kept
    :param settings: what all cells have in common
    :param cells: of the table, row by row
    :raises ValueError: for a file with other settings
    """

    def __init__(self, path: Path, settings: dict[str, Any], cells: list[Cell]):
        self.path, self.settings, self.cells = path, settings, cells
        document = {**settings, "origins": [], "cells": []}
        if path.exists():
            document = json.loads(path.read_text())
            held = {key: document.get(key) for key in settings}
            if held != settings or "cells" not in document:
                raise ValueError(f"{path} holds {held}, but {settings} is to be played: give another --json.")
        self.origins: list[dict[str, Any]] = document["origins"]
        held_cells = [(_key(entry), entry) for entry in document["cells"]]
        old = dict(held_cells)
        keys = {cell: _key(asdict(cell)) for cell in cells}
        #: JSON entries beside what the cell says: its result, and which of the origins made it
        self.found: dict[Cell, dict[str, Any]] = {}
        for cell in cells:
            entry = old.get(keys[cell])
            if cell.obstacle is not None:
                self.found[cell] = {"origin": None, "result": None}
            elif entry is not None:
                self.found[cell] = {key: entry[key] for key in ("origin", "result")}
        asked = {cell.file: cell.sha256 for cell in cells}
        taken_over = set(keys.values())
        self.others = [
            entry
            for key, entry in held_cells
            if key not in taken_over and asked.get(entry["file"], entry["sha256"]) == entry["sha256"]
        ]

    @classmethod
    def read(cls, path: Path, delays: list[int | str]) -> Results:
        """Return what a file holds.

        :param delays: those of interest, in this order; all by default
        :raises ValueError: without the file, or when it holds nothing of these delays
        """
        if not path.exists():
            raise ValueError(f"{path} does not exist, and no runs are given: name the runs to play.")
        document = json.loads(path.read_text())
        names = [field.name for field in fields(Cell)]
        cells = [Cell(**{name: entry[name] for name in names}) for entry in document.pop("cells")]
        del document["origins"]
        if delays:  # by what they are, however they are written
            cells = [
                replace(cell, delay=delay)
                for delay in delays
                for cell in cells
                if make_process(cell.delay) == make_process(delay)
            ]
        if not cells:
            raise ValueError(f"{path} holds nothing{f' of the delays {delays}' if delays else ''}: name runs to play.")
        return cls(path, document, cells)

    def missing(self) -> list[Cell]:
        """Return the cells that are still to be played."""
        return [cell for cell in self.cells if cell not in self.found]

    def add(self, cell: Cell, summary: Summary) -> None:
        """Keep what was played now."""
        result = summary.to_dict()
        del result["label"]  # the cell has it, and another call can give the agent another one
        self.found[cell] = {"origin": len(self.origins) - 1, "result": result}
        self.write()

    def write(self) -> None:
        """Write the file, whole or not at all."""
        cells = [{**asdict(cell), **self.found[cell]} for cell in self.cells if cell in self.found]
        document = {**self.settings, "origins": self.origins, "cells": cells + self.others}
        write_json(self.path, document)

    def table(self, rows: list[str]) -> dict[str, dict[int | str, Summary]]:
        """Return for each row's agent what it did under each delay that it could play."""
        table: dict[str, dict[int | str, Summary]] = {row: {} for row in rows}
        for cell in self.cells:
            if cell.agent in table and (result := self.found[cell]["result"]) is not None:
                table[cell.agent][cell.delay] = Summary.from_episodes(cell.agent, result["returns"], result["lengths"])
        return table


def _key(entry: dict[str, Any]) -> tuple[str, ...]:
    return entry["sha256"], str(entry["answer"]), repr(make_process(entry["delay"]))


def play_all(cells: list[Cell], env_id: str, args: argparse.Namespace) -> Iterator[tuple[Cell, Summary]]:
    """Play cells, in processes if more than one are to be played at once; yields them as they are done."""
    how = (env_id, args.episodes, args.seed, args.n_envs, args.device)
    if args.workers == 1:
        yield from ((cell, play(cell, *how)) for cell in cells)
        return
    context = multiprocessing.get_context("spawn")  # forked processes would share torch's threads
    pool = ProcessPoolExecutor(args.workers, context, initializer=th.set_num_threads, initargs=(args.num_threads,))
    try:
        futures = {pool.submit(play, cell, *how): cell for cell in cells}
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    finally:
        pool.shutdown(cancel_futures=True)


def play(cell: Cell, env_id: str, episodes: int, seed: int, n_envs: int, device: str) -> Summary:
    """Play the episodes of a cell."""
    run = open_run(cell.file, cell.algo, env_id, cell.delay, device)
    with answering(run.model, cell.answer), at_any_age():
        played = rollout(run.model, run.make_env, episodes, seed, n_envs, normalize=run.normalize)
    return Summary.from_episodes(cell.agent, played.returns, played.lengths)


def print_table(table: dict[str, dict[int | str, Summary]], delays: list[int | str]) -> None:
    """Print a Markdown table: one row for each agent, one column for each delay, then the averages."""
    columns: dict[str, list[int | str]] = {str(delay): [delay] for delay in delays}
    for name, kind in (("mean of fixed", int), ("mean of random", str)):
        columns[name] = [delay for delay in delays if isinstance(delay, kind)]
    rows = [["return under delay", *columns]]
    rows += [[agent, *(average(row, column) for column in columns.values())] for agent, row in table.items()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    for row in rows:
        print("| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |")


def average(row: dict[int | str, Summary], delays: list[int | str]) -> str:
    """Write the mean return over delays, with its interval over reset seeds.

    :param row: of an agent
    :param delays: those that the agent cannot play are left out, and the rest is counted
    """
    returns = [row[delay].returns for delay in delays if delay in row]
    if not returns:
        return "-"
    interval = str(bootstrap_interval(np.mean(returns, axis=0)))  # from (delays, n_episodes)
    return interval if len(returns) == len(delays) else f"{interval}, {len(returns)} of {len(delays)}"
