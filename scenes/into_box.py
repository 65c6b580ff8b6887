"""Learns to throw a cloth from a table into the box beside it: what scenes/throw.py --box does.

python scenes/throw.py --box                       forces at the corners: out/box.usdc, out/box.png, out/box.json
python scenes/throw.py --box --learn network       a network that sees the cloth and gives the forces
python scenes/throw.py --box --png out/throw.png   and a picture of the throw

The cloth, 5 × 5 of the paper's yarns, lies on the table, and forces of at most 4 mN along each axis act on its corners
in the first 5 ms. Learned is from a flight in air alone, by the exact gradient of how far from the middle of the box's
bottom it arrives; each throw is then judged with table, box and friction, and the first that ends with every node
inside and at rest ends the search. Ctrl-C ends it too, and writes the best throw so far. docs/control.md has the why.
Needs the extras torch and bench, and render for --png.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tqdm
from common import (
    add_pictures,
    add_slowdown,
    check_pictures,
    file_ending,
    make_folders,
    optional,
    parse,
    pictures,
    write_all,
)

import warp_yarn as wy
from warp_yarn.envs import box
from warp_yarn.errors import integer
from warp_yarn.io.files import atomic_write
from warp_yarn.io.usd import ENDINGS

with optional("torch"):
    from warp_yarn.envs import throws
with optional("bench"):
    from matplotlib.figure import Figure

POLICIES = {"forces": "Forces", "network": "Network"}
SHOWN = (0, 30, 60, 90, 120, box.STEPS)
"""Frames in the picture."""
BESIDE = 8e-3
"""Of table and floor in the picture, around the cloth and the box [m]."""
VIEW = (-0.15, -1.0, 1.05)
"""To the camera: along the throw, from above."""


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("--box", action="store_true", required=True, help="this scene")
    add("--learn", choices=POLICIES, default="forces", help="(%(default)s)")
    add("--seed", type=int, default=0, help="of where learning starts (%(default)s)")
    add("--epochs", type=int, default=70, help="at most (%(default)s)")
    add("--output", type=file_ending(*ENDINGS), default=Path("out/box.usdc"), metavar="USD", help="(%(default)s)")
    add("--plot", type=file_ending(".png"), metavar="PNG", help="loss by epoch (the USD file's name, .png)")
    add("--result", type=file_ending(".json"), metavar="JSON", help="numbers (the USD file's name, .json)")
    add_pictures(result, "several moments of the throw")
    add_slowdown(result)
    return result


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Learns, writes, and tells what was found.

    Returns:
        What the JSON file says.

    Raises:
        InputError: an option that cannot be used.
        KeyboardInterrupt: after the best throw before was written.
    """
    options = parse(parser(), arguments)
    integer("--epochs", options.epochs, least=1)
    integer("--seed", options.seed, least=0)
    options.plot = options.plot or options.output.with_suffix(".png")
    options.result = options.result or options.output.with_suffix(".json")
    make_folders([options.output, options.plot, options.result, options.png, options.mp4])
    check_pictures(options)
    policy = getattr(throws, POLICIES[options.learn])(options.seed)
    found: list[throws.Epoch] = []
    stop: BaseException | None = None
    try:
        with tqdm.tqdm(total=options.epochs, unit="epoch", desc="compiling", disable=None) as bar:
            for epoch in throws.learn(throws.Throw(), policy, options.epochs):
                found.append(epoch)
                bar.set_description("throwing", refresh=False)
                bar.set_postfix(loss=f"{epoch.loss:.2e}", mm=f"{1e3 * epoch.miss:.1f}")
                bar.update()
                if epoch.success:
                    break
    except KeyboardInterrupt as error:
        stop = error
    result: dict[str, Any] = {}
    if any(math.isfinite(epoch.miss) for epoch in found):
        best = min(found, key=rank)
        result = numbers(found, best, options)
        write(found, best, result, options)
        tell(result)
        files = [options.output, options.plot, options.result, options.png, options.mp4]
        print("written:", ", ".join(str(file) for file in files if file is not None))
    if stop is not None:
        raise stop
    return result


