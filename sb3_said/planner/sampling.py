"""What a network's sampling needs beside the noise, made once and kept while the weights stay as they are."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_said.planner.diffusion import SolverStep
from sb3_said.planner.dit import DiT1d

MAX_GRAPHS = 8  # of a GPU; each keeps the memory of one decision


class Prepared(NamedTuple):
    """A network made ready for the steps of a solver."""

    network: DiT1d  # its blocks and output in the number format of sampling
    modulations: th.Tensor  # (n_steps, 6 * depth + 2, d_model) float32, of every step: they depend on time alone


class SamplingCache:
    """Keeps what was prepared for the last weights and schedule, and the CUDA graphs made with it.

    Weights that were written to, moved or replaced are noticed by their version and address. PyTorch's fused optimizers
    write without counting a version, so nothing is kept of weights that require a gradient; whoever writes to frozen
    weights through ``tensor.data`` must not expect to be noticed. Copies and pickles of a cache are empty.
    """

    def __init__(self) -> None:
        self._made_for: Hashable = None
        self._sources: list[tuple[th.Tensor, float]] = []  # held, so that no other tensor can take their address
        self._prepared: Prepared | None = None
        self._graphs: dict[Hashable, Graph] = {}

    def __reduce__(self) -> tuple[type[SamplingCache], tuple[()]]:
        return SamplingCache, ()

    def prepare(self, planner: nn.Module, network: DiT1d, steps: Sequence[SolverStep], dtype: th.dtype) -> Prepared:
        """Return the network ready for these steps.

        :param planner: holds the network and all else whose change must be noticed
        :param steps: from :func:`~sb3_said.planner.diffusion.solver_steps`
        :param dtype: number format of the blocks' products; time, residual stream and solver stay in float32
        """
        made_for, tensors = (tuple(steps), dtype), [*planner.parameters(), *planner.buffers()]
        if self._prepared is not None and made_for == self._made_for and self._holds(tensors):
            return self._prepared
        self._prepared = None
        self._graphs.clear()
        times = th.tensor([step.t for step in steps], device=network.frequencies.device)
        ready = network if dtype == th.float32 else _with_blocks_in(network, dtype)
        prepared = Prepared(ready, network.modulations(times))
        if is_frozen(planner):
            self._prepared, self._made_for = prepared, made_for
            self._sources = [(tensor.detach(), _version(tensor)) for tensor in tensors]
        return prepared

    def graph(
        self, key: Hashable, function: Callable[..., tuple[th.Tensor, ...]], inputs: Sequence[th.Tensor]
    ) -> Graph:
        """Return a function's graph, to be called with inputs of these shapes.

        :param key: what else than the inputs' values and the weights the graph depends on
        """
        if key not in self._graphs:
            if len(self._graphs) == MAX_GRAPHS:
                del self._graphs[next(iter(self._graphs))]  # the oldest
            self._graphs[key] = Graph(function, inputs)
        return self._graphs[key]

    def _holds(self, tensors: list[th.Tensor]) -> bool:
        return len(tensors) == len(self._sources) and all(
            not tensor.requires_grad and tensor.data_ptr() == source.data_ptr() and _version(tensor) == version
            for tensor, (source, version) in zip(tensors, self._sources, strict=True)
        )


class Graph:
    """A function of tensors recorded as one CUDA graph: a replay starts hundreds of kernels at the price of one.

    :param function: launches the same kernels on every call and never waits for the device
    :param inputs: its arguments, of the shapes of all later calls
    """

    def __init__(self, function: Callable[..., tuple[th.Tensor, ...]], inputs: Sequence[th.Tensor]) -> None:
        self._inputs = [x.clone() for x in inputs]
        stream = th.cuda.Stream()
        stream.wait_stream(th.cuda.current_stream())
        with th.cuda.stream(stream):
            for _ in range(3):  # libraries allocate and choose kernels in their first calls, which no graph may record
                function(*self._inputs)
        th.cuda.current_stream().wait_stream(stream)
        self._graph = th.cuda.CUDAGraph()
        with th.cuda.graph(self._graph):
            self._outputs = function(*self._inputs)

    def __call__(self, *inputs: th.Tensor) -> tuple[th.Tensor, ...]:
        for static, x in zip(self._inputs, inputs, strict=True):
            static.copy_(x)
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)


def is_frozen(module: nn.Module) -> bool:
    """Tell whether no weight of a module requires a gradient."""
    return not any(parameter.requires_grad for parameter in module.parameters())


def addresses(module: Any) -> tuple[int, ...]:
    """Return where a module's tensors are: a graph that reads them is of no use once they have moved."""
    return tuple(tensor.data_ptr() for tensor in (*module.parameters(), *module.buffers()))


def _with_blocks_in(network: DiT1d, dtype: th.dtype) -> DiT1d:
    network = copy.deepcopy(network).requires_grad_(False)
    network.blocks.to(dtype)
    network.out.to(dtype)
    return network


def _version(tensor: th.Tensor) -> float:
    """Return how often a tensor was written to; NaN, which equals nothing, where PyTorch does not count."""
    return math.nan if tensor.is_inference() else tensor._version
