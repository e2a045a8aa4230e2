"""What an update frees serves the next one."""

import platform
import subprocess
import sys

import pytest

# 64 windows of 24 tokens, 256 wide: activations of 1.5 and 6 MB, beyond what glibc keeps by itself
SCRIPT = """
import resource
import torch as th
from torch import nn
from sb3_said.planner.memory import keep_freed_memory

th.set_num_threads(1)
if {keeps}:
    keep_freed_memory()
network = nn.Sequential(nn.Linear(256, 1024), nn.GELU(), nn.Linear(1024, 1024), nn.GELU(), nn.Linear(1024, 256))
x = th.randn(64, 24, 256)

def update():
    network(x).square().mean().backward()

for _ in range(10):
    update()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    update()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_an_update_asks_the_system_for_no_page_that_the_one_before_has_freed():
    faults = {}
    for keeps in (True, False):
        made = subprocess.run([sys.executable, "-c", SCRIPT.format(keeps=keeps)], capture_output=True, text=True)
        assert made.returncode == 0, made.stderr
        faults[keeps] = int(made.stdout)
    assert faults[True] * 2 < faults[False]
