"""Write a model card beside an agent's file, in the form of the Hugging Face Hub, from what was measured of it."""

from __future__ import annotations

import ast
import csv
import hashlib
import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from huggingface_hub import EvalResult, ModelCard, ModelCardData

from sb3_said import SAID, PlannerConfig
from sb3_said.delays.space import written_ages
from sb3_said.files.agents import task_of
from sb3_said.files.archive import load_metadata
from sb3_said.files.atomic import check_writable, write_text
from sb3_said.files.normalization import normalization_file
from sb3_said.zoo.algorithms import ALGORITHMS
from sb3_said.zoo.arguments import explained, make_parser
from sb3_said.zoo.cells import Cell, Results
from sb3_said.zoo.playing import digest_of
from sb3_said.zoo.presets import config_file, preset_overrides
from sb3_said.zoo.record import Record, evaluated
from sb3_said.zoo.runs import LoadedRun, changes, control_period, load_run, longest_delay
from sb3_said.zoo.tables import average

EPILOG = """\
examples:
  # an agent to hand on, its returns over delay, its card
  sb3-said decide logs/said/Hopper-v5-delay0-16-seed1_1 --compact -o agents/hopper.zip
  sb3-said over-delays SAID=agents/hopper.zip --delays 0 4 8 16 --episodes 50 --json hopper.json
  sb3-said evaluate agents/hopper.zip --json hopper_latency.json
  sb3-said card agents/hopper.zip --run logs/said/Hopper-v5-delay0-16-seed1_1 --returns hopper.json \\
      --latency 3.1   # writes agents/hopper.md

The returns must be of this very file: one that was measured before the file was written anew is refused.
"""

CARD_BEGINS = b"---\n"  # every card on the Hub begins with YAML
TEMPLATE = """\
---
{{ card_data }}
---

# {{ title }}

{{ text }}
"""


def main(argv: list[str] | None = None) -> None:
    parser = make_parser(__doc__, EPILOG)
    parser.add_argument("agent", type=Path, metavar="ZIP", help="the agent's file")
    parser.add_argument("--run", type=Path, required=True, help="folder of the run that made it: command, seed, budget")
    parser.add_argument(
        "--returns", type=Path, required=True, metavar="JSON", help="what over-delays wrote of the file"
    )
    parser.add_argument("--latency", type=float, metavar="MS", help="median time of a decision, as evaluate printed it")
    parser.add_argument("-o", "--output", type=Path, metavar="MD", help="the card (default: beside the agent, .md)")
    args = parser.parse_args(argv)
    target = args.output or args.agent.with_suffix(".md")
    with explained(parser):
        if args.latency is not None and not 0 < args.latency < math.inf:
            raise ValueError(f"--latency is a time in milliseconds, above 0, got {args.latency}.")
        if args.agent.is_dir():
            raise ValueError(f"{args.agent} is a folder: give the agent's file, such as {args.agent / 'agent.zip'}.")
        check_writable(target)
        if target.is_file() and not target.read_bytes().startswith(CARD_BEGINS):
            raise ValueError(f"{target} is no model card, and would be replaced: give another --output.")
        record, results = Record.read(args.run), Results(args.returns, None)
        check_made_by(args.agent, record)
        run = load_run(args.agent, record.algo, record.env, gym_packages=record.gym_packages)
        card = make_card(run, record, results, args.latency, trial_steps(args.run))
        write_text(target, str(card))
        print(f"Wrote {target}")


def check_made_by(file: Path, record: Record) -> None:
    """
    :param record: of the run that is said to have made the file
    :raises ValueError: for an agent of another class or task
    """
    metadata = load_metadata(file)
    task = task_of(metadata) or record.env
    refuse_others(file, {"class": (ALGORITHMS[record.algo][0].__name__, metadata["kind"]), "env": (record.env, task)})


def refuse_others(file: Path, made: dict[str, tuple[Any, Any]]) -> None:
    """
    :param made: by name what the run has, and what the agent has
    :raises ValueError: where these differ
    """
    if others := {name: pair for name, pair in made.items() if pair[0] != pair[1]}:
        told = ", ".join(f"{name}={own!r}, and the agent {name}={its!r}" for name, (own, its) in others.items())
        raise ValueError(f"{file} is not of the run that --run names, which has {told}: name its own.")


def trial_steps(folder: Path) -> int:
    """Return the environment steps of a run's trials, which ``learn`` does not count.

    They are in the run's logs. Each resume has a log of its own.
    """
    steps = 0
    for file in folder.glob("progress*.csv"):
        with file.open(newline="") as rows:
            steps += sum(int(float(row.get("trial/steps") or 0)) for row in csv.DictReader(rows))
    return steps


