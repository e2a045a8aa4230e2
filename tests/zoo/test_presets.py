"""Presets: ``cpu`` is the constructors' defaults, ``paper`` the paper's table, and all exist for all algorithms."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import gymnasium as gym
import pytest

pytest.importorskip("rl_zoo3")

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC, PlannerConfig
from sb3_said.zoo.arguments import Delay
from sb3_said.zoo.manager import ALGORITHMS, DelayedExperimentManager, Run
from sb3_said.zoo.presets import PRESETS, config_file, preset_overrides

TASKS = ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")


def paper(env_id: str, delay: Delay, max_delay: int | None = None) -> PlannerConfig:
    """Return the paper's planner for a task and a delay."""
    return PlannerConfig(**preset_overrides(config_file("said"), "paper", env_id, delay, max_delay)["planner_kwargs"])


@pytest.mark.parametrize("env_id", [*TASKS, "Pendulum-v1"])
def test_the_default_preset_and_the_constructor_make_the_same_agent(env_id: str, tmp_path: Path) -> None:
    run = Run([], 2, "cpu", 25_000)
    manager = DelayedExperimentManager(run, Namespace(), "said", env_id, str(tmp_path), verbose=0, eval_freq=-1)
    made = manager.setup_experiment()
    assert made is not None
    model, plain = made[0], SAID("MultiInputPolicy", DelayedObservationWrapper(gym.make(env_id), delay=2))
    assert isinstance(model, SAID) and model.policy.planner.config == plain.policy.planner.config
    names = {"buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq", "gradient_steps", "ent_coef"}
    names |= {"planner_gradient_steps", "planner_train_freq", "planner_newest_fraction", "planner_terminal_penalty"}
    assert {n: getattr(model, n) for n in names} == {n: getattr(plain, n) for n in names}
    assert model.lr_schedule(1.0) == plain.lr_schedule(1.0)
    # The numbers that the results stand on.
    assert (model.learning_starts, model.planner_gradient_steps, model.planner_newest_fraction) == (10_000, 25_000, 0.2)
    assert (model.policy.planner.config.d_model, model.policy.planner.config.scored_states) == (128, "decision")


@pytest.mark.parametrize("algo", ["sac", "sa", "dr", "sadr"])
def test_the_default_preset_of_a_baseline_is_the_constructors(algo: str, tmp_path: Path) -> None:
    run = Run([], 2, "cpu", 25_000)
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
def test_the_paper_preset_is_the_papers_table(env_id: str, delay: int) -> None:
    tables = {  # Table 6: depth, temperature
        "Ant-v5": [(8, 0.6), (8, 0.6), (8, 0.6), (8, 0.8)],
        "HalfCheetah-v5": [(8, 0.6), (8, 0.3), (8, 0.3), (8, 0.1)],
        "Hopper-v5": [(8, 0.6), (4, 0.3), (2, 0.1), (8, 0.6)],
        "Walker2d-v5": [(8, 0.8), (8, 0.6), (4, 0.8), (8, 0.6)],
    }
    settings = preset_overrides(config_file("said"), "paper", env_id, delay)
    depth, temperature = tables[env_id][[0, 4, 8, 16].index(delay)]
    assert settings["n_timesteps"] == 5e6 and settings["planner_gradient_steps"] == 1_000_000
    assert PlannerConfig(**settings["planner_kwargs"]) == PlannerConfig.paper(depth, temperature, precision="auto")
    assert not {"planner_by_delay", "base"} & {*settings, *settings["planner_kwargs"]}


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


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValueError, match="no preset 'fast'"):
        preset_overrides(config_file("said"), "fast", "Hopper-v5", 4)
