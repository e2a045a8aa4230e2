"""The table of offline agents: means over seeds, scores and parts that are kept, against numbers by hand."""

import json

import offline_table
import pytest


def row(*means):
    return [{"returns": [mean - 1, mean + 1]} for mean in means]


def cell(delay, mean, answer=None, sha256="a", age_error=0):
    result = None if mean is None else {"returns": [mean]}
    return {"delay": delay, "result": result, "answer": answer, "sha256": sha256, "age_error": age_error}


@pytest.fixture
def files(tmp_path):
    """Two seeds of motivation.py, and an agent of over-delays that has not played delay 8."""
    for seed, means in enumerate([(2000, 1000), (3000, 2000)]):
        players = {"inpainted": row(500, 50), "old observation": row(1, 2), "SAID": row(*means), "cloning": row(4, 2)}
        document = {"env": "Hopper-v5", "delays": [0, 8], "returns": players}
        (tmp_path / f"{seed}.json").write_text(json.dumps(document))
    (tmp_path / "dql.json").write_text(json.dumps({"env": "Hopper-v5", "cells": [cell(0, 1607.0), cell(8, None)]}))
    return [f"medium={tmp_path}/0.json", f"medium={tmp_path}/1.json", f"medium,DQL+SA={tmp_path}/dql.json"]


def test_seeds_are_joined_and_scored(files, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    found = offline_table.main([*files, "--plot", str(tmp_path)])
    rows = found["medium", "Hopper-v5"]
    assert list(rows) == ["belief-only", "SAID", "BC", "DQL+SA"]
    assert rows["SAID"] == {0: [[1999, 2001], [2999, 3001]], 8: [[999, 1001], [1999, 2001]]}
    lines = {line.split(" | ")[1]: line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]}
    low, high = -20.272305, 3234.3
    scores = [100 * (mean - low) / (high - low) for mean in (2000, 3000)]
    assert lines["SAID"][2] == f"{sum(scores) / 2:.1f} [{scores[0]:.1f}, {scores[1]:.1f}]"
    assert lines["SAID"][3] == "" and lines["SAID"][7] == "0.60"  # 1,500 of 2,500
    assert lines["SAID"][-1] == "84.6, 82.0, 83.5, 86.6 |"
    assert lines["DQL+SA"][2] == "50.0" and lines["DQL+SA"][7] == ""
    assert (tmp_path / "Hopper-v5-medium.png").read_bytes()[:4] == b"\x89PNG"


def test_only_one_agent_that_answers_in_one_way_is_a_row(tmp_path, capsys):
    file = tmp_path / "agent.json"
    file.write_text(json.dumps({"env": "Hopper-v5", "cells": [cell(0, 5.0), cell(0, 9.0, age_error=1)]}))
    assert offline_table.main([f"medium,x={file}"])["medium", "Hopper-v5"]["x"] == {0: [[5.0]]}
    for other in (cell(0, 7.0, answer="student"), cell(4, 7.0, sha256="b")):
        file.write_text(json.dumps({"env": "Hopper-v5", "cells": [cell(0, 5.0), other]}))
        with pytest.raises(SystemExit):
            offline_table.main([f"medium,x={file}"])
        assert "holds 2 agents or answers" in capsys.readouterr().err


def test_a_word_without_a_file_is_refused(capsys):
    with pytest.raises(SystemExit):
        offline_table.main(["medium"])
    assert "medium=hopper-medium-0.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "agent.json is no JSON"),
        ("[1]", "agent.json is neither of motivation.py nor of sb3-said over-delays"),
        ("{}", "agent.json is neither of motivation.py nor of sb3-said over-delays: KeyError('env')"),
        ('{"env": "Hopper-v5", "cells": [3]}', "agent.json is neither of motivation.py nor of"),
        ({"env": "Pendulum-v1", "cells": [cell(0, 5.0)]}, "is of Pendulum-v1, for which D4RL has no reference returns"),
        ({"env": "Hopper-v5", "cells": [cell(3, 5.0), cell(4, None)]}, "holds no returns of these agents at delays"),
    ],
)
def test_another_file_is_no_traceback(text, message, tmp_path, capsys):
    file = tmp_path / "agent.json"
    file.write_text(text if isinstance(text, str) else json.dumps(text))
    with pytest.raises(SystemExit):
        offline_table.main([f"medium,x={file}"])
    assert message in capsys.readouterr().err


def test_without_delay_0_no_part_is_kept(tmp_path, capsys):
    (tmp_path / "a.json").write_text(json.dumps({"env": "Hopper-v5", "cells": [cell(8, 1607.0)]}))
    offline_table.main([f"medium={tmp_path}/a.json"])
    assert "| Hopper-v5 medium | a |  |  | 50.0 |  |  |  |  |  |" in capsys.readouterr().out
