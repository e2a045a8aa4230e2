"""Why the present is inpainted: errors of a rolled-out one-step model and of inpainted states, over the delay.

    python benchmarks/motivation.py --env Hopper-v5 --dataset medium.npz --json motivation.json --plot motivation.png
    python benchmarks/motivation.py ... --actor logs/sadr/Hopper-v5-seed1_1    # who acts on the beliefs, in BC's place

Four beliefs of the present learn from the same episodes. "inpainted" is SAID's planner, and "guessed" its first guess.
"rolled out" is a one-step model that is rolled out over the actions since, as the guess's is. "regressed" is an MLP
that predicts the present at once. One network of each serves all delays. --plain-steps gives the plain networks as many
gradient steps as they need.

error   root mean squared error of s_t on held-out episodes, in standard deviations of the states, the same windows for
        all beliefs
return  of one actor without delay that acts on each belief, over seeded episodes: behaviour cloning of the same
        episodes at delay 0, or --actor. For comparison, it acts on the "old observation" as if nothing was delayed.
        "SAID" decides by its planner; "one step" is SAID in one denoising step, and "SAID, inpainting" is SAID with its
        present inpainted. "guess alone" is the clone in SAID's first guess, at the present that it guesses. "cloning"
        is BC on the augmented state
"""

from __future__ import annotations

import argparse
import ast
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from measure import print_table
from tqdm import tqdm

from sb3_said import SAID, DelayedObservationWrapper, PlannerConfig
from sb3_said.delays.space import KEYS
from sb3_said.evaluation import Summary, plots, rollout
from sb3_said.files.atomic import write_json
from sb3_said.offline import BC, Dataset, load_dataset, normalized_score, reference_returns
from sb3_said.offline.belief import (
    Belief,
    BeliefOnly,
    LearnedBelief,
    PlannerBelief,
    RegressedPresent,
    RolledOutModel,
    belief_error,
    train_belief,
)
from sb3_said.sac.policies import settings_of
from sb3_said.zoo.arguments import explained
from sb3_said.zoo.folder import find_agent
from sb3_said.zoo.runs import LoadedRun, load_run, origin

N_WINDOWS = 5_000  # held out, at most
PLAIN: dict[str, type[LearnedBelief]] = {"rolled out": RolledOutModel, "regressed": RegressedPresent}
INPAINTING, GUESS_ALONE = "SAID, inpainting", "guess alone"
PLAYERS = ["inpainted", "guessed", *PLAIN, "old observation", "SAID", "one step", INPAINTING, GUESS_ALONE, "cloning"]


def load_agent(path: str | Path, device: str = "cpu") -> LoadedRun:
    """Open a trained agent that reads states of its task as they are.

    :raises SystemExit: for one that was trained under VecNormalize, or on a task with arguments or wrappers of its own
    """
    run, record = load_run(path, device=device), find_agent(Path(path))[1]
    if run.normalize is not None:
        raise SystemExit(f"{path} was trained under VecNormalize, which is not applied here; give another agent.")
    if record is not None and (record.env_kwargs or record.hyperparams.get("env_wrapper")):
        raise SystemExit(f"{path} was trained on a task with env_kwargs or env_wrapper, which is not made here.")
    return run


class OldObservation:
    """Takes the newest observation for the present, whatever its age."""

    def __init__(self, max_delay: int):
        self.max_delay = max_delay

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        return state


class AllAtOnce:
    """SAID, answering a batch at once, in a fraction of the time, with other settings of sampling if any are given.

    Answers row by row differ from these by rounding at temperature 0, and above it by the noise that is drawn.
    """

    def __init__(self, said: SAID, **settings: Any):
        self.said = said
        self.settings = settings

    def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, Any]:
        self.said.set_planner(**self.settings)
        return self.said.predict(observation, deterministic=False)


class GuessAlone:
    """Decides as the first guess of SAID's planner does by itself."""

    def __init__(self, said: SAID):
        self.said = said

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        parts = {key: th.as_tensor(observation[key], device=self.said.device) for key in KEYS}
        planner = self.said.policy.planner
        action = planner.guess(parts["observation"], parts["action_history"], parts["delay"][:, 0].long())[1]
        return self.said.policy.unscale_action(action.cpu().numpy()), state


def split(data: Dataset, held_out: float, seed: int) -> tuple[Dataset, Dataset]:
    """Return training and held-out episodes.

    :raises ValueError: when either part would have no episode
    """
    if not 0 < held_out < 1:
        raise ValueError(f"--held-out is a part of the episodes, above 0 and below 1, got {held_out}.")
    n = len(data.lengths)
    if n < 2:
        raise ValueError(f"The data has {n} episode; two are needed, one of them to hold out.")
    is_held = np.zeros(n, bool)
    is_held[np.random.default_rng(seed).permutation(n)[: min(max(1, round(n * held_out)), n - 1)]] = True
    return data.select(~is_held), data.select(is_held)


