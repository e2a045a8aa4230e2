"""benchmarks/plan_latency.py: both ways do the same work, and the numbers are what they are called."""

import json
from dataclasses import replace

import numpy as np
import plan_latency
import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

from sb3_said.planner import PlannerConfig

SETTING = plan_latency.QUICK._replace(config=replace(plan_latency.QUICK.config, depth=2, precision="float32"))
OBS, ACT = 11, 3  # Hopper-v5


def changed(setting, **changes):
    return setting._replace(config=replace(setting.config, **changes))


def counted(function):
    with FlopCounterMode(display=False) as counter:
        function()
    return {name: sum(flops.values()) for name, flops in counter.get_flop_counts().items()}


@pytest.mark.parametrize("scored_states", ["future", "decision", "all"])
def test_both_ways_do_the_work_that_is_counted_from_shapes(scored_states):
    ours, expected = [], []
    for n_candidates, temperature in ((1, 0.0), (4, 0.5)):
        setting = changed(SETTING, n_candidates=n_candidates, temperature=temperature, scored_states=scored_states)
        model = plan_latency.make_agent(setting, "cpu")
        env = model.get_env().envs[0]
        obs = plan_latency.observe(env, setting.delay)
        assert obs["delay"] == setting.delay
        plain = plan_latency.make_plain(setting, "cpu", env)
        flops = plan_latency.matmul_flops(setting, OBS, ACT)

        model.warmup()
        ours.append(counted(lambda model=model, obs=obs: model.predict(obs, deterministic=True))["Global"])
        expected.append(flops)

        plain.planner.model_ema.train()  # the fused attention of evaluation is not counted
        theirs = counted(lambda plain=plain, obs=obs: plain(obs))
        by_sample = ("modulation", "map_embedding", "time_embedding")  # for every candidate at every call
        repeated = sum(n for name, n in theirs.items() if name.endswith(by_sample))
        assert repeated > 0 and theirs["Global"] - repeated == flops
    assert ours[1] - ours[0] == expected[1] - expected[0]
    beside = ours[0] - expected[0]  # once a decision, whatever the number of candidates
    assert 0 < beside < expected[0]


def test_flops_grow_with_each_size():
    base = plan_latency.matmul_flops(SETTING, OBS, ACT)
    twice = plan_latency.matmul_flops(changed(SETTING, n_candidates=2 * SETTING.n_candidates), OBS, ACT)
    assert twice == 2 * base
    paper, two_steps = plan_latency.SETTINGS[:2]
    assert (paper.name, paper.config) == ("paper", PlannerConfig.paper())
    assert (two_steps.name, two_steps.delay, two_steps.n_candidates) == ("paper, 2 steps", 8, 50)
    assert two_steps.config == PlannerConfig.paper(sampling_steps=2)
    assert plan_latency.matmul_flops(paper, OBS, ACT) == pytest.approx(203.8e9, rel=0.001)
    assert plan_latency.matmul_flops(changed(paper, scored_states="future"), OBS, ACT) < 203.8e9


def test_every_setting_is_timed_with_a_first_guess_too():
    guessing = [plan_latency.with_first_guess(setting).config for setting in plan_latency.SETTINGS]
    assert {config.first_guess for config in guessing} == {"prior"}
    assert [config.present for config in guessing] == ["inpainted"] * 2 + ["guessed"] * 3


def test_quick_run_writes_what_it_prints(tmp_path, capsys):
    threads = th.get_num_threads()
    products = ["--product-size", "64", "--product-seconds", "0"]
    plan_latency.main(["--quick", *products, "--json", str(tmp_path / "latency.json")])
    assert th.get_num_threads() == threads
    result = json.loads((tmp_path / "latency.json").read_text())
    (row,) = result["rows"]
    assert 0 < row["ours p50 ms"] <= row["p95"] <= row["p99"]
    assert row["first"] > 0 and row["of the floor"] > 0
    for name in ("times as fast", "with a first guess"):
        assert row[name]["low"] <= row[name]["value"] <= row[name]["high"]
    assert [line["p50 in ms by"] for line in result["scaling"]] == [
        "candidates",
        "denoising steps",
        "environments, batched",
        "environments, deterministic",
    ]
    assert all(np.isfinite(line["slope"]) for line in result["scaling"])
    captured = capsys.readouterr()
    assert "quick: depth 1, width 32, 2 steps, 4 candidates" in captured.out
    assert "environments, batched" in captured.out and captured.err.count("\n") == 1 + 1 + 4
