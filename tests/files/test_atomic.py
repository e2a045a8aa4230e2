"""Files that are there whole or not at all, whatever happens to who writes them."""

import io
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from sb3_said.files import atomic as files
from sb3_said.files.atomic import replacing, write_json, write_text


def test_texts_and_documents_in_folders_that_are_made(tmp_path):
    path = tmp_path / "new" / "folder" / "file"
    write_text(path, "für\nalle\n")
    assert path.read_bytes() == "für\nalle\n".encode()
    document = {"results": [1.5, None, "für"]}
    write_json(path, document)
    assert json.loads(path.read_text()) == document and path.read_text().endswith("\n}\n")
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"mean": float("nan")})
    assert json.loads(path.read_text()) == document and list(path.parent.iterdir()) == [path]


def test_a_file_object_is_written_as_it_is():
    target = io.BytesIO()
    with replacing(target) as file:
        file.write(b"text")
    assert file is target and target.getvalue() == b"text"


def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)) as reader:
        write_text(pipe, "text")
        assert reader.read() == "text"
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "text"
    write_text(path, "old")
    with pytest.raises(OSError, match="disk full"), replacing(path) as file:
        file.write(b"half of the n")
        raise OSError("disk full")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_two_processes_may_write_one_file_at_a_time(tmp_path):
    path = tmp_path / "text"
    with replacing(path) as file:
        write_text(path, "the other's")
        assert path.read_text() == "the other's"
        file.write(b"the last to finish")
    assert path.read_text() == "the last to finish" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_write_left_is_removed_by_a_later_one(tmp_path):
    path = tmp_path / "run[1].zip"
    script = (
        "import os, signal, sys\n"
        "from sb3_said.files.atomic import replacing\n"
        "with replacing(sys.argv[1]):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = pathlib.Path(files.__file__).parents[2]  # importable from there, installed or not
    killed = subprocess.run([sys.executable, "-c", script, str(path)], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".run[1].zip.") and left.suffix == ".tmp"
    others = {tmp_path / name for name in (".run[1].zip.mine.tmp", ".run1.zip.0123abcd.tmp", ".run[1].zip.0123abcd")}
    for stale in (left, *others):
        stale.touch()
        os.utime(stale, (0, time.time() - files.ABANDONED_AFTER - 10))
    write_text(tmp_path / "run[2].zip", "2")
    assert left.exists()  # of another file, which another process may be writing
    write_text(path, "3")
    assert set(tmp_path.iterdir()) == others | {path, tmp_path / "run[2].zip"} and path.read_text() == "3"


def test_a_symbolic_link_keeps_pointing(tmp_path):
    write_text(tmp_path / "real", "1")
    (tmp_path / "link").symlink_to("real")
    write_text(tmp_path / "link", "2")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "2"
    with pytest.raises(ValueError, match="folder"):
        write_text(tmp_path, "1")
