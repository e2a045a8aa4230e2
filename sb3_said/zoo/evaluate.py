"""Measure a trained agent: mean return over whole seeded episodes, and how long a decision takes."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from tqdm import tqdm

from sb3_said.evaluation import Summary, collect_observations, measure_latency, plots
from sb3_said.files.atomic import check_writable, write_json
from sb3_said.offline import normalized_score, reference_returns
from sb3_said.zoo.answer import BEST_NAME
from sb3_said.zoo.arguments import TRUST, add_run, check_positive, explained, make_parser, read_delay
from sb3_said.zoo.latency import evaluate_in_real_time
from sb3_said.zoo.runs import LoadedRun, answering, answers, control_period, load_run, origin

EPILOG = f"""\
examples:
  # 50 episodes of the planner, and of the expert beside it; writes evaluation.json into the run folder
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1

  # the expert that did best in training, under a shorter delay
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1/expert/best_model.zip --delay 2 --json d2.json

  # an agent that came without its run folder
  sb3-said evaluate hopper.zip --algo said --env Hopper-v5 --delay 4

  # the same in real time: the task does not wait for answers, so their time on this machine is delay
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1 --realtime --period 0.02

Episode i starts from reset seed --seed + i, so two agents meet the same starts; --n-envs changes the speed, the
rounding, and with --stochastic what is drawn. A return is the undiscounted sum of the task's own rewards, and a score
is D4RL's, 0 for a random policy and 100 for an expert, where D4RL has both. Decisions are timed after the episodes,
one at a time, from NumPy observation to NumPy action. The last agent of a run is played, and where an earlier one did
best in training, that "best" one too, or alone where the run was killed: it was chosen on other episodes than these.

With --realtime every answer is also made to wait: it takes effect at the first control step after the time that it
took. The row "in real time" plans for that step. The row "latency ignored" plans for the step at which it was asked,
and shows what that costs. In between the first sends the later actions of a plan, and holds the last one where there
are none; the second holds it always. Other programs on this machine count, too.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    add_run(parser, episodes=50)
    parser.add_argument("--n-envs", type=int, default=8, help="episodes played side by side (default: 8)")
    parser.add_argument("--latency-calls", type=int, default=200, help="decisions to time, 0 for none (default: 200)")
    parser.add_argument("--json", type=Path, help="where to write the numbers (default: RUN/evaluation.json, of a .zip "
                        "NAME_evaluation.json beside it; with --realtime realtime.json in their place)")  # fmt: skip
    parser.add_argument("--plot", type=Path, help="draw returns and training curves to this .png or .pdf")
    parser.add_argument("--realtime", action="store_true", help="play also without waiting for answers; --delay, 0 by "
                        "default, is then the delay without them")  # fmt: skip
    parser.add_argument("--period", type=float, metavar="SECONDS", help="of a control step with --realtime (default: "
                        "the task's own)")  # fmt: skip
    args = parser.parse_args(argv)
    with explained(parser):
        measure(args, *opened(args))


