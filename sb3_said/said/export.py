"""Write a student as an ONNX graph, for computers without PyTorch."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_said.delays.space import KEYS, check_spaces, holds_whole_numbers
from sb3_said.files.atomic import replacing
from sb3_said.files.normalization import get_statistics
from sb3_said.said.said import SAID
from sb3_said.said.student import Student

OPSET, IR_VERSION = 17, 8  # of 2022, so that old runtimes read it


class Graph:
    """An ONNX graph under construction: its nodes in order, and its constants.

    :raises ImportError: without the package onnx
    """

    def __init__(self) -> None:
        try:
            import onnx
        except ImportError as error:
            raise ImportError('onnx is missing, which export needs: pip install "sb3_said[export]"') from error
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Add a constant and return its name."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Add a node of one output and return that output's name."""
        name = output or f"{kind}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def clip(self, x: str, low: Any, high: Any) -> str:
        """Add nodes that hold ``x`` between two constants."""
        return self.add("Max", self.add("Min", x, self.constant(high)), self.constant(low))

    def model(self, inputs: dict[str, list[str | int]], act_dim: int, metadata: dict[str, str]) -> Any:
        """Return what was added as a checked ``onnx.ModelProto``, whose inputs and ``action`` (B, act_dim) are float32.

        :param inputs: shape of each input by its name; a text is an axis of any length
        """
        helper = self.onnx.helper
        tensors = (
            [helper.make_tensor_value_info(key, self.onnx.TensorProto.FLOAT, shape) for key, shape in part.items()]
            for part in (inputs, {"action": ["B", act_dim]})
        )
        graph = helper.make_graph(self.nodes, "student", *tensors, self.constants)
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(made, metadata)
        self.onnx.checker.check_model(made)
        return made


def to_onnx(model: SAID, normalization: VecNormalize | None = None) -> Any:
    """Return an agent's student as an ``onnx.ModelProto`` that answers as ``predict`` does.

    Its inputs are the keys of a delayed observation, float32: ``observation`` (B, obs_dim), ``action_history``
    (B, D, act_dim) and ``delay`` (B, 1); ``observation`` alone where the agent's task has no delay. Its output is
    ``action`` (B, act_dim), in the units of the action space. The metadata have ``max_delay``, the bounds of actions,
    by which the history is scaled, and whether the caller has to normalise observations. The graph does so itself where
    the statistics of the agent's ``VecNormalize`` are known here.

    :param normalization: what normalises the agent's observations; that of its environment by default
    :raises ImportError: without the package onnx
    :raises ValueError: for an agent without a student
    """
    graph, policy, student = Graph(), model.policy, model.policy.student
    if "student" not in policy.answers:
        raise ValueError(
            "This agent has no student to export. In Python: model = SAID.load(file, env=env); model.distill(); "
            "model.save(file)."
        )
    assert student is not None  # it can answer
    state_space, space, max_delay = check_spaces(policy.observation_space, policy.action_space)
    scale = normalization or model.get_vec_normalize_env()
    statistics = get_statistics(scale).get("obs/observation")

    x = "observation"
    if scale is not None and statistics is not None:
        mean, var, _ = statistics
        z = graph.add("Sub", x, graph.constant(mean))
        z = graph.add("Div", z, graph.constant(np.sqrt(var + scale.epsilon)))
        x = graph.clip(z, -scale.clip_obs, scale.clip_obs)
    if student.reader is not None:
        x = graph.add("Concat", x, *_read_delay(graph, max_delay), axis=1)
    x = _answer(graph, student, x)
    low, high = (bound.astype(np.float32) for bound in (space.low, space.high))
    x = graph.add("Mul", graph.constant(0.5 * (high - low)), graph.add("Add", x, graph.constant(1.0)))
    x = graph.add("Add", graph.constant(low), x)
    x = graph.add("Round", x) if holds_whole_numbers(space) else x
    graph.add("Identity", graph.clip(x, low, high), output="action")

    obs_dim, act_dim = state_space.shape[0], space.shape[0]
    shapes: dict[str, list[str | int]] = {
        "observation": ["B", obs_dim],
        "action_history": ["B", max_delay, act_dim],
        "delay": ["B", 1],
    }
    inputs = {key: shapes[key] for key in (KEYS if student.reader is not None else KEYS[:1])}
    bounds = {"action_low": json.dumps(space.low.tolist()), "action_high": json.dumps(space.high.tolist())}
    bounds["action_dtype"] = str(space.dtype)
    told = {"max_delay": str(max_delay), "reads_normalized": json.dumps(model.reads_normalized and statistics is None)}
    return graph.model(inputs, act_dim, told | bounds)


def _read_delay(graph: Graph, max_delay: int) -> tuple[str, str]:
    """Add what reads history and delay: actions since the observation, else zeros, (B, D * act_dim); and delay / D."""
    steps_ago = graph.constant(np.arange(max_delay, 0, -1))  # (D,)
    since = graph.add("LessOrEqual", steps_ago, "delay")  # (B, D)
    since = graph.add("Cast", since, to=graph.onnx.TensorProto.FLOAT)
    since = graph.add("Unsqueeze", since, graph.constant([2], np.int64))
    history = graph.add("Mul", "action_history", since)
    flat = graph.add("Flatten", history, axis=1)  # a Reshape could not infer B where D is 0
    return flat, graph.add("Div", "delay", graph.constant(max(max_delay, 1)))


def _answer(graph: Graph, student: Student, x: str) -> str:
    """Add a student's network: from what it reads to actions in [-1, 1], (B, act_dim)."""
    x = graph.add("Sub", x, graph.constant(student.mean.cpu()))
    x = graph.add("Div", x, graph.constant(student.std.cpu()))
    for layer in student.network:
        if isinstance(layer, nn.Linear):
            weights = [graph.constant(part.detach().cpu()) for part in (layer.weight, layer.bias)]
            x = graph.add("Gemm", x, *weights, transB=1)
        else:
            x = graph.add({nn.ReLU: "Relu", nn.Tanh: "Tanh"}[type(layer)], x)
    return x


def export(model: SAID, path: str | os.PathLike[str], normalization: VecNormalize | None = None) -> None:
    """Write :func:`to_onnx`'s graph to a file.

    :param normalization: as of :func:`to_onnx`
    :raises ImportError: without the package onnx
    :raises ValueError: for an agent without a student
    """
    made = to_onnx(model, normalization)
    with replacing(path) as file:
        file.write(made.SerializeToString())
