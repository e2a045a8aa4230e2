"""The expert's benchmarks: they count what is computed, and their statistics are right."""

import json
from itertools import product

import expert_updates
import learning_curves
import numpy as np
import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

from sb3_said import DelayedSAC


@pytest.mark.parametrize("delay", [None, 4])
def test_the_floor_counts_every_product_of_an_update(delay):
    args = expert_updates.parse(["--steps", "150"])
    model = expert_updates.make(DelayedSAC, delay, args, precision="float32")
    with FlopCounterMode(display=False) as counter:
        model.train(1, 64)
    assert expert_updates.matmul_flops(model, 64) == counter.get_total_flops()


def test_a_table_of_updates(tmp_path, capsys):
    path = tmp_path / "updates.json"
    expert_updates.main(["--steps", "150", "--rounds", "2", "--batch-size", "32", "--json", str(path)])
    result = json.loads(path.read_text())
    assert capsys.readouterr().out.count("DelayedSAC") == 3
    rows = {row["updates"]: row for row in result["rows"]}
    assert result["rows"][0]["times SB3's SAC"]["value"] == 1.0
    for name, row in rows.items():
        assert 0 < row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"]
        assert row["fraction of floor"] is None if name == "SB3's SAC" else 0 < row["fraction of floor"] < 1
    assert result["settings"]["batch_size"] == 32 and result["machine"]["torch"] == th.__version__


def test_learning_curves_of_both_trainers_are_compared(tmp_path, capsys):
    short = ["--steps", "40", "--eval-freq", "20", "--eval-episodes", "2", "--results", str(tmp_path)]
    for trainer, seed in product(("sb3", "float32"), (0, 1)):
        learning_curves.main(["--trainer", trainer, "--seed", str(seed), *short])
    files = sorted(tmp_path.glob("*.json"))
    curves = {file.stem: json.loads(file.read_text())["curve"] for file in files}
    assert len(curves) == 4 and all(curve["steps"] == [20, 40] for curve in curves.values())
    for seed in (0, 1):  # nothing is learned yet: the same seed gives the same networks, so the same episodes
        assert curves[f"Hopper-v5_sb3_seed{seed}"] == curves[f"Hopper-v5_float32_seed{seed}"]
    capsys.readouterr()
    learning_curves.main(["--compare", "--results", str(tmp_path)])
    table = capsys.readouterr().out
    assert "SB3's SAC | 2 |" in table and "DelayedSAC, float32 | 2 |" in table
    assert (tmp_path / "Hopper-v5.png").stat().st_size > 10_000


def test_permutations_are_all_counted():
    first, second = np.array([1.0, 2.0, 3.0]), np.array([10.0, 11.0, 12.0])
    assert learning_curves.permutation_p(first, second) == pytest.approx(
        2 / 20
    )  # the split that is seen, and its mirror
    assert learning_curves.permutation_p(first, first) == 1.0
    # By hand: 4 against {1, 9}: |4 - 5| = 1; the others are |1 - 6.5| and |9 - 2.5|
    assert learning_curves.permutation_p(np.array([4.0]), np.array([1.0, 9.0])) == 1.0
    assert learning_curves.permutation_p(np.array([9.0]), np.array([1.0, 4.0])) == pytest.approx(1 / 3)
