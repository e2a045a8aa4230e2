"""benchmarks/plan_latency.py: both ways do the same work, and the numbers are what they are called."""

import json

import numpy as np
import plan_latency
import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

SETTING = plan_latency.QUICK._replace(depth=2)
OBS, ACT = 11, 3  # Hopper-v5


def counted(function):
    with FlopCounterMode(display=False) as counter:
        function()
    return {name: sum(flops.values()) for name, flops in counter.get_flop_counts().items()}


@pytest.mark.parametrize("n_candidates", [1, 4])
def test_both_ways_do_the_work_that_is_counted_from_shapes(n_candidates):
    setting = SETTING._replace(n_candidates=n_candidates)
    model = plan_latency.make_agent(setting, "cpu", precision="float32")
    env = model.get_env().envs[0]
    obs = plan_latency.observe(env, setting.delay)
    assert obs["delay"] == setting.delay
    plain = plan_latency.make_plain(setting, "cpu", env.action_space, env.observation_space["observation"])
    flops = plan_latency.matmul_flops(setting, OBS, ACT)

    model.warmup()
    ours = counted(lambda: model.predict(obs, deterministic=True))
    d_model, known = setting.d_model, OBS + setting.delay * (ACT + 1)
    length = setting.delay + setting.horizon
    context = 2 * (known * d_model + d_model * d_model + length * 2 * d_model)  # once a decision
    assert ours["Global"] == flops + context

    plain.planner.model_ema.train()  # the fused attention of evaluation is not counted
    theirs = counted(lambda: plain(obs))
    by_sample = ("modulation", "map_embedding", "time_embedding")  # for every candidate at every call
    repeated = sum(n for name, n in theirs.items() if name.endswith(by_sample))
    assert repeated > 0 and theirs["Global"] - repeated == flops


def test_flops_grow_with_each_size():
    base = plan_latency.matmul_flops(SETTING, OBS, ACT)
    twice = plan_latency.matmul_flops(SETTING._replace(n_candidates=2 * SETTING.n_candidates), OBS, ACT)
    assert twice == 2 * base
    assert plan_latency.matmul_flops(plan_latency.SETTINGS[0], OBS, ACT) == pytest.approx(203.7e9, rel=0.01)


def test_line_through_points():
    line = plan_latency.fit_line([1, 2, 3, 4], [5.0, 7.0, 9.0, 11.0])
    assert line == pytest.approx({"intercept": 3.0, "slope": 2.0, "R2": 1.0})
    assert plan_latency.fit_line([1, 2, 3, 4], [1.0, -1.0, 1.0, -1.0])["R2"] < 0.3


def test_quick_run_writes_what_it_prints(tmp_path, capsys):
    threads = th.get_num_threads()
    plan_latency.main(["--quick", "--json", str(tmp_path / "latency.json")])
    assert th.get_num_threads() == threads
    result = json.loads((tmp_path / "latency.json").read_text())
    (row,) = result["rows"]
    assert 0 < row["ours p50 ms"] <= row["p95"] <= row["p99"]
    assert row["first"] > 0
    assert row["times as fast"]["low"] <= row["times as fast"]["value"] <= row["times as fast"]["high"]
    assert 0 < row["of the floor"] < 1
    assert {line["p50 in ms by"].split(",")[0] for line in result["scaling"]} == {
        "candidates",
        "denoising steps",
        "environments",
    }
    assert all(np.isfinite(line["slope"]) for line in result["scaling"])
    printed = capsys.readouterr().out
    assert "quick: depth 1, width 32, 2 steps, 4 candidates" in printed and "environments, batched" in printed
