"""Two ways to keep cloth from what it touches: a barrier in implicit stages, and the paper's impact zones.

    python benchmarks/contact_methods.py [--size 5] [--motions drop block drape fold] [--steps 1 0.25] [--repeats 3]

A cloth falls on a plane, a block or a ball, or its one half on the other; nothing but gravity acts, so its energy
cannot rise. The methods are the barrier with implicit Euler and with SDIRK2, and eq. 2 with impact zones, each with its
defaults. Impact zones know no friction, so there is none, but in "slide", which the barrier has alone. Of each step the
table and the chart have

- the error: how far nodes are, at the end, from where the same method of contact leads to at an eighth of the shortest
  step (the barrier by SDIRK2), relative to what they moved. A barrier is soft and gives back part of an impact, zones
  give nothing back: their limits are different motions, and the table says how far apart;
- the smallest distance of a node from what it touches, in any frame, of what the method allows: the barrier's distance
  from the obstacle or from another node, or the zones' thickness from the obstacle or a triangle of the cloth;
- the energy gained: all that frames gain on the ones before them, of the kinetic energy at the beginning;
- when a run ended, by an error that says that the method gained energy;
- wall time per simulated second, the median of turns in which each method has one, on one core. Loading kernels and
  capturing graphs come before.
"""

from __future__ import annotations

import argparse
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


BETWEEN = 3
"""Of a node and the triangles that it is compared with, how many yarns apart they are at least."""


TURNING = 5
"""Segments in the turn of a fold."""


class Fall:
    """A flat cloth above something, on which it falls.

    Args:
        title: a few words, for charts.
        obstacle: makes it, for a cloth of this width [m] above (0, 0, 0).
        duration: of the motion [s].
        tilt: of the cloth at the beginning, in height over width.
        speed: at which it goes along x, y and z [m/s].
        methods: of contact.
    """

    def __init__(
        self,
        title: str,
        obstacle: Callable[[float], wy.Obstacle],
        duration: float,
        *,
        tilt: float = 0.0,
        speed: tuple[float, float, float] = (0.0, 0.0, -0.3),
        methods: Sequence[str] = tuple(LIMITS),
    ):
        self.title, self.obstacle, self.duration, self.methods = title, obstacle, duration, methods
        self.tilt, self.speed = tilt, speed

    def gaps(self, cloth: wy.Cloth, method: str, position: np.ndarray) -> float:
        """Measure the smallest gap of frames [frames, nodes, 3], of what the method allows."""
        obstacle = self.obstacle(np.ptp(cloth.position[:, 0]))
        if isinstance(obstacle, wy.Plane):
            gap = position[..., 2] - obstacle.position[2]
        elif isinstance(obstacle, wy.TriangleMesh):
            gap = distances_to(obstacle.vertices[obstacle.faces], position.reshape(-1, 3)).min(axis=1)
        else:
            outside = np.abs(position - obstacle.position) - obstacle.size
            gap = np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(outside.max(axis=-1), 0.0)
        return float(gap.min() / (cloth.radius if method == "barrier" else 0.1 * cloth.spacing))

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

    def velocity(self, cloth: wy.Cloth) -> np.ndarray:
        """Find the velocities at the beginning [nodes, 3] (m/s)."""
        return np.tile(self.speed, (cloth.nodes, 1))


