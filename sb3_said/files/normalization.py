"""What VecNormalize has learned, in files without pickle."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_said.files.archive import SavedFileError, load_tree, readable, save_tree
from sb3_said.files.checks import check_argument, check_numbers

_SETTINGS = ("norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon", "norm_obs_keys")
KIND = "VecNormalize"


def normalization_file(agent: Path) -> Path:
    """Return the path of the normalisation of an agent's observations: beside the agent's file."""
    return agent.with_suffix(".normalize.zip")


def save_normalization(path: Path, vec_normalize: VecNormalize) -> None:
    """Write settings and statistics, of rewards and observations."""
    settings = {name: getattr(vec_normalize, name) for name in _SETTINGS}
    save_tree(path, {"settings": settings, "statistics": get_statistics(vec_normalize)}, kind=KIND)


def normalizes_observations(path: Path) -> bool:
    """Return whether a file of :func:`save_normalization` changes observations, or rewards alone.

    :raises SavedFileError: if the file is damaged or forged
    """
    saved = load_tree(path, KIND)
    with readable(path):
        return saved["settings"]["norm_obs"] is not False


def load_normalization(path: Path, venv: VecEnv, training: bool = False) -> VecNormalize:
    """Normalise environments as a file of :func:`save_normalization` says, running no code from it.

    :param training: go on learning the statistics
    :raises SavedFileError: if the file is damaged or forged, or does not fit the environments
    """
    saved = load_tree(path, KIND)
    with readable(path, explained=(ValueError, AssertionError)):  # SB3 asserts what it needs
        settings = {name: saved["settings"][name] for name in _SETTINGS}
        no_clip = {name for name in ("clip_obs", "clip_reward") if settings[name] == math.inf}
        finite = {name: value for name, value in settings.items() if name not in no_clip}
        check_numbers("settings", finite)
        for name, value in finite.items():
            check_argument(name, value, VecNormalize)
        if min(settings[name] for name in ("epsilon", "clip_obs", "clip_reward")) <= 0:
            raise ValueError(f"its epsilon and clips are to be above 0: {settings}")
        vec_normalize = VecNormalize(venv, training, **settings)
        set_statistics(vec_normalize, saved["statistics"])
    return vec_normalize


def get_statistics(vec_normalize: VecNormalize | None) -> dict[str, list[Any]]:
    """Return mean, variance and count of returns and observations; nothing without VecNormalize."""
    return {name: [rms.mean, rms.var, rms.count] for name, rms in _parts(vec_normalize).items()}


def set_statistics(vec_normalize: VecNormalize | None, saved: dict[str, list[Any]]) -> None:
    """Take over what :func:`get_statistics` returned.

    :raises SavedFileError: as :func:`check_statistics`
    """
    check_statistics(vec_normalize, saved)
    for name, rms in _parts(vec_normalize).items():
        rms.mean, rms.var, rms.count = saved[name]


def check_statistics(vec_normalize: VecNormalize | None, saved: dict[str, list[Any]]) -> None:
    """:raises SavedFileError: for statistics of other parts or shapes, and for negative or not finite ones"""
    parts = _parts(vec_normalize)
    if parts.keys() != saved.keys():
        raise SavedFileError(
            f"in the run VecNormalize normalised {', '.join(saved) or 'nothing'}, in this model's environment "
            f"{', '.join(parts) or 'nothing'}; resume with the environment of the run"
        )
    for name, rms in parts.items():
        mean, var, count = saved[name]
        own: list[Any] = [rms.mean, rms.var, rms.count]
        for given, like in zip((mean, var, count), own, strict=True):
            if np.shape(given) != np.shape(like) or not np.isfinite(given).all():
                raise SavedFileError(f"its statistics of {name} do not fit: {given!s:.60} for {like!s:.60}")
        if min(np.min(var), count) < 0:
            raise SavedFileError(f"its statistics of {name} do not fit: a variance or count is negative")


def _parts(vec_normalize: VecNormalize | None) -> dict[str, RunningMeanStd]:
    if vec_normalize is None:
        return {}
    observations = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
    if isinstance(observations, RunningMeanStd):
        observations = {"observation": observations}
    return {"return": vec_normalize.ret_rms, **{f"obs/{key}": rms for key, rms in observations.items()}}
