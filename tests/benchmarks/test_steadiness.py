"""The table of how steady trainings are, against numbers worked out by hand."""

from pathlib import Path

import numpy as np
import pytest
import steadiness


def write_run(folder: Path, means: list[float]) -> Path:
    """Write evaluations of two episodes around each mean, every 10 steps."""
    folder.mkdir(parents=True)
    returns = np.array(means)[:, None] + [-5.0, 5.0]
    np.savez(folder / "evaluations.npz", timesteps=10 * np.arange(1, len(means) + 1), results=returns)
    return folder


def test_a_row_is_worked_out_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steady = write_run(tmp_path / "a" / "expert", [0, 100, 100, 100]).parent  # as a SAID run has it
    falls = write_run(tmp_path / "b", [500, 80, 20, 80])
    file = tmp_path / "all.json"
    rows = steadiness.main([f"x={steady}", f"x={falls}", f"y={falls}", "--last", "30", "--json", str(file)])
    assert rows["x"] | {"sd / mean": 0} == {
        "runs": 2, "steps": [40, 40], "mean": 80.0, "sd / mean": 0, "bad": 1, "evaluations": 6, "worst run": 0.75,
    }  # fmt: skip
    assert rows["x"]["sd / mean"] == pytest.approx(np.std([80, 20, 80]) / 60)
    assert "| x | 40, 40 | 80 | 0.47 | 1 of 6 | 0.75 |" in capsys.readouterr().out
    assert steadiness.main([f"x={file}", f"y={file}", "--last", "30"]) == rows


def test_each_run_of_a_file_has_a_row_with_its_evaluations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "all.json"
    short = write_run(tmp_path / "short", [500, 80])
    steadiness.main([f"x={write_run(tmp_path / 'long', [0, 50, 100, 300])}", f"y={short}", "--json", str(file)])
    capsys.readouterr()
    rows = steadiness.main([str(file), "--last", "20", "--each", "20"])
    assert {name: row["mean"] for name, row in rows.items()} == {"x": 200.0, "y": 290.0}
    assert capsys.readouterr().out.splitlines() == [
        "|  | run | 20 | 40 | last: mean | sd / mean | bad |",
        "|---|---|---|---|---|---:|---|",
        "| x | long | 50 | 300 | 200 | 0.50 | 1 of 2 |",
        "| y | short | 80 |  | 290 | 0.72 | 1 of 2 |",
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            '[{"name": "stable", "run": "a", "steps": [1], "returns": [[1.0]]}]',
            "has no runs named 'stabel', only stable",
        ),
        ('{"agents": {}}', "was not written by --json of this program"),
    ],
)
def test_a_file_without_the_runs_is_told(
    content: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file := tmp_path / "runs.json").write_text(content)
    with pytest.raises(SystemExit):
        steadiness.main([f"stabel={file}"])
    assert message in capsys.readouterr().err


def test_a_run_without_evaluations_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        steadiness.main([f"x={tmp_path}"])
    assert "train with --eval-freq" in capsys.readouterr().err
