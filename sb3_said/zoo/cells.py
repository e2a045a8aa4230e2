"""Results of agents under several delays, in a JSON file that later calls add to."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock

from sb3_said.delays.text import make_process
from sb3_said.files.atomic import write_json

AGE = ", age "  # stands before the age error in the name of a column


@dataclass
class Cell:
    """One agent under one delay, and its result."""

    agent: str
    answer: str | None
    """who acts in a SAID agent"""
    delay: int | str
    """control steps, or a process as it was written"""
    algo: str
    file: str
    """the agent's file: absolute if the command line gave it so. Otherwise the path starts at the working directory;
    written to the JSON file, it starts at that file's folder"""
    sha256: str
    """of the file and of all else that decides what the agent sees: what its run changes in the task besides the
    delay, and the statistics of ``VecNormalize``, if any"""
    trained_steps: int
    obstacle: str | None
    """why the agent cannot play this delay"""
    origin: int | None = None
    """which of the file's origins made the result"""
    result: dict[str, Any] | None = None
    """a summary without its label: the cell has that"""
    age_error: int = 0
    """control steps by which the age is told wrong; the told age is cut at 0 and at the agent's largest"""
    is_changed: bool = False
    """whether its run changes the task; no reference return holds for a changed task"""

    @property
    def key(self) -> tuple[str, ...]:
        """The file's contents, the answer, the delay and the age error. Cells of equal keys have equal results. Only
        rounding depends on how many episodes are played side by side."""
        return self.sha256, str(self.answer), repr(make_process(self.delay)), str(self.age_error)

    @property
    def lineage(self) -> tuple[str, str]:
        """The file and the label. A cell with equal ones but another ``sha256`` is of an earlier state of the agent."""
        return os.path.abspath(self.file), self.agent.removesuffix(f" {self.answer}")

    @property
    def column(self) -> int | str:
        """The cell's column in the table: its delay, and how wrong the age is told."""
        return f"{self.delay}{AGE}{self.age_error:+d}" if self.age_error else self.delay


class Results:
    """The cells of a JSON file, which is always written whole. Several processes may add to one file at a time.

    :param path: of the file, which need not exist yet
    :param settings: what all cells have in common; those of the file by default
    :raises ValueError: for a file of another kind or with other settings, and for neither file nor settings
    """

    def __init__(self, path: Path, settings: dict[str, Any] | None = None):
        self.path = path
        if settings is None and not path.exists():
            raise ValueError(f"{path} does not exist: sb3-said over-delays writes it, where runs to play are named.")
        found, self.origins, self.cells = _read(path) if path.exists() else (settings or {}, [], [])
        self.settings = found if settings is None else settings
        self._asked: list[Cell] = []
        self._own: int | None = None  # which of the origins is this process's
        if found != self.settings:
            raise ValueError(f"{path} holds {found}, but {settings} is to be played: give another --json.")

    def ask(self, cells: list[Cell]) -> list[Cell]:
        """Put these cells first, and fill in results known under any label. Drop cells of agents whose file changed.

        :return: the dropped cells
        """
        known = {cell.key: cell for cell in self.cells if cell.result is not None}
        for cell in cells:
            if cell.obstacle is None and cell.result is None and (old := known.get(cell.key)) is not None:
                cell.origin, cell.result = old.origin, old.result
        asked, agents = {(cell.agent, cell.key) for cell in cells}, {cell.lineage: cell.sha256 for cell in cells}
        others = [cell for cell in self.cells if (cell.agent, cell.key) not in asked]

        def has_changed(cell: Cell) -> bool:
            return agents.get(cell.lineage, cell.sha256) != cell.sha256

        self.cells = cells + [cell for cell in others if not has_changed(cell)]
        self._asked = cells
        return [cell for cell in others if has_changed(cell)]

    def add(self, cell: Cell, result: dict[str, Any], origin: dict[str, Any]) -> None:
        """Store the result of a cell that was asked for, and write the file.

        :param origin: command, date, machine and versions
        """
        with self._newest():
            if self._own is None:  # each process adds one; none is ever removed, so its number stays
                self._own = len(self.origins)
                self.origins.append(origin)
            cell.origin, cell.result = self._own, result

    def write(self) -> None:
        """Write the file, whole or not at all, without the cells that are still to be played."""
        with self._newest():
            pass

    @contextmanager
    def _newest(self) -> Iterator[None]:
        """Take in what other processes have added, and write the file after the context. Until then they wait."""
        with FileLock(self.path.with_name(f".{self.path.name}.lock")):
            if self.path.exists():
                newest = Results(self.path, self.settings)
                newest.ask(self._asked)
                self.origins, self.cells = newest.origins, newest.cells
            yield
            cells = [cell for cell in self.cells if cell.result is not None or cell.obstacle is not None]
            written = [asdict(replace(cell, file=_moved(cell.file, to=self.path.parent))) for cell in cells]
            write_json(self.path, {**self.settings, "origins": self.origins, "cells": written})


def _read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]], list[Cell]]:
    try:
        document = json.loads(path.read_text())
        if {"env", "n_episodes", "seed"} <= set(document):
            origins, cells = document.pop("origins"), [Cell(**entry) for entry in document.pop("cells")]
            cells = [replace(cell, file=_moved(cell.file, to=Path(), within=path.parent)) for cell in cells]
            return document, origins, cells
    except (ValueError, TypeError, KeyError, AttributeError):
        pass  # no JSON, or a number; cells of another version
    raise ValueError(f"{path} is no file of over-delays: give another --json.")


def _moved(path: str, to: Path, within: Path = Path()) -> str:
    """Return a path relative to one folder as it is from another; an absolute path stays."""
    return path if os.path.isabs(path) else os.path.relpath(within / path, to)
