"""A cloth is dropped onto something, and drapes over it.

python scenes/drape.py                                    the paper's, over a sphere: out/drape.usdc
python scenes/drape.py --over torus --weave satin --png out/drape.png
python scenes/drape.py --over table --fabric handkerchief --rows 41 --columns 41
python scenes/drape.py --mesh bunny.obj --scale 0.1       any file that trimesh reads, in metres times the scale
python scenes/drape.py --record out/drape.npz             and later, to go on from there:
python scenes/drape.py --resume out/drape.npz --steps 100

Beneath is a floor, but for the table, which is higher than the cloth is long.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import touch
from common import command

import warp_yarn as wy
from warp_yarn.description.obstacles import Obstacle

OVER = ("sphere", "box", "table", "torus")


def parser() -> argparse.ArgumentParser:
    result = touch.parser(__doc__, "drape", rows=21, columns=21, steps=300)
    result.add_argument("--over", choices=OVER, help="(sphere)")
    result.add_argument("--mesh", type=Path, metavar="FILE", help="over what this file has, instead")
    touch.add_positive(result, "--scale", 1.0, "metres of a unit of the file")
    return result


def torus(ring: float, tube: float, sides: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """A ring about z: vertices [sides · sides, 3] (m) and triangles [2 sides · sides, 3].

    Args:
        ring, tube: radii [m].
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    around, about = (a.ravel() for a in np.meshgrid(angle, angle, indexing="ij"))
    far = ring + tube * np.cos(about)
    vertices = np.stack([far * np.cos(around), far * np.sin(around), tube * np.sin(about)], axis=1)
    k = np.arange(sides * sides).reshape(sides, sides)
    a, b, c, d = (x.ravel() for x in (k, np.roll(k, -1, 0), np.roll(k, (-1, -1), (0, 1)), np.roll(k, -1, 1)))
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def obstacles(options: argparse.Namespace, length: float) -> tuple[list[Obstacle], float]:
    """What the cloth falls on, of a size that goes with its own, and how high that is [m]."""
    mu = options.friction
    floor = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1), friction=mu)
    if options.mesh is not None:
        mesh = wy.TriangleMesh.read(options.mesh, scale=options.scale, friction=mu)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        middle = 0.5 * (low + high)
        return [floor, mesh.replace(position=(-middle[0], -middle[1], -low[2]))], float(high[2] - low[2])
    if options.over in (None, "sphere"):
        radius = 0.33 * length
        return [floor, wy.Sphere(center=(0, 0, radius), radius=radius, friction=mu)], 2.0 * radius
    if options.over == "box":
        half = np.array([0.22, 0.22, 0.15]) * length
        return [floor, wy.Box(center=(0, 0, half[2]), half_extents=half, friction=mu)], 2.0 * half[2]
    if options.over == "table":
        # the edge is along x, and a quarter of the cloth is beyond it: with less friction than 0.25 it slides off
        half = np.array([0.8, 0.6, 0.05]) * length
        return [wy.Box(center=(0, 0.25 * length - half[1], -half[2]), half_extents=half, friction=mu)], 0.0
    tube = 0.09 * length
    vertices, faces = torus(0.24 * length, tube)
    return [floor, wy.TriangleMesh(vertices, faces, position=(0, 0, tube), friction=mu)], 2.0 * tube


def main(arguments: Sequence[str] | None = None) -> wy.Trajectory:
    """Simulates, writes, and tells what was made.

    Raises:
        InputError: an option that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the simulation, after the frames before it were written.
    """
    options = touch.parsed(parser(), arguments)
    if options.simulator is not None:
        return touch.go_on(options)
    if options.mesh is not None and options.over is not None:
        raise wy.InputError(f"--over {options.over} and --mesh {options.mesh}, must be one of both")
    if options.mesh is None and options.scale != 1.0:
        raise wy.InputError(f"--scale {options.scale:g} is of --mesh, which is not given")
    cloth = touch.flat(options)
    beneath, height = obstacles(options, float(np.ptp(cloth.position, axis=0).max()))
    cloth = touch.raised(cloth, height)
    made = touch.run(touch.scene(cloth, options, obstacles=beneath), options)
    drop = height + touch.rest(cloth) - made.trajectory.position[-1, :, 2].min()
    return touch.finish(made, options, f"it hangs down by {1e3 * drop:.2f} mm")


if __name__ == "__main__":
    sys.exit(command(main))
