"""A strip of plain weave that is pulled along its warp, as in a tensile tester: force per width over strain.

python benchmarks/tensile_curve.py                      a cotton of 5 % crimp, 9 × 13 yarns: some ten seconds
python benchmarks/tensile_curve.py --crimp 0.08 0.03    of the warp, and of the weft

With crimp interchange the warp is soft until it is straight, the weft being bent in its place, and then as stiff as its
yarns; without, yarns are as stiff from the start. The ends are held across, as clamps hold them, or free to draw in.
Each strain is held for steps of implicit Euler that are long beside every vibration, so that the cloth is at rest.
Beside the curves stands how far the strip draws in. Lines: what Leaf and Kandil have for the first slope, and kₛ/p over
1 + c for the last, from the crimp on.

Writes benchmarks/results/tensile_curve.csv and docs/tensile_curve.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv
from matplotlib.figure import Figure
from plots import COLORS, PICTURES, save

import warp_yarn as wy

DISTANCE, STRETCH, BEND, DENSITY = 0.5e-3, 120.0, 1e-9, 2e-5
"""p [m] and k_b [N m²] of a cell of Leaf and Kandil; kₛ [N] of cotton's fibres, 6 N/tex, and ρ [kg/m], of 20 tex."""
STEPS, STEP = 12, 2e-3
"""Steps at each strain, of so long [s]: implicit Euler takes most of the motion away in every one."""
KINDS = {
    "interchange, drawing in": (True, False),
    "interchange, clamped across": (True, True),
    "no interchange": (False, False),
}
"""Whether there is crimp interchange, and whether the long edges are held across."""


def strip(rows: int, columns: int, crimp: tuple[float, float]) -> wy.Cloth:
    """Yarns that are as thick as they are crimped: at rest as woven."""
    radius = 0.25 * sum(wy.crimp_height(DISTANCE, DISTANCE * (1.0 + c)) for c in crimp)
    area = np.pi * radius**2
    yarn = wy.Yarn(density=DENSITY, stretch=STRETCH / area, bend=BEND / area)
    weave = wy.Weave.plain(rows=rows, columns=columns)
    return wy.Cloth(weave, yarns=[yarn], spacing=DISTANCE, radius=radius, crimp=crimp, shear=0.0, pose="flat")


def curve(cloth: wy.Cloth, strains: Sequence[float], *, interchange: bool, clamped: bool) -> list[dict[str, float]]:
    """Force per width [N/m], and strain across in the middle of the strip, at each strain along it."""
    rows, columns = cloth.weave.rows, cloth.weave.columns
    grid = np.arange(cloth.nodes).reshape(rows, columns)
    ends = grid[:, [0, -1]].ravel()
    held = np.unique(np.append(ends, grid[[0, -1]])) if clamped else np.sort(ends)
    at = np.repeat(1.0 + np.asarray(strains), STEPS)[:, None, None] * [1.0, 0.0, 0.0] + [0.0, 1.0, 1.0]
    scene = wy.Scene(
        cloth,
        gravity=None,
        pins=held,
        pin_stiffness=None,
        pin_path=cloth.position[held] * at,
        sliding=False,
        crimp_interchange=interchange,
    )
    simulator = wy.Simulator(scene, integrator="implicit-euler", step=STEP, newton_tolerance=1e-6)
    name = "crimp_interchange" if interchange else "stretch"
    found = []
    for strain in strains:
        simulator.run(STEPS)
        state, force = simulator.state, simulator.forces()[name][0]
        width = np.ptp(state.position[grid[:, columns // 2], 1])
        found.append(
            {
                "strain": float(strain),
                "force per width [N/m]": float(-force[grid[1:-1, -1], 0].mean() / DISTANCE),
                "strain across": float(width / ((rows - 1) * DISTANCE) - 1.0),
                "speed [m/s]": float(np.abs(state.velocity).max()),
            }
        )
    return found


def leaf_kandil(crimp: tuple[float, float]) -> float:
    """Their modulus of the warp [N/m], of a square sett."""
    (l1, l2), (t1, t2) = ([DISTANCE * (1.0 + c) for c in crimp], [np.arccos(1.0 / (1.0 + c)) for c in crimp])
    ratio = (l1 / l2) ** 3 * (np.cos(t1) / np.cos(t2)) ** 2
    return float(12.0 * BEND / (l1**3 * np.sin(t1) ** 2) * (1.0 + ratio))


def draw(rows: Sequence[dict[str, Any]], crimp: tuple[float, float]) -> Figure:
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for kind, color in zip(KINDS, COLORS, strict=False):
        mine = [row for row in rows if row["kind"] == kind]
        x = [100.0 * row["strain"] for row in mine]
        left.plot(x, [row["force per width [N/m]"] for row in mine], "o-", color=color, markersize=3, label=kind)
        right.plot(x, [100.0 * row["strain across"] for row in mine], "o-", color=color, markersize=3, label=kind)
    most = max(row["force per width [N/m]"] for row in rows if row["kind"] != "no interchange")
    strains = np.array([0.0, max(row["strain"] for row in rows)])
    first = leaf_kandil(crimp)
    left.plot(100.0 * strains, first * strains, ":", color="0.3", label=f"Leaf and Kandil, {first:.0f} N/m")
    last = STRETCH / DISTANCE / (1.0 + crimp[0])
    left.plot(100.0 * strains, last * (strains - crimp[0]), "--", color="0.3", label=f"yarns, {last:.0f} N/m")
    left.axvline(100.0 * crimp[0], color="0.7", linewidth=0.8)
    left.set_ylim(-0.03 * most, 1.05 * most)
    left.set_ylabel("force per width [N/m]")
    right.set_ylabel("strain across, in the middle [%]")
    for axes in (left, right):
        axes.set_xlabel("strain along the warp [%]")
        axes.legend(fontsize=8)
    left.set_title(f"grey: the crimp, {100 * crimp[0]:g} %", fontsize=10)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(9, 13), help="rows and columns (%(default)s)")
    parser.add_argument("--crimp", type=float, nargs=2, default=(0.05, 0.05), help="of warp and weft (%(default)s)")
    parser.add_argument("--points", type=int, default=29, help="strains, up to 1.4 times the crimp (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "tensile_curve.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "tensile_curve.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    one_core()
    crimp = tuple(options.crimp)
    cloth = strip(*options.size, crimp)
    strains = np.linspace(0.0, 1.4 * crimp[0], options.points)
    rows = []
    for kind, (interchange, clamped) in KINDS.items():
        found = curve(cloth, strains, interchange=interchange, clamped=clamped)
        rows += [{"kind": kind, "crimp": str(crimp), **row} for row in found]
    print_table(rows)
    write_csv(options.output, rows, environment("matplotlib"))
    save(draw(rows, crimp), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