def make_card(
    run: LoadedRun, record: Record, results: Results, latency_ms: float | None = None, n_trial_steps: int = 0
) -> ModelCard:
    """Return the card of an agent.

    :param run: the agent, opened from its file
    :param record: of the run that made it
    :param results: of ``over-delays``, with cells of this file
    :param latency_ms: median time of a decision
    :param n_trial_steps: environment steps of the trials, beyond those of the training
    :raises ValueError: when the results hold nothing of this file, or are of another task than its training
    """
    refuse_others(Path(run.info["file"]), {"seed": (record.seed, run.model.seed)})
    if run.changes != (trained := changes(record.env_kwargs, record.wrappers)):
        raise ValueError(
            f"{run.info['file']} was trained in a task that its run changes by {trained}, and outside the run's folder "
            f"plays in one changed by {run.changes}. Give the file as it lies in that folder, to over-delays, too."
        )
    if results.settings["env"] != record.env:
        raise ValueError(
            f"{results.path} holds returns of {results.settings['env']}, and the agent is of {record.env}: give what "
            "over-delays wrote of it."
        )
    file = Path(run.info["file"])
    digest = digest_of(run)
    known = [cell for cell in results.cells if cell.sha256 == digest and cell.result is not None]
    cells = [*{cell.key: cell for cell in known}.values()]  # each once, though the file may have several labels
    who = run.model.policy.who_answers if hasattr(run.model.policy, "who_answers") else None
    answered = [cell for cell in cells if cell.answer == who and not cell.age_error]
    if not answered:
        asked = dict.fromkeys(str(cell.delay) for cell in results.cells)
        words = ["over-delays", f"X={file}", "--delays", *asked, "--episodes", str(results.settings["n_episodes"])]
        words += ["--seed", str(results.settings["seed"]), "--json", str(results.path)]
        lacking = f"as its {who}, who answers in it" if cells else "as it is now"
        raise ValueError(
            f"{results.path} holds no returns of {file} {lacking}: play it with sb3-said {shlex.join(words)} first."
        )
    env_id, returns = run.info["env"], np.concatenate([cell.result["returns"] for cell in answered if cell.result])
    delays = ", ".join(str(cell.delay) for cell in answered)
    result = EvalResult(
        task_type="reinforcement-learning",
        task_name="reinforcement-learning",
        dataset_name=env_id,
        dataset_type=env_id,
        metric_type="mean_reward",
        metric_name=f"mean_reward, observation delays {delays}",
        metric_value=f"{returns.mean():.2f} +/- {returns.std():.2f}",
        verified=False,
    )
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_said"],
        model_name=type(run.model).__name__,
        eval_results=[result],
    )
    text = describe(run, record, results, cells, latency_ms, n_trial_steps)
    title = f"{type(run.model).__name__} on {env_id} under observation delay"
    return ModelCard.from_template(data, template_str=TEMPLATE, title=title, text=text)


