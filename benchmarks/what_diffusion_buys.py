"""What does diffusion buy? Ways to act under delay that learned from one replay, with the same number of updates.

    python benchmarks/what_diffusion_buys.py RUN --updates 8000 --seeds 1 2 3 --delays 0 4 8 16 --json rows.json

RUN is the folder of a SAID run, ended or not; its checkpoint holds the replay. With --log, RUN is any SAID agent, and
a log of its task (such as scripts/collect.py makes) takes the place of the replay.

expert, last         the expert's actor as it is
expert, average      the average of its weights
cloning              a plain network from what is known under delay to the action, weighted as the planner is
regressed present    such a network gives the present, on which the expert's actor acts at age 0
inpainted present    the planner's present, for the same actor
guessed present      the present of its first guess, for the same actor
guess alone          the clone of the first guess, at the present that it guesses
one step             SAID in one denoising step at temperature 0
SAID                 SAID as its preset decides: in five steps at temperature 0
SAID, inpainting     the same, but the planner also fills in the present, which SAID takes from its first guess
weighed              SAID whose critics weigh the candidates of two steps at temperature 1
chosen by Q          the best of these candidates by the mean min Q(s, a) of the steps planned after the decision
chosen by V          the same by V(s), learned on the replay by implicit Q-learning with two steps for each update
together             the mean of the answers that the seeds' planners give as "SAID"
paper                SAID with the paper's settings (Tables 3 and 4), except that the average of its weights is
                     warmed up, so that few updates count, and that its precision is the preset's; a decision takes
                     seconds on a CPU
paper, 2 steps       the same planner in two denoising steps, which the paper has in its appendix, a tenth of the time
paper, temperature 0 the same planner in five steps and one candidate, as SAID decides

The planner's seed decides the initial weights and the batches, also of the networks. Every row of a seed learns from
the same batches, except the paper's, which has windows and batches of its own. Planners answer all episodes at once, in
a fraction of the time. A call plays what --json lacks, so the same command goes on after a stop. The planner of a seed
is trained anew if one of its rows is missing, and the planners of all seeds if "together" is.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from measure import print_table, progress, resumed
from motivation import GUESS_ALONE, INPAINTING, AllAtOnce, GuessAlone, dict_of, load_agent
from tqdm import tqdm

from sb3_said import SAID, DelayedObservationWrapper, PlannerConfig
from sb3_said.evaluation import confidence_interval, rollout
from sb3_said.files.archive import load_tree
from sb3_said.files.atomic import write_json
from sb3_said.files.checkpoint import CHECKPOINT_NAME
from sb3_said.files.state import restore_agent
from sb3_said.offline.belief import BeliefOnly, PlannerBelief
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.inpainting import newest
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.said.ways import WAYS
from sb3_said.zoo.answer import BEST_NAME, EXPERT_FOLDER
from sb3_said.zoo.arguments import explained
from sb3_said.zoo.record import Record

EXPERT = ("expert, last", "expert, average")
NETWORKS = ("cloning", "regressed present", "inpainted present", "guessed present", GUESS_ALONE)
SETTINGS: dict[str, dict[str, Any]] = {
    "SAID": {},
    INPAINTING: {"present": "inpainted"},
    "one step": WAYS["one_step"],
    "weighed": WAYS["weighed"],
    "chosen by Q": {"temperature": 1.0, "sampling_steps": 2, "scored_states": "future"},
}
SETTINGS["chosen by V"] = SETTINGS["chosen by Q"]
LEARNED = (*NETWORKS, *SETTINGS)
PAPER = {
    "paper": {"sampling_steps": 20},
    "paper, 2 steps": {"sampling_steps": 2},
    "paper, temperature 0": WAYS["default"],
}
ROWS = (*EXPERT, *LEARNED, "together", *PAPER)
ALONE = (*EXPERT, "together")  # rows without a planner's seed


class Regression:
    """The plain network that learns beside a planner: a belief of the present, and a policy by itself.

    :param trainer: of the planner
    :param model: the agent, which scales actions
    """

    def __init__(self, trainer: PlannerTrainer, model: SAID):
        self.network, self.normalizer = trainer.yardstick.requires_grad_(False), trainer.average.normalizer
        self.model, self.max_delay = model, trainer.planner.max_delay

    def ask(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the present (B, obs_dim) and the action (B, act_dim) in [-1, 1].

        :param action_history: (B, D, act_dim), oldest first
        """
        since = newest(action_history, delay, self.max_delay)
        present, action = self.network(self.normalizer.normalize_states(state), since, delay)
        return self.normalizer.denormalize_states(present), action.clamp(-1.0, 1.0)

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        return self.ask(state, action_history, delay)[0]

    def predict(self, observation: dict[str, np.ndarray], state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        tensors = {key: th.as_tensor(value, device=self.model.device) for key, value in observation.items()}
        delay = tensors["delay"][:, 0].long()
        action = self.ask(tensors["observation"], tensors["action_history"], delay)[1]
        return self.model.policy.unscale_action(action.cpu().numpy()), state


class Together:
    """Answers with the mean of several planners' answers.

    :param model: the agent of these planners
    :param planners: each takes the place of the agent's planner in turn
    """

    def __init__(self, model: SAID, planners: list[InpaintingPlanner]):
        self.model, self.planners = model, planners

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[np.ndarray, Any]:
        answers = []
        for planner in self.planners:
            self.model.policy.planner = planner
            answers.append(AllAtOnce(self.model).predict(observation)[0])
        return np.mean(answers, axis=0), state


def open_run(folder: Path, device: str = "cpu") -> SAID:
    """Return a run's agent with the replay of its checkpoint; if the run has not ended, the checkpoint's agent.

    :raises ValueError: for a folder without a checkpoint or a saved SAID agent
    """
    own, best = folder / Record.read(folder).agent_name, folder / EXPERT_FOLDER / BEST_NAME
    agents = [file for file in (own, best) if file.is_file()]
    if not agents or not (folder / CHECKPOINT_NAME).is_file():
        raise ValueError(f"{folder} has no {CHECKPOINT_NAME}, or no saved agent beside it; give a run of --algo said.")
    run = load_agent(agents[0], device)
    model = run.model
    if not isinstance(model, SAID):
        raise ValueError(f"{folder} is a run of {type(model).__name__}; give one of --algo said.")
    state = load_tree(folder / CHECKPOINT_NAME)
    model.set_env(run.make_env())
    if model.num_timesteps < state["counters"]["num_timesteps"]:
        restore_agent(model, state)
    model.replay_buffer.load_state_dict(state["replay_buffer"])
    return model


def open_with_log(agent: Path, log: Path, device: str = "cpu") -> SAID:
    """Return an agent whose replay is a log of its task.

    :raises ValueError: when it is no SAID agent, or the log is not of its task
    """
    run = load_agent(agent, device)
    if not isinstance(run.model, SAID):
        raise ValueError(f"{agent} is a {type(run.model).__name__}; give a SAID agent.")
    run.model.set_env(run.make_env())
    run.model.take_dataset(log)
    run.model.planner_newest_fraction = 1.0  # no step of a log is newer than another
    return run.model


def opened(p: argparse.ArgumentParser, run: Path, log: Path | None, device: str = "cpu") -> SAID:
    """Return a run's agent with its replay, or an agent with a log; the program ends where there is none.

    :param p: reports the error
    """
    with explained(p):
        return open_run(run, device) if log is None else open_with_log(run, log, device)


def agent_of(model: SAID, args: argparse.Namespace) -> dict[str, Any]:
    """Return what tells an agent and its data from others, in JSON types."""
    weights = [x.numpy(force=True).tobytes() for x in model.actor.state_dict().values()]
    digest = hashlib.sha256(b"".join(weights)).hexdigest()
    return {"steps": model.num_timesteps, "actor": digest, "log": None if args.log is None else args.log.name}


def make_env(model: SAID, delay: int) -> gym.Env[Any, Any]:
    """Return an agent's task under another fixed delay."""
    return DelayedObservationWrapper(gym.make(model.task or ""), delay, max_delay=model.policy.max_delay)


def train(model: SAID, config: PlannerConfig, updates: int, seed: int) -> PlannerTrainer:
    """Train a planner of these settings on the agent's replay, and hand it over."""
    model.policy.make_planner(config)
    model.seed = seed
    trainer = model.make_planner_trainer(updates)
    with tqdm(total=updates, desc=f"planner, seed {seed}") as bar:
        trainer.train(callback=lambda _: bar.update())
    model.policy.planner_updates.fill_(float(updates))
    return trainer


def learn_values(model: SAID, updates: int) -> None:
    """Learn V(s) on the agent's replay, and let it score plans."""
    model.policy.set_value("iql")
    learner = model._make_value_trainer()
    assert learner is not None  # V(s) was just asked for
    for _ in tqdm(range(updates * learner.values.config.updates), desc="V(s)"):
        learner.step()
    assert model.policy.values is not None
    model.policy.values.load_state_dict(learner.values.state_dict())


def preset_of(model: SAID, args: argparse.Namespace) -> PlannerConfig:
    """Return the settings of SAID's row, whatever the run's trial chose."""
    way = model.planner_ways.get("default", WAYS["default"])  # the first planner's, even if the trial took another
    return replace(model.policy.planner.config, **{**way, **args.planner_kwargs})


def players(model: SAID, rows: list[str], args: argparse.Namespace) -> Iterator[tuple[str, int | None, Any]]:
    """Train what is missing, and yield each row with its seed and its player.

    :param rows: those that are missing, as "row/seed"
    """
    policy = model.policy
    if "expert, last/None" in rows:
        with policy.answering("expert"), policy.without_average():
            yield "expert, last", None, model
    if "expert, average/None" in rows:
        with policy.answering("expert"):
            yield "expert, average", None, model
    preset = preset_of(model, args)
    together: list[InpaintingPlanner] = []
    for seed in args.seeds:
        if "together/None" in rows or any(f"{row}/{seed}" in rows for row in LEARNED):
            trainer = train(model, preset, args.updates, seed)
            together.append(copy.deepcopy(policy.planner))
            regression = Regression(trainer, model)
            with policy.answering("expert"):
                yield "cloning", seed, regression
                yield "regressed present", seed, BeliefOnly(regression, model, model.device)
                yield from (
                    (f"{which} present", seed, BeliefOnly(PlannerBelief(policy.planner, which), model, model.device))
                    for which in ("inpainted", "guessed")
                    if f"{which} present/{seed}" in rows  # not every planner has both
                )
                yield GUESS_ALONE, seed, GuessAlone(model)
            for row, how in SETTINGS.items():
                if f"{row}/{seed}" not in rows:
                    continue
                if row == "chosen by V":
                    learn_values(model, args.updates)
                policy.planner.config = replace(preset, **how)
                with policy.answering("planner"):
                    yield row, seed, AllAtOnce(model)
            policy.set_value("critics")
        if any(f"{row}/{seed}" in rows for row in PAPER):
            train(
                model,
                PlannerConfig.paper(mask=preset.mask, ema_warmup=True, precision=preset.precision),
                args.updates,
                seed,
            )
            papers = policy.planner.config
            for row, how in PAPER.items():
                policy.planner.config = replace(papers, **how)
                with policy.answering("planner"):
                    yield row, seed, AllAtOnce(model)
    if "together/None" in rows:
        with policy.answering("planner"):
            yield "together", None, Together(model, together)


def main(argv: list[str] | None = None) -> dict[str, Any]:
    """Train, play, print, write, and return the numbers."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path, metavar="RUN")
    p.add_argument("--log", type=Path, help="dataset to learn from")
    p.add_argument("--updates", type=int, default=8_000, help="of each planner, and of the networks beside it")
    p.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="of the planners")
    p.add_argument(
        "--planner-kwargs", type=partial(dict_of, "--planner-kwargs"), default={}, metavar="NAME=VALUE,...",
        help="other settings of the planner than the run's",
    )  # fmt: skip
    p.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW")
    p.add_argument("--delays", type=int, nargs="+", default=[0, 4, 8, 16])
    p.add_argument("--episodes", type=int, default=20, help="of each row, seed and delay")
    p.add_argument("--n-envs", type=int, default=20)
    p.add_argument("--eval-seed", type=int, default=10_000, help="reset seed of the first episode")
    p.add_argument("--num-threads", type=int, default=1)
    p.add_argument("--device", default="cpu", help="torch device, such as cuda")
    p.add_argument("--json", type=Path, required=True, help="file of the numbers, read and written")
    args = p.parse_args(argv)
    th.set_num_threads(args.num_threads)
    model = opened(p, args.run, args.log, args.device)
    preset = preset_of(model, args)
    if preset.first_guess == "none" and {"guessed present", GUESS_ALONE} & {*args.rows}:
        p.error(f"This planner has no first guess: leave 'guessed present' and {GUESS_ALONE!r} out of --rows.")
    if preset.mask == "none" and {"inpainted present", INPAINTING} & {*args.rows}:
        p.error(f"This planner inpaints no present: leave 'inpainted present' and {INPAINTING!r} out of --rows.")
    settings: dict[str, Any] = {key: getattr(args, key) for key in ("updates", "episodes", "eval_seed")}
    settings |= agent_of(model, args)
    settings |= {f"planner_{name}": value for name, value in preset.to_dict().items()}
    document = resumed(p, args.json, settings, returns={})
    returns: dict[str, dict[str, list[float]]] = document["returns"]

    keys = [f"{row}/{seed}" for row in args.rows for seed in ([None] if row in ALONE else args.seeds)]
    missing = [key for key in keys if any(str(d) not in returns.get(key, {}) for d in args.delays)]
    for row, seed, player in players(model, missing, args):
        key = f"{row}/{seed}"
        for delay in args.delays if key in missing else ():
            if str(delay) not in returns.setdefault(key, {}):
                progress(f"{key} plays {args.episodes} episodes at delay {delay}")
                th.manual_seed(seed or 0)  # of the noise of candidates
                played = rollout(player, partial(make_env, model, delay), args.episodes, args.eval_seed, args.n_envs)
                returns[key][str(delay)] = played.returns.tolist()
                write_json(args.json, document)
    show(returns, args)
    return document


def show(returns: dict[str, dict[str, list[float]]], args: argparse.Namespace) -> None:
    """Print a Markdown table: intervals over the planners' seeds, or over episodes of a single agent."""
    table = []
    for row in args.rows:
        seeds = [None] if row in ALONE else args.seeds
        cells = {}
        for delay in args.delays:
            values = np.array([returns[f"{row}/{seed}"][str(delay)] for seed in seeds])  # (n_seeds, n_episodes)
            cells[str(delay)] = str(confidence_interval(values if len(values) > 1 else values[0]))
        table.append({"return at delay": row, **cells})
    print_table(table)


if __name__ == "__main__":
    main()
