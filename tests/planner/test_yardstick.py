"""The regression: its loss is a naive sum over windows, of what the planner has to decode."""

import torch as th
from small_planner import ACT, DELAY, LENGTH, OBS, make_windows, seeded

from sb3_said.planner.yardstick import RegressionYardstick


@th.no_grad()
def test_its_loss_is_a_naive_sum_over_windows_that_reach_the_decision():
    yardstick, windows = RegressionYardstick(OBS, ACT, DELAY, hidden=16), make_windows(40)
    delay, weight = th.arange(40) % (DELAY + 1), th.rand(40, generator=seeded(1))
    total, n_valid = 0.0, 0
    for states, actions, valid, d, w in zip(*windows[:3], delay.tolist(), weight.tolist(), strict=True):
        if not valid[d]:
            continue
        known = actions.clone()
        known[d:] = 9.0  # none of these is read
        present, decision = yardstick(states[:1], known[None], th.tensor([d]))
        error = (present[0] - states[d]).square().mean() + (decision[0] - actions[d]).square().mean()
        total, n_valid = total + w * error, n_valid + 1
    assert 0 < n_valid < 40 and LENGTH > DELAY
    th.testing.assert_close(yardstick.loss(windows, delay, weight), total / n_valid)
