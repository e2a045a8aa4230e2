"""An agent that has learned a little, and its file."""

import pytest
from saving import make_sac


@pytest.fixture(scope="module")
def trained():
    return make_sac().learn(20)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "agent")
    return tmp_path / "agent.zip"
