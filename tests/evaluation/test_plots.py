"""Plots are drawn from the files that SB3 writes, and say what is missing."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_said.evaluation import Summary, confidence_interval, plots

PNG = b"\x89PNG"


@pytest.fixture
def png(tmp_path: Path) -> Path:
    pytest.importorskip("matplotlib")
    return tmp_path / "plots" / "plot.png"


def drawn(path: Path) -> bool:
    return path.read_bytes()[:4] == PNG and path.stat().st_size > 5000


def write_monitor(folder: Path, rank: int, rows: list[tuple[float, int, float]]) -> None:
    lines = ['#{"t_start": 0.0, "env_id": "None"}', "r,l,t", *(f"{r},{n},{t}" for r, n, t in rows)]
    (folder / f"{rank}.monitor.csv").write_text("\n".join(lines) + "\n")


def test_learning_curve(tmp_path: Path, png: Path) -> None:
    with pytest.raises(ValueError, match="neither"):
        plots.plot_learning_curve(tmp_path)
    write_monitor(tmp_path, 0, [(10.0 + i, 50, 2.0 * i) for i in range(30)])
    write_monitor(tmp_path, 1, [(-5.0, 20, 1.5 + 2.0 * i) for i in range(30)])
    np.savez(tmp_path / "evaluations.npz", timesteps=[500, 1000], results=np.random.default_rng(0).normal(size=(2, 5)))
    ax = plots.plot_learning_curve(tmp_path)
    steps, returns = ax.lines[0].get_data()
    # Two environments side by side, in episodes of 50 and 20 steps.
    np.testing.assert_array_equal(steps[:6], [40, 80, 100, 120, 160, 200])
    np.testing.assert_array_equal(returns[:6], [-5.0, -5.0, 10.0, -5.0, -5.0, 11.0])
    mean_steps, means = plots.plot_learning_curve(tmp_path, window=3).lines[1].get_data()
    np.testing.assert_array_equal(mean_steps, steps[2:])
    np.testing.assert_allclose(means, [returns[k : k + 3].mean() for k in range(58)])
    with np.load(tmp_path / "evaluations.npz") as file:
        interval = confidence_interval(file["results"][0])
    (band,) = ax.collections[0].get_paths()
    bounds = {round(interval.low, 6), round(interval.high, 6)}
    assert {round(y, 6) for x, y in band.vertices if x == 500} == bounds
    plots.save(ax, png)
    assert drawn(png)


def test_the_learning_curve_of_a_resumed_run(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    write_monitor(tmp_path, 0, [(1.0, 10, 5.0), (2.0, 10, 9.0), (3.0, 30, 4.0)])  # whose clock began anew
    steps, returns = plots.plot_learning_curve(tmp_path).lines[0].get_data()
    np.testing.assert_array_equal(steps, [10, 20, 50])
    np.testing.assert_array_equal(returns, [1.0, 2.0, 3.0])


def test_returns_of_planner_and_expert(png: Path) -> None:
    rng = np.random.default_rng(0)
    rows = [Summary.from_episodes(name, rng.normal(size=n), [1] * n) for name, n in (("planner", 20), ("expert", 1))]
    ax = plots.plot_returns(rows)
    assert [label.get_text().split("\n")[0] for label in ax.get_xticklabels()] == ["planner", "expert"]
    plots.save(ax, png)
    assert drawn(png)


def test_return_over_delay(png: Path) -> None:
    table: dict[str, dict[int | str, Any]] = {
        "any": {"WIFI_20MS": [[3.0, 3.5], [5.0, 4.5]], 8: [1.0, 3.0], 0: [10.0]},
        "short": {0: [7.0, 9.0], "RandomWalkDelay(0, 16, move_prob=0.1)": [-6.0, -6.0]},
    }
    fixed, random = plots.plot_over_delays(table, "Hopper-v5 under delay")
    assert fixed.figure.get_suptitle() == "Hopper-v5 under delay"
    lines = [container.lines[0].get_xydata().tolist() for container in fixed.containers]
    assert lines == [[[0.0, 10.0], [8.0, 2.0]], [[0.0, 8.0]]]  # in the order of delays, whatever that of the table
    points = [container.lines[0].get_xydata() for container in random.containers]
    assert [np.round(p[:, 0]).tolist() for p in points] == [[0.0], [1.0]]  # under the tick of their delay
    assert [p[:, 1].tolist() for p in points] == [[4.0], [-6.0]]
    interval = confidence_interval(table["any"]["WIFI_20MS"])  # of two training seeds
    (bar,) = random.containers[0].lines[2][0].get_segments()
    np.testing.assert_allclose(bar[:, 1], [interval.low, interval.high])
    labels = [label.get_text() for label in random.get_xticklabels()]
    assert labels == ["WIFI_20MS", "RandomWalkDelay\n(0, 16,\nmove_prob=0.1)"]
    assert fixed.get_ylim() == random.get_ylim()
    assert fixed.get_ylim()[0] < -6.0 and fixed.get_ylim()[1] > 10.0  # markers of either panel are inside both
    plots.save(fixed, png)
    assert drawn(png)
    for n in (4, 7, 8, 20):
        (ax,) = plots.plot_over_delays({f"agent {i}": {0: [1.0, 2.0]} for i in range(n)})
        assert len({container.lines[0].get_color() for container in ax.containers}) == n
    only_fixed = {agent: {d: s for d, s in row.items() if isinstance(d, int)} for agent, row in table.items()}
    assert len(plots.plot_over_delays(only_fixed)) == 1
    with pytest.raises(ValueError, match="Nothing was played"):
        plots.plot_over_delays({"any": {}})


@pytest.mark.parametrize("n_delays", [1, 3])
def test_nothing_that_is_written_leaves_the_figure(n_delays: int) -> None:
    """With the labels that commands give by default."""
    pytest.importorskip("matplotlib")
    run = "said/HalfCheetah-v5-delay4-seed1_1"
    table = {f"{run} {who}": {d: [1.0, 2.0] for d in range(n_delays)} for who in ("planner", "expert")}
    long = f"HalfCheetah-v5 under delay {'DroppedPackets(12, p=0.1), ' * 2}: means of 50 episodes, 95 % intervals"
    (over,) = plots.plot_over_delays(table, long)
    names = ["planner, in real time", "planner, latency ignored", "expert, in real time"]
    for ax in (over, plots.plot_returns([Summary.from_episodes(name, [1.0, 2.0], [1, 1]) for name in names])):
        figure = ax.figure
        figure.canvas.draw()
        texts = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
        for extent in (text.get_window_extent() for text in texts):
            assert figure.bbox.x0 <= extent.x0 and extent.x1 <= figure.bbox.x1
        ticks = [text.get_window_extent() for text in ax.get_xticklabels()]
        assert all(left.x1 <= right.x0 for left, right in itertools.pairwise(ticks))


def test_planner_errors(tmp_path: Path, png: Path) -> None:
    progress = tmp_path / "progress.csv"
    progress.write_text(
        "rollout/ep_rew_mean,planner/present_error_d4,planner/present_error_mlp_d4,planner/action_error_d4,"
        "planner/action_error_mlp_d4,planner/n_updates\n"
        "1.0,,,,,\n"
        ",0.9,0.5,0.4,0.3,100\n"
        ",,,,,150\n"
        ",0.6,0.4,0.3,0.2,200\n"
        "2.0,,,,,200\n"
        ",0.5,0.4,0.2,0.2,100\n"  # a second training counts from zero again
    )
    (tmp_path / "progress_500.csv").write_text("planner/action_error_d4,planner/n_updates\n0.15,200\n")
    left, right = plots.panels(2)
    assert len(plots.plot_planner_errors(tmp_path, "present", left).lines) == 2
    plots.plot_planner_errors(tmp_path, "action", right)
    np.testing.assert_array_equal(right.lines[0].get_xydata(), [[100, 0.4], [200, 0.3], [300, 0.2], [400, 0.15]])
    assert [line.get_label() for line in right.lines] == ["planner, delay 4", "MLP, delay 4"]
    plots.save(left, png)
    assert drawn(png)
    (tmp_path / "progress_500.csv").unlink()
    progress.write_text("rollout/ep_rew_mean\n1.0\n")
    with pytest.raises(ValueError, match="has no progress"):
        plots.plot_planner_errors(tmp_path, "present")


def test_errors_of_many_delays_are_thinned(tmp_path: Path) -> None:
    names = [f"planner/present_error{who}_d{d}" for d in range(17) for who in ("", "_mlp")]
    (tmp_path / "progress.csv").write_text(
        ",".join(["planner/n_updates", *names]) + "\n" + ",".join(["100"] + ["0.5"] * 34)
    )
    lines = plots.plot_planner_errors(tmp_path, "present").lines
    assert [line.get_label() for line in lines[::2]] == [f"planner, delay {d}" for d in (0, 4, 8, 12, 16)]
    assert len({line.get_color() for line in lines}) == 5


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"sb3_said\[plots\]"):
        plots.panels()
