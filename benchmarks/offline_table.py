"""Agents that learned from logs, over delays and planner seeds: a table and plots beside the paper's Table 2.

    python benchmarks/offline_table.py medium=results/offline/hopper-medium-0.json \\
        mixed,DQL+SA=results/nine_logs/hopper-mixed-0-dql.json --plot results/offline

Each file is from motivation.py (its players, of one planner seed), or from sb3-said over-delays (one agent, whose name
follows the comma). Files of one task, set and name are seeds of the same training.

plots   95 % intervals are over the episodes of all seeds together
score   D4RL's normalised score of the mean return; in brackets that of each seed, where there are several
kept    the return as a part of the same agent's at delay 0
paper   what Table 2 of arXiv 2603.01553 has for SAID and DQL+SA at these delays, on D4RL's -v2 sets: other logs, of
        other versions of the tasks; medium-replay stands beside mixed, and medium-expert beside expert
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from measure import print_table, read_json

from sb3_said.evaluation import plots
from sb3_said.offline import normalized_score, reference_returns
from sb3_said.zoo.arguments import explained

DELAYS = (0, 4, 8, 16)
NAMES = {
    "SAID": "SAID",
    "one step": "SAID, one step",
    "SAID, inpainting": "SAID, inpainting",
    "guess alone": "its first guess alone",
    "inpainted": "belief-only",
    "guessed": "belief-only, guessed present",
    "cloning": "BC",
    "rolled out": "belief-only, rolled-out model",
}
#: (set, task) -> rows of Table 2 at delays 0, 4, 8 and 16. At delay 0, the number of DQL+SA is their DQL's.
PAPER: dict[tuple[str, str], dict[str, tuple[float, ...]]] = {
    ("expert", "HalfCheetah-v5"): {"SAID": (106.2, 32.8, 4.5, 1.9), "DQL+SA": (95.9, 2.9, 2.1, 1.4)},
    ("mixed", "HalfCheetah-v5"): {"SAID": (50.2, 34.3, 8.3, 2.1), "DQL+SA": (48.9, 0.2, 1.4, 1.3)},
    ("medium", "HalfCheetah-v5"): {"SAID": (58.5, 45.2, 5.8, 1.5), "DQL+SA": (52.6, 2.4, 2.0, 1.3)},
    ("expert", "Walker2d-v5"): {"SAID": (111.1, 111.1, 110.8, 106.7), "DQL+SA": (112.0, 8.1, -0.3, -0.1)},
    ("mixed", "Walker2d-v5"): {"SAID": (95.5, 91.1, 85.6, 45.2), "DQL+SA": (99.9, 7.1, -0.1, -0.2)},
    ("medium", "Walker2d-v5"): {"SAID": (84.4, 84.8, 84.1, 80.3), "DQL+SA": (91.2, -0.1, -0.1, -0.1)},
    ("expert", "Hopper-v5"): {"SAID": (112.3, 111.4, 111.2, 110.3), "DQL+SA": (111.1, 4.2, 1.9, 1.0)},
    ("mixed", "Hopper-v5"): {"SAID": (98.3, 87.5, 85.6, 90.3), "DQL+SA": (102.9, 2.7, 1.8, 2.1)},
    ("medium", "Hopper-v5"): {"SAID": (84.6, 82.0, 83.5, 86.6), "DQL+SA": (102.0, 3.1, 2.0, 2.0)},
}
Seeds = dict[int, list[list[float]]]  # by delay, for each seed its returns


def read(path: Path, name: str | None) -> tuple[str, dict[str, dict[int, list[float]]]]:
    """Return the task of a file, and its returns by agent and delay.

    :param name: of the agent in a file of over-delays
    :raises ValueError: for such a file of several agents, or of one that answers in several ways; for one that holds
        nothing of the table's delays, is of a task without reference returns, or of something else
    """
    document = read_json(path)
    try:
        env, rows = document["env"], _rows(document, name or path.stem)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is neither of motivation.py nor of sb3-said over-delays: {error!r}.") from error
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error
    if reference_returns(env) is None:
        raise ValueError(f"{path} is of {env}, for which D4RL has no reference returns, and so no score.")
    if not any(delay in row for row in rows.values() for delay in DELAYS):
        raise ValueError(f"{path} holds no returns of these agents at delays {DELAYS}.")
    return env, rows


def _rows(document: dict[str, Any], name: str) -> dict[str, dict[int, list[float]]]:
    if "cells" not in document:
        return {
            NAMES[player]: dict(zip(document["delays"], (row["returns"] for row in summaries), strict=True))
            for player, summaries in document["returns"].items()
            if player in NAMES
        }
    cells = [cell for cell in document["cells"] if cell["result"] is not None and not cell.get("age_error")]
    if len(agents := sorted({(cell["sha256"], str(cell["answer"])) for cell in cells})) > 1:
        raise ValueError(f"holds {len(agents)} agents or answers, expected those of one agent, in one way.")
    return {name: {cell["delay"]: cell["result"]["returns"] for cell in cells}}


def table(files: list[tuple[str, str | None, Path]]) -> dict[tuple[str, str], dict[str, Seeds]]:
    """Return by (set, task) and agent the returns of all seeds."""
    found: dict[tuple[str, str], dict[str, Seeds]] = {}
    for kind, name, path in files:
        env, rows = read(path, name)
        for agent, of_delay in rows.items():
            seeds = found.setdefault((kind, env), {}).setdefault(agent, {})
            for delay, returns in of_delay.items():
                seeds.setdefault(delay, []).append(returns)
    return found


def show(found: dict[tuple[str, str], dict[str, Seeds]]) -> None:
    """Print a Markdown table: a row for each set and agent."""
    table = []
    for (kind, env), rows in found.items():
        for agent, seeds in rows.items():
            cells = {"set": f"{env} {kind}", "agent": agent}
            for delay in DELAYS:
                scores = [float(normalized_score(float(np.mean(returns)), env)) for returns in seeds.get(delay, [])]
                each = f" [{', '.join(f'{score:.1f}' for score in scores)}]" if len(scores) > 1 else ""
                cells[f"delay {delay}"] = f"{np.mean(scores):.1f}{each}" if scores else ""
            for d in DELAYS[1:]:
                cells[f"kept at {d}"] = f"{np.mean(seeds[d]) / np.mean(seeds[0]):.2f}" if {0, d} <= {*seeds} else ""
            cells["paper"] = ", ".join(map(str, PAPER.get((kind, env), {}).get(agent, ())))
            table.append(cells)
    print_table(table)


def main(argv: list[str] | None = None) -> dict[tuple[str, str], dict[str, Seeds]]:
    """Print the table, draw a plot for each task and set, and return the returns."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", metavar="SET[,NAME]=JSON")
    p.add_argument("--plot", type=Path, metavar="FOLDER", help="one .png for each task and set")
    args = p.parse_args(argv)
    files = []
    for word in args.files:
        key, _, path = word.partition("=")
        kind, _, name = key.partition(",")
        if not path:
            p.error(f"{word} is no SET=JSON, such as medium=hopper-medium-0.json.")
        files.append((kind, name or None, Path(path)))
    with explained(p):
        found = table(files)
    show(found)
    for (kind, env), rows in found.items() if args.plot else ():
        returns: dict[str, Any] = {
            agent: {d: np.concatenate(x) for d, x in seeds.items()} for agent, seeds in rows.items()
        }
        plots.save(plots.plot_over_delays(returns, f"{env}, {kind} log")[0], args.plot / f"{env}-{kind}.png")
    return found


if __name__ == "__main__":
    main()
