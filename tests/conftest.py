"""Settings of all tests."""

import gc
import multiprocessing
from contextlib import nullcontext

import pytest
from hypothesis import settings
from small_planner import with_small_first_guesses

# What is forked, SB3's environments among it, begins in a process that has imported these once
multiprocessing.set_forkserver_preload(["sb3_said.zoo.train", "torch._dynamo", "mujoco"])
settings.register_profile("suite", max_examples=30, deadline=None)  # five minutes for all tests on two cores
settings.load_profile("suite")


def pytest_collection_finish():
    """Let no collection of garbage look again and again at what the imports have left."""
    gc.collect()
    gc.freeze()


# Their agents are loaded by processes of the package's own, or come from files; or they ask how well it is learned
OF_THE_USUAL_SIZE = {"test_over_delays", "test_playing", "test_shipped_agents", "test_belief"}


@pytest.fixture(scope="module", autouse=True)
def small_first_guesses(request):
    """In all tests but these."""
    with nullcontext() if request.path.stem in OF_THE_USUAL_SIZE else with_small_first_guesses():
        yield
