"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

PathOrFile = str | os.PathLike[str] | IO[bytes]

ABANDONED_AFTER = 600.0  # seconds since a write's last byte; no running write is that slow


@contextlib.contextmanager
def replacing(target: PathOrFile) -> Iterator[IO[bytes]]:
    """Write beside the target and swap at the end: a crash leaves the old file, never half a file.

    A write removes what killed ones left beside its target, once it is ``ABANDONED_AFTER`` old. Several processes may
    write one target at a time: the last to finish wins.

    :param target: where to write; missing folders are made. A device or a pipe is written to and stays, and a binary
        file object is given back as it is.
    :raises ValueError: if the target is a folder
    """
    if not isinstance(target, (str, os.PathLike)):
        yield target
        return
    if os.path.isdir(target):
        raise ValueError(f"Cannot write to {os.fspath(target)}: it is a folder. Give the path of a file.")
    if os.path.exists(target) and not os.path.isfile(target):
        with open(target, "wb") as file:
            yield file
        return
    path = Path(os.path.realpath(target))  # a symbolic link stays, and what it points to is replaced
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(scratch, "xb") as file:
            now = scratch.stat().st_mtime  # by the file system's clock, as the others' times
            for left in path.parent.glob(glob.escape(f".{path.name}.") + "[0-9a-f]" * 8 + ".tmp"):
                with contextlib.suppress(OSError):  # one that cannot be removed does no harm
                    if now - left.stat().st_mtime > ABANDONED_AFTER:
                        left.unlink()
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


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
