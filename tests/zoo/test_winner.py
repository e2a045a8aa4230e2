"""winner.py: what a search found, as train.py reads it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch as th

pytest.importorskip("rl_zoo3")

from trained_run import ENV, config_of, read_by_train, train_said

from sb3_said import SAID
from sb3_said.zoo import train
from sb3_said.zoo.runs import load_run
from sb3_said.zoo.winner import RunConfig


def test_train_reads_the_winner(tmp_path: Path) -> None:
    run = train_said(tmp_path / "tuned")
    (run / "tune").mkdir()
    config = RunConfig.read(run)
    assert config.write_best(run / "tune", {"depth": 2, "temperature": 0.3}, "for a test") == []
    best = run / "tune" / "best.yml"
    expected = {**config_of(run), "n_timesteps": 200}
    expected["planner_kwargs"] |= {"depth": 2, "temperature": 0.3}
    for preset in ("cpu", "paper"):  # "paper" is the default on a machine with a GPU
        assert read_by_train(best, 2, preset, tmp_path) == expected
    assert config.train_command(run / "tune").endswith(f"--env {ENV} --delay 2 -conf {best}")
    train.main(["--algo", "said", "--env", ENV, "--delay", "2", "-conf", str(best), "-f", str(tmp_path), "-n", "120",
                "--num-threads", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0"])  # fmt: skip
    model = load_run(tmp_path / "said" / f"{ENV}-delay2_1", device="cpu").model
    assert isinstance(model, SAID) and model.policy.planner.config.temperature == 0.3
    assert len(model.policy.planner.network.blocks) == 2


def test_what_yaml_cannot_hold_is_named() -> None:
    config = RunConfig(Path(), {"policy_kwargs": {"activation_fn": th.nn.Tanh}, "gamma": 0.9}, {})
    block, left_out = config.block({"depth": 2, "temperature": 0.0})
    assert block == {"gamma": 0.9, "planner_kwargs": {"depth": 2, "temperature": 0.0}}
    assert left_out == ["policy_kwargs"]
