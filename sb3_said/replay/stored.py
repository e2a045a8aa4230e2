"""What a stored replay must be like, before a buffer takes it over."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

ROW_ARRAYS = ("observations", "actions", "rewards", "dones", "timeouts", "ages", "steps", "ends")


def check_stored(buffer: Any, state: dict[str, Any]) -> None:
    """Check what a buffer's ``state_dict`` returned against the buffer that is to take it over.

    :param buffer: a ``DelayedReplayBuffer``
    :raises ValueError: when it came from a buffer of another shape, or holds what no buffer stores
    """
    size, space, expected = len(state["rewards"]), buffer.observation_space, state["expected"]
    fits = size == buffer.buffer_size if state["full"] else size == state["pos"] < buffer.buffer_size
    fits = fits and all(state[name].shape[1:] == getattr(buffer, name).shape[1:] for name in ROW_ARRAYS)
    if expected is not None:  # the observation that would continue the replay is of this buffer's task
        boxes = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        sizes = {key: buffer.n_envs * math.prod(box.shape or ()) for key, box in boxes.items()}
        fits = fits and sizes == {key: x.size for key, x in expected.items()}
    if not fits:
        raise ValueError(
            f"A stored replay of shape {state['observations'].shape} does not fit a buffer of shape "
            f"{buffer.observations.shape}; use the buffer_size, n_envs, task and max_delay it was made with."
        )
    n_tails, (obs_dim,) = len(state["tail_places"]), buffer.observations.shape[2:]
    like = {name: ((size, *getattr(buffer, name).shape[1:]), getattr(buffer, name).dtype) for name in ROW_ARRAYS}
    like |= {"next_states": ((buffer.n_envs, obs_dim), np.float32), "next_ages": ((buffer.n_envs,), np.int16)}
    like |= {"tail_places": ((n_tails, 2), np.int64), "tail_ages": ((n_tails,), np.int16)}
    like |= {"tail_states": ((n_tails, obs_dim), np.float32)}
    for name, (shape, dtype) in like.items():
        if (state[name].shape, state[name].dtype) != (shape, dtype):
            raise ValueError(
                f"The stored {name} are {state[name].dtype} of the shape {state[name].shape}, expected {dtype} of the "
                f"shape {shape}."
            )
    for name, values in {**{name: state[name] for name in like}, **(expected or {})}.items():
        if values.dtype.kind not in "biuf" or not np.isfinite(values).all():
            raise ValueError(f"The stored {name} have entries that are no numbers, NaN or infinite.")
    ages = np.concatenate([state[name].ravel() for name in ("ages", "next_ages", "tail_ages")])
    flags = np.concatenate([state[name].ravel() for name in ("dones", "timeouts")])
    for what, is_so in {
        "pos": type(state["pos"]) is int and type(state["full"]) is bool and 0 <= state["pos"] < buffer.buffer_size,
        "tail_places": sorted(state["tail_places"].tolist()) == np.argwhere(state["ends"]).tolist(),
        "ages": np.all((ages >= 0) & (ages <= buffer.max_delay)),
        "steps": np.all(state["steps"] >= 0),
        "dones or timeouts": np.all((flags == 0) | (flags == 1)),
        "holds_logs": type(state["holds_logs"]) is bool,
    }.items():
        if not is_so:
            raise ValueError(f"The stored {what} are none that a DelayedReplayBuffer has.")
