"""Times at equal error: what each method takes to be 1 % and 0.1 % off, side by side.

    python benchmarks/equal_error.py [--sizes 5 17] [--motions hung drop] [--fabric cotton] [--repeats 9]

Chart 1 (``work_precision.py``) has points at given steps, measured one after the other; this is for ratios. Each method
makes the motion, with default tolerances and double precision, at the largest step (of those that fit whole times) from
which on it is nearer to the converged motion than the target. Then all methods run in turn, so that what else the
machine does falls on all alike: the ratio to eq. 2's time is that of the same turn, its median and quartiles over the
turns. One core; loading kernels and capturing graphs come before.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, one_core, print_table, turns, write_csv
from motions import Motion, add_options, find
from references import TARGETS, Reference, end, reference
from work_precision import EQ_2

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS

LARGEST_STEP = 1.25e-2
"""Where the search begins [s]."""
MOST_STEPS = 8192
"""A method that needs more of them is left out."""


def error(motion: Motion, size: int, method: str, steps: int, converged: Reference) -> float:
    """Of the motion in so many steps, relative to what moved; infinite where a step cannot be made."""
    simulator = motion.simulator(size, step=motion.duration / steps, integrator=method)
    try:
        return converged.error(end(simulator, steps))
    except wy.SimulationError:
        return math.inf


def steps_to(
    motion: Motion, size: int, method: str, targets: Sequence[float], converged: Reference
) -> list[int | None]:
    """The fewest steps from which on a method is nearer than each target, to 3 %; None where it does not get there."""
    counts = [max(1, round(motion.duration / LARGEST_STEP))]
    errors = [error(motion, size, method, counts[0], converged)]
    while errors[-1] > min(targets) and 2 * counts[-1] <= MOST_STEPS:
        counts.append(2 * counts[-1])
        errors.append(error(motion, size, method, counts[-1], converged))
    found: list[int | None] = []
    for target in targets:
        if errors[-1] > target:
            found.append(None)
            continue
        # the last step that is too large, and the one half as large
        last = max((k for k, e in enumerate(errors) if e > target), default=-1)
        many = counts[last + 1]
        few = counts[last] if last >= 0 else many
        while many - few > max(1, 0.03 * many):
            middle = (few + many) // 2
            if error(motion, size, method, middle, converged) > target:
                few = middle
            else:
                many = middle
        found.append(many)
    return found


def side_by_side(motion: Motion, size: int, steps: dict[str, int], repeats: int) -> dict[str, np.ndarray]:
    """Wall times per simulated second of every method's runs, the k-th of one beside the k-th of another."""

    def timed(method: str, count: int) -> Callable[[], float]:
        simulator = motion.simulator(size, step=motion.duration / count, integrator=method)
        beginning = simulator.state

        def run() -> float:
            simulator.state, simulator.steps_done = beginning, 0
            begin = time.perf_counter()
            end(simulator, count)
            return (time.perf_counter() - begin) / motion.duration

        return run

    seconds = turns([timed(method, count) for method, count in steps.items()], repeats)
    return {method: np.array(times) for method, times in zip(steps, seconds, strict=True)}


def rows(motion: Motion, name: str, size: int, repeats: int) -> list[dict[str, Any]]:
    converged = reference(motion, size)
    needed = {method: steps_to(motion, size, method, TARGETS, converged) for method in INTEGRATORS}
    result = []
    for k, target in enumerate(TARGETS):
        steps = {method: counts[k] for method, counts in needed.items() if counts[k] is not None}
        seconds = side_by_side(motion, size, steps, repeats)
        for method in INTEGRATORS:
            row: dict[str, Any] = {"motion": name, **motion.about(size), "error": target, "method": method}
            if method not in steps:
                empty = dict.fromkeys(("step [ms]", "wall [s per simulated s]", "wall IQR", "of eq. 2's", "of IQR"), "")
                result.append(row | empty | {"step [ms]": f"< {1e3 * motion.duration / MOST_STEPS:.2g}"})
                continue
            timing = Timing.of(seconds[method])
            row["step [ms]"] = 1e3 * motion.duration / steps[method]
            row |= {"wall [s per simulated s]": timing.median, "wall IQR": timing.upper - timing.lower}
            if EQ_2 in steps:
                ratio = Timing.of(seconds[method] / seconds[EQ_2])
                row |= {"of eq. 2's": ratio.median, "of IQR": ratio.upper - ratio.lower}
            else:
                row |= {"of eq. 2's": "", "of IQR": ""}
            result.append(row)
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[5, 17], help="rows and columns (5 17)")
    add_options(parser, default=["hung"])
    parser.add_argument("--repeats", type=int, default=9, help="turns (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "equal_error.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    table = []
    for name, size in itertools.product(options.motions, options.sizes):
        table += rows(find(name, options.fabric), name, size, options.repeats)
        print_table(table[-len(TARGETS) * len(INTEGRATORS) :])
    write_csv(options.output, table, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
