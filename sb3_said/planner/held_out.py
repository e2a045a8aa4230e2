"""Errors on windows that a planner does not learn from, beside those of a small regression."""

from __future__ import annotations

import torch as th
import torch.nn.functional as F

from sb3_said.planner.planner import InpaintingPlanner
from sb3_said.planner.yardstick import RegressionYardstick
from sb3_said.replay.windows import Windows, WindowSource

HELD_OUT_WINDOWS = 1024  # per delay: enough to tell errors apart that differ by 2 %


def draw_held_out(
    source: WindowSource, planner: InpaintingPlanner, seed: int, is_own: bool = False
) -> dict[int, Windows]:
    """Return windows of every delay that the planner is trained for; a delay longer than all episodes has none.

    :param source: windows that are kept from training
    :param planner: whose delays, length and device the windows have
    :param seed: of the draws
    :param is_own: take windows whose decision was made at the delay, where the source has some
    """
    max_delay, generator = planner.max_delay, th.Generator().manual_seed(seed)
    held_out = {}
    for d in [max_delay] if planner.config.mask == "fixed" else range(max_delay + 1):
        starts = th.nonzero(source.remaining > d)[:, 0]  # index d, the decision, is in the same episode
        if is_own and len(own := source.own_starts(d)):
            starts = own
        starts = starts[th.randperm(len(starts), generator=generator)[:HELD_OUT_WINDOWS]]
        if len(starts):
            held_out[d] = source.gather(starts, planner.window_length).to(planner.device)
    return held_out


@th.no_grad()
def held_out_errors(
    planner: InpaintingPlanner, yardstick: RegressionYardstick, held_out: dict[int, Windows]
) -> dict[str, float]:
    """Return mean absolute errors for every delay d that the windows show.

    ``planner/present_error_d4`` is the error of s_t at delay 4, in standard deviations of the states: as the planner
    decodes it, or with ``present="guessed"`` as its first guess has it. ``planner/action_error_d4`` is that of the
    decision a_t, in [-1, 1]; ``..._mlp_d4`` are the regression's. The planner draws one candidate at temperature 0.

    :param held_out: of :func:`draw_held_out`
    """
    metrics, normalize = {}, planner.normalizer.normalize_states
    for d, windows in held_out.items():
        states, actions = windows.states, windows.actions
        delay = th.full((len(states),), d, device=planner.device)
        history = F.pad(actions[:, :d], (0, 0, planner.max_delay - d, 0))  # (B, D, act_dim), as an agent has
        plan = planner.plan(states[:, 0], history, delay, temperature=0.0)
        present, decision = yardstick(normalize(states[:, 0]), actions, delay)
        for name, state, action in (
            ("", normalize(plan.present), plan.action),
            ("_mlp", present, decision.clamp(-1.0, 1.0)),
        ):
            metrics[f"planner/present_error{name}_d{d}"] = (state - normalize(states[:, d])).abs().mean().item()
            metrics[f"planner/action_error{name}_d{d}"] = (action - actions[:, d]).abs().mean().item()
    return metrics


def worse_than_regression(errors: dict[str, float], tolerance: float = 0.05) -> str:
    """Name the errors that lie above those of the regression, such as ``"present_error_d4 0.31 against 0.20"``.

    :param errors: of :func:`held_out_errors`
    :param tolerance: part by which an error may lie above, for windows are few
    """
    bars = {name.replace("_mlp", ""): bar for name, bar in errors.items() if "_mlp" in name}
    return ", ".join(
        f"{name.removeprefix('planner/')} {errors[name]:.3g} against {bar:.3g}"
        for name, bar in bars.items()
        if errors[name] > (1 + tolerance) * bar
    )
