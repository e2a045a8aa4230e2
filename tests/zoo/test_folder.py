"""A run's folder: each process gets its own, holds it while it trains, and clears what a kill left."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

from sb3_said.files.archive import save_tree
from sb3_said.files.normalization import normalization_file
from sb3_said.zoo.folder import claim_folder, drop_undone_episodes, find_normalization, hold_folder


def test_trainings_that_start_together_claim_folders_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "Task-delay4-seed1_7").mkdir()
    (tmp_path / "Task-delay4-seed12_9").mkdir()  # of another seed
    barrier = Barrier(8)

    def claim(_: int) -> str:
        barrier.wait()
        return claim_folder(tmp_path, "Task-delay4-seed1").name

    with ThreadPoolExecutor(8) as pool:
        names = list(pool.map(claim, range(8)))
    assert sorted(names) == sorted(f"Task-delay4-seed1_{k}" for k in range(8, 16))
    assert claim_folder(tmp_path, "Task-delay4-seed1", "_0a-b").name == "Task-delay4-seed1_16_0a-b"
    assert claim_folder(tmp_path, "Task-delay4-seed1").name == "Task-delay4-seed1_17"


def test_a_folder_is_held_by_one_and_cleared_of_killed_writes(tmp_path: Path) -> None:
    (tmp_path / ".checkpoint.zip.0123abcd.tmp").touch()
    lock = hold_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["run.lock"]
    with pytest.raises(ValueError, match="is being trained by another process"):
        hold_folder(tmp_path)
    lock.release()
    hold_folder(tmp_path).release()


@pytest.mark.parametrize(
    "noted", [None, 3, {"../victim": 0, "victim": 0, "0.monitor.csv": -1}, {"0.monitor.csv": 10**12}]
)
def test_a_forged_note_cuts_and_lengthens_nothing(noted: Any, tmp_path: Path) -> None:
    (run := tmp_path / "run").mkdir()
    files = [tmp_path / "victim", run / "victim", run / "0.monitor.csv"]
    for file in files:
        file.write_text("12345")
    save_tree(run / "checkpoint.zip", {}, {"monitors": noted})
    drop_undone_episodes(run / "checkpoint.zip")
    assert [file.read_text() for file in files] == ["12345"] * 3


def test_statistics_of_the_last_agent_serve_checkpoints_with_a_warning_and_not_what_the_run_began_with(
    tmp_path: Path,
) -> None:
    record: Any = SimpleNamespace(agent_name="Task.zip")
    agents = [tmp_path / name for name in ("Task.zip", "best_model.zip", "rl_model_50_steps.zip", "given.zip")]
    last, best, checkpoint, given = agents
    for agent in agents:
        agent.touch()
    own = normalization_file(last)
    for statistics in (own, normalization_file(best)):
        statistics.touch()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_normalization(last, record) == own
        assert find_normalization(best, record) == normalization_file(best)
        assert find_normalization(given, record) is None
    with pytest.warns(UserWarning, match="rl_model_50_steps.zip is played with .*, statistics .* of another step"):
        assert find_normalization(checkpoint, record) == own
