"""One recorded graph of kernels instead of hundreds of launches: a training step on a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

EAGER_CALLS = 3  # before recording, as torch.cuda.graph asks: libraries set themselves up, optimizers make their state


class CapturedStep:
    """Run a step on a GPU: a few times as it is, then recorded once and replayed.

    The step must always do the same work on tensors that stay in their places, draw from ``generator`` alone and read
    no number back to the host.

    :param step: returns a tensor, which the next call overwrites
    :param generator: of the GPU; replays draw from it what the step itself would
    """

    def __init__(self, step: Callable[[], th.Tensor], generator: th.Generator) -> None:
        self.step = step
        self.generator = generator
        self.forget()

    def forget(self) -> None:
        """Record anew, because tensors that the step uses were replaced."""
        self.n_eager = 0
        self.graph: th.cuda.CUDAGraph | None = None

    def __call__(self) -> th.Tensor:
        """Do the step once."""
        if self.n_eager < EAGER_CALLS:
            self.n_eager += 1
            return self._eager()
        if self.graph is None:
            graph = th.cuda.CUDAGraph()
            graph.register_generator_state(self.generator)
            with th.cuda.graph(graph):  # recorded, not run
                self.output = self.step()
            self.graph = graph
        self.graph.replay()
        return self.output

    def _eager(self) -> th.Tensor:
        # On a stream of its own, so that gradients are not tied to the default stream, which cannot be recorded
        device = self.generator.device
        stream, current = th.cuda.Stream(device), th.cuda.current_stream(device)
        stream.wait_stream(current)
        with th.cuda.stream(stream):
            output = self.step()
        current.wait_stream(stream)
        return output
