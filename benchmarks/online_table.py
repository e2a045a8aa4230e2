"""Agents that learned online, over delays and training seeds: a table and a plot beside the paper's Table 1.

    python benchmarks/online_table.py results/agents/hopper.json results/agents/walker2d.json \\
        results/agents/walker2d_seed2.json --plot agents.png

Each file is of sb3-said over-delays. Agents of one task, told apart by their file's SHA-256, are training seeds.

SAID       planner and expert, each at its ages, where an agent's file has results of both together; else the planner;
           or the expert, for files after --expert-answers, whose trial found it better
intervals  95 %, by a bootstrap that draws training seeds, then episodes of each; of one seed over its episodes
SAID more  SAID's return less its expert's, from the same reset seeds; below it the same with its interval by
           Student's t over training seeds, which is wider for few
seeds      mean of each seed over fixed delays, in the order of the files
falls      part of all episodes that the task ended
change     of the actions, from step to step
paper      what Table 1 of arXiv 2603.01553 has for SAID, mean and standard error: an agent for each delay, 5 M steps
plot       thin lines are training seeds

With --each, every training seed has rows of its own.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from measure import print_table

from sb3_said.evaluation import Interval, confidence_interval, plots, stratified_interval
from sb3_said.zoo.arguments import explained
from sb3_said.zoo.cells import Cell, Results
from sb3_said.zoo.tables import manners_of

#: Rows of Table 1 at delays 0, 4, 8 and 16.
PAPER = {
    "Hopper-v5": ((3170, 283), (2698, 305), (2514, 415), (3268, 237)),
    "Walker2d-v5": ((5158, 360), (4874, 230), (5222, 295), (4913, 175)),
    "HalfCheetah-v5": ((14845, 367), (9648, 436), (5565, 274), (5289, 432)),
    "Ant-v5": ((5953, 84), (4586, 660), (4610, 383), (4137, 41)),
}
PAPER_DELAYS = (0, 4, 8, 16)
SAID, EXPERT = "SAID", "its expert"
Seeds = list[dict[int | str, Cell]]  # for each training seed its cell by delay


def read(paths: Iterable[Path], by_expert: Iterable[Path] = ()) -> dict[str, dict[str, Seeds]]:
    """Return by task and row what each training seed played.

    :param by_expert: files of agents that answer by their expert, whether or not ``paths`` has them, too
    :raises ValueError: for files of other episodes, an agent in two files, or one without episodes for a row
    """
    found: dict[str, dict[str, Seeds]] = {}
    episodes: dict[str, dict[str, object]] = {}
    files: dict[str, Path] = {}
    for path in dict.fromkeys([*paths, *by_expert]):
        results = Results(path)
        env = str(results.settings["env"])
        if episodes.setdefault(env, results.settings) != results.settings:
            raise ValueError(f"{path} has {results.settings}, and another file of the task {episodes[env]}.")
        cells = [cell for cell in results.cells if cell.result is not None and not cell.age_error]
        for agent in dict.fromkeys(cell.sha256 for cell in cells):
            if agent in files:
                raise ValueError(f"{path} and {files[agent]} hold the same agent, which would count as two seeds.")
            files[agent] = path
            of_agent = [cell for cell in cells if cell.sha256 == agent]
            own = "both" if any(cell.answer == "both" for cell in of_agent) else "planner"
            own = "expert" if path in by_expert else own
            for row, answer in ((SAID, own), (EXPERT, "expert")):
                by_delay = {cell.delay: cell for cell in of_agent if cell.answer == answer}
                if not by_delay:
                    raise ValueError(f"{path} has no episodes of {answer}, who is to be the row {row!r}.")
                found.setdefault(env, {}).setdefault(row, []).append(by_delay)
    return found


def returns_over(seeds: Seeds, delays: Sequence[int | str]) -> np.ndarray:
    """Return each episode's mean return over delays, for the seeds that played them all: (n_seeds, n_episodes)."""
    results = [[of_seed[d].result for d in delays] for of_seed in seeds if set(delays) <= set(of_seed)]
    return np.array([np.mean([result["returns"] for result in of_seed if result], axis=0) for of_seed in results])


def gain_over(rows: Mapping[str, Seeds], delays: Sequence[int | str]) -> np.ndarray:
    """Return how much more SAID earns than its expert in each episode, in the shape of :func:`returns_over`."""
    played = [pair for pair in zip(rows[SAID], rows[EXPERT], strict=True) if set(delays) <= set(pair[0]) & set(pair[1])]
    said, expert = (returns_over([pair[i] for pair in played], delays) for i in range(2))
    return said - expert


def written(returns: np.ndarray, over_seeds: Callable[[np.ndarray], Interval] = stratified_interval) -> str:
    """Write the mean of (n_seeds, n_episodes) with its interval."""
    if not len(returns):
        return "-"
    interval = confidence_interval(returns[0]) if len(returns) == 1 else over_seeds(returns)
    return f"{round(interval.value):,} [{round(interval.low):,}, {round(interval.high):,}]"  # so no -0 is written


