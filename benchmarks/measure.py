"""What the benchmarks share: timing turn by turn, the machine's matrix-product rate, tables and JSON."""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from tqdm import tqdm

from sb3_said.evaluation import Interval, confidence_interval
from sb3_said.evaluation.statistics import FEWEST_RESAMPLED
from sb3_said.files import atomic as files
from sb3_said.planner.precision import has_bfloat16
from sb3_said.zoo.arguments import explained

PATIENCE = 2.0  # seconds after which a measurement shows its progress
DTYPES = {"float32": th.float32, "bfloat16": th.bfloat16}


def parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--num-threads", type=int, help="torch threads (default: %(default)s; None: all cores)")
    made.add_argument("--rounds", type=int, help="turns of each variant; more make narrower intervals")
    made.add_argument("--device", default="cpu", help="torch device, such as cuda")
    made.add_argument("--json", type=Path, metavar="FILE", help="also write settings, machine and figures to FILE")
    made.add_argument("--product-size", type=int, metavar="N", help="rows and columns of the matrices whose product "
                      "gives the machine's rate; by default 2048, on a GPU 8192")  # fmt: skip
    made.add_argument("--product-seconds", type=float, default=1.0, help="time to measure that rate for")
    return made


def parse(made: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """Read a command line and set the threads it asks for."""
    args = made.parse_args(argv)
    if args.num_threads:
        th.set_num_threads(args.num_threads)
    return args


def progress(text: str) -> None:
    """Say on stderr what is being measured; tables go to stdout."""
    print(text, file=sys.stderr, flush=True)


def turn_by_turn(
    variants: Mapping[str, Callable[[], Any]], rounds: int, device: str | th.device = "cpu"
) -> dict[str, np.ndarray]:
    """Time variants in turn, in both orders alternately, so that a drift of the machine meets all of them alike.

    Every variant first runs once, uncounted. A measurement longer than ``PATIENCE`` shows its progress on stderr.

    :param variants: what to time, by name
    :param rounds: turns of each
    :param device: torch device, which must finish before the clock is read
    :return: seconds of each turn by name, (rounds,) each
    """

    def wait() -> None:
        if th.device(device).type == "cuda":
            th.cuda.synchronize(device)

    names = list(variants)
    seconds = {name: np.empty(rounds) for name in names}
    for name in names:
        variants[name]()
    for turn in tqdm(range(rounds), unit="turn", leave=False, delay=PATIENCE, mininterval=1.0):
        for name in names if turn % 2 == 0 else names[::-1]:
            wait()
            began = time.perf_counter()
            variants[name]()
            wait()
            seconds[name][turn] = time.perf_counter() - began
    return seconds


def ratio(slow: np.ndarray, fast: np.ndarray) -> Interval:
    """Return how many times as long ``slow`` takes: the median of the ratios turn by turn, with its interval.

    For fewer than ten turns the interval is the range of the ratios. It misses the median only if all ratios are on one
    side, so its ``confidence`` is 1 - 2^(1 - rounds), above .95 from six turns on. Of so few turns a bootstrap or
    Student's t covers less than it says.

    :param slow: (rounds,) seconds
    :param fast: (rounds,) seconds of the same turns
    """
    ratios = slow / fast
    if len(ratios) >= FEWEST_RESAMPLED:
        return confidence_interval(ratios, np.median)
    low, high = (ratios.min(), ratios.max()) if len(ratios) > 1 else (np.nan, np.nan)
    sure = 1.0 - 2.0 ** (1 - len(ratios))
    return Interval(float(np.median(ratios)), float(low), float(high), sure, len(ratios), "range")


def matmul_rate(dtype: str, device: str | th.device = "cpu", size: int | None = None, seconds: float = 1.0) -> float:
    """Return what this machine reaches in large square matrix products, the 95th percentile in FLOP/s.

    :param dtype: ``"float32"`` or ``"bfloat16"``, which is emulated without :func:`has_bfloat16` and can take minutes
    :param device: to measure
    :param size: rows and columns; by default 2048, on a GPU 8192
    :param seconds: to measure for, at least
    """
    n = size or (2048 if th.device(device).type == "cpu" else 8192)
    a, b = (th.randn(n, n, device=device).to(DTYPES[dtype]) for _ in range(2))
    out = th.empty_like(a)
    rounds = 3
    while True:
        times = turn_by_turn({"matmul": lambda: th.mm(a, b, out=out)}, rounds, device)["matmul"]
        if times.sum() >= seconds:
            return float(2 * n**3 / np.percentile(times, 5))
        rounds *= 2


def matmul_rates(args: argparse.Namespace) -> dict[str, float]:
    """Return :func:`matmul_rate` of float32, and of bfloat16 where the device multiplies it in hardware.

    :param args: of :func:`parser`
    """
    formats = ["float32"] + ["bfloat16"] * has_bfloat16(th.device(args.device))
    progress(f"matrix products in {' and '.join(formats)}")
    return {dtype: matmul_rate(dtype, args.device, args.product_size, args.product_seconds) for dtype in formats}


def percentiles(seconds: np.ndarray) -> dict[str, float]:
    """Return p50, p95 and p99 in milliseconds."""
    return {f"p{q}_ms": float(1e3 * np.percentile(seconds, q)) for q in (50, 95, 99)}


def print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows of the same keys as a Markdown table."""
    header = list(rows[0])
    print(f"| {' | '.join(header)} |")
    print(f"|{'|'.join('---' if isinstance(rows[0][key], str) else '---:' for key in header)}|")
    for row in rows:
        print(f"| {' | '.join(_cell(row[key]) for key in header)} |")


def write_json(path: Path | None, args: argparse.Namespace, rows: Sequence[Mapping[str, Any]], **more: Any) -> None:
    """Write what was measured, with which settings, when and on what machine; nothing without a path."""
    if path is None:
        return
    settings = {key: value for key, value in vars(args).items() if key != "json"}
    result = {"date": date.today().isoformat(), "settings": settings, "machine": machine(args.device)}
    files.write_json(path, {**result, "rows": list(rows), **more}, default=_plain)


def read_json(path: Path) -> Any:
    """
    :raises ValueError: for a file that is no JSON
    """
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}.") from error


def resumed(p: argparse.ArgumentParser, path: Path, settings: dict[str, Any], **empty: Any) -> dict[str, Any]:
    """Return what a file of ``--json`` holds, or a document with nothing in it but the settings yet.

    The program ends if the file has other settings.

    :param p: reports the error
    :param empty: parts of a new document
    """
    if not path.exists():
        return {**settings, **empty}
    with explained(p):
        document: dict[str, Any] = read_json(path)
        if not isinstance(document, dict) or not empty.keys() <= document.keys():
            raise ValueError(f"{path} was not written by --json of this program: give another.")
        if found := {name: document.get(name) for name in settings if document.get(name) != settings[name]}:
            asked = {name: settings[name] for name in found}
            raise ValueError(f"{path} holds results of {found}, but {asked} was asked for: give another --json.")
    return document


def report(args: argparse.Namespace, rows: list[dict[str, Any]], **more: Any) -> list[dict[str, Any]]:
    """Print the table of ``rows``, write it with ``more`` where ``--json`` says, and return it."""
    print_table(rows)
    write_json(args.json, args, rows, **more)
    return rows


def machine(device: str | th.device = "cpu") -> dict[str, Any]:
    """Return what the figures depend on: processor, threads, versions."""
    capabilities = th.cpu.get_capabilities() if hasattr(th.cpu, "get_capabilities") else {}
    on_gpu = th.device(device).type == "cuda"
    return {
        "device": th.cuda.get_device_name(device) if on_gpu else _processor(),
        "bfloat16": [name for name in ("avx512_bf16", "amx_bf16") if capabilities.get(name)],
        "threads": th.get_num_threads(),
        "python": platform.python_version(),
        "torch": th.__version__,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor()
    )


def _cell(value: Any) -> str:
    if isinstance(value, Interval):
        return f"{value.value:.2f} [{value.low:.2f}, {value.high:.2f}]"
    return f"{value:,.2f}" if isinstance(value, float) else "" if value is None else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Interval):
        return {"value": value.value, "low": value.low, "high": value.high, "confidence": value.confidence}
    return str(value)
