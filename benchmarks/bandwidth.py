"""Chart 3, distance from the limit: what an iteration of the solver takes, against what moving its bytes must take.

    python benchmarks/bandwidth.py [--sizes 200 400 600] [--repeats 5]

The limit is the bandwidth of a triad like STREAM's, a += b + 2 c, in a Warp kernel: double precision, arrays of 268 MB
each, far beyond any cache; by one thread on one core, and by two threads on two, each on its half. It moves 32 bytes an
element: a is read as well as written, so that it does not matter whether a write reads first, and nearly all that the
solver writes it reads too.

Bytes of an iteration: it makes several passes over the nodes (``PASSES``), and at sizes of which no array stays in the
cache each pass must move every array that it reads or writes: so many bytes, and as many again of an array that it both
reads and writes. Elements that neighbours share within a pass count once. Small cloths stay in the cache: they can
be above the limit.

Time of an iteration: the difference of solves of 13 and of 3 iterations at a tolerance of 0, over 10, so that what a
solve does before does not count. The system is that of the paper's hung cloth after 5 steps, all terms, double
precision.

The fraction is bytes over time over the triad's bandwidth by as many threads, and the gain the time by one thread over
that by two. Triads and solves of either take turns, so that what else the machine does falls on all: medians of the
turns' own fractions and gains. Threads wait for each other by spinning: two need two free cores.
"""

from __future__ import annotations

import argparse
import itertools
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, Timing, environment, print_table, write_csv
from matplotlib.figure import Figure
from plots import COLORS, PICTURES, save

import warp_yarn as wy
from warp_yarn.presets import paper

ELEMENTS = 1 << 25
"""Of each array of the triad."""

WANTED = 0.6
"""The fraction that one core is to reach."""

SHORT, LONG = 3, 13
"""Iterations of the two solves."""

MATRIX = "neighbour upper_xx upper_xs upper_sx upper_ss"
PASSES = {
    "incomplete": (
        # (read, written): p ← r + β p, t = (E + U)⁻¹ p, q = (D + U) t
        (
            f"{MATRIX} diagonal_xx diagonal_xs diagonal_ss inverse_pivot inverse_s r_x r_s p_x p_s",
            "p_x p_s t_x t_s q_x q_s",
        ),
        # q ← E (E + U)⁻ᵀ A t, solution += α t, r −= α q
        (
            f"{MATRIX} inverse_pivot inverse_s t_x t_s q_x q_s solution euler_solution r_x r_s",
            "q_x q_s solution euler_solution r_x r_s",
        ),
    ),
    "jacobi": (
        # q = A p
        (f"{MATRIX} diagonal_xx diagonal_xs diagonal_ss p_x p_s q_x q_s", "q_x q_s"),
        # p·q
        ("p_x p_s q_x q_s", ""),
        # solution += α p, r −= α q
        (
            "solution euler_solution p_x p_s r_x r_s q_x q_s inverse_x inverse_s",
            "solution euler_solution r_x r_s q_x q_s",
        ),
        # p = P⁻¹ r + β p
        ("inverse_x inverse_s r_x r_s p_x p_s", "p_x p_s"),
    ),
}
"""Arrays that the passes of an iteration read and write, by preconditioner, in the order of the kernels' loops."""

THREADS = {"incomplete": (1, 2), "jacobi": (1,)}
"""How many processor cores may share a solve, by preconditioner."""


# -- what the memory can do -------------------------------------------------------------------------------------------


@wp.kernel(module="triad", enable_backward=False)
def accumulate(b: wp.array(dtype=wp.vec3d), c: wp.array(dtype=wp.vec3d), a: wp.array(dtype=wp.vec3d)):
    """In vectors of three, as the solver's: Warp's code of single numbers keeps one core from its full bandwidth."""
    i = wp.tid()
    a[i] = a[i] + b[i] + wp.float64(2.0) * c[i]


