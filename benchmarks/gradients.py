"""What gradients cost, in time and memory, and how right they are, on the paper's hung cloth, double precision.

    python benchmarks/gradients.py [--quick] [--results FOLDER]

Cost: a run of the hung cloth from rest, by eq. 2 and by the default method, and the gradient of a loss of its last
frame with respect to the materials, the numbers of crossings and of the wind, and the initial velocities, all at once.
"forward" and "backward" are of one step: the call of a Rollout and loss.backward(), divided by the steps; "ratio" is
the median of the ratios of each turn.

Memory: "kept" is what the graph of the call holds for the backward pass, its tensors counted; "measured" is what the
process grew by, from a run of few steps to one of many, where the system tells.

Forward only: Simulator.run, in a process that never made anything of gradients; in one that computed gradients of
another run; and by the simulator of that run; in turn. Compiling, once a machine: the first step with an empty kernel
cache, of a simulator with reverse mode and of one without.

Error: the relative error of gradients, against those at a solver tolerance of 1e-14, and of the positions, for each
tolerance, on a hung 6 × 6 twill. The tolerance is that of the adjoint solves too.

One core. Times are CPU time of this process, which has one thread: on an idle machine that is the wall time, and on a
busy one it has less of what others do.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp
from common import RESULTS, Timing, environment, measure, one_core, print_table, write_csv
from memory import resident, settle

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.presets import paper

WANTED = (
    "density", "stretch", "bend", "shear", "friction", "friction_stiffness", "friction_damping", "parallel_stiffness",
    "wind_velocity", "wind_density", "wind_drag", "gravity", "velocity", "euler_velocity",
)  # fmt: skip
"""What the cost table differentiates with respect to."""

OF_THE_ERROR = ("stretch", "bend", "density", "shear", "wind_velocity", "velocity")
"""What the error table differentiates with respect to."""

EXACT = 1e-14
"""Solver tolerance of the reference: solves end at rounding."""

EVERY = (1, 8)
"""Checkpoints of the cost table: off, and on."""

METHODS = ("linear", "sdirk2")
"""Eq. 2 and the default, in the cost table; the others are eq. 2's."""

TOLERANCES = tuple(10.0**-k for k in range(3, 14))


def inputs(rollout: wt.Rollout, names: Sequence[str]) -> dict[str, torch.Tensor]:
    """The scene's own values of these inputs, to be differentiated with respect to."""
    result = {}
    for name in names:
        if name in ("density", "stretch", "bend"):
            yarns = rollout.scene.cloth.yarns
            value = torch.tensor([getattr(yarn, name) for yarn in yarns], dtype=rollout.dtype)
        else:
            value = rollout.defaults[name].clone()
        result[name] = value.requires_grad_()
    return result


# -- cost -------------------------------------------------------------------------------------------------------------


class Case:
    """Forward and backward runs of a hung cloth, timed by the step."""

    def __init__(self, size: int, steps: int, every: int = 1, method: str = "linear", **options: Any):
        scene = paper.hung_cloth(rows=size, columns=size, **options)
        self.steps = steps
        self.rollout = wt.Rollout(
            scene, steps, frames=[steps], checkpoint_every=every, step=paper.STEP, integrator=method
        )
        self.inputs = inputs(self.rollout, [name for name in WANTED if scene.sliding or name != "euler_velocity"])
        self.ratios: list[float] = []
        self._forward = 0.0
        self._loss = torch.tensor(0.0)

    def call(self) -> wt.Frames:
        return self.rollout(**self.inputs)

    def forward(self) -> float:
        begin = time.process_time()
        frames = self.call()
        self._forward = (time.process_time() - begin) / self.steps
        self._loss = frames.position.square().sum()
        return self._forward

    def backward(self) -> float:
        for value in self.inputs.values():
            value.grad = None
        begin = time.process_time()
        self._loss.backward()
        seconds = (time.process_time() - begin) / self.steps
        self.ratios.append(seconds / self._forward)
        return seconds

    @property
    def ratio(self) -> Timing:
        """Of backward to forward, turn by turn; the first one compiles."""
        return Timing.of(self.ratios[1:])


