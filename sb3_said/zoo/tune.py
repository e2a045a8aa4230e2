"""Search the planner's depth, and how it decides, for a trained SAID run. All trials share its expert and replay."""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch as th
from filelock import FileLock
from optuna import Study
from optuna.trial import FrozenTrial

from sb3_said import SAID
from sb3_said.evaluation import Latency, Summary
from sb3_said.files.atomic import write_json
from sb3_said.files.checkpoint import CHECKPOINT_NAME
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.zoo.arguments import TRUST, check_positive, device, explained, make_parser, reset_seed
from sb3_said.zoo.best import write_best
from sb3_said.zoo.depths import DepthPlanners
from sb3_said.zoo.evaluate import evaluate, print_table
from sb3_said.zoo.folder import TUNED_NAME, TUNED_SETTINGS, resuming
from sb3_said.zoo.record import RECORD_NAME, Record
from sb3_said.zoo.runs import LoadedRun, answers, load_run, origin
from sb3_said.zoo.search import (
    DRAWN,
    OWN_STUDY,
    describe,
    find_winner,
    finished,
    open_study,
    returns_of,
    save_plot,
    search,
)

RESULTS_NAME = "results.json"
EPILOG = f"""\
examples:
  # the default: three planners are trained, each is tried at six temperatures
  sb3-said tune logs/said/Hopper-v5-delay4-seed1_1

  # two workers; they may run on machines that share the folder
  sb3-said tune logs/said/Hopper-v5-delay4-seed1_1 & sb3-said tune logs/said/Hopper-v5-delay4-seed1_1

  # a quick look: one depth, fewer updates, fewer episodes, in a folder of its own
  sb3-said tune logs/said/Hopper-v5-delay4-seed1_1 --depths 2 --gradient-steps 1000 --episodes 10 --output look

  # how the critics choose: the larger the factor, the more the best candidate decides; 100 hardly asks another
  sb3-said tune logs/said/Hopper-v5-delay4-seed1_1 --depths 2 --temperatures 0.5 1 --choice-factors 0.3 1 3 100

  # any temperature from 0 to 1, fewer denoising steps, in a data base
  sb3-said tune logs/said/Hopper-v5-delay4-seed1_1 --sampler tpe --n-trials 30 --sampling-steps 1 2 5 \\
      --storage sqlite:///tune.db

  # then train with the winner, or play it
  sb3-said train --algo said --env Hopper-v5 --delay 4 -conf logs/said/Hopper-v5-delay4-seed1_1/tune/best.yml
  sb3-said evaluate logs/said/Hopper-v5-delay4-seed1_1/tune/best.zip

The search keeps the run's expert and replay, and trains one planner per depth. Every trial plays the same episodes. A
trial that is clearly worse than the best, episode by episode, is pruned. The best of many trials looks better on these
episodes than it is: the report plays the winner and the expert on others.
Give the same command again to go on after a crash. The output folder holds the planners, study.log (the study),
results.json, best.yml, best.zip and slice.png; each worker writes the report when it ends.
{TRUST}
"""
DEPTHS, TEMPERATURES = [2, 4, 8], [0.0, 0.1, 0.3, 0.6, 0.8, 1.0]


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_DIR", help="folder that sb3-said train left")
    add("--depths", type=int, nargs="+", default=DEPTHS, metavar="N", help="network depths (default: 2 4 8)")
    add("--temperatures", type=float, nargs="+", default=TEMPERATURES, metavar="T", help="default: 0 0.1 0.3 0.6 0.8 1")
    add("--sampling-steps", type=int, nargs="+", metavar="N", help="denoising steps (default: as the run's)")
    add("--choice-factors", type=float, nargs="+", metavar="BETA", help="how much the critics' scores weigh among the "
        "candidates; without effect at temperature 0 (default: as the run's)")  # fmt: skip
    add("--sampler", choices=("grid", "tpe"), default="grid", help="grid tries every cell once; tpe draws temperatures "
        "and choice factors between the lowest and the highest (default: grid)")  # fmt: skip
    add("--n-trials", type=int, help="trials of the whole study (default: as many as the grid has)")
    add("--gradient-steps", type=int, help="updates of each planner (default: as the run's)")
    add("--episodes", type=int, default=20, help="episodes of a trial (default: 20)")
    add("--round", type=int, default=5, help="episodes played between two decisions on pruning (default: 5)")
    add("--prune", type=float, default=0.05, metavar="P", help="p-value of the paired test below which a trial is "
        "pruned; 0: never (default: 0.05)")  # fmt: skip
    add("--seed", type=reset_seed, default=20_000, help="reset seed of the first episode (default: 20000)")
    add("--report-episodes", type=int, default=50, help="episodes that report the winner and the expert (default: 50)")
    add("--report-seed", type=reset_seed, default=10_000, help="reset seed of the first of them (default: 10000)")
    add("--storage", help="Optuna RDB URL, or path of a journal file (default: study.log in the output folder)")
    add("--study-name", help="default: the run folder's name")
    add("--output", type=Path, metavar="DIR", help="default: RUN_DIR/tune")
    add("--timeout", type=float, default=math.inf, metavar="SECONDS", help="begin no trial after this time")
    add("--device", type=device, default="auto", help="torch device (default: auto)")
    add("--num-threads", type=int, default=1, help="torch threads, which wait for each other beside another process "
        "(default: 1)")  # fmt: skip
    add("-P", "--progress", action="store_true", help="show a progress bar while a planner trains")
    args = parser.parse_args(argv)
    with explained(parser, goes_on=True):
        check(args)
        th.set_num_threads(args.num_threads)
        tune(args)


