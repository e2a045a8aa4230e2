"""Delays on the command line: what is read, and what is refused."""

from __future__ import annotations

import argparse

import pytest

from sb3_said.zoo.arguments import Delay, ages_under, device, largest_delay, read_delay


@pytest.mark.parametrize(
    ("words", "delay"),
    [
        ([], None),
        (["4"], 4),
        (["0", "8"], [0, 8]),
        (["WIFI_20MS"], "WIFI_20MS"),
        (["DroppedPackets(4, p=0.1)"], "DroppedPackets(4, p=0.1)"),
    ],
)
def test_what_delay_takes(words: list[str], delay: Delay) -> None:
    assert read_delay(words) == delay


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-1"], "whole number of control steps >= 0"),
        (["1", "2", "3"], "--delay takes N, or LOW HIGH"),
        (["UniformDelay(0,", "8)"], "--delay takes N, or LOW HIGH"),
        (["4", "WIFI_20MS"], "--delay takes N, or LOW HIGH"),
        (["print(1)"], "expected numbers, WIFI_20MS, FixedDelay"),
        (["²"], "is no delay: .* Write it as in docs"),
    ],
)
def test_a_bad_delay_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_delay(words)


@pytest.mark.parametrize(
    ("delay", "ages"),
    [(None, [0]), (4, [4]), ("FixedDelay(4)", [4]), ([0, 2], [0, 1, 2]), ("UniformDelay(2, 3)", [2, 3])],
)
def test_a_delay_has_a_largest_age_and_may_vary(delay: Delay, ages: list[int]) -> None:
    assert (largest_delay(delay), ages_under(delay)) == (ages[-1], ages)


def test_a_device_that_torch_has_not_here_is_refused_at_once() -> None:
    assert [device(word) for word in ("auto", "cpu", "cpu:0")] == ["auto", "cpu", "cpu:0"]
    refused = []
    for word in ("mps", "xpu", "hpu"):  # of three makers: no machine has all
        try:
            device(word)
        except argparse.ArgumentTypeError as error:
            assert str(error).startswith(f"auto, cpu, cuda or another that torch has, got {word}: ")
            refused.append(word)
    assert refused
