"""A tenth of the hostile files; how to load all of them is said in ``tests/support/hostile_run.py``."""

import json
import sys
from pathlib import Path

import pytest
from forked import begin, run_script


@pytest.mark.skipif(sys.platform != "linux", reason="limits its memory as Linux does")
def test_hostile_files_are_refused_or_harmless(tmp_path):
    run = Path(__file__).parents[1] / "support" / "hostile_run.py"
    process = begin(tmp_path / "output.txt", run_script, run, ["10"])
    process.join()
    shown = (tmp_path / "output.txt").read_text()
    assert process.exitcode == 0, shown[-2000:]
    found = json.loads(shown[shown.index("{") :])
    assert found["failures"] == []
    outcomes = found["outcomes"]
    assert sum(outcomes.values()) == 200
    # Neither everything refused nor everything let through: the generator reaches what it is for
    assert outcomes["sealed: refused"] > 60 and outcomes["damaged: refused"] > 30 and outcomes["sealed: the same"] > 5
