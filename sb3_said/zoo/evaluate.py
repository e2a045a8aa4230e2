"""Measure a trained agent: mean return over whole seeded episodes, and how long a decision takes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from tqdm import tqdm

from sb3_said.evaluation import Summary, collect_observations, measure_latency, plots
from sb3_said.files.atomic import write_json
from sb3_said.zoo.arguments import TRUST, add_run, check_positive, explained, make_parser, read_delay
from sb3_said.zoo.latency import control_period, evaluate_in_real_time
from sb3_said.zoo.runs import LoadedRun, answering, answers, load_run, origin

EPILOG = f"""\
examples:
  # 20 episodes of the planner, and of the expert beside it; writes evaluation.json into the run folder
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1

  # the expert that did best in training, under a shorter delay
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1/expert/best_model.zip --delay 2 --json d2.json

  # an agent that came without its run folder
  sb3-said evaluate hopper.zip --algo said --env Hopper-v5 --delay 4

  # the same in real time: the task does not wait for answers, so their time on this machine is delay
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1 --realtime --period 0.02

Episode i starts from reset seed --seed + i, so two agents meet the same starts; --n-envs changes only the speed. A
return is the undiscounted sum of the task's own rewards. Decisions are timed after the episodes, one at a time, from
NumPy observation to NumPy action.

With --realtime every answer is also made to wait: it takes effect at the first control step after the time that it
took. The row "in real time" plans for that step. The row "latency ignored" plans for the step at which it was asked,
and shows what that costs. Both hold the last action in between. Other programs on this machine count, too.
{TRUST}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    add_run(parser, episodes=20)
    parser.add_argument("--n-envs", type=int, default=8, help="episodes played side by side (default: 8)")
    parser.add_argument("--latency-calls", type=int, default=200, help="decisions to time, 0 for none (default: 200)")
    parser.add_argument("--json", type=Path, help="where to write the numbers (default: RUN/evaluation.json)")
    parser.add_argument("--plot", type=Path, help="draw returns and training curves to this .png or .pdf")
    parser.add_argument("--realtime", action="store_true", help="play also without waiting for answers; --delay, 0 by "
                        "default, is then the delay without them")  # fmt: skip
    parser.add_argument("--period", type=float, metavar="SECONDS", help="of a control step with --realtime (default: "
                        "the task's own)")  # fmt: skip
    args = parser.parse_args(argv)
    with explained(parser):
        check_positive(args, "episodes", "n_envs", "num_threads")
        if args.period is not None and not (args.realtime and args.period > 0):
            raise ValueError(f"--period takes seconds above 0 and needs --realtime, got {args.period}.")
        th.set_num_threads(args.num_threads)
        if args.plot is not None:
            plots.panels()  # without matplotlib, fail now and not after the episodes
        delay = 0 if args.realtime and not args.delay else read_delay(args.delay)
        run = load_run(args.run, args.algo, args.env, delay, args.device, gym_packages=args.gym_packages)
        period = control_period(run) if args.realtime and args.period is None else args.period

    last_seed = args.seed + args.episodes - 1
    print(f"{run.info['algo']} on {run.info['env']}, delay {run.info['delay']}, reset seeds {args.seed}..{last_seed}")
    settings = {"seed": args.seed, "n_envs": args.n_envs, "deterministic": not args.stochastic}
    how = {**settings, "latency_calls": args.latency_calls}
    summaries: list[Summary] = []
    counted: dict[str, dict[str, float]] = {}
    for answer in answers(run.model):
        summaries.append(evaluate(run, answer, args.episodes, **how))
        if args.realtime:
            for summary, counts in evaluate_in_real_time(
                run, answer, args.episodes, args.seed, period, not args.stochastic
            ):
                summaries.append(summary)
                counted[summary.label] = counts
    print_table(summaries)
    for label, counts in counted.items():
        print(f"{label}: {', '.join(f'{name} {value:g}' for name, value in counts.items() if 'gap' not in name)}")

    document = {**run.info, "n_episodes": args.episodes, **settings}
    document |= {"results": [summary.to_dict() for summary in summaries], "origin": origin(run)}
    document |= {"period": period, "realtime": counted} if args.realtime else {}
    target = args.json or run.folder / "evaluation.json"
    write_json(target, document)
    print(f"Wrote {target}")
    if args.plot is not None:
        draw(args.plot, summaries, run.folder, f"{run.info['algo']} on {run.info['env']}, delay {run.info['delay']}")
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
    with answering(run.model, answer), tqdm(total=n_episodes, desc=label, unit="episode", leave=False) as bar:
        played = run.play(n_episodes, seed, n_envs, deterministic=deterministic, on_episode=lambda *_: bar.update())
        latency = None
        if latency_calls > 0:
            observations = collect_observations(run.make_env, min(latency_calls, 100), seed)
            latency = measure_latency(run.model, observations, latency_calls, deterministic, run.normalize)
    return Summary.from_episodes(label, played.returns, played.lengths, latency)


def print_table(summaries: list[Summary]) -> None:
    """Print one line for each answer."""
    width = max(10, *(len(s.label) for s in summaries))
    print(f"{'':{width}} {'mean return':>12} {'95 % interval':>24} {'length':>8}   decision latency")
    for s in summaries:
        interval = f"[{s.mean_return.low:,.1f}, {s.mean_return.high:,.1f}]"
        speed = "not measured" if s.latency is None else str(s.latency)
        print(f"{s.label:{width}} {s.mean_return.value:12,.1f} {interval:>24} {s.mean_length.value:8,.1f}   {speed}")


def draw(path: Path, summaries: list[Summary], folder: Path, title: str) -> None:
    """Draw the returns, and beside them the training curves whose files lie in the run folder.

    :param title: names the task and its delay
    """
    drawings: list[Any] = [partial(plots.plot_returns, summaries)]
    if any(folder.glob("*monitor.csv")):
        drawings.append(partial(plots.plot_learning_curve, folder))
    headers = [path.read_text().split("\n", 1)[0] for path in folder.glob("progress*.csv")]
    drawings += [
        partial(plots.plot_planner_errors, folder, kind)
        for kind in ("present", "action")
        if any(f"planner/{kind}_error" in header for header in headers)
    ]
    axes = plots.panels(len(drawings), title)
    for ax, drawing in zip(axes, drawings, strict=True):
        drawing(ax=ax)
    plots.save(axes[0], path)
