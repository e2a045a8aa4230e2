"""Results of agents under several delays, as tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from sb3_said.evaluation import Interval, confidence_interval, stratified_interval, worst_tenth
from sb3_said.offline import normalized_score, reference_returns
from sb3_said.zoo.cells import AGE, Cell

#: Returns by row and column: (n_episodes,), or (n_seeds, n_episodes) of several training seeds.
Table = dict[str, dict[int | str, np.ndarray]]


def make_table(cells: list[Cell], rows: Mapping[str, str]) -> Table:
    """Return what each row's agent returned under each delay that it could play.

    Several cells of one agent and one delay are of several training seeds, in the same order under each delay.

    :param rows: agents, each with the name that the table shows
    """
    return {
        rows[agent]: {
            column: np.array([*seeds.values()] if len(seeds) > 1 else next(iter(seeds.values())))
            for column, seeds in row.items()
        }
        for agent, row in _by_seed(cells, rows).items()
    }


def unpaired(cells: list[Cell], rows: Mapping[str, str]) -> set[str]:
    """Return the rows in which two delays share some training seeds but not all, by the names shown.

    An average over the delays would mix different training seeds.

    :param rows: as of :func:`make_table`
    """
    return {
        rows[agent]
        for agent, row in _by_seed(cells, rows).items()
        for one, other in combinations(row.values(), 2)
        if one.keys() != other.keys() and one.keys() & other.keys()
    }


def _by_seed(cells: list[Cell], rows: Mapping[str, str]) -> dict[str, dict[int | str, dict[str, list[float]]]]:
    """Return each agent's returns by delay and by the ``sha256`` that tells a training seed, in one order of these."""
    order = {sha256: i for i, sha256 in enumerate(dict.fromkeys(cell.sha256 for cell in cells))}
    played: dict[str, dict[int | str, dict[str, list[float]]]] = {agent: {} for agent in rows}
    for cell in sorted(cells, key=lambda cell: order[cell.sha256]):
        if cell.agent in played and (result := cell.result) is not None:
            played[cell.agent].setdefault(cell.column, {})[cell.sha256] = result["returns"]
    return played


class Manners(NamedTuple):
    """How an agent moves, over all that it played."""

    worst_tenth: float
    """mean of the lowest tenth of its returns"""
    ended: float | None
    """part of the episodes that the task ended; None where that was not counted"""
    change: float | None
    """of the actions, from step to step; None where that was not measured"""
    succeeded: float | None
    """part of the episodes that were a success; None where the task does not tell it"""


def manners_of(cells: Iterable[Cell]) -> Manners | None:
    """Return how the agent of these cells moves where the age was told right; None where nothing was played."""
    played = [cell.result for cell in cells if cell.result and not cell.age_error]
    if not played:
        return None
    returns = [x for result in played for x in result["returns"]]
    changes = [x["value"] for result in played if (x := result.get("mean_action_change"))]
    return Manners(
        worst_tenth(returns),
        _part(played, "terminations"),
        float(np.mean(changes)) if changes else None,
        _part(played, "successes"),
    )


def _part(played: list[dict[str, Any]], name: str) -> float | None:
    """Return which part of all episodes a count makes up, over the results that have this count."""
    counts = [(x, len(result["returns"])) for result in played if (x := result.get(name)) is not None]
    return sum(n for n, _ in counts) / sum(n for _, n in counts) if counts else None


def print_manners(cells: list[Cell], rows: Mapping[str, str]) -> None:
    """Print how each row's agent moves.

    :param rows: as of :func:`make_table`
    """
    for agent, name in rows.items():
        manners = manners_of(cell for cell in cells if cell.agent == agent)
        if manners is not None:
            words = [f"{name}: worst tenth of returns {manners.worst_tenth:.1f}"]
            if manners.ended is not None:
                words.append(f"{manners.ended:.0%} of the episodes ended by the task")
            if manners.succeeded is not None:
                words.append(f"{manners.succeeded:.0%} were a success")
            if manners.change is not None:
                words.append(f"actions change by {manners.change:.3f} a step")
            print(", ".join(words))


