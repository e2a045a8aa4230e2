"""Plots of training and evaluation, drawn without a display."""

from __future__ import annotations

import csv
import itertools
import math
import re
import textwrap
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from sb3_said.evaluation.statistics import Interval, Summary, confidence_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette without its yellow: colour-blind readers can tell it apart, too.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
N_DELAYS_PLOTTED = 5  # of a planner that logged errors at more delays than readers can tell apart
MARKERS = "osD^vPX*"
UPDATES = "planner/n_updates"  # column of progress.csv


def panels(n: int = 1, title: str = "", width: float = 5.0, height: float = 3.6) -> list[Axes]:
    """Make a figure of n panels, up to three side by side, more in two rows.

    :param n: panels
    :param title: of the figure: name the task and its delay
    :param width: of each panel, inches
    :param height: of each panel, inches
    :raises ImportError: without matplotlib
    """
    try:
        from matplotlib.figure import Figure  # no pyplot: needs no display, and leaves the caller's backend alone
    except ImportError as error:
        raise ImportError('Plots need matplotlib: pip install "sb3_said[plots]"') from error
    rows = 1 if n <= 3 else 2
    columns = math.ceil(n / rows)
    figure = Figure(figsize=(columns * width, rows * height), dpi=150, layout="constrained")
    if title:
        figure.suptitle(textwrap.fill(title, int(10 * columns * width)))  # characters of this size on its width
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(n)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="y", alpha=0.3)
        ax.set_axisbelow(True)
    return axes


def colors(n: int, ordered: bool = False) -> list[str]:
    """Return n colours, no two alike.

    :param n: lines to draw
    :param ordered: from dark to light, for lines in the order of a number
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    if n <= len(COLORS) and not ordered:
        return list(COLORS[:n])
    return [to_hex(color) for color in colormaps["viridis" if ordered else "turbo"](np.linspace(0, 0.9, n))]


def check_file(path: str | Path) -> None:
    """Refuse a file that :func:`save` cannot write, before the data of its plot is made.

    :raises ValueError: for a suffix that names no format
    :raises ImportError: without matplotlib
    """
    formats = panels()[0].get_figure(root=True).canvas.get_supported_filetypes()  # type: ignore[union-attr]  # as below
    if Path(path).suffix.removeprefix(".").lower() not in formats:
        raise ValueError(f"No plot can be written as {path}: give it the suffix .png, .pdf or .svg.")


def save(ax: Axes, path: str | Path) -> None:
    """Write the figure of ``ax``; the file's suffix names the format (.png, .pdf, .svg)."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    ax.get_figure(root=True).savefig(path)  # type: ignore[union-attr]  # all axes of `panels` have one


def evaluation_files(run: Path) -> list[Path]:
    """Return the files of a run's evaluations in training, first those of a SAID run's expert. Not all need exist."""
    return [run / "expert" / "evaluations.npz", run / "evaluations.npz"]


def plot_learning_curve(run: str | Path, ax: Axes | None = None, window: int = 20) -> Axes:
    """Plot the returns of training, and of the evaluations beside it, over environment steps.

    Its colours differ from those of planner and expert in :func:`plot_returns`, so that both fit into one figure.

    :param run: folder with ``*.monitor.csv`` (SB3's Monitor), ``evaluations.npz`` (SB3's EvalCallback), or both; in a
        SAID run these evaluations are the trained agent's, and those of its expert lie in ``expert/``
    :param ax: to draw on; a new figure by default
    :param window: training episodes in the running mean
    :raises ValueError: when the folder holds neither file
    """
    run = Path(run)
    steps, returns = _read_monitors(sorted(run.glob("*monitor.csv")))
    files = evaluation_files(run)
    if not len(steps) and not any(file.is_file() for file in files):
        raise ValueError(f"{run} holds neither episodes in *.monitor.csv nor evaluations.npz; give a training run.")
    ax = panels()[0] if ax is None else ax
    if len(steps):
        window = min(window, len(returns))
        mean = np.convolve(returns, np.full(window, 1 / window), mode="valid")
        ax.plot(steps, returns, ".", color=COLORS[2], alpha=0.2, markersize=3, markeredgewidth=0)
        ax.plot(steps[window - 1 :], mean, color=COLORS[2], label=f"training, mean of {window} episodes")
    own = "evaluation of the trained agent" if files[0].is_file() else "evaluation"
    for path, name, color in zip(files, ("evaluation of the expert", own), (COLORS[3], COLORS[4]), strict=True):
        if path.is_file():
            try:
                with np.load(path) as file:
                    known = ~np.isnan(file["results"]).any(axis=1)  # NaN at step 0, before there is a planner
                    eval_steps, results = file["timesteps"][known], file["results"][known]
            except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
                warnings.warn(f"{path} is damaged, as a kill leaves it, and left out: {error}.", stacklevel=2)
                continue
            value, low, high = _bounds([confidence_interval(row) for row in results])
            ax.plot(eval_steps, value, color=color, marker="o", markersize=3, label=f"{name}, 95 % interval")
            ax.fill_between(eval_steps, low, high, color=color, alpha=0.2, linewidth=0)
    ax.set_xlabel("environment steps" if len(steps) else "training steps")  # gradient steps in learning from logs
    ax.set_ylabel("return of an episode (undiscounted)")
    ax.legend(frameon=False)
    return ax


