"""Memory of a process: what a training step frees serves the next."""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
KEPT = 2**30  # bytes: more than an update of the paper's planner frees
LARGEST = 2**26  # bytes of an array that is kept; larger ones, such as a replay, go back to the system at once


def keep_freed_memory() -> None:
    """Let glibc keep up to 1 GB that is freed, in this process and from now on.

    By default it hands the activations of an update back to the system as soon as they are freed, and the next update
    waits for the system to clear the same pages again: 7,700 of them for the preset's planner, a fifth of the time of
    its updates on one core (benchmarks/README.md). Other C libraries have no such setting, and nothing happens there.
    """
    if not sys.platform.startswith("linux"):
        return
    c_library = ctypes.CDLL(None)
    if hasattr(c_library, "mallopt"):
        c_library.mallopt(M_MMAP_THRESHOLD, LARGEST)
        c_library.mallopt(M_TRIM_THRESHOLD, KEPT)
