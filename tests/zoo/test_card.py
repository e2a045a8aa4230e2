"""sb3-said card: what stands in it is what was measured of that very file."""

import argparse
import ast
import hashlib
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch as th

pytest.importorskip("rl_zoo3")

from huggingface_hub import ModelCard
from rl_zoo3 import exp_manager
from rl_zoo3.utils import StoreDict
from small_run import write_run
from stable_baselines3.common.utils import LinearSchedule
from trained_run import ENV, train_run

from sb3_said import SAID
from sb3_said.zoo import card, decide, evaluate, over_delays
from sb3_said.zoo.record import Record
from sb3_said.zoo.runs import load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("said") / f"{ENV}-delay2_1", SAID, 2)


def test_an_agent_handed_on_and_its_card(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    agent, returns = tmp_path / "agent.zip", tmp_path / "returns.json"
    decide.main([str(run), "--compact", "-o", str(agent)])
    with pytest.raises(SystemExit):
        card.main([str(agent), "--run", str(run), "--returns", str(returns)])
    assert "where runs to play are named" in capsys.readouterr().err
    delays = ["--delays", "0", "UniformDelay(0, 2)", "--episodes", "3", "--device", "cpu"]
    over_delays.main([f"x={agent}", *delays, "--age-errors", "1", "--json", str(returns)])  # without --env or --algo
    card.main([str(agent), "--run", str(run), "--returns", str(returns), "--latency", "1.5"])

    written = ModelCard.load(agent.with_suffix(".md"))
    cells = json.loads(returns.read_text())["cells"]
    who = SAID.load(agent, device="cpu").policy.who_answers
    right = [cell["result"]["returns"] for cell in cells if cell["answer"] == who and not cell["age_error"]]
    result = written.data.eval_results[0]
    assert written.data.library_name == "stable-baselines3" and written.data.model_name == "SAID"
    assert result.metric_value == f"{np.mean(right):.2f} +/- {np.std(right):.2f}" and result.dataset_name == ENV
    text = written.text
    assert "| ages trained on | 2 control steps |" in text and "| median decision | 1.5 ms, one CPU thread |" in text
    assert f"`sb3-said train --algo said --env {ENV}" in text and "| under delay | planner | expert |" in text
    assert f"| 0 | {np.mean(right[0]):.1f} [" in text and "| UniformDelay(0, 2), age +1 |" in text
    assert "| control period | 40 ms |" in text
    assert f"| SHA-256 | `{hashlib.sha256(agent.read_bytes()).hexdigest()}` |" in text
    assert "denoising step" in text


def test_returns_of_another_file_are_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    agent, returns = tmp_path / "agent.zip", tmp_path / "returns.json"
    over_delays.main([f"x={run}", "--delays", "0", "--episodes", "2", "--device", "cpu", "--json", str(returns)])
    decide.main([str(run), "--compact", "-o", str(agent)])
    with pytest.raises(SystemExit):
        card.main([str(agent), "--run", str(run), "--returns", str(returns)])
    told = f"holds no returns of {agent} as it is now: play it with sb3-said over-delays X={agent} --delays 0"
    assert f"{told} --episodes 2 --seed 10000 --json {returns} first" in capsys.readouterr().err


def test_returns_of_a_file_with_two_labels_count_once(run: Path, tmp_path: Path) -> None:
    returns = tmp_path / "returns.json"
    how = ["--episodes", "3", "--device", "cpu", "--json", str(returns)]
    over_delays.main([f"a={run}", "--delays", "0", *how])
    over_delays.main([f"b={run}", "--delays", "0", "2", *how])
    target = tmp_path / "agent.md"
    card.main([str(run / f"{ENV}.zip"), "--run", str(run), "--returns", str(returns), "-o", str(target)])
    assert ModelCard.load(target).data.eval_results[0].metric_name == "mean_reward, observation delays 0, 2"


def test_a_file_of_something_else_is_no_card_to_replace(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes, returns = tmp_path / "notes.md", tmp_path / "returns.json"
    notes.write_text("# What I noticed\n\n---\n")
    with pytest.raises(SystemExit):
        card.main([str(run / "x.zip"), "--run", str(run), "--returns", str(returns), "-o", str(notes)])
    assert f"{notes} is no model card, and would be replaced: give another --output" in capsys.readouterr().err
    assert notes.read_text().startswith("# What I noticed")


def test_a_folder_in_place_of_the_agents_file_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        card.main([str(run), "--run", str(run), "--returns", str(tmp_path / "returns.json")])
    assert "is a folder: give the agent's file" in capsys.readouterr().err
    assert not run.with_suffix(".md").exists()


def test_a_run_that_did_not_make_the_agent_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    returns, file = tmp_path / "returns.json", run / f"{ENV}.zip"
    over_delays.main([f"x={file}", "--delays", "0", "--episodes", "2", "--device", "cpu", "--json", str(returns)])
    other = Path(shutil.copytree(run, tmp_path / "other"))
    record = Record.read(run)
    gym.register("SamePendulum-v0", "gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv")
    wrong: dict[str, dict[str, Any]] = {"seed=8, and the agent seed=0": {"seed": 8}}
    wrong |= {f"env={env!r}, and the agent env={ENV!r}": {"env": env} for env in ("SamePendulum-v0", "Hopper-v5")}
    wrong |= {"class='DelayedSAC', and the agent class='SAID'": {"algo": "sadr"}}
    for told, change in wrong.items():
        replace(record, **change).write(other)
        with pytest.raises(SystemExit):
            card.main([str(file), "--run", str(other), "--returns", str(returns), "-o", str(tmp_path / "card.md")])
        assert told in capsys.readouterr().err
    returns.write_text(returns.read_text().replace(ENV, "Hopper-v5"))
    with pytest.raises(SystemExit):
        card.main([str(file), "--run", str(run), "--returns", str(returns), "-o", str(tmp_path / "card.md")])
    assert f"returns.json holds returns of Hopper-v5, and the agent is of {ENV}" in capsys.readouterr().err
    assert not (tmp_path / "card.md").exists()


@pytest.mark.parametrize("latency", ["nan", "-1", "inf"])
def test_a_time_that_is_none_is_refused(latency: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        card.main([str(run), "--run", str(run), "--returns", "x.json", "--latency", latency, "-o", "x.md"])
    assert "--latency is a time in milliseconds, above 0" in capsys.readouterr().err


def test_returns_of_another_answer_alone_are_no_others(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    agent, returns = tmp_path / "my agent.zip", tmp_path / "returns.json"
    decide.main([str(run), "--answer", "planner", "-o", str(agent)])
    shared = ["--delays", "0", "UniformDelay(0, 2)", "--episodes", "2", "--device", "cpu", "--json", str(returns)]
    over_delays.main([f"x={agent}", *shared, "--answer", "expert"])
    with pytest.raises(SystemExit):
        card.main([str(agent), "--run", str(run), "--returns", str(returns)])
    told = capsys.readouterr().err
    assert "holds no returns of" in told and "as its planner, who answers in it: play it with" in told
    command = shlex.split(told.partition("play it with sb3-said over-delays ")[2].removesuffix(" first.\n"))
    over_delays.main([*command, "--device", "cpu"])
    card.main([str(agent), "--run", str(run), "--returns", str(returns)])
    assert agent.with_suffix(".md").is_file()


def test_the_command_has_what_is_not_the_presets() -> None:
    hyperparams = {"n_timesteps": 5e5, "policy": "MultiInputPolicy", "planner_terminal_penalty": -100.0,
                   "env_wrapper": None, "planner_gradient_steps": 7, "ent_coef": "auto_0.2"}  # fmt: skip
    record = Record("said", "Hopper-v5", 3, [0, 4], hyperparams=hyperparams, options={"n_timesteps": 90})
    command = card.made_by(record)
    assert command.endswith("-n 90 --seed 3 -params planner_gradient_steps:7 'ent_coef:'\"'\"'auto_0.2'\"'\"''")
    smoke = {"planner_kwargs": {"d_model": 64, "batch_size": 32}, "planner_trial_episodes": 2}
    assert card.made_by(replace(record, preset="smoke", hyperparams=smoke)).endswith("-params planner_trial_episodes:2")


def test_the_command_makes_the_agent_again_whatever_the_preset_says_since() -> None:
    """The run was of a preset without gamma, when the constructor's default was .99; and of a task with arguments."""
    record = Record("said", "Hopper-v5", 1, 4, hyperparams={"planner_terminal_penalty": -100.0},
                    options={"trained_agent": "old.zip"}, env_kwargs={"forward_reward_weight": 2.0})  # fmt: skip
    command = card.made_by(record, SimpleNamespace(gamma=0.99, planner_kwargs={"depth": 2}))
    assert command.endswith("-i old.zip --seed 1 -params gamma:0.99 --env-kwargs forward_reward_weight:2.0")


def test_the_command_has_what_the_planner_learned_with_before_its_defaults_changed(run: Path) -> None:
    def settings_in(command: str) -> dict[str, Any]:
        words = [word for word in shlex.split(command) if word.startswith("planner_kwargs:")]
        return ast.literal_eval(words[0].removeprefix("planner_kwargs:")) if words else {}

    played, record = load_run(run, device="cpu"), Record.read(run)
    assert isinstance(played.model, SAID)
    before, planner = settings_in(card.made_by(record, played.model)), played.model.policy.planner
    planner.config = replace(planner.config, weight_factor=2.0, value_scale="rank", mask="own", present="inpainted")
    since = settings_in(card.made_by(record, played.model))  # but for the mask and the present, which a trial chooses
    assert since == before | {"weight_factor": 2.0, "value_scale": "rank"}


def test_the_command_of_settings_with_classes_makes_them_again(tmp_path: Path) -> None:
    classes = {"activation_fn": th.nn.Tanh, "net_arch": [16], "optimizer_class": th.optim.AdamW}
    hyperparams = {"n_timesteps": 5e5, "policy_kwargs": classes, "replay_buffer_kwargs": {"x": [th.nn.ReLU, (1, 2)]}}
    record = Record("sadr", "Pendulum-v1", 3, 2, hyperparams=hyperparams, missing={"env_wrapper": "a lambda"})
    command, _, left_out = card.made_by(record).partition("  # ")
    assert left_out == "and env_wrapper, which no command line holds"
    words = shlex.split(command)
    parser = argparse.ArgumentParser()
    parser.add_argument("-params", nargs="+", action=StoreDict)
    given = parser.parse_args(words[words.index("-params") :]).__dict__["params"]
    read = {name: eval(text, vars(exp_manager)) for name, text in given.items()}
    assert read == {name: hyperparams[name] for name in ("policy_kwargs", "replay_buffer_kwargs")}
    schedule = replace(record, missing={}, hyperparams={"n_timesteps": 5e5, "learning_rate": LinearSchedule(1, 0, 1)})
    assert card.made_by(schedule).endswith("  # and learning_rate, which no command line holds")


def test_an_agent_of_normalised_observations_says_how_to_read_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = train_run(tmp_path, "sadr", "normalize:dict(norm_obs_keys=['observation'])")
    played = load_run(folder, device="cpu")
    results: Any = SimpleNamespace(settings={"n_episodes": 1, "seed": 0})
    facts = card.describe(played, Record.read(folder), results, [], None, 0)
    assert f"| belongs beside it | `{ENV}.normalize.zip` |" in facts
    code, env = facts.split("```")[1].removeprefix("python\n"), played.make_env()
    names: dict[str, Any] = {"make_env": played.make_env, "observation": env.reset(seed=3)[0]}
    monkeypatch.chdir(folder)
    exec(code, names)
    assert played.normalize is not None
    batch = played.normalize({key: value[None] for key, value in env.reset(seed=3)[0].items()})
    np.testing.assert_array_equal(names["action"], played.model.predict(batch, deterministic=True)[0][0])


def test_the_command_has_the_budget_wherever_it_was_given() -> None:
    record = Record("said", "Hopper-v5", 3, 4, hyperparams={"n_timesteps": 30}, options={"n_timesteps": -1})
    assert " -n 30 --seed 3" in card.made_by(record)
    assert " -n " not in card.made_by(replace(record, hyperparams={"n_timesteps": 5e5}))


def test_an_agent_of_logs_has_met_all_ages_of_its_delay(run: Path) -> None:
    played = load_run(run, device="cpu")
    model: Any = played.model
    record = Record("said", ENV, 3, [1, 2], dataset=["a.npz"])
    assert card.ages_trained_on(played, record) == [0, 1, 2]
    assert card.ages_trained_on(played, replace(record, dataset=[])) == model.trained_ages
    results: Any = SimpleNamespace(settings={"n_episodes": 1, "seed": 0})
    facts = card.describe(played, record, results, [], None, 0)
    assert "| gradient steps, on logs | 60 |" in facts
    other = replace(record, dataset=[], expert_delay=0)  # whose planner has drawn them all
    assert card.ages_trained_on(played, other) == [0, 1, 2]


def test_the_card_says_what_plays_an_agent_of_a_task_of_ones_own(run: Path) -> None:
    played, results = load_run(run, device="cpu"), cast(Any, SimpleNamespace(settings={"n_episodes": 1, "seed": 0}))
    record = Record("said", ENV, 3, 2, gym_packages=["mine", "yours"])
    assert "--delay 2 --gym-packages mine yours --record video.mp4` shows it." in card.describe(
        played, record, results, [], None, 0
    )
    played.changes["env_kwargs"] = {"g": 1.0}
    text = card.describe(played, record, results, [], None, 0)
    assert "| task changed by |" in text and "'g': 1.0" in text.replace('"', "'") and "shows it" not in text


def test_returns_of_another_task_than_its_training_are_refused(run: Path, tmp_path: Path) -> None:
    """A file alone does not know what its run changes."""
    shutil.copy(run / f"{ENV}.zip", tmp_path / "alone.zip")
    record = replace(Record.read(run), env_kwargs={"reset_noise_scale": 0.1})
    with pytest.raises(
        ValueError, match=r"alone\.zip was trained in a task that its run changes by .*reset_noise_scale"
    ):
        card.make_card(load_run(tmp_path / "alone.zip", device="cpu"), record, cast(Any, None))


def test_the_card_says_how_candidates_decide(run: Path) -> None:
    model: Any = load_run(run, device="cpu").model
    model.set_answer("planner")
    model.set_planner(temperature=1.0, n_candidates=3)
    assert card.who_answers(model).endswith("at temperature 1, 3 candidates, the one of the highest value decides")
    model.set_planner(choice_factor=1.0)
    assert card.who_answers(model).endswith("at temperature 1, 3 candidates, weighed by their values")
    guesses = "from a guess of the present" in card.who_answers(model)
    assert guesses == (model.policy.planner.config.present == "guessed")
    model.set_planner(present="inpainted")
    assert "with the present inpainted at temperature 1" in card.who_answers(model)


def test_the_trials_steps_are_those_of_the_log(tmp_path: Path) -> None:
    assert card.trial_steps(tmp_path) == 0
    (tmp_path / "progress.csv").write_text("time,trial/steps,x\n1,,2\n2,340.0,\n3,60.0,\n")
    assert card.trial_steps(tmp_path) == 400
    (tmp_path / "progress_2.csv").write_text("time,trial/steps\n4,7.0\n")  # of a resumed run
    assert card.trial_steps(tmp_path) == 407


def test_a_file_alone_names_its_task(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    agent = tmp_path / "agent.zip"
    decide.main([str(run), "--compact", "-o", str(agent)])
    target = tmp_path / "evaluation.json"
    evaluate.main([str(agent), "--json", str(target), "--episodes", "1", "--latency-calls", "0", "--device", "cpu"])
    found = json.loads(target.read_text())
    assert (found["algo"], found["env"], found["delay"]) == ("said", ENV, 2)
    model = SAID.load(agent, device="cpu")
    model.task = "os:Evil-v0"  # gymnasium would import the module
    model.save(agent)
    with pytest.raises(SystemExit):
        evaluate.main([str(agent), "--json", str(target), "--episodes", "1"])
    assert "Give --env" in capsys.readouterr().err
