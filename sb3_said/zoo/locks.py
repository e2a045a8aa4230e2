"""Locks that processes share through a folder, one for each piece of work that only one of them is to do."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock, Timeout


def work_lock(path: Path) -> FileLock:
    """Return the lock of a piece of work. The operating system frees it when the process that holds it ends.

    :param path: of its file, the same for all processes; missing folders are made, and the empty file stays
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(path)


def try_acquire(lock: FileLock) -> bool:
    """Take a lock if nobody holds it, and say whether that worked."""
    try:
        lock.acquire(blocking=False)
    except Timeout:
        return False
    return True


def is_held(lock: FileLock) -> bool:
    """Say whether another lock of this path is held, here or in another process."""
    if not try_acquire(lock):
        return True
    lock.release()
    return False
