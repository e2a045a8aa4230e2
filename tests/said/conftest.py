"""Trained agents for the tests of what they answer and of their files."""

import pytest
from small_agent import make
from small_student import taught_agent


@pytest.fixture(scope="module")
def trained():
    """A trained agent; tests must leave it as it is."""
    return make().learn(40)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "said.zip")
    return tmp_path / "said.zip"


@pytest.fixture(scope="module")
def taught():
    """A trained agent with a student; tests must leave it as it is."""
    return taught_agent()


@pytest.fixture
def pupil(taught):
    """The taught agent, for tests that distill another student."""
    before = taught.policy.student
    yield taught
    taught.policy.student, taught.student_width = before, before.width
