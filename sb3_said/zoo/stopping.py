"""Ctrl-C, SIGTERM and SIGHUP ask a training to stop. It stops where nothing is half done."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Stopping:
    """Says whether the training has been asked to stop. A second signal raises ``KeyboardInterrupt`` at once.

    A signal that is ignored, as SIGHUP is under ``nohup``, stays ignored.
    """

    def __init__(self) -> None:
        self.is_asked = self.is_forced = False

    def __call__(self) -> bool:
        return self.is_asked

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen to the signals inside the context; only the main thread can.

        :raises KeyboardInterrupt: where a signal, such as one to the whole process group, ended the environments'
            processes before the training could stop
        """
        before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            before = {number: signal.getsignal(number) for number in SIGNALS}
            before = {number: handler for number, handler in before.items() if handler is not signal.SIG_IGN}
        for number in before:
            signal.signal(number, self._ask)
        try:
            yield
        except (EOFError, ConnectionError) as error:
            if self.is_asked:
                raise KeyboardInterrupt from error
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.is_asked:
            self.is_forced = True
            raise KeyboardInterrupt
        self.is_asked = True
        print(
            f"\n{signal.Signals(number).name}: the training stops after this step and writes a checkpoint; the same "
            "again stops it at once, without one.",
            flush=True,
        )


@contextmanager
def holding_back_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C wait until the end of the context. It interrupts the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if held:
            signal.raise_signal(signal.SIGINT)


def shield() -> None:
    """Let child processes ignore Ctrl-C from their first step: a terminal sends it to all, even to those still needed.

    They are forked from a server, and ignore what the server has ignored since it began. Where there is no server, as
    on Windows, Ctrl-C ends them, too.
    """
    is_main = threading.current_thread() is threading.main_thread()  # no other thread may set signals
    if not is_main or "forkserver" not in multiprocessing.get_all_start_methods():
        return
    from multiprocessing.forkserver import ensure_running

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
