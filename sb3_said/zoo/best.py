"""Write what a search found: best.yml to train with, and beside best.zip the files that make its task."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from sb3_said.files.atomic import write_text
from sb3_said.files.normalization import normalization_file
from sb3_said.zoo.folder import TUNED_SETTINGS
from sb3_said.zoo.record import Record, evaluated


def write_best(run: Path, folder: Path, planner: dict[str, Any], n_updates: int, choice: str) -> str:
    """Write the YAML of a tuned run, and return the command that trains with it.

    :param run: folder of the run that was tuned
    :param folder: to write to
    :param planner: settings of the best trial's planner, which replace those of the run
    :param n_updates: updates that the planner was trained for
    :param choice: says how the settings were chosen, for a comment
    """
    record = Record.read(run)
    hyperparams = {
        **record.hyperparams,
        "planner_kwargs": {**(record.hyperparams.get("planner_kwargs") or {}), **planner},
    }
    options = record.options
    if record.dataset:
        options = {**options, "n_timesteps": n_updates}
    elif n_updates != record.hyperparams.get("planner_gradient_steps"):
        hyperparams["planner_gradient_steps"] = n_updates
    record = replace(record, hyperparams=hyperparams, options=options)
    if (statistics := normalization_file(run / record.agent_name)).exists():
        shutil.copyfile(statistics, normalization_file(folder / record.agent_name))  # serves all agents there

    words = ["sb3-said", "train", "--algo", "said", *record.task_words(), *record.agent_words()]
    if record.eval_env_kwargs != record.env_kwargs:  # the YAML has only env_kwargs
        words += ["--eval-env-kwargs", *(f"{name}:{value!r}" for name, value in record.eval_env_kwargs.items())]
    command = shlex.join([*words, "-conf", str(folder / TUNED_SETTINGS)])

    block, left_out = plain_settings(record)
    lines = [f"{choice}; see results.json.", command]
    lines += [f"Left out, as YAML cannot hold it: {name}" for name in left_out]
    text = "".join(f"# {line}\n" for line in lines) + yaml.safe_dump({record.env: block}, sort_keys=False)
    write_text(folder / TUNED_SETTINGS, text)
    record.write(folder)  # makes the task of best.zip; last, as without the YAML the folder looks like a run's
    return command


def plain_settings(record: Record) -> tuple[dict[str, Any], list[str]]:
    """Return hyper-parameters as rl_zoo3 reads them from YAML, and the names of those that YAML cannot hold.

    :param record: of a run; its ``env_kwargs`` and ``n_timesteps`` are taken in, too
    """
    given = {name: value for name, value in record.hyperparams.items() if name != "env_wrapper" or value}
    given |= {"env_kwargs": record.env_kwargs} if record.env_kwargs else {}
    given |= {} if record.n_timesteps is None else {"n_timesteps": record.n_timesteps}
    block, left_out = {}, list(record.missing)
    for name, value in given.items():
        try:
            block[name] = yaml.safe_load(yaml.safe_dump(value))
        except yaml.YAMLError:
            try:
                block[name] = evaluated(name, value)
            except ValueError:
                left_out.append(name)
    return block, left_out
