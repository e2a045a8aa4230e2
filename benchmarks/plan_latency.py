"""How long a decision takes, from a NumPy observation to a NumPy action, beside the same work done the plain way.

    python benchmarks/plan_latency.py                                          # about four minutes on two cores
    python benchmarks/plan_latency.py --json results/speed/plan_latency.json
    python benchmarks/plan_latency.py --num-threads 1 --rounds 10
    python benchmarks/plan_latency.py --depth 4 --sampling-steps 10 --n-candidates 32    # one setting of your own

Hopper-v5's sizes at a delay of 8 steps, so windows of 16. Weights are random: they do not change the time.

"ours" is ``model.predict(observation, deterministic=True)``. Its first call after ``model.warmup()`` is one of those
that the percentiles are of. "plain" is benchmarks/plain.py; both run in turn, and "times as fast" is the median of the
ratios turn by turn with its 95 % interval. "of the floor" is the part of our time that the matrix products alone would
take, counted from their shapes, at the rate that large products of the same number format reach on this machine.

A second table shows that cost is linear in candidates, denoising steps and environments: a line is fitted to the
medians. "batched" are environments in one ``predict(..., deterministic=False)``; deterministic answers are made one by
one, so that they do not depend on how many are asked for at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from measure import dtype_name, matmul_rate, parser, percentiles, print_table, ratio, turn_by_turn, write_json
from plain import PlainPlanner
from stable_baselines3 import SAC

from sb3_said import SAID, DelayedObservationWrapper

ENV = "Hopper-v5"
HIDDEN = 256  # of the critics, two layers each: SB3's default
N_CRITICS = 2


class Setting(NamedTuple):
    """What a decision is made with."""

    name: str
    depth: int
    sampling_steps: int
    n_candidates: int
    rounds: int
    d_model: int = 256
    horizon: int = 8
    delay: int = 8

    @property
    def temperature(self) -> float:
        """0, the default, where there is one candidate; then no critic is asked."""
        return 0.5 if self.n_candidates > 1 else 0.0


SETTINGS = (
    Setting("paper", 8, 20, 50, rounds=20),
    Setting("real time", 2, 5, 16, rounds=300),
    Setting("--preset cpu, at the default temperature 0", 2, 5, 1, rounds=300, d_model=128),
    Setting("real time, the width of --preset cpu", 2, 5, 16, rounds=300, d_model=128),
)
QUICK = Setting("quick", 1, 2, 4, rounds=3, d_model=32, horizon=2, delay=2)


def make_agent(setting: Setting, device: str, precision: str = "auto") -> SAID:
    """Return an agent of random weights that answers with its planner."""
    env = DelayedObservationWrapper(gym.make(ENV), setting.delay)
    planner = {key: getattr(setting, key) for key in ("depth", "sampling_steps", "n_candidates", "d_model", "horizon")}
    planner |= {"precision": precision, "temperature": setting.temperature}
    model = SAID("MultiInputPolicy", env, seed=0, buffer_size=1_000, device=device, planner_kwargs=planner)
    for layer in (model.policy.planner.network.modulation, model.policy.planner.network.out):
        th.nn.init.normal_(layer.weight, std=0.02)  # zero before training, so that nothing would be computed
    model.policy.planner_updates.fill_(1)
    return model


def make_plain(setting: Setting, device: str, action: gym.Space[Any], observation: gym.Space[Any]) -> Any:
    """Return the plain planner's decision, with SB3's critics: maps observations to actions."""
    obs_dim, act_dim = observation.shape[0], action.shape[0]  # type: ignore[index]
    length = setting.delay + setting.horizon
    planner = PlainPlanner(obs_dim, act_dim, setting.delay, length, setting.d_model, setting.depth, device=device)
    critic = SAC("MlpPolicy", gym.make(ENV), buffer_size=1_000, device=device).critic.requires_grad_(False)

    def decide(obs: dict[str, np.ndarray]) -> np.ndarray:
        return planner.decide(
            obs["observation"][None],
            obs["action_history"][None],
            critic,
            setting.sampling_steps,
            setting.n_candidates,
            setting.temperature,
        )

    decide.planner = planner  # type: ignore[attr-defined]
    return decide


def observe(env: gym.Env[Any, Any], delay: int) -> dict[str, np.ndarray]:
    """Return an observation amid an episode, where its age is the full delay."""
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    for _ in range(delay):
        obs = env.step(env.action_space.sample())[0]
    return obs


def matmul_flops(setting: Setting, obs_dim: int, act_dim: int) -> int:
    """Count the floating-point operations of one decision's matrix products, two a weight and row."""
    d, n, length = setting.d_model, setting.n_candidates, setting.delay + setting.horizon
    weights = d * (3 * d + d + 4 * d + 4 * d)  # query, key and value; output of the attention; MLP
    attention = 2 * length * d  # a token's scores, and the mean of values
    per_token = setting.depth * (weights + attention) + 2 * d * (obs_dim + act_dim)
    scored = n * (setting.horizon - 1) if n > 1 else 0  # the states behind the decision
    critics = N_CRITICS * ((obs_dim + act_dim) * HIDDEN + HIDDEN * HIDDEN + HIDDEN)
    return 2 * (setting.sampling_steps * n * length * per_token + scored * critics)


