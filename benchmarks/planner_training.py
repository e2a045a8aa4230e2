"""How fast the planner trains: updates of PlannerTrainer beside the same planner trained the plain way, turn by turn.

    python benchmarks/planner_training.py --json results/speed/planner_training.json
    python benchmarks/planner_training.py --num-threads 1      # one run per core, as a sweep uses a small machine
    python benchmarks/planner_training.py --device cuda --rounds 200

Every row makes whole updates, from drawing the windows to the averaged weights, on made-up episodes of Hopper-v5's
sizes. Ours also train the regression yardstick. Otherwise both ways do the same work, since ours have no first guess.
There is a row in bfloat16 where the device multiplies it in hardware. "plain" is benchmarks/plain.py: eager float32, a
DataLoader, and an optimizer and an average that go parameter by parameter. "times plain" is the median of the ratios
turn by turn, with its 95 % interval: above 1 is faster than plain.
"floor" is the time of the transformer's matrix products alone. It follows from their shapes and the rate that large
products of the same number format reach on this machine and thread count. "fraction of floor" is the floor over the
median time of an update.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch as th
from measure import matmul_rates, parse, parser, percentiles, progress, ratio, report, turn_by_turn
from plain import PlainPlanner, WindowDataset, batches

from sb3_said.planner import InpaintingPlanner, PlannerConfig, PlannerTrainer
from sb3_said.replay.windows import WindowSource

OBS_DIM, ACT_DIM = 11, 3  # Hopper-v5
N_TIME_FEATURES = 32
GRADIENT_STEPS = 1_000_000  # the learning rate must not reach its end while measuring


def make_source(n_episodes: int = 50, length: int = 400) -> WindowSource:
    """Return random episodes of one length."""
    generator = th.Generator().manual_seed(0)
    n = n_episodes * length
    step = th.arange(length).repeat(n_episodes)
    return WindowSource(
        states=th.randn(n, 1, OBS_DIM, generator=generator),
        actions=th.rand(n, 1, ACT_DIM, generator=generator) * 2 - 1,
        rewards=th.zeros(n, 1),
        terminated=th.zeros(n, 1, dtype=th.bool),
        rows=th.arange(n),
        envs=th.zeros(n, dtype=th.int64),
        remaining=length - step,
        values=th.rand(n, generator=generator),
        episodes=th.arange(n_episodes).repeat_interleave(length),
    )


def matmul_flops(batch_size: int, window: int, d_model: int, depth: int, delay: int) -> int:
    """Count the floating-point operations of the matrix products in one update of the transformer.

    Forward there are two operations for each weight and row, backward twice as many.

    :param window: L, tokens of a window
    :param delay: D, known actions whose embedding every token gets
    """
    in_dim, d = OBS_DIM + ACT_DIM, d_model
    attention = 2 * window * d  # scores and mixing, of each token with every other
    per_token = (in_dim + 2) * d + depth * (12 * d * d + attention) + d * in_dim
    known = (OBS_DIM + delay * (ACT_DIM + 1)) * d + d * d
    per_window = N_TIME_FEATURES * d + d * d + known + d * (6 * depth + 2) * d
    return 3 * 2 * batch_size * (window * per_token + per_window)


def make_trainer(depth: int, precision: str, args: argparse.Namespace, source: WindowSource) -> PlannerTrainer:
    config = PlannerConfig(
        depth=depth,
        d_model=args.d_model,
        horizon=args.horizon,
        batch_size=args.batch_size,
        precision=precision,
        first_guess="none",
    )
    planner = InpaintingPlanner(OBS_DIM, ACT_DIM, args.delay, config).to(args.device)
    return PlannerTrainer(planner, source, GRADIENT_STEPS, held_out=0.0)


def measure(depth: int, rates: dict[str, float], args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of one depth.

    :param rates: FLOP/s of large products, by the number formats to train in
    """
    source = make_source()
    window = args.delay + args.horizon
    plain = PlainPlanner(OBS_DIM, ACT_DIM, args.delay, window, args.d_model, depth, device=args.device)
    loader = batches(WindowDataset(source.sample(10 * args.batch_size, window)), args.batch_size)
    variants: dict[str, Any] = {"plain": lambda: plain.update(next(loader))}
    variants |= {f"ours, {precision}": make_trainer(depth, precision, args, source).step for precision in rates}
    progress(f"{args.rounds} turns of one update at depth {depth}: {'; '.join(variants)}")
    for update in variants.values():
        for _ in range(4):  # a GPU records its graph in the fourth
            update()
    seconds = turn_by_turn(variants, args.rounds, args.device)

    flops = matmul_flops(args.batch_size, window, args.d_model, depth, args.delay)
    rows = []
    for (name, each), rate in zip(seconds.items(), (rates["float32"], *rates.values()), strict=True):
        median, floor = float(np.median(each)), flops / rate
        rows.append(
            {
                "updates": name,
                "depth": depth,
                **percentiles(each),
                "per second": 1 / median,
                "times plain": ratio(seconds["plain"], each),
                "floor_ms": 1e3 * floor,
                "fraction of floor": floor / median,
            }
        )
    return rows


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, print, write, and return the rows."""
    p = parser(__doc__)
    p.add_argument("--depth", type=int, nargs="+", default=[2, 8], help="blocks of the transformer")
    p.add_argument("--d-model", type=int, default=256, help="its width, a multiple of 32")
    p.add_argument("--delay", type=int, default=8, help="known actions; a window is delay + horizon steps")
    p.add_argument("--horizon", type=int, default=8)
    p.add_argument("--batch-size", type=int, default=256)
    p.set_defaults(rounds=20)
    args = parse(p, argv)
    rates = matmul_rates(args)
    rows = [row for depth in args.depth for row in measure(depth, rates, args)]
    return report(args, rows, matmul_flops_per_second=rates)


if __name__ == "__main__":
    main()
