"""A small planner whose weights are random, and what to ask it."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch as th

from sb3_said.planner import InpaintingPlanner, PlannerConfig
from sb3_said.replay.windows import Windows

OBS, ACT, DELAY = 3, 2, 4
SMALL = PlannerConfig(
    depth=2,
    d_model=32,
    horizon=4,
    precision="float32",
    sampling_steps=3,
    n_candidates=5,
    temperature=0.5,
    scored_states="future",
    present="inpainted",
)
LENGTH = DELAY + SMALL.horizon


@contextmanager
def with_small_first_guesses() -> Iterator[None]:
    """A planner's first guess is as small as the planners of the tests, and takes half of the time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sb3_said.planner.plain.MODEL_WIDTH", 32)
        patched.setattr("sb3_said.planner.plain.MODEL_BLOCKS", 1)
        patched.setattr("sb3_said.planner.first_guess.CLONE_WIDTH", 32)
        yield


def make_planner(max_delay=DELAY, **changes):
    """A planner whose weights and statistics are random, so that every input shows in the output."""
    planner = InpaintingPlanner(OBS, ACT, max_delay, dataclasses.replace(SMALL, **changes))
    generator = th.Generator().manual_seed(1)
    for parameter in planner.parameters():
        th.nn.init.normal_(parameter, std=0.2, generator=generator)
    states = th.tensor([10.0, 0.0, -3.0]) + th.tensor([4.0, 0.1, 1.0]) * th.randn(100, OBS, generator=generator)
    planner.fit_normalizer(states, th.rand(100, ACT, generator=generator) * 2 - 1)
    return planner


def make_batch(n, max_delay=DELAY, seed=0):
    generator = th.Generator().manual_seed(seed)
    observation = 5 * th.randn(n, OBS, generator=generator)
    history = th.rand(n, max_delay, ACT, generator=generator) * 2 - 1
    return observation, history, th.randint(max_delay + 1, (n,), generator=generator)


def make_windows(n=6, seed=0):
    generator = th.Generator().manual_seed(seed)
    valid = th.arange(LENGTH) < th.randint(1, LENGTH + 1, (n, 1), generator=generator)
    states = 5 * th.randn(n, LENGTH, OBS, generator=generator)
    actions = th.rand(n, LENGTH, ACT, generator=generator) * 2 - 1
    return Windows(states, actions, valid, th.rand(n, generator=generator))


def existing(windows, delay):
    """Steps that are in the episode and within the horizon of their delay: (n, L) bool."""
    return windows.valid & (th.arange(LENGTH) < delay[:, None] + SMALL.horizon)


def seeded(seed=0):
    return th.Generator().manual_seed(seed)


def good():
    observation, history, delay = make_batch(2)
    return {"observation": observation, "action_history": history, "delay": delay}


class FakeNetwork(th.nn.Module):
    """Answers with a stored tensor and remembers what it was shown."""

    def __init__(self, output):
        super().__init__()
        self.output = output

    def context(self, window, known, guess=None):
        self.known = known

    def modulations(self, t):
        self.t = t

    def forward(self, x, context, modulations, valid):
        self.x, self.valid = x, valid
        return self.output
