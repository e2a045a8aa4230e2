"""A tenth of the hostile files; how to load all of them is said in ``tests/support/hostile_run.py``."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="limits its memory as Linux does")
def test_hostile_files_are_refused_or_harmless():
    support = Path(__file__).parents[1] / "support"
    paths = os.pathsep.join([str(support), str(support.parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, str(support / "hostile_run.py"), "10"],
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout[done.stdout.index("{") :])
    assert found["failures"] == []
    outcomes = found["outcomes"]
    assert sum(outcomes.values()) == 200
    # Neither everything refused nor everything let through: the generator reaches what it is for
    assert outcomes["sealed: refused"] > 60 and outcomes["damaged: refused"] > 30 and outcomes["sealed: the same"] > 5