def cores(count: int) -> None:
    """Keeps this process on so many cores."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(AVAILABLE)[-count:])


AVAILABLE = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


class Triad:
    """The triad, by so many threads on as many cores; ``run`` says how many bytes per second it moves."""

    def __init__(self, threads: int, elements: int = ELEMENTS):
        count = elements // 3 // threads
        self.parts = [
            [wp.full(count, wp.vec3d(1.0), dtype=wp.vec3d, device="cpu") for _ in "bca"] for _ in range(threads)
        ]
        self.bytes = 4 * 3 * 8 * count * threads
        self.rates: list[float] = []
        self.run()
        self.rates.clear()

    def run(self) -> float:
        cores(len(self.parts))
        workers = [
            threading.Thread(target=wp.launch, args=(accumulate, len(part[0]), part), kwargs={"device": "cpu"})
            for part in self.parts
        ]
        begin = time.perf_counter()
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        rate = self.bytes / (time.perf_counter() - begin)
        self.rates.append(rate)
        return rate

    @property
    def median(self) -> float:
        """Of all runs but the first one, which loads the kernel [bytes/s]."""
        return float(np.median(self.rates))


# -- what the solver does ---------------------------------------------------------------------------------------------


def iteration_bytes(simulator: wy.Simulator) -> int:
    """What the passes of an iteration must move at least."""
    arrays = simulator.arrays
    names = " ".join(part for reads_writes in PASSES[simulator.model.preconditioner] for part in reads_writes).split()
    return sum(arrays[name].capacity for name in names if arrays[name] is not None)


class Solver:
    """The solver on the hung cloth's system of one step, on so many cores."""

    def __init__(self, size: int, sliding: bool, preconditioner: str, threads: int):
        scene = paper.hung_cloth(rows=size, columns=size, sliding=sliding)
        options = {"integrator": "linear", "preconditioner": preconditioner, "threads": threads}
        self.simulator = wy.Simulator(scene, step=paper.STEP, chunk=1, **options)
        self.threads, self.tolerance = threads, self.simulator.arrays.numbers(0.0)
        cores(threads)
        for _ in range(5):
            self.simulator.run(1)
        model = self.simulator.model
        model.assemble()
        model.factorize()

    def solve(self, iterations: int) -> float:
        """Time of one solve, from the present velocities, of exactly so many iterations [s]."""
        model, a = self.simulator.model, self.simulator.arrays
        wp.copy(a["solution"], a["velocity"])
        if model.scene.sliding:
            wp.copy(a["euler_solution"], a["euler_velocity"])
        model.max_iterations = iterations
        with model.threads.at_hand():
            begin = time.perf_counter()
            model.solve(tolerance=self.tolerance)
            seconds = time.perf_counter() - begin
        # at a tolerance of 0 no solve converges, and that is no failure here
        a.zero("status")
        made = int(a["iterations"].numpy()[0])
        if made != iterations:
            raise RuntimeError(f"the solver stopped after {made} of {iterations} iterations: nothing can be told")
        return seconds

    def iteration(self) -> float:
        """Time of one iteration [s]."""
        cores(self.threads)
        short, long = (self.solve(count) for count in (SHORT, LONG))
        return (long - short) / (LONG - SHORT)


