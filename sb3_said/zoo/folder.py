"""A run's folder: one process claims it, a resume continues its logs, and its agents are found in it."""

from __future__ import annotations

import os
import shlex
import warnings
from pathlib import Path

from filelock import FileLock, Timeout

from sb3_said.files.archive import SavedFileError, load_metadata
from sb3_said.files.atomic import remove_abandoned
from sb3_said.files.normalization import normalization_file, normalizes_observations
from sb3_said.zoo.answer import BEST_NAME, EXPERT_FOLDER
from sb3_said.zoo.record import GIVEN_NAME, RECORD_NAME, Record

TUNED_NAME, TUNED_SETTINGS = "best.zip", "best.yml"  # what sb3-said tune leaves in its folder


def claim_folder(parent: Path, name: str, suffix: str = "") -> Path:
    """Make ``parent/name_K``, where K follows the largest number there. Two processes get two folders."""
    parent.mkdir(parents=True, exist_ok=True)
    taken = [path.name.removeprefix(f"{name}_").split("_")[0] for path in parent.glob(f"{name}_[0-9]*")]
    number = max([int(text) for text in taken if text.isdigit()], default=0)
    while True:
        number += 1
        folder = parent / f"{name}_{number}{suffix}"
        try:
            folder.mkdir()  # atomic: it fails if another process has made the folder
            return folder
        except FileExistsError:
            continue


def resuming(folder: Path) -> str:
    """Return the option that goes on with a run, quoted for a shell."""
    return f"--resume {shlex.quote(str(folder))}"


def hold_folder(folder: Path) -> FileLock:
    """Hold a run's folder until the lock is released or the process ends. Remove what killed writes left there.

    :raises ValueError: while another process trains there
    """
    lock = FileLock(folder / "run.lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ValueError(f"{folder} is being trained by another process; wait until it ends, or stop it.") from None
    remove_abandoned(folder)
    return lock


def log_suffix(folder: Path, steps: int) -> str:
    """Return a suffix of ``progress.csv`` that no log has yet.

    :param folder: of the run
    :param steps: environment steps that the run has taken
    """
    names = ["" if steps == 0 else f"_{steps}", *(f"_{steps}_{k}" for k in range(2, 1000))]
    return next(name for name in names if not (folder / f"progress{name}.csv").exists())


def drop_undone_episodes(checkpoint: Path) -> None:
    """Cut from SB3's monitor files the episodes that a resume undoes: those that ended after the checkpoint.

    The episode during which the checkpoint was written stays missing from the files.
    """
    noted = load_metadata(checkpoint)["metadata"].get("monitors")
    for file in checkpoint.parent.glob("*.monitor.csv"):
        size = noted.get(file.name) if isinstance(noted, dict) else None
        if type(size) is int and 0 <= size < file.stat().st_size:
            os.truncate(file, size)  # in place: the environments have opened it, to append to it


def find_agent(path: Path) -> tuple[Path, Record | None]:
    """Return the agent's file, and the record of its run if it lies in a run folder.

    :param path: a run folder, or an agent's ``.zip``
    :raises ValueError: for a path without an agent
    """
    if not path.exists():
        raise ValueError(
            f"{path} does not exist; give a run folder such as logs/said/Hopper-v5-delay4-seed1_1 or a .zip."
        )
    if path.is_file():
        folder = path.absolute().parent
        folder = folder.parent if folder.name == EXPERT_FOLDER else folder
        return path, Record.read(folder) if (folder / RECORD_NAME).is_file() else None
    runs = sorted(str(record.parent) for record in path.glob(f"**/{RECORD_NAME}"))
    runs = [run for run in runs if run == str(path) or not (Path(run) / TUNED_SETTINGS).is_file()]
    if runs and str(path) not in runs:
        raise ValueError(f"{path} is not a run folder: it holds the runs {', '.join(runs)}.")
    record = Record.read(path)
    names = record.agent_name, BEST_NAME, TUNED_NAME
    for name in names:
        if (path / name).is_file():
            return path / name, record
    raise ValueError(
        f"{path} has no finished agent: none of {', '.join(names)}. sb3-said train {resuming(path)} goes on with it."
    )


def find_normalization(file: Path, record: Record | None) -> Path | None:
    """Return the file of an agent's statistics of ``VecNormalize``, None without.

    An agent may have learned from observations as they are. Statistics of observations beside it then belonged to
    another agent of its name: they are left out, with a warning. rl_zoo3's checkpoints have no statistics of their own.
    They are played with those of the last agent, with a warning.

    :param file: of the agent; ``file`` and ``record`` are as :func:`find_agent` returns them
    :raises SavedFileError: where the statistics cannot be read
    """
    own = normalization_file(file)
    agents = [own]
    if record is not None and file.name != GIVEN_NAME:  # rl_zoo3's checkpoints (--save-freq) have none of their own
        agents.append(normalization_file(file.with_name(record.agent_name)))
    found = next((path for path in agents if path.is_file()), None)
    if found is not None and _reads_them_as_they_are(file) and normalizes_observations(found):
        warnings.warn(
            f"{found} is left out: {file} learned of observations as they are, so it belonged to another agent of that "
            "name. Delete it.",
            stacklevel=2,
        )
        return None
    if found not in (None, own) and file.name.startswith("rl_model_"):
        told = f"{file} is played with {found}, statistics of VecNormalize of another step: it has none of its own."
        warnings.warn(told, stacklevel=2)
    return found


def _reads_them_as_they_are(agent: Path) -> bool:
    """Return whether an agent's file says that no ``VecNormalize`` changed its observations."""
    try:
        told = load_metadata(agent)["metadata"]
    except SavedFileError:  # an agent of SB3's own
        return False
    return isinstance(told, dict) and told.get("reads_normalized") is False
