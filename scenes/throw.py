"""Learns how to throw a cloth: the initial velocity, or forces at its corners, that bring its centre to a target.

python scenes/throw.py                                    a velocity: out/throw.usdc, out/throw.png, out/throw.json
python scenes/throw.py --forces                           forces on the four corners in the first five steps instead
python scenes/throw.py --size 17 --weave twill --target 0.1 0 0.3 --time 0.3
python scenes/throw.py --box                              from a table into a box; --box --help lists its options

The cloth lies flat and is free, gravity acts, there is no wind. The target is where the mean of its nodes shall be,
relative to where it starts. Ctrl-C ends the search and writes the best throw so far. Needs the extras torch and bench.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import into_box
import numpy as np
import tqdm
from common import (
    add_pictures,
    add_slowdown,
    add_weave,
    check_pictures,
    checked_counts,
    command,
    file_ending,
    make_folders,
    optional,
    parse,
    pictures,
    woven_cloth,
    write_all,
)

import warp_yarn as wy
from warp_yarn.errors import finite_array, integer, real
from warp_yarn.io.files import atomic_write
from warp_yarn.io.usd import ENDINGS
from warp_yarn.presets.fabrics import FABRICS

with optional("torch"):
    import torch

    import warp_yarn.torch as wt
with optional("bench"):
    from matplotlib.figure import Figure

GRAVITY = np.array([0.0, 0.0, -9.8])

PUSHED = 5
"""Steps, the first ones, in which --forces acts."""

HALVINGS = 20
"""How often a throw that cannot be simulated is moved half the way back before the search gives up."""
AS_PUBLISHED: dict[str, Any] = {"integrator": "linear", "energy_watch": False}
"""Eq. 2: where momentum decides, not stiffness, one linear solve a step is enough, and the violent forces that a search
tries need no more. Its first step stretches yarns where corners are pulled out of the flat cloth, which is energy from
nowhere, and the next steps damp it."""


class Throw:
    """A free cloth, and where its centre shall be after some steps.

    Variables y are scaled so that the loss, |centre − target|² / |target|², has the curvature 2 along what moves the
    centre, as long as the cloth stays as it is: one learning rate suits all targets, times and sizes.

    Args:
        cloth: it starts at rest, in its pose.
        target: displacement of the mean of its nodes [m], 3 numbers, not all 0.
        duration: time until then [s], above 0.
        steps: number of time steps in it.
        forces: learn forces on the corners, instead of the velocity.
        options: of the Rollout.
    """

    def __init__(
        self, cloth: wy.Cloth, target: Sequence[float], duration: float, steps: int, *, forces: bool, **options: Any
    ):
        self.cloth, self.forces = cloth, forces
        self.target = finite_array("--target", target, (3,))
        self.distance = float(np.linalg.norm(self.target))
        real("the distance of --target", self.distance, above=0.0)
        self.duration = real("--time", duration, above=0.0)
        self.steps = integer("--steps", steps, least=PUSHED + 1 if forces else 1)
        self.step = self.duration / self.steps
        zero = np.zeros((PUSHED, 3))
        pushed = {node: zero for node in cloth.corners()} if forces else None
        self.scene = wy.Scene(cloth, gravity=GRAVITY, forces=pushed)
        self.rollout = wt.Rollout(
            self.scene, self.steps, frames=[self.steps], step=self.step, **AS_PUBLISHED, **options
        )
        speed = self.distance / self.duration
        # An impulse of `scale` on each of so many variables moves the centre as one of √count times that on one.
        self.scale = cloth.mass * speed / (self.step * np.sqrt(PUSHED * 4)) if forces else speed
        self.shape = self.rollout.inputs["forces"] if forces else (3,)

    def start(self) -> torch.Tensor:
        """Variables of no throw at all: the cloth falls."""
        return torch.zeros(self.shape, dtype=self.rollout.dtype, requires_grad=True)

    def physical(self, y: torch.Tensor) -> torch.Tensor:
        """The velocity [m/s], or the forces [steps, corners, 3] (N)."""
        return y * self.scale

    def miss(self, y: torch.Tensor) -> torch.Tensor:
        """From the target to where the centre ends [m]; differentiable."""
        value = self.physical(y)
        inputs = {"forces": value} if self.forces else {"velocity": value.expand(self.cloth.nodes, 3)}
        centre = self.rollout(**inputs).position[0].mean(dim=0)
        return centre - torch.as_tensor(self.cloth.position.mean(axis=0) + self.target)

    def analytic(self) -> np.ndarray:
        """The velocity that brings a point to the target, by eq. 2: x += h v after v += h g."""
        fall = 0.5 * GRAVITY * self.duration * (self.duration + self.step)
        return (self.target - fall) / self.duration

    def trajectory(self, y: torch.Tensor) -> wy.Trajectory:
        """Every frame of a throw, by a simulator that knows nothing of gradients."""
        value, cloth = self.physical(y).detach().numpy(), self.cloth
        corners = cloth.corners()
        forces = {node: value[:, k] for k, node in enumerate(corners)} if self.forces else None
        scene = wy.Scene(cloth, gravity=GRAVITY, forces=forces)
        tolerance = self.rollout.simulator.model.tolerance
        simulator = wy.Simulator(scene, step=self.step, tolerance=tolerance, **AS_PUBLISHED)
        if not self.forces:
            velocity = np.broadcast_to(value, (cloth.nodes, 3))
            simulator.state = dataclasses.replace(simulator.state, velocity=velocity)
        return simulator.run(self.steps)


@dataclasses.dataclass
class Search:
    """What a search has found so far.

    Args:
        best: the variables of the smallest loss.
        losses: of every iteration that could be simulated.
        distances: of the centre from the target [m].
        seconds: wall time of each.
    """

    best: torch.Tensor
    losses: list[float] = dataclasses.field(default_factory=list)
    distances: list[float] = dataclasses.field(default_factory=list)
    seconds: list[float] = dataclasses.field(default_factory=list)
    stop: BaseException | None = None

    def add(self, y: torch.Tensor, loss: float, distance: float, seconds: float) -> None:
        if not self.losses or loss < min(self.losses):
            self.best = y.detach().clone()
        self.losses.append(loss)
        self.distances.append(distance)
        self.seconds.append(seconds)


def search(throw: Throw, iterations: int, rate: float, within: float) -> Search:
    """Improves a throw by L-BFGS, one evaluation of loss and gradient an iteration.

    Args:
        iterations: how many at most.
        rate: of the optimizer; 1 is its full step.
        within: end where the centre comes so near to the target [m].

    Returns:
        What was found; ``stop`` is what ended it early, to be raised once the best is written.
    """
    y = throw.start()
    found = Search(y.detach().clone())
    good = y.detach().clone()
    optimizer = lbfgs(y, rate)
    halvings = 0

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        begin = time.perf_counter()
        miss = throw.miss(y)
        loss = (miss / throw.distance).square().sum()
        loss.backward()
        found.add(y, loss.item(), float(miss.detach().norm()), time.perf_counter() - begin)
        return loss

    try:
        # The first iteration compiles the kernels where they changed, which takes many seconds, and says so meanwhile.
        with tqdm.trange(iterations, unit="throw", desc="compiling", disable=None) as bar:
            for _ in bar:
                before = y.detach().clone()
                try:
                    optimizer.step(closure)
                except (wy.SimulationError, wy.GradientError):
                    halvings += 1
                    if halvings > HALVINGS or not found.losses:
                        raise
                    # Thrown too hard: back, half of the way. What the optimizer learned of the slope is void then.
                    y = (0.5 * (good + before)).requires_grad_()
                    optimizer = lbfgs(y, rate)
                    continue
                good, halvings = before, 0
                bar.set_description("throwing", refresh=False)
                bar.set_postfix(loss=f"{found.losses[-1]:.2e}", mm=f"{1e3 * found.distances[-1]:.4f}")
                if min(found.distances) <= within:
                    break
    except (wy.SimulationError, wy.GradientError, KeyboardInterrupt) as error:
        found.stop = error
    return found


def lbfgs(y: torch.Tensor, rate: float) -> torch.optim.Optimizer:
    return torch.optim.LBFGS([y], lr=rate, max_iter=1, tolerance_grad=0.0, tolerance_change=0.0)


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("--fabric", choices=FABRICS, default="paper", help="(%(default)s)")
    add("--size", type=int, default=9, metavar="N", help="rows and columns (%(default)s)")
    add_weave(result)
    add("--target", type=float, nargs=3, metavar=("X", "Y", "Z"), default=(0.3, 0.1, 0.2), help="m (0.3 0.1 0.2)")
    add("--time", type=float, default=0.25, metavar="SECONDS", help="until it shall be there (%(default)s)")
    add("--steps", type=int, default=250, help="time steps in it (%(default)s)")
    add("--forces", action="store_true", help=f"learn forces on the corners in the first {PUSHED} steps")
    add("--box", action="store_true", help="throw from a table into a box, with options of its own")
    add("--iterations", type=int, default=50, help="at most (%(default)s)")
    add("--rate", type=float, default=1.0, help="learning rate of the optimizer, L-BFGS (%(default)g)")
    add("--within", type=float, default=1e-6, metavar="METRES", help="near enough to end (%(default)g)")
    add("--checkpoint-every", type=int, default=1, metavar="K", help="keep every K-th state only (%(default)s)")
    add("--output", type=file_ending(*ENDINGS), default=Path("out/throw.usdc"), metavar="USD", help="(%(default)s)")
    add("--plot", type=file_ending(".png"), metavar="PNG", help="loss by iteration (the USD file's name, .png)")
    add("--result", type=file_ending(".json"), metavar="JSON", help="numbers (the USD file's name, .json)")
    add_pictures(result)
    add_slowdown(result)
    return result


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches, writes, and tells what was found.

    Returns:
        What the JSON file says.

    Raises:
        InputError: an option that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the search, after the best throw before was written.
    """
    if "--box" in (sys.argv[1:] if arguments is None else arguments):
        return into_box.main(arguments)
    options = parse(parser(), arguments)
    options.plot = options.plot or options.output.with_suffix(".png")
    options.result = options.result or options.output.with_suffix(".json")
    integer("--iterations", options.iterations, least=1)
    real("--rate", options.rate, above=0.0)
    real("--within", options.within, least=0.0)
    make_folders([options.output, options.plot, options.result, options.png, options.mp4])
    check_pictures(options)
    checked_counts(options, "size")
    cloth = woven_cloth(options.fabric, options, options.size, options.size, pose="flat")
    throw = Throw(
        cloth,
        options.target,
        options.time,
        options.steps,
        forces=options.forces,
        checkpoint_every=options.checkpoint_every,
    )
    found = search(throw, options.iterations, options.rate, options.within)
    result = {}
    if found.losses:
        result = numbers(throw, found)
        write(throw, found, result, options)
        tell(throw, result)
        files = (options.output, options.plot, options.result, options.png, options.mp4)
        print("written:", ", ".join(str(file) for file in files if file is not None))
    if found.stop is not None:
        raise found.stop
    return result


