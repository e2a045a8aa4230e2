"""benchmarks/distillation.py: what it writes is what a student of the run does."""

import json
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("onnxruntime")

import distillation as script
from small_run import write_run
from what_diffusion_buys import open_run, open_with_log

from sb3_said import SAID, DelayedSAC
from sb3_said.evaluation import rollout
from sb3_said.zoo import collect
from sb3_said.zoo.runs import load_run

TINY = {"n_labels": 40, "own_steps": 10, "rounds": 1, "gradient_steps": 5, "batch_size": 8}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run-v0", SAID, (0, 2), checkpoint=True)


def test_students_are_played_beside_their_planner(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "distillation.json"
    words = [str(run), "--settings", json.dumps(TINY), "--delays", "0", "2", "--episodes", "2", "--calls", "3",
             "--onnx", "--json", str(file)]  # fmt: skip
    rows = script.main([*words, "--seeds", "5"])
    name = "student, seed 5"
    assert set(rows) == {"planner", name} and json.loads(file.read_text())["rows"] == rows
    assert rows[name]["error"] > 0 and rows[name]["onnx"]["n_calls"] == rows["planner"]["predict"]["n_calls"] == 3
    out = capsys.readouterr().out
    assert f"| {name} | " in out and "| planner | " in out

    model = open_run(run)
    model.seed = 5
    assert model.distill(**TINY) == rows[name]["error"]
    make_env = load_run(run, delay=2, device="cpu").make_env
    for who, row in (("planner", "planner"), ("student", name)):
        with model.policy.answering(who):
            assert rollout(model, make_env, 2, 10_000, 20).returns.tolist() == rows[row]["returns"]["2"]

    assert script.main([*words, "--seeds", "5"]) == rows
    with pytest.raises(SystemExit):
        script.main([*words, "--episodes", "3"])
    assert "holds results of {" in capsys.readouterr().err


def test_a_log_takes_the_replays_place(run: Path, tmp_path: Path) -> None:
    log, file = tmp_path / "log.npz", tmp_path / "rows.json"
    collect.main([str(run), "--steps", "70", "--n-envs", "1", "-o", str(log), "--device", "cpu"])
    words = [str(run), "--log", str(log), "--settings", json.dumps(TINY), "--delays", "0", "2", "--episodes", "1"]
    rows = script.main([*words, "--calls", "1", "--json", str(file)])

    model = open_with_log(run, log)
    assert model.replay_buffer.size() == 70
    model.seed = 1
    assert model.distill(**TINY) == rows["student, seed 1"]["error"]
    write_run(tmp_path / "expert-v0", DelayedSAC, 2)
    with pytest.raises(ValueError, match="DelayedSAC; give a SAID agent"):
        open_with_log(tmp_path / "expert-v0", log)
