"""Cells that are played: by which agent, in how many processes, and what ends them."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import warnings
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from forked import begin, run_script
from played_cells import play
from small_run import ENV

from sb3_said.zoo import playing
from sb3_said.zoo.runs import load_run


def test_an_agent_of_a_plain_run_is_its_file(said: Path, tmp_path: Path) -> None:
    (copy := tmp_path / "alone.zip").write_bytes((said / f"{ENV}.zip").read_bytes())
    digests = {playing.digest_of(load_run(path, device="cpu")) for path in (said, copy)}
    assert digests == {hashlib.sha256(copy.read_bytes()).hexdigest()}


def test_workers_change_the_speed_only(said: Path, tmp_path: Path) -> None:
    delays = ["1", "WIFI_20MS"]  # which needs 6 steps
    one, two = (play(tmp_path / f"{n}.json", [said], delays, "--workers", n) for n in ("1", "2"))
    assert one["cells"] == two["cells"]
    assert [cell["result"] is None for cell in two["cells"]] == [False, True] * 2


def test_a_worker_that_is_killed_is_told_of(
    said: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killed(*_: Any, **__: Any) -> Any:
        raise BrokenProcessPool("A process in the process pool was terminated abruptly")

    monkeypatch.setattr(playing, "as_completed", killed)
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [said], ["1"], "--workers", "2")
    assert "fewer --workers. What was played is kept" in capsys.readouterr().err


def die_beside_a_worker(_: Connection) -> None:
    """Begin a worker, which is forked and so holds the pipe, too, and be killed."""
    fork = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(1, fork, initializer=playing.begin_worker, initargs=(1,))
    assert pool.submit(os.getpid).result() != os.getpid()
    os.kill(os.getpid(), signal.SIGKILL)


def test_workers_end_with_a_killed_command(tmp_path: Path) -> None:
    reader, writer = multiprocessing.Pipe(duplex=False)
    killed = begin(output := tmp_path / "output.txt", die_beside_a_worker, writer)
    writer.close()
    assert reader.poll(240), "the worker goes on"  # reading the pipe ends with its last writer
    killed.join()
    assert killed.exitcode == -signal.SIGKILL, output.read_text()


@pytest.mark.parametrize("starts", [False, True])
def test_ctrl_c_ends_workers_amid_their_cells(starts: bool, sadr: Path, tmp_path: Path) -> None:
    """A terminal sends it to all: workers would go on with the next cells, and the command wait for them.

    Amid the start of one, too, which without what it is to do would tell so in a traceback.
    """
    delays = ["--delays", "0", "1", "UniformDelay(0, 1)", "EpisodeDelay(0, 1)"]
    words = [str(sadr), *delays, "--workers", "2", "--device", "cpu", "--json", str(tmp_path / "out.json")]
    code = f"""
import os, time
from multiprocessing import forkserver
from signal import SIGINT
from sb3_said.zoo import over_delays, playing

def begin(*_):
    print("begun", flush=True)
    time.sleep(1000)

def start(fds, start=forkserver.connect_to_new_process):
    made = start(fds)
    if {starts}:
        os.kill(os.getpid(), SIGINT)
    return made

if __name__ == "__main__":
    playing.play, forkserver.connect_to_new_process = begin, start
    over_delays.main({words!r})
"""
    (script := tmp_path / "command.py").write_text(code)
    os.mkfifo(output := tmp_path / "output")
    process = begin(output, run_script, script, [])
    assert process.pid is not None
    try:
        with output.open() as pipe:  # which ends with the last of the processes
            while not starts and "begun" not in (line := pipe.readline()):
                assert line, "it has ended"
            if not starts:
                os.killpg(process.pid, signal.SIGINT)
            shown = pipe.read()
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == 130 and "Interrupted. Give the same command again" in shown, shown
    n_begun = shown.count("begun") + (not starts)  # one was read above
    assert "Traceback" not in shown and n_begun <= 2, shown  # of the four cells, one each worker


def test_only_the_warning_of_another_delay_is_silent(sadr: Path) -> None:
    with pytest.warns(UserWarning, match="learned at ages"):
        load_run(sadr, delay=0, device="cpu")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "This")
        with playing.at_any_age():
            load_run(sadr, delay=0, device="cpu")
    with pytest.warns(UserWarning, match="old"), playing.at_any_age():
        warnings.warn("This file is old.", stacklevel=1)


def test_an_agent_that_changes_amid_a_call_ends_it(
    sadr: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, original = Path(shutil.copytree(sadr, tmp_path / "run")), playing.play

    def trained_on(*args: Any) -> Any:
        result = original(*args)
        model: Any = load_run(run, device="cpu").model
        model.num_timesteps += 1
        model.save(run / f"{ENV}.zip")
        return result

    monkeypatch.setattr(playing, "play", trained_on)
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [f"x={run}"], ["0", "1"])
    assert f"{ENV}.zip has changed since this call began" in capsys.readouterr().err
    (cell,) = json.loads((tmp_path / "out.json").read_text())["cells"]
    assert cell["delay"] == 0  # of the file that it names
