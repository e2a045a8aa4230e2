"""Checks of arguments."""

from __future__ import annotations

from collections.abc import Sequence


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a name that is not among the choices.

    :raises ValueError: saying what was given and what was expected
    """
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, expected one of {tuple(choices)}.")
