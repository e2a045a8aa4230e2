"""Cells that are played, one after another or in processes."""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import torch as th

from sb3_said.evaluation import Summary
from sb3_said.zoo.cells import Cell
from sb3_said.zoo.runs import LoadedRun, load_run
from sb3_said.zoo.stopping import holding_back_ctrl_c, shield


@contextmanager
def at_any_age() -> Iterator[None]:
    """Hide the warning that an agent was not trained at some ages: to play such ages is the purpose here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"This \w+ learned at ages .* and is given", UserWarning)
        yield


def digest_of(run: LoadedRun) -> str:
    """Return the SHA-256 of an agent's file and of all else that decides what the agent sees.

    That is what its run changes in the task besides the delay, and the statistics of ``VecNormalize``, if any.
    """
    changes = run.setting.encode() if run.changes else b""
    statistics = b"" if run.statistics is None else run.statistics.read_bytes()
    return hashlib.sha256(Path(run.info["file"]).read_bytes() + changes + statistics).hexdigest()


def play_all(cells: list[Cell], env_id: str, args: argparse.Namespace) -> Generator[tuple[Cell, Summary], None, None]:
    """Play cells, in processes if several are to be played at once. Yield each as soon as it is done.

    Whatever ends this earlier, such as Ctrl-C, ends the processes, too.
    """
    how = (env_id, args.episodes, args.seed, args.n_envs, args.device, args.gym_packages)
    if args.workers == 1:
        yield from ((cell, play(cell, *how)) for cell in cells)
        return
    # As SB3's environments in processes: plain forks would share torch's threads
    can_fork = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if can_fork else "spawn")
    if can_fork:
        context.set_forkserver_preload([__name__])  # so that workers import it once
    pool = ProcessPoolExecutor(args.workers, context, initializer=begin_worker, initargs=(args.num_threads,))
    try:
        shield()
        with holding_back_ctrl_c():  # interrupted at its start, a worker prints a traceback
            futures = {pool.submit(play, cell, *how): cell for cell in cells}
        yield from ((futures[future], future.result()) for future in as_completed(futures))
    except BrokenProcessPool as error:
        raise OSError(
            "A worker was ended, perhaps for lack of memory: give fewer --workers. What was played is kept, and the "
            "same command goes on."
        ) from error
    except (KeyboardInterrupt, GeneratorExit):
        for worker in multiprocessing.active_children():  # its cell may take minutes more
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def begin_worker(num_threads: int) -> None:
    """Prepare a process that plays cells: set its number of threads, and end it when its parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; a worker would go on with the next cell
    th.set_num_threads(num_threads)
    parent = multiprocessing.parent_process()
    assert parent is not None  # for mypy: a pool calls this

    def end_with_it() -> None:  # a parent ended by kill -9 cannot end its pool
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


def play(
    cell: Cell, env_id: str, episodes: int, seed: int, n_envs: int, device: str, gym_packages: list[str]
) -> Summary:
    """Play the episodes of a cell.

    :raises ValueError: where the agent's file is no longer what the cell says
    """
    with at_any_age():
        run = load_run(cell.file, cell.algo, env_id, cell.delay, device, gym_packages=gym_packages, answer=cell.answer)
        if digest_of(run) != cell.sha256:
            raise ValueError(f"{cell.file} has changed since this call began: give the command again.")
        return run.play(episodes, seed, n_envs, age_error=cell.age_error, answer=cell.answer).summary(cell.agent)
