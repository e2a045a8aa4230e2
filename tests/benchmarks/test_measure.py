"""What the benchmarks share."""

import argparse
import json
import time

import measure
import numpy as np
import pytest


def test_variants_take_turns_in_both_orders_and_are_timed_apart():
    calls = []

    def variant(name, seconds):
        def run():
            calls.append(name)
            time.sleep(seconds)

        return run

    times = measure.turn_by_turn({"slow": variant("s", 0.02), "fast": variant("f", 0.005)}, rounds=4)
    assert "".join(calls) == "sf" + "sffssffs"
    assert {name: len(t) for name, t in times.items()} == {"slow": 4, "fast": 4}
    assert times["slow"].min() >= 0.02 and 0.005 <= times["fast"].min() < 0.02


def test_ratio_is_the_median_of_the_turns():
    slow, fast = np.array([2.0, 4.0, 9.0, 8.0, 6.0]), np.array([1.0, 1.0, 3.0, 4.0, 3.0])
    found = measure.ratio(slow, fast)
    assert found.value == 2.0
    assert found.low <= 2.0 <= found.high


def test_the_rate_of_products_is_that_of_the_clock():
    rate = measure.matmul_rate("float32", seconds=0.05)
    a = np.ones((512, 512), np.float32)
    seconds = []
    for _ in range(10):
        began = time.perf_counter()
        a @ a
        seconds.append(time.perf_counter() - began)
    numpys = 2 * 512**3 / min(seconds)  # a busy machine makes the others as slow as it likes
    assert 0.1 < rate / numpys < 20  # another library, perhaps on another number of threads: the same order


def test_tables_and_files(tmp_path, capsys):
    rows = [
        {"what": "plain", "p50_ms": 1234.5, "ratio": measure.ratio(np.ones(3), np.ones(3))},
        {"what": "ours", "p50_ms": 0.25, "ratio": measure.ratio(2 * np.ones(3), np.ones(3))},
    ]
    measure.print_table(rows)
    assert capsys.readouterr().out.splitlines() == [
        "| what | p50_ms | ratio |",
        "|---|---:|---:|",
        "| plain | 1,234.50 | 1.00 [1.00, 1.00] |",
        "| ours | 0.25 | 2.00 [2.00, 2.00] |",
    ]
    path = tmp_path / "folder" / "table.json"
    measure.write_json(path, argparse.Namespace(device="cpu", rounds=3, json=path), rows, note=1.5)
    written = json.loads(path.read_text())
    assert written["rows"][1]["ratio"]["value"] == 2.0 and written["note"] == 1.5
    assert written["settings"] == {"device": "cpu", "rounds": 3}
    assert written["machine"]["threads"] >= 1
    measure.write_json(None, argparse.Namespace(device="cpu"), rows)


def test_percentiles_are_numpys_in_milliseconds():
    assert measure.percentiles(np.arange(101) / 1000) == pytest.approx({"p50_ms": 50, "p95_ms": 95, "p99_ms": 99})
