"""Search the planner's depth, temperature and denoising steps for a trained SAID run, sharing its expert and replay."""

from __future__ import annotations

import argparse
import json
import time
from argparse import Namespace
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch as th
from optuna.trial import FrozenTrial

from sb3_said import SAID
from sb3_said.evaluation import bootstrap_interval, rollout
from sb3_said.files.atomic import write_json
from sb3_said.files.checkpoint import CHECKPOINT_NAME
from sb3_said.zoo.evaluate import evaluate
from sb3_said.zoo.locks import try_acquire, work_lock
from sb3_said.zoo.runs import ANSWERS, LoadedRun, load_run, origin
from sb3_said.zoo.study import Search, describe, returns_of, save_plots
from sb3_said.zoo.tuning import DepthPlanners
from sb3_said.zoo.winner import RunConfig

EPILOG = """\
examples:
  # the paper's grid: three planners are trained, each is tried at six temperatures
  python scripts/tune.py --run logs/said/Hopper-v5-delay4_1

  # the same with two workers, here or on machines that share the folder; run it again to go on after a crash
  python scripts/tune.py --run logs/said/Hopper-v5-delay4_1 --num-threads 1 & \\
  python scripts/tune.py --run logs/said/Hopper-v5-delay4_1 --num-threads 1

  # a quick look: one depth, fewer updates, fewer episodes, into a folder of its own
  python scripts/tune.py --run logs/said/Hopper-v5-delay4_1 --depths 2 --gradient-steps 5000 --episodes 10 \\
      --output look

  # one denoising step is the mean of the likely plans: worse on one task, better and five times as fast on another
  python scripts/tune.py --run logs/said/HalfCheetah-v5-delay0-16_1 --depths 2 --temperatures 0 --sampling-steps 1 2 5

  # any temperature from 0 to 1, in a data base
  python scripts/tune.py --run logs/said/Hopper-v5-delay4_1 --sampler tpe --n-trials 30 --storage sqlite:///tune.db

  # afterwards: train with the winner, or play it
  python scripts/train.py --algo said --env Hopper-v5 --delay 4 -conf logs/said/Hopper-v5-delay4_1/tune/best.yml
  python scripts/evaluate.py logs/said/Hopper-v5-delay4_1/tune/best.zip

A run is what train.py --algo said left: its expert collects nothing more, its replay trains one planner per depth.
Every trial plays the same episodes, --seed and up; one that is clearly worse than the best, episode by episode, is
pruned. The winner, and the expert beside it, are reported on other episodes, --report-seed and up, since the best of
many trials looks better on its own episodes than it is.

Written to RUN_DIR/tune: planner_depthN.zip, study.log (the study), and by the worker that ends last results.json,
best.yml, best.zip, importance.png and slice.png.
A run folder's YAML can run code (rl_zoo3 reads it so): open only folders that you trust.
"""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path, required=True, metavar="RUN_DIR", help="folder that train.py left")
    parser.add_argument("--depths", type=int, nargs="+", default=[2, 4, 8], metavar="N", help="default: 2 4 8")
    parser.add_argument(
        "--temperatures",
        type=float,
        nargs="+",
        default=[0.0, 0.1, 0.3, 0.6, 0.8, 1.0],
        metavar="T",
        help="default: 0 0.1 0.3 0.6 0.8 1",
    )
    parser.add_argument(
        "--sampling-steps", type=int, nargs="+", metavar="N", help="denoising steps (default: as the run's)"
    )
    parser.add_argument("--sampler", choices=("grid", "tpe"), default="grid", help="default: grid, every cell once")
    parser.add_argument("--n-trials", type=int, help="trials of the whole study (default: as many as the grid has)")
    parser.add_argument("--gradient-steps", type=int, help="updates of each planner (default: as the run's)")
    parser.add_argument("--episodes", type=int, default=20, help="whole episodes of a trial (default: 20)")
    parser.add_argument(
        "--round", type=int, default=5, help="episodes side by side, between two looks at pruning (default: 5)"
    )
    parser.add_argument(
        "--prune",
        type=float,
        default=0.05,
        metavar="P",
        help="p-value of the paired test below which a trial is pruned; 0: never (default: 0.05)",
    )
    parser.add_argument("--seed", type=int, default=20_000, help="reset seed of the first episode (default: 20000)")
    parser.add_argument("--report-episodes", type=int, default=50, help="of the winner and the expert (default: 50)")
    parser.add_argument(
        "--report-seed", type=int, default=10_000, help="reset seed of the first of those (default: 10000)"
    )
    parser.add_argument(
        "--storage", help="Optuna RDB URL, or path of a journal file (default: study.log in the output folder)"
    )
    parser.add_argument("--study-name", help="default: the run folder's name")
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: RUN_DIR/tune")
    parser.add_argument("--timeout", type=float, metavar="SECONDS", help="begin no trial after this time")
    parser.add_argument("--device", default="auto", help="torch device (default: auto)")
    parser.add_argument("--num-threads", type=int, help="torch threads (default: torch's own choice)")
    parser.add_argument("-P", "--progress", action="store_true", help="show a progress bar while a planner trains")
    return parser


