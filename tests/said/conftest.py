"""A trained agent for the tests of what it answers and of its files."""

import pytest
from small_agent import make


@pytest.fixture(scope="module", autouse=True)
def small_first_guesses():
    """A planner's first guess is as small as the planners here, and takes half of the time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sb3_said.planner.plain.MODEL_WIDTH", 32)
        patched.setattr("sb3_said.planner.plain.MODEL_BLOCKS", 1)
        patched.setattr("sb3_said.planner.first_guess.CLONE_WIDTH", 32)
        yield


@pytest.fixture(scope="module")
def trained():
    """A trained agent; tests must leave it as it is."""
    return make().learn(80)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "said.zip")
    return tmp_path / "said.zip"
