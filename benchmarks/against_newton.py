"""One gradient of the same task, by warp_yarn and by Newton: time, memory, and how right it is.

    pip install newton                                    (the extra newton)
    python benchmarks/against_newton.py [--quick] [--results FOLDER]

The task: a free cloth of the same size and mass, 1 mm between its nodes, is thrown, spinning and rippled, so that its
centre reaches a target after a second. The loss is the squared distance of the mean of its nodes from the target, the
gradient that with respect to the velocity that all nodes start with. Gravity acts; there is no wind.

Newton's differentiable cloth solver is SolverSemiImplicit: symplectic Euler on triangles, explicit, 32 bits.
Its cloth gets the mean membrane stiffness of ours, kₛ/L over both yarn materials: with tri_ke = tri_ka = E/2 its
material has Young's modulus E and Poisson's ratio 0, linearized. It gets no bending stiffness, no damping, lift or
drag, and no contact, all of which would cost it more, or smaller steps. Its shear modulus is E/2 then, which is more
than ours; triangles have no less at that E. Its time step is the largest of --newton-steps at which the throw ends with
the cloth no more than twice as wide as it was. Forward and backward are recorded on wp.Tape: captured once, as in
Newton's own example (diffsim_cloth), so that a gradient is a replay of the graph; or launched and recorded each time.

Ours has all terms, in double precision, at the paper's step.

Each runs in a process of its own, on one core, and is compiled before anything is measured. Times are CPU time of that
process: on an idle machine the wall time, and on a busy one with less of what others do. "preparing" is making room for
the run's states and, for Newton, capturing it, once for any number of gradients. "memory" is the peak above
what the process used before it made room for the run's states. "found" and "difference" are the derivative in one
direction, by the gradient and by a central difference.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from common import RESULTS, environment, measure, one_core, print_table, write_csv
from memory import forget_peak, peak, resident, settle

import warp_yarn as wy
from warp_yarn.presets import paper

TARGET = np.array([1.0, 0.3, 0.5])
"""Of the centre, relative to where it starts [m]."""

THROWN = np.array([0.5, 0.2, 4.0])
"""The velocity at which the gradient is taken [m/s]."""

SPIN = np.array([20.0, 10.0, 5.0])
"""Angular velocity [1/s]."""

RIPPLE = 0.1
"""Amplitude of a wave of the vertical velocity [m/s]."""

DIRECTION = np.ones(3) / np.sqrt(3.0)

DIFFERENCE = 0.1
"""Step of the central difference [m/s]: the loss is almost quadratic, and Newton's rounding is that of 32 bits."""

WIDER = 2.0


def cloth(size: int) -> wy.Cloth:
    """The paper's plain cloth, flat."""
    plain = paper.cloth(rows=size, columns=size)
    return wy.Cloth(plain.weave, yarns=plain.yarns, shear=plain.shear, pose="flat")


def motion(position: np.ndarray) -> np.ndarray:
    """What is added to the velocity of the throw at each node: a spin and a ripple, without momentum."""
    relative = position - position.mean(axis=0)
    width = np.ptp(position[:, 0])
    wave = RIPPLE * np.sin(2.0 * np.pi * relative[:, 0] / width) * np.cos(2.0 * np.pi * relative[:, 1] / width)
    velocity = np.cross(SPIN, relative)
    velocity[:, 2] += wave - wave.mean()
    return velocity


class Ours:
    """The throw by a Rollout that keeps every `every`-th state."""

    def __init__(self, size: int, duration: float, step: float, every: int):
        # Newton's processes have no use for torch.
        import torch

        import warp_yarn.torch as wt

        torch.set_num_threads(1)
        self.torch, self.every = torch, every
        self.cloth, self.steps = cloth(size), round(duration / step)
        self.added = torch.tensor(motion(self.cloth.position))
        self.rest = torch.tensor(self.cloth.position.mean(axis=0))
        self.make = lambda steps: wt.Rollout(
            wy.Scene(self.cloth), steps, frames=[steps], checkpoint_every=every, step=step
        )
        self.gradient_by(self.make(1), THROWN)  # compiles

    def room(self) -> None:
        self.rollout = self.make(self.steps)

    def loss(self, thrown: Any, rollout: Any = None) -> Any:
        velocity = self.torch.as_tensor(thrown) + self.added
        centre = (rollout or self.rollout)(velocity=velocity).position[0].mean(dim=0)
        return (centre - self.rest - self.torch.as_tensor(TARGET)).square().sum()

    def gradient_by(self, rollout: Any, thrown: np.ndarray) -> np.ndarray:
        variable = self.torch.tensor(thrown, requires_grad=True)
        self.loss(variable, rollout).backward()
        return variable.grad.numpy()

    def gradient(self) -> np.ndarray:
        return self.gradient_by(self.rollout, THROWN)

    def value(self, thrown: np.ndarray) -> float:
        with self.torch.no_grad():
            return float(self.loss(thrown))


