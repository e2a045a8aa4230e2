"""One recorded graph of kernels instead of hundreds of launches, on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

EAGER_CALLS = 3  # before recording, as torch.cuda.graph asks: libraries set themselves up, optimizers make their state


class RecordedFunction:
    """Run a function of tensors on a GPU: a few times as it is, then recorded once and replayed.

    The function must do the same work on every call, on tensors that stay in their places, and never wait for the
    device. A planner's update is about a thousand launches without this, a decision some hundreds.

    :param function: maps the inputs to a tuple of tensors
    :param device: the GPU
    :param generator: that the function draws from, if any; replays draw from it what the function itself would
    """

    def __init__(
        self,
        function: Callable[..., tuple[th.Tensor, ...]],
        device: th.device,
        generator: th.Generator | None = None,
    ) -> None:
        self.function, self.device, self.generator = function, device, generator
        self.forget()

    def forget(self) -> None:
        """Record anew, because tensors that the function uses were replaced."""
        self.n_eager = 0
        self.graph: th.cuda.CUDAGraph | None = None

    def __call__(self, *inputs: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return the function of inputs, which have the same shapes in all calls."""
        if self.n_eager < EAGER_CALLS:
            self.n_eager += 1
            return self._eager(inputs)
        if self.graph is None:
            self.inputs = [x.clone() for x in inputs]
            graph = th.cuda.CUDAGraph()
            if self.generator is not None:
                graph.register_generator_state(self.generator)
            with th.cuda.graph(graph):  # recorded, not run
                self.outputs = self.function(*self.inputs)
            self.graph = graph
        for static, x in zip(self.inputs, inputs, strict=True):
            static.copy_(x)
        self.graph.replay()
        return tuple(output.clone() for output in self.outputs)

    def _eager(self, inputs: tuple[th.Tensor, ...]) -> tuple[th.Tensor, ...]:
        # On a stream of its own, so that gradients are not tied to the default stream, which cannot be recorded
        stream, current = th.cuda.Stream(self.device), th.cuda.current_stream(self.device)
        stream.wait_stream(current)
        with th.cuda.stream(stream):
            outputs = self.function(*inputs)
        current.wait_stream(stream)
        return outputs
