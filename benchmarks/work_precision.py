"""Chart 1, work and precision: how far each time-stepping method is off, against what it costs.

    python benchmarks/work_precision.py [--size 17] [--motions hung snap pull] [--fabric cotton] [--repeats 3]

Every method of the registry, in both precisions and at several solver tolerances, makes the motions of ``motions.py``
at ever smaller steps, until it is 0.02 % off or nearly as good as the reference, or a run takes --longest seconds.

Error: the root mean square over the nodes of the distance of their positions at the end of the motion to converged
ones, over that of their displacement from its beginning (``Motion.moved``). Time: of a run of the whole motion, divided
by what it simulates; the median of the repeats, on one core. Loading or compiling kernels, capturing graphs and two
steps come before and are in a column of their own. A tolerance is that of the conjugate gradient and of Newton's
iteration alike.

Converged: the second-order method at three halving steps, extrapolated: the powers p and p + 1 of the step are taken
out of the error. How far that is from the same by another method (of second order too where one agrees) is how far the
reference is to be trusted: a point nearer to it than ten times that is in the table, but neither on the chart nor in a
fit. Those runs' tolerances are near rounding.

Slope: of the logarithm of the error over that of the step, by least squares, of the points of 1 % error at most. "to
1 %" is the time at which a curve passes 1 % for good, interpolated between logarithms, and "of eq. 2's" its ratio to
that of the fastest curve of eq. 2; "≤" where the largest step that works is already nearer. "split" and "failed" count
the points at which a step could only be made in parts, and those that could not be made.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, one_core, print_table, write_csv
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from motions import Motion, add_options, find
from plots import COLORS, MARKERS, PICTURES, save
from references import REFERENCE, TARGETS, Reference, end, reference

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS

STEPS = tuple(1e-3 / k for k in (0.2, 0.4, 1, 2, 4, 8, 16, 32, 64, 128, 256))
"""From the longest down [s]; each fits whole times into every motion."""

CURVES = {"double": (None, 1e-2, 1e-4), "single": (None,)}
"""Solver tolerances by precision; None: the default ones."""

LAST_ERROR = 2e-4
"""A curve ends below this error [of the motion]: it has passed the targets."""

LARGEST_ERROR_OF_SLOPE = 0.01
"""Errors above this have no part in a slope [of the motion]."""

EQ_2 = "linear"
"""The paper's method."""


# -- runs -------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Curve:
    """A method as it is asked for."""

    motion: str
    method: str
    precision: str
    tolerance: float | None
    fabric: str | None = None

    @property
    def made(self) -> Motion:
        """The motion, of its fabric."""
        return find(self.motion, self.fabric)

    @property
    def columns(self) -> dict[str, Any]:
        """What the table says of it."""
        return {
            "motion": self.motion,
            "fabric": self.made.fabric,
            "method": self.method,
            "precision": self.precision,
            "tolerance": "default" if self.tolerance is None else f"{self.tolerance:.0e}",
        }

    def simulator(self, size: int, step: float) -> wy.Simulator:
        """Makes a simulator of the motion at its beginning."""
        options = {"tolerance": self.tolerance, "newton_tolerance": self.tolerance, "precision": self.precision}
        return self.made.simulator(size, step=step, integrator=self.method, **options)


@dataclasses.dataclass(frozen=True)
class Point:
    """One step size of a curve.

    Args:
        step: [s].
        error: relative to the motion; None: the run failed.
        timing: wall time per simulated second; of a run that failed, until then.
        start: wall time of what comes before a run [s].
        split: how many steps could only be made in parts.
        failure: what happened, or "".
    """

    step: float
    error: float | None
    timing: Timing
    start: float
    split: int = 0
    failure: str = ""

    def columns(self, floor: float) -> dict[str, Any]:
        """Says what the table has of it; errors below the floor are not charted."""
        timing = self.timing
        return {
            "step [ms]": 1e3 * self.step,
            "error": "failed" if self.error is None else self.error,
            "charted": "no" if self.error is None or self.error < floor else "yes",
            "wall [s per simulated s]": timing.median,
            "wall IQR": timing.upper - timing.lower,
            "start-up [s]": self.start,
            "steps made in parts": self.split,
            "failure": self.failure,
        }


def point(curve: Curve, size: int, step: float, converged: Reference, repeats: int) -> Point:
    """Makes runs of a curve at one step size."""
    motion = curve.made
    begin = time.perf_counter()
    simulator = curve.simulator(size, step)
    beginning = simulator.state
    seconds = []
    try:
        simulator.run(2)
        start = time.perf_counter() - begin
        for _ in range(repeats):
            simulator.state, simulator.steps_done = beginning, 0
            simulator.split_steps.clear()
            begin = time.perf_counter()
            position = end(simulator, motion.steps(step))
            seconds.append((time.perf_counter() - begin) / motion.duration)
    except wy.SimulationError as error:
        until = time.perf_counter() - begin
        simulated = step * (simulator.steps_done + 1)
        # a failure among the first two steps has the start-up in its time: it has no other
        return Point(step, None, Timing.of([until / simulated]), 0.0 if seconds else until, failure=str(error))
    return Point(step, converged.error(position), Timing.of(seconds), start, len(simulator.split_steps))