def check(args: argparse.Namespace) -> None:
    """Check the options.

    :raises ValueError: naming the option that is wrong
    """
    check_positive(args, "episodes", "round", "report_episodes", "n_trials", "gradient_steps", "num_threads")
    if not 0 <= args.prune < 1:
        raise ValueError(f"--prune is a p-value in [0, 1), got {args.prune}; 0 prunes nothing.")
    for name in ("depths", "temperatures", "sampling_steps", "choice_factors"):
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
    """Train the planners, make the trials and report.

    :raises ValueError: when the run cannot be tuned, or the output folder holds another search
    """
    began = time.monotonic()
    run, model = open_run(args)
    folder = args.output or args.run / "tune"
    if (folder / RECORD_NAME).is_file() and not (folder / TUNED_SETTINGS).is_file():
        raise ValueError(
            f"{folder} is the folder of a run, whose {RECORD_NAME} would be replaced: give another --output."
        )
    read_report(folder / RESULTS_NAME)  # refuse now a file that is no report, not after the trials
    dataset = Record.read(args.run).dataset
    planners = DepthPlanners(model, args.run / CHECKPOINT_NAME, folder, args.gradient_steps, args.progress, dataset)
    steps = args.sampling_steps or [planners.config.sampling_steps]
    tried = {"depth": args.depths, "temperature": args.temperatures, "sampling_steps": steps}
    tried |= {"choice_factor": args.choice_factors} if args.choice_factors else {}
    for name, values in tried.items():
        for value in values:
            replace(planners.config, **{name: value})  # raises for a value out of range
    common = {"sampler": args.sampler, "episodes": args.episodes, "seed": args.seed}
    common |= {"env": run.info["env"], "delay": run.info["delay"]}
    common |= {**planners.config.to_dict(), **planners.training(planners.config.depth)}
    common = {key: value for key, value in common.items() if key not in tried}
    if args.sampler == "tpe":
        common |= tried | {name: [min(tried[name]), max(tried[name])] for name in DRAWN if name in tried}
    storage = args.storage or str(folder / OWN_STUDY)
    study = open_study(folder, storage, args.study_name, common, args.prune, args.run.resolve().name)
    print(
        f"{common['env']}, delay {common['delay']}: {len(finished(study))} trials are finished in {storage}", flush=True
    )

    def play(seed: int, n: int) -> list[float]:
        return [float(value) for value in run.play(n, seed, n, answer="planner").returns]

    planners.train(args.depths)
    left = args.timeout - (time.monotonic() - began)
    how = {"sampler": args.sampler, "n_trials": args.n_trials, "round_size": args.round, "timeout": left}
    search(study, tried, planners.put, play, episodes=args.episodes, seed=args.seed, **how)
    with FileLock(folder / "report.lock"):
        winner = find_winner(study)  # under the lock nobody else reports one
        if winner is None:
            raise ValueError("No trial is finished, so there is no winner: give more --timeout or --n-trials.")
        planners.put(**winner.params)
        report(args, run, study, winner, folder)


