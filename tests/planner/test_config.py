"""The settings: the paper's, those of a file, and those that are refused."""

import dataclasses
import json

import numpy as np
import pytest

from sb3_said.planner import PlannerConfig


def test_paper_config_is_the_papers_table():
    config = PlannerConfig.paper(depth=4, temperature=0.3)
    expected = {"depth": 4, "d_model": 256, "horizon": 8, "prediction": "epsilon", "schedule": "linear"}
    expected |= {"sampling_steps": 20, "n_candidates": 50, "temperature": 0.3, "mask": "fixed"}
    expected |= {"action_transform": "tanh", "scored_states": "all", "batch_size": 256, "learning_rate": 2e-4}
    expected |= {"ema_decay": 0.9999, "weight_factor": 2.0, "warmup_steps": 0, "gradient_clip": None}
    expected |= {"value_scale": "centred", "precision": "float32", "end_time_probability": 0.0}
    expected |= {"early_probability": 0.0, "first_guess": "none", "relative_states": False, "decision_weight": 1.0}
    expected |= {"time_sampling": "uniform", "embed_known": False}
    assert expected.items() <= dataclasses.asdict(config).items()
    assert PlannerConfig.paper(sampling_steps=2).sampling_steps == 2


def test_numbers_and_texts_of_numpy_are_pythons():
    config = PlannerConfig(horizon=np.int64(8), temperature=np.float32(0.5), mask=np.str_("own"))
    assert PlannerConfig(**json.loads(json.dumps(config.to_dict()))) == config
    assert config == PlannerConfig(horizon=8, temperature=0.5, mask="own")


def test_settings_of_sampling_do_not_decide_the_weights():
    config = PlannerConfig()
    others = dict(sampling_steps=1, n_candidates=2, temperature=1.0, scored_states="all", choice_factor=1.0)
    others["decided_by"] = "actor"
    assert dataclasses.replace(config, **others).weight_settings() == config.weight_settings()
    assert dataclasses.replace(config, depth=4).weight_settings() != config.weight_settings()


def test_a_plan_begins_at_the_guessed_present_where_there_is_one():
    assert PlannerConfig().present == PlannerConfig(mask="none").present == "guessed"
    assert PlannerConfig(first_guess="none").present == PlannerConfig(mask="fixed").present == "inpainted"
    assert PlannerConfig(present="inpainted").present == "inpainted"


def test_config_survives_json():
    config = PlannerConfig(betas=(0.8, 0.99))
    assert PlannerConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prediction": "score"}, r"prediction is 'score', expected one of \('v', 'epsilon'\)"),
        ({"schedule": "sqrt"}, "schedule is 'sqrt'"),
        ({"time_sampling": "beta"}, "time_sampling is 'beta'"),
        ({"mask": "block"}, "mask is 'block'"),
        ({"mask": "none", "first_guess": "none"}, "mask is 'none' with first_guess='none' and present='inpainted'"),
        ({"mask": "none", "present": "inpainted"}, "mask is 'none' .* present='inpainted'; expected a first_guess"),
        ({"present": "seen"}, "present is 'seen', expected one of"),
        ({"decided_by": "critic"}, "decided_by is 'critic', expected one of"),
        ({"decided_by": "actor", "present": "inpainted"}, "decided_by is 'actor' .* expected present='guessed'"),
        ({"action_transform": "log"}, "action_transform is 'log'"),
        ({"scored_states": "past"}, "scored_states is 'past'"),
        ({"value_scale": "log"}, "value_scale is 'log'"),
        ({"precision": "half"}, "precision is 'half'"),
        ({"lr_schedule": "step"}, "lr_schedule is 'step'"),
        ({"horizon": 1}, "horizon is 1, expected at least 2"),
        ({"depth": 0}, "depth is 0, expected at least 1"),
        ({"choice_factor": -1.0}, "choice_factor is -1.0, expected at least 0"),
        ({"temperature": float("nan")}, "temperature is nan, expected a finite number"),
        ({"learning_rate": float("inf")}, "learning_rate is inf, expected a finite number"),
        ({"depth": 2.0}, "depth is 2.0, expected a whole number"),
        ({"depth": "2"}, "depth is '2', expected a whole number"),
        ({"embed_known": 1}, "embed_known is 1, expected True or False"),
        ({"schedule": ["cosine"]}, "schedule is .'cosine'., expected one of"),
        ({"betas": (0.9, 1.0)}, "betas is .0.9, 1.0., expected two numbers"),
        ({"ema_decay": None}, "ema_decay is None, expected a finite number"),
        ({"depth": 10**9}, "depth is 1000000000, expected at most 1000"),
        ({"horizon": 10**9}, "horizon is 1000000000, expected at most 1000"),
        ({"n_candidates": 10**9}, "n_candidates is 1000000000, expected at most 10000"),
        ({"d_model": 100}, "d_model is 100, expected a multiple of 32"),
        ({"learning_rate": 0.0}, "learning_rate is 0.0"),
        ({"gradient_clip": 0.0}, "give gradient_clip=None"),
        ({"extra_state_probability": 1.1}, r"extra_state_probability is 1.1, expected at most 1"),
        ({"ema_decay": 1.5}, r"ema_decay is 1.5, expected at most 1"),
        ({"end_time_probability": 1.1}, "end_time_probability is 1.1, expected at most 1"),
        ({"early_probability": 1.1}, "early_probability is 1.1, expected at most 1"),
        ({"mask_end_probability": 1.1}, "mask_end_probability is 1.1, expected at most 1"),
        ({"weight_decay": -1.0}, "weight_decay is -1.0, expected at least 0"),
        ({"weight_factor": -1.0}, "weight_factor is -1.0, expected at least 0"),
        ({"decision_weight": -1.0}, "decision_weight is -1.0, expected at least 0"),
        ({"warmup_steps": -1}, "warmup_steps is -1, expected at least 0"),
    ],
)
def test_config_refuses(changes, message):
    with pytest.raises(ValueError, match=message):
        PlannerConfig(**changes)