def points(curve: Curve, size: int, converged: Reference, repeats: int, longest: float) -> list[Point]:
    """Makes all points of a curve, from the largest step down."""
    duration, result = curve.made.duration, []
    for step in STEPS:
        result.append(point(curve, size, step, converged, repeats))
        last = result[-1]
        if last.error is not None and last.error < max(LAST_ERROR, converged.floor):
            break
        # half a step costs nearly twice as much
        if last.error is not None and 2.0 * last.timing.median * duration > longest:
            break
    return result


# -- what the points say ----------------------------------------------------------------------------------------------


def slope(points: Sequence[Point], floor: float) -> float | None:
    """Fits the slope of error over step, both as logarithms; None where fewer than three points tell."""
    told = [p for p in points if p.error is not None and floor <= p.error <= LARGEST_ERROR_OF_SLOPE]
    if len(told) < 3:
        return None
    return float(np.polyfit(np.log([p.step for p in told]), np.log([p.error for p in told]), 1)[0])


def time_to(points: Sequence[Point], target: float) -> tuple[float, bool] | None:
    """Finds the wall time per simulated second from which on a curve is nearer than the target.

    Returns:
        The time, and whether that is only an upper bound, as the curve's largest step is nearer already; or None: it
        does not get there.
    """
    made = [p for p in points if p.error is not None]
    above = [k for k, p in enumerate(made) if p.error > target]
    if not made or (above and above[-1] == len(made) - 1):
        return None
    if not above:
        return made[0].timing.median, True
    a, b = made[above[-1]], made[above[-1] + 1]
    share = np.log(a.error / target) / np.log(a.error / b.error)
    return float(a.timing.median ** (1.0 - share) * b.timing.median**share), False


def summary(found: dict[Curve, list[Point]], floor: float) -> list[dict[str, Any]]:
    """Makes a row for each curve of one motion: its slope and what the targets take."""
    best = {}
    for target in TARGETS:
        times = [time_to(points, target) for curve, points in found.items() if curve.method == EQ_2]
        best[target] = min((t for t, _ in filter(None, times)), default=None)
    rows = []
    for curve, points in found.items():
        fitted = slope(points, floor)
        row = {**curve.columns, "order": INTEGRATORS[curve.method].order, "slope": "" if fitted is None else fitted}
        for target in TARGETS:
            name, reached = f"to {100 * target:g} %", time_to(points, target)
            if reached is None:
                row |= {f"{name} [s per simulated s]": "not reached", f"{name}, of eq. 2's": ""}
                continue
            seconds, bound = reached
            sign = "≤" if bound else ""
            ratio = "" if best[target] is None else f"{sign}{seconds / best[target]:.3g}"
            row |= {f"{name} [s per simulated s]": f"{sign}{seconds:.3g}", f"{name}, of eq. 2's": ratio}
        row["split"] = sum(p.split > 0 for p in points)
        row["failed"] = sum(p.error is None for p in points)
        rows.append(row)
    return rows


# -- the chart --------------------------------------------------------------------------------------------------------


IN_PARTS: dict[str, Any] = {"color": "0.2", "marker": "o", "markersize": 10, "fillstyle": "none", "linestyle": ""}
"""Rings around points at which steps were made in parts."""


