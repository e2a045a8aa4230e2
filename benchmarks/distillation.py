"""What a student keeps of its planner, and how fast it answers.

    python benchmarks/distillation.py RUN --seeds 1 2 --delays 0 4 8 16 --json distillation.json

RUN is the folder of a SAID run that has ended; its checkpoint holds the replay. With --log, RUN is any SAID agent, and
a log of its task (such as scripts/collect.py makes) takes the place of the replay. Each student learns from the planner
at temperature 0, as in any model.distill(). "kept" is the student's mean return over the planner's, all delays
together. Times are of single answers on one thread: of predict(), and of the exported graph (--onnx).
A call plays what --json lacks, so the same command goes on after a stop.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from measure import print_table, progress, resumed
from what_diffusion_buys import agent_of, make_env, opened

from sb3_said import SAID
from sb3_said.evaluation import collect_observations, confidence_interval, measure_latency, rollout
from sb3_said.files.atomic import write_json
from sb3_said.realtime import OnnxModel
from sb3_said.said.export import export


def play(model: SAID, args: argparse.Namespace) -> dict[str, Any]:
    """Return an agent's returns by delay, and the time of its answers at the longest delay."""
    found: dict[str, Any] = {"returns": {}}
    for delay in args.delays:
        progress(f"the {model.policy.who_answers} plays {args.episodes} episodes at delay {delay}")
        played = rollout(model, partial(make_env, model, delay), args.episodes, args.eval_seed, args.n_envs)
        found["returns"][str(delay)] = played.returns.tolist()
    met = collect_observations(partial(make_env, model, max(args.delays)), 100, args.eval_seed)
    found["predict"] = vars(measure_latency(model, met, args.calls))
    if args.onnx and model.policy.who_answers == "student":
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "student.onnx"
            export(model, file)
            found["onnx"] = vars(measure_latency(OnnxModel(file), met, args.calls))
    return found


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Distil, play, print, write, and return the numbers."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path, metavar="RUN")
    p.add_argument("--log", type=Path, help="dataset to learn from")
    p.add_argument("--seeds", type=int, nargs="+", default=[1], help="of the students")
    p.add_argument("--settings", type=json.loads, default={}, metavar="JSON", help="other settings of distill()")
    p.add_argument("--delays", type=int, nargs="+", default=[0, 4, 8, 16])
    p.add_argument("--episodes", type=int, default=20, help="of each agent and delay")
    p.add_argument("--n-envs", type=int, default=20)
    p.add_argument("--eval-seed", type=int, default=10_000, help="reset seed of the first episode")
    p.add_argument("--calls", type=int, default=2_000, help="answers to time")
    p.add_argument("--onnx", action="store_true", help="time the exported graph, too: needs sb3_said[export]")
    p.add_argument("--num-threads", type=int, default=1)
    p.add_argument("--json", type=Path, required=True, help="file of the numbers, read and written")
    args = p.parse_args(argv)
    th.set_num_threads(args.num_threads)
    model = opened(p, args.run, args.log)
    model.set_planner(temperature=0.0)
    settings = {name: getattr(args, name) for name in ("settings", "delays", "episodes", "eval_seed")}
    settings |= agent_of(model, args)
    document = resumed(p, args.json, settings, rows={})
    rows: dict[str, Any] = document["rows"]
    if "planner" not in rows:
        with model.policy.answering("planner"):
            rows["planner"] = play(model, args)
        write_json(args.json, document)
    for seed in args.seeds:
        name = f"student, seed {seed}"
        if name not in rows:
            model.seed = seed
            error = model.distill(progress_bar=True, **args.settings)
            with model.policy.answering("student"):
                rows[name] = play(model, args) | {"error": error}
            write_json(args.json, document)
    show(rows)
    return rows


def show(rows: dict[str, Any]) -> None:
    """Print a Markdown table."""
    delays = list(rows["planner"]["returns"])
    whole = np.mean([rows["planner"]["returns"][d] for d in delays])
    table = []
    for name, row in rows.items():
        cells = {f"delay {d}": str(confidence_interval(row["returns"][d])) for d in delays}
        cells["kept"] = f"{np.mean([row['returns'][d] for d in delays]) / whole:.3f}"
        for key, who in (("predict", "predict"), ("onnx", "ONNX")):
            times = f"{row[key]['p50_ms']:.2f}, {row[key]['p99_ms']:.2f}" if key in row else "-"
            cells[f"{who} p50, p99 ms"] = times
        table.append({"": name, **cells})
    print_table(table)


if __name__ == "__main__":
    main()