def train(data: Dataset, actor: Any, args: argparse.Namespace) -> tuple[dict[str, Belief], Any, SAID, BC]:
    """Train, and return the beliefs by name, the actor without delay, and the agents that decide under delay.

    :param actor: None for a clone of the data
    """
    task = gym.make(args.env)
    env = DelayedObservationWrapper(gym.make(args.env), delay=(0, args.max_delay))
    said = SAID(
        *("MlpPolicy", env),
        planner_kwargs=args.planner_kwargs,
        planner_terminal_penalty=args.terminal_penalty,
        seed=args.seed,
        device=args.device,
    )
    # The log goes nowhere; a progress bar shows the updates
    said.learn_offline(data, args.gradient_steps, folder=args.folder, progress_bar=True)
    source = data.to_replay(task.observation_space, task.action_space).window_source()
    sizes = source.obs_dim, source.act_dim, args.max_delay
    networks: dict[str, LearnedBelief] = {}
    for name in [name for name in PLAIN if name in args.players]:
        th.manual_seed(args.seed)
        networks[name] = PLAIN[name](*sizes).to(args.device)
        train_belief(networks[name], source, args.plain_steps, seed=args.seed, progress_bar=True)

    def clone(env: gym.Env[Any, Any]) -> BC:
        bc = BC("MultiInputPolicy", env, seed=args.seed, device=args.device, buffer_size=args.max_delay + 2)
        return bc.learn_offline(data, args.plain_steps, progress_bar=True)

    actor = actor or clone(task)
    beliefs: dict[str, Belief] = {"inpainted": PlannerBelief(said.policy.planner)}
    if "guessed" in args.players:
        beliefs["guessed"] = PlannerBelief(said.policy.planner, "guessed")
    beliefs |= networks
    beliefs["old observation"] = OldObservation(args.max_delay)
    return beliefs, actor, said, clone(env)


def errors(held: Dataset, beliefs: dict[str, Belief], args: argparse.Namespace) -> dict[str, list[float]]:
    """Return the error of each belief at each delay."""
    task = gym.make(args.env)
    source = held.to_replay(task.observation_space, task.action_space).window_source()
    starts = th.randperm(len(source), generator=th.Generator().manual_seed(args.seed))[:N_WINDOWS]
    windows = source.gather(starts, args.max_delay + 1).to(args.device)
    return {name: [belief_error(belief, windows, d) for d in args.delays] for name, belief in beliefs.items()}


def returns(players: dict[str, Any], args: argparse.Namespace) -> dict[str, list[Summary]]:
    """Play the same episodes with each player under each delay."""
    table: dict[str, list[Summary]] = {name: [] for name in players}
    for name, player in tqdm(players.items(), unit="player"):
        for delay in args.delays:

            def make_env(delay: int = delay) -> gym.Env[Any, Any]:
                return DelayedObservationWrapper(gym.make(args.env), delay, max_delay=args.max_delay)

            played = rollout(player, make_env, args.episodes, args.eval_seed, args.n_envs)
            table[name].append(played.summary(name))
    return table


def draw(path: Path, document: dict[str, Any], table: dict[str, list[Summary]]) -> None:
    """Draw errors and returns over the delay, side by side."""
    title = f"{document['env']}: {document['gradient_steps']:,} updates of the planner"
    left, right = plots.panels(2, title, width=5.5)
    rows = {**{name: None for name in document["errors"]}, **{name: None for name in table}}
    color_of = dict(zip(rows, plots.colors(len(rows)), strict=True))
    delays = document["delays"]
    for name, row in document["errors"].items():
        left.plot(delays, row, marker="o", markersize=4, color=color_of[name], label=name)
    for name, summaries in table.items():
        means = [s.mean_return for s in summaries]
        right.plot(delays, [m.value for m in means], marker="o", markersize=4, color=color_of[name], label=name)
        bounds = [[getattr(m, side) for m in means] for side in ("low", "high")]
        right.fill_between(delays, *bounds, color=color_of[name], alpha=0.15, linewidth=0)
    left.set_ylabel("error of the present (standard deviations)")
    right.set_ylabel("return of an episode (undiscounted)")
    for ax in (left, right):
        ax.set_xlabel("delay (control steps)")
        ax.legend(frameon=False, fontsize="small")
    plots.save(left, path)


