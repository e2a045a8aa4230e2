"""How fast the expert learns: updates of DelayedSAC beside SB3's SAC, turn by turn, on one thread.

    python benchmarks/expert_updates.py --json results/speed/expert_updates.json

Both make the same update (SB3's default networks and batch, Hopper-v5) on a replay buffer of their own, sampling
included. "floor" is the time of the matrix products alone, counted from their shapes, at the rate that large products
of the same number format reach on this machine and thread count.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import torch as th
from measure import dtype_name, matmul_rates, parser, percentiles, print_table, ratio, turn_by_turn, write_json
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_said import DelayedObservationWrapper, DelayedSAC

UPDATES_PER_TURN = 20


def make(cls: type[OffPolicyAlgorithm], delay: int | None, args: argparse.Namespace, **kwargs: Any) -> Any:
    """Return an agent with a replay buffer of random steps, ready to update."""
    env = gym.make(args.env)
    if delay is not None:
        env = DelayedObservationWrapper(env, delay=delay)
    name = "MlpPolicy" if delay is None else "MultiInputPolicy"
    model = cls(name, env, seed=0, learning_starts=args.steps, buffer_size=10_000, device=args.device, **kwargs)
    model.set_logger(Logger(None, []))
    return model.learn(args.steps, log_interval=None)


def matmul_flops(model: DelayedSAC, batch_size: int) -> int:
    """Count the floating-point operations of one update's matrix products, as autograd needs them.

    A product forward takes two operations a weight and row; backward as many for the input's gradient and as many for
    the weights'. The actor runs for this state and the next, with one pass back to its weights; the critics run three
    times (target, fit, actor's loss), with one pass back to their weights and one to their input.
    """

    def weights(net: Any) -> tuple[int, int]:
        sizes = [size for size, shape in zip(net.sizes, net.shapes, strict=True) if len(shape) == 3]
        return sum(sizes), sizes[0]

    actor, first_actor = weights(model.actor.net)
    critic, first_critic = weights(model.critic.net)
    actor_passes = 2 * actor + (2 * actor - first_actor)  # no gradient for the data
    critic_passes = 3 * critic + (2 * critic - first_critic) + critic
    return 2 * batch_size * (actor_passes + critic_passes)


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    p = parser(__doc__)
    p.add_argument("--env", default="Hopper-v5", help="gymnasium task, for its sizes")
    p.add_argument("--delay", type=int, default=4, help="of the delayed rows")
    p.add_argument("--batch-size", type=int, default=256)
    p.add_argument("--steps", type=int, default=2000, help="random steps in the replay buffers")
    p.set_defaults(num_threads=1, rounds=40)
    return p.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Run the command line."""
    args = parse(argv)
    th.set_num_threads(args.num_threads or th.get_num_threads())

    models = {
        "SB3's SAC": make(SAC, None, args),
        "DelayedSAC, float32": make(DelayedSAC, None, args, precision="float32"),
        "DelayedSAC, auto": make(DelayedSAC, None, args, precision="auto"),
        f"DelayedSAC at delay {args.delay}, auto": make(DelayedSAC, args.delay, args, precision="auto"),
    }
    seconds = turn_by_turn(
        {name: lambda m=m: m.train(UPDATES_PER_TURN, args.batch_size) for name, m in models.items()},
        args.rounds,
        args.device,
    )
    rates = matmul_rates(args.device)
    rows = []
    for name, model in models.items():
        each = seconds[name] / UPDATES_PER_TURN
        row: dict[str, Any] = {"updates": name, **percentiles(each), "per second": float(1 / each.mean())}
        row["times SB3's SAC"] = ratio(seconds["SB3's SAC"], seconds[name])
        floor = None
        if isinstance(model, DelayedSAC):
            rate = rates[dtype_name(model.precision, model.device)]
            floor = matmul_flops(model, args.batch_size) / rate / float(each.mean())
        row["fraction of floor"] = floor
        rows.append(row)
    print_table(rows)
    write_json(args.json, args, rows, matmul_flops_per_second=rates)


if __name__ == "__main__":
    main()
