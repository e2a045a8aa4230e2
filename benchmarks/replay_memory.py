"""Memory and sampling rate of the replay buffer, beside SB3's DictReplayBuffer of the same delayed transitions.

    python benchmarks/replay_memory.py --json results/speed/replay_memory.json
    python benchmarks/replay_memory.py --obs-dim 11 --act-dim 3 --delay 0 4 16

Random episodes of a delayed task of Ant-v5's sizes go into both buffers, which then return the same: delayed
observation, action history, age and true state, before and after the step. "GB / 1 M" counts the arrays of a full
buffer, scaled to a million transitions. "RSS / 1 M" is the growth of the process while a buffer was filled, scaled
alike (Linux; rough, since all else that was allocated meanwhile counts). Sampling is timed turn by turn, on one
thread. "times SB3" is the median of the ratios of the rates, with its 95 % interval: above 1 is faster than SB3's.
"""

from __future__ import annotations

import argparse
import math
import resource
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from measure import parse, parser, percentiles, progress, ratio, report, turn_by_turn
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from sb3_said import DelayedObservationWrapper
from sb3_said.delays.space import UNDELAYED
from sb3_said.replay.buffer import DelayedReplayBuffer

MILLION = 1_000_000
EPISODE_LENGTH = 1000
SAMPLES_PER_TURN = 20


class RandomTask(gym.Env[np.ndarray, np.ndarray]):
    """Gives random observations of any size, without a simulator."""

    def __init__(self, obs_dim: int, act_dim: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (act_dim,), np.float32)

    def _observe(self) -> np.ndarray:
        return self.np_random.standard_normal(self.observation_space.shape, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return self._observe(), 0.0, False, False, {}


def make_buffer(cls: type[ReplayBuffer], env: gym.Env, rows: int) -> ReplayBuffer:
    """Return an empty buffer for an environment's observations; SB3's holds the true state as one more entry."""
    space = env.observation_space
    if cls is DictReplayBuffer:
        space = spaces.Dict({**space.spaces, UNDELAYED: space["observation"]})
    return cls(rows, space, env.action_space, device="cpu")


def fill(buffer: ReplayBuffer, env: gym.Env, seed: int = 0) -> None:
    """Play random episodes until the buffer is full; the same with the same seed."""
    keys = set(buffer.observation_space.spaces)  # either buffer has a Dict space
    env.action_space.seed(seed)
    obs, info = env.reset(seed=seed)
    for step in range(1, buffer.buffer_size + 1):
        action = env.action_space.sample()
        next_obs, reward, _, _, next_info = env.step(action)
        done = step % EPISODE_LENGTH == 0
        rows = [
            {key: value[None] for key, value in {**o, UNDELAYED: i[UNDELAYED]}.items() if key in keys}
            for o, i in ((obs, info), (next_obs, next_info))
        ]  # a vector of one environment
        buffer.add(*rows, action[None], np.array([reward]), np.array([done]), [next_info])
        obs, info = env.reset() if done else (next_obs, next_info)


def array_bytes(buffer: ReplayBuffer) -> int:
    """Count the bytes of all arrays a buffer holds."""
    held = [
        part for value in vars(buffer).values() for part in (value.values() if isinstance(value, dict) else [value])
    ]
    return sum(part.nbytes for part in held if isinstance(part, np.ndarray))


def resident_bytes() -> float:
    """Return the memory this process has now; NaN where the system does not tell."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * resource.getpagesize() if statm.is_file() else math.nan


def measure(delay: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of one delay."""
    env = DelayedObservationWrapper(RandomTask(args.obs_dim, args.act_dim), delay=delay)
    buffers, resident = {}, {}
    for name, cls in (("SB3's", DictReplayBuffer), ("ours", DelayedReplayBuffer)):
        progress(f"filling {name} buffer with {args.rows} transitions at delay {delay}")
        before = resident_bytes()
        buffers[name] = make_buffer(cls, env, args.rows)
        fill(buffers[name], env)
        resident[name] = resident_bytes() - before
    variants = {
        name: lambda b=buffer: [b.sample(args.batch_size) for _ in range(SAMPLES_PER_TURN)]
        for name, buffer in buffers.items()
    }
    progress(f"{args.rounds} turns of {SAMPLES_PER_TURN} samples")
    seconds = turn_by_turn(variants, args.rounds)
    scale = MILLION / args.rows / 1e9
    return [
        {
            "buffer": name,
            "delay": delay,
            "GB / 1 M": array_bytes(buffer) * scale,
            "RSS / 1 M": resident[name] * scale,
            "samples / s": float(SAMPLES_PER_TURN / np.median(seconds[name])),
            **percentiles(seconds[name] / SAMPLES_PER_TURN),
            "times SB3": ratio(seconds["SB3's"], seconds[name]),
        }
        for name, buffer in buffers.items()
    ]


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, print, write, and return the rows."""
    p = parser(__doc__)
    p.add_argument("--obs-dim", type=int, default=105, help="Ant-v5's by default")
    p.add_argument("--act-dim", type=int, default=8)
    p.add_argument("--delay", type=int, nargs="+", default=[0, 16])
    p.add_argument("--batch-size", type=int, default=256)
    p.add_argument("--rows", type=int, default=50_000, help="transitions in each buffer")
    p.set_defaults(num_threads=1, rounds=40)
    args = parse(p, argv)
    return report(args, [row for delay in args.delay for row in measure(delay, args)])


if __name__ == "__main__":
    main()
