"""Tables of results under several delays: what an average pairs, scores, and how agents move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from scipy.stats import ttest_1samp

from sb3_said.offline.scores import REFERENCE_RETURNS
from sb3_said.zoo.cells import Cell
from sb3_said.zoo.tables import average, make_table, manners_of, print_manners, print_scores, print_table, unpaired


def test_an_average_pairs_episodes_of_one_start() -> None:
    row = {0: np.array([0.0, 10.0]), 4: np.array([10.0, 0.0])}
    over = "2 episodes (Student's t)"
    assert average(row, [0, 4]) == ("5.0 [5.0, 5.0]", over)  # each start has a mean of 5
    assert average(row, [0, 4, 8]) == ("5.0 [5.0, 5.0], 2 of 3", over)
    assert average(row, [8]) == ("-", "")
    assert average({0: np.array([3.0])}, [0]) == ("3.0", "")  # an episode by itself tells nothing about the spread


def test_scores_are_the_returns_between_those_of_a_random_policy_and_an_expert(
    capsys: pytest.CaptureFixture[str],
) -> None:
    low, high = REFERENCE_RETURNS["hopper"]
    returns = low + np.array([0.2, 0.4, 0.6]) * (high - low)
    print_scores({"said": {0: returns}}, [0, 4], "Hopper-v5")
    cells = capsys.readouterr().out.splitlines()[-2].split("|")
    t = ttest_1samp([20.0, 40.0, 60.0], 0.0).confidence_interval()
    assert [cell.strip() for cell in cells[1:4]] == ["said", f"40.0 [{t.low:.1f}, {t.high:.1f}]", "-"]
    print_scores({"said": {0: returns}}, [0, 4], "Pendulum-v1")
    assert not capsys.readouterr().out


def test_falls_and_successes_are_parts_of_the_episodes_that_counted_them(capsys: pytest.CaptureFixture[str]) -> None:
    old = {"returns": [1.0, 2.0, 3.0]}
    cells = [
        Cell("a", None, d, "sadr", "a.zip", "a", 1, None, result=result)
        for d, result in enumerate([old, {**old, "terminations": 1}, {**old, "successes": 2}, {**old, "successes": 0}])
    ]
    found = manners_of(cells)
    assert found is not None and found.ended == pytest.approx(1 / 3) and found.worst_tenth == 1.0
    assert found.succeeded == pytest.approx(1 / 3)
    print_manners(cells, {"a": "A"})
    assert "33% of the episodes ended by the task, 33% were a success" in capsys.readouterr().out


def test_an_average_pairs_training_seeds_where_all_delays_have_as_many() -> None:
    row = {0: np.array([[1.0, 3.0], [5.0, 7.0]]), 4: np.array([[5.0, 7.0], [1.0, 3.0]]), 8: np.array([9.0, 9.0])}
    assert average(row, [0, 4]) == ("4.0 [4.0, 4.0]", "2 training seeds (Student's t)")
    assert average(row, [0, 8]) == ("6.5", "")
    assert average(row, [0, 4], is_paired=False) == ("4.0", "")
    assert average(row, [4], is_paired=False) == average(row, [4])


def seeds_of_a_row(played: dict[int, dict[str, float]]) -> list[Cell]:
    """Return cells of one agent, two episodes each: by delay, what each training seed returned."""
    settings: dict[str, Any] = {"answer": None, "algo": "sadr", "trained_steps": 1, "obstacle": None}
    return [
        Cell(agent="x", delay=delay, file=f"{seed}.zip", sha256=seed, **settings, result={"returns": [x - 1, x + 1]})
        for delay, seeds in played.items()
        for seed, x in seeds.items()
    ]


def test_an_average_pairs_a_training_seed_with_itself_however_the_calls_named_them() -> None:
    right = {0: {"a": 10.0, "b": 20.0, "c": 30.0}, 4: {"a": 110.0, "b": 120.0, "c": 130.0}}
    swapped = {0: right[0], 4: dict(reversed(right[4].items()))}
    one, other = (make_table(seeds_of_a_row(played), {"x": "x"})["x"] for played in (right, swapped))
    assert average(one, [0, 4]) == average(other, [0, 4])
    t = ttest_1samp([60.0, 70.0, 80.0], 0.0).confidence_interval()
    assert average(other, [0, 4])[0] == f"70.0 [{t.low:.1f}, {t.high:.1f}]"
    assert not unpaired(seeds_of_a_row(swapped), {"x": "x"})


@pytest.mark.parametrize(
    ("played", "is_told"),
    [
        ({0: {"a": 1.0, "b": 2.0}, 4: {"b": 2.0, "c": 3.0}}, True),
        ({0: {"a": 1.0, "b": 2.0}, 4: {"b": 2.0}}, True),
        ({0: {"a": 1.0}, 4: {"b": 2.0}}, False),  # an agent for each delay
    ],
)
def test_delays_of_other_training_seeds_have_no_interval_together(
    played: dict[int, dict[str, float]], is_told: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = seeds_of_a_row(played)
    others = unpaired(cells, {"x": "y"})
    assert others == ({"y"} if is_told else set())
    print_table(make_table(cells, {"x": "y"}), [0, 4], others)
    out = capsys.readouterr().out
    mean = next(line for line in out.splitlines() if line.startswith("| y ")).split("|")[4].strip()
    assert ("[" not in mean) == is_told == ("y: no interval of the means, as some delays" in out)
