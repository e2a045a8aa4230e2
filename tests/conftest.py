"""Settings of all tests."""

import pytest
from hypothesis import settings

settings.register_profile("suite", max_examples=30, deadline=None)  # five minutes for all tests on two cores
settings.load_profile("suite")


@pytest.fixture(scope="module")
def small_first_guesses():
    """A planner's first guess is as small as the planners of these tests, and takes half of the time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sb3_said.planner.plain.MODEL_WIDTH", 32)
        patched.setattr("sb3_said.planner.plain.MODEL_BLOCKS", 1)
        patched.setattr("sb3_said.planner.first_guess.CLONE_WIDTH", 32)
        yield
