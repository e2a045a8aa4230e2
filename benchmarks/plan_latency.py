"""How long a decision takes, from a NumPy observation to a NumPy action, beside the same work done the plain way.

    python benchmarks/plan_latency.py                                          # about four minutes on two cores
    python benchmarks/plan_latency.py --json results/speed/plan_latency.json
    python benchmarks/plan_latency.py --num-threads 1 --rounds 10
    python benchmarks/plan_latency.py --depth 4 --sampling-steps 10 --n-candidates 32    # one setting of your own

Sizes are Hopper-v5's at a delay of 8 steps, so windows have 16. Weights are random, which does not change the time.
The rows "paper" are ``PlannerConfig.paper()``, in float32 as there. For 2 steps the paper says 15 ms, on an A100, but
tells no depth; 8 is the most frequent in its Table 4.

"ours" is ``model.predict(observation, deterministic=True)``, without a first guess, so that both ways do the same work.
The percentiles include its first call after ``model.warmup()``. "plain" is benchmarks/plain.py, in float32. Both run in
turn, and "times as fast" is the median of the ratios turn by turn with its 95 % interval. "with a first guess" tells
how many times as long as "ours" an answer takes with the default's first guess, in the same turns. "of the floor" is
the time of the matrix products alone over our time. That time follows from their shapes and the rate that large
products of the same number format reach on this machine.

A second table shows that cost is linear in candidates, denoising steps and environments: a line is fitted to the
medians. "batched" means all environments in one ``predict(..., deterministic=False)``. Deterministic answers are made
one by one, so that they do not depend on the number of environments.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from measure import matmul_rates, parse, parser, percentiles, print_table, progress, ratio, turn_by_turn, write_json
from plain import PlainPlanner
from scipy.stats import linregress
from stable_baselines3 import SAC

from sb3_said import SAID, DelayedObservationWrapper
from sb3_said.planner import PlannerConfig
from sb3_said.planner.precision import compute_dtype

ENV = "Hopper-v5"
HIDDEN = 256  # of the critics, two layers each: SB3's default
N_CRITICS = 2


class Setting(NamedTuple):
    """The settings of a decision, at a delay that is also the largest."""

    name: str
    config: PlannerConfig
    rounds: int
    delay: int = 8

    @property
    def length(self) -> int:
        """L, steps of a window."""
        return self.delay + self.config.horizon

    @property
    def n_candidates(self) -> int:
        """Windows that are denoised: one at temperature 0, where all would be the same."""
        return self.config.n_candidates if self.config.temperature > 0 else 1

    @property
    def scored(self) -> slice:
        """The states of a window that the critics score; a single candidate is not scored."""
        first = {"all": 1, "future": self.delay + 1, "decision": self.delay}[self.config.scored_states]
        return slice(first, first + 1 if self.config.scored_states == "decision" else self.length)


CPU = PlannerConfig(depth=2, d_model=128, sampling_steps=5, temperature=0.0, first_guess="none")
MANY = replace(CPU, n_candidates=16, temperature=0.5, scored_states="future")
SETTINGS = (
    Setting("paper", PlannerConfig.paper(), rounds=20),
    Setting("paper, 2 steps", PlannerConfig.paper(sampling_steps=2), rounds=100),
    Setting("16 candidates, width 256", replace(MANY, d_model=256), rounds=300),
    Setting("--preset cpu", CPU, rounds=300),
    Setting("--preset cpu with 16 candidates", MANY, rounds=300),
)
QUICK = Setting("quick", replace(MANY, depth=1, d_model=32, horizon=2, sampling_steps=2, n_candidates=4), 3, delay=2)


def make_agent(setting: Setting, device: str) -> SAID:
    """Return an agent of random weights that answers with its planner."""
    env = DelayedObservationWrapper(gym.make(ENV), setting.delay)
    planner = setting.config.to_dict()
    model = SAID("MultiInputPolicy", env, seed=0, buffer_size=1_000, device=device, planner_kwargs=planner)
    for layer in (model.policy.planner.network.modulation, model.policy.planner.network.out):
        th.nn.init.normal_(layer.weight, std=0.02)  # all 0 before training, so that the network would compute nothing
    model.policy.planner_updates.fill_(1)
    return model


def with_first_guess(setting: Setting) -> Setting:
    """Return the setting with the default's first guess and, where the planner knows age 0, the default's present."""
    return setting._replace(config=replace(setting.config, first_guess="prior", present=None))


def make_plain(setting: Setting, device: str, env: gym.Env[Any, Any]) -> Any:
    """Return a function from an observation to the plain planner's action, with SB3's critics."""
    obs_dim, act_dim = sizes(env)
    config = setting.config
    planner = PlainPlanner(obs_dim, act_dim, setting.delay, setting.length, config.d_model, config.depth, device=device)
    critic = SAC("MlpPolicy", gym.make(ENV), buffer_size=1_000, device=device).critic.requires_grad_(False)

    def decide(obs: dict[str, np.ndarray]) -> np.ndarray:
        return planner.decide(
            obs["observation"][None],
            obs["action_history"][None],
            critic,
            config.sampling_steps,
            setting.n_candidates,
            config.temperature,
            setting.scored,
        )

    decide.planner = planner  # type: ignore[attr-defined]
    return decide


def sizes(env: gym.Env[Any, Any]) -> tuple[int, int]:
    """Return obs_dim and act_dim of a delayed task."""
    return env.observation_space["observation"].shape[0], env.action_space.shape[0]  # type: ignore[index]  # Boxes have a shape


def observe(env: gym.Env[Any, Any], delay: int) -> dict[str, np.ndarray]:
    """Return an observation amid an episode, whose age is the full delay."""
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    for _ in range(delay):
        obs = env.step(env.action_space.sample())[0]
    return obs


def matmul_flops(setting: Setting, obs_dim: int, act_dim: int) -> int:
    """Count the floating-point operations of one decision's matrix products, two for each weight and row.

    What is computed once for all candidates is left out: the embeddings of the times and of the known part.
    """
    d, n, length = setting.config.d_model, setting.n_candidates, setting.length
    weights = d * (3 * d + d + 4 * d + 4 * d)  # query, key and value; output of the attention; MLP
    attention = 2 * length * d  # a token's scores, and the mean of values
    per_token = setting.config.depth * (weights + attention) + 2 * d * (obs_dim + act_dim)
    scored = n * len(range(length)[setting.scored]) if n > 1 else 0
    critics = N_CRITICS * ((obs_dim + act_dim) * HIDDEN + HIDDEN * HIDDEN + HIDDEN)
    return 2 * (setting.config.sampling_steps * n * length * per_token + scored * critics)


def measure_setting(setting: Setting, rounds: int, device: str, rates: dict[str, float]) -> dict[str, Any]:
    """Time our way and the plain way in turn, and return a row of the table.

    :param rates: FLOP/s of large products, by number format
    """
    model = make_agent(setting, device)
    env = model.get_env().envs[0]  # type: ignore[union-attr]
    obs = observe(env, setting.delay)
    plain = make_plain(setting, device, env)
    config = setting.config
    guessing = make_agent(with_first_guess(setting), device)
    work = f"{config.sampling_steps} steps, {setting.n_candidates} candidate{'s' if setting.n_candidates > 1 else ''}"
    name = f"{setting.name}: depth {config.depth}, width {config.d_model}, {work}"
    size = setting.n_candidates * setting.length * config.d_model
    dtype = str(compute_dtype(config.precision, model.device, size)).removeprefix("torch.")

    progress(f"{rounds} turns of one decision, ours, with a first guess, and plain: {name}")
    model.warmup()
    guessing.warmup()
    began = time.perf_counter()
    model.predict(obs, deterministic=True)
    first = time.perf_counter() - began
    variants = {
        "ours": lambda: model.predict(obs, deterministic=True),
        "guessing": lambda: guessing.predict(obs, deterministic=True),
        "plain": lambda: plain(obs),
    }
    seconds = turn_by_turn(variants, rounds, device)
    ours = percentiles(np.append(seconds["ours"], first))
    flops = matmul_flops(setting, *sizes(env))
    return {
        "setting": name,
        "ours p50 ms": ours["p50_ms"],
        "p95": ours["p95_ms"],
        "p99": ours["p99_ms"],
        "first": 1e3 * first,
        "plain p50 ms": percentiles(seconds["plain"])["p50_ms"],
        "times as fast": ratio(seconds["plain"], seconds["ours"]),
        "with a first guess": ratio(seconds["guessing"], seconds["ours"]),
        "GFLOP": flops / 1e9,
        "GFLOP/s, matrix product": rates[dtype] / 1e9,
        "number format": dtype,
        "of the floor": float(np.median(flops / rates[dtype] / seconds["ours"])),
    }


def measure_scaling(base: Setting, rounds: int, device: str) -> list[dict[str, Any]]:
    """Time decisions of several sizes in turn, and return a row with a fitted line for each kind of size."""
    model = make_agent(base, device)
    obs = observe(model.get_env().envs[0], base.delay)  # type: ignore[union-attr]

    def answers(model: SAID, n_envs: int, deterministic: bool) -> Callable[[], Any]:
        batch = {key: np.repeat(value[None], n_envs, 0) for key, value in obs.items()}
        model.warmup(n_envs)
        return lambda: model.predict(batch, deterministic=deterministic)

    def settings(key: str) -> dict[int, Callable[[], Any]]:
        values = [getattr(base.config, key) * k for k in (1, 2, 3, 4)]
        changed = {value: base._replace(config=replace(base.config, **{key: value})) for value in values}
        return {value: answers(make_agent(setting, device), 1, True) for value, setting in changed.items()}

    kinds = {
        "candidates": settings("n_candidates"),
        "denoising steps": settings("sampling_steps"),
        "environments, batched": {n: answers(model, n, False) for n in (1, 2, 3, 4)},
        "environments, deterministic": {n: answers(model, n, True) for n in (1, 2, 3, 4)},
    }
    rows = []
    for kind, variants in kinds.items():
        progress(f"{rounds} turns of one decision by {kind}: {', '.join(map(str, variants))}")
        seconds = turn_by_turn({str(size): variant for size, variant in variants.items()}, rounds, device)
        medians = [1e3 * float(np.median(seconds[str(size)])) for size in variants]
        line = linregress(list(variants), medians)
        rows.append(
            {
                "p50 in ms by": kind,
                "at": ", ".join(f"{size}: {ms:.2f}" for size, ms in zip(variants, medians, strict=True)),
                "intercept": float(line.intercept),
                "slope": float(line.slope),
                "R2": f"{line.rvalue**2:.4f}",
            }
        )
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure, print and write."""
    p = parser(__doc__)
    p.add_argument("--depth", type=int, help="blocks of the transformer; with the next three: only this setting")
    p.add_argument("--sampling-steps", type=int, default=5, help="with --depth")
    p.add_argument("--n-candidates", type=int, default=16, help="with --depth")
    p.add_argument("--d-model", type=int, default=256, help="with --depth")
    p.add_argument("--no-scaling", action="store_true", help="leave the second table out")
    p.add_argument("--quick", action="store_true", help="a tiny network and few turns: shows that it runs")
    args = parse(p, argv)

    settings = (QUICK,) if args.quick else SETTINGS
    if args.depth and not args.quick:
        keys = ("depth", "sampling_steps", "n_candidates", "d_model")
        own = replace(MANY, **{key: getattr(args, key) for key in keys})
        settings = (Setting("own", own if args.n_candidates > 1 else replace(own, temperature=0.0), rounds=50),)
    rates = matmul_rates(args)
    rows = [measure_setting(setting, args.rounds or setting.rounds, args.device, rates) for setting in settings]
    print_table(rows)
    scaling = []
    if not args.no_scaling:
        scaling = measure_scaling(settings[-1], args.rounds or min(50, settings[-1].rounds), args.device)
        print()
        print_table(scaling)
    write_json(args.json, args, rows, scaling=scaling)


if __name__ == "__main__":
    main()