def measure_setting(setting: Setting, rounds: int, device: str) -> dict[str, Any]:
    """Time our way and the plain way in turn, and return a row of the table."""
    model = make_agent(setting, device)
    env = model.get_env().envs[0]  # type: ignore[union-attr]
    obs = observe(env, setting.delay)
    spaces = env.observation_space["observation"], env.action_space
    plain = make_plain(setting, device, spaces[1], spaces[0])
    size = setting.n_candidates * (setting.delay + setting.horizon) * setting.d_model
    dtype = dtype_name(model.policy.planner.config.precision, model.device, size)
    rate = matmul_rate(dtype, device)

    model.warmup()
    began = time.perf_counter()
    model.predict(obs, deterministic=True)
    first = time.perf_counter() - began
    seconds = turn_by_turn(
        {"ours": lambda: model.predict(obs, deterministic=True), "plain": lambda: plain(obs)}, rounds, device
    )
    ours = percentiles(np.append(seconds["ours"], first))
    flops = matmul_flops(setting, spaces[0].shape[0], spaces[1].shape[0])
    work = f"{setting.sampling_steps} steps, {setting.n_candidates} candidate{'s' if setting.n_candidates > 1 else ''}"
    return {
        "setting": f"{setting.name}: depth {setting.depth}, width {setting.d_model}, {work}",
        "ours p50 ms": ours["p50_ms"],
        "p95": ours["p95_ms"],
        "p99": ours["p99_ms"],
        "first": 1e3 * first,
        "plain p50 ms": percentiles(seconds["plain"])["p50_ms"],
        "times as fast": ratio(seconds["plain"], seconds["ours"]),
        "GFLOP": flops / 1e9,
        "GFLOP/s, matrix product": rate / 1e9,
        "number format": dtype,
        "of the floor": float(np.median(flops / rate / seconds["ours"])),
    }


def fit_line(x: Sequence[float], y: Sequence[float]) -> dict[str, float]:
    """Return intercept, slope and the share of variance that the line of least squares explains."""
    slope, intercept = np.polyfit(x, y, 1)
    residual = np.asarray(y) - (intercept + slope * np.asarray(x))
    return {
        "intercept": float(intercept),
        "slope": float(slope),
        "R2": float(1 - residual @ residual / np.square(y - np.mean(y)).sum()),
    }


def measure_scaling(base: Setting, rounds: int, device: str) -> list[dict[str, Any]]:
    """Time decisions of several sizes in turn, and return a row for each kind of size with its line."""
    model = make_agent(base, device)
    obs = observe(model.get_env().envs[0], base.delay)  # type: ignore[union-attr]

    def answers(model: SAID, n_envs: int, deterministic: bool) -> Callable[[], Any]:
        batch = {key: np.repeat(value[None], n_envs, 0) for key, value in obs.items()}
        model.warmup(n_envs)
        return lambda: model.predict(batch, deterministic=deterministic)

    def settings(key: str) -> dict[int, Callable[[], Any]]:
        sizes = [getattr(base, key) * k for k in (1, 2, 3, 4)]
        return {size: answers(make_agent(base._replace(**{key: size}), device), 1, True) for size in sizes}

    kinds = {
        "candidates": settings("n_candidates"),
        "denoising steps": settings("sampling_steps"),
        "environments, batched": {n: answers(model, n, False) for n in (1, 2, 3, 4)},
        "environments, deterministic": {n: answers(model, n, True) for n in (1, 2, 3, 4)},
    }
    rows = []
    for kind, variants in kinds.items():
        seconds = turn_by_turn({str(size): variant for size, variant in variants.items()}, rounds, device)
        medians = [1e3 * float(np.median(seconds[str(size)])) for size in variants]
        line = fit_line(list(variants), medians)
        rows.append(
            {
                "p50 in ms by": kind,
                "at": ", ".join(f"{size}: {ms:.2f}" for size, ms in zip(variants, medians, strict=True)),
                "intercept": line["intercept"],
                "slope": line["slope"],
                "R2": f"{line['R2']:.4f}",
            }
        )
    return rows


def main(argv: list[str] | None = None) -> None:
    p = parser(__doc__)
    p.add_argument(
        "--depth", type=int, help="blocks of the transformer; together with the next three: only this setting"
    )
    p.add_argument("--sampling-steps", type=int, default=5, help="with --depth")
    p.add_argument("--n-candidates", type=int, default=16, help="with --depth")
    p.add_argument("--d-model", type=int, default=256, help="with --depth")
    p.add_argument("--no-scaling", action="store_true", help="leave the second table out")
    p.add_argument("--quick", action="store_true", help="a tiny network and few turns: shows that it runs")
    args = p.parse_args(argv)
    if args.num_threads:
        th.set_num_threads(args.num_threads)

    settings = SETTINGS
    if args.quick:
        settings = (QUICK,)
    elif args.depth:
        settings = (
            Setting("own", args.depth, args.sampling_steps, args.n_candidates, rounds=50, d_model=args.d_model),
        )
    rows = [measure_setting(setting, args.rounds or setting.rounds, args.device) for setting in settings]
    print_table(rows)
    scaling = []
    if not args.no_scaling:
        scaling = measure_scaling(settings[-1], args.rounds or min(50, settings[-1].rounds), args.device)
        print()
        print_table(scaling)
    write_json(args.json, args, rows, scaling=scaling)


if __name__ == "__main__":
    main()
