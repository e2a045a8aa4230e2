"""The page on robots runs as it is written."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "real_time.md"
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.mark.parametrize("snippet", SNIPPETS)
def test_a_snippet_is_python(snippet):
    compile(snippet, PAGE, "exec")


def test_the_delay_is_found_in_a_log_file(tmp_path, monkeypatch):
    (snippet,) = (each for each in SNIPPETS if "estimate_delay" in each)
    rng = np.random.default_rng(0)
    states, actions = np.zeros((600, 11)), rng.normal(size=(600, 2))
    for t in range(599):
        states[t + 1] = 0.9 * states[t] + 0.1 * actions[t] @ np.ones((2, 11)) + 0.01 * rng.normal(size=11)
    log = np.hstack([states[:-3], actions[3:]])  # observations 3 steps old
    np.savetxt(tmp_path / "log.csv", log, delimiter=",", header="angles, velocities, torques", comments="")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(snippet, names)
    assert names["found"].delay == 3 and names["found"].confidence > 0.9