@wp.kernel
def add_up(positions: wp.array(dtype=wp.vec3), weight: float, centre: wp.array(dtype=wp.vec3)):
    wp.atomic_add(centre, 0, positions[wp.tid()] * weight)


@wp.kernel
def squared_distance(centre: wp.array(dtype=wp.vec3), target: wp.vec3, loss: wp.array(dtype=float)):
    miss = centre[0] - target
    loss[0] = wp.dot(miss, miss)


class Newton:
    """The throw by Newton's SolverSemiImplicit, every state of it kept; captured, or recorded anew each time."""

    def __init__(self, size: int, duration: float, step: float, *, captured: bool = True):
        try:
            import newton
        except ImportError as error:
            sys.exit(f"This benchmark needs Newton: pip install newton ({error})")
        ours = cloth(size)
        self.position, self.step, self.captured = ours.position, step, captured
        self.steps = round(duration / step)
        area = np.pi * ours.radius**2
        young = np.mean([yarn.stretch * area / ours.spacing for yarn in ours.yarns])
        yarns = 2 * size * (size - 1) * ours.spacing
        mass = yarns * np.mean([ours.yarns[k].density for k in ours.material]) / ours.nodes
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.8))
        builder.add_cloth_grid(
            pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0),
            dim_x=size - 1, dim_y=size - 1, cell_x=ours.spacing, cell_y=ours.spacing, mass=mass,
            tri_ke=0.5 * young, tri_ka=0.5 * young, tri_kd=0.0, tri_lift=0.0, tri_drag=0.0, edge_ke=0.0, edge_kd=0.0,
        )  # fmt: skip
        self.model = builder.finalize(device="cpu", requires_grad=True)
        self.model.particle_grid = None  # no contact among particles
        self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)
        self.centre = wp.zeros(1, dtype=wp.vec3, device="cpu", requires_grad=True)
        self.loss = wp.zeros(1, dtype=float, device="cpu", requires_grad=True)
        self.target = wp.vec3(*(self.position.mean(axis=0) + TARGET))
        self.states, self.graph = [self.model.state() for _ in range(3)], None
        self._forward_backward()  # compiles

    def width(self) -> float:
        """Of the cloth at the end, relative to that at the start; the throw is made with two states, not kept."""
        states = [self.model.state() for _ in range(2)]
        states[0].particle_qd.assign(THROWN + motion(self.position))
        for k in range(self.steps):
            self._step(states[k % 2], states[(k + 1) % 2])
        return float(np.ptp(states[self.steps % 2].particle_q.numpy(), axis=0).max() / np.ptp(self.position))

    def room(self) -> None:
        """Makes every state, and captures the run and its gradient."""
        self.states = [self.model.state() for _ in range(self.steps + 1)]
        self._throw(THROWN)
        if self.captured:
            with wp.ScopedCapture(device="cpu") as capture:
                self._forward_backward()
            self.graph = capture.graph

    def _throw(self, thrown: np.ndarray) -> None:
        self.states[0].particle_qd.assign(thrown + motion(self.position))

    def _step(self, state: Any, result: Any) -> None:
        state.clear_forces()
        self.solver.step(state, result, None, None, self.step)

    def _forward_backward(self) -> None:
        self.tape = wp.Tape()
        with self.tape:
            for k in range(len(self.states) - 1):
                self._step(self.states[k], self.states[k + 1])
            self.centre.zero_()
            last, count = self.states[-1].particle_q, self.model.particle_count
            wp.launch(add_up, dim=count, inputs=[last, 1.0 / count, self.centre], device="cpu")
            wp.launch(squared_distance, dim=1, inputs=[self.centre, self.target, self.loss], device="cpu")
        self.tape.backward(self.loss)

    def gradient(self) -> np.ndarray:
        self.tape.zero()
        if self.graph is None:
            self._forward_backward()
        else:
            wp.capture_launch(self.graph)
        return self.states[0].particle_qd.grad.numpy().astype(np.float64).sum(axis=0)

    def value(self, thrown: np.ndarray) -> float:
        self._throw(thrown)
        self.gradient()
        self._throw(THROWN)
        return float(self.loss.numpy()[0])