class Fold:
    """A strip that lies in a U on its side, whose upper half falls on the lower one, and that begins as ``Fall`` does.

    Args:
        title: a few words, for charts.
        duration: of the motion [s].
        speed: at which the halves come to each other [m/s].
    """

    methods = tuple(LIMITS)

    def __init__(self, title: str, duration: float, speed: float = 0.3):
        self.title, self.duration, self.speed = title, duration, speed

    def gaps(self, cloth: wy.Cloth, method: str, position: np.ndarray) -> float:
        """Measure the smallest gap of frames, of what the method allows."""
        u = cloth.euler
        if method == "barrier":
            distance = max(1.5 * cloth.spacing, 3.0 * cloth.radius)
            # as far apart along the cloth as the tightest fold of two layers, nearer than which nodes do not touch
            far = np.linalg.norm(u[:, None] - u, axis=2) > 0.5 * np.pi * (distance + cloth.spacing)
            least = min(np.linalg.norm(x[:, None] - x, axis=2)[far].min() for x in position)
            return float(least / distance)
        triangles = cloth.topology.triangle_nodes
        apart = np.abs(u[:, None, None] - u[triangles]).max(axis=3).min(axis=2) > BETWEEN * cloth.spacing
        least = min(distances_to(x[triangles], x)[apart].min() for x in position)
        return float(least / (0.1 * cloth.spacing))

    def scene(self, size: int, method: str) -> wy.Scene:
        """Make the scene of a strip of so many rows."""
        # a handkerchief's yarns would spring open at once
        cloth = wy.paper.cloth(rows=size, columns=4 * size - 3, pose="flat")
        length, columns = cloth.spacing, cloth.weave.columns
        # segments of their own length, so many of which turn; layers are beyond the reach of the barrier
        turn = np.clip((np.arange(columns - 1) - 0.5 * (columns - 2)) / TURNING + 0.5, 0.0, 1.0) * np.pi
        x, z = (np.append(0.0, np.cumsum(length * f(turn))) for f in (np.cos, np.sin))
        _, v = cloth.euler.T
        cloth = cloth.replace(pose=np.stack([np.tile(x, size), v, np.tile(z, size)], axis=1))
        return wy.Scene(cloth, self_contact=True, contact=wy.Contact(method=method))

    def velocity(self, cloth: wy.Cloth) -> np.ndarray:
        """Find the velocities at the beginning [nodes, 3] (m/s): the halves turn about the fold."""
        x, _, z = cloth.position.T
        share = np.clip((x.max() - x) / np.ptp(x), 0.0, 1.0) * np.sign(z.mean() - z)
        return 0.5 * self.speed * share[:, None] * (0.0, 0.0, 1.0)


