"""Processes of their own that are forked from one that has made the imports, so that each begins at once."""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

from small_planner import with_small_first_guesses


def begin(output: Path, function: Callable[..., object], *arguments: object) -> BaseProcess:
    """Call a module's function in a process, which has a group of its own and writes what it prints into a file."""
    process = multiprocessing.get_context("forkserver").Process(target=_call, args=(output, function, *arguments))
    process.start()
    return process


def run_script(file: Path, words: list[str]) -> None:
    """Run a script as Python's command line does."""
    sys.argv = [str(file), *words]
    runpy.run_path(str(file), run_name="__main__")


def _call(output: Path, function: Callable[..., object], *arguments: object) -> None:
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a background job of a shell ignores
    with output.open("wb") as file:
        for standard in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), standard.fileno())
    with with_small_first_guesses():  # as in the process that asks for it
        function(*arguments)
