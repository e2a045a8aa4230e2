"""Write a student as an ONNX graph, for computers without PyTorch."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_said.delays.space import KEYS, check_spaces, holds_whole_numbers
from sb3_said.files.atomic import replacing
from sb3_said.files.normalization import get_statistics
from sb3_said.said.said import SAID

OPSET, IR_VERSION = 17, 8  # of 2022, so that old runtimes read it


def to_onnx(model: SAID, normalization: VecNormalize | None = None) -> Any:
    """Return an agent's student as an ``onnx.ModelProto`` that answers as ``predict`` does.

    Its inputs are the keys of a delayed observation, float32: ``observation`` (B, obs_dim), ``action_history``
    (B, D, act_dim) and ``delay`` (B, 1); ``observation`` alone where the agent's task has no delay. Its output is
    ``action`` (B, act_dim), in the units of the action space. The metadata have ``max_delay``, the bounds of actions,
    which the history is scaled by, and whether observations are to be normalised before: an agent of ``VecNormalize``
    has its scale in the graph, where that is known here.

    :param normalization: what the agent's observations are normalised by; its environment's by default
    :raises ImportError: without the package onnx
    :raises ValueError: for an agent without a student
    """
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise ImportError('onnx is missing, which export needs: pip install "sb3_said[export]"') from error
    policy, student = model.policy, model.policy.student
    if "student" not in policy.answers:
        raise ValueError(
            "This agent has no student to export. In Python: model = SAID.load(file, env=env); model.distill(); "
            "model.save(file)."
        )
    assert student is not None  # who answers is there
    state_space, space, max_delay = check_spaces(policy.observation_space, policy.action_space)
    obs_dim, act_dim = state_space.shape[0], space.shape[0]
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(value: Any, dtype: Any = np.float32) -> str:
        name = f"constant_{len(constants)}"
        constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(kind: str, inputs: Sequence[str], **attributes: Any) -> str:
        name = f"{kind}_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    read, scale = "observation", normalization or model.get_vec_normalize_env()
    seen = get_statistics(scale).get("obs/observation")
    if scale is not None and seen is not None:
        mean, var, _ = seen
        read = add("Div", [add("Sub", [read, constant(mean)]), constant(np.sqrt(var + scale.epsilon))])
        read = add("Max", [add("Min", [read, constant(scale.clip_obs)]), constant(-scale.clip_obs)])
    if student.reader is not None:
        steps_ago = constant(np.arange(max_delay, 0, -1))  # (D,)
        since = add("Cast", [add("LessOrEqual", [steps_ago, "delay"])], to=TensorProto.FLOAT)  # (B, D)
        history = add("Mul", ["action_history", add("Unsqueeze", [since, constant([2], np.int64)])])
        flat = add("Flatten", [history], axis=1)  # also where D is 0, of which a Reshape could not tell B
        age = add("Div", ["delay", constant(max(max_delay, 1))])
        read = add("Concat", [read, flat, age], axis=1)
    x = add("Div", [add("Sub", [read, constant(student.mean.cpu())]), constant(student.std.cpu())])
    for layer in student.network:
        if isinstance(layer, nn.Linear):
            weights = [constant(part.detach().cpu()) for part in (layer.weight, layer.bias)]
            x = add("Gemm", [x, *weights], transB=1)
        else:
            x = add({nn.ReLU: "Relu", nn.Tanh: "Tanh"}[type(layer)], [x])
    low, high = (bound.astype(np.float32) for bound in (space.low, space.high))
    x = add("Add", [constant(low), add("Mul", [constant(0.5 * (high - low)), add("Add", [x, constant(1.0)])])])
    x = add("Round", [x]) if holds_whole_numbers(space) else x
    x = add("Max", [add("Min", [x, constant(high)]), constant(low)])
    nodes.append(helper.make_node("Identity", [x], ["action"]))

    shapes: dict[str, list[str | int | None]] = {
        "observation": ["B", obs_dim],
        "action_history": ["B", max_delay, act_dim],
        "delay": ["B", 1],
    }
    given = KEYS if student.reader is not None else KEYS[:1]
    inputs = [helper.make_tensor_value_info(key, TensorProto.FLOAT, shapes[key]) for key in given]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["B", act_dim])]
    graph = helper.make_graph(nodes, "student", inputs, outputs, constants)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    bounds = {"action_low": json.dumps(space.low.tolist()), "action_high": json.dumps(space.high.tolist())}
    bounds["action_dtype"] = str(space.dtype)
    told = {"max_delay": str(max_delay), "reads_normalized": json.dumps(model.reads_normalized and seen is None)}
    helper.set_model_props(made, told | bounds)
    onnx.checker.check_model(made)
    return made


def export(model: SAID, path: str | os.PathLike[str], normalization: VecNormalize | None = None) -> None:
    """Write :func:`to_onnx`'s graph to a file.

    :param normalization: as there
    :raises ImportError: without the package onnx
    :raises ValueError: for an agent without a student
    """
    made = to_onnx(model, normalization)
    with replacing(path) as file:
        file.write(made.SerializeToString())
