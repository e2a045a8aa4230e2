"""Files that are there whole or not at all, whatever happens to who writes them."""

import errno
import io
import json
import multiprocessing
import os
import pathlib
import signal
import stat
import subprocess
import sys

import numpy as np
import pytest
from forked import begin

from sb3_said.files import atomic as files
from sb3_said.files.archive import load_tree, save_tree
from sb3_said.files.atomic import check_writable, remove_abandoned, replacing, write_json, write_text


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


@pytest.mark.parametrize("name", ["file/below", "file/below/that"])
def test_what_cannot_be_written_is_named_before(name, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=f"'{tmp_path}/{name}'"):
        check_writable(tmp_path / name)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "text"
    write_text(path, "old")
    with pytest.raises(OSError, match=r"No space left on device: '.*text'"), replacing(path) as file:
        file.write(b"half of the n")
        raise OSError(errno.ENOSPC, "No space left on device")  # as of the operating system: it names no file
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def write_and_read(path, letter, together):
    """Write 1 MB of a letter to a file that others write too, over and over, and read it."""
    together.wait(60)
    for _ in range(20):
        save_tree(path, np.full(1_000_000, letter, np.uint8))
        read = load_tree(path)
        assert (read == read[0]).all()


def test_several_processes_may_write_one_file_and_a_reader_sees_it_whole(tmp_path):
    path, together = tmp_path / "files" / "tree", multiprocessing.get_context("forkserver").Barrier(3)
    writers = [begin(tmp_path / f"{letter}.txt", write_and_read, path, letter, together) for letter in b"abc"]
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    assert list(path.parent.iterdir()) == [path]


def test_the_last_to_finish_wins_however_long_it_took(tmp_path):
    path = tmp_path / "text"
    with replacing(path) as file:
        os.utime(file.name, (0, 0))
        write_text(path, "the other's")
        assert path.read_text() == "the other's"
        file.write(b"the last to finish")
    assert path.read_text() == "the last to finish" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_write_left_is_removed_by_the_next_one(tmp_path):
    path = tmp_path / "run[1].zip"
    code = (
        "import os, signal, sys\n"
        "from sb3_said.files.atomic import replacing\n"
        "with replacing(sys.argv[1]):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = pathlib.Path(files.__file__).parents[2]  # importable from there, installed or not
    killed = subprocess.run([sys.executable, "-c", code, str(path)], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".run[1].zip.") and left.suffix == ".tmp"
    others = {tmp_path / name for name in (".run[1].zip.mine.tmp", ".run1.zip.0123abcd.tmp", ".run[1].zip.0123abcd")}
    for other in others:
        other.touch()
    write_text(tmp_path / "run[2].zip", "2")
    assert left.exists()  # of another file
    write_text(path, "3")
    assert set(tmp_path.iterdir()) == others | {path, tmp_path / "run[2].zip"} and path.read_text() == "3"


def test_a_folder_is_cleared_of_killed_writes_and_keeps_running_ones(tmp_path):
    for name in (".a.0123abcd.tmp", ".b.0123abcd.tmp"):
        (tmp_path / name).touch()
    with replacing(tmp_path / "c") as file:
        remove_abandoned(tmp_path)
        assert [str(path) for path in tmp_path.iterdir()] == [file.name]


def test_a_symbolic_link_keeps_pointing(tmp_path):
    write_text(tmp_path / "real", "1")
    (tmp_path / "link").symlink_to("real")
    write_text(tmp_path / "link", "2")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "2"
    with pytest.raises(ValueError, match="folder"):
        write_text(tmp_path, "1")


def test_who_may_read_a_file_stays(tmp_path):
    target = tmp_path / "agent.zip"
    target.write_bytes(b"old")
    target.chmod(0o600)
    with replacing(target) as file:
        file.write(b"new")
    assert target.read_bytes() == b"new" and stat.S_IMODE(target.stat().st_mode) == 0o600
