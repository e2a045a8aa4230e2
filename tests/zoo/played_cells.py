"""Cells that over_delays.py played."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_said.zoo import over_delays


def play(file: Path, runs: list[str | Path], delays: list[str], *more: str) -> dict[str, Any]:
    """Call the script, and return what it wrote."""
    words = [*map(str, runs), "--delays", *delays, "--json", str(file), "--episodes", "3", "--device", "cpu", *more]
    over_delays.main(words)
    return json.loads(file.read_text())


def by_cell(document: dict[str, Any]) -> dict[tuple[str, Any], Any]:
    return {(cell["agent"], cell["delay"]): cell["result"] for cell in document["cells"]}