def describe(
    run: LoadedRun,
    record: Record,
    results: Results,
    cells: list[Cell],
    latency_ms: float | None,
    n_trial_steps: int,
) -> str:
    """Return the card's text: how to use it, how it was made, and what it returned."""
    file = Path(run.info["file"])
    kind = type(run.model).__name__
    n_episodes, seed = results.settings["n_episodes"], results.settings["seed"]
    period = control_period(run)
    steps = "gradient steps, on logs" if record.dataset else "environment steps"
    facts: dict[str, Any] = {
        "ages trained on": written_ages(ages_trained_on(run, record)) + " control steps",
        "largest age it reads": f"{longest_delay(run.model) or 0} control steps",
        **({"task changed by": run.setting} if run.changes else {}),
        "control period": "unknown" if period is None else f"{1000 * period:g} ms",
        "who answers": who_answers(run.model),
        steps: f"{run.model.num_timesteps:,}"
        + (f", and {n_trial_steps:,} to choose how it decides" if n_trial_steps else ""),
        "training seed": record.seed,
        "made by": f"`{made_by(record, run.model)}`",
        "SHA-256": f"`{hashlib.sha256(file.read_bytes()).hexdigest()}`",
        **({} if run.normalize is None else {"belongs beside it": f"`{normalization_file(file).name}`"}),
        "median decision": "not measured" if latency_ms is None else f"{latency_ms:g} ms, one CPU thread",
    }
    packages = ["--gym-packages", *record.gym_packages] if record.gym_packages else []
    words = ["enjoy", file.name, "--delay", str(longest_delay(run.model) or 0), *packages, "--record", "video.mp4"]
    shows = f"`sb3-said {shlex.join(words)}` shows it."
    if run.changes:
        shows = "It plays right in its run's folder, or in an environment of yours with the changes below."
    lines = [
        "```python",
        *use(run),
        "```",
        "",
        shows,
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in facts.items()),
        "",
        f"Mean returns of {n_episodes} episodes (reset seeds {seed}..{seed + n_episodes - 1})"
        + " with 95 % intervals over these episodes" * (n_episodes > 1)
        + ", of one training seed:",
        "",
    ]
    columns = list(dict.fromkeys(cell.column for cell in cells))
    rows = list(dict.fromkeys(cell.answer or kind for cell in cells))
    lines += ["| under delay | " + " | ".join(rows) + " |", "|---" * (len(rows) + 1) + "|"]
    for column in columns:
        texts = []
        for row in rows:
            found = [c.result for c in cells if c.column == column and (c.answer or kind) == row]
            texts.append(average({column: np.array(found[0]["returns"])}, [column])[0] if found and found[0] else "-")
        lines.append(f"| {column} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


def use(run: LoadedRun) -> list[str]:
    """Return the lines of Python that let an agent act."""
    kind, file = type(run.model).__name__, Path(run.info["file"])
    head, load = [f"from sb3_said import {kind}"], [f'model = {kind}.load("{file.name}")']
    if run.normalize is None:
        act = "action, _ = model.predict(observation, deterministic=True)  # of a DelayedObservationWrapper"
        return [*head, "", *load, act]
    head = ["from stable_baselines3.common.vec_env import DummyVecEnv", "", *head]
    head.append("from sb3_said.files.normalization import load_normalization")
    beside = normalization_file(file).name
    load.append(f'statistics = load_normalization("{beside}", DummyVecEnv([make_env]))  # what it read in training')
    read = "statistics.normalize_obs(observation)"
    return [*head, "", *load, f"action, _ = model.predict({read}, deterministic=True)  # of what make_env makes"]


def ages_trained_on(run: LoadedRun, record: Record) -> list[int]:
    """Return the ages that an agent was trained on: all, for a planner from logs or from an expert of another delay."""
    if isinstance(run.model, SAID) and (record.dataset or record.expert_delay is not None):
        return [*range(run.model.policy.max_delay + 1)]
    return run.model.trained_ages or []  # type: ignore[attr-defined]  # all of ours have them


def who_answers(model: Any) -> str:
    """Say who answers in an agent, up to which age, and in which way its planner decides."""
    if not isinstance(model, SAID):
        return type(model).__name__
    who, config = model.policy.who_answers, model.policy.planner.config
    if who not in ("planner", "both"):
        return who
    if config.decided_by == "actor":
        how = "'s guess of the present, at which the expert's actor decides"
    else:
        how = f" in {config.sampling_steps} denoising step{'s' * (config.sampling_steps > 1)}"
        how += " with the present inpainted" if config.present == "inpainted" else " from a guess of the present"
        how += f" at temperature {config.temperature:g}"
        if config.temperature:
            how += f", {config.n_candidates} candidates, "
            how += "the one of the highest value decides" if config.choice_factor is None else "weighed by their values"
    return (
        f"{who}{how}"
        if who == "planner"
        else f"the expert at ages {written_ages([*model.policy.expert_ages])}, else the planner{how}"
    )


def made_by(record: Record, model: Any = None) -> str:
    """Return the command that trains such an agent, with the settings that are not the preset's.

    :param model: the agent; it holds settings that the preset has gained since, and those of its planner
    """
    file = config_file(record.algo, bool(record.dataset))
    blocks = yaml.safe_load(file.read_text())
    usual = blocks.get(record.env, blocks["default"])
    usual |= preset_overrides(file, record.preset, record.env, record.delay, dataset=record.dataset)
    steps = record.options.get("n_timesteps") or -1
    if steps < 0 and record.hyperparams.get("n_timesteps") not in (None, usual["n_timesteps"]):
        steps = int(record.hyperparams["n_timesteps"])  # rl_zoo3's -1 takes the steps from the YAML, or from -params
    budget = ["-n", str(steps)] if steps > 0 else []
    newer = usual.keys() - record.hyperparams.keys() - {"policy", "planner_kwargs"}
    had = {name: getattr(model, name) for name in sorted(newer) if hasattr(model, name)} | record.hyperparams
    given = had.get("planner_kwargs") or {}
    if isinstance(model, SAID) and isinstance(given, dict):
        asked, has = PlannerConfig(**given).weight_settings(), model.policy.planner.config.weight_settings()
        # The mask is left out: the trial chooses it
        older = {name: value for name, value in has.items() if value != asked[name] and name != "mask"}
        had |= {"planner_kwargs": given | older} if older else {}
    own = {name: value for name, value in had.items() if value != usual.get(name) and name != "n_timesteps"}
    words = ["sb3-said", "train", "--algo", record.algo, *record.task_words(), "--preset", record.preset, *budget]
    words += [*record.agent_words(), "--seed", str(record.seed)]
    left_out = [*record.missing]
    for option, settings in (("-params", own), ("--env-kwargs", record.env_kwargs)):
        texts = {name: as_word(name, value) for name, value in settings.items()}
        left_out += [name for name, text in texts.items() if text is None]
        given = [f"{name}:{text}" for name, text in texts.items() if text is not None]
        words += [option, *given] if given else []
    return shlex.join(words) + f"  # and {', '.join(left_out)}, which no command line holds" * bool(left_out)


def as_word(name: str, value: Any) -> str | None:
    """Write a setting for a command line: as Python, or as text of Python with rl_zoo3's names; else return None."""
    try:
        ast.literal_eval(repr(value))
        return repr(value)
    except (SyntaxError, ValueError):
        pass
    try:
        return repr(evaluated(name, value))
    except ValueError:
        return None
