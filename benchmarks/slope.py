"""A cloth on a slope: what sticks creeps, what slides gets faster, and by how much, against closed forms.

python benchmarks/slope.py                                5 × 5, implicit Euler and SDIRK2: some two minutes
python benchmarks/slope.py --size 9 --integrators sdirk2

With r = tan θ/μ, the share of friction's limit that gravity asks for, Coulomb's law as ``kernels/contact/barrier.py``
smooths it gives in the steady state

    r < 1    a speed ε (1 − √(1 − r)): it creeps
    r > 1    an acceleration g (sin θ − μ cos θ)

Writes benchmarks/results/slope.csv and docs/slope.png: a map of speeds over μ and θ, and how far off runs are.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, one_core, print_table, write_csv
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from plots import COLORS, MARKERS, PICTURES, save

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS

FRICTIONS = (0.1, 0.3, 0.5, 1.0)
SHARES = (0.5, 0.9, 0.98, 1.02, 1.5)
ANGLES = tuple(range(4, 53, 6))
"""Of the map [degrees]."""
GRAVITY = 9.8
SLIP = wy.Contact().slip_speed
TOLERANCES = (None, 1e-6)
"""``newton_tolerance``: the default, and one at which only the law counts."""
INTEGRATORS = ("implicit-euler", "sdirk2")
DURATION = 0.2
"""[s], of which the second half counts: what sticks creeps steadily after some ms, and what slides is past ε, where
friction is full, after at most 50."""
SETTLING = 0.05
"""[s], by implicit Euler, before that: where cloth is let go is not quite where it rests, and with SDIRK2 it would
bounce by micrometres for a second, as normal damping has it, by exp(−g t/(4 v_d)). Friction of a load that comes and
goes is not the closed form's."""


def scene(cloth: wy.Cloth, friction: float, angle: float) -> wy.Scene:
    """A cloth that lies on a plane which falls towards +x by an angle [rad]."""
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    normal = turn[:, 2]
    # where it touches, but hardly
    above = 2.0 * cloth.half_thickness * (1.0 - 1e-6)
    flat = cloth.position - cloth.position.mean(axis=0) + [0.0, 0.0, above]
    plane = wy.Plane(point=(0, 0, 0), normal=normal, friction=friction)
    return wy.Scene(cloth.replace(pose=flat @ turn.T), gravity=(0, 0, -GRAVITY), obstacles=[plane])


def speeds(
    cloth: wy.Cloth, friction: float, angle: float, *, steps: int, step: float, **options: Any
) -> tuple[np.ndarray, float]:
    """Mean speed down the slope at every frame after settling [steps + 1] (m/s), and wall time of these [s]."""
    on = scene(cloth, friction, angle)
    settled = wy.Simulator(on, step=step, integrator="implicit-euler").run(max(1, round(SETTLING / step)))
    simulator = wy.Simulator(on, step=step, **options)
    simulator.state = settled[-1]
    begin = time.perf_counter()
    velocity = simulator.run(steps).velocity.mean(axis=1)
    return velocity @ [np.cos(angle), 0.0, -np.sin(angle)], time.perf_counter() - begin


def expected(friction: float, angle: float) -> tuple[str, float]:
    """What is measured, and its closed form [m/s or m/s²]."""
    share = np.tan(angle) / friction
    if share < 1.0:
        return "creep", float(SLIP * (1.0 - np.sqrt(1.0 - share)))
    return "slide", float(GRAVITY * (np.sin(angle) - friction * np.cos(angle)))


def measured(
    cloth: wy.Cloth, friction: float, angle: float, *, duration: float = DURATION, step: float = 1e-3, **options: Any
) -> dict[str, Any]:
    """A row: one cloth on one slope."""
    steps = round(duration / step)
    speed, seconds = speeds(cloth, friction, angle, steps=steps, step=step, **options)
    what, exact = expected(friction, angle)
    half = steps // 2
    value = speed[half:].mean() if what == "creep" else (speed[-1] - speed[half]) / (step * (steps - half))
    return {
        "friction": friction,
        "angle [deg]": float(np.degrees(angle)),
        "share": float(np.tan(angle) / friction),
        "what": what,
        "measured": float(value),
        "closed form": exact,
        "off": float(abs(value / exact - 1.0)),
        "speed [m/s]": float(speed[-1]),
        "seconds": seconds,
    }


