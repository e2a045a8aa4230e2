"""A model in a process of its own, so that what it computes in Python never makes a control loop wait."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np

from sb3_said.realtime.asking import plan_of


class ModelProcess:
    """Loads a model in another process and answers as it does, for a :class:`~sb3_said.realtime.ControlLoop`.

    The process imports the calling script once more, so the script must do its work below
    ``if __name__ == "__main__":``. Threads that ask at the same time are answered one by one. A call that is
    interrupted, as by Ctrl-C, ends the process.

    :param load: makes the model; a function that another process can import, such as
        ``functools.partial(SAID.load, "agent.zip", device="cpu")``
    :raises ValueError: for what is no function, or cannot be handed to another process, such as a lambda
    :raises RuntimeError: where the model cannot be loaded; the message holds the reason

    >>> if __name__ == "__main__":  # doctest: +SKIP
    ...     with ModelProcess(partial(SAID.load, "agent.zip")) as model, ControlLoop(model, 0.02) as loop:
    ...         ...
    """

    def __init__(self, load: Callable[[], Any]):
        try:
            ForkingPickler.dumps(load)
            reason = None if callable(load) else "it is no function"
        except Exception as error:  # pickle raises many kinds
            reason = str(error)
        if reason is not None:
            raise ValueError(
                f"{load!r} cannot load a model in another process ({reason}): give "
                'functools.partial(SAID.load, "agent.zip", device="cpu"), or a function at the top of a module.'
            )
        context = multiprocessing.get_context("spawn")  # a fork would copy locks that other threads hold
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(load, theirs), name="ModelProcess", daemon=True)
        self._process.start()
        theirs.close()
        self._lock = threading.Lock()  # no other question may come between a question and its answer
        self.observation_space, self.action_space, self.reads_normalized = self._receive(
            ' It ended as it began: does the script make its ModelProcess below `if __name__ == "__main__":`?'
        )

    def __enter__(self) -> ModelProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def warmup(self) -> None:
        """Warm the model up, if it has a ``warmup``."""
        self._call("warmup")

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """Answer a batch (B, ...) with actions (B, act_dim), as Stable-Baselines3 does for models without a memory."""
        return self.predict_plan(observation, deterministic)[:, 0], None

    def predict_plan(self, observation: Any, deterministic: bool = False) -> np.ndarray:
        """Answer a batch (B, ...) with plans (B, K, act_dim); K is 1 for a model that does not plan."""
        plan: np.ndarray = self._call("plan", observation, deterministic)
        return plan

    def close(self) -> None:
        """End the process. Close the loop first, since it may be waiting for an answer."""
        self._pipe.close()
        self._process.join(5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _call(self, *question: Any) -> Any:
        with self._lock:
            try:
                self._pipe.send(question)
            except OSError as error:
                raise RuntimeError("The model's process has ended; make another one.") from error
            except BaseException:
                self._pipe.close()  # else the next question would get the answer to this one
                raise
            return self._receive()

    def _receive(self, hint: str = "") -> Any:
        try:
            answer, failure = self._pipe.recv()
        except BaseException as error:
            self._pipe.close()  # else the next question would get what is left of this answer
            if not isinstance(error, (EOFError, ConnectionError)):
                raise
            self._process.join(5)
            raise RuntimeError(
                f"The model's process has ended with exit code {self._process.exitcode}.{hint}"
            ) from error
        if failure is not None:
            raise RuntimeError(f"In the model's process: {failure}")
        return answer


def _serve(load: Callable[[], Any], pipe: Connection) -> None:
    """Answer until the other end is closed. Ctrl-C is ignored here, since the loop may still want an answer."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        model = load()
        told = model.observation_space, model.action_space, getattr(model, "reads_normalized", False)
        pipe.send((told, None))
    except Exception as error:  # the other end raises it
        pipe.send((None, f"{type(error).__name__}: {error}"))
        return
    with suppress(EOFError, OSError):
        while True:
            kind, *arguments = pipe.recv()
            answer, failure = None, None
            try:
                if kind == "plan":
                    answer = plan_of(model, *arguments)
                elif hasattr(model, "warmup"):
                    model.warmup()
            except Exception as error:
                failure = f"{type(error).__name__}: {error}"
            pipe.send((answer, failure))