def show(found: Mapping[str, Mapping[str, Seeds]]) -> None:
    """Print a Markdown table: SAID, its expert, how much more SAID earns, and the paper's SAID, for each task."""
    delays = list(dict.fromkeys(d for rows in found.values() for seeds in rows.values() for one in seeds for d in one))
    fixed, random = ([d for d in delays if isinstance(d, kind)] for kind in (int, str))
    over = {**{str(delay): [delay] for delay in delays}, "mean of fixed": fixed, "mean of random": random}
    columns = [*map(str, delays), "mean of fixed", "seeds", "mean of random", "worst tenth", "falls", "change"]
    table = []
    for env, rows in found.items():
        for row, seeds in rows.items():
            of_fixed, manners = returns_over(seeds, fixed), manners_of(cell for one in seeds for cell in one.values())
            assert manners is not None  # `read` made sure
            cells = {name: written(returns_over(seeds, of)) if of else "-" for name, of in over.items()} | {
                "seeds": ", ".join(f"{of_seed.mean():,.0f}" for of_seed in of_fixed),
                "worst tenth": f"{manners.worst_tenth:,.0f}",
                "falls": "-" if manners.ended is None else f"{manners.ended:.1%}",
                "change": "-" if manners.change is None else f"{manners.change:.3f}",
            }
            table.append({"task": env, "agent": row, **{name: cells[name] for name in columns}})
        gains = {name: gain_over(rows, of) for name, of in over.items() if of}
        ways: dict[str, Callable[[np.ndarray], Interval]] = {"SAID more": stratified_interval}
        if len(rows[SAID]) > 1:
            ways["the same, by t"] = confidence_interval
        for row, over_seeds in ways.items():
            cells = {name: written(gain, over_seeds) for name, gain in gains.items()}
            table.append({"task": env, "agent": row, **{name: cells.get(name, "") for name in columns}})
        paper = dict(zip(PAPER_DELAYS, PAPER.get(env, ()), strict=False))
        if paper:
            told = {str(d): f"{mean:,} ± {error}" for d, (mean, error) in paper.items()}
            table.append({"task": env, "agent": "SAID, paper", **{name: told.get(name, "") for name in columns}})
    print_table(table)


def each_by_itself(found: Mapping[str, Mapping[str, Seeds]]) -> dict[str, dict[str, Seeds]]:
    """Return the same with every training seed as a task of its own, numbered in the order of the files."""
    return {
        f"{env}, seed {i + 1}": {row: [seeds[i]] for row, seeds in rows.items()}
        for env, rows in found.items()
        for i in range(len(rows[SAID]))
    }


def plot(found: Mapping[str, Mapping[str, Seeds]], path: Path) -> None:
    """Draw a panel for each task: return over fixed delays, each training seed thin and their mean thick."""
    axes = plots.panels(len(found), width=4.6, height=3.2)
    for ax, (env, rows) in zip(axes, found.items(), strict=True):
        for (row, seeds), color, marker in zip(rows.items(), plots.COLORS, plots.MARKERS, strict=False):
            fixed = sorted(d for d in set[int | str].intersection(*map(set, seeds)) if isinstance(d, int))
            means = np.array([returns_over(seeds, [d]).mean(1) for d in fixed])  # (n_delays, n_seeds)
            ax.plot(fixed, means, color=color, alpha=0.45, linewidth=0.8)
            ax.plot(fixed, means.mean(1), color=color, marker=marker, linewidth=2, label=f"{row}, delays 0 to 16")
        if env in PAPER:
            mean, error = np.array(PAPER[env]).T
            ax.errorbar(PAPER_DELAYS, mean, error, color="grey", linestyle="none", marker="x", capsize=3,
                        label="SAID, paper: an agent for each delay, 5 M steps")  # fmt: skip
        n_seeds = len(rows[SAID])
        ax.set_title(f"{env}, {n_seeds} training seed{'s' if n_seeds > 1 else ''}", fontsize="medium")
        ax.set_xticks(PAPER_DELAYS)
        ax.set_ylim(bottom=0)
        ax.set_xlabel("delay (control steps)")
        ax.set_ylabel("return of an episode")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    plots.save(axes[0], path)


def main(argv: list[str] | None = None) -> dict[str, dict[str, Seeds]]:
    """Print the table, draw the plot, and return what was read."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="*", type=Path, metavar="JSON")
    p.add_argument("--expert-answers", nargs="+", type=Path, default=[], metavar="JSON", help="files of agents that "
                   "answer by their expert")  # fmt: skip
    p.add_argument("--each", action="store_true", help="rows of every training seed by itself")
    p.add_argument("--plot", type=Path, metavar="PNG", help="draw return over fixed delays, a panel for each task")
    args = p.parse_args(argv)
    if not [*args.files, *args.expert_answers]:
        p.error("Expected files of sb3-said over-delays, got none.")
    with explained(p):
        found = read(args.files, args.expert_answers)
    show(each_by_itself(found) if args.each else found)
    if args.plot:
        plot(found, args.plot)
    return found


if __name__ == "__main__":
    main()
