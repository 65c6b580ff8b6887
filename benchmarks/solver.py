"""A full step against one SciPy solve of its linear system, on a hung cloth, all terms, double precision.

    python benchmarks/solver.py [--sizes 5 9 17 25 33] [--fabric cotton] [--repeats 15]

One core. "step" is everything a step costs: forces, matrix, contact, solve, update, and copying the frame out, as the
mean of consecutive steps of Simulator.run, replayed from a captured graph. "locked" is the same of the cloth without
sliding, which goes its own way from rest. "scipy" is scipy.sparse.linalg.cg alone on the system of the first of these
steps, a CSR matrix made beforehand. All of them take turns.

SciPy's cg stops at ‖r‖ ≤ tolerance ‖b‖, ours at √(r·P⁻¹r) ≤ tolerance times what it is at its start, the present
velocities, P being its preconditioner. So SciPy solves for the change of velocities, and gets the system scaled by its
diagonal D: D^-½ A D^-½ y = D^-½ r, y = D^½ Δq̇. Plain cg on it makes the iterates of Jacobi-preconditioned cg on A, its
norm is ours with P = D, and it is spared calling a preconditioner from Python. With the default preconditioner our norm
is another one, so the table has errors: of one solution against a direct solve, in the norm √(e·De), relative.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import warp as wp
from common import RESULTS, environment, measure, one_core, print_table, write_csv

import warp_yarn as wy
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS

WARM_UP = 50
"""Steps before the one that is measured: the cloth moves and bends by then."""

RUN = 20
"""Steps in a measured run, over which the costs of its beginning are spread."""

SIZES = [5, 9, 17, 25, 33]
KINDS = {"default": None, "jacobi": "jacobi"}
METHOD = {"step": paper.STEP, "integrator": "linear"}


@dataclasses.dataclass(frozen=True)
class Scaled:
    """The free part of a step's linear system, scaled by its diagonal D: matrix · (scale · q̇) = rhs.

    Args:
        matrix: D^-½ A D^-½, CSR.
        rhs: D^-½ b, what is held moved to this side.
        start: D^½ times the present velocities.
        scale: D^½.
        free: which of all unknowns the system has.
    """

    matrix: scipy.sparse.csr_array
    rhs: np.ndarray
    start: np.ndarray
    scale: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, simulator: wy.Simulator) -> Scaled:
        """The system of a simulator's next step."""
        system = simulator.system()
        n, free = len(system.rhs), system.free
        whole = scipy.sparse.csr_array((system.entries, (system.rows, system.columns)), shape=(n, n))
        rates = velocities(simulator)
        scale = np.sqrt(whole.diagonal()[free])
        unscale = scipy.sparse.diags_array(1.0 / scale)
        rows = whole[free]
        matrix = (unscale @ rows[:, free] @ unscale).tocsr()
        rhs = (system.rhs[free] - rows[:, ~free] @ rates[~free]) / scale
        return cls(matrix, rhs, scale * rates[free], scale, free)

    def solve(self, tolerance: float) -> tuple[np.ndarray, int]:
        """SciPy's solution, scaled, and how many iterations it took."""
        count = 0

        def tick(_: np.ndarray) -> None:
            nonlocal count
            count += 1

        rhs = self.rhs - self.matrix @ self.start
        change, failed = scipy.sparse.linalg.cg(self.matrix, rhs, rtol=tolerance, callback=tick)
        if failed:
            raise RuntimeError(f"SciPy's cg did not converge in {failed} iterations")
        return self.start + change, count

    def error(self, solution: np.ndarray) -> float:
        """Of a scaled solution, against a direct solve, relative."""
        exact = scipy.sparse.linalg.spsolve(self.matrix.tocsc(), self.rhs)
        return float(np.linalg.norm(solution - exact) / np.linalg.norm(exact))


def velocities(simulator: wy.Simulator) -> np.ndarray:
    """q̇ of the present state, in the order of the linear system's unknowns."""
    state = simulator.state
    parts = [state.velocity, state.euler_velocity] if simulator.scene.sliding else [state.velocity]
    return np.concatenate([part.ravel() for part in parts])


def simulators(size: int, fabric: str = "paper") -> dict[str, wy.Simulator]:
    """One for each of our preconditioners, on the same moving cloth."""
    scene = paper.hung(FABRICS[fabric](rows=size, columns=size))
    result = {name: wy.Simulator(scene, preconditioner=kind, **METHOD) for name, kind in KINDS.items()}
    result["default"].run(WARM_UP)
    result["jacobi"].state = result["default"].state
    return result


def compare(ours: dict[str, wy.Simulator], tolerance: float | None = None) -> dict[str, dict[str, float]]:
    """Iterations and errors of one solve of the same system: ours and SciPy's. The states stay as they are."""
    result = {}
    for name, simulator in ours.items():
        state, scaled = simulator.state, Scaled.of(simulator)
        simulator.run(1)
        solution = scaled.scale * velocities(simulator)[scaled.free]
        simulator.state = state
        iterations = int(simulator.arrays["iterations"].numpy()[0])
        result[name] = {"iterations": iterations, "error": scaled.error(solution)}
    solution, iterations = scaled.solve(simulator.model.tolerance)
    return {**result, "scipy": {"iterations": iterations, "error": scaled.error(solution)}}


def benchmark(size: int, repeats: int, fabric: str = "paper") -> dict[str, Any]:
    """One row of the table."""
    ours = simulators(size, fabric)
    scaled = Scaled.of(ours["jacobi"])
    locked = wy.Simulator(paper.hung(FABRICS[fabric](rows=size, columns=size), sliding=False), **METHOD)
    locked.run(WARM_UP)
    start = ours["jacobi"].state

    def step(simulator: wy.Simulator) -> Callable[[], float]:
        start = simulator.state

        def run() -> float:
            simulator.state = start
            begin = time.perf_counter()
            simulator.run(RUN)
            return (time.perf_counter() - begin) / RUN

        return run

    def solve() -> None:
        scipy.sparse.linalg.cg(scaled.matrix, scaled.rhs, scaled.start, rtol=ours["jacobi"].model.tolerance)

    without, *timings = measure([*map(step, (locked, *ours.values())), solve], repeats)
    for simulator in ours.values():
        simulator.state = start
    row: dict[str, Any] = {"fabric": fabric, "size": f"{size} × {size}", "unknowns": len(scaled.rhs)}
    names = [*(f"step, {name}" for name in ours), "scipy"]
    for name, timing, facts in zip(names, timings, compare(ours).values(), strict=True):
        row |= {**timing.columns(name), f"{name} iterations": facts["iterations"], f"{name} error": facts["error"]}
    row["scipy / step"] = timings[-1].median / timings[0].median
    row |= {**without.columns("locked"), "locked / step": without.median / timings[0].median}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="rows and columns (%(default)s)")
    parser.add_argument("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="timed runs (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "solver.csv", help="CSV file (%(default)s)")
    options = parser.parse_args()
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    about = environment("scipy")
    rows = [benchmark(size, options.repeats, options.fabric) for size in options.sizes]
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"medians of {options.repeats} runs; IQR: interquartile range")
    for columns in (("step, default", "locked"), ("step, jacobi",), ("scipy",)):
        shown = [
            {
                key: value
                for key, value in row.items()
                if key in ("fabric", "size", "unknowns") or key.startswith(columns)
            }
            for row in rows
        ]
        print_table(shown)
        print()
    write_csv(options.output, rows, about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
