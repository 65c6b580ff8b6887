"""Chart 2, cost against size: time per step, iterations and memory per crossing, from 5 × 5 to 600 × 600 yarns.

    python benchmarks/sizes.py [--sizes 5 10 25 50 100 200 400 600] [--steps 5] [--largest] [--integrator linear]

The paper's hung cloth, or one of another fabric (--fabric), at its step of 1 ms, double precision, with sliding yarns
and without, each in a process of its own, on one core: 5 steps from rest, as at every size, and then those that are
measured. --largest adds 1000 × 1000.

Time: the median of single steps, all that a step costs. Iterations: of the conjugate gradient, the mean of those steps
(with an implicit method: of the last solve of each). Memory: the most that the process needed, less what one with a
cloth of 3 × 3 needed, which has all the code; "arrays" is what the simulator's arrays on the device take. A crossing
is a node, the border's among them. Slope: of the logarithm of a step's time over that of the crossings, by least
squares, of all sizes from 50 on.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import multiprocessing
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, one_core, print_table, write_csv
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from memory import peak
from plots import COLORS, MARKERS, PICTURES, save

import warp_yarn as wy
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS

SIZES = (5, 10, 25, 50, 100, 200, 400, 600)
LARGEST = 1000
TINY = 3

WARM_UP = 5
"""Steps before those that are measured: kernels are loaded and the cloth moves."""

LARGE = 50
"""Sizes from here on have a slope, and times are compared with those of this one."""

LIMITS = {True: 3.0, False: 1.5}
"""Memory per crossing that is wanted [kB], by sliding."""


def array_bytes(simulator: wy.Simulator) -> int:
    """Of all arrays of a simulator, each memory counted once, gradients and frames among them."""
    arrays = [value for value in simulator.arrays.values() if isinstance(value, wp.array)]
    arrays += [array.grad for array in arrays if array.grad is not None]
    return sum({array.ptr: array.capacity for array in arrays}.values())


def measured(size: int, sliding: bool, integrator: str, fabric: str, steps: int) -> dict[str, Any]:
    """Steps of one cloth, in this process: the times of each [s], mean iterations, and bytes; or why there are none.

    (A SimulationError does not travel between processes.)
    """
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    begin = time.perf_counter()
    scene = paper.hung(FABRICS[fabric](rows=size, columns=size), sliding=sliding)
    # one frame at a time, as in a run of a large cloth
    simulator = wy.Simulator(scene, step=paper.STEP, integrator=integrator, chunk=1)
    made = time.perf_counter() - begin
    seconds, iterations = [], []
    for k in range(WARM_UP + steps):
        begin = time.perf_counter()
        if simulator.run_chunk(1) == 0:
            try:
                simulator.fail(k + 1, simulator.chunk_trajectory(1))
            except wy.SimulationError as error:
                return {"failure": str(error)}
        if k >= WARM_UP:
            seconds.append(time.perf_counter() - begin)
            iterations.append(int(simulator.arrays["iterations"].numpy()[0]))
    return {
        "seconds": seconds,
        "iterations": float(np.mean(iterations)),
        "made": made,
        "peak": peak(),
        "arrays": array_bytes(simulator),
    }


def apart(*arguments: Any) -> dict[str, Any]:
    """``measured`` in a process of its own, which has nothing of this one's memory."""
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as apart:
        return apart.submit(measured, *arguments).result()


def benchmark(sizes: Sequence[int], sliding: bool, integrator: str, fabric: str, steps: int) -> list[dict[str, Any]]:
    """A row for each size; one that failed has a reason and no numbers."""
    rows, tiny = [], apart(TINY, sliding, integrator, fabric, steps)
    for size in sizes:
        about = {"fabric": fabric, "size": f"{size} × {size}", "crossings": size * size}
        about |= {"sliding": sliding, "method": integrator}
        found = apart(size, sliding, integrator, fabric, steps if size > 200 else 4 * steps)
        if "failure" in found:
            print(f"{size} × {size} failed: {found['failure']}", flush=True)
            rows.append({**about, **dict.fromkeys(numbers(tiny, tiny, 1), ""), **found})
            continue
        rows.append({**about, **numbers(found, tiny, size * size), "failure": ""})
        print(f"{size} × {size}, sliding {sliding}: {rows[-1]['step [ms]']:.3g} ms a step", flush=True)
    return rows


