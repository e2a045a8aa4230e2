"""In which number format the network computes."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch as th

from sb3_said.planner.diffusion import check_choice

PRECISIONS = ("auto", "float32", "bfloat16")


def has_bfloat16(device: th.device) -> bool:
    """Tell whether a device multiplies bfloat16 matrices in hardware; emulation would be slower than float32."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        if not hasattr(th.cpu, "get_capabilities"):  # older PyTorch cannot tell
            return False
        capabilities = th.cpu.get_capabilities()
        return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16"))
    return False


def autocast(precision: str, device: th.device) -> AbstractContextManager[object]:
    """Return the context the network runs in: bfloat16 autocast, or nothing.

    :param precision: ``"auto"``, ``"float32"`` or ``"bfloat16"``
    """
    check_choice("precision", precision, PRECISIONS)
    if precision == "bfloat16" or (precision == "auto" and has_bfloat16(device)):
        return th.autocast(device.type, dtype=th.bfloat16)
    return nullcontext()