def opened(args: argparse.Namespace) -> tuple[dict[str, LoadedRun], Path, float]:
    """Check the options and open the agents, before any episode.

    :return: the last and the best agent, or the only one; the file for the numbers; seconds of a control step in real
        time
    :raises ValueError: for an option that cannot work
    """
    check_positive(args, "episodes", "n_envs", "num_threads")
    if args.latency_calls < 0:
        raise ValueError(f"--latency-calls must be at least 0, got {args.latency_calls}.")
    if args.period is not None and not (args.realtime and 0 < args.period < math.inf):
        raise ValueError(f"--period takes seconds above 0 and needs --realtime, got {args.period}.")
    th.set_num_threads(args.num_threads)
    if args.plot is not None:
        plots.check_file(args.plot)  # refuse now what cannot be drawn, not after the episodes
        check_writable(args.plot)
    played: dict[str, Any] = {"algo": args.algo, "env_id": args.env, "delay": read_delay(args.delay)}
    played |= {"device": args.device, "gym_packages": args.gym_packages}
    run = load_run(args.run, **played)
    if args.realtime and not args.delay and run.own_delay is None:  # the time of answers is all the delay
        played["delay"] = 0
        run = load_run(args.run, **played)
    best = run.folder / BEST_NAME
    runs = {"best" if Path(run.info["file"]) == best else "last": run}
    if "last" in runs and Path(args.run).is_dir() and best.is_file():
        runs["best"] = load_run(best, **played)
        if runs["best"].info["trained_steps"] == run.info["trained_steps"]:
            del runs["best"]  # the last one is the best
    period: float = args.period or (args.realtime and control_period(run)) or 0.0
    if args.realtime and not period:
        raise ValueError(f"{run.info['env']} does not tell how long a control step is: give --period.")
    name = "realtime.json" if args.realtime else "evaluation.json"
    target = args.json or run.folder / (name if Path(args.run).is_dir() else f"{Path(args.run).stem}_{name}")
    check_writable(target)
    check_replaceable(target)
    return runs, target, period


def check_replaceable(target: Path) -> None:
    """
    :raises ValueError: for a file that holds something else than this command's numbers
    """
    if not target.is_file() or not (text := target.read_text(errors="replace")):
        return
    try:
        if "results" in json.loads(text):
            return
    except (ValueError, TypeError):  # no JSON, or a number
        pass
    raise ValueError(f"{target} holds something else than what sb3-said evaluate writes: give another --json.")


def measure(args: argparse.Namespace, runs: dict[str, LoadedRun], target: Path, period: float) -> None:
    """Play and time the agents, print a table, and write the numbers.

    :param runs: the last and the best agent, or the only one
    """
    run = next(iter(runs.values()))
    last_seed = args.seed + args.episodes - 1
    print(f"{run.info['algo']} on {run.info['env']}, delay {run.info['delay']}, reset seeds {args.seed}..{last_seed}")
    settings = {"seed": args.seed, "n_envs": args.n_envs, "deterministic": not args.stochastic}
    how = {**settings, "latency_calls": args.latency_calls}
    played: list[tuple[str, Summary]] = []
    counted: dict[str, dict[str, float]] = {}
    for which, one in runs.items():
        for answer in answers(one.model):
            played.append((which, evaluate(one, answer, args.episodes, **how)))
            if args.realtime:
                in_time = evaluate_in_real_time(one, answer, args.episodes, args.seed, period, not args.stochastic)
                for summary, counts in in_time:
                    played.append((which, summary))
                    counted[label_of(which, summary)] = counts
    print_table(played, run.scored_task)
    for which, summary in played:
        if summary.successes is not None:
            print(f"{label_of(which, summary)}: {summary.successes} of {len(summary.returns)} episodes were a success")
    for label, counts in counted.items():
        print(f"{label}: {', '.join(f'{name} {value:g}' for name, value in counts.items() if 'gap' not in name)}")

    document = {**run.info, "n_episodes": args.episodes, **settings}
    document["results"] = [
        {**summary.to_dict(), "which": which, "trained_steps": runs[which].info["trained_steps"]}
        | {"normalized_score": score_of(summary, run.scored_task)}
        for which, summary in played
    ]
    document["origin"] = origin(run)
    document |= {"period": period, "realtime": counted} if args.realtime else {}
    write_json(target, document)
    print(f"Wrote {target}")
    if args.plot is not None:
        rows = [replace(summary, label=label_of(which, summary)) for which, summary in played]
        draw(args.plot, rows, run.folder, f"{run.info['algo']} on {run.info['env']}, delay {run.info['delay']}")
        print(f"Wrote {args.plot}")