def draw(found: dict[Curve, list[Point]], references: dict[str, Reference], size: int) -> Figure:
    """Draws a panel for each motion, four in a row, and the legend of all."""
    tolerances = sorted({curve.tolerance for curve in found if curve.tolerance is not None}, reverse=True)
    dashes = {tolerance: (":", "--", "-.")[k % 3] for k, tolerance in enumerate(tolerances)}
    across = min(len(references), 4)
    down = -(-len(references) // across)
    figure = Figure(figsize=(5.2 * across, 6.0 * down), layout="constrained")
    grid = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
    panels = grid[: len(references)]
    for axes in grid[len(references) :]:
        axes.remove()
    for axes, (name, converged) in zip(panels, references.items(), strict=True):
        draw_panel(axes, {c: points for c, points in found.items() if c.motion == name}, converged, size, dashes)
    for axes in panels[::across]:
        axes.set_ylabel("position error, relative to the motion")
    # room below for the legend, above for what failed
    lowest, highest = min(axes.dataLim.y0 for axes in panels), max(axes.dataLim.y1 for axes in panels)
    panels[0].set_ylim(lowest / 50.0, 3.0 * highest)
    styles = legend(dashes)
    figure.legend(
        styles.values(), styles, loc="outside lower center", ncols=min(len(styles), 2 * across + 2), fontsize=9
    )
    figure.suptitle("Work and precision, one core")
    return figure


def draw_panel(
    axes: Axes, found: dict[Curve, list[Point]], converged: Reference, size: int, dashes: dict[float, str]
) -> None:
    """Draws the curves of one motion, with their slopes; what failed is at the top."""
    look = {name: (COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]) for k, name in enumerate(INTEGRATORS)}
    failed, slopes = [], []
    for curve, points in found.items():
        color, marker = look[curve.method]
        main, single = curve.tolerance is None, curve.precision == "single"
        style = {
            "color": color,
            "linestyle": "-" if main else dashes[curve.tolerance],
            "linewidth": 1.6 if main else 0.9,
            "alpha": 1.0 if main else 0.6,
            "marker": marker,
            "markersize": 6.0 if main else 3.5,
            "markerfacecolor": "white" if single else color,
            "zorder": 3 if main else 2,
        }
        told = [p for p in points if p.error is not None and p.error >= converged.floor]
        axes.plot([p.timing.median for p in told], [p.error for p in told], **style)
        split = [p for p in told if p.split]
        axes.plot([p.timing.median for p in split], [p.error for p in split], **IN_PARTS)
        failed += [(p.timing.median, color) for p in points if p.error is None]
        if main and not single:
            fitted = slope(points, converged.floor)
            slopes.append((Line2D([], [], **style), f"{curve.method}: {'–' if fitted is None else f'{fitted:.2f}'}"))
    axes.set_xscale("log")
    axes.set_yscale("log")
    limits = axes.get_xlim()
    for seconds, color in failed:
        at = min(max(seconds, limits[0] * 1.05), limits[1] / 1.05)
        axes.plot(at, 0.97, "x", color=color, transform=axes.get_xaxis_transform())
    axes.set_xlim(limits)
    made = next(curve.made for curve in found)
    axes.set_title(f"{made.title}: {made.fabric}, {made.about(size)['size']}")
    axes.set_xlabel("wall time per simulated second [s]")
    axes.grid(which="major", alpha=0.3)
    for target in TARGETS:
        axes.axhline(target, color="0.4", linewidth=0.8, linestyle=(0, (1, 3)))
    handles, labels = zip(*slopes, strict=True)
    axes.legend(handles, labels, title="slope of error over step", fontsize=8, title_fontsize=8, loc="lower left")


def legend(dashes: dict[float, str]) -> dict[str, Line2D]:
    """Says what markers and lines mean in all panels."""
    grey = {"color": "0.2", "marker": "o"}
    lines = {
        f"tolerances {t:.0e}": Line2D([], [], color="0.2", linewidth=0.9, linestyle=dash) for t, dash in dashes.items()
    }
    return {
        "double precision": Line2D([], [], **grey),
        "single precision": Line2D([], [], **grey, markerfacecolor="white"),
        "some steps in parts": Line2D([], [], **IN_PARTS),
        "failed: time until then": Line2D([], [], color="0.2", marker="x", linestyle=""),
        "default tolerances": Line2D([], [], color="0.2", linewidth=1.6),
        **lines,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Makes the tables and the chart."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=17, help="rows and columns (%(default)s)")
    add_options(parser)
    parser.add_argument("--repeats", type=int, default=3, help="timed runs (%(default)s)")
    parser.add_argument("--longest", type=float, default=1.5, metavar="SECONDS", help="of one run (%(default)g)")
    parser.add_argument("--output", type=Path, default=RESULTS / "work_precision.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "work_precision.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment("matplotlib")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    rows, found, references, sums = [], {}, {}, []
    for name in options.motions:
        begin = time.perf_counter()
        made = find(name, options.fabric)
        about_it = made.about(options.size)
        converged = reference(made, options.size)
        references[name] = converged
        print(
            f"\n{name}: {made.title}, {made.fabric}, {about_it['size']}, {1e3 * made.duration:g} ms, "
            f"moved by {1e3 * converged.moved:.3g} mm; reference by {REFERENCE}, {converged.uncertainty:.1e} of that "
            f"from {converged.check}'s: errors from {converged.floor:.1e} on are charted "
            f"(made in {time.perf_counter() - begin:.0f} s)"
        )
        mine = {}
        for method, (precision, tolerances) in itertools.product(INTEGRATORS, CURVES.items()):
            for tolerance in tolerances:
                curve = Curve(name, method, precision, tolerance, options.fabric)
                mine[curve] = points(curve, options.size, converged, options.repeats, options.longest)
                checked = {"check": converged.check, "reference uncertainty": converged.uncertainty}
                size = {"size": about_it["size"], "order": INTEGRATORS[method].order}
                rows += [{**curve.columns, **size, **p.columns(converged.floor), **checked} for p in mine[curve]]
        sums += summary(mine, converged.floor)
        print_table(sums[-len(mine) :])
        found |= mine
    for row in rows:
        if row["failure"]:
            which = ", ".join(row[name] for name in ("motion", "fabric", "method", "precision"))
            print(f"failed: {which}, step {row['step [ms]']:g} ms: {row['failure']}")
    write_csv(options.output, rows, about)
    summary_file = options.output.with_stem(options.output.stem + "_summary")
    write_csv(summary_file, sums, about)
    save(draw(found, references, options.size), options.plot)
    print("written:", ", ".join(str(file) for file in (options.output, summary_file, options.plot)))


if __name__ == "__main__":
    main()
