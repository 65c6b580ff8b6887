"""Iterations of the conjugate gradient to 1e-6, with the multilevel line preconditioner and with the incomplete one.

    python benchmarks/iterations.py [--tables hung stretch jittered] [--sizes 31 61 121] [--most 3000]

The systems are those of eq. 2 for a step of 1 ms, and for the length of an SDIRK2 stage of it, from the velocities that
the cloth has; where sliding is on, so are friction and all that goes with it.

    hung        handkerchief and cotton that have been let go by two corners for 15 ms, flat at the beginning,
                locked and sliding
    stretch     the paper's cloth of 17 × 17, so too, sliding, with Y × 1 to × 1e5
    jittered    all three fabrics of 31 × 31 with nodes put 2, 15 and 40 % of a spacing wrong, crossings a third of that
                along their yarns, at stages of 0.3 ms, 2 ms and 1/60 s, locked and sliding

"to r" is until √(r·P⁻¹r) is 1e-6 of what it is at the start, as the simulator's ``tolerance`` says; "to b" until it is
1e-6 of √(b·P⁻¹b), which takes fewer where velocities are near the solution. "> n" where it takes more than --most, or
ends before because p·A p is no longer above 0.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, print_table, write_csv

import warp_yarn as wy
from warp_yarn.device.model import SOLVED
from warp_yarn.presets.fabrics import STUDIED

TOLERANCE = 1e-6
STEP = 1e-3
GAMMA = 1.0 - 0.5**0.5
LENGTHS = {"eq. 2": STEP, "stage": GAMMA * STEP}
PRECONDITIONERS = ("multilevel", "incomplete")
SIZES = [31, 61, 121]
STRETCHES = (1.0, 10.0, 1e2, 1e3, 1e4, 1e5)
JITTERS = (0.02, 0.15, 0.4)
STAGES = (3e-4, 2e-3, 1.0 / 60.0)
SETTLED = 30
"""Steps of 0.5 ms before a hung cloth is looked at."""


def cloth_of(fabric: str, size: int, stretch: float = 1.0) -> wy.Cloth:
    """Make a flat cloth, of yarns that are as much stiffer."""
    cloth = STUDIED[fabric](rows=size, columns=size, pose="flat")
    yarns = [dataclasses.replace(yarn, stretch=stretch * yarn.stretch) for yarn in cloth.yarns]
    return cloth.replace(yarns=yarns)


def hung(cloth: wy.Cloth) -> wy.State:
    """Make the state of a cloth that was let go by two corners, without sliding."""
    scene = wy.Scene(cloth, pins=cloth.corners("top"), sliding=False)
    simulator = wy.Simulator(scene, step=5e-4, integrator="implicit-euler", newton_tolerance=1e-5)
    simulator.run(SETTLED)
    return simulator.state


def jittered(cloth: wy.Cloth, jitter: float, sliding: bool) -> wy.State:
    """Make a state that is wrong everywhere."""
    rng = np.random.default_rng(round(1e3 * jitter))
    off = jitter * cloth.spacing
    position = cloth.position + rng.uniform(-off, off, (cloth.nodes, 3))
    inside = (cloth.topology.is_crossing != 0)[:, None] * float(sliding)
    euler = cloth.euler + rng.uniform(-off / 3.0, off / 3.0, (cloth.nodes, 2)) * inside
    return wy.State(position, euler, rng.normal(0.0, 0.1, (cloth.nodes, 3)), np.zeros((cloth.nodes, 2)))


def _norm(simulator: wy.Simulator) -> float:
    """r·P⁻¹r of what the arrays hold at a solve's start."""
    a = simulator.arrays
    r = a["r_x"].numpy().astype(np.float64)
    if simulator.model.preconditioner == "multilevel":
        total = (r * a["t_x"].numpy()).sum()
    else:
        m = a["inverse_pivot"].numpy()
        # of a symmetric block its upper triangle, row by row
        full = m[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        total = np.einsum("ij,ijk,ik->", r, full, r)
    if simulator.scene.sliding:
        r_s = a["r_s"].numpy()
        z_s = a["t_s"].numpy() if simulator.model.preconditioner == "multilevel" else a["inverse_s"].numpy() * r_s
        total += (r_s * z_s).sum()
    return float(total)


def count(scene: wy.Scene, state: wy.State, length: float, preconditioner: str, most: int) -> dict[str, int | str]:
    """Count the iterations that a system takes, "to r" and "to b"; or say after how many it ended without success."""
    simulator = wy.Simulator(
        scene, step=length, integrator="linear", preconditioner=preconditioner, max_iterations=most
    )
    simulator.state = state
    simulator.system()
    model, a = simulator.model, simulator.arrays
    model.factorize()

    def start(moving: bool) -> None:
        a.zero("solution", "euler_solution", "status")
        if moving:
            model.copy(solution="velocity", euler_solution="euler_velocity")

    def solve(most: int, tolerance: float) -> int:
        a.put("tolerance", tolerance)
        arrays = {name: a[name] for name in SOLVED}
        model.launch(f"{preconditioner}_conjugate_gradient", 1, thread=0, most_iterations=most, **arrays)
        return int(a["iterations"].numpy()[0])

    sizes = []
    for moving in (False, True):
        start(moving)
        solve(0, TOLERANCE)
        sizes.append(_norm(simulator))
    result: dict[str, int | str] = {}
    for name, tolerance in (("to r", TOLERANCE), ("to b", TOLERANCE * np.sqrt(sizes[0] / sizes[1]))):
        start(True)
        result[name] = solve(most, tolerance)
        if a["status"].numpy()[0]:
            result[name] = f"> {result[name]}"
    return result


def row(
    about: dict[str, Any], scene: wy.Scene, state: wy.State, lengths: dict[str, float], most: int
) -> dict[str, Any]:
    """One row of a table."""
    result = dict(about)
    for preconditioner, (name, length) in itertools.product(PRECONDITIONERS, lengths.items()):
        found = count(scene, state, length, preconditioner, most)
        for to, iterations in found.items():
            result[f"{preconditioner}, {name}, {to}"] = iterations
    return result


def of_hung(sizes: Sequence[int], most: int) -> Iterator[dict[str, Any]]:
    for size, fabric in itertools.product(sizes, ("handkerchief", "cotton")):
        cloth = cloth_of(fabric, size)
        state = hung(cloth)
        for sliding in (False, True):
            scene = wy.Scene(cloth, pins=cloth.corners("top"), sliding=sliding)
            about = {"fabric": fabric, "size": f"{size} × {size}", "sliding": sliding}
            yield row(about, scene, state, LENGTHS, most)


def of_stretch(size: int, most: int) -> Iterator[dict[str, Any]]:
    for stretch in STRETCHES:
        cloth = cloth_of("paper", size, stretch)
        scene = wy.Scene(cloth, pins=cloth.corners("top"))
        about = {"fabric": "paper", "size": f"{size} × {size}", "stretch": stretch}
        yield row(about, scene, hung(cloth), LENGTHS, most)


def of_jittered(size: int, most: int) -> Iterator[dict[str, Any]]:
    for fabric, jitter, stage, sliding in itertools.product(STUDIED, JITTERS, STAGES, (False, True)):
        cloth = cloth_of(fabric, size)
        scene = wy.Scene(cloth, pins=cloth.corners("top"), sliding=sliding)
        about = {"fabric": fabric, "size": f"{size} × {size}", "jitter": jitter, "length": stage, "sliding": sliding}
        yield row(about, scene, jittered(cloth, jitter, sliding), {"stage": stage}, most)


def main(arguments: Sequence[str] | None = None) -> None:
    tables = ("hung", "stretch", "jittered")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", nargs="+", choices=tables, default=tables, help="(all)")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="of the hung ones (%(default)s)")
    parser.add_argument("--size", type=int, help="of the others (17 of stretch, 31 of jittered)")
    parser.add_argument("--most", type=int, default=3000, help="iterations (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS / "iterations.csv", help="CSV file (%(default)s)")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    about = environment()
    every = {
        "hung": lambda: of_hung(options.sizes, options.most),
        "stretch": lambda: of_stretch(options.size or 17, options.most),
        "jittered": lambda: of_jittered(options.size or 31, options.most),
    }
    rows: list[dict[str, Any]] = []
    for name in options.tables:
        found = []
        for one in every[name]():
            found.append(one)
            print(name, *one.values(), flush=True)
        print_table(found)
        rows += [{"table": name, **one} for one in found]
    # tables differ in their columns
    names = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    write_csv(options.output, [{name: one.get(name, "") for name in names} for one in rows], about)
    print("written:", options.output)


if __name__ == "__main__":
    main()
