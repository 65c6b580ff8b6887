"""The paper's published data against this simulator: starts from frame 1 of a file and follows it.

    python scenes/published.py FILE [--usd out/published.usdc]

The error is the root mean square over the nodes of the distance to the published position, the displacement that of
the published position from frame 1. On wind_plain_12_5x5.h5, at frame 25, the published motion is 6.4 % of its
displacement away from the converged one (h → 0), this one, by the same eq. 2 at the same 1 ms, 10.9 %, and they are
6.5 % away from each other: the published code has an inexact Jacobian of the shear force, this one a symmetric positive
definite matrix. Later the cloth flutters and swings back through where it began, so that the displacement is small at
some frames and the error relative to it large: look at both.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from common import add_slowdown, command, file_ending, make_folders, simulate

import warp_yarn as wy
from warp_yarn.io.usd import ENDINGS

FRAMES = (2, 5, 10, 25, 50, 100, 200, 300, 400)
"""Frames to compare, and the last one."""


def main(arguments: Sequence[str] | None = None) -> dict[int, float]:
    """Follows a published file and prints the distance to it.

    Returns:
        {frame: error relative to the displacement}.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="an HDF5 file of the paper's published data")
    parser.add_argument("--usd", type=file_ending(*ENDINGS), metavar="FILE", help="write the simulated motion")
    add_slowdown(parser)
    parser.set_defaults(fps=None)
    options = parser.parse_args(arguments)
    make_folders([options.usd])
    published = wy.read_published(options.file)
    frames = published.trajectory
    # the published motion's own method: what is compared is the model, not the error of its steps
    simulator = wy.Simulator(published.scene, step=frames.step, integrator="linear")
    simulator.state = frames[1]
    last = len(frames) - 1
    run = simulate(simulator, options, [options.usd], steps=last - 1)
    relative = {}
    print("frame  error [µm]  displacement [µm]   relative")
    for frame, position in enumerate(run.trajectory.position[1:], start=2):
        if frame in FRAMES or frame == last:
            error, displacement = published.distance(position, frame)
            relative[frame] = error / displacement
            print(f"{frame:5d} {1e6 * error:11.1f} {1e6 * displacement:18.1f} {100.0 * relative[frame]:8.1f} %")
    if options.usd is not None:
        print("written:", options.usd)
    run.end()
    return relative


if __name__ == "__main__":
    sys.exit(command(main))