def main(argv: list[str] | None = None) -> None:
    parser = make_parser()
    args = parser.parse_args(argv)
    if args.num_threads is not None:
        th.set_num_threads(args.num_threads)
    try:
        check(args)
        tune(args)
    except ValueError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        parser.exit(130, "\nInterrupted; the same command goes on.\n")


def check(args: argparse.Namespace) -> None:
    """
    :raises ValueError: for options that make no search
    """
    for name in ("episodes", "round", "report_episodes", "n_trials", "gradient_steps"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {value}.")
    if not 0 <= args.prune < 1:
        raise ValueError(f"--prune is a p-value in [0, 1), got {args.prune}; 0 prunes nothing.")
    if args.prune > 0 and find_spec("scipy") is None:
        raise ValueError("Pruning needs SciPy: pip install scipy, or give --prune 0.")
    for name in ("depths", "temperatures", "sampling_steps"):
        values = getattr(args, name) or []
        if len(set(values)) < len(values):
            option = name.replace("_", "-")
            raise ValueError(f"--{option} names a value twice: {' '.join(f'{value:g}' for value in values)}.")
    if args.seed < args.report_seed + args.report_episodes and args.report_seed < args.seed + args.episodes:
        raise ValueError(
            f"Tuning would play the reset seeds {args.seed}..{args.seed + args.episodes - 1} and the report "
            f"{args.report_seed}..{args.report_seed + args.report_episodes - 1}: a report on episodes that were tuned "
            "on is too good. Move --report-seed or --seed so that they do not overlap."
        )


def tune(args: argparse.Namespace) -> None:
    """Search, and report unless another worker is still searching.

    :raises ValueError: when the run cannot be tuned, or the output folder holds another search
    """
    run, model = open_run(args)
    folder = args.output or args.run / "tune"
    planners = DepthPlanners(model, args.run / CHECKPOINT_NAME, folder, args.gradient_steps, args.progress)
    tried = {
        "depth": args.depths,
        "temperature": args.temperatures,
        "sampling_steps": args.sampling_steps or [planners.config.sampling_steps],
    }
    for name, values in tried.items():
        for value in values:
            replace(planners.config, **{name: value})
    settings = {**planners.trial_settings(), "env": run.info["env"], "delay": run.info["delay"]}
    search = Search(
        folder,
        args.storage or str(folder / "study.log"),
        args.study_name or args.run.resolve().name,
        tried,
        args.sampler,
        args.n_trials,
        args.episodes,
        args.round,
        args.seed,
        args.prune,
        settings,
    )
    n_before = len(search.finished())
    print(
        f"{run.info['env']}, delay {run.info['delay']}: {n_before} trials are finished in {search.storage}", flush=True
    )

    def play(seed: int, n: int) -> list[float]:
        played = rollout(model, run.make_env, n, seed, n, deterministic=True, normalize=run.normalize)
        return [float(value) for value in played.returns]

    made = search.work(planners, play, None if args.timeout is None else time.monotonic() + args.timeout)
    if made == 0 and args.timeout is None:
        print("No trial is left to make.")

    others = search.running()
    if others:
        print(f"{len(others)} trials are still running in other workers; the last worker reports.")
        return
    winner = search.winner()
    if winner is None:
        raise ValueError("No trial is finished, so there is no winner: give more --timeout or --n-trials.")
    reporting = work_lock(folder / "locks" / "report.lock")
    if not try_acquire(reporting):
        print("Another worker reports.")
        return
    try:
        report(args, run, search, planners, winner, folder)
    finally:
        reporting.release()


def open_run(args: argparse.Namespace) -> tuple[LoadedRun, SAID]:
    """Open the run to tune.

    :raises ValueError: when it is not a run of SAID with its replay
    """
    run = load_run(args.run, device=args.device)
    if not isinstance(run.model, SAID):
        raise ValueError(f"{args.run} is a run of '{run.info['algo']}', which has no planner; give one of --algo said.")
    if not args.run.is_dir() or not (args.run / CHECKPOINT_NAME).is_file():
        raise ValueError(
            f"{args.run} has no {CHECKPOINT_NAME}, whose replay the planners are trained on; give the folder that "
            "train.py left, and finish the run if it was stopped: python scripts/train.py --resume RUN_DIR"
        )
    if run.normalize is not None:  # the bound method of the run's VecNormalize, which the replay needs too
        run.model._vec_normalize_env = run.normalize.__self__  # type: ignore[attr-defined]
    return run, run.model


def report(
    args: argparse.Namespace,
    run: LoadedRun,
    search: Search,
    planners: DepthPlanners,
    winner: FrozenTrial,
    folder: Path,
) -> None:
    """Play the winner and the expert on fresh episodes and write everything that the search found."""
    planners.put(**winner.params)
    fresh = {
        "study": search.name,
        "trial": winner.number,
        "finished": str(winner.datetime_complete),
        "seed": args.report_seed,
        "n_episodes": args.report_episodes,
    }
    results = folder / "results.json"
    before = json.loads(results.read_text()).get("report", {}) if results.is_file() else {}
    if {key: before.get(key) for key in fresh} == fresh and (folder / "best.zip").is_file():
        played = before["results"]
    else:
        how = Namespace(
            episodes=args.report_episodes, seed=args.report_seed, n_envs=8, stochastic=False, latency_calls=100
        )
        played = [evaluate(run, answer, how).to_dict() for answer in ANSWERS]
    assert isinstance(run.model, SAID)
    run.model.save(folder / "best.zip")
    config = RunConfig.read(args.run)
    choice = (
        f"trial {winner.number} of {len(search.finished())} in study {search.name!r}, mean return "
        f"{winner.value:.1f} over {search.episodes} episodes"
    )
    left_out = config.write_best(folder, dict(winner.params), choice)

    trials = [trial_to_dict(trial, args.seed) for trial in search.finished()]
    document = {
        **run.info,
        "settings": search.study.user_attrs["settings"],
        "trials": trials,
        "winner": {**trial_to_dict(winner, args.seed), "agent": str(folder / "best.zip")},
        "report": {**fresh, "deterministic": True, "results": played},
        "origin": origin(run),
    }
    write_json(results, document)

    pruned = sum(trial["state"] == "PRUNED" for trial in trials)
    print(f"\n{len(trials)} trials, {pruned} of them pruned. Best: {describe(winner.params)}, mean return "
          f"{winner.value:,.1f} on the episodes it was chosen by.")  # fmt: skip
    print(f"On {args.report_episodes} other episodes:")
    for one in played:
        mean = one["mean_return"]
        interval = "" if mean["low"] is None else f"   95 % interval [{mean['low']:,.1f}, {mean['high']:,.1f}]"
        print(f"  {one['label']:8} {mean['value']:12,.1f}{interval}")
    try:
        plots = save_plots(search, folder)
    except ImportError:
        plots = []
        print('No plots: they need matplotlib, pip install "sb3_said[plots]"')
    for name in left_out:
        print(f"Left out of best.yml, as YAML cannot hold it: {name}")
    names = ["results.json", "best.yml", "best.zip", *(path.name for path in plots)]
    print(f"Wrote {', '.join(names)} in {folder}\nTrain with it: {config.train_command(folder)}")


def trial_to_dict(trial: FrozenTrial, seed: int) -> dict[str, Any]:
    """Return what results.json keeps of a trial."""
    returns = returns_of(trial)
    interval = bootstrap_interval(returns)
    return {
        "number": trial.number,
        "state": trial.state.name,
        **trial.params,
        "mean_return": interval.value,
        "interval": None if len(returns) < 2 else [interval.low, interval.high],
        "seed": seed,
        "n_episodes": len(returns),
        "returns": returns,
        "seconds": None if trial.duration is None else trial.duration.total_seconds(),
    }
