"""Ctrl-C, SIGTERM and SIGHUP as a wish, which a training grants where nothing is half done."""

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
    """Says whether the training has been asked to stop. A second wish is granted at once, as a ``KeyboardInterrupt``.

    A signal that is ignored, as SIGHUP is under ``nohup``, stays ignored.
    """

    def __init__(self) -> None:
        self.is_asked = self.is_forced = False

    def __call__(self) -> bool:
        return self.is_asked

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen to the signals inside the context; outside the main thread nobody can.

        :raises KeyboardInterrupt: where the signal has ended the environments' processes, too, as one to a whole
            process group does, before the training could stop
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
    """Let Ctrl-C wait until the end of the context, in the main thread; no other is interrupted."""
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
    """Let processes ignore Ctrl-C from their first step: a terminal sends it to all, also to those that are needed.

    They are forked from a server, and ignore what it has ignored since it began. Where there is none, as on Windows,
    Ctrl-C ends them, too.
    """
    is_main = threading.current_thread() is threading.main_thread()  # no other may set what is ignored
    if not is_main or "forkserver" not in multiprocessing.get_all_start_methods():
        return
    from multiprocessing.forkserver import ensure_running

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
