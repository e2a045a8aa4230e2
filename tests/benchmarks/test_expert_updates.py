"""The expert's benchmark counts what is computed, and writes what it measured."""

import json

import expert_updates
import pytest
import torch as th
from stable_baselines3 import SAC
from torch.utils.flop_counter import FlopCounterMode

from sb3_said import DelayedSAC, StableSAC


@pytest.mark.parametrize(("cls", "delay"), [(SAC, 0), (DelayedSAC, 0), (DelayedSAC, 4), (StableSAC, 4)])
def test_the_floor_counts_every_product_of_an_update(cls, delay):
    model = expert_updates.make(cls, delay, expert_updates.read_arguments(["--steps", "150"]))
    with FlopCounterMode(display=False) as counter:
        model.train(2, 64)
    assert 2 * expert_updates.matmul_flops(model, 64) == counter.get_total_flops()


def test_a_table_of_updates(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(expert_updates, "UPDATES_PER_TURN", 4)
    path = tmp_path / "updates.json"
    short = ["--steps", "150", "--rounds", "2", "--batch-size", "32", "--product-size", "64", "--product-seconds", "0"]
    rows = expert_updates.main([*short, "--delay", "2", "--json", str(path)])
    names = ["SB3's SAC", "DelayedSAC at delay 0", "DelayedSAC at delay 2", "StableSAC at delay 2"]
    assert [row["updates"] for row in rows] == names
    captured = capsys.readouterr()
    assert captured.out.count("\n") == 2 + len(rows) and "2 turns of 4 updates" in captured.err
    result = json.loads(path.read_text())
    assert result["rows"][0]["time, SAC's = 1"]["value"] == 1.0
    for row, kept in zip(rows, result["rows"], strict=True):
        assert 0 < row["p50_ms"] == kept["p50_ms"] <= row["p95_ms"] <= row["p99_ms"]
        assert row["fraction of floor"] > 0
    assert result["settings"]["batch_size"] == 32 and result["machine"]["torch"] == th.__version__
    assert result["matmul_flops_per_second"] > 0
