"""make train plays the run that it trained, whatever else is trained meanwhile; make demo draws a shipped agent."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).resolve().parents[2] / "Makefile"

# Stands in for Python: "trains" while another run appears that is newer, and says what it was called with.
PYTHON = """#!/bin/sh
echo "$@" >> calls
case "$*" in *train.py*)
  mkdir -p logs/said/Task_1 logs/said/Task_2
  touch -t 202001010000 logs/said/Task_1
  echo "Log path: logs/said/Task_1"
  test ! -e broken && echo "Saving to logs/said/Task_1"
esac
"""


def make(folder: Path, target: str = "train") -> subprocess.CompletedProcess[str]:
    python = folder / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    command = ["make", "-f", str(MAKEFILE), "-o", "install", target, f"PY={python}", "PYTHON=none", "EPISODES=3"]
    environ = {name: value for name, value in os.environ.items() if "MAKE" not in name}  # not those of `make test`
    return subprocess.run(command, cwd=folder, env=environ, capture_output=True, text=True, timeout=60)


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_train_evaluates_its_own_run(tmp_path: Path) -> None:
    done = make(tmp_path)
    assert done.returncode == 0, done.stderr
    train, evaluate = (tmp_path / "calls").read_text().splitlines()
    assert "scripts/train.py --algo said" in train
    run = "logs/said/Task_1"
    assert evaluate == f"scripts/evaluate.py {run} --episodes 3 --num-threads 1 --plot {run}/evaluation.png"
    assert f"Saving to {run}" in done.stdout  # a long training is watched


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_train_ends_with_a_training_that_failed(tmp_path: Path) -> None:
    (tmp_path / "broken").touch()
    assert make(tmp_path).returncode != 0
    assert "evaluate.py" not in (tmp_path / "calls").read_text()


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_demo_draws_an_agent_that_is_there(tmp_path: Path) -> None:
    done = make(tmp_path, "demo")
    assert done.returncode == 0, done.stderr
    (call,) = (tmp_path / "calls").read_text().splitlines()
    words = call.split()
    assert words[0] == "scripts/enjoy.py" and (MAKEFILE.parent / words[1]).is_file()
    assert "--beside-ignorant" in words and words[-2:] == ["--record", "demo.gif"]