def distances_to(triangles: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Measure from every place [places, 3] to every triangle [triangles, 3, 3] (m)."""
    a, b, c = np.swapaxes(triangles, 0, 1)[:, None]
    p = places[:, None]

    def to_segment(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        along = ((p - a) * (b - a)).sum(axis=2) / ((b - a) ** 2).sum(axis=2)
        return np.linalg.norm(p - a - np.clip(along, 0.0, 1.0)[..., None] * (b - a), axis=2)

    normal = np.cross(b - a, c - a)
    normal = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    height = ((p - a) * normal).sum(axis=2)
    sides = [(np.cross(normal, q - p0) * (p - p0)).sum(axis=2) > 0.0 for p0, q in ((a, b), (b, c), (c, a))]
    edges = np.min([to_segment(a, b), to_segment(b, c), to_segment(c, a)], axis=0)
    return np.where(np.all(sides, axis=0), np.abs(height), edges)


def simulator_of(motion: Fall | Fold, size: int, method: str, **options: Any) -> wy.Simulator:
    """Make a simulator at the beginning of a motion."""
    simulator = wy.Simulator(motion.scene(size, method), **options)
    start = simulator.state
    start.velocity[:] = motion.velocity(simulator.scene.cloth)
    simulator.state = start
    return simulator


def floor(width: float, friction: float = 0.0) -> wy.Plane:
    return wy.Plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction=friction)


def rough(width: float) -> wy.Plane:
    return floor(width, friction=0.3)


def block(width: float) -> wy.Box:
    """As wide as a third of the cloth."""
    half = width / 6.0
    return wy.Box(center=(0.0, 0.0, -half), half_extents=(half, half, half), friction=0.0)


def ball(width: float) -> wy.TriangleMesh:
    """Half as wide as the cloth, an icosahedron with a corner at the top and faces in four."""
    ring = np.deg2rad(72.0 * np.arange(5))
    height = 1.0 / np.sqrt(5.0)
    upper = np.stack([2.0 * height * np.cos(ring), 2.0 * height * np.sin(ring), np.full(5, height)], axis=1)
    vertices = [(0.0, 0.0, 1.0), *upper, *-upper, (0.0, 0.0, -1.0)]
    # ring k of the lower ones is opposite to ring k of the upper ones
    faces = [(0, 1 + k, 1 + (k + 1) % 5) for k in range(5)] + [(11, 6 + (k + 1) % 5, 6 + k) for k in range(5)]
    for k in range(5):
        low, next_low = 6 + (k + 3) % 5, 6 + (k + 2) % 5
        faces += [(1 + k, next_low, low), (1 + k, low, 1 + (k + 1) % 5)]
    corners = np.array(vertices)[np.array(faces)]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    parts = [np.stack([corners[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
    small = np.concatenate([*parts, middles])
    places, index = np.unique(np.round(small.reshape(-1, 3), 12), axis=0, return_inverse=True)
    places = places / np.linalg.norm(places, axis=1, keepdims=True)
    radius = 0.25 * width
    return wy.TriangleMesh(radius * (places - (0.0, 0.0, 1.0)), index.reshape(-1, 3), friction=0.0)


MOTIONS = {
    "drop": Fall("a drop on a plane, tilted by 0.2", floor, 0.008, tilt=0.2),
    "slide": Fall(
        "a drop on a plane, with friction", rough, 0.008, tilt=0.2, speed=(0.3, 0.0, -0.3), methods=("barrier",)
    ),
    "block": Fall("a drop on a block", block, 0.016),
    "drape": Fall("a drop on a ball", ball, 0.016),
    "fold": Fold("a fold that closes", 0.016),
}


def energies(simulator: wy.Simulator, run: wy.Trajectory) -> np.ndarray:
    """Add up all energies of every frame [frames] (J)."""
    return np.array([sum(simulator.energy(run[k]).values()) for k in range(len(run))])


def limit(motion: Fall | Fold, size: int, method: str, step: float) -> np.ndarray:
    """Find where a method of contact leads to at a very short step."""
    options = {"tolerance": 1e-10, "newton_tolerance": 1e-7} if method == "barrier" else {"tolerance": 1e-10}
    simulator = simulator_of(motion, size, method, step=step, integrator=LIMITS[method], **options)
    left = round(motion.duration / step)
    try:
        while left > 0:
            position = simulator.run(min(left, 500)).position[-1]
            left -= 500
    except wy.SimulationError as error:
        print(f"{method} has no limit: {error}")
        return np.full_like(simulator.scene.cloth.position, np.nan)
    return position


def rows(name: str, size: int, steps: Sequence[float], repeats: int) -> list[dict[str, Any]]:
    """Measure a motion at these steps [s]."""
    motion = MOTIONS[name]
    limits = {method: limit(motion, size, method, min(steps) / 2**HALVINGS) for method in motion.methods}
    first = simulator_of(motion, size, "barrier")
    begin, kinetic = first.scene.cloth, first.energy()["mass"]
    moved = {method: distance(position, begin.position) for method, position in limits.items()}
    apart = distance(limits["barrier"], limits["impact-zones"]) / moved["barrier"] if len(limits) > 1 else np.nan
    compared = {title: way for title, way in METHODS.items() if way[0] in motion.methods}
    result = []
    for step in steps:
        count = round(motion.duration / step)
        timed: dict[int, Callable[[], float]] = {}
        for title, (method, integrator) in compared.items():
            simulator = simulator_of(motion, size, method, step=step, integrator=integrator)
            start = simulator.state
            row: dict[str, Any] = {"motion": name, "size": f"{size} × {size}", "method": title, "step [ms]": 1e3 * step}
            try:
                run = simulator.run(count)
            except wy.SimulationError as error:
                run = error.trajectory
            ended = len(run) <= count
            energy = energies(simulator, run)
            row |= {
                "error": np.nan if ended else distance(run.position[-1], limits[method]) / moved[method],
                "smallest gap, of allowed": motion.gaps(begin, method, run.position),
                "energy gained": float(np.maximum(np.diff(energy), 0.0).sum() / kinetic),
                "split steps": len(simulator.split_steps),
                "limits apart": apart,
                "ended at [ms]": 1e3 * step * (len(run) - 1) if ended else np.nan,
                "wall [s per simulated s]": np.nan,
                "wall IQR": np.nan,
            }
            result.append(row)
            if not ended:
                timed[len(result) - 1] = timed_run(simulator, start, count, motion.duration)
        for k, seconds in zip(timed, turns(list(timed.values()), repeats), strict=True):
            timing = Timing.of(seconds)
            result[k] |= {"wall [s per simulated s]": timing.median, "wall IQR": timing.upper - timing.lower}
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
    figure = Figure(figsize=(12.0, 3.0 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), len(PANELS), squeeze=False)
    for name, line in zip(names, axes, strict=True):
        for (column, label), axis in zip(PANELS.items(), line, strict=True):
            for k, title in enumerate(METHODS):
                found = [row for row in table if row["motion"] == name and row["method"] == title]
                wall = [row["wall [s per simulated s]"] for row in found]
                if found:
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
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(METHODS), frameon=False
    )
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
        print_table([row for row in table if row["motion"] == name])
    write_csv(options.output, table, about)
    save(draw(table, options.size), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
