"""The number format in which networks compute."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import torch as th

#: Numbers in the activations: with fewer, on a CPU, the conversion to bfloat16 costs more time than it saves
SMALL = 48 * 128


def has_bfloat16(device: th.device) -> bool:
    """Tell whether a device multiplies bfloat16 matrices in hardware; emulation would be slower than float32."""
    if device.type == "cuda":
        with th.cuda.device(device):
            return th.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        capabilities = th.cpu.get_capabilities() if hasattr(th.cpu, "get_capabilities") else {}  # not in older PyTorch
        return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16"))
    return False


def compute_dtype(precision: str, device: th.device, size: float = math.inf) -> th.dtype:
    """Return the number format of the network's matrix products.

    :param precision: ``"auto"`` (bfloat16 where :func:`has_bfloat16`, and on a CPU where it pays), ``"float32"`` or
        ``"bfloat16"``
    :param size: numbers in the activations, tokens times width
    """
    pays = has_bfloat16(device) and (device.type != "cpu" or size >= SMALL)
    return th.bfloat16 if precision == "bfloat16" or (precision == "auto" and pays) else th.float32


def autocast(precision: str, device: th.device, size: float = math.inf) -> AbstractContextManager[object]:
    """Return the context that a network runs in: autocast to :func:`compute_dtype`, or nothing for float32."""
    dtype = compute_dtype(precision, device, size)
    return nullcontext() if dtype == th.float32 else th.autocast(device.type, dtype=dtype)
