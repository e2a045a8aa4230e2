"""sb3-said export."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from small_agent import make, observe, teach
from small_task import delayed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said.realtime import OnnxModel
from sb3_said.zoo import export
from sb3_said.zoo.answer import save_with_normalization


def test_the_command_writes_the_student(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    onnx = pytest.importorskip("onnx")
    teach(make(), 8).save(tmp_path / "agent.zip")
    export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert [node.name for node in onnx.load(tmp_path / "agent.onnx").graph.output] == ["action"]
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'agent.onnx'}\n"


def test_the_scale_beside_an_agent_is_in_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    venv = VecNormalize(DummyVecEnv([delayed]), norm_obs_keys=["observation"])
    venv.obs_rms["observation"].mean += 3.0
    model, obs = teach(make(venv), 8), observe()
    save_with_normalization(model, tmp_path / "agent.zip")
    export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert capsys.readouterr().out == f"Wrote {tmp_path / 'agent.onnx'}\n"
    with model.policy.answering("student"):
        wanted = model.predict(venv.normalize_obs(obs), deterministic=True)[0]
    answer, _ = OnnxModel(tmp_path / "agent.onnx").predict(obs)
    np.testing.assert_allclose(answer, wanted, rtol=1e-5, atol=1e-6)
    (tmp_path / "agent.normalize.zip").unlink()
    export.main([str(tmp_path / "agent.zip"), str(tmp_path / "agent.onnx")])
    assert "no statistics are beside the agent: normalise them first" in capsys.readouterr().out
    assert OnnxModel(tmp_path / "agent.onnx").reads_normalized


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