def report(make: Callable[[], Ours | Newton], repeats: int) -> dict[str, Any]:
    """Measures one side, in this process."""
    side = make()
    settle()
    before = resident()
    forget_peak()
    begin = time.process_time()
    side.room()
    preparing = time.process_time() - begin
    gradient = side.gradient()
    most = peak()

    def turn() -> float:
        begin = time.process_time()
        side.gradient()
        return time.process_time() - begin

    (timing,) = measure([turn], repeats)
    found = float(gradient @ DIRECTION)
    ahead, behind = (side.value(THROWN + sign * DIFFERENCE * DIRECTION) for sign in (1.0, -1.0))
    difference = (ahead - behind) / (2.0 * DIFFERENCE)
    return {
        "steps": side.steps,
        "gradient [s]": timing.median,
        "gradient IQR [s]": timing.upper - timing.lower,
        "memory [MB]": "unknown" if before is None or most is None else (most - before) / 1e6,
        "preparing [s]": preparing,
        "found": found,
        "difference": difference,
        "error": abs(found / difference - 1.0),
    }


def stable_step(size: int, duration: float, steps: list[float]) -> dict[str, Any]:
    """The largest of the steps at which Newton's throw stays a cloth, and how wide it got at each that was tried."""
    widths = {}
    for step in sorted(steps, reverse=True):
        widths[f"{step:g}"] = width = Newton(size, duration, step).width()
        if width <= WIDER:
            return {"step": step, "widths": widths}
    return {"step": None, "widths": widths}


def in_a_process(part: str, options: argparse.Namespace) -> dict[str, Any]:
    """What this script finds out about one part of the benchmark, in a process of its own."""
    given = {name: getattr(options, name) for name in ("size", "duration", "step", "newton_steps", "repeats")}
    arguments = [part, json.dumps(given)]
    done = subprocess.run([sys.executable, __file__, "--part", *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(done.returncode)
    return json.loads(done.stdout.splitlines()[-1])


def run_part(part: str, size: int, duration: float, step: float, newton_steps: list[float], repeats: int) -> Any:
    kind, _, value = part.partition(":")
    if kind == "stable":
        return stable_step(size, duration, newton_steps)
    if kind in ("captured", "recorded"):
        return report(lambda: Newton(size, duration, float(value), captured=kind == "captured"), repeats)
    return report(lambda: Ours(size, duration, step, int(value)), repeats)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--quick", action="store_true", help="a small cloth for a short time: whether it works")
    add("--size", type=int, help="rows and columns (17)")
    add("--duration", type=float, help="s (1)")
    add("--step", type=float, default=paper.STEP, help="ours [s] (%(default)g)")
    add("--every", type=int, nargs="+", default=[1, 32], help="checkpoints of ours (1 32)")
    ladder = [2e-4, 1.5e-4, 1.2e-4, 1e-4, 8e-5, 6e-5, 5e-5, 4e-5, 3e-5, 2e-5]
    add("--newton-steps", type=float, nargs="+", default=ladder, help="to try, s")
    add("--repeats", type=int, default=5, help="timed gradients (%(default)s)")
    add("--results", type=Path, default=RESULTS, metavar="FOLDER", help="of the CSV file (%(default)s)")
    add("--part", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.size = options.size or (5 if options.quick else 17)
    options.duration = options.duration or (0.05 if options.quick else 1.0)
    one_core()
    wp.config.log_level = wp.LOG_WARNING
    if options.part:
        print(json.dumps(run_part(options.part[0], **json.loads(options.part[1]))))
        return
    stable = in_a_process("stable", options)
    about = environment("newton", "torch")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    print(f"{options.size} × {options.size} nodes, {options.duration:g} s")
    widths = ", ".join(f"{width:.3g} at {step} s" for step, width in stable["widths"].items())
    print(f"width of Newton's cloth at the end, relative to the start: {widths}")
    if stable["step"] is None:
        sys.exit("Newton's cloth is unstable at every one of these steps.")
    sides = {f"ours, checkpoint_every {k}": (options.step, f"ours:{k}") for k in options.every}
    for kind in ("captured", "recorded"):
        sides[f"Newton, {kind}"] = (stable["step"], f"{kind}:{stable['step']!r}")
    rows = [
        {"simulator": name, "step [s]": step, **in_a_process(part, options)} for name, (step, part) in sides.items()
    ]
    for row in rows:
        row |= {"time / first": row["gradient [s]"] / rows[0]["gradient [s]"]}
    print_table(rows)
    size = {"size": f"{options.size} × {options.size}", "duration [s]": options.duration}
    write_csv(options.results / "against_newton.csv", [{**size, **row} for row in rows], about)
    print("written:", options.results / "against_newton.csv")


if __name__ == "__main__":
    main()
