"""What each time-stepping method costs and how far it is off, on the paper's hung cloth, all terms, double precision.

    python benchmarks/integrators.py [--size 5] [--repeats 7]

The error is the root mean square over the nodes of the distance of their positions after 25 ms to converged ones, over
that of their displacement. Converged: the second-order method at a 64th and a 128th of a millisecond, extrapolated;
the table's last row is how far eq. 2, extrapolated from the same steps, is from that. The time is that of the 25 ms,
kernels compiled and graphs captured before.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, measure, one_core, print_table, write_csv

import warp_yarn as wy
from warp_yarn import paper
from warp_yarn.integrators import INTEGRATORS

DURATION = 0.025
STEPS = tuple(1e-3 / 2**k for k in range(5))
FINEST = 1e-3 / 64


def simulator(size: int, method: str, step: float, **options: Any) -> wy.Simulator:
    return wy.Simulator(paper.hung_cloth(rows=size, columns=size), step=step, integrator=method, **options)


def end(simulator: wy.Simulator) -> np.ndarray:
    return simulator.run(round(DURATION / simulator.step_size)).position[-1]


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def extrapolated(size: int, method: str) -> np.ndarray:
    """Positions from two fine steps, the leading power of the error taken out."""
    exact = {"tolerance": 1e-12, "newton_tolerance": 1e-9}
    coarse, fine = (end(simulator(size, method, step, **exact)) for step in (FINEST, FINEST / 2))
    factor = 2.0 ** INTEGRATORS[method].order
    return (factor * fine - coarse) / (factor - 1.0)


def benchmark(size: int, repeats: int) -> list[dict[str, Any]]:
    """A row for each method and step, and the check of the reference."""
    start = paper.hung_cloth(rows=size, columns=size).cloth.position
    reference = extrapolated(size, "sdirk2")
    moved = distance(reference, start)
    rows = []
    for method, cls in INTEGRATORS.items():
        for step in STEPS:
            sim = simulator(size, method, step)
            rest = sim.state
            error = distance(end(sim), reference) / moved

            def run(sim: wy.Simulator = sim, rest: wy.State = rest) -> float:
                sim.state = rest
                begin = time.perf_counter()
                end(sim)
                return time.perf_counter() - begin

            (timing,) = measure([run], repeats)
            row = {"method": method, "order": cls.order, "step [ms]": 1e3 * step, "error": error}
            rows.append({**row, **timing.columns("25 ms take")})
    check = distance(extrapolated(size, "linear"), reference) / moved
    rows.append({**dict.fromkeys(rows[0], ""), "method": "reference against eq. 2's", "error": check})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=5, help="rows and columns (%(default)s)")
    parser.add_argument("--repeats", type=int, default=7, help="timed runs (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "integrators.csv", help="CSV file (%(default)s)")
    options = parser.parse_args()
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    rows = benchmark(options.size, options.repeats)
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print_table(rows)
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
