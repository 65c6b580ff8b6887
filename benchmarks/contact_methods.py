"""Two ways to keep cloth from what it touches: a barrier in implicit stages, and the paper's impact zones.

    python benchmarks/contact_methods.py [--size 5] [--motions drop block] [--steps 1 0.25 0.0625] [--repeats 3]

A cloth falls on something without friction, which both methods know; nothing else acts, so its energy cannot rise. The
methods are the barrier with implicit Euler and with SDIRK2, and eq. 2 with impact zones, each with its defaults. Of
each step the table and the chart have

- the error: how far nodes are, at the end, from where the same method of contact leads to at an eighth of the shortest
  step (the barrier by SDIRK2), relative to what they moved. A barrier is soft and gives back part of an impact, zones
  give nothing back: their limits are different motions, and the table says how far apart;
- the smallest distance of a node from what it touches, in any frame, of what the method allows: the barrier's distance,
  or the zones' thickness;
- the energy gained: all that frames gain on the ones before them, of the kinetic energy at the beginning;
- wall time per simulated second, the median of turns in which each method has one, on one core. Loading kernels and
  capturing graphs come before.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, one_core, print_table, turns, write_csv
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from motions import distance
from plots import COLORS, MARKERS, PICTURES, save

import warp_yarn as wy
from warp_yarn.presets import fabrics

METHODS = {
    "barrier, implicit Euler": ("barrier", "implicit-euler"),
    "barrier, SDIRK2": ("barrier", "sdirk2"),
    "impact zones, eq. 2": ("impact-zones", "linear"),
}
LIMITS = {"barrier": "sdirk2", "impact-zones": "linear"}
"""The integrator by which a method of contact is taken to its limit."""

HALVINGS = 3
"""From the shortest step of the table to that of the limits."""


@dataclasses.dataclass(frozen=True)
class Fall:
    """A cloth that falls on something.

    Args:
        title: a few words, for charts.
        obstacle: makes it, for a cloth of this width [m] above (0, 0, 0).
        tilt: of the cloth at the beginning, in height over width.
        speed: downwards [m/s].
        duration: of the motion [s].
    """

    title: str
    obstacle: Callable[[float], wy.Plane | wy.Box]
    tilt: float
    speed: float
    duration: float

    def gap(self, width: float, position: np.ndarray) -> np.ndarray:
        """Measure how far places [..., 3] are from the obstacle [...] (m)."""
        obstacle = self.obstacle(width)
        if isinstance(obstacle, wy.Plane):
            return position[..., 2] - obstacle.position[2]
        outside = np.abs(position - obstacle.position) - obstacle.size
        return np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(outside.max(axis=-1), 0.0)

    def scene(self, size: int, method: str) -> wy.Scene:
        """Make the scene of a cloth of so many rows and columns."""
        cloth = fabrics.handkerchief(rows=size, columns=size, pose="flat")
        position = cloth.position - cloth.position.mean(axis=0)
        width = np.ptp(position[:, 0])
        position[:, 2] += self.tilt * position[:, 0]
        # above the reach of the barrier, by its own defaults
        position[:, 2] += 2.2 * cloth.radius - position[:, 2].min()
        cloth = cloth.replace(pose=position)
        return wy.Scene(cloth, obstacles=[self.obstacle(width)], contact=wy.Contact(method=method))

    def simulator(self, size: int, method: str, **options: Any) -> wy.Simulator:
        """Make a simulator at the beginning."""
        simulator = wy.Simulator(self.scene(size, method), **options)
        start = simulator.state
        start.velocity[:, 2] = -self.speed
        simulator.state = start
        return simulator


def floor(width: float) -> wy.Plane:
    return wy.Plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction=0.0)


def block(width: float) -> wy.Box:
    """As wide as a third of the cloth."""
    half = width / 6.0
    return wy.Box(center=(0.0, 0.0, -half), half_extents=(half, half, half), friction=0.0)


MOTIONS = {
    "drop": Fall("a drop on a plane, tilted by 0.2", floor, 0.2, 0.3, 0.008),
    "block": Fall("a drop on a block", block, 0.0, 0.3, 0.016),
}


def energies(simulator: wy.Simulator, run: wy.Trajectory) -> np.ndarray:
    """Add up all energies of every frame [frames] (J)."""
    return np.array([sum(simulator.energy(run[k]).values()) for k in range(len(run))])


def limit(motion: Fall, size: int, method: str, step: float) -> np.ndarray:
    """Find where a method of contact leads to at a very short step."""
    options = {"tolerance": 1e-10, "newton_tolerance": 1e-7} if method == "barrier" else {"tolerance": 1e-10}
    simulator = motion.simulator(size, method, step=step, integrator=LIMITS[method], **options)
    left = round(motion.duration / step)
    while left > 0:
        position = simulator.run(min(left, 500)).position[-1]
        left -= 500
    return position


def rows(name: str, size: int, steps: Sequence[float], repeats: int) -> list[dict[str, Any]]:
    """Measure a motion at these steps [s]."""
    motion = MOTIONS[name]
    limits = {method: limit(motion, size, method, min(steps) / 2**HALVINGS) for method in LIMITS}
    begin = motion.scene(size, "barrier").cloth
    width = float(np.ptp(begin.position[:, 0]))
    kinetic = motion.simulator(size, "barrier").energy()["mass"]
    moved = {method: distance(position, begin.position) for method, position in limits.items()}
    apart = distance(limits["barrier"], limits["impact-zones"]) / moved["barrier"]
    result = []
    for step in steps:
        count = round(motion.duration / step)
        timed = []
        for title, (method, integrator) in METHODS.items():
            simulator = motion.simulator(size, method, step=step, integrator=integrator)
            start = simulator.state
            row: dict[str, Any] = {"motion": name, "size": f"{size} × {size}", "method": title, "step [ms]": 1e3 * step}
            run = simulator.run(count)
            allowed = begin.radius if method == "barrier" else 0.1 * begin.spacing
            energy = energies(simulator, run)
            row |= {
                "error": distance(run.position[-1], limits[method]) / moved[method],
                "smallest gap, of allowed": float(motion.gap(width, run.position).min() / allowed),
                "energy gained": float(np.maximum(np.diff(energy), 0.0).sum() / kinetic),
                "split steps": len(simulator.split_steps),
                "limits apart": apart,
            }
            result.append(row)
            timed.append(timed_run(simulator, start, count, motion.duration))
        for row, seconds in zip(result[-len(METHODS) :], turns(timed, repeats), strict=True):
            timing = Timing.of(seconds)
            row |= {"wall [s per simulated s]": timing.median, "wall IQR": timing.upper - timing.lower}
    return result


def timed_run(simulator: wy.Simulator, start: wy.State, count: int, duration: float) -> Callable[[], float]:
    """Make what repeats a run and says how long it took, per simulated second."""

    def run() -> float:
        simulator.state, simulator.steps_done = start, 0
        begin = time.perf_counter()
        simulator.run(count)
        return (time.perf_counter() - begin) / duration

    return run


PANELS = {
    "error": "error at the end",
    "smallest gap, of allowed": "smallest gap, of what is allowed",
    "energy gained": "energy gained, of that at the beginning",
}


def draw(table: Sequence[dict[str, Any]], size: int) -> Figure:
    """Draw what the table has over wall time, a row for each motion."""
    names = list(dict.fromkeys(row["motion"] for row in table))
    figure = Figure(figsize=(12.0, 3.6 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), len(PANELS), squeeze=False)
    for name, line in zip(names, axes, strict=True):
        for (column, label), axis in zip(PANELS.items(), line, strict=True):
            for k, title in enumerate(METHODS):
                found = [row for row in table if row["motion"] == name and row["method"] == title]
                wall = [row["wall [s per simulated s]"] for row in found]
                axis.plot(wall, [row[column] for row in found], color=COLORS[k], marker=MARKERS[k], label=title)
            axis.set(xscale="log", xlabel="wall time per simulated second [s]", ylabel=label)
            if column == "error":
                axis.set(yscale="log", title=f"{MOTIONS[name].title}, {size} × {size}")
            elif column == "energy gained":
                # what is 0 has a place too
                axis.set_yscale("symlog", linthresh=1e-6)
                axis.set_ylim(bottom=-2e-7)
            else:
                axis.axhline(1.0, color="0.6", linewidth=1.0, zorder=0)
            axis.grid(color="0.9")
            axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].legend(frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=5, help="rows and columns (%(default)s)")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS), help="(all)")
    steps = [1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125]
    parser.add_argument("--steps", type=float, nargs="+", default=steps, help="in ms (1, 1/2 ... 1/32)")
    parser.add_argument("--repeats", type=int, default=3, help="turns (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "contact_methods.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "contact_methods.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment("matplotlib")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    table: list[dict[str, Any]] = []
    for name in options.motions:
        table += rows(name, options.size, [1e-3 * step for step in options.steps], options.repeats)
        print_table(table[-len(options.steps) * len(METHODS) :])
    write_csv(options.output, table, about)
    save(draw(table, options.size), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
