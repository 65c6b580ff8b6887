"""A long strip, folded zigzag, falls together and settles, layer on layer.

python scenes/stack.py                                    five layers of the paper's: out/stack.usdc
python scenes/stack.py --layers 9 --weave twill --png out/stack.png
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
import touch
from common import command

import warp_yarn as wy
from warp_yarn.errors import integer

TURN = 5
"""Segments of the half circle from a layer to the next."""


def parser() -> argparse.ArgumentParser:
    result = touch.parser(__doc__, "stack", rows=9, columns=17, steps=400)
    result.add_argument("--layers", type=int, default=5, help="(%(default)s); --columns are the nodes of one")
    return result


def zigzag(columns: int, layers: int) -> np.ndarray:
    """A strip's profile (x, z) in spacings, [nodes, 2], from below: straight layers of so many nodes, and half circles
    from one to the next, all of it in steps of 1."""
    radius = 0.5 / np.sin(0.5 * np.pi / TURN)
    angle = np.pi * np.arange(1, TURN) / TURN
    parts = []
    for k in range(layers):
        forward = k % 2 == 0
        along = np.arange(columns - 1.0 + 1.0)
        parts.append(np.stack([along if forward else along[::-1], np.full(columns, 2.0 * radius * k)], axis=1))
        if k < layers - 1:
            out = radius * np.sin(angle)
            x = columns - 1.0 + out if forward else -out
            parts.append(np.stack([x, 2.0 * radius * k + radius * (1.0 - np.cos(angle))], axis=1))
    return np.concatenate(parts)


def main(arguments: Sequence[str] | None = None) -> wy.Trajectory:
    """Simulates, writes, and tells what was made.

    Raises:
        InputError: an option that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the simulation, after the frames before it were written.
    """
    options = touch.parsed(parser(), arguments)
    if options.simulator is not None:
        return touch.go_on(options)
    layers, columns = integer("--layers", options.layers, least=2), integer("--columns", options.columns, least=3)
    profile = zigzag(columns, layers)
    options.columns = len(profile)
    cloth = touch.flat(options)
    unit = cloth.node_spacing[0, 0]  # along a row
    x = np.tile(profile[:, 0], options.rows) * unit
    z = np.tile(profile[:, 1], options.rows) * unit + touch.rest(cloth)
    cloth = cloth.replace(pose=np.stack([x - x.mean(), cloth.position[:, 1], z], axis=1))
    floor = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1), friction=options.friction)
    made = touch.run(touch.scene(cloth, options, obstacles=[floor]), options)
    return touch.finish(made, options, heights(made.trajectory, columns, layers))


def heights(trajectory: wy.Trajectory, columns: int, layers: int) -> str:
    """How far apart layers lie, in their middle."""
    cloth = trajectory.cloth
    z = trajectory.position[-1, :, 2].reshape(cloth.weave.rows, cloth.weave.columns) / cloth.node_spacing[0, 0]
    middle = np.arange(layers) * (columns + TURN - 1) + columns // 2
    apart = np.diff(np.median(z[:, middle], axis=0))
    return f"layers lie {', '.join(f'{d:.2f}' for d in apart)} spacings apart, from below"


if __name__ == "__main__":
    sys.exit(command(main))
