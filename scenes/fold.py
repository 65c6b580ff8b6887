"""A cloth on a table is folded: one edge is carried over to the other on moving pins, and let go.

python scenes/fold.py                                     the paper's: out/fold.usdc
python scenes/fold.py --weave twill --columns 25 --png out/fold.png --mp4 out/fold.mp4

Folding and letting go are two scenes, the second of which begins where the first one ends: pins cannot be taken out of
one. --steps are those of the second; --fold those of the first.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence

import numpy as np
import touch
from common import Run, command, frames_a_second, simulate, write_all

import warp_yarn as wy
from warp_yarn.errors import integer
from warp_yarn.simulation.pace import Pace, every_of
from warp_yarn.simulation.state import FIELDS

SHORT = 2.0
"""How far it is let go before the other edge, in spacings: on it, it would slip over."""
LAYERS = 2.5
"""How far above the other edge the carried one is let go, in spacings: where layers touch, but hardly."""


def parser() -> argparse.ArgumentParser:
    result = touch.parser(__doc__, "fold", rows=15, columns=21, steps=200)
    result.add_argument("--fold", type=int, default=600, metavar="STEPS", help="of the fold, before (%(default)s)")
    return result


def carried(cloth: wy.Cloth, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The nodes of the left edge, and their way [steps, nodes, 3] (m): over the other edge, in half an ellipse, fast in
    its middle and slow at its ends. A higher one would drag the cloth along, a lower one leave it slack, to buckle."""
    rows, columns = cloth.weave.rows, cloth.weave.columns
    pins = np.arange(rows) * columns
    start = cloth.position[pins]
    length = cloth.position[:, 0].max() - cloth.position[:, 0].min()
    angle = 0.5 * np.pi * (1.0 - np.cos(np.pi * np.arange(1, steps + 1) / steps))
    across = 0.5 * (length - SHORT * cloth.longest_spacing) * (1.0 - np.cos(angle))
    up = 0.47 * length * np.sin(angle) + LAYERS * cloth.longest_spacing * angle / np.pi
    way = np.stack([across, np.zeros(steps), up], axis=1)
    return pins, start + way[:, None]


def joined(before: wy.Trajectory, after: wy.Trajectory) -> wy.Trajectory:
    """Both, as one of the second scene, which goes on in the first one's last state."""
    parts = {name: np.concatenate([getattr(before, name), getattr(after, name)[1:]]) for name in FIELDS}
    return dataclasses.replace(after, **parts, start=before.start)


def main(arguments: Sequence[str] | None = None) -> wy.Trajectory:
    """Simulates, writes, and tells what was made.

    Raises:
        InputError: an option that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the simulation, after the frames before it were written.
    """
    options = touch.parsed(parser(), arguments)
    if options.simulator is not None:
        if options.simulator.scene.pin_path is not None:
            raise wy.InputError(f"--resume {options.resume} ended within the fold, must have let go: begin anew")
        return touch.go_on(options)
    integer("--fold", options.fold, least=1)
    table = [wy.Plane(point=(0, 0, 0), normal=(0, 0, 1), friction=options.friction)]
    cloth = touch.raised(touch.flat(options), 0.0)
    pins, path = carried(cloth, options.fold)
    held = touch.scene(cloth, options, obstacles=table, pins=pins, pin_path=path)
    each_step = argparse.Namespace(**{**vars(options), "fps": None})
    first = simulate(touch.simulator(held, options), each_step, steps=options.fold)
    made = first
    if first.stop is None:
        simulator = touch.simulator(held.replace(pins=(), pin_path=None), options)
        simulator.state = first.trajectory[-1]
        simulator.steps_done = options.fold
        second = simulate(simulator, each_step)
        made = Run(joined(first.trajectory, second.trajectory), first.seconds + second.seconds, second.stop)
    made = dataclasses.replace(made, trajectory=filmed(made.trajectory, options))
    write(made.trajectory, options)
    return touch.finish(made, options, thickness(made.trajectory))


def filmed(trajectory: wy.Trajectory, options: argparse.Namespace) -> wy.Trajectory:
    """The frames that --fps asks for, of a trajectory of every step; between two steps on a straight line."""
    rate = frames_a_second(options)
    if rate is None:
        return trajectory
    every = every_of(rate, trajectory.step)
    places = Pace.of(trajectory.step, len(trajectory) - 1, None, every).places()
    before = places.astype(int)
    after, share = np.minimum(before + 1, len(trajectory) - 1), (places - before)[:, None, None]
    parts = {}
    for name in FIELDS:
        values = getattr(trajectory, name)
        parts[name] = values[before] + share * (values[after] - values[before])
    return dataclasses.replace(trajectory, **parts, step=every * trajectory.step, every=every)


def write(trajectory: wy.Trajectory, options: argparse.Namespace) -> None:
    """The files of both scenes, which are one to whoever looks."""
    writers = [lambda: wy.write_usd(options.output, trajectory, tubes=options.tubes, slowdown=options.slowdown)]
    if options.record is not None:
        writers.insert(0, lambda: trajectory.save(options.record))
    write_all(trajectory, *writers)


def thickness(trajectory: wy.Trajectory) -> str:
    """How high the fold is at its edges, where they lie on each other, and where it turns."""
    cloth = trajectory.cloth
    z = trajectory.position[-1, :, 2].reshape(cloth.weave.rows, cloth.weave.columns) / cloth.longest_spacing
    edge, turn = np.median(z[:, 0] - z[:, -1]), np.ptp(z, axis=1).max()
    return f"the edges lie {edge:.2f} spacings apart; the fold is {turn:.2f} spacings high"


if __name__ == "__main__":
    sys.exit(command(main))
