"""A trained agent for the tests of what it answers and of its files."""

import pytest
from small_agent import make


@pytest.fixture(scope="module")
def trained():
    """A trained agent; tests must leave it as it is."""
    return make().learn(80)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "said.zip")
    return tmp_path / "said.zip"
