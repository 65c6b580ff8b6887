"""A hundred thousand steps of a hung cloth: what its energy and this process's memory do.

    python benchmarks/long_run.py [--size 5] [--fabric cotton] [--steps 100000]

The wind blows for the first half and then stops. From there on the energy (kinetic, of every term and of gravity) may
only fall: the command fails where it grows, or anything is not finite, or memory grows.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tqdm
import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv

import warp_yarn as wy
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS

SAMPLES = 100
"""Of energy and memory, equally spaced."""
GROWTH = 1e-3
"""That the energy may rise from one sample to the next after the wind, relative to the most that it has been above its
last: a sample falls anywhere in a swing, and eq. 5's energy has the contact force in it."""
MEGABYTES = 20.0
"""That memory may grow from the tenth sample on: the interpreter's own coming and going."""


def memory() -> float:
    """Of this process [MB]; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * 4096 / 1e6


def run(size: int, steps: int, fabric: str = "paper") -> list[dict[str, Any]]:
    """A row a sample."""
    simulator = wy.Simulator(paper.hung(FABRICS[fabric](rows=size, columns=size)))
    rows = []
    part = max(1, steps // SAMPLES)
    for _ in tqdm.trange(steps // part, unit="sample", disable=None):
        if 2 * simulator.steps_done >= steps:
            simulator.arrays["wind_velocity"].zero_()
        # a trajectory of every frame would be the memory that is looked for
        simulator.run(part)
        state = simulator.state
        finite = bool(np.isfinite(state.position).all() and np.isfinite(state.velocity).all())
        energy = simulator.energy()
        rows.append(
            {
                "fabric": fabric,
                "step": simulator.steps_done,
                "wind": float(simulator.arrays["wind_velocity"].numpy()[0, 1]),
                "finite": finite,
                "kinetic energy [J]": energy["mass"],
                "energy [J]": sum(energy.values()),
                "memory [MB]": memory(),
            }
        )
    return rows


def faults(rows: list[dict[str, Any]]) -> list[str]:
    """What the run must not do, and did."""
    result = [f"step {row['step']}: not finite" for row in rows if not row["finite"]]
    calm = np.array([row["energy [J]"] for row in rows if row["wind"] == 0.0])
    if len(calm) > 1 and np.diff(calm).max() > GROWTH * np.ptp(calm):
        result.append(f"energy grew by {np.diff(calm).max():g} J without wind")
    kept = [row["memory [MB]"] for row in rows[len(rows) // 10 :]]
    if max(kept) - kept[0] > MEGABYTES:
        result.append(f"memory grew from {kept[0]:.0f} to {max(kept):.0f} MB")
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=5, help="rows and columns (%(default)s)")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    parser.add_argument("--steps", type=int, default=100_000, help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "long_run.csv", help="CSV file (%(default)s)")
    options = parser.parse_args()
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    rows = run(options.size, options.steps, options.fabric)
    print_table(rows[:: max(1, len(rows) // 20)])
    write_csv(options.output, rows, environment())
    print("written:", options.output)
    found = faults(rows)
    for fault in found:
        print(fault, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
