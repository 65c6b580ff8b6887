"""Steps that follow the error against even ones: what each is off, and what it takes.

    python benchmarks/step_control.py [--size 17] [--motions hung snap pull] [--fabric cotton] [--repeats 9]

The default method makes the motions of ``motions.py`` in even steps, and as one step in parts (``Simulator(...,
step_error=...)``) that begin with 1 ms. Error as of chart 1 (``work_precision.py``). Wall times are of all the motion's
runs in turn, on one core; "of even's" is the ratio to what even steps take for the same error, by a line between
logarithms of the two nearest, from the same turn: its median.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, one_core, print_table, turns, write_csv
from motions import Motion, add_options, find
from references import end, reference

import warp_yarn as wy

COUNTS = (5, 10, 20, 40, 80, 160)
"""Even steps in a motion."""

STEP_ERRORS = (2e-2, 5e-3, 1e-3, 2e-4, 5e-5)

FIRST_PART = 1e-3
"""[s]"""


def made(simulator: wy.Simulator, count: int) -> Callable[[], np.ndarray]:
    """A function that makes all of a motion from its beginning, and returns where it ends."""
    start, parts = simulator.state, simulator.substepping

    def run() -> np.ndarray:
        simulator.state, simulator.steps_done = start, 0
        parts.next_size, parts.accepted, parts.rejected = FIRST_PART / simulator.step_size, 0, 0
        return end(simulator, count)

    return run


def rows(motion: Motion, name: str, size: int, repeats: int) -> list[dict[str, Any]]:
    converged = reference(motion, size)
    runs, result = [], []
    for count in COUNTS:
        runs.append((motion.simulator(size, step=motion.duration / count), count))
    for allowed in STEP_ERRORS:
        runs.append((motion.simulator(size, step=motion.duration, step_error=allowed), 1))
    makes = [made(*run) for run in runs]
    for (simulator, count), make in zip(runs, makes, strict=True):
        row = {"motion": name, **motion.about(size), "step error": simulator.step_error or "even"}
        row["error"] = converged.error(make())
        parts = simulator.substepping
        row |= {"steps": count, "rejected": 0} if count > 1 else {"steps": parts.accepted, "rejected": parts.rejected}
        result.append(row)

    def timed(make: Callable[[], np.ndarray]) -> float:
        begin = time.perf_counter()
        make()
        return time.perf_counter() - begin

    seconds = np.array(turns([functools.partial(timed, make) for make in makes], repeats)) / motion.duration
    even = len(COUNTS)
    log_errors = np.log([row["error"] for row in result])
    for k, row in enumerate(result):
        timing = Timing.of(seconds[k])
        row |= {"wall [s per simulated s]": timing.median, "wall IQR": timing.upper - timing.lower, "of even's": ""}
        if k >= even and log_errors[:even].min() <= log_errors[k] <= log_errors[:even].max():
            order = np.argsort(log_errors[:even])
            at = [np.exp(np.interp(log_errors[k], log_errors[order], np.log(turn[order]))) for turn in seconds.T]
            row["of even's"] = float(np.median(seconds[k] / at))
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=17, help="rows and columns (%(default)s)")
    add_options(parser)
    parser.add_argument("--repeats", type=int, default=9, help="turns (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "step_control.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    table = []
    for name in options.motions:
        table += rows(find(name, options.fabric), name, options.size, options.repeats)
        print_table(table[-len(COUNTS) - len(STEP_ERRORS) :])
    write_csv(options.output, table, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
