"""Presets: the hyper-parameters in ``zoo_configs/`` that one word on the command line changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from sb3_said.planner import PlannerConfig
from sb3_said.zoo.arguments import Delay, ages_under, largest_delay

PRESETS = ("cpu", "paper", "smoke", "quick")

_INSTALLED = Path(__file__).parent / "configs"  # where the wheel puts zoo_configs
CONFIGS = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).resolve().parents[2] / "zoo_configs"


def config_file(algo: str, offline: bool = False) -> Path:
    """Return the YAML file of an algorithm; SAC, SA, DR and SADR share one, and SAID has another for logs."""
    if algo in ("sac", "sa", "dr", "sadr"):
        return CONFIGS / "delayed_sac.yml"
    return CONFIGS / ("said_offline.yml" if algo == "said" and offline else f"{algo}.yml")


def dataset_kind(dataset: Sequence[str]) -> str:
    """Return which of D4RL's kinds a dataset is by its name: medium-expert, medium-replay, or else medium.

    :param dataset: paths, of which folders do not count, and ids of Minari datasets
    """
    name = " ".join(Path(source).stem for source in dataset).lower()
    return "medium-replay" if "replay" in name else "medium-expert" if "expert" in name else "medium"


def preset_overrides(
    config: str | Path,
    preset: str,
    env_id: str,
    delay: Delay,
    max_delay: int | None = None,
    dataset: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what a preset changes for a task: its own entry of ``presets:`` in the file, or the preset's default.

    ``cpu`` changes nothing in the file's block for the task: the constructors' defaults, a
    ``planner_terminal_penalty`` for tasks that end by falling, and a larger ``gamma`` on legs. Three keys are for
    planners:

    - ``planner_kwargs: {base: paper, ...}`` starts from ``PlannerConfig.paper()``.
    - ``planner_by_delay`` adds the settings of the largest delay, and of ``varies`` if the delay is not one number.
    - ``planner_by_dataset`` has such entries for kinds of datasets. They replace those of the same delay.

    A file may have ``by_dataset:`` beside its presets. Every preset also gets the entry there for the task and the kind
    of dataset.

    :param config: YAML; rl_zoo3 takes Python files, too, which have no presets
    :param max_delay: length of the action history, by default the largest of ``delay``; if it is longer, ages vary, too
    :param dataset: logs to learn from, whose names tell their kind
    :raises ValueError: for a preset that the file does not have, and a file that is no YAML of settings
    """
    is_yaml, kind = Path(config).suffix in (".yml", ".yaml"), dataset_kind(dataset)
    try:
        document = yaml.safe_load(Path(config).read_text()) if is_yaml else {}
    except yaml.YAMLError as error:
        raise ValueError(f"{config} is no YAML: {error}") from error
    block = document.get(env_id, document.get("default", {})) if isinstance(document, dict) else document
    if not isinstance(block, dict):
        held = "nothing" if block is None else f"a {type(block).__name__}"
        raise ValueError(f"{config} holds {held}, expected settings by task, such as {env_id}: {{n_timesteps: 9000}}.")
    presets = {"cpu": {"default": {}}, **_part(document, "presets", config)}
    if preset not in presets:
        raise ValueError(f"{config} has no preset '{preset}', only {[*presets]}.")
    suited = _part(_part(_part(document, "by_dataset", config), env_id, config), kind, config)
    blocks = _part(presets, preset, config)
    overrides = {**suited, **_part(blocks, env_id if env_id in blocks else "default", config)}
    by_kind = overrides.pop("planner_by_dataset", {}).get(kind, {})
    by_delay = {**overrides.pop("planner_by_delay", {}), **by_kind}
    planner = dict(overrides.get("planner_kwargs", {}))
    if planner.pop("base", None) == "paper":
        planner = {**PlannerConfig.paper().to_dict(), **planner}
    planner |= by_delay.get(largest_delay(delay), {})
    if ages_under(delay) != [largest_delay(delay) if max_delay is None else max_delay]:
        planner |= by_delay.get("varies", {})
    return {**overrides, "planner_kwargs": planner} if planner else overrides


def _part(settings: dict[str, Any], name: str, config: str | Path) -> dict[str, Any]:
    """Return the settings of a name, none where there is nothing.

    :raises ValueError: for something else there
    """
    part = settings.get(name) or {}
    if not isinstance(part, dict):
        raise ValueError(f"{config} holds {part!r} as {name}, expected settings by name.")
    return part
