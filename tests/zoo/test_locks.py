"""Locks of work: one holder at a time, and none outlives its process."""

import subprocess
import sys

from sb3_said.zoo.locks import is_held, try_acquire, work_lock

HOLDER = """
import sys, time
from pathlib import Path
from sb3_said.zoo.locks import try_acquire, work_lock
lock = work_lock(Path(sys.argv[1]))
print(try_acquire(lock), flush=True)
time.sleep(120)
"""


def test_a_lock_has_one_holder(tmp_path):
    first, second = (work_lock(tmp_path / "locks" / "work.lock") for _ in range(2))
    assert not is_held(first)
    assert try_acquire(first) and not try_acquire(second) and is_held(second)
    first.release()
    assert not is_held(first) and try_acquire(second)
    second.release()


def test_a_killed_process_holds_nothing(tmp_path):
    lock = work_lock(tmp_path / "work.lock")
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "work.lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == "True\n"
        assert is_held(lock) and not try_acquire(lock)
        holder.kill()
    assert not is_held(lock) and try_acquire(lock)
    lock.release()