def kept_bytes(frames: wt.Frames) -> int:
    """What the graph of a call holds for the backward pass beside its inputs, counted by its memory."""
    node = frames.position.grad_fn
    kept = node.saved_tensors[-len(node.kept_names) :]
    storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes() for tensor in kept}
    return sum(storages.values())


def state_bytes(scene: wy.Scene) -> int:
    """Of one state: positions and velocities, and with sliding (u, v), its rates and friction's anchors."""
    return 8 * (3 + 3 + (2 + 2 + 2 if scene.sliding else 0)) * scene.cloth.nodes


def growth(size: int, every: int, method: str, few: int, many: int) -> float | None:
    """Bytes that the process grows by for each further step whose gradient can still be asked for."""
    grown = {}
    for steps in (few, many):
        case = Case(size, steps, every, method)
        case.call()  # compiles, and makes what does not depend on the steps
        settle()
        before = resident()
        frames = case.call()
        after = resident()
        if before is None or after is None:
            return None
        grown[steps] = after - before
        del frames
    return (grown[many] - grown[few]) / (many - few)


def cost(size: int, every: Sequence[int], steps: int, repeats: int, few: int, many: int) -> list[dict[str, Any]]:
    """Rows of the cost table for one size, all timed in turn."""
    cases = {(method, k): Case(size, steps, k, method) for method in METHODS for k in every}
    timings = measure([f for case in cases.values() for f in (case.forward, case.backward)], repeats)
    rows = []
    for at, ((method, k), case) in enumerate(cases.items()):
        forward, backward = timings[2 * at : 2 * at + 2]
        ratio, state = case.ratio, state_bytes(case.rollout.scene)
        kept, measured = kept_bytes(case.call()), growth(size, k, method, few, many)
        rows.append(
            {
                "size": f"{size} × {size}",
                "method": method,
                "checkpoint_every": k,
                "steps": steps,
                **forward.columns("forward"),
                **backward.columns("backward"),
                "ratio": ratio.median,
                "ratio IQR": ratio.upper - ratio.lower,
                "state [kB]": state / 1e3,
                "kept, a step [kB]": kept / steps / 1e3,
                "measured, a step [kB]": "unknown" if measured is None else measured / 1e3,
            }
        )
    return rows


# -- what a forward-only user pays -----------------------------------------------------------------------------------


def gradient_arrays(simulator: wy.Simulator) -> int:
    """How many of a simulator's arrays have a gradient beside them."""
    return sum(getattr(array, "grad", None) is not None for array in simulator.arrays.values())


def runs(simulator: wy.Simulator, steps: int) -> Callable[[], float]:
    """A function that makes steps from rest and returns the time of one [s]."""
    start = simulator.state

    def run() -> float:
        simulator.state = start
        begin = time.process_time()
        simulator.run(steps)
        return (time.process_time() - begin) / steps

    return run


@functools.cache
def simulator_apart(size: int) -> wy.Simulator:
    """Of a process in which no Rollout and no adjoint was ever made."""
    wp.config.log_level = wp.LOG_WARNING
    return wy.Simulator(paper.hung_cloth(rows=size, columns=size), step=paper.STEP, integrator="linear")


def run_apart(size: int, steps: int) -> float:
    """Steps in that process: the time of one [s]."""
    return runs(simulator_apart(size), steps)()


def forward_only(size: int, steps: int, repeats: int) -> dict[str, Any]:
    """Steps of a plain simulator in a process without gradients, of one in this process, and of one that made some."""
    case = Case(size, steps)
    case.forward()
    case.backward()
    asked = case.rollout.simulator
    plain = wy.Simulator(case.rollout.scene, step=paper.STEP, integrator="linear")
    # Spawned, so that it has nothing of this process; on the same core, as it inherits that.
    with multiprocessing.get_context("spawn").Pool(1) as apart:
        functions = [lambda: apart.apply(run_apart, (size, steps)), runs(plain, steps), runs(asked, steps)]
        timings = measure(functions, repeats)
    row: dict[str, Any] = {"size": f"{size} × {size}"}
    names = ("no gradients in the process", "gradients of another run", "gradients of this one")
    for name, timing in zip(names, timings, strict=True):
        row |= timing.columns(name)
    return {**row, "gradient arrays, plain": gradient_arrays(plain), "asked": gradient_arrays(asked)}


