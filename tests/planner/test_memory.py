"""What an update frees serves the next one."""

import ctypes
import subprocess
import sys

import pytest

MB = 2**20
ARRAYS, SIZE = 6, 40 * MB  # each beyond 32 MB, so that glibc by itself maps it alone and hands it back when it is freed

# What the process holds of the system, in use or not. Page faults would say the same, but a system may take pages away
# that nobody has touched for a while, and then they count the system's work.
SCRIPT = f"""
import ctypes
import torch as th
from sb3_said.planner.memory import keep_freed_memory

class Mallinfo(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in
                "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()]

library = ctypes.CDLL(None)
library.mallinfo2.restype = Mallinfo

def held():
    info = library.mallinfo2()
    return info.arena + info.hblkhd

if {{keeps}}:
    keep_freed_memory()
before = held()
for _ in range(2):
    arrays = [th.empty({SIZE}, dtype=th.uint8) for _ in range({ARRAYS})]
    del arrays
    print(held() - before)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="a setting of glibc")
def test_an_update_finds_the_memory_that_the_one_before_has_freed():
    held = {}
    for keeps in (True, False):
        made = subprocess.run([sys.executable, "-c", SCRIPT.format(keeps=keeps)], capture_output=True, text=True)
        assert made.returncode == 0, made.stderr
        held[keeps] = [int(line) for line in made.stdout.split()]
    first, second = held[True]
    assert first >= ARRAYS * SIZE * 0.95  # kept
    assert second - first < 2 * SIZE  # and enough for the second time, but for one array that alignment leaves no place
    assert max(held[False]) < 4 * MB  # handed back
