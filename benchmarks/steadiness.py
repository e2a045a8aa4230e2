"""How steady trainings are: their evaluations in the last steps, over seeds.

    python benchmarks/steadiness.py stable=logs/said/Hopper-v5-delay0-16-seed1_1 stable=...seed2_1 sadr=logs/sadr/... \\
        --json steadiness.json

Runs of one name are seeds of the same training. A path is a run's folder, or a file written by --json, whose runs of
that name count (without a name all, each under its own). Of a SAID run the expert's evaluations are read. A training
that has not ended counts as far as it has come.

mean        of all evaluations in the last steps, over runs
sd / mean   standard deviation between the evaluations of one run, over their mean; the worst run's
bad         evaluations below 70 % of their run's median (below it by more than 30 % of its absolute value)
worst run   its mean over the mean of all runs
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from measure import print_table, read_json

from sb3_said.files.atomic import write_json
from sb3_said.zoo.arguments import explained

BAD = 0.7  # of the median, as results/stable_expert.md counts
EVALUATIONS = "evaluations.npz"  # of SB3's EvalCallback


def read_runs(name: str, path: Path) -> list[dict[str, Any]]:
    """Return the evaluations that a path holds: steps (n,) and returns (n, n_episodes) each.

    :param name: of the runs; "" for all that a file holds
    :raises ValueError: where it holds none
    """
    if path.is_file():
        runs = read_json(path)
        if not isinstance(runs, list):
            raise ValueError(f"{path} was not written by --json of this program, and is no run's folder.")
        if found := [run for run in runs if name in ("", run["name"])]:
            return found
        raise ValueError(f"{path} has no runs named {name!r}, only {', '.join(sorted({run['name'] for run in runs}))}.")
    files = [file for file in (path / EVALUATIONS, path / "expert" / EVALUATIONS) if file.is_file()]
    if not files:
        raise ValueError(f"{path} has no {EVALUATIONS}; train with --eval-freq.")
    with np.load(files[-1]) as saved:  # a SAID run's expert has evaluations of its own
        steps, returns = saved["timesteps"].tolist(), saved["results"].round(1).tolist()
    return [{"name": name, "run": path.name, "steps": steps, "returns": returns}]


def steadiness(runs: list[dict[str, Any]], last: int) -> dict[str, Any]:
    """Return the columns of a row.

    :param last: evaluations in so many environment steps before a run's end count
    """
    means = [np.mean(run["returns"], axis=1)[np.array(run["steps"]) > run["steps"][-1] - last] for run in runs]
    of_runs = np.array([late.mean() for late in means])
    return {
        "runs": len(runs),
        "steps": [run["steps"][-1] for run in runs],
        "mean": float(of_runs.mean()),
        "sd / mean": max(float(late.std() / abs(late.mean())) for late in means),
        "bad": sum(int((late < np.median(late) - (1 - BAD) * abs(np.median(late))).sum()) for late in means),
        "evaluations": sum(map(len, means)),
        "worst run": float(of_runs.min() / of_runs.mean()),
    }


def _of_seeds(name: str, row: dict[str, Any]) -> dict[str, Any]:
    return {
        "": name,
        "steps": ", ".join(f"{n:,}" for n in row["steps"]),
        "mean": f"{row['mean']:,.0f}",
        "sd / mean, worst run": row["sd / mean"],
        "bad evaluations": f"{row['bad']} of {row['evaluations']}",
        "worst run / mean": row["worst run"],
    }


def _of_run(run: dict[str, Any], row: dict[str, Any], columns: Iterable[int]) -> dict[str, Any]:
    means = dict(zip(run["steps"], np.mean(run["returns"], axis=1), strict=True))
    return {
        "": run["name"],
        "run": run["run"],
        **{f"{step:,}": f"{means[step]:,.0f}" if step in means else "" for step in columns},
        "last: mean": f"{row['mean']:,.0f}",
        "sd / mean": row["sd / mean"],
        "bad": f"{row['bad']} of {row['evaluations']}",
    }


def main(argv: list[str] | None = None) -> dict[str, dict[str, Any]]:
    """Print a Markdown table, write the evaluations, and return the rows."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("runs", nargs="+", metavar="NAME=RUN_OR_JSON")
    p.add_argument("--last", type=int, default=100_000, metavar="STEPS", help="of each run (default: 100000)")
    p.add_argument(
        "--each", type=int, metavar="STEPS", help="a row for each run, with an evaluation every so many steps"
    )
    p.add_argument("--json", type=Path, help="write every evaluation there, to read again")
    args = p.parse_args(argv)
    groups: dict[str, list[dict[str, Any]]] = {}
    for word in args.runs:
        name, _, path = word.rpartition("=")
        with explained(p):
            for run in read_runs(name, Path(path)):
                groups.setdefault(run["name"], []).append(run)
    rows = {name: steadiness(runs, args.last) for name, runs in groups.items()}
    if args.each is None:
        table = [_of_seeds(name, row) for name, row in rows.items()]
    else:
        runs = [run for of_name in groups.values() for run in of_name]
        columns = range(args.each, max(run["steps"][-1] for run in runs) + 1, args.each)
        table = [_of_run(run, steadiness([run], args.last), columns) for run in runs]
    print_table(table)
    if args.json is not None:
        write_json(args.json, [run for runs in groups.values() for run in runs])
    return rows


if __name__ == "__main__":
    main()