def numbers(throw: Throw, found: Search) -> dict[str, Any]:
    """What was found, for the JSON file."""
    value = throw.physical(found.best).tolist()
    result = {
        "learned": "forces" if throw.forces else "velocity",
        "weave": throw.cloth.weave.name,
        "rows": throw.cloth.weave.rows,
        "columns": throw.cloth.weave.columns,
        "target [m]": throw.target.tolist(),
        "time [s]": throw.duration,
        "steps": throw.steps,
        "distance [m]": found.distances[int(np.argmin(found.losses))],
        "iterations": len(found.losses),
        "seconds an iteration": float(np.median(found.seconds)),
        "losses": found.losses,
        "distances [m]": found.distances,
    }
    if throw.forces:
        return {**result, "corners": throw.cloth.corners(), "forces [N]": value}
    return {**result, "velocity [m/s]": value, "velocity of a thrown point [m/s]": throw.analytic().tolist()}


def write(throw: Throw, found: Search, result: dict[str, Any], options: argparse.Namespace) -> None:
    """The output files, those first that need the least."""
    with atomic_write(options.result) as temporary:
        temporary.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    trajectory = throw.trajectory(found.best)
    write_all(
        trajectory,
        lambda: plot(options.plot, found),
        lambda: wy.write_usd(options.output, trajectory, slowdown=options.slowdown),
        *pictures(trajectory, options),
    )


