"""The planner's training benchmark counts what is computed, and writes what it measured."""

from __future__ import annotations

import argparse
import json

import measure
import planner_training
import pytest
from plain import PlainPlanner, WindowDataset, batches
from torch.utils.flop_counter import FlopCounterMode


@pytest.mark.parametrize("depth", [1, 3])
def test_counted_work_is_done_both_ways(depth):
    args = argparse.Namespace(d_model=64, horizon=8, delay=8, batch_size=16, device="cpu")
    source = planner_training.make_source(5, 40)
    counted = planner_training.matmul_flops(16, 16, 64, depth, 8)
    trainer = planner_training.make_trainer(depth, "float32", args, source)
    with FlopCounterMode(display=False) as ours:
        trainer.online.loss(source.sample(16, 16)).backward()
    # Nothing goes back through the data, so that the first layers' input gradients are left out
    assert 0.98 * counted < ours.get_total_flops() <= counted
    plain = PlainPlanner(planner_training.OBS_DIM, planner_training.ACT_DIM, 8, 16, 64, depth)
    batch = next(batches(WindowDataset(source.sample(32, 16)), 16))
    with FlopCounterMode(display=False) as theirs:
        plain.update(batch)
    assert theirs.get_total_flops() == pytest.approx(counted, rel=0.03)


@pytest.mark.parametrize("bfloat16", [False, True])  # whatever this processor has: tiny products are cheap to emulate
def test_rows_agree_with_what_was_measured(bfloat16, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(measure, "has_bfloat16", lambda device: bfloat16)
    file = tmp_path / "made" / "figures.json"
    tiny = ["--depth", "1", "--d-model", "32", "--batch-size", "8", "--rounds", "2", "--num-threads", "1"]
    tiny += ["--product-size", "64", "--product-seconds", "0"]
    rows = planner_training.main([*tiny, "--json", str(file)])
    written = json.loads(file.read_text())
    formats = ["float32", "bfloat16"] if bfloat16 else ["float32"]
    assert [row["updates"] for row in rows] == ["plain", *(f"ours, {name}" for name in formats)]
    assert list(written["matmul_flops_per_second"]) == formats
    captured = capsys.readouterr()
    assert captured.out.count("\n") == 2 + len(rows) and "2 turns of one update at depth 1: plain" in captured.err
    for row, kept in zip(rows, written["rows"], strict=True):
        assert kept["p50_ms"] == row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"]
        assert row["per second"] == pytest.approx(1000 / row["p50_ms"])
        assert kept["times plain"]["value"] == row["times plain"].value > 0
        assert row["fraction of floor"] == pytest.approx(row["floor_ms"] / row["p50_ms"])
    assert rows[0]["floor_ms"] == rows[1]["floor_ms"] > 0  # both float32
    assert rows[0]["times plain"].value == 1.0
