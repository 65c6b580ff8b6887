"""Newton's iterations at a hundred impacts, where naive forms of contact stall.

    python benchmarks/impacts.py [--fabrics paper handkerchief cotton] [--seeds 25]

7 × 7 yarns fall on a plane with friction, turned anyhow, at 0.3 to 1 m/s in any direction, for 20 ms: two methods, two
steps, from as many starts, solved to the tolerance of a differentiable run, 1e-8. "mean" and "most" are of the steps of
all starts, "parted" counts steps that were made in parts, those that are damped left out (an impact is left to
implicit Euler).
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, print_table, write_csv
from scipy.spatial.transform import Rotation

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS

METHODS = ("implicit-euler", "sdirk2")
STEPS = (1e-3, 0.25e-3)
DURATION = 0.02
TOLERANCE = 1e-8
GROUND = -0.5
"""Height of the plane [m]: far below the cloth's place at rest, which is checked too."""
CLEARANCE = 2.5e-3
"""Of the lowest node at the start [m]."""


def start(cloth: wy.Cloth, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Turn a cloth anyhow above the plane, and throw it down; gives positions and velocities."""
    rng = np.random.default_rng(seed)
    x = Rotation.random(rng=rng).apply(cloth.position - cloth.position.mean(axis=0))
    x[:, 2] += GROUND + CLEARANCE - x[:, 2].min()
    v = rng.normal(size=3)
    v *= rng.uniform(0.3, 1.0) / np.linalg.norm(v)
    v[2] = -abs(v[2]) - 0.3
    return x, np.tile(v / max(1.0, float(np.linalg.norm(v))), (len(x), 1))


def simulator(fabric: str, seed: int, step: float, integrator: str) -> wy.Simulator:
    cloth = FABRICS[fabric](rows=7, columns=7)
    ground = wy.Plane(point=(0.0, 0.0, GROUND), normal=(0.0, 0.0, 1.0), friction=0.3)
    contact = wy.Contact(slip_speed=1e-4)
    scene = wy.Scene(cloth, obstacles=[ground], self_contact=True, contact=contact)
    result = wy.Simulator(scene, step=step, integrator=integrator, newton_tolerance=TOLERANCE)
    x, v = start(cloth, seed)
    result.state = dataclasses.replace(result.state, position=x, velocity=v)
    return result


def row(fabric: str, integrator: str, step: float, seeds: int) -> dict[str, Any]:
    """One row of the table: iterations of every step from every start."""
    counts, parted = [], 0
    for seed in range(seeds):
        falling = simulator(fabric, seed, step, integrator)
        for _ in range(round(DURATION / step)):
            falling.run(1)
            counts.append(falling.integrator.iterations)
        parted += len(set(falling.split_steps) - falling.damped_steps)
    count = np.array(counts)
    return {
        "fabric": fabric,
        "method": integrator,
        "step [ms]": 1e3 * step,
        "mean": float(count.mean()),
        "90 %": float(np.percentile(count, 90)),
        "99 %": float(np.percentile(count, 99)),
        "most": int(count.max()),
        "above 60": int((count > 60).sum()),
        "steps": len(count),
        "parted": parted,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fabrics", nargs="+", choices=FABRICS, default=["paper", "handkerchief", "cotton"])
    parser.add_argument("--seeds", type=int, default=25, help="starts (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "impacts.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    rows = [
        row(fabric, integrator, step, options.seeds)
        for fabric in options.fabrics
        for step in STEPS
        for integrator in METHODS
    ]
    print_table(rows)
    for fabric in options.fabrics:
        of_it = [r for r in rows if r["fabric"] == fabric]
        print(f"{fabric}: mean {np.mean([r['mean'] for r in of_it]):.1f}, most {max(r['most'] for r in of_it)}")
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
