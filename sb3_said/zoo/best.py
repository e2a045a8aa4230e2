"""Write what a search found as YAML: a best.yml to train with, and the settings beside best.zip to play it with."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import yaml

from sb3_said.files.atomic import write_text
from sb3_said.zoo.manager import WRAPPER, read_arguments
from sb3_said.zoo.runs import read_params
from sb3_said.zoo.train import own_parser


def write_best(run: Path, folder: Path, planner: dict[str, Any], choice: str) -> str:
    """Write the YAML of a tuned run, and return the command that trains with it.

    The run's YAML can run code: tune only runs that you trust.

    :param run: folder of the run that was tuned
    :param folder: to write to
    :param planner: its settings that were tried
    :param choice: how they were chosen, for a comment
    """
    params = next(run.glob("*/args.yml")).parent
    config = dict(yaml.load((params / "config.yml").read_text(), Loader=yaml.UnsafeLoader))
    config["planner_kwargs"] = {**(config.get("planner_kwargs") or {}), **planner}
    beside = shutil.copytree(params, folder / params.name, dirs_exist_ok=True)  # VecNormalize's statistics, too
    write_text(beside / "config.yml", yaml.dump(config))

    args = read_params(params)[1]
    options, _ = own_parser().parse_known_args(read_arguments(run))
    words = ["sb3-said", "train", "--algo", "said", "--env", args["env"]]
    for name, delay in (("--delay", options.delay), ("--expert-delay", options.expert_delay)):
        words += [name, *delay] if delay else []
    command = shlex.join([*words, "-conf", str(folder / "best.yml")])

    block, left_out = plain_settings(config, args)
    lines = [f"{', '.join(planner)}: {choice}; see results.json.", command]
    lines += [f"Left out, as YAML cannot hold it: {name}" for name in left_out]
    text = "".join(f"# {line}\n" for line in lines) + yaml.safe_dump({args["env"]: block}, sort_keys=False)
    write_text(folder / "best.yml", text)
    return command


def plain_settings(config: dict[str, Any], args: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return hyper-parameters as rl_zoo3 reads them from YAML, and the names of those that YAML cannot hold.

    The wrapper of the delay is left out, since ``--delay`` adds it.

    :param config: a run's config.yml
    :param args: its command line, whose settings beside the hyper-parameters are taken in
    """
    wrappers = config.get("env_wrapper") or []
    wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
    given = {**config, "env_wrapper": [w for w in wrappers if not (isinstance(w, dict) and WRAPPER in w)]}
    given |= {"env_kwargs": args["env_kwargs"]} if args.get("env_kwargs") else {}
    given |= {"n_timesteps": args["n_timesteps"]} if args.get("n_timesteps", -1) > 0 else {}
    if not given["env_wrapper"]:
        del given["env_wrapper"]
    block, left_out = {}, []
    for name, value in given.items():
        try:
            block[name] = yaml.safe_load(yaml.safe_dump(value))
        except yaml.YAMLError:
            left_out.append(name)
    return block, left_out