FIRST_STEP = """
import sys, time
import warp as wp
wp.config.log_level = wp.LOG_WARNING
wp.config.kernel_cache_dir = sys.argv[1]
import warp_yarn as wy
begin = time.process_time()
wy.Simulator(wy.paper.hung_cloth(rows=5, columns=5), differentiable=sys.argv[2] == "with").run(1)
print(time.process_time() - begin)
"""
"""A script whose arguments are a cache's folder, and "with" or "without"."""


def compiling() -> list[dict[str, Any]]:
    """Times of a first step [s], of processes that have everything to compile."""
    row = {}
    for reverse in ("with", "without"):
        with tempfile.TemporaryDirectory() as cache:
            arguments = [sys.executable, "-c", FIRST_STEP, cache, reverse]
            done = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, check=True)
        row[f"{reverse} the reverse [s]"] = float(done.stdout.split()[-1])
    return [row]


# -- error against tolerance ------------------------------------------------------------------------------------------


def error_table(
    tolerances: Sequence[float] = TOLERANCES, *, rows: int = 6, columns: int = 6, steps: int = 50
) -> list[dict[str, Any]]:
    """Relative errors of gradients and of positions at each solver tolerance."""
    scene = paper.hung_cloth("twill", rows, columns)
    rest = torch.tensor(scene.cloth.position)
    weights = torch.randn(steps, *rest.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def gradients(tolerance: float) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        rollout = wt.Rollout(scene, steps, tolerance=tolerance, step=paper.STEP, integrator="linear")
        given = inputs(rollout, OF_THE_ERROR)
        position = rollout(**given).position
        (weights * (position[1:] - rest)).sum().backward()
        return position.detach(), {name: value.grad for name, value in given.items()}

    exact_position, exact = gradients(EXACT)
    displacement = (exact_position - rest).norm(dim=-1).max()
    result = []
    for tolerance in tolerances:
        position, found = gradients(tolerance)
        row = {
            "tolerance": f"{tolerance:.0e}",
            "positions": float((position - exact_position).norm(dim=-1).max() / displacement),
        }
        for name, value in found.items():
            row[name] = float((value - exact[name]).norm() / exact[name].norm())
        result.append(row)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small cloths and few turns: whether it works")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FOLDER", help="of CSV files (%(default)s)")
    options = parser.parse_args()
    one_core()
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    about = environment("torch")
    # size: steps of a run, turns, steps of the two runs whose memory is compared; at 100 × 100 a run takes many seconds
    plan = {17: (100, 9, 20, 120), 100: (16, 5, 4, 20)}
    if options.quick:
        plan = {5: (16, 3, 20, 40), 9: (16, 3, 20, 40)}
    plain = forward_only(5, 20, 3) if options.quick else forward_only(17, 100, 15)
    print(", ".join(f"{name} {value}" for name, value in about.items()))

    rows = [row for size, numbers in plan.items() for row in cost(size, EVERY, *numbers)]
    tables = {
        "gradient_cost": ("Cost of a step, and memory for it (medians; IQR: interquartile range)", rows),
        "gradient_forward_only": ("A step of Simulator.run (medians; IQR: interquartile range)", [plain]),
        "gradient_error": ("Relative errors", error_table()),
    }
    if not options.quick:
        tables["gradient_compiling"] = ("A first step, with everything to compile", compiling())
    for name, (title, table) in tables.items():
        print(f"\n{title}")
        print_table(table)
        write_csv(options.results / f"{name}.csv", table, about)
        print("written:", options.results / f"{name}.csv")


if __name__ == "__main__":
    main()
