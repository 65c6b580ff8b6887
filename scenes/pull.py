"""A tray, or a cloth, is pulled away under a cloth: slowly, and that goes along; fast, and it stays, and falls.

python scenes/pull.py                                     at 20 m/s² up to 1 m/s: out/pull.usdc
python scenes/pull.py --acceleration 1 --speed 0.05       the cloth rides along
python scenes/pull.py --beneath cloth --steps 60          from under a smaller one, on a table
python scenes/pull.py --friction 0.1 --weave satin --png out/pull.png

Friction cannot accelerate the cloth by more than μ g. Below the tray is a floor.
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

GRAVITY = 9.8
MORE = 1000
"""Steps that what is beneath goes on after those of a run, for --resume."""
SMALLER = 6
"""Yarns either way that the upper cloth has less than the lower one."""
LAYERS = 2.5
"""Of the upper cloth over the lower one, in spacings: where they touch, but hardly."""


def parser() -> argparse.ArgumentParser:
    result = touch.parser(__doc__, "pull", rows=17, columns=17, steps=45)
    result.add_argument("--beneath", choices=("tray", "cloth"), default="tray", help="(%(default)s)")
    touch.add_positive(result, "--acceleration", 20.0, "of what is beneath [m/s²]")
    touch.add_positive(result, "--speed", 1.0, "its last [m/s]")
    return result


def way(acceleration: float, speed: float, time: np.ndarray) -> np.ndarray:
    """How far what is beneath has moved [m]: steadily faster, then steadily."""
    until = speed / acceleration
    return np.where(time < until, 0.5 * acceleration * time**2, speed * (time - 0.5 * until))


def main(arguments: Sequence[str] | None = None) -> wy.Trajectory:
    """Simulates, writes, and tells what was made.

    Raises:
        InputError: an option that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the simulation, after the frames before it were written.
    """
    options = touch.parsed(parser(), arguments)
    if options.simulator is not None:
        return touch.go_on(options)
    cloth = touch.flat(options)
    length = float(np.ptp(cloth.position, axis=0).max())
    moved = way(options.acceleration, options.speed, options.step * np.arange(1, options.steps + MORE + 1))
    along = moved[:, None] * np.array([0.0, 1.0, 0.0])
    floor = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1), friction=options.friction)
    if options.beneath == "tray":
        half = np.array([0.55, 0.55, 0.04]) * length
        high = 0.35 * length
        center = np.array([0.0, 0.0, high - half[2]])
        tray = wy.Box(center=center, half_extents=half, friction=options.friction, path=center + along)
        made = touch.run(touch.scene(touch.raised(cloth, high), options, obstacles=[floor, tray]), options)
    else:
        for name in ("rows", "columns"):
            integer(f"--{name} of a cloth beneath another", getattr(options, name), least=SMALLER + 3)
        lower = touch.raised(cloth, 0.0)
        fewer = {"rows": options.rows - SMALLER, "columns": options.columns - SMALLER}
        smaller = argparse.Namespace(**{**vars(options), **fewer})
        upper = touch.raised(touch.flat(smaller), LAYERS * cloth.longest_spacing)
        pins = [lower.node(-1, column) for column in range(options.columns)]
        path = lower.position[pins] + along[:, None]
        scene = touch.scene(lower, options, upper, obstacles=[floor], pins=pins, pin_path=path)
        made = touch.run(scene, options)
    return touch.finish(made, options, shares(made.trajectory, moved, options))


def shares(trajectory: wy.Trajectory, moved: np.ndarray, options: argparse.Namespace) -> str:
    """How far the cloth went with what was beneath it."""
    upper = trajectory.cloth.nodes_of(1) if isinstance(trajectory.cloth, wy.Cloths) else slice(None)
    went = (trajectory.position[-1] - trajectory.position[0])[upper, 1].mean()
    of = moved[len(trajectory) - 2] if len(trajectory) > 1 else 0.0
    most = options.friction * GRAVITY
    asked = f"its {options.acceleration:g} m/s², friction's limit {most:.3g} m/s²"
    return f"the {options.beneath} beneath went {1e3 * of:.1f} mm, the cloth on it {1e3 * went:.1f} mm ({asked})"


if __name__ == "__main__":
    sys.exit(command(main))
