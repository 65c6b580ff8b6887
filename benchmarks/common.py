"""What the benchmarks share: timing by medians, the machine they ran on, tables and CSV files."""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"


@dataclasses.dataclass(frozen=True)
class Timing:
    """Wall times of repeated runs [s]: the median and the quartiles around it."""

    median: float
    lower: float
    upper: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        lower, median, upper = np.percentile(seconds, [25.0, 50.0, 75.0])
        return cls(float(median), float(lower), float(upper))

    def columns(self, name: str) -> dict[str, float]:
        """Median and interquartile range in ms, as two columns of a table."""
        return {f"{name} [ms]": 1e3 * self.median, f"{name} IQR [ms]": 1e3 * (self.upper - self.lower)}


def turns(functions: Sequence[Callable[[], Any]], repeats: int) -> list[list[float]]:
    """Wall times of every function [s], the k-th of one beside the k-th of another, so that what else the machine does
    falls on all alike; a first turn is not counted.

    A function returns how long it took [s], or None: then all of it counts.
    """
    seconds: list[list[float]] = [[] for _ in functions]
    for turn in range(repeats + 1):
        for function, times in zip(functions, seconds, strict=True):
            start = time.perf_counter()
            own = function()
            elapsed = time.perf_counter() - start
            if turn > 0:
                times.append(elapsed if own is None else own)
    return seconds


def measure(functions: Sequence[Callable[[], Any]], repeats: int) -> list[Timing]:
    """Times functions in turns."""
    return [Timing.of(times) for times in turns(functions, repeats)]


def one_core() -> None:
    """Keeps this process on one core, libraries that would start threads included."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def environment(*packages: str) -> dict[str, str]:
    """The processor, how many processes wanted it in the last minute, versions, and the git revision ("+" where files
    differ from it)."""
    versions = {name: importlib.metadata.version(name) for name in ("warp_yarn", "warp-lang", "numpy", *packages)}
    load = f"{os.getloadavg()[0]:.1f} of {os.cpu_count()}" if hasattr(os, "getloadavg") else "unknown"
    machine = {"processor": _processor(), "load": load, "python": platform.python_version()}
    return {**machine, **versions, "revision": _revision()}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _revision() -> str:
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty=+"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Rows under their names, numbers with 3 significant digits."""
    cells = [list(rows[0]), *([_text(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))


def _text(value: Any) -> str:
    return f"{value:#.3g}" if isinstance(value, float) else str(value)


def write_csv(path: Path, rows: Sequence[dict[str, Any]], environment: dict[str, str]) -> None:
    """A CSV file of the rows, with the environment as further columns of each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *environment])
        writer.writeheader()
        writer.writerows({**row, **environment} for row in rows)
