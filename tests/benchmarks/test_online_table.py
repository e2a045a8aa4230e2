"""The table of online agents: rows, means and intervals over training seeds, against numbers by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import online_table
import pytest

from sb3_said.evaluation import stratified_interval

SETTINGS = {"env": "Hopper-v5", "n_episodes": 2, "seed": 10000, "deterministic": True}


def cell(sha256: str, answer: str, delay: int | str, mean: float, **other: Any) -> dict[str, Any]:
    """Two episodes around a mean, of which one falls."""
    result = {"returns": [mean - 10, mean + 10], "terminations": 1, "mean_action_change": {"value": 0.1}}
    entry = {"agent": f"SAID {answer}", "answer": answer, "delay": delay, "sha256": sha256, "result": result}
    return {"algo": "said", "file": f"{sha256}.zip", "trained_steps": 1, "obstacle": None, **entry, **other}


def write(path: Path, cells: list[dict[str, Any]], **settings: Any) -> str:
    path.write_text(json.dumps({**SETTINGS, **settings, "origins": [], "cells": cells}))
    return str(path)


def seed(sha256: str, answer: str, mean: float, gain: float = 100.0) -> list[dict[str, Any]]:
    """An agent that plays delays 0 and 8 and a random one; its expert returns less."""
    whos = ((answer, mean), ("expert", mean - gain))
    return [cell(sha256, who, d, m - less) for who, m in whos for d, less in ((0, 0), (8, 40), ("WIFI_20MS", 200))]


def test_rows_are_worked_out_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    wrong_age = cell("a", "planner", 0, 5.0, age_error=1)
    unplayed = cell("a", "planner", 16, 5.0, result=None, obstacle="it was built for delays 0..8")
    files = [
        write(tmp_path / "a.json", [*seed("a", "planner", 1000.0), wrong_age, unplayed]),
        # Where both answer, they are the agent, and its planner alone is not
        write(tmp_path / "b.json", [*seed("b", "both", 3000.0), cell("b", "planner", 0, 7.0)]),
    ]
    found = online_table.main([*files, "--plot", str(tmp_path / "agents.png")])
    assert [len(seeds) for seeds in found["Hopper-v5"].values()] == [2, 2]
    lines = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
    columns = {name: [line[i] for line in lines[2:4]] for i, name in enumerate(lines[0])}
    assert columns["agent"] == ["SAID", "its expert"]
    of_0 = stratified_interval([[990, 1010], [2990, 3010]])
    assert columns["0"][0] == f"2,000 [{of_0.low:,.0f}, {of_0.high:,.0f}]" and columns["0"][1].startswith("1,900 [")
    assert columns["8"][0].startswith("1,960 [") and columns["mean of fixed"][0].startswith("1,980 [")
    assert columns["seeds"] == ["980, 2,980", "880, 2,880"] and columns["mean of random"][0].startswith("1,800 [")
    assert columns["falls"] == ["50.0%"] * 2 and columns["change"] == ["0.100"] * 2
    gain = "100 [100, 100]"
    assert lines[4] == ["Hopper-v5", "SAID more", gain, gain, gain, gain, "", gain]
    assert lines[5] == ["Hopper-v5", "the same, by t", *lines[4][2:]]
    assert lines[6][:4] == ["Hopper-v5", "SAID, paper", "3,170 ± 283", "2,514 ± 415"]
    assert (tmp_path / "agents.png").read_bytes()[:4] == b"\x89PNG"


def test_every_seed_by_itself_is_the_table_of_its_file_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [
        write(tmp_path / f"{name}.json", seed(name, "planner", m), env="Own-v0") for name, m in (("a", 1e3), ("b", 3e3))
    ]

    def rows(*argv: str) -> list[str]:
        online_table.main([*argv, "--each"])
        return [line for line in capsys.readouterr().out.splitlines() if "Own-v0" in line]

    first, second = (rows(file) for file in files)
    together = rows(*files)
    assert together == [*first, *(line.replace("seed 1", "seed 2") for line in second)]
    assert [line.split(" | ")[0] for line in together] == ["| Own-v0, seed 1"] * 3 + ["| Own-v0, seed 2"] * 3
    assert together[0].split(" | ")[2].startswith("1,000 [") and together[3].split(" | ")[2].startswith("3,000 [")


def test_what_said_has_more_has_students_t_over_seeds_as_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    online_table.main([
        write(tmp_path / f"{name}.json", seed(name, "planner", 1000.0, gain), env="Own-v0")
        for name, gain in (("a", 100.0), ("b", 150.0), ("c", 200.0))
    ])  # fmt: skip
    by_t = capsys.readouterr().out.splitlines()[5].strip("| ").split(" | ")
    assert by_t[:3] == ["Own-v0", "the same, by t", "150 [26, 274]"]  # 4.303 * 50 / sqrt(3) = 124


def test_an_agent_that_its_trial_lets_the_expert_answer_is_its_expert(tmp_path: Path) -> None:
    ours = write(tmp_path / "a.json", seed("a", "planner", 1000.0))
    theirs = write(tmp_path / "b.json", seed("b", "planner", 3000.0))
    found = online_table.main([ours, "--expert-answers", theirs])["Hopper-v5"]
    means = {row: online_table.returns_over(seeds, [0]).mean(1).tolist() for row, seeds in found.items()}
    assert means == {"SAID": [1000.0, 2900.0], "its expert": [900.0, 2900.0]}
    assert len(online_table.main(["--expert-answers", theirs])["Hopper-v5"]["SAID"]) == 1
    found = online_table.main([theirs, ours, "--expert-answers", theirs])["Hopper-v5"]  # in the order of all
    means = {row: online_table.returns_over(seeds, [0]).mean(1).tolist() for row, seeds in found.items()}
    assert means == {"SAID": [2900.0, 1000.0], "its expert": [2900.0, 900.0]}


def test_a_seed_that_has_not_played_a_delay_counts_in_no_mean_over_it(tmp_path: Path) -> None:
    lacking = [one for one in seed("b", "planner", 3000.0) if one["delay"] != "WIFI_20MS"]
    rows = online_table.read([Path(write(tmp_path / "all.json", [*seed("a", "planner", 1000.0), *lacking]))])
    said = rows["Hopper-v5"]["SAID"]
    assert np.array_equal(online_table.returns_over(said, ["WIFI_20MS"]), [[790, 810]])
    assert np.array_equal(online_table.returns_over(said, [0, 8]), [[970, 990], [2970, 2990]])


def test_what_cannot_be_compared_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write(tmp_path / "a.json", seed("a", "planner", 1000.0))
    for name, cells, settings, said in (
        ("fewer", seed("b", "planner", 1000.0), {"n_episodes": 1}, "another file of the task"),
        ("expert", [cell("b", "expert", 0, 1.0)], {}, "no episodes of planner"),
        ("again", seed("a", "planner", 1000.0), {}, "hold the same agent"),
    ):
        with pytest.raises(SystemExit):
            online_table.main([first, write(tmp_path / f"{name}.json", cells, **settings)])
        assert said in capsys.readouterr().err
    with pytest.raises(SystemExit):
        online_table.main([])
    assert "Expected files of sb3-said over-delays" in capsys.readouterr().err
