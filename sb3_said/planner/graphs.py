"""One recorded graph of kernels instead of hundreds of launches, on a GPU."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache

import torch as th

EAGER_CALLS = 3  # before recording, as torch.cuda.graph asks: libraries set themselves up, optimizers make their state

#: For threads: a process can record one graph at a time, and a recording has one place for its inputs.
_LOCK = threading.RLock()


@cache
def _side_stream(device: th.device) -> th.cuda.Stream:
    """Return the one stream on which functions run before they are recorded, and on which they are recorded.

    The default stream cannot be recorded, and gradients would be tied to it. All functions share one stream, because
    libraries keep memory for each that they have seen. By itself ``torch.cuda.graph`` would take one of the current
    GPU.
    """
    return th.cuda.Stream(device)


class Recording:
    """Runs one function of tensors on a GPU: a few times as it is, then recorded once and replayed.

    The function must do the same work on every call, on tensors that stay in their places, and never wait for the
    device. Without a recording a planner's update takes about a thousand launches, a decision some hundreds.

    The function is given at each call and not kept. It often belongs to the owner of the recording, and such a cycle of
    references would hold a GPU's memory until Python's garbage collector finds it.

    :param device: the GPU
    :param generator: from which the function draws, if it does; replays draw from it what the function would
    """

    def __init__(self, device: th.device, generator: th.Generator | None = None) -> None:
        self.device, self.generator = device, generator
        self.forget()

    def forget(self) -> None:
        """Record anew, because tensors that the function uses were replaced."""
        self.n_eager = 0
        self.graph: th.cuda.CUDAGraph | None = None

    def __call__(self, function: Callable[..., tuple[th.Tensor, ...]], *inputs: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return the function's outputs for inputs, which have the same shapes in all calls.

        :param function: the same in all calls; maps the inputs to a tuple of tensors
        """
        with _LOCK, th.cuda.device(self.device):
            if self.n_eager < EAGER_CALLS:
                self.n_eager += 1
                return self._eager(function, inputs)
            if self.graph is None:
                self._record(function, inputs)
            assert self.graph is not None
            for static, x in zip(self.inputs, inputs, strict=True):
                static.copy_(x)
            self.graph.replay()
            return tuple(output.clone() for output in self.outputs)

    def _record(self, function: Callable[..., tuple[th.Tensor, ...]], inputs: tuple[th.Tensor, ...]) -> None:
        self.inputs = [x.clone() for x in inputs]
        graph = th.cuda.CUDAGraph()
        if self.generator is not None:
            graph.register_generator_state(self.generator)
        # The function is recorded here and not run. "thread_local" lets other threads go on with the GPU meanwhile
        with th.cuda.graph(graph, stream=_side_stream(self.device), capture_error_mode="thread_local"):
            self.outputs = function(*self.inputs)
        self.graph = graph

    def _eager(
        self, function: Callable[..., tuple[th.Tensor, ...]], inputs: tuple[th.Tensor, ...]
    ) -> tuple[th.Tensor, ...]:
        stream, current = _side_stream(self.device), th.cuda.current_stream(self.device)
        stream.wait_stream(current)
        with th.cuda.stream(stream):
            outputs = function(*inputs)
        current.wait_stream(stream)
        return outputs
