"""Learning curves of DelayedSAC and of SB3's SAC at delay 0: are faster updates still as good?

    python benchmarks/learning_curves.py --trainer sb3 --seed 0        # one run: 45 minutes on one core
    python benchmarks/learning_curves.py --trainer bfloat16 --seed 0   # 25 minutes
    python benchmarks/learning_curves.py --compare                     # table and plot of all runs so far

All trainers get the same networks, batches, schedule and evaluation episodes. A seed counts as one value: the area
under its curve (the mean return of all its evaluations). ``p`` is the share of all ways to deal the seeds out to the
two trainers that set their means at least as far apart as they are (permutation test); with three seeds each it
cannot be below 0.1.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch as th
from measure import print_table
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from sb3_said import DelayedSAC
from sb3_said.evaluation import bootstrap_interval, rollout
from sb3_said.evaluation.plots import COLORS, panels, save
from sb3_said.files.atomic import write_text

RESULTS = Path(__file__).parent.parent / "results" / "expert_updates"
# What the runs share: SB3's defaults (networks of 256 x 256, batch 256, 3e-4), rl_zoo3's learning_starts for Hopper.
SETTINGS = {"learning_starts": 10_000, "batch_size": 256}
EVAL_SEED = 10_000  # episode i of an evaluation starts from reset(seed=EVAL_SEED + i)
TRAINERS: dict[str, Any] = {
    "sb3": lambda env, seed: SAC("MlpPolicy", env, seed=seed, **SETTINGS),
    "float32": lambda env, seed: DelayedSAC("MlpPolicy", env, seed=seed, precision="float32", **SETTINGS),
    "bfloat16": lambda env, seed: DelayedSAC("MlpPolicy", env, seed=seed, precision="bfloat16", **SETTINGS),
}
LABELS = {"sb3": "SB3's SAC", "float32": "DelayedSAC, float32", "bfloat16": "DelayedSAC, bfloat16"}


class Evaluation(BaseCallback):
    """Play whole episodes with the mean action every ``every`` steps, and keep their returns."""

    def __init__(self, env_id: str, every: int, n_episodes: int):
        super().__init__()
        self.env_id, self.every, self.n_episodes = env_id, every, n_episodes
        self.curve: dict[str, list[Any]] = {"steps": [], "returns": []}

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            played = rollout(self.model, self.env_id, self.n_episodes, EVAL_SEED, n_envs=self.n_episodes)
            self.curve["steps"].append(self.num_timesteps)
            self.curve["returns"].append(played.returns.round(2).tolist())
            print(f"{self.num_timesteps:>8,} steps, return {played.returns.mean():8.1f}", flush=True)
        return True


def train(args: argparse.Namespace) -> None:
    """Make one run and write its curve."""
    th.set_num_threads(args.num_threads)
    model = TRAINERS[args.trainer](Monitor(gym.make(args.env)), args.seed)
    evaluation = Evaluation(args.env, args.eval_freq, args.eval_episodes)
    model.learn(args.steps, callback=evaluation)
    result = {
        "trainer": args.trainer,
        "env": args.env,
        "seed": args.seed,
        "steps": args.steps,
        "num_threads": args.num_threads,
        "settings": SETTINGS,
        "eval_seed": EVAL_SEED,
        "versions": {
            "python": platform.python_version(),
            "torch": th.__version__,
            "stable_baselines3": stable_baselines3.__version__,
            "gymnasium": gym.__version__,
        },
        "curve": evaluation.curve,
    }
    path = args.results / f"{args.env}_{args.trainer}_seed{args.seed}.json"
    write_text(path, json.dumps(result) + "\n")
    print(f"wrote {path.name}")


def compare(args: argparse.Namespace) -> None:
    """Print a table of all runs in the results folder, and draw their curves."""
    runs: dict[str, list[dict[str, Any]]] = {}
    for file in sorted(args.results.glob(f"{args.env}_*_seed*.json")):
        run = json.loads(file.read_text())
        runs.setdefault(run["trainer"], []).append(run)
    if "sb3" not in runs:
        raise SystemExit(f"{args.results} holds no run of SB3's SAC on {args.env}; make one with --trainer sb3.")
    ax = panels(width=7)[0]
    rows = []
    names = [name for name in TRAINERS if name in runs]
    areas = {name: np.array([np.mean(run["curve"]["returns"]) for run in runs[name]]) for name in names}
    for color, name in zip(COLORS, names, strict=False):
        curves = np.array([np.mean(run["curve"]["returns"], axis=1) for run in runs[name]])  # (seeds, evaluations)
        steps = runs[name][0]["curve"]["steps"]
        ax.plot(steps, curves.T, color=color, alpha=0.35, linewidth=1)
        ax.plot(steps, curves.mean(0), color=color, linewidth=2.5, label=f"{LABELS[name]}, {len(curves)} seeds")
        rows.append(
            {
                "trainer": LABELS[name],
                "seeds": len(curves),
                "mean return of all evaluations": bootstrap_interval(areas[name]),
                "of the last five": bootstrap_interval(curves[:, -5:].mean(1)),
                "p against SB3's SAC": permutation_p(areas["sb3"], areas[name]),
            }
        )
    print_table(rows)
    ax.set_xlabel("environment steps")
    ax.set_ylabel("return of an episode (undiscounted)")
    ax.legend(frameon=False)
    save(ax, args.results / f"{args.env}.png")


def permutation_p(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of all ways to deal the values out that set the means at least as far apart as they are."""
    values, n = np.concatenate([first, second]), len(first)
    deals = [list(deal) for deal in itertools.combinations(range(len(values)), n)]
    apart = [abs(values[deal].mean() - np.delete(values, deal).mean()) for deal in deals]
    return float(np.mean(np.array(apart) >= apart[0] - 1e-9))  # the first deal is the one that was made


def main(argv: list[str] | None = None) -> None:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--trainer", choices=TRAINERS, help="what to train")
    p.add_argument("--compare", action="store_true", help="print and draw what the results folder holds")
    p.add_argument("--env", default="Hopper-v5", help="gymnasium task")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--steps", type=int, default=200_000, help="environment steps")
    p.add_argument("--eval-freq", type=int, default=10_000, help="environment steps between evaluations")
    p.add_argument("--eval-episodes", type=int, default=10, help="of each evaluation")
    p.add_argument("--num-threads", type=int, default=1, help="torch threads: one, so that two runs share two cores")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder of the curves")
    args = p.parse_args(argv)
    if args.trainer is None and not args.compare:
        p.error("give --trainer, --compare or both")
    if args.trainer is not None:
        train(args)
    if args.compare:
        compare(args)


if __name__ == "__main__":
    main()
