"""The random states of Python, NumPy and torch, from which a resumed run draws."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import torch as th

from sb3_said.files.archive import SavedFileError


def random_state() -> dict[str, Any]:
    """Return the global random states of Python, NumPy and torch."""
    name, keys, *numpy_rest = np.random.get_state(legacy=True)
    state = {"python": random.getstate(), "numpy": [name, np.asarray(keys), *numpy_rest], "torch": th.get_rng_state()}
    if th.cuda.is_initialized():  # a run on the CPU takes no memory of a GPU
        state["cuda"] = th.cuda.get_rng_state_all()
    return state


def restore_random_state(state: dict[str, Any]) -> None:
    """Restore what ``random_state`` returned.

    :raises SavedFileError: for a state that no generator has; one of NumPy's would crash the process
    """
    check_random_state(state)
    (version, internal, gauss), (name, keys, *rest) = state["python"], state["numpy"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state((name, keys, *rest))
    th.set_rng_state(state["torch"])
    if "cuda" in state and th.cuda.is_available():
        th.cuda.set_rng_state_all(state["cuda"][: th.cuda.device_count()])  # the machine before may have had more GPUs


def check_random_state(state: dict[str, Any]) -> None:
    """:raises SavedFileError: for states that no generator has; the generators' own checks let some pass"""
    version, internal, gauss = state["python"]
    random.Random().setstate((version, tuple(internal), gauss))  # raises before any global generator has changed
    name, keys, position, has_gauss, cached = state["numpy"]
    if name != "MT19937" or type(position) is not int or not 0 <= position <= 624:
        raise SavedFileError(f"NumPy's random state is {name!s:.20} at position {position!s:.20}, expected 0..624")
    if not isinstance(keys, np.ndarray) or (keys.dtype, keys.shape) != (np.uint32, (624,)):
        raise SavedFileError("NumPy's random state is not of 624 numbers")
    if has_gauss not in (0, 1) or not all(x is None or _is_finite(x) for x in (gauss, cached)):
        raise SavedFileError("a random state keeps a number that is not finite for its next draw")
    probe = th.Generator()
    probe.set_state(state["torch"])
    if not th.randn(2, generator=probe, dtype=th.float64).isfinite().all():
        raise SavedFileError("torch's random state draws numbers that are not finite")


def _is_finite(x: Any) -> bool:
    return type(x) in (int, float) and math.isfinite(x)
