"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows, which removes no open file
    fcntl = None  # type: ignore[assignment]

PathOrFile = str | os.PathLike[str] | IO[bytes]


@contextlib.contextmanager
def replacing(target: PathOrFile) -> Iterator[IO[bytes]]:
    """Write beside the target and swap at the end: a crash leaves the old file, never half a file.

    Several processes may write one target at a time: each writes a file of its own, and the last to finish wins. A
    write removes what killed ones left beside its target, and nothing that is still being written.

    :param target: where to write; missing folders are made. A device or a pipe is written to and stays, and a binary
        file object is given back as it is.
    :raises ValueError: if the target is a folder
    :raises OSError: naming the target, such as for a full disk
    """
    if not isinstance(target, (str, os.PathLike)):
        yield target
        return
    _refuse_folder(target)
    if os.path.exists(target) and not os.path.isfile(target):
        with open(target, "wb") as file:
            yield file
        return
    path = Path(os.path.realpath(target))  # a symbolic link stays, and what it points to is replaced
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent, path.name)
        scratch = _scratch_of(path)
        try:
            with scratch:
                yield scratch
                scratch.flush()
                if path.exists():
                    os.chmod(scratch.name, path.stat().st_mode)  # a file that others must not read stays so
                os.fsync(scratch.fileno())
                if fcntl is not None:  # while the lock is held: no other write takes it for abandoned
                    os.replace(scratch.name, path)
            if fcntl is None:  # Windows moves no open file
                os.replace(scratch.name, path)
        except BaseException:
            Path(scratch.name).unlink(missing_ok=True)
            raise
    except OSError as error:
        error.filename = error.filename or str(path)  # the error of a full disk has none
        raise


def check_writable(target: str | os.PathLike[str]) -> None:
    """Refuse a target that :func:`replacing` cannot write, before the work whose result it is to hold.

    :param target: where to write; missing folders are made
    :raises ValueError: if it is a folder
    :raises OSError: where its folder cannot be written
    """
    _refuse_folder(target)
    if os.path.isfile(target) or not os.path.exists(target):
        folder = Path(target).parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=folder):
                pass
        except OSError as error:
            error.filename = os.fspath(target)  # not that of the temporary file
            raise


def _refuse_folder(target: str | os.PathLike[str]) -> None:
    if os.path.isdir(target):
        raise ValueError(f"Cannot write to {os.fspath(target)}: it is a folder. Give the path of a file.")


def remove_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove what killed writes left in a folder.

    :param name: of the target that they were to replace; all by default
    """
    for left in folder.glob(f".{'*' if name is None else glob.escape(name)}." + "[0-9a-f]" * 8 + ".tmp"):
        # A file that cannot be removed does no harm. One that is being written is locked; Windows removes no open file.
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            if fcntl is not None:
                fcntl.flock(stack.enter_context(open(left, "r+b")), fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()


def _scratch_of(path: Path) -> IO[bytes]:
    """Open a new file beside a path, locked for as long as this process writes it."""
    while True:
        file = open(path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp"), "xb")
        if fcntl is None:
            return file
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file.fileno()).st_nlink > 0:  # else another write took it for abandoned before it was locked
            return file
        file.close()


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, as :func:`replacing` writes."""
    with replacing(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: Path, document: Any, default: Callable[[Any], Any] | None = None) -> None:
    """Write a JSON document, indented for its readers, as :func:`replacing` writes.

    :param default: turns an object that JSON lacks into one that it has
    :raises ValueError: if it holds NaN or an infinite number, which JSON lacks
    """
    write_text(path, json.dumps(document, indent=2, allow_nan=False, default=default) + "\n")
