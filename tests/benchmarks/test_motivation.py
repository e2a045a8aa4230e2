"""The motivation experiment, tiny: what it writes is what it measured, and held-out episodes teach nobody."""

import json

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

import motivation

from sb3_said.offline import Dataset, write_dataset

ENV = "InvertedPendulum-v5"


@pytest.fixture(scope="module")
def log():
    """Episodes of small random actions, of different lengths."""
    env, rng = gym.make(ENV), np.random.default_rng(0)
    states, actions, ends, finals = [], [], [], []
    for seed in range(12):
        state, ended = env.reset(seed=seed)[0], False
        while not ended:
            states.append(state)
            actions.append(rng.uniform(-0.1, 0.1, 1))
            state, _, ended, _, _ = env.step(3 * actions[-1])
            ends.append(ended)
        finals.append(state)
    floats = [np.array(x, np.float32) for x in (states, actions, np.ones(len(ends)))]
    return Dataset(*floats, np.array(ends), np.array(ends), np.array(finals, np.float32))


def test_selected_and_held_out_trajectories_are_whole(log):
    training, held = motivation.split(log, 0.25, seed=1)
    assert len(held.lengths) == 3 and sorted([*training.lengths, *held.lengths]) == sorted(log.lengths)
    pieces = [motivation.split(log, 0.25, seed=1)[1], held]
    np.testing.assert_array_equal(*(piece.states for piece in pieces))
    for part in (training, held):
        assert part.ends.sum() == len(part.finals) and part.ends[-1]
        i = int(np.flatnonzero((log.finals == part.finals[0]).all(1))[0])
        start = log.lengths[:i].sum()
        np.testing.assert_array_equal(part.states[: part.lengths[0]], log.states[start : start + log.lengths[i]])
    with pytest.raises(ValueError, match="two are needed"):
        motivation.split(log.select(np.arange(12) == 3), 0.1, seed=0)
    assert len(motivation.split(log, 0.99, seed=0)[0].lengths) == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--dataset nowhere.npz", "nowhere.npz"),
        ("--dataset {log} --env Walker2d-v5", "is of InvertedPendulum-v5, and the task is Walker2d-v5"),
        ("--dataset {log} --env Nosuch-v1", "doesn't exist"),
        ("--dataset {log} --held-out 2", "--held-out is a part of the episodes, above 0 and below 1, got 2"),
        ("--dataset {log} --actor nowhere", "nowhere does not exist"),
        ("--dataset {log} --planner-kwargs depth=0", "depth"),
        ("--dataset {log} --planner-kwargs deepth=3", "The planner has no setting deepth; did you mean depth"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_trained(words, message, log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(motivation, "train", lambda *_: pytest.fail("it trains"))
    write_dataset(log, tmp_path / "log.npz", gym.make(ENV))
    with pytest.raises(SystemExit) as stop:
        motivation.main(["--env", ENV, *words.format(log=tmp_path / "log.npz").split()])
    assert stop.value.code in (1, 2) and message in capsys.readouterr().err


def test_it_measures_errors_and_returns_of_each_belief(log, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    write_dataset(log, tmp_path / "log.npz", gym.make(ENV))
    paths = ["--json", str(tmp_path / "m.json"), "--plot", str(tmp_path / "m.png"), "--folder", str(tmp_path)]
    tiny = (
        "--gradient-steps 3 --episodes 2 --delays 0 9 --held-out 0.3"
        " --planner-kwargs depth=1,d_model=32,batch_size=8,embed_known=False"
    )
    made = motivation.main(["--env", ENV, "--dataset", str(tmp_path / "log.npz"), *tiny.split(), *paths])
    written = json.loads((tmp_path / "m.json").read_text())
    assert written["errors"] == made["errors"] and written["planner"]["d_model"] == 32
    assert written["planner"]["embed_known"] is False
    assert (written["held_out"], written["eval_seed"], written["terminal_penalty"]) == (0.3, 10_000, None)
    assert written["dataset"] == [str(tmp_path / "log.npz")] and written["env"] == ENV
    assert {"command", "date", "machine", "versions"} < set(written["origin"])
    names = ["inpainted", "guessed", "rolled out", "regressed", "old observation"]
    players = [*names, "SAID", "one step", "SAID, inpainting", "guess alone", "cloning"]
    assert list(written["errors"]) == names and list(written["returns"]) == players
    for name, (now, later) in written["errors"].items():
        assert later > 0 and (now < 1e-6 or name == "regressed")  # which is asked at delay 0, too
    at_0 = {name: tuple(row[0]["returns"]) for name, row in written["returns"].items()}
    assert len({at_0[name] for name in names if name != "regressed"}) == 1
    assert (tmp_path / "m.png").read_bytes()[:4] == b"\x89PNG"
    assert "| error at delay | 0 | 9 |" in capsys.readouterr().out
    some = motivation.main([
        *("--env", ENV, "--dataset", str(tmp_path / "log.npz"), *tiny.split(), "--folder", str(tmp_path)),
        *("--players", "SAID", "inpainted", "--delays", "9"),
    ])  # fmt: skip
    assert list(some["errors"]) == ["inpainted", "old observation"]
    for given, message in (
        ("first_guess=none", "leave 'guessed' and 'guess alone' out"),
        ("mask=none", "inpaints no present"),
    ):
        with pytest.raises(SystemExit):
            motivation.main(["--dataset", str(tmp_path / "log.npz"), "--planner-kwargs", given])
        assert message in capsys.readouterr().err
    assert some["returns"] == {name: made["returns"][name][1:] for name in ("SAID", "inpainted")}
