"""Coarse cloths beside the fine one: what it costs to have one yarn for n, and what it saves.

python benchmarks/coarse.py                         the handkerchief, n = 8, 4, 2, 1 of 145 × 145 yarns: two minutes
python benchmarks/coarse.py --size 49 --fabric cotton

Of a cloth of each n, against that of n = 1:

    drape     held by a square in its middle, its edges hang down: the part of its area that is seen from above, at
              rest
    period    of a strip, clamped at one end, that swings by its bending, without gravity
    shear     work for an angle of 0.1 between the clamped ends of a square, per area
    tension   work for 1 % between them, per area

and how long a step of the drape takes, all n in turns. The first three converge as the edges do: clamps and free ends
are half a coarse distance off (docs/outlines.md).

Writes benchmarks/results/coarse.csv and docs/coarse.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, measure, one_core, print_table, write_csv
from matplotlib.figure import Figure
from plots import COLORS, PICTURES, save

import warp_yarn as wy

MEASURES = ("drape", "period [s]", "shear [J/m²]", "tension [J/m²]")
ANGLE, STRAIN = 0.1, 0.01
QUIET = 2e-2
"""Step of implicit Euler [s], by which a cloth comes to rest."""
FACTORS = (8, 4, 2, 1)


def area_seen(cloth: wy.Cloth, position: np.ndarray) -> float:
    """Of all triangles from above [m²]."""
    a, b, c = np.moveaxis(position[cloth.topology.triangle_nodes], 1, 0)
    return float(0.5 * np.abs(np.cross(b - a, c - a)[:, 2]).sum())


def draped(cloth: wy.Cloth) -> wy.Simulator:
    """A simulator of the cloth, held in a middle square of a third of its size."""
    off = np.abs(cloth.rest_grid - cloth.middle) / np.array(cloth.size)
    held = np.flatnonzero((off <= 1.0 / 6.0 + 1e-9).all(axis=1)).tolist()
    scene = wy.Scene(cloth, pins=held, pin_stiffness=None)
    return wy.Simulator(scene, integrator="linear", step=QUIET / 4.0)


def drape(cloth: wy.Cloth, steps: int) -> float:
    simulator = draped(cloth)
    simulator.run(steps)
    return area_seen(cloth, simulator.state.position) / area_seen(cloth, cloth.position)


def period(cloth: wy.Cloth, step: float = 2e-3, most: int = 1000) -> float:
    """Twice the time until the free end is back, thrown as a beam swings [s]."""
    along = cloth.rest_grid[:, 0]
    held = np.flatnonzero(along <= along.max() / 6.0 + 1e-9).tolist()
    simulator = wy.Simulator(wy.Scene(cloth, gravity=None, pins=held, pin_stiffness=None, sliding=False), step=step)
    state = simulator.state
    x = np.maximum(along / along.max() - 1.0 / 6.0, 0.0) * 1.2
    # the first mode, (6 x² − 4 x³ + x⁴)/3 to 1 %
    state.velocity[:, 2] = 0.02 * (6.0 * x**2 - 4.0 * x**3 + x**4) / 3.0
    simulator.state = state
    tip, before, now = along == along.max(), 0.0, 0.0
    for k in range(1, most):
        simulator.run(1)
        before, now = now, float(simulator.state.position[tip, 2].mean())
        if k > 1 and before > 0.0 >= now:
            return 2.0 * step * (k - now / (now - before))
    return float("nan")


def work(cloth: wy.Cloth, moved: np.ndarray) -> float:
    """Per area [J/m²], of the ends of the warp as far as ``moved`` [3] (m), from one to the other."""
    along = cloth.rest_grid[:, 0]
    held = np.flatnonzero((along == 0.0) | (along == along.max()))
    goal = cloth.position[held] + (along[held] / along.max())[:, None] * moved
    path = cloth.position[held] + np.linspace(0.1, 1.0, 10)[:, None, None] * (goal - cloth.position[held])
    scene = wy.Scene(cloth, gravity=None, pins=held.tolist(), pin_stiffness=None, pin_path=path, sliding=False)
    simulator = wy.Simulator(scene, integrator="implicit-euler", step=QUIET)
    simulator.run(60)
    energy = simulator.energy()
    return sum(energy[term] for term in ("stretch", "bending", "shear")) / float(np.prod(cloth.size))


def compare(fabric: str, size: int, factors: Sequence[int], steps: int) -> list[dict[str, Any]]:
    make = wy.fabrics.FABRICS[fabric]
    cloths = [make(rows=size, columns=size, pose="flat").coarsened(n) for n in factors]
    narrow = 2 * max(factors) + 1
    strips = [make(rows=narrow, columns=size, pose="flat").coarsened(n) for n in factors]
    rows = []
    for n, cloth, strip in zip(factors, cloths, strips, strict=True):
        length = cloth.size[0]
        values = (
            drape(cloth, steps),
            period(strip),
            work(cloth, np.array([0.0, ANGLE * length, 0.0])),
            work(cloth, np.array([STRAIN * length, 0.0, 0.0])),
        )
        rows.append({"fabric": fabric, "n": n, "nodes": cloth.nodes, **dict(zip(MEASURES, values, strict=True))})
        print_table(rows[-1:])
    simulators = [draped(cloth) for cloth in cloths]
    for simulator in simulators:
        simulator.run(2)
    times = measure([lambda simulator=simulator: simulator.run(4) and None for simulator in simulators], 5)
    for row, time in zip(rows, times, strict=True):
        row |= {"step [ms]": 250.0 * time.median, "step IQR [ms]": 250.0 * (time.upper - time.lower)}
    fine = rows[[row["n"] for row in rows].index(1)] if 1 in factors else rows[-1]
    for row in rows:
        row |= {f"{name.split()[0]} error": row[name] / fine[name] - 1.0 for name in MEASURES}
        row["times faster"] = fine["step [ms]"] / row["step [ms]"]
    return rows


def draw(rows: Sequence[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    coarse = [row for row in rows if row["n"] > 1]
    for name, color in zip(MEASURES, COLORS, strict=False):
        errors = [100.0 * abs(row[f"{name.split()[0]} error"]) for row in coarse]
        left.loglog([row["n"] for row in coarse], errors, "o-", color=color, label=name.split()[0])
    left.loglog([2, 8], [2, 8], ":", color="0.4", label="∝ n")
    left.set_ylabel("off the fine cloth [%]")
    right.loglog([row["n"] for row in rows], [row["times faster"] for row in rows], "o-", color=COLORS[0])
    right.loglog([1, 8], [1, 64], ":", color="0.4", label="∝ n², as nodes")
    right.set_ylabel("times as fast a step")
    for axes in (left, right):
        axes.set_xlabel("n, yarns to one")
        axes.set_xticks([row["n"] for row in rows], [str(row["n"]) for row in rows])
        axes.minorticks_off()
        axes.legend(fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fabric", choices=wy.fabrics.FABRICS, default="handkerchief", help="(%(default)s)")
    parser.add_argument("--size", type=int, default=145, help="rows and columns, 48 k + 1 (%(default)s)")
    parser.add_argument("--factors", type=int, nargs="+", default=FACTORS, help="n (%(default)s)")
    parser.add_argument("--steps", type=int, default=300, help="of the drape (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "coarse.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "coarse.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    one_core()
    rows = compare(options.fabric, options.size, options.factors, options.steps)
    print_table(rows)
    write_csv(options.output, rows, environment("matplotlib"))
    save(draw(rows), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
