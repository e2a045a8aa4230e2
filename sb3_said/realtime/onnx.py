"""An exported student on a computer without PyTorch."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_said.delays.observations import checked_observation
from sb3_said.delays.space import STATE_KEYS, delayed_space, within_bounds


class OnnxModel:
    """Answers by the graph in a file of ``sb3-said export``, on one thread; for a ``ControlLoop``.

    :param path: of the file
    :raises FileNotFoundError: where there is no such file
    :raises ImportError: without the package onnxruntime
    :raises ValueError: for a file that is damaged, or of another program
    """

    def __init__(self, path: str | os.PathLike[str]):
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError("onnxruntime is missing, which OnnxModel needs: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        if not os.path.isfile(path):
            raise FileNotFoundError(f"{path} does not exist.")
        try:
            self._session = onnxruntime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
            properties = self._session.get_modelmeta().custom_metadata_map
            dtype = np.dtype(properties["action_dtype"])
            low, high = (np.array(json.loads(properties[name]), dtype) for name in ("action_low", "action_high"))
            self.action_space = spaces.Box(low, high, dtype=dtype.type)
        except Exception as error:  # onnxruntime raises many kinds
            raise ValueError(f"{path} is no file of sb3-said export, or damaged ({error}): export it again.") from error
        #: Whether the student reads observations that VecNormalize has normalised.
        self.reads_normalized = properties["reads_normalized"] == "true"
        state_space = spaces.Box(-np.inf, np.inf, (self._session.get_inputs()[0].shape[1],), np.float32)
        self.observation_space: spaces.Space[Any] = state_space
        if "delay" in [each.name for each in self._session.get_inputs()]:
            self.observation_space = delayed_space(state_space, self.action_space, int(properties["max_delay"]))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Answer one observation, or a batch (B, ...), with actions (act_dim,) or (B, act_dim), in the task's units.

        :raises ValueError: as :func:`~sb3_said.delays.observations.checked_observation`, and for an answer that is
            not finite
        """
        if isinstance(observation, dict):  # a student learned without these, even if its planner reads them
            observation = {key: part for key, part in observation.items() if key not in STATE_KEYS}
        given, is_batch = checked_observation(observation, self.observation_space)
        action: np.ndarray = self._session.run(["action"], given)[0]
        if not np.isfinite(action).all():
            raise ValueError(f"The graph answers {action}, which is not finite; look at the observation: {given}.")
        action = within_bounds(action, self.action_space)
        return action if is_batch else action[0], None
