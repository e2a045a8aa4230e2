"""Presets: ``cpu`` is the constructors' defaults, ``paper`` the paper's tables, and all exist for all algorithms."""

from __future__ import annotations

import inspect
from argparse import Namespace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

pytest.importorskip("rl_zoo3")

from stable_baselines3 import SAC

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC, PlannerConfig
from sb3_said.files.arguments import with_given
from sb3_said.zoo.algorithms import ALGORITHMS, NESTED
from sb3_said.zoo.arguments import Delay
from sb3_said.zoo.experiment import Run
from sb3_said.zoo.manager import DelayedExperimentManager
from sb3_said.zoo.presets import PRESETS, config_file, preset_overrides

TASKS = ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")


def merged_settings(
    algo: str, preset: str, env_id: str, delay: Delay, log_folder: Path, given: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return what the command line trains with: the preset over the file's block over the constructors' defaults."""
    run = Run(delay, preset)
    how: dict[str, Any] = {"verbose": 0, "eval_freq": -1, "hyperparams": given}
    manager = DelayedExperimentManager(run, Namespace(), algo, env_id, str(log_folder), **how)
    cls, flags = ALGORITHMS[algo]
    defaults: dict[str, Any] = {}
    for base in reversed(cls.__mro__[: cls.__mro__.index(SAC) + 1]):
        if "__init__" in vars(base):
            defaults |= {name: p.default for name, p in inspect.signature(base).parameters.items()}
    return {**defaults, **flags, **manager.read_hyperparameters()[0]}


def paper(env_id: str, delay: Delay, max_delay: int | None = None) -> PlannerConfig:
    """Return the paper's planner for a task and a delay."""
    return PlannerConfig(**preset_overrides(config_file("said"), "paper", env_id, delay, max_delay)["planner_kwargs"])


@pytest.mark.parametrize("env_id", [*TASKS, "Pendulum-v1"])
def test_the_default_preset_and_the_constructor_make_the_same_agent(env_id: str, tmp_path: Path) -> None:
    run = Run(2, "cpu")
    manager = DelayedExperimentManager(run, Namespace(), "said", env_id, str(tmp_path), verbose=0, eval_freq=-1)
    made = manager.setup_experiment()
    assert made is not None
    model, plain = made[0], SAID("MultiInputPolicy", DelayedObservationWrapper(gym.make(env_id), delay=2))
    assert isinstance(model, SAID) and model.policy.planner.config == plain.policy.planner.config
    names = {"buffer_size", "learning_starts", "batch_size", "tau", "train_freq", "gradient_steps", "ent_coef"}
    names |= {"planner_gradient_steps", "planner_train_freq", "planner_newest_fraction", "relabelled_ages"}
    assert {n: getattr(model, n) for n in names} == {n: getattr(plain, n) for n in names}
    assert model.lr_schedule(1.0) == plain.lr_schedule(1.0)
    # The numbers that the results stand on.
    assert (model.learning_starts, model.planner_gradient_steps, model.planner_newest_fraction) == (10_000, 4_000, 0.2)
    assert (model.policy.planner.config.d_model, model.policy.planner.config.scored_states) == (128, "decision")


@pytest.mark.parametrize("algo", ["said", "stable", "sadr"])
def test_the_expert_looks_further_ahead_on_legs_that_fall(algo: str, tmp_path: Path) -> None:
    for env_id in (*TASKS, "Humanoid-v5", "InvertedPendulum-v5"):
        falls = algo != "sadr" and env_id not in ("HalfCheetah-v5", "InvertedPendulum-v5")
        assert merged_settings(algo, "cpu", env_id, 2, tmp_path)["gamma"] == (0.995 if falls else 0.99)
    assert merged_settings("said", "paper", "Hopper-v5", 2, tmp_path)["gamma"] == 0.99


@pytest.mark.parametrize("preset", PRESETS)
def test_falling_costs_where_a_task_ends_by_it(preset: str, tmp_path: Path) -> None:
    falls = ("Ant-v5", "Hopper-v5", "Humanoid-v5", "InvertedDoublePendulum-v5", "InvertedPendulum-v5", "Walker2d-v5")
    for env_id in (*falls, "Reacher-v5", "Pendulum-v1"):
        merged = merged_settings("said", preset, env_id, 2, tmp_path)
        costs = env_id in falls or preset == "paper"  # the paper has it for all, HalfCheetah-v5 which never ends too
        assert merged["planner_terminal_penalty"] == (-100.0 if costs else None)


@pytest.mark.parametrize("algo", ["sac", "sa", "dr", "sadr"])
def test_the_default_preset_of_a_baseline_is_the_constructors(algo: str, tmp_path: Path) -> None:
    run = Run(2, "cpu")
    manager = DelayedExperimentManager(run, Namespace(), algo, "Hopper-v5", str(tmp_path), verbose=0, eval_freq=-1)
    made = manager.setup_experiment()
    assert made is not None
    env = DelayedObservationWrapper(gym.make("Hopper-v5"), delay=2)
    model, plain = made[0], DelayedSAC("MultiInputPolicy", env, **ALGORITHMS[algo][1])
    names = ("buffer_size", "learning_starts", "batch_size", "augment_state", "delay_reconciled_critic")
    assert [getattr(model, name) for name in names] == [getattr(plain, name) for name in names]
    assert model.learning_starts == 10_000


@pytest.mark.parametrize("env_id", TASKS)
@pytest.mark.parametrize("delay", [0, 4, 8, 16])
def test_the_paper_preset_merged_is_the_papers_tables(env_id: str, delay: int, tmp_path: Path) -> None:
    tables = {  # Table 4: depth, temperature
        "Ant-v5": [(8, 0.6), (8, 0.6), (8, 0.6), (8, 0.8)],
        "HalfCheetah-v5": [(8, 0.6), (8, 0.3), (8, 0.3), (8, 0.1)],
        "Hopper-v5": [(8, 0.6), (4, 0.3), (2, 0.1), (8, 0.6)],
        "Walker2d-v5": [(8, 0.8), (8, 0.6), (4, 0.8), (8, 0.6)],
    }
    settings = merged_settings("said", "paper", env_id, delay, tmp_path)
    depth, temperature = tables[env_id][[0, 4, 8, 16].index(delay)]
    # Table 3, in its order; a stride of 1, DDIM and the averaged weights are all that there is here
    expected: dict[str, Any] = {"planner_terminal_penalty": -100.0, "gamma": 0.99, "learning_rate": 3e-4}
    expected |= {"planner_gradient_steps": 1_000_000}
    # Section 6.4 and Algorithm 1: 5 M steps, all of which the planner learns from, once; SADR as published
    expected |= {"n_timesteps": 5e6, "buffer_size": 5_000_000, "planner_newest_fraction": 1.0}
    expected |= {"planner_train_freq": None, "relabelled_ages": 0.0}
    expected |= {"scale_rewards": False, "normalise_states": False, "policy_delay": 1, "actor_averaging": 0.0}
    expected |= {"ent_coef": "auto", "target_entropy": "auto", "batch_size": 256, "planner_trial_episodes": 0}
    assert {name: settings[name] for name in expected} == expected
    config = PlannerConfig(**settings["planner_kwargs"])
    assert config == PlannerConfig.paper(depth, temperature)
    table: dict[str, Any] = {"d_model": 256, "sampling_steps": 20, "prediction": "epsilon", "ema_decay": 0.9999}
    table |= {"weight_factor": 2.0, "batch_size": 256, "n_candidates": 50, "horizon": 8}
    table |= {"depth": depth, "temperature": temperature}
    # The text: states z-scored, actions after an arctanh; a fixed mask; the mean value of all states; cosine
    table |= {"relative_states": False, "action_transform": "tanh", "mask": "fixed", "scored_states": "all"}
    table |= {"choice_factor": None, "lr_schedule": "cosine"}
    # The code under the results
    table |= {"value_scale": "centred", "precision": "float32", "learning_rate": 2e-4, "weight_decay": 1e-5}
    table |= {"ema_warmup": False, "warmup_steps": 0, "gradient_clip": None, "schedule": "linear"}
    assert {name: getattr(config, name) for name in table} == table
    assert not {"planner_by_delay", "base"} & {*settings, *settings["planner_kwargs"]}


def test_what_is_given_for_the_planner_leaves_the_rest_of_the_preset(tmp_path: Path) -> None:
    settings = merged_settings("said", "paper", "Hopper-v5", 4, tmp_path, {"planner_kwargs": {"temperature": 0.7}})
    assert PlannerConfig(**settings["planner_kwargs"]) == PlannerConfig.paper(4, 0.7)
    given = {"planner_kwargs": {"temperature": 0.7}, "gamma": 0.9}
    assert merged_settings("said", "cpu", "Hopper-v5", 4, tmp_path, given)["planner_kwargs"] == {"temperature": 0.7}
    before = {"planner_kwargs": {"depth": 2}, "iql_kwargs": {"expectile": 0.9}, "gamma": 0.99}  # as a resumed run's
    assert with_given(before, given | {"iql_kwargs": {"updates": 1}}, NESTED) == {
        "planner_kwargs": {"depth": 2, "temperature": 0.7},
        "iql_kwargs": {"expectile": 0.9, "updates": 1},
        "gamma": 0.9,
    }


def test_the_papers_expert_is_sadr_as_published(tmp_path: Path) -> None:
    settings = merged_settings("sadr", "paper", "Hopper-v5", 4, tmp_path)
    assert (settings["n_timesteps"], settings["buffer_size"], settings["relabelled_ages"]) == (5e6, 5_000_000, 0.0)


@pytest.mark.parametrize("delay", [None, 8, "8", "FixedDelay(8)"])
def test_the_papers_planner_knows_one_delay(delay: Delay) -> None:
    assert paper("Hopper-v5", delay).mask == "fixed"


@pytest.mark.parametrize("env_id", [*TASKS, "Pendulum-v1"])
@pytest.mark.parametrize(("delay", "max_delay"), [([0, 8], None), ("UniformDelay(0, 8)", None), (4, 8)])
def test_under_a_delay_that_varies_the_papers_planner_knows_all(env_id: str, delay: Delay, max_delay: int) -> None:
    """A delay below the largest, which then is the expert's, is one that varies, too."""
    assert paper(env_id, delay, max_delay).mask == "random"


def test_the_papers_settings_go_by_the_largest_delay() -> None:
    assert [paper("Hopper-v5", delay).depth for delay in (4, [0, 8], "UniformDelay(0, 8)", 5)] == [4, 2, 2, 8]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_preset_exists_for_every_algorithm(algo: str, preset: str) -> None:
    assert isinstance(preset_overrides(config_file(algo), preset, "Hopper-v5", 4), dict)


def test_a_file_of_ones_own_may_name_no_preset(tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text("presets:\n")
    assert preset_overrides(tmp_path / "own.yml", "cpu", "Hopper-v5", 4) == {}


@pytest.mark.parametrize("default", ["", "    default:\n"])
def test_a_preset_of_ones_own_may_be_of_one_task(default: str, tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text(f"presets:\n  fast:\n    Hopper-v5: {{n_timesteps: 7}}\n{default}")
    assert preset_overrides(tmp_path / "own.yml", "fast", "Hopper-v5", 4) == {"n_timesteps": 7}
    assert preset_overrides(tmp_path / "own.yml", "fast", "Ant-v5", 4) == {}


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValueError, match="no preset 'fast'"):
        preset_overrides(config_file("said"), "fast", "Hopper-v5", 4)
