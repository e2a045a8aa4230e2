"""sb3-said decide: the new file decides as it says, and nothing else has changed."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

import torch as th
from small_run import ENV, TINY_PLANNER, write_run
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC
from sb3_said.evaluation import collect_observations
from sb3_said.files.archive import save_tree
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.zoo import decide, evaluate
from sb3_said.zoo.answer import EXPERT_FOLDER
from sb3_said.zoo.record import Record

NEW = ["--temperature", "0.5", "--n-candidates", "3", "--choice-factor", "2", "--sampling-steps", "1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    planner = {**TINY_PLANNER, "scored_states": "future"}
    return write_run(tmp_path_factory.mktemp("said") / f"{ENV}-delay2_1", SAID, 2, planner_kwargs=planner)


def load(file: Path) -> Any:
    return SAID.load(file, device="cpu")


def results(file: Path, folder: Path) -> dict[str, list[float]]:
    """Return what evaluate measures of an agent's file, by who answered."""
    target = folder / "evaluation.json"
    evaluate.main([str(file), "--json", str(target), "--episodes", "3", "--latency-calls", "0", "--device", "cpu"])
    return {one["label"]: one["returns"] for one in json.loads(target.read_text())["results"]}


def test_an_agent_decides_otherwise_and_is_else_the_same(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, new = run / f"{ENV}.zip", run / "weighed.zip"
    written = file.read_bytes()
    decide.main([str(run), *NEW, "-o", str(new)])
    out = capsys.readouterr().out
    assert "choice_factor  2.0  (new)" in out and "scored_states  future\n" in out and f"Wrote {new}" in out
    assert file.read_bytes() == written

    before, after = load(file), load(new)
    config = after.policy.planner.config
    assert (config.temperature, config.n_candidates, config.choice_factor, config.sampling_steps) == (0.5, 3, 2.0, 1)
    assert (
        config.scored_states == "future" and config.weight_settings() == before.policy.planner.config.weight_settings()
    )
    for name, value in before.policy.state_dict().items():
        th.testing.assert_close(after.policy.state_dict()[name], value, rtol=0, atol=0)
    assert (after.num_timesteps, after.trained_ages) == (before.num_timesteps, before.trained_ages)

    # The planner plays as set_planner makes it, and the expert as before; the run folder still says what task it is.
    obs = collect_observations(lambda: DelayedObservationWrapper(gym.make(ENV), 2), 20, seed=0)
    old_actions, new_actions = (model.predict(obs, deterministic=True)[0] for model in (before, after))
    before.set_planner(temperature=0.5, n_candidates=3, choice_factor=2.0, sampling_steps=1)
    np.testing.assert_array_equal(before.predict(obs, deterministic=True)[0], new_actions)
    assert np.abs(new_actions - old_actions).max() > 0.01
    assert results(new, tmp_path)["expert"] == results(file, tmp_path)["expert"]

    decide.main([str(new), "--choice-factor", "none", "-o", str(new)])  # in place
    config = load(new).policy.planner.config
    assert config.choice_factor is None and config.temperature == 0.5


def test_who_answers_is_set_and_shown(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = tmp_path / "both.zip"
    decide.main([str(run), "--answer", "both", "--expert-up-to", "0", "-o", str(new)])
    assert "answers        both: the expert at ages 0  (new)" in capsys.readouterr().out
    assert load(new).policy.who_answers == "both" and load(new).policy.expert_ages == range(1)
    assert list(results(new, tmp_path)) == ["planner", "expert", "both"]
    newer = tmp_path / "newer.zip"
    decide.main([str(new), "--expert-up-to", "1", "-o", str(newer)])  # both answer already
    assert load(newer).policy.expert_ages == range(2)


def test_statistics_of_vec_normalize_go_with_the_file(run: Path, tmp_path: Path) -> None:
    source = tmp_path / "agent.zip"
    source.write_bytes((run / f"{ENV}.zip").read_bytes())
    env = DummyVecEnv([lambda: DelayedObservationWrapper(gym.make(ENV), 2)])
    save_normalization(normalization_file(source), VecNormalize(env, norm_obs=False))
    statistics = normalization_file(source).read_bytes()
    decide.main([str(source), "--compact", "-o", str(tmp_path / "elsewhere" / "small.zip")])
    assert normalization_file(tmp_path / "elsewhere" / "small.zip").read_bytes() == statistics
    decide.main([str(source), "--compact", "-o", str(source)])  # in place
    assert normalization_file(source).read_bytes() == statistics
    decide.main([str(run), "--compact", "-o", str(source)])  # another agent takes the name, and has none
    assert not normalization_file(source).exists()


def test_an_agent_that_cannot_be_written_leaves_the_one_before_with_its_statistics(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "agent.zip"
    decide.main([str(run), "--compact", "-o", str(target)])
    normalization_file(target).write_bytes(b"its own")

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(SAID, "save", full)
    with pytest.raises(SystemExit) as stop:
        decide.main([str(run), "--compact", "-o", str(target)])
    assert stop.value.code == 1 and "No space left" in capsys.readouterr().err
    assert normalization_file(target).read_bytes() == b"its own"


def test_what_a_run_changes_in_its_task_is_told_where_the_file_leaves_it(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = Path(shutil.copytree(run, tmp_path / "changed"))
    replace(Record.read(run), env_kwargs={"reset_noise_scale": 0.1}).write(changed)
    decide.main([str(changed), "--compact", "-o", str(tmp_path / "agent.zip")])
    assert "{'env_kwargs': {'reset_noise_scale': 0.1}}" in capsys.readouterr().out
    decide.main([str(changed), "--compact", "-o", str(changed / "agent.zip")])
    (changed / EXPERT_FOLDER).mkdir()
    best = shutil.copy(changed / f"{ENV}.zip", changed / EXPERT_FOLDER / "best_model.zip")  # which is of the run, too
    decide.main([str(best), "--compact", "-o", str(changed / "agent.zip")])
    decide.main([str(run), "--compact", "-o", str(tmp_path / "plain.zip")])
    assert "does not keep" not in capsys.readouterr().out


def test_a_file_s_name_gets_its_suffix(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    decide.main([str(run), "--temperature", "0.5", "-o", str(tmp_path / "hopper_t0.5")])
    assert f"Wrote {tmp_path / 'hopper_t0.5.zip'}" in capsys.readouterr().out
    assert SAID.load(tmp_path / "hopper_t0.5.zip", device="cpu").policy.planner.config.temperature == 0.5


def test_what_is_no_agent_is_not_replaced(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "notes.zip").write_text("mine")
    save_tree(tmp_path / "checkpoint.zip", {"replay": 1})
    refused = "is no agent of SAID, and would be replaced"
    for name, told in (("logs", "it is a folder"), ("notes.zip", refused), ("checkpoint.zip", refused)):
        before = {file: file.read_bytes() for file in tmp_path.glob("*.zip")}
        with pytest.raises(SystemExit) as stop:
            decide.main([str(run), "--compact", "-o", str(tmp_path / name)])
        assert stop.value.code == 2 and told in capsys.readouterr().err
        assert {file: file.read_bytes() for file in tmp_path.glob("*.zip")} == before
    decide.main([str(run), "--compact", "-o", str(tmp_path / "agent.zip")])
    decide.main([str(run), "--temperature", "0.5", "-o", str(tmp_path / "agent.zip")])


def test_without_settings_it_shows_them(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    decide.main([str(run / f"{ENV}.zip")])
    out = capsys.readouterr().out
    assert "temperature    0.0\n" in out and "At temperature 0 there is one candidate" in out and "Wrote" not in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{run}", "--temperature", "1"], "-o is missing"),
        (["{run}", "-o", "x.zip"], "none is given: add --temperature"),
        (["{run}", "--temperature", "-1", "-o", "x.zip"], "temperature is -1.0, expected at least 0"),
        (["{run}", "--scored-states", "some", "-o", "x.zip"], "expected one of ('future', 'decision', 'all')"),
        (
            ["{run}", "--answer", "both", "-o", "x.zip"],
            "--answer both and --expert-up-to or --expert-from need each other",
        ),
        (["{run}", "--expert-up-to", "1"], "-o is missing"),
        (["{run}", "--expert-up-to", "1", "-o", "x.zip"], "--answer both and --expert-up-to or --expert-from need"),
        (["{run}", "--answer", "both", "--expert-up-to", "9", "-o", "x.zip"], "answers up to an age in 0..1"),
        (["{run}", "--choice-factor", "best", "-o", "x.zip"], "--choice-factor: a number, or none, got best"),
        (["{sadr}"], "is a run of 'sadr', which has no planner"),
        (["{sadr_zip}"], "SAID"),
        (["nowhere"], "does not exist"),
    ],
)
def test_says_what_is_wrong(
    run: Path, tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = {"run": run, "sadr": tmp_path / "sadr", "sadr_zip": tmp_path / "agent.zip"}
    if "sadr" in words[0]:
        file = write_run(paths["sadr"], DelayedSAC, 1) / f"{ENV}.zip"
        paths["sadr_zip"].write_bytes(file.read_bytes())
    with pytest.raises(SystemExit) as exit_info:
        decide.main([word.format(**paths) for word in words])
    assert exit_info.value.code == 2 and message in capsys.readouterr().err