def plot(path: Path, found: Search) -> None:
    """Loss against iterations."""
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.semilogy(range(1, len(found.losses) + 1), found.losses, marker=".")
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss: |centre − target|² / |target|²")
    axes.grid(alpha=0.3)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=150)


def tell(throw: Throw, result: dict[str, Any]) -> None:
    """A few lines about what was found."""
    distance, count, cost = (result[name] for name in ("distance [m]", "iterations", "seconds an iteration"))
    print(f"{1e3 * distance:.6f} mm from the target after {count} iterations of {cost:.2f} s")
    if throw.forces:
        total = np.sum(result["forces [N]"], axis=(0, 1)) * throw.step
        print(f"impulse of the forces: ({total[0]:.3e}, {total[1]:.3e}, {total[2]:.3e}) N s")
        return
    learned, analytic = np.array(result["velocity [m/s]"]), throw.analytic()
    print("velocity:                  ({:.6f}, {:.6f}, {:.6f}) m/s".format(*learned))
    print("that of a thrown point:    ({:.6f}, {:.6f}, {:.6f}) m/s".format(*analytic))
    print(f"they differ by {np.linalg.norm(learned - analytic) / np.linalg.norm(analytic):.1e} of it")


if __name__ == "__main__":
    sys.exit(command(main))
