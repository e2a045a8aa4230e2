"""How fast the expert learns: updates of DelayedSAC and StableSAC beside SB3's SAC, turn by turn, on one thread.

    python benchmarks/expert_updates.py --json results/speed/expert_updates.json

All have SB3's default networks and batch (Hopper-v5) and a replay buffer of their own; sampling is included. StableSAC
updates its actor every second time and keeps an average of its weights. "time, SAC's = 1" is the median of the ratios
turn by turn, with its 95 % interval: above 1 is slower than SB3's SAC. "fraction of floor" is the time of the matrix
products alone over the time of an update. That time follows from their shapes and the rate that large products reach on
this machine and thread count.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
from measure import matmul_rates, parse, parser, percentiles, progress, ratio, report, turn_by_turn
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_said import DelayedObservationWrapper, DelayedSAC, StableSAC

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


def matmul_flops(model: SAC, batch_size: int) -> float:
    """Count the floating-point operations of one update's matrix products, as autograd makes them, on average.

    A forward product takes two operations for each weight and row. Backward there are as many for the gradient of the
    input, and as many for that of the weights. A layer that reads data needs no gradient of its input.

    The actor runs forward for the next state, and forward and back for the current one. The critics run forward for the
    target, forward and back for the fit, and forward and back for the actor's loss. In this last pass the weights get
    gradients, too, except in StableSAC, which makes it only every ``policy_delay`` updates.
    """

    def weights(net: nn.Module) -> list[int]:
        return [layer.weight.numel() for layer in net.modules() if isinstance(layer, nn.Linear)]

    actor = weights(model.actor)
    critics = [weights(net) for net in model.critic.q_networks]
    of_critics = sum(4 * sum(critic) - critic[0] for critic in critics)
    passes, every = (2, model.policy_delay) if isinstance(model, StableSAC) else (3, 1)
    of_actor = 3 * sum(actor) - actor[0] + passes * sum(sum(critic) for critic in critics)
    return 2 * batch_size * (sum(actor) + of_critics + of_actor / every)


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
        f"StableSAC at delay {args.delay}": make(StableSAC, args.delay, args),
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