def plot_returns(summaries: Sequence[Summary], ax: Axes | None = None) -> Axes:
    """Plot every episode's return, and the mean with its interval, one column for each summary.

    :param summaries: for instance the planner's and the expert's, in the order of the columns
    :param ax: to draw on; a new figure by default
    """
    ax = panels(width=returns_width(summaries))[0] if ax is None else ax
    for column, (summary, color) in enumerate(zip(summaries, colors(len(summaries)), strict=True)):
        n = len(summary.returns)
        # Spread evenly, not at random, so that the same evaluation draws the same picture.
        x = column + np.linspace(-0.25, 0.25, n) if n > 1 else [column]
        ax.plot(x, summary.returns, "o", color=color, alpha=0.3, markersize=4, markeredgewidth=0)
        value, low, high = _bounds([summary.mean_return])
        ax.errorbar(column, value, yerr=[value - low, high - value], fmt="D", color=color, capsize=5, markersize=6)
        ax.annotate(f"{value[0]:,.0f}", (column, value[0]), (9, 5), textcoords="offset points", color=color)
    names = [s.label.replace(", ", ",\n") + f"\n{len(s.returns)} episodes" for s in summaries]
    ax.set_xticks(range(len(summaries)), names)
    ax.set_xlim(-0.6, len(summaries) - 0.4)
    ax.set_ylabel("return of an episode (undiscounted)")
    return ax


def returns_width(summaries: Sequence[Summary]) -> float:
    """Return the width of a panel of :func:`plot_returns`, in inches."""
    return 1.6 + 1.4 * len(summaries)


def plot_over_delays(table: Mapping[str, Mapping[int | str, npt.ArrayLike]], title: str = "") -> list[Axes]:
    """Plot mean returns with their intervals: a line over fixed delays, and points for each random delay.

    :param table: for each agent its returns, by the delay in control steps or, for a random one, by its name; each
        (n_episodes,), or (n_seeds, n_episodes) of several training seeds. Delays that an agent lacks are left out
    :param title: of the figure: name the task
    :return: a panel for each kind of delay there is, on one figure, with the same axis of returns
    :raises ValueError: for a table without returns
    """
    delays = list(dict.fromkeys(delay for row in table.values() for delay in row))
    fixed = sorted(delay for delay in delays if isinstance(delay, Integral))
    random = [delay for delay in delays if isinstance(delay, str)]
    kinds: list[Sequence[int | str]] = [kind for kind in (fixed, random) if kind]
    if not kinds:
        raise ValueError(f"Nothing was played, got {table}; give each agent returns under some delay.")
    width = max(5.0, 1.3 * len(random))
    fits_twice = max(map(len, table)) < 4.5 * len(kinds) * width
    legend_rows = math.ceil(len(table) / 2) if fits_twice else len(table)
    axes = panels(len(kinds), title, width, height=3.4 + 0.2 * legend_rows)
    for ax, kind in zip(axes, kinds, strict=True):
        for i, (color, (agent, row)) in enumerate(zip(colors(len(table)), table.items(), strict=True)):
            played = [delay for delay in kind if delay in row]
            offset = 0.7 * ((i + 0.5) / len(table) - 0.5)  # agents side by side at the tick of a random delay
            x = played if kind is fixed else [kind.index(delay) + offset for delay in played]
            value, low, high = _bounds([confidence_interval(row[delay]) for delay in played])
            ax.errorbar(
                x, value, yerr=[value - low, high - value], color=color, marker=MARKERS[i % len(MARKERS)],
                markersize=5, elinewidth=1, capsize=2, linestyle="-" if kind is fixed else "none", label=agent,
            )  # fmt: skip
            if kind is fixed:
                ax.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
        if kind is fixed:
            ax.set_xticks(fixed)
            ax.set_xlabel("delay (control steps)")
        else:
            ax.set_xticks(range(len(random)), [_in_lines(name) for name in random], fontsize="small")
            ax.set_xlim(-0.5, len(random) - 0.5)
            ax.set_xlabel("random delay")
        ax.sharey(axes[0])
    axes[0].autoscale_view()  # sharing alone keeps the limits of the first panel
    axes[0].set_ylabel("return of an episode (undiscounted)")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, loc="outside lower center", ncols=1 + fits_twice, frameon=False)
    return axes