def open_run(args: argparse.Namespace) -> tuple[LoadedRun, SAID]:
    """Open the run to tune.

    :raises ValueError: when it is not a run of SAID with its replay
    """
    if (args.run / TUNED_SETTINGS).is_file():
        of_it = f"{args.run.parent}, " * (args.run.parent / RECORD_NAME).is_file()  # unless --output said otherwise
        raise ValueError(f"{args.run} is what sb3-said tune found: give {of_it}the run that it searched.")
    run = load_run(args.run, device=args.device)
    if not isinstance(run.model, SAID):
        raise ValueError(f"{args.run} is a run of '{run.info['algo']}', which has no planner; give one of --algo said.")
    if not Record.read(args.run).dataset and not (args.run / CHECKPOINT_NAME).is_file():
        raise ValueError(
            f"{args.run} has no {CHECKPOINT_NAME}, whose replay the planners are trained on; give the folder that the "
            "training left, and finish the run if it was stopped: "
            f"sb3-said train {resuming(args.run)}"
        )
    if run.normalize is not None:  # the bound method of the run's VecNormalize, which the replay needs too
        run.model._vec_normalize_env = run.normalize.__self__  # type: ignore[attr-defined]
    return run, run.model


def read_report(file: Path) -> dict[str, Any]:
    """Return what an earlier call has reported, ``{}`` where there was none.

    :raises ValueError: for a file of something else
    """
    try:
        return dict(json.loads(file.read_text())["report"]) if file.is_file() else {}
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{file} holds something else than what sb3-said tune writes: give another --output."
        ) from error


def report(args: argparse.Namespace, run: LoadedRun, study: Study, winner: FrozenTrial, folder: Path) -> None:
    """Play the winner, which the agent has, and the expert on fresh episodes; write the files and print a summary."""
    results = folder / RESULTS_NAME
    fresh = {"study": study.study_name, "trial": winner.number, "finished": str(winner.datetime_complete)}
    fresh |= {"seed": args.report_seed, "n_episodes": args.report_episodes}
    before = read_report(results)
    if fresh.items() <= before.items():  # another worker has played it, or an earlier call
        played = before["results"]
    else:
        how = (args.report_episodes, args.report_seed)
        played = [
            evaluate(run, answer, *how, latency_calls=100).to_dict()
            for answer in ("planner", "expert")
            if answer in answers(run.model)
        ]
    run.model.save(folder / TUNED_NAME)
    trials = [trial_to_dict(trial) for trial in finished(study)]
    choice = f"{', '.join(winner.params)}: the best of {len(trials)} trials, mean return {winner.value:.1f} over "
    choice += f"{args.episodes} episodes; how the planner decides beyond that: as the run does"
    assert isinstance(run.model, SAID)  # open_run has seen to it
    decides = {name: getattr(run.model.policy.planner.config, name) for name in ("mask", *SAMPLING_SETTINGS)}
    n_updates = int(run.model.policy.planner_updates)
    command = write_best(args.run, folder, decides | winner.params, n_updates, choice)
    document = {
        **run.info,
        "settings": study.user_attrs["settings"],
        "trials": trials,
        "winner": {**trial_to_dict(winner), "agent": str(folder / TUNED_NAME)},
        "report": {**fresh, "deterministic": True, "results": played},
        "origin": origin(run),
    }
    write_json(results, document)

    pruned = sum(trial["state"] == "PRUNED" for trial in trials)
    print(f"\n{len(trials)} trials, {pruned} of them pruned. Best: {describe(winner.params)}, mean return "
          f"{winner.value:,.1f} on the episodes it was chosen by.")  # fmt: skip
    print(f"On {args.report_episodes} other episodes:")
    rows = (Summary.from_episodes(p["label"], p["returns"], p["lengths"], Latency(**p["latency"])) for p in played)
    print_table([("last", row) for row in rows])
    if find_spec("matplotlib") is None:
        print('No plot: it needs matplotlib, pip install "sb3_said[plots]"')
    else:
        title = f"{run.info['env']}, delay {run.info['delay']}: mean of {args.episodes} episodes, by setting"
        save_plot(study, folder / "slice.png", title)
    print(f"Wrote results.json, {TUNED_SETTINGS} and {TUNED_NAME} in {folder}\nTrain with it: {command}")


def trial_to_dict(trial: FrozenTrial) -> dict[str, Any]:
    """Return what results.json keeps of a trial."""
    returns = returns_of(trial)
    return {
        "number": trial.number,
        "state": trial.state.name,
        **trial.params,
        "mean_return": sum(returns) / len(returns),
        "n_episodes": len(returns),
        "returns": returns,
        "seconds": None if trial.duration is None else trial.duration.total_seconds(),
    }