def show(rows: dict[str, list[str]], what: str, delays: list[int]) -> None:
    """Print a Markdown table over the delays."""
    print()
    print_table([{what: name, **dict(zip(map(str, delays), row, strict=True))} for name, row in rows.items()])


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Train, measure, print, write, and return the numbers."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--env", default="Hopper-v5")
    p.add_argument("--dataset", nargs="+", required=True, help="ids of Minari datasets, or files")
    p.add_argument("--delays", type=int, nargs="+", default=[0, 1, 2, 4, 8, 12, 16])
    p.add_argument("--gradient-steps", type=int, default=25_000, help="of the planner")
    p.add_argument("--plain-steps", type=int, help="of each plain network (default: those of the planner)")
    p.add_argument("--terminal-penalty", type=float, help="in place of the reward of a step that ends the task, in the "
                   "planner's values (default: none)")  # fmt: skip
    p.add_argument("--actor", help="run folder or .zip of an agent of the task without delay (default: BC)")
    p.add_argument("--players", nargs="+", choices=PLAYERS, default=PLAYERS, help="whose return is measured")
    p.add_argument("--held-out", type=float, default=0.05, help="part of the episodes that no network learns from")
    p.add_argument("--episodes", type=int, default=50, help="of each return")
    p.add_argument("--n-envs", type=int, default=10)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--eval-seed", type=int, default=10_000, help="reset seed of the first episode")
    p.add_argument("--planner-kwargs", type=partial(dict_of, "--planner-kwargs"), default={}, metavar="NAME=VALUE,...")
    p.add_argument("--folder", type=Path, help="keep the planner's checkpoint there, and go on from it")
    p.add_argument("--device", default="cpu")
    p.add_argument("--num-threads", type=int, default=1)
    p.add_argument("--json", type=Path)
    p.add_argument("--plot", type=Path)
    args = p.parse_args(argv)
    with explained(p):
        config = settings_of(PlannerConfig, args.planner_kwargs, "The planner")
    if config.mask == "none":
        p.error("A planner with mask=none inpaints no present, which is what is compared here; give another mask.")
    if config.first_guess == "none" and {"guessed", GUESS_ALONE} & {*args.players}:
        p.error(
            f"A planner without a first guess guesses nothing: leave 'guessed' and {GUESS_ALONE!r} out of --players."
        )
    args.max_delay = max(args.delays)
    args.plain_steps = args.plain_steps or args.gradient_steps
    th.set_num_threads(args.num_threads)

    with explained(p):
        task = gym.make(args.env)
        data = load_dataset(args.dataset, task.observation_space, task.action_space, args.env, progress_bar=True)
        training, held = split(data, args.held_out, args.seed)
        given = None if args.actor is None else load_agent(args.actor, args.device).model
    beliefs, actor, said, cloning = train(training, given, args)
    document: dict[str, Any] = {k: v for k, v in vars(args).items() if k not in ("folder", "json", "plot")}
    document |= {"training_steps": len(training), "held_out_steps": len(held), "held_out_episodes": len(held.lengths)}
    document["planner"] = said.policy.planner.config.to_dict()
    document["errors"] = errors(held, beliefs, args)
    show({k: [f"{x:.3f}" for x in row] for k, row in document["errors"].items()}, "error at delay", args.delays)
    players: dict[str, Any] = {name: BeliefOnly(belief, actor, args.device) for name, belief in beliefs.items()}
    own = said.policy.planner.config
    players["SAID"] = AllAtOnce(said, sampling_steps=own.sampling_steps, present=own.present)
    players["one step"] = AllAtOnce(said, sampling_steps=1, present=own.present)
    players[INPAINTING] = AllAtOnce(said, sampling_steps=own.sampling_steps, present="inpainted")
    players[GUESS_ALONE] = GuessAlone(said)
    players["cloning"] = cloning
    table = returns({name: players[name] for name in args.players}, args)
    show({k: [str(s.mean_return) for s in row] for k, row in table.items()}, "return at delay", args.delays)
    document["returns"] = {name: [summary.to_dict() for summary in row] for name, row in table.items()}
    if reference_returns(args.env) is not None:
        document["scores"] = {
            name: [float(normalized_score(s.mean_return.value, args.env)) for s in row] for name, row in table.items()
        }
        show({k: [f"{x:.1f}" for x in row] for k, row in document["scores"].items()}, "score at delay", args.delays)
    document["origin"] = origin(LoadedRun(said, lambda: task, None, Path(), {}))
    if args.json is not None:
        write_json(args.json, document)
    if args.plot is not None:
        draw(args.plot, document, table)
    return document


def dict_of(option: str, text: str) -> dict[str, Any]:
    """Read ``name=value`` pairs, separated by commas; a value is a number or a bool where it can be one.

    :raises ArgumentTypeError: for anything else
    """
    found = {}
    for pair in text.split(","):
        name, is_pair, value = pair.partition("=")
        if not (name and is_pair and value):
            raise argparse.ArgumentTypeError(f"{option} takes NAME=VALUE,..., such as depth=2, got {text}")
        found[name] = value
        with suppress(ValueError, SyntaxError):
            found[name] = ast.literal_eval(value)
    return found


if __name__ == "__main__":
    main()