def measured(
    triads: dict[int, Triad], size: int, sliding: bool, preconditioner: str, repeats: int
) -> list[dict[str, Any]]:
    """Rows of one system, by the number of threads."""
    solvers = {k: Solver(size, sliding, preconditioner, k) for k in THREADS[preconditioner] if k in triads}
    moved = iteration_bytes(solvers[1].simulator)
    seconds: dict[int, list[float]] = {threads: [] for threads in solvers}
    rates: dict[int, list[float]] = {threads: [] for threads in solvers}
    for turn in range(repeats + 1):
        for threads, solver in solvers.items():
            rate, time_of_one = triads[threads].run(), solver.iteration()
            if turn > 0:
                rates[threads].append(rate)
                seconds[threads].append(time_of_one)
    rows = []
    for threads in solvers:
        timing, limit = Timing.of(seconds[threads]), float(np.median(rates[threads]))
        fractions = [moved / t / rate for t, rate in zip(seconds[threads], rates[threads], strict=True)]
        fraction = Timing.of(fractions)
        gain = float(np.median([one / own for one, own in zip(seconds[1], seconds[threads], strict=True)]))
        rows.append(
            {
                "size": f"{size} × {size}",
                "sliding": sliding,
                "preconditioner": preconditioner,
                "threads": threads,
                "bytes per crossing": moved / size**2,
                "moved [MB]": moved / 1e6,
                **timing.columns("iteration"),
                "reached [GB/s]": moved / timing.median / 1e9,
                "triad [GB/s]": limit / 1e9,
                "fraction": fraction.median,
                "fraction IQR": fraction.upper - fraction.lower,
                "gain": gain,
            }
        )
    return rows


def counted(threads: int) -> str:
    return f"{threads} thread{'s' if threads > 1 else ''}"


def draw(rows: Sequence[dict[str, Any]], limits: dict[int, float]) -> Figure:
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.subplots()
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    kinds = list(dict.fromkeys((row["preconditioner"], row["sliding"], row["threads"]) for row in rows))
    systems = list(dict.fromkeys(kind[:2] for kind in kinds))
    width = 0.8 / len(kinds)
    for at, kind in enumerate(kinds):
        mine = [row for row in rows if (row["preconditioner"], row["sliding"], row["threads"]) == kind]
        places = [sizes.index(row["size"]) + width * (at - 0.5 * (len(kinds) - 1)) for row in mine]
        preconditioner, sliding, threads = kind
        label = f"{preconditioner}, {'sliding' if sliding else 'locked'}, {counted(threads)}"
        style = {"color": COLORS[systems.index(kind[:2])], "hatch": "//" * (threads - 1), "edgecolor": "white"}
        bars = axes.bar(places, [row["fraction"] for row in mine], width, label=label, **style)
        axes.bar_label(bars, [f"{100 * row['fraction']:.0f} %" for row in mine], fontsize=7, padding=1)
    axes.axhline(1.0, color="0.2", linewidth=1.0)
    axes.axhline(WANTED, color="0.2", linewidth=1.0, linestyle=":")
    axes.set_xticks(range(len(sizes)), sizes)
    axes.set_xlabel("yarns")
    axes.set_ylabel("bytes of an iteration over its time,\nrelative to the triad's bandwidth")
    axes.set_ylim(0.0, 1.35 * max(1.0, *(row["fraction"] for row in rows)))
    axes.legend(fontsize=8, ncols=2, loc="upper left")
    told = ", ".join(f"{limit / 1e9:.1f} GB/s by {counted(threads)}" for threads, limit in limits.items())
    axes.set_title(f"The solver and the memory's limit\ntriad: {told}; dotted: what one core is to reach", fontsize=10)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200, 400, 600], help="(%(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "bandwidth.csv", help="CSV file (%(default)s)")
    parser.add_argument("--plot", type=Path, default=PICTURES / "bandwidth.png", help="PNG file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    about = environment("matplotlib")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    triads = {threads: Triad(threads) for threads in (1, 2) if threads <= len(AVAILABLE)}
    rows = []
    for size, preconditioner, sliding in itertools.product(options.sizes, PASSES, (True, False)):
        for row in measured(triads, size, sliding, preconditioner, options.repeats):
            rows.append(row)
            told = f"{row['size']}, {preconditioner}, sliding {sliding}, {counted(row['threads'])}"
            print(f"{told}: {100 * row['fraction']:.0f} %, gain {row['gain']:.2f}", flush=True)
    limits = {threads: triad.median for threads, triad in triads.items()}
    print_table(rows)
    write_csv(options.output, rows, about)
    save(draw(rows, limits), options.plot)
    print("written:", options.output, options.plot)


if __name__ == "__main__":
    main()
