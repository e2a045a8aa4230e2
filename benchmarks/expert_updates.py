"""How fast the expert learns: updates of DelayedSAC beside SB3's SAC, turn by turn, on one thread.

    python benchmarks/expert_updates.py --json results/speed/expert_updates.json

All make the same update (SB3's default networks and batch, Hopper-v5) on a replay buffer of their own, sampling
included. "time, SAC's = 1" is the median of the ratios turn by turn, with its 95 % interval: above 1 is slower than
SB3's SAC. "fraction of floor" is the time of the matrix products alone over the time of an update. The products are
counted from their shapes, at the rate that large products reach on this machine and thread count.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
from measure import matmul_rates, parse, parser, percentiles, progress, ratio, report, turn_by_turn
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_said import DelayedObservationWrapper, DelayedSAC

UPDATES_PER_TURN = 20


def make(cls: type[SAC], delay: int, args: argparse.Namespace) -> SAC:
    """Return an agent with a replay buffer of random steps, ready to update; at delay 0 on the plain task."""
    env = gym.make(args.env)
    if delay > 0:
        env = DelayedObservationWrapper(env, delay=delay)
    name = "MlpPolicy" if delay == 0 else "MultiInputPolicy"
    model = cls(name, env, seed=0, learning_starts=args.steps, buffer_size=10_000, device=args.device)
    model.set_logger(Logger(None, []))
    return model.learn(args.steps, log_interval=None)


def matmul_flops(model: SAC, batch_size: int) -> int:
    """Count the floating-point operations of one update's matrix products, as autograd makes them.

    A product forward takes two operations a weight and row; backward as many for the input's gradient and as many for
    the weights'. No layer that reads data needs its input's gradient.

    The actor runs for the next state, and for this one with a pass back. The critics run for the target, for the fit
    with a pass back, and for the actor's loss with a pass back to their input; that one reaches their weights, too.
    """

    def weights(net: nn.Module) -> list[int]:
        return [layer.weight.numel() for layer in net.modules() if isinstance(layer, nn.Linear)]

    actor = weights(model.actor)
    critics = [weights(net) for net in model.critic.q_networks]
    actor_passes = 4 * sum(actor) - actor[0]
    critic_passes = sum(7 * sum(critic) - critic[0] for critic in critics)
    return 2 * batch_size * (actor_passes + critic_passes)


def read_arguments(argv: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    p = parser(__doc__)
    p.add_argument("--env", default="Hopper-v5", help="gymnasium task, for its sizes")
    p.add_argument("--delay", type=int, default=4, help="of the delayed row")
    p.add_argument("--batch-size", type=int, default=256)
    p.add_argument("--steps", type=int, default=2000, help="random steps in the replay buffers")
    p.set_defaults(num_threads=1, rounds=40)
    return parse(p, argv)


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, print, write, and return the rows."""
    args = read_arguments(argv)
    models = {
        "SB3's SAC": make(SAC, 0, args),
        "DelayedSAC at delay 0": make(DelayedSAC, 0, args),
        f"DelayedSAC at delay {args.delay}": make(DelayedSAC, args.delay, args),
    }
    rate = matmul_rates(args)["float32"]
    progress(f"{args.rounds} turns of {UPDATES_PER_TURN} updates: {', '.join(models)}")
    seconds = turn_by_turn(
        {name: lambda m=model: m.train(UPDATES_PER_TURN, args.batch_size) for name, model in models.items()},
        args.rounds,
        args.device,
    )
    rows = []
    for name, model in models.items():
        each = seconds[name] / UPDATES_PER_TURN
        rows.append(
            {
                "updates": name,
                **percentiles(each),
                "per second": float(1 / each.mean()),
                "time, SAC's = 1": ratio(seconds[name], seconds["SB3's SAC"]),
                "fraction of floor": matmul_flops(model, args.batch_size) / rate / float(each.mean()),
            }
        )
    return report(args, rows, matmul_flops_per_second=rate)


if __name__ == "__main__":
    main()
