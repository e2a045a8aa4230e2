"""over_delays.py: what it plays, what it keeps, and what it does not play again."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from played_cells import by_cell, play
from scipy.stats import ttest_1samp
from small_run import ENV, write_run
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import DelayedObservationWrapper, DelayedSAC
from sb3_said.evaluation import Summary
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.offline.scores import REFERENCE_RETURNS
from sb3_said.zoo import evaluate, over_delays, playing
from sb3_said.zoo.cells import Cell, Results
from sb3_said.zoo.record import Record
from sb3_said.zoo.runs import load_run


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Training seeds of the same setting, in folders of one name."""
    return [write_run(tmp_path_factory.mktemp("seed") / "sadr" / "run", DelayedSAC, 1, seed=seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def changed(seeds: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of them, of a task that it changes."""
    run = Path(shutil.copytree(seeds[0], tmp_path_factory.mktemp("changed") / "run"))
    replace(Record.read(run), env_kwargs={"reset_noise_scale": 0.2}).write(run)
    return run


def count_plays(monkeypatch: pytest.MonkeyPatch, stop_after: int | None = None) -> list[tuple[str, Any]]:
    """Return a list that will hold the agent and delay of every cell played from now on."""
    played: list[tuple[str, Any]] = []
    original = playing.play

    def counted(cell: Cell, *how: Any) -> Summary:
        if len(played) == stop_after:
            raise KeyboardInterrupt
        played.append((cell.agent, cell.delay))
        return original(cell, *how)

    monkeypatch.setattr(playing, "play", counted)
    return played


def numbers(node: Any) -> list[float]:
    """Return the numbers of a tree of JSON, in order."""
    if isinstance(node, (dict, list)):
        parts = [node[key] for key in sorted(node)] if isinstance(node, dict) else node
        return [number for part in parts for number in numbers(part)]
    return [node] if isinstance(node, (int, float)) else []


def test_cells_are_what_evaluate_measures(
    said: Path, sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    delays, plot = ["0", "2", "UniformDelay(0, 1)"], tmp_path / "sub" / "plot.png"
    document = play(tmp_path / "sub" / "out.json", [f"any={said}", sadr], delays, "--plot", str(plot))
    out = capsys.readouterr().out
    cells, short = by_cell(document), f"{sadr.parent.name}/{sadr.name}"
    assert [*cells] == [
        (agent, delay) for agent in ("any planner", "any expert", short) for delay in (0, 2, "UniformDelay(0, 1)")
    ]
    for folder, delay, agents in (
        (said, "0", ["any planner", "any expert"]),
        (said, "UniformDelay(0, 1)", ["any planner", "any expert"]),
        (sadr, "UniformDelay(0, 1)", [short]),
    ):
        target = tmp_path / "evaluation.json"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # another delay than the trained one
            evaluate.main([str(folder), "--delay", delay, "--json", str(target), "--episodes", "3",
                           "--latency-calls", "0", "--device", "cpu"])  # fmt: skip
        for agent, result in zip(agents, json.loads(target.read_text())["results"], strict=True):
            cell = cells[agent, int(delay) if delay.isdigit() else delay]
            # Side by side, actions round otherwise than one by one
            np.testing.assert_allclose(numbers({key: result[key] for key in cell}), numbers(cell), 1e-4, 1e-6)
    assert cells[short, 2] is None
    assert f"{short} cannot play delay 2: it was built for delays 0..1." in out
    table = {
        row.split("|")[1].strip(): [x.strip() for x in row.split("|")[2:-1]] for row in out.splitlines() if "|" in row
    }
    assert table["return under delay"] == [*delays, "mean of fixed", "mean of random"]
    assert table[short][1] == "-" and table[short][3].endswith(", 1 of 2")
    mean = np.mean([cells["any planner", 0]["returns"], cells["any planner", 2]["returns"]])
    assert table["any planner"][3].startswith(f"{mean:.1f} [")
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_runs_of_one_label_play_each_its_own_delay(
    said: Path, sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = write_run(tmp_path / "random", DelayedSAC, (0, 1))
    runs = [f"each={said}", f"each={sadr}", f"each={random}", f"one={sadr}"]
    document = play(tmp_path / "out.json", runs, ["0", "1", "2", "EpisodeDelay(0,1)"])
    files = {(cell["agent"], cell["delay"]): Path(cell["file"]).parent for cell in document["cells"] if cell["result"]}
    assert files == {
        ("each planner", 2): said, ("each expert", 2): said, ("each", 1): sadr, ("each", "EpisodeDelay(0,1)"): random,
        ("one", 0): sadr, ("one", 1): sadr, ("one", "EpisodeDelay(0,1)"): sadr,
    }  # fmt: skip
    cells = by_cell(document)
    assert cells["each", 1] == cells["one", 1]  # the same file, played once or twice
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| each  "))
    assert [word.strip() == "-" for word in row.split("|")[2:5]] == [True, False, True]  # delays 0, 1, 2


@pytest.mark.parametrize("answer", ["planner", "expert"])
def test_one_answer_alone_can_be_asked_for(said: Path, sadr: Path, tmp_path: Path, answer: str) -> None:
    document = play(tmp_path / "out.json", [f"a={said}", f"b={sadr}"], ["1"], "--answer", answer)
    assert [*by_cell(document)] == [(f"a {answer}", 1), ("b", 1)]  # another algorithm's agent has but one


def test_what_was_played_is_not_played_again(said: Path, sadr: Path, tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "out.json"
    played = count_plays(monkeypatch, stop_after=4)
    with pytest.raises(SystemExit) as exit_info:
        play(file, [said, sadr], ["0", "1", "2"])
    assert exit_info.value.code == 130
    assert len(by_cell(json.loads(file.read_text()))) == 4 + 1  # and the one that cannot be played
    monkeypatch.undo()
    before, rest = by_cell(json.loads(file.read_text())), count_plays(monkeypatch)
    document = play(file, [said, sadr], ["0", "1", "2"])
    assert len(rest) == 4 and not set(rest) & set(played)
    assert before.items() <= by_cell(document).items()
    assert [cell["origin"] for cell in document["cells"]] == [0, 0, 0, 0, 1, 1, 1, 1, None]
    assert len(document["origins"]) == 2

    written = file.read_bytes()
    play(file, [said, sadr], ["0", "1", "2"])
    assert len(rest) == 4 and file.read_bytes() == written
    # A delay and an agent are known however they are written, and a smaller call forgets nothing.
    part = play(file, [f"other={sadr}"], ["FixedDelay(1)"])
    assert len(rest) == 4 and len(part["cells"]) == 9 + 1
    assert by_cell(part)["other", 1] == document["cells"][-2]["result"]
    for written_so in ("UniformDelay(0, 1)", "UniformDelay(low=0,high=1)"):
        play(file, [sadr], [written_so])
        assert len(rest) == 5


def test_without_runs_what_was_played_is_shown(
    said: Path, sadr: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    file, plot = tmp_path / "out.json", tmp_path / "plot.png"
    runs = [f"any={said}", f"one={sadr}", f"again={sadr}"]
    play(file, runs, ["0", "UniformDelay(0, 1)", "1", "2"])
    full, written, played = capsys.readouterr().out, file.read_bytes(), count_plays(monkeypatch)

    def show(*words: str) -> list[list[str]]:
        over_delays.main(["--json", str(file), *words])
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
        return [[word.strip() for word in line.split("|")[1:-1]] for line in lines]

    assert show() == [[word.strip() for word in line.split("|")[1:-1]] for line in full.splitlines() if "|" in line]
    header, _, first, second = show("--rows", "one", "any expert", "--delays", "1", "UniformDelay(low=0, high=1)",
                                    "--plot", str(plot))  # fmt: skip
    assert header[1:3] == ["1", "UniformDelay(low=0, high=1)"]
    cells = by_cell(json.loads(written))
    for row, agent in ((first, "one"), (second, "any expert")):
        assert row[0] == agent
        for column, delay in ((1, 1), (2, "UniformDelay(0, 1)")):
            assert row[column].startswith(f"{np.mean(cells[agent, delay]['returns']):.1f} [")
    assert plot.read_bytes()[:4] == b"\x89PNG"
    assert show("--rows", "one=a short name")[2][0] == "a short name"
    two = json.loads(written)  # played by two commands, which wrote the process in two ways
    next(cell for cell in two["cells"] if cell["delay"] == "UniformDelay(0, 1)")["delay"] = "UniformDelay(0,1)"
    file.write_text(json.dumps(two))
    assert len(show()[0]) == len(show("--delays", "0", "UniformDelay(0, 1)", "1", "2")[0])
    file.write_bytes(written)
    play(file, runs, ["0", "1"], "--rows", "again")
    assert not played  # an agent under two labels is known under both
    assert file.read_bytes() != written and by_cell(json.loads(file.read_text())) == cells
    for words, message in (
        (["--rows", "x"], "the rows are any planner"),
        (["--delays", "16"], "holds nothing of the delays [16]"),
        (["--json", str(plot) + "x"], "not exist"),
    ):
        with pytest.raises(SystemExit):
            show(*words)
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        over_delays.main([str(said), "--json", str(file)])
    assert "--delays is missing" in capsys.readouterr().err


def test_what_was_played_is_shown_where_nothing_can_be_written(sadr: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    document = play(tmp_path / "out.json", [sadr], ["1"])
    monkeypatch.setattr(over_delays, "check_writable", lambda path: pytest.fail(f"{path} is to be written"))
    capsys.readouterr()
    over_delays.main(["--json", str(tmp_path / "out.json")])
    mean = np.mean(document["cells"][0]["result"]["returns"])
    assert f"| {document['cells'][0]['agent']} |" in (out := capsys.readouterr().out) and f"{mean:,.1f}" in out


def test_what_is_shown_is_what_was_asked_for(said: Path, tmp_path: Path, capsys) -> None:
    file = tmp_path / "out.json"
    play(file, [f"a={said}"], ["1"], "--age-errors", "-1", "1")
    capsys.readouterr()
    over_delays.main(["--json", str(file), "--answer", "expert", "--age-errors", "1"])
    out = capsys.readouterr().out
    assert "a expert" in out and "age +1" in out and "planner" not in out and "age -1" not in out
    with pytest.raises(SystemExit):
        over_delays.main(["--json", str(file), "--episodes", "7", "--workers", "2"])
    assert "--episodes, --workers: without runs to play this has no effect" in capsys.readouterr().err


def test_cells_of_another_version_are_told_in_one_line(tmp_path: Path, capsys) -> None:
    document = {"env": ENV, "n_episodes": 2, "seed": 3, "origins": [], "cells": [{"x": 1}]}
    (tmp_path / "other.json").write_text(json.dumps(document))
    with pytest.raises(SystemExit):
        over_delays.main(["--json", str(tmp_path / "other.json")])
    assert "is no file of over-delays" in capsys.readouterr().err


def test_a_changed_agent_is_played_again(said: Path, seeds: list[Path], tmp_path: Path, monkeypatch, capsys) -> None:
    file, folder = tmp_path / "out.json", Path(shutil.copytree(seeds[0], tmp_path / "d1"))
    old = play(file, [f"a={said}", f"b={folder}"], ["0", "1"])
    shutil.copytree(seeds[1], folder, dirs_exist_ok=True)
    played = count_plays(monkeypatch)
    assert "dropped" not in capsys.readouterr().out
    new = play(file, [f"b={folder}"], ["1"])
    assert played == [("b", 1)] and "2 results of b are dropped: " in capsys.readouterr().out
    # What the agent did before it changed is gone, also where it was not asked for now.
    assert sorted(by_cell(new), key=str) == sorted(
        [(f"a {w}", d) for w in ("expert", "planner") for d in (0, 1)] + [("b", 1)]
    )
    assert by_cell(new)["b", 1] != by_cell(old)["b", 1]
    monkeypatch.chdir(tmp_path)
    shutil.copytree(seeds[0], folder, dirs_exist_ok=True)
    again = play(file, ["b=d1"], ["1"])  # the same by another path
    assert "1 results of b are dropped: " in capsys.readouterr().out and [*by_cell(again)].count(("b", 1)) == 1
    assert by_cell(new)["a expert", 0] == by_cell(old)["a expert", 0]


def test_an_agent_by_another_label_stays_in_the_row_of_its_seeds(seeds: list[Path], tmp_path: Path) -> None:
    row = play(tmp_path / "out.json", [f"both={run}" for run in seeds], ["0"])
    again = play(tmp_path / "out.json", [f"alone={seeds[1]}"], ["0"])
    alone, *both = again["cells"]
    assert both == row["cells"] and alone == {**both[1], "agent": "alone"}


def test_paths_are_of_the_results_folder_wherever_a_call_is_made(
    sadr: Path, seeds: list[Path], tmp_path: Path, monkeypatch
) -> None:
    run, file = tmp_path / "logs" / "run", Path("results", "out.json")
    monkeypatch.chdir(tmp_path)
    for folder, seed in zip((tmp_path, tmp_path / "logs"), seeds, strict=True):  # a run that goes on between two calls
        shutil.copytree(seed, run, dirs_exist_ok=True)
        monkeypatch.chdir(folder)
        document = play(Path(os.path.relpath(tmp_path / file)), [f"a={os.path.relpath(run)}", f"b={sadr}"], ["0"])
    paths = [Path(cell["file"]) for cell in document["cells"]]
    assert paths == [Path("..", "logs", "run", f"{ENV}.zip"), sadr / f"{ENV}.zip"]  # an absolute one stays
    assert Results(Path("..", file)).cells[0].file == str(Path("run", f"{ENV}.zip"))


def test_an_agent_of_another_folder_is_no_changed_one(seeds: list[Path], tmp_path: Path, monkeypatch) -> None:
    """Both are named by the same relative path, and may have the same label: then they are training seeds."""
    for labels in (("first", "second"), ("same", "same")):
        file = tmp_path / f"{labels[0]}.json"
        for seed, label in zip(seeds, labels, strict=True):
            monkeypatch.chdir(seed.parent)
            document = play(file, [f"{label}=run"], ["0"])
        assert [cell["agent"] for cell in document["cells"]] == [*reversed(labels)]


def test_calls_that_add_to_one_file_at_a_time_lose_nothing(said: Path, sadr: Path, tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "out.json"
    original = playing.play

    def meanwhile(cell: Cell, *how: Any) -> Summary:
        if cell.agent == "one planner":
            with monkeypatch.context() as patch:
                patch.setattr(playing, "play", original)
                play(file, [f"other={sadr}"], ["0"])
                play(file, [f"one={said}"], ["1"], "--answer", "expert")
        return original(cell, *how)

    monkeypatch.setattr(playing, "play", meanwhile)
    document = play(file, [f"one={said}"], ["1"])
    assert {*by_cell(document)} == {("one planner", 1), ("one expert", 1), ("other", 0)}
    for cell in document["cells"]:
        words = document["origins"][cell["origin"]]
        assert words.keys() >= {"command", "date"} and cell["result"]["returns"]
    monkeypatch.undo()
    alone = play(tmp_path / "alone.json", [f"one={said}", f"other={sadr}"], ["0", "1"])
    assert by_cell(document).items() <= by_cell(alone).items()


def test_runs_of_one_folder_name_need_labels(seeds: list[Path], tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [*seeds], ["1"])
    assert f"would both be called sadr/run: give each its own label, as in LABEL={seeds[1]}" in capsys.readouterr().err


def test_a_table_without_a_number_has_no_interval_and_no_plot(
    said: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    play(tmp_path / "out.json", [said], ["9"], "--plot", str(tmp_path / "plot.png"))
    out = capsys.readouterr().out
    assert "Nothing was played that" in out and "95 %" not in out and not (tmp_path / "plot.png").exists()


def test_a_delay_written_in_two_ways_is_played_once(
    sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second column of it would count as another training seed."""
    words = ["UniformDelay(0, 1)", "1", "UniformDelay(0,1)", "FixedDelay(1)", "UniformDelay(low=0, high=1)"]
    file = tmp_path / "out.json"
    assert [cell["delay"] for cell in play(file, [sadr], words)["cells"]] == ["UniformDelay(0, 1)", 1]
    capsys.readouterr()
    over_delays.main(["--json", str(file), "--delays", "UniformDelay(0,1)", "1"])
    assert "training seeds" not in capsys.readouterr().out


def test_a_planner_of_one_delay_plays_no_other(said: Path) -> None:
    run = load_run(said, device="cpu")
    policy: Any = run.model.policy
    planner = policy.planner
    planner.config = replace(planner.config, mask="fixed", present="inpainted")
    found = {delay: over_delays.obstacle(run, "planner", delay) for delay in (1, 2, "UniformDelay(0, 2)")}
    assert found.pop(2) is None
    assert all(reason.startswith("A planner with mask='fixed' plans at age 2 only") for reason in found.values())
    assert over_delays.obstacle(run, "expert", 1) is None and over_delays.obstacle(run, "student", 1)
    told = {error: over_delays.obstacle(run, "planner", 2, error) for error in (-2, -1, 0, 1)}
    assert [error for error, reason in told.items() if reason is None] == [0, 1]  # cut at the largest
    assert over_delays.obstacle(run, "expert", 2, -1) is None


def test_the_expert_of_a_planner_of_one_delay_plays_all(said: Path, tmp_path: Path) -> None:
    model: Any = load_run(said, device="cpu").model
    model.policy.make_planner(replace(model.policy.planner.config, mask="fixed", present="inpainted"))
    model.policy.planner_updates.fill_(1.0)
    model.save(tmp_path / "fixed.zip")
    cells = by_cell(play(tmp_path / "out.json", [f"x={tmp_path / 'fixed.zip'}"], ["1", "2"], "--env", ENV))
    assert {name for name, result in cells.items() if result} == {("x planner", 2), ("x expert", 1), ("x expert", 2)}


def test_training_seeds_of_one_label_are_one_row(
    sadr: Path, seeds: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They play every delay; the intervals are over the seeds, by Student's t, also when the file is shown again."""
    pytest.importorskip("matplotlib")
    file, plot = tmp_path / "out.json", tmp_path / "plot.png"
    runs = [f"any={run}" for run in (sadr, *seeds)]
    document = play(file, [*runs, f"one={sadr}"], ["0", "1"])
    capsys.readouterr()
    titles: list[str] = []
    monkeypatch.setattr(over_delays.plots, "save", lambda ax, path: titles.append(ax.figure.get_suptitle()))
    over_delays.main(["--json", str(file), "--plot", str(plot), "--rows", "any=three seeds", "one"])
    out = capsys.readouterr().out
    rows = {
        line.split("|")[1].strip(): line.split("|")[2:-1]
        for line in out.partition("The same agents, with training seeds drawn")[0].splitlines()
        if line.startswith("| ") and "---" not in line
    }
    assert [*rows] == ["return under delay", "three seeds", "one"]
    returns = {
        (cell["file"], cell["delay"]): cell["result"]["returns"] for cell in document["cells"] if cell["agent"] == "any"
    }
    assert len(returns) == 6
    for column, delays in enumerate([(0,), (1,), (0, 1)]):
        means = [
            np.mean([played for (one, delay), played in returns.items() if one == run and delay in delays])
            for run in dict.fromkeys(one for one, _ in returns)
        ]
        t = ttest_1samp(means, 0.0).confidence_interval()
        assert rows["three seeds"][column].strip() == f"{np.mean(means):.1f} [{t.low:.1f}, {t.high:.1f}]"
    assert "95 % intervals over 3 training seeds (Student's t), or 3 episodes (Student's t)" in out
    assert "95 % intervals over 3 training seeds of 3 episodes (stratified bootstrap)" in out
    assert f"three seeds: 3 agents, {', '.join(dict.fromkeys(one for one, _ in returns))}" in out
    assert "one: 1 agents" not in out
    assert [title.replace("\n", " ") for title in titles] == [f"{ENV} under delay: means of 3 episodes, 95 % intervals"]


def test_other_statistics_of_vec_normalize_make_another_agent(sadr: Path, tmp_path: Path, monkeypatch) -> None:
    run = Path(shutil.copytree(sadr, tmp_path / "run"))
    env = VecNormalize(DummyVecEnv([lambda: DelayedObservationWrapper(gym.make(ENV), 1)]), norm_obs=False)
    agent = run / f"{ENV}.zip"
    played = count_plays(monkeypatch)
    play(tmp_path / "out.json", [f"x={run}"], ["1"])
    save_normalization(normalization_file(agent), env)
    for _ in range(2):
        play(tmp_path / "out.json", [f"x={run}"], ["1"])
    env.ret_rms.mean += 1.0
    save_normalization(normalization_file(agent), env)
    document = play(tmp_path / "out.json", [f"x={run}"], ["1"])
    assert len(played) == 3 and len(document["cells"]) == 1


def test_a_path_with_an_equals_sign_is_no_label(sadr: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sadr, Path("lr=0.1") / "s0")
    document = play(tmp_path / "out.json", ["lr=0.1/s0", "x=lr=0.1/s0"], ["1"])
    assert [cell["agent"] for cell in document["cells"]] == ["lr=0.1/s0", "x"]


def test_rows_of_two_labels_are_two(said: Path, sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [f"x={said}", f"x planner={sadr}"], ["1"])
    assert "Agents of two labels would both be the row 'x planner'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("runs", "more", "message"),
    [
        (["a={said}", "a={said}"], [], "twice: give it other training seeds"),
        (["a={said}"], ["--rows", "a planner=x", "a expert=x"], "two rows alike"),
        (["{said}", "x={nowhere}"], [], "does not exist"),
        (["{said}"], ["--delays", "-1"], "whole number of control steps >= 0"),
        (["{said}"], ["--workers", "0"], "must be at least 1"),
        (["{said}"], ["--seed", "1"], "give another --json"),
        (
            ["{said}"],
            ["--answer", "student"],
            "There is nothing to play: {said}/{env}.zip, which cannot answer as student.",
        ),
        (["{sadr}"], ["--answer", "expert"], "--answer expert has no effect, as no run is of SAID"),
    ],
)
def test_what_cannot_be_done_is_said(
    said: Path,
    sadr: Path,
    tmp_path: Path,
    runs: list[str],
    more: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "out.json"
    settings = {"env": ENV, "n_episodes": 3, "seed": 10_000, "deterministic": True}
    file.write_text(json.dumps({**settings, "origins": [], "cells": []}))
    paths = {"said": said, "sadr": sadr, "nowhere": tmp_path / "nowhere", "env": ENV}
    with pytest.raises(SystemExit) as exit_info:
        play(file, [run.format(**paths) for run in runs], ["0"], *more)
    assert exit_info.value.code == 2 and message.format(**paths) in capsys.readouterr().err


def test_who_and_what_is_not_played_is_said(
    said: Path, sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = play(tmp_path / "out.json", [f"each={said}", f"each={sadr}"], ["1", "0"], "--answer", "expert")
    out = capsys.readouterr().out
    assert [*by_cell(document)] == [("each", 1)]
    assert f"Left out: {said}/{ENV}.zip, whose delay 2 is none of --delays; other runs of each have another" in out
    assert "Left out: delay 0, which is no run's own;" in out and out.count("Left out") == 2


@pytest.mark.parametrize("text", ["{}", "[1]", "3", "{"])
def test_another_file_is_no_table(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(SystemExit) as exit_info:
        over_delays.main(["--json", str(tmp_path / "other.json")])
    assert exit_info.value.code == 2 and "other.json is no file of over-delays" in capsys.readouterr().err


def test_runs_of_two_tasks_are_refused(sadr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    env = DelayedObservationWrapper(gym.make("Pendulum-v1"), delay=1)
    other = tmp_path / "other"
    DelayedSAC("MultiInputPolicy", env, buffer_size=10, device="cpu").save(other / "Pendulum-v1.zip")
    Record("sadr", "Pendulum-v1", 0, 1).write(other)
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [sadr, other], ["0"])
    assert "several tasks cannot be compared" in capsys.readouterr().err


def test_no_reference_return_is_of_a_changed_task(
    sadr: Path, changed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(REFERENCE_RETURNS, "invertedpendulum", (0.0, 1000.0))
    for words in ([f"plain={sadr}", f"changed={changed}"], []):  # and where a file alone says so
        over_delays.main(
            [*words, *("--delays 1 --episodes 2 --json".split() if words else ["--json"]), str(tmp_path / "o.json")]
        )
        shown = capsys.readouterr().out
        assert "changed" in shown.split("normalised score")[0]
        scores = shown.split("normalised score")[1]
        assert "| plain" in scores and "| changed" not in scores
    over_delays.main(["--rows", "changed", "--json", str(tmp_path / "o.json")])
    assert "normalised score" not in capsys.readouterr().out  # not even its header
    assert (load_run(sadr).scored_task, load_run(changed).scored_task) == (ENV, "")


def test_an_agent_that_reads_no_age_is_told_none_wrong(said: Path, tmp_path: Path) -> None:
    model = DelayedSAC("MlpPolicy", gym.make(ENV), buffer_size=10, device="cpu")
    model.save((plain := tmp_path / "plain") / f"{ENV}.zip")
    Record("sac", ENV, 0, None).write(plain)
    words = [f"a={said}", f"b={plain}"]
    cells = play(tmp_path / "out.json", words, ["0"], "--answer", "expert", "--age-errors", "1")["cells"]
    found = {(cell["agent"], cell["age_error"]): cell["obstacle"] for cell in cells}
    no_age = "it reads no age, so none can be told wrong"
    assert found == {("a expert", 0): None, ("b", 0): None, ("a expert", 1): None, ("b", 1): no_age}


def test_runs_of_a_task_that_one_of_them_changes_are_no_seeds_of_one_setting(
    sadr: Path, changed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        play(tmp_path / "out.json", [f"x={sadr}", f"x={changed}"], ["1"])
    assert "The runs of x change their task in different ways" in capsys.readouterr().err
    play(tmp_path / "out.json", [f"x={sadr}", f"y={changed}"], ["1"])
    assert 'not the same task, beside the delay: x has {}; y has {"env_kwargs"' in capsys.readouterr().out


def test_an_age_that_is_told_wrong(said: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    play(tmp_path / "out.json", [f"any={said}"], ["1"], "--answer", "expert")
    document = play(tmp_path / "out.json", [f"any={said}"], ["1"], "--answer", "expert", "--age-errors", "-2", "1")
    cells = {cell["age_error"]: cell["result"] for cell in document["cells"]}
    assert [*cells] == [0, -2, 1]
    assert cells[-2]["returns"] != cells[0]["returns"] != cells[1]["returns"]
    out = capsys.readouterr().out
    assert "2 of 3 cells to play" in out and "| 1, age -2" in out and "| 1, age +1" in out
    assert f"any expert: worst tenth of returns {min(cells[0]['returns']):.1f}" in out

    class Ages:
        """Notes the ages that it is told, and acts at random."""

        told: ClassVar[list[float]] = []

        def __init__(self, model):
            self.observation_space, self.action_space = model.observation_space, model.action_space

        def predict(self, observation, **_):
            self.told += observation["delay"].ravel().tolist()
            return np.zeros((len(observation["delay"]), *self.action_space.shape), np.float32), None

    run = load_run(said, delay=1)
    for error, expected in ((0, [0, 1, 1]), (-2, [0, 0, 0]), (1, [1, 2, 2]), (5, [2, 2, 2])):
        Ages.told.clear()
        replace(run, model=Ages(run.model)).play(1, 0, age_error=error)
        assert Ages.told[:3] == expected


def test_an_agent_that_is_told_no_age_cannot_be_told_a_wrong_one(tmp_path: Path) -> None:
    DelayedSAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=10, device="cpu").save(tmp_path / "plain.zip")
    run = load_run(tmp_path / "plain.zip", algo="sac", env_id="Pendulum-v1")
    with pytest.raises(ValueError, match="reads no age"):
        run.play(1, 0, age_error=1)
