"""What the benchmarks share."""

import argparse
import json
from types import SimpleNamespace

import measure
import numpy as np
import pytest


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests move themselves, so that no time depends on the machine."""
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)
    monkeypatch.setattr(measure, "time", clock)
    return clock


def test_variants_take_turns_in_both_orders_and_are_timed_apart(clock):
    calls = []

    def variant(name, seconds):
        def run():
            calls.append(name)
            clock.now += seconds

        return run

    times = measure.turn_by_turn({"slow": variant("s", 2.0), "fast": variant("f", 0.5)}, rounds=4)
    assert "".join(calls) == "sf" + "sffssffs"
    assert {name: t.tolist() for name, t in times.items()} == {"slow": [2.0] * 4, "fast": [0.5] * 4}


def test_a_long_measurement_shows_how_far_it_is(monkeypatch, capsys):
    measure.turn_by_turn({"quick": lambda: None}, rounds=5)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(measure, "PATIENCE", 0.0)
    measure.turn_by_turn({"slow": lambda: None}, rounds=5)
    shown = capsys.readouterr()
    assert "0/5" in shown.err and shown.out == ""


def test_ratio_is_the_median_of_the_turns():
    slow, fast = np.array([2.0, 4.0, 9.0, 8.0, 6.0]), np.array([1.0, 1.0, 3.0, 4.0, 3.0])
    found = measure.ratio(slow, fast)
    assert found.value == 2.0
    assert (found.low, found.high, found.confidence) == (2.0, 4.0, 0.9375)
    assert np.isnan(measure.ratio(slow[:1], fast[:1]).low)


@pytest.mark.parametrize("rounds", [3, 6, 8, 20])
def test_the_interval_of_a_ratio_covers_its_median(rounds):
    rng = np.random.default_rng(rounds)
    found = [measure.ratio(np.exp(rng.normal(size=rounds)), np.ones(rounds)) for _ in range(100)]
    covered = np.mean([one.low <= 1.0 <= one.high for one in found])
    assert covered > found[0].confidence - 0.05


def test_the_rate_of_products_is_that_of_the_clock(clock, monkeypatch):
    products = []

    def multiply(a, b, out):
        products.append((a.shape, b.shape, a.dtype))
        clock.now += 0.25

    monkeypatch.setattr(measure.th, "mm", multiply)
    assert measure.matmul_rate("float32", size=8, seconds=1.0) == 2 * 8**3 / 0.25
    assert len(products) == 4 + 7  # 3 turns, then 6, each after one that does not count
    assert set(products) == {((8, 8), (8, 8), measure.th.float32)}


@pytest.mark.parametrize(("bfloat16", "formats"), [(False, ["float32"]), (True, ["float32", "bfloat16"])])
def test_bfloat16_is_measured_only_in_hardware(bfloat16, formats, monkeypatch):
    monkeypatch.setattr(measure, "has_bfloat16", lambda device: bfloat16)
    args = measure.parse(measure.parser(""), ["--product-size", "16", "--product-seconds", "0"])
    rates = measure.matmul_rates(args)
    assert list(rates) == formats and min(rates.values()) > 0


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


def test_a_file_of_rows_is_read_again_only_if_it_is_of_the_same(tmp_path, capsys):
    p, file = argparse.ArgumentParser(), tmp_path / "rows.json"
    document = measure.resumed(p, file, {"seed": 1}, rows={})
    assert document == {"seed": 1, "rows": {}}
    file.write_text(json.dumps({**document, "rows": {"a": 2}}))
    assert measure.resumed(p, file, {"seed": 1}, rows={})["rows"] == {"a": 2}
    for text, settings, message in (
        (file.read_text(), {"seed": 2}, "holds results of {'seed': 1}, but {'seed': 2} was asked for"),
        ("{", {}, "rows.json is no JSON"),
        ("[]", {}, "was not written by --json of this program"),
        ('{"seed": 1}', {"seed": 1}, "was not written by --json of this program"),
    ):
        file.write_text(text)
        with pytest.raises(SystemExit):
            measure.resumed(p, file, settings, rows={})
        assert message in capsys.readouterr().err