def draw(grid: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    angles = sorted({row["angle [deg]"] for row in grid})
    frictions = sorted({row["friction"] for row in grid})
    speed = np.zeros((len(frictions), len(angles)))
    for row in grid:
        speed[frictions.index(row["friction"]), angles.index(row["angle [deg]"])] = row["speed [m/s]"]
    norm = LogNorm(max(speed.min(), 1e-2 * SLIP), speed.max())
    drawn = left.pcolormesh(angles, frictions, speed, norm=norm, cmap="cividis", shading="nearest")
    figure.colorbar(drawn, ax=left, label=f"speed after {DURATION:g} s [m/s]")
    fine = np.linspace(min(angles), max(angles), 200)
    left.plot(fine, np.tan(np.radians(fine)), color="white", linewidth=1.5)
    left.set_ylim(min(frictions) - 0.05, max(frictions) + 0.05)
    left.set_xlabel("angle θ [degrees]")
    left.set_ylabel("friction μ")
    left.set_title("white: tan θ = μ", fontsize=10)
    kinds = list(dict.fromkeys((row["integrator"], row["newton_tolerance"]) for row in rows))
    for k, kind in enumerate(kinds):
        mine = [row for row in rows if (row["integrator"], row["newton_tolerance"]) == kind]
        x = [row["share"] * 1.01 ** (k - 1.5) for row in mine]
        label = f"{kind[0]}, newton_tolerance {kind[1]}"
        off = [max(row["off"], 1e-9) for row in mine]
        right.loglog(x, off, MARKERS[k], color=COLORS[k], markersize=5, label=label, alpha=0.8)
    for level in (0.01, 0.05):
        right.axhline(level, color="0.4", linewidth=0.8, linestyle=":")
    right.axvline(1.0, color="0.4", linewidth=0.8)
    right.set_xticks(SHARES, [f"{share:g}" for share in SHARES], fontsize=8, rotation=45)
    right.minorticks_off()
    right.set_xlabel("r = tan θ/μ")
    right.set_ylabel("off the closed form, of it")
    right.set_title("creep left of 1, sliding right of it; dotted: 1 % and 5 %", fontsize=10)
    right.legend(fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=5, help="rows and columns (%(default)s)")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    parser.add_argument("--step", type=float, default=1e-3, help="time step [s] (%(default)g)")
    parser.add_argument("--integrators", nargs="+", choices=INTEGRATORS, default=INTEGRATORS, help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "slope.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "slope.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    one_core()
    cloth = FABRICS[options.fabric](rows=options.size, columns=options.size, pose="flat")
    about = {"fabric": options.fabric, "size": f"{options.size} × {options.size}", "step [s]": options.step}
    rows = []
    for integrator, tolerance in itertools.product(options.integrators, TOLERANCES):
        method: dict[str, Any] = {"integrator": integrator, "newton_tolerance": tolerance}
        for friction, share in itertools.product(FRICTIONS, SHARES):
            angle = float(np.arctan(share * friction))
            row = measured(cloth, friction, angle, step=options.step, **method)
            rows.append({**about, "integrator": integrator, "newton_tolerance": tolerance or "default", **row})
    map_of = options.integrators[0]
    grid = [
        measured(cloth, friction, float(np.radians(angle)), step=options.step, integrator=map_of)
        for friction, angle in itertools.product(np.linspace(0.1, 1.0, 10).round(2).tolist(), ANGLES)
    ]
    print_table(rows)
    for kind in dict.fromkeys((row["integrator"], row["newton_tolerance"]) for row in rows):
        mine = [row["off"] for row in rows if (row["integrator"], row["newton_tolerance"]) == kind]
        print(f"{kind[0]}, newton_tolerance {kind[1]}: off by {100 * max(mine):.2g} % at most")
    grid = [{**about, "integrator": map_of, "newton_tolerance": "default", **row} for row in grid]
    write_csv(options.output, [*rows, *grid], environment("matplotlib"))
    save(draw(grid, rows), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
