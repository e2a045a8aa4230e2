"""sb3-said export."""

from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

from small_agent import make, teach

from sb3_said.zoo import export


def test_the_command_writes_the_student(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    onnx = pytest.importorskip("onnx")
    teach(make(), 8).save(tmp_path / "agent.zip")
    export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert [node.name for node in onnx.load(tmp_path / "agent.onnx").graph.output] == ["action"]
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'agent.onnx'}\n"


def test_what_cannot_be_exported_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnx")
    make().save(tmp_path / "agent.zip")
    with pytest.raises(SystemExit) as stop:
        export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert stop.value.code == 2 and "no student to export" in capsys.readouterr().err


def test_without_onnx_it_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    make().save(tmp_path / "agent.zip")
    with pytest.raises(SystemExit) as stop:
        export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert stop.value.code == 1 and "sb3_said[export]" in capsys.readouterr().err
