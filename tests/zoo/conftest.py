"""Runs whose cells are played."""

from pathlib import Path

import pytest

# small_run needs rl_zoo3, without which the files of tests are skipped and this one is read all the same


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from small_run import ENV, TINY_PLANNER, write_run

    from sb3_said import SAID

    planner = {**TINY_PLANNER, "first_guess": "none"}  # which each cell would load
    return write_run(tmp_path_factory.mktemp("said") / f"{ENV}-delay2_1", SAID, 2, planner_kwargs=planner)


@pytest.fixture(scope="module")
def sadr(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from small_run import ENV, write_run

    from sb3_said import DelayedSAC

    return write_run(tmp_path_factory.mktemp("sadr") / f"{ENV}-delay1_1", DelayedSAC, 1)