def evaluate(
    run: LoadedRun,
    answer: str | None,
    n_episodes: int,
    seed: int,
    n_envs: int = 8,
    deterministic: bool = True,
    latency_calls: int = 200,
) -> Summary:
    """Play the episodes and time the decisions of one answer."""
    label = answer or run.info["algo"]
    with tqdm(total=n_episodes, desc=label, unit="episode", leave=False) as bar:
        how: dict[str, Any] = {"deterministic": deterministic, "on_episode": lambda *_: bar.update()}
        played = run.play(n_episodes, seed, n_envs, answer=answer, **how)
    latency = None
    if latency_calls > 0:
        observations = collect_observations(run.make_env, min(latency_calls, 100), seed)
        with answering(run.model, answer):
            latency = measure_latency(run.model, observations, latency_calls, deterministic, run.normalize)
    return played.summary(label, latency)


def label_of(which: str, summary: Summary) -> str:
    """Return the label under which the last and the best agent can stand in one list."""
    return summary.label if which == "last" else f"{summary.label}, {which}"


def score_of(summary: Summary, env_id: str) -> list[float] | None:
    """Return D4RL's score of the mean return and of its interval's ends, None where there is none.

    :param env_id: of an unchanged task
    """
    if reference_returns(env_id) is None:
        return None
    mean = summary.mean_return
    ends = [mean.value] if math.isnan(mean.low) else [mean.value, mean.low, mean.high]
    return [float(normalized_score(end, env_id)) for end in ends]


def print_table(played: list[tuple[str, Summary]], env_id: str = "") -> None:
    """Print one line for each answer, with columns for the last agent and for the best, if that is another.

    :param played: which of the two, "last" or "best", and what it did
    :param env_id: of a task, for the score
    """
    table: dict[str, dict[str, Summary]] = {}
    for which, summary in played:
        table.setdefault(summary.label, {})[which] = summary
    kinds = list(dict.fromkeys(which for which, _ in played))
    names = {kind: "mean return" if kinds == ["last"] else f"{kind} return" for kind in kinds}
    width = max(10, *map(len, table))
    heads = [f"{names[kind]:>12} {'95 % interval':>24} {'score':>7} {'length':>8}" for kind in kinds]
    print(f"{'':{width}} {' '.join(heads)}   decision latency")
    for label, row in table.items():
        columns = " ".join(_columns(row.get(kind), env_id) for kind in kinds)
        print(f"{label:{width}} {columns}   {next(iter(row.values())).latency or 'not measured'}")


def _columns(summary: Summary | None, env_id: str) -> str:
    if summary is None:  # this answer did not exist yet when the best agent was saved
        return f"{'-':>12} {'-':>24} {'-':>7} {'-':>8}"
    mean, scores = summary.mean_return, score_of(summary, env_id)
    interval = "-" if mean.n == 1 else f"[{mean.low:,.1f}, {mean.high:,.1f}]"
    score = "-" if scores is None else f"{scores[0]:.1f}"
    return f"{mean.value:12,.1f} {interval:>24} {score:>7} {summary.mean_length.value:8,.1f}"


def draw(path: Path, summaries: list[Summary], folder: Path, title: str) -> None:
    """Draw the returns, and beside them the training curves whose files lie in the run folder.

    :param title: names the task and its delay
    """
    drawings: list[Any] = [partial(plots.plot_returns, summaries)]
    has_episodes = any(len(file.read_text().splitlines()) > 2 for file in folder.glob("*monitor.csv"))
    if has_episodes or any(file.is_file() for file in plots.evaluation_files(folder)):
        drawings.append(partial(plots.plot_learning_curve, folder))
    headers = [path.read_text().split("\n", 1)[0] for path in folder.glob("progress*.csv")]
    drawings += [
        partial(plots.plot_planner_errors, folder, kind)
        for kind in ("present", "action")
        if any(f"planner/{kind}_error" in header for header in headers)
    ]
    axes = plots.panels(len(drawings), title, width=max(5.0, plots.returns_width(summaries)))
    for ax, drawing in zip(axes, drawings, strict=True):
        drawing(ax=ax)
    plots.save(axes[0], path)