def rank(epoch: throws.Epoch) -> tuple[bool, float]:
    """How good a throw is: less is better."""
    return not epoch.success, epoch.miss if math.isfinite(epoch.miss) else math.inf


def numbers(found: Sequence[throws.Epoch], best: throws.Epoch, options: argparse.Namespace) -> dict[str, Any]:
    """What was found, for the JSON file."""
    return {
        "learned": options.learn,
        "seed": options.seed,
        "success": best.success,
        "epochs": len(found),
        "seconds": found[-1].seconds,
        "arrives from the middle [m]": best.miss,
        "corners": box.cloth().corners(),
        "forces [N]": best.forces.tolist(),
        "losses": [epoch.loss for epoch in found],
        "misses [m]": [epoch.miss for epoch in found],
    }


def write(
    found: Sequence[throws.Epoch], best: throws.Epoch, result: dict[str, Any], options: argparse.Namespace
) -> None:
    """The output files, those first that need the least."""
    with atomic_write(options.result) as temporary:
        temporary.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    trajectory = throws.true_throw(best.forces)
    writers = [
        lambda: plot(options.plot, found),
        lambda: wy.write_usd(options.output, trajectory, slowdown=options.slowdown),
    ]
    still = None if options.png is None else moments(trajectory)
    write_all(trajectory, *writers, *pictures(trajectory, options, still, view=VIEW))


def moments(trajectory: wy.Trajectory) -> wy.Trajectory:
    """One frame that has a cloth for each moment of the throw, and of table and floor what is near, for the whole of
    them would leave the cloths too small."""
    cloths = [trajectory.cloth.replace(pose=trajectory.position[frame]) for frame in SHOWN]
    table, floor, *walls = trajectory.scene.obstacles
    edge, high = table.position[0] + table.size[0], table.size[2]
    half = 0.5 * (edge + BESIDE)
    top = wy.Box(center=(edge - half, 0, -high), half_extents=(half, BESIDE, high), friction=table.friction)
    # planes are drawn beneath the first cloth alone
    far = box.PLACE[0] + 0.5 * box.INNER
    half = 0.5 * (far + 2.0 * BESIDE)
    slab = wy.Box(
        center=(0.5 * far, 0, box.BOTTOM - 1e-3),
        half_extents=(half, 0.5 * box.INNER + BESIDE, 1e-3),
        friction=floor.friction,
    )
    return wy.Simulator(wy.Scene(cloths, obstacles=[top, slab, *walls]), step=trajectory.step).run(0)


def plot(path: Path, found: Sequence[throws.Epoch]) -> None:
    """Loss against epochs, and where the throws arrive."""
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    epochs = np.arange(1, len(found) + 1)
    axes.semilogy(epochs, [epoch.loss for epoch in found], marker=".", label="loss: |centre − target|² / |target|²")
    misses = np.array([epoch.miss for epoch in found]) / np.linalg.norm(box.target())
    axes.semilogy(epochs, misses**2, marker=".", label="of the true throw, along x and y")
    for epoch, miss, at in zip(found, misses, epochs, strict=True):
        if epoch.success:
            axes.plot(at, miss**2, "*", color="black", markersize=12)
    axes.set_xlabel("epoch (★: ends in the box)")
    axes.legend()
    axes.grid(alpha=0.3)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=150)


def tell(result: dict[str, Any]) -> None:
    """A few lines about what was found."""
    for number, (loss, miss) in enumerate(zip(result["losses"], result["misses [m]"], strict=True), 1):
        print(f"epoch {number}: loss {loss:.3e}, the true throw arrives {1e3 * miss:.1f} mm from the middle")
    ends = "in the box, at rest" if result["success"] else "NOT in the box"
    print(f"the best throw ends {ends}; {result['epochs']} epochs in {result['seconds']:.1f} s")
    total = np.sum(result["forces [N]"], axis=(0, 1)) * box.STEP
    print("impulse of its forces: ({:.3e}, {:.3e}, {:.3e}) N s".format(*total))
