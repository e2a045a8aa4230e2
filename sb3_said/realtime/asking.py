"""How a loop asks a model: with the observation that the wrapper would give, for as long a plan as it makes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_said.delays.space import has_state_history, within_bounds
from sb3_said.realtime.ledger import Request


@dataclass(frozen=True)
class Asking:
    """Asks a model; fields without a docstring are as in :class:`~sb3_said.realtime.ControlLoop`."""

    model: Any
    max_delay: int
    """D, the largest age that the model was built for"""
    deterministic: bool
    normalize: Callable[[Any], Any] | None

    def answer(self, request: Request) -> tuple[np.ndarray, float]:
        """Return the actions from the request's target on, (K, act_dim), and the seconds that the model took.

        Actions are in the units of the action space, clipped to its bounds. K is 1 for a model without
        ``predict_plan``.

        :raises ValueError: for an answer that is not finite, or of another shape
        """
        began = time.perf_counter()
        observation: Any = request.observation[None]
        if isinstance(self.model.observation_space, spaces.Dict):
            observation = {
                "observation": observation,
                "action_history": request.history[None],
                "delay": np.array([[request.age]], np.float32),
            }
            if has_state_history(self.model.observation_space):  # no younger state is known, and no older one is read
                shape = (1, self.max_delay)
                observation["state_history"] = np.zeros((*shape, *request.observation.shape), np.float32)
                observation["state_known"] = np.zeros(shape, np.float32)
        observation = observation if self.normalize is None else self.normalize(observation)
        actions, space = plan_of(self.model, observation, self.deterministic)[0], self.model.action_space
        seconds = time.perf_counter() - began
        if actions.ndim != 2 or actions.shape[1:] != space.shape or len(actions) == 0 or not np.isfinite(actions).all():
            raise ValueError(
                f"It answers {actions} of the shape {actions.shape}, expected (K, {space.shape[0]}) and finite."
            )
        return within_bounds(actions, space), seconds

    def warm_up(self) -> float:
        """Let the model answer dummy requests until it is warm, and return the seconds of a warm answer."""
        space = self.model.observation_space
        state_shape = (space["observation"] if isinstance(space, spaces.Dict) else space).shape or ()
        history = np.zeros((self.max_delay, *self.model.action_space.shape), np.float32)
        dummy = Request(-1, 0, 0, 0, np.zeros(state_shape, np.float32), history, self.max_delay)
        if hasattr(self.model, "warmup"):
            self.model.warmup()
        self.answer(dummy)  # a ModelProcess has a warmup() even if its model has none
        return self.answer(dummy)[1]


def plan_of(model: Any, observation: Any, deterministic: bool) -> np.ndarray:
    """Return a plan for each observation of a batch: (B, K, act_dim). K is 1 for a model that does not plan.

    :raises ValueError: for a model with a memory, whose answers depend on earlier ones, and for an answer that is not
        of a batch
    """
    if hasattr(model, "predict_plan"):
        return np.asarray(model.predict_plan(observation, deterministic=deterministic))
    action, memory = model.predict(observation, deterministic=deterministic)
    if memory is not None:
        raise ValueError(
            f"{type(model).__name__} answers with a memory, of type {type(memory).__name__}, which is not kept between "
            "answers that may come late or never: give a model without one, such as one that reads the actions sent."
        )
    action = np.asarray(action)
    if action.ndim != 2:
        raise ValueError(
            f"{type(model).__name__} answers {action} of the shape {action.shape}, expected (B, act_dim) for a batch."
        )
    return action[:, None]