def plot_planner_errors(run: str | Path, kind: Literal["present", "action"], ax: Axes | None = None) -> Axes:
    """Plot how far the planner is off on held-out windows, beside an MLP regression trained on the same windows.

    Each delay d has a colour, the darker the shorter. Of many delays five are shown. Solid lines are the
    planner's ``planner/{kind}_error_d*``, dashed ones the MLP's ``planner/{kind}_error_mlp_d*``. A planner above its
    dashed line is not trained yet.

    :param run: folder with SB3's ``progress.csv``, and ``progress_STEPS.csv`` where the training was resumed
    :param kind: "present", the error of the decoded present state in standard deviations of the states; or "action",
        the error of the decision in environment units
    :param ax: to draw on; a new figure by default
    :raises ValueError: when the folder holds no such error
    """
    files = sorted(
        Path(run).glob("progress*.csv"), key=lambda file: [int(number) for number in file.stem.split("_")[1:]]
    )
    rows = [row for file in files for row in csv.DictReader(file.read_text().splitlines())]
    names = {name for row in rows for name in row}
    pattern = re.compile(rf"planner/{kind}_error(_mlp)?_d(\d+)")
    columns = {name: match for name in names if (match := pattern.fullmatch(name))}
    if not columns:
        raise ValueError(
            f"{run} has no progress.csv with planner/{kind}_error_d*; give the run of a planner's training."
        )
    ax = panels()[0] if ax is None else ax
    # Delays of both kinds of error, so that a delay has the same colour in both plots.
    delays = sorted({int(d) for name in names for d in re.findall(r"planner/\w+_error(?:_mlp)?_d(\d+)", name)})
    if len(delays) > N_DELAYS_PLOTTED + 1:  # the shortest, the longest, and some between
        delays = [delays[round(k)] for k in np.linspace(0, len(delays) - 1, N_DELAYS_PLOTTED)]
        columns = {name: match for name, match in columns.items() if int(match[2]) in delays}
    color_of = dict(zip(delays, colors(len(delays), ordered=True), strict=True))
    updates = _running_total([float(row.get(UPDATES) or 0.0) for row in rows])
    for column, match in sorted(columns.items(), key=lambda item: (int(item[1][2]), item[0])):
        points = [(x, float(row[column])) for x, row in zip(updates, rows, strict=True) if row.get(column)]
        ax.plot(
            *zip(*points, strict=True),
            color=color_of[int(match[2])],
            linestyle="--" if match[1] else "-",
            marker=".",
            label=f"{'MLP' if match[1] else 'planner'}, delay {match[2]}",
        )
    ax.set_xlabel("planner updates")
    unit = {"present": "standard deviations", "action": "environment units"}[kind]
    ax.set_ylabel(f"{kind}{'-state' if kind == 'present' else ''} error ({unit})")
    ax.set_ylim(0, 1.6 * ax.get_ylim()[1])  # room for a legend that no curve runs through
    ax.legend(frameon=False, fontsize="small", ncols=2 if len(columns) > 6 else 1, loc="upper center")
    return ax


def _bounds(intervals: Sequence[Interval]) -> np.ndarray:
    """Return values, lower and upper bounds: (3, n)."""
    return np.array([(i.value, i.low, i.high) for i in intervals]).reshape(-1, 3).T


def _in_lines(name: str) -> str:
    """Break the name of a process into lines that fit under a tick."""
    head, bracket, rest = name.partition("(")
    return "\n".join(line for line in [head, *textwrap.wrap(bracket + rest, 17, break_long_words=False)] if line)


def _running_total(counts: Sequence[float]) -> list[float]:
    """Join the counts of several trainings of the planner, each from 0, into one count of updates.

    The count also falls where a training was resumed, but only to its checkpoint, which lies after its first row.
    """
    first = next((count for count in counts if count > 0), 0.0)
    before, last, joined = 0.0, 0.0, []
    for count in counts:
        if 0 < count < last and count <= first:
            before += last
        last = count or last
        joined.append(before + last)
    return joined


def _read_monitors(files: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Return environment steps and returns of all episodes in the order in which they ended, (n,) each.

    The files' times do not give that order: they begin anew with each resume.

    :param files: one for each environment; they take their steps side by side
    """
    ends: list[int] = []
    returns: list[float] = []
    for file in files:
        lines = file.read_text().splitlines()[1:]  # the first one is a JSON comment
        rows = [row for row in csv.DictReader(lines) if row["r"] and row["l"]]  # a kill may cut the last one
        ends += [len(files) * end for end in itertools.accumulate(int(float(row["l"])) for row in rows)]
        returns += [float(row["r"]) for row in rows]
    order = np.argsort(ends, kind="stable")
    return np.array(ends, np.int64)[order], np.array(returns)[order]