def numbers(found: dict[str, Any], tiny: dict[str, Any], crossings: int) -> dict[str, Any]:
    """Columns of what was measured of a cloth, and of a tiny one."""
    timing = Timing.of(found["seconds"])
    grown = None if found["peak"] is None else (found["peak"] - tiny["peak"]) / crossings
    return {
        **timing.columns("step"),
        "per crossing [µs]": 1e6 * timing.median / crossings,
        "iterations": found["iterations"],
        "memory per crossing [kB]": "unknown" if grown is None else grown / 1e3,
        "arrays per crossing [kB]": found["arrays"] / 1e3 / crossings,
        "making it [s]": found["made"],
    }


def slope(rows: Sequence[dict[str, Any]]) -> float | None:
    """Of the time of a step over the crossings, both as logarithms; None of fewer than two large sizes."""
    told = [row for row in rows if not row["failure"] and row["crossings"] >= LARGE**2]
    if len(told) < 2:
        return None
    crossings, times = ([np.log(row[name]) for row in told] for name in ("crossings", "step [ms]"))
    return float(np.polyfit(crossings, times, 1)[0])


def add_relative(rows: Sequence[dict[str, Any]]) -> None:
    """A column of the time per crossing, relative to that at 50 × 50; empty where one of them is missing."""
    cost = {row["crossings"]: row["per crossing [µs]"] for row in rows if not row["failure"]}
    base = cost.get(LARGE**2)
    for row in rows:
        own = cost.get(row["crossings"])
        row[f"relative to {LARGE} × {LARGE}"] = "" if base is None or own is None else own / base


def draw(tables: dict[bool, list[dict[str, Any]]], fabric: str) -> Figure:
    figure = Figure(figsize=(9.5, 7.5), layout="constrained")
    time_axes, crossing_axes, iteration_axes, memory_axes = figure.subplots(2, 2).ravel()
    for at, (sliding, table) in enumerate(tables.items()):
        rows = [row for row in table if not row["failure"]]
        crossings = [row["crossings"] for row in rows]
        style = {"color": COLORS[at], "marker": MARKERS[at], "label": "with sliding" if sliding else "without sliding"}
        fitted = slope(table)
        told = style["label"] if fitted is None else f"{style['label']}, slope {fitted:.2f}"
        time_axes.loglog(crossings, [row["step [ms]"] for row in rows], **{**style, "label": told})
        crossing_axes.semilogx(crossings, [row["per crossing [µs]"] for row in rows], **style)
        iteration_axes.semilogx(crossings, [row["iterations"] for row in rows], **style)
        # small cloths are lost in what the process needs anyway
        large = [row for row in rows if row["crossings"] >= LARGE**2]
        arrays = [row["arrays per crossing [kB]"] for row in large]
        memory = [row["memory per crossing [kB]"] for row in large if row["memory per crossing [kB]"] != "unknown"]
        at_size = [row["crossings"] for row in large]
        if memory:
            memory_axes.semilogx(at_size, memory, **style)
        memory_axes.semilogx(at_size, arrays, **{**style, "label": f"{style['label']}, arrays"}, linestyle=":")
        memory_axes.axhline(LIMITS[sliding], color=COLORS[at], linewidth=0.8, linestyle="--", alpha=0.7)
    labels = {
        time_axes: "time of a step [ms]",
        crossing_axes: "time of a step per crossing [µs]",
        iteration_axes: "iterations of the solver, a step",
        memory_axes: "memory per crossing [kB]",
    }
    for axes, label in labels.items():
        axes.set_xlabel("crossings")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.xaxis.set_minor_formatter(NullFormatter())
        if axes is not time_axes:
            axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=8)
    memory_axes.set_title("dashed: what is wanted at most", fontsize=9)
    figure.suptitle(f"Cost against size: a hung cloth ({fabric}), steps of 1 ms, one core")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="rows and columns (%(default)s)")
    parser.add_argument("--largest", action="store_true", help=f"{LARGEST} × {LARGEST} too, with sliding")
    parser.add_argument(
        "--steps", type=int, default=5, help="measured; four times as many up to 200 × 200 (%(default)s)"
    )
    parser.add_argument("--integrator", choices=INTEGRATORS, default="linear", help="(%(default)s)")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "sizes.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "sizes.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    about = environment("matplotlib")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    tables = {}
    for sliding in (True, False):
        sizes = [*options.sizes, *([LARGEST] if options.largest and sliding else [])]
        tables[sliding] = benchmark(sizes, sliding, options.integrator, options.fabric, options.steps)
    for sliding, rows in tables.items():
        print(f"\n{'with' if sliding else 'without'} sliding")
        add_relative(rows)
        print_table(rows)
        fitted = slope(rows)
        if fitted is not None:
            print(f"slope of time over crossings: {fitted:.3f}")
    write_csv(options.output, [row for rows in tables.values() for row in rows], about)
    save(draw(tables, options.fabric), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