def print_table(table: Table, delays: list[int | str], unpaired: Collection[str] = ()) -> None:
    """Print a Markdown table: one row for each agent, one column for each delay, then the averages.

    Ages that are told wrong have columns of their own and count in no average. A line below it says what the intervals
    are over.

    :param unpaired: rows whose averages have no interval
    """
    columns = _columns(delays)
    _print_rows("return under delay", table, columns, confidence_interval, unpaired)
    several = {agent: row for agent, row in table.items() if row and all(x.ndim == 2 for x in row.values())}
    if several:
        print("\nThe same agents, with training seeds drawn, and then episodes of each:")
        _print_rows("return under delay", several, columns, stratified_interval, unpaired)
    if told := [row for row in table if row in unpaired]:
        print(f"{', '.join(told)}: no interval of the means, as some delays have other training seeds than others.")


def print_seeds(cells: Iterable[Cell], rows: Mapping[str, str]) -> None:
    """Print the files behind each row that has several: one label may have been played in several calls.

    :param rows: as of :func:`make_table`
    """
    for agent, name in rows.items():
        files = dict.fromkeys(cell.file for cell in cells if cell.agent == agent and cell.result)
        if len(files) > 1:
            print(f"{name}: {len(files)} agents, {', '.join(files)}")


def print_scores(table: Table, delays: list[int | str], env_id: str, unpaired: Collection[str] = ()) -> None:
    """Print the table again in D4RL's normalised scores, and nothing for no rows or a task that has none."""
    if table and reference_returns(env_id) is not None:
        scores = {
            row: {delay: np.asarray(normalized_score(x, env_id)) for delay, x in returns.items()}
            for row, returns in table.items()
        }
        print()
        _print_rows("normalised score", scores, _columns(delays), confidence_interval, unpaired)


def _columns(delays: list[int | str]) -> dict[str, list[int | str]]:
    """Return the delays behind each column: first each delay by itself, then those of each average."""
    columns: dict[str, list[int | str]] = {str(delay): [delay] for delay in delays}
    for name, kind in (("mean of fixed", int), ("mean of random", str)):
        columns[name] = [delay for delay in delays if isinstance(delay, kind) and AGE not in str(delay)]
    return columns


def _print_rows(
    what: str,
    table: Table,
    columns: dict[str, list[int | str]],
    interval: Callable[[Any], Interval],
    unpaired: Collection[str],
) -> None:
    averages = {
        agent: [average(row, column, interval, agent not in unpaired) for column in columns.values()]
        for agent, row in table.items()
    }
    rows = [[what, *columns]]
    rows += [[agent, *(text for text, _ in row)] for agent, row in averages.items()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    for row in rows:
        print("| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |")
    units = dict.fromkeys(over for row in averages.values() for _, over in row if over)
    if units:
        print(f"95 % intervals over {', or '.join(units)}")


def average(
    row: Mapping[int | str, np.ndarray],
    delays: list[int | str],
    interval: Callable[[Any], Interval] = confidence_interval,
    is_paired: bool = True,
) -> tuple[str, str]:
    """Write the mean return over delays with its interval, and what the interval is over: training or reset seeds.

    :param row: of an agent
    :param delays: those that the agent cannot play are left out, and the text says how many are left. Delays of
        different numbers of training seeds have a mean and no interval
    :param interval: of returns (n_episodes,), or (n_seeds, n_episodes) of several training seeds
    :param is_paired: whether the delays have the same training seeds; if not, several delays have no interval either
    """
    returns = [row[delay] for delay in delays if delay in row]
    if not returns:
        return "-", ""
    covered = "" if len(returns) == len(delays) else f", {len(returns)} of {len(delays)}"
    if len({one.shape for one in returns}) > 1 or not (is_paired or len(returns) == 1):
        return f"{np.mean([one.mean() for one in returns]):.1f}{covered}", ""
    found = interval(np.mean(returns, axis=0))  # from (delays, n_episodes) or (delays, seeds, n_episodes)
    if returns[0].size == 1:  # an episode by itself tells nothing about the spread
        return f"{found}{covered}", ""
    units = f"{found.n} episodes"
    if returns[0].ndim == 2:
        n_seeds, n_episodes = returns[0].shape
        units = f"{n_seeds} training seeds" + f" of {n_episodes} episodes" * (interval is not confidence_interval)
    return f"{found}{covered}", f"{units} ({found.method})"
