"""README's table is what the raw files in results/ give: no number in it was typed."""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import online_table
import pytest

ROOT = Path(__file__).resolve().parents[2]


def rows_of(text: str, header: str) -> list[list[str]]:
    """Return the cells of the Markdown table with this header, from it on."""
    lines = text[text.index(header) :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_tables_are_those_of_the_raw_files(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    command = ["make", "-n", "-o", "install", "report", "PY=python", "PYTHON=none"]
    environ = {name: value for name, value in os.environ.items() if "MAKE" not in name}  # not those of `make test`
    printed = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=60).stdout
    python, script, *arguments = shlex.split(printed.replace("\\\n", " "))
    assert (python, script) == ("python", "benchmarks/online_table.py") and arguments[-2] == "--plot"
    page = Path("results/agents.md").read_text()
    seeds = online_table.main(arguments[:-2])
    header, _, *rows = rows_of(capsys.readouterr().out, "| task | agent |")
    found = {tuple(row[:2]): dict(zip(header, row, strict=True)) for row in rows}

    header, _, *rows = rows_of(page, "| task | agent |")
    assert len(rows) == 4 * 4
    online_table.show(online_table.each_by_itself(seeds))
    each = rows_of(page[page.index("## Each training seed") :], "| task | agent |")
    assert len(each) == 2 + 12 * 3
    assert each == rows_of(capsys.readouterr().out, "| task | agent |")
    for row in rows:
        assert [found[row[0], row[1]][name] for name in header] == row

    _, _, *rows = rows_of(Path("README.md").read_text(), "| return | | delay 0 |")
    assert len(rows) == 12
    task = ""
    for name, agent, *cells in rows:
        task = name or task
        expected = found[task, "SAID, paper" if agent == "paper" else agent]
        means = [expected[delay].split(" [")[0] for delay in "0 4 8 16".split()]
        assert cells[:4] == means
        if agent == "paper":
            mean = sum(float(each.split()[0].replace(",", "")) for each in means) / 4
            assert float(cells[4].replace(",", "")) == pytest.approx(mean, abs=0.5)
        else:
            assert cells[4] == expected["mean of fixed"]
