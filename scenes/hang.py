"""A cloth, hung by its two top corners, in a wind: simulated and written as a USD file.

python scenes/hang.py                                     the paper's, 17 × 17, plain, 500 × 1 ms: out/hang.usdc
python scenes/hang.py --fabric handkerchief               one that you might have at hand
python scenes/hang.py --size 31 --weave twill --yarns 1 3 --png out/hang.png --mp4 out/hang.mp4
python scenes/hang.py --weave "3/1 twill S"               as weavers say it; or --draft FILE.wif, as they draw it
python scenes/hang.py --seconds 2 --fps 24                a film: 24 frames a second of playing time, slowed down
python scenes/hang.py --record out/hang.npz               and later, to go on from there:
python scenes/hang.py --resume out/hang.npz --steps 500 --output out/both.usdc
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    Run,
    add_length,
    add_pictures,
    add_recording,
    add_weave,
    check_pictures,
    checked_counts,
    command,
    draw,
    file_ending,
    make_folders,
    resumed,
    settle_length,
    simulate,
    woven_cloth,
)

import warp_yarn as wy
from warp_yarn.io.usd import ENDINGS
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("--fabric", choices=FABRICS, help="(paper)")
    add("--size", type=int, metavar="N", help="rows and columns (17)")
    add("--rows", type=int, help="number of warp yarns, at least 3")
    add("--columns", type=int, help="number of weft yarns, at least 3")
    add_weave(result)
    add("--yarns", type=int, nargs=2, metavar=("EVEN", "ODD"), help="two of the paper's yarns 1, 2 and 3 (1 2)")
    add("--wind", type=float, nargs=3, metavar=("X", "Y", "Z"), help="m/s (0 5 0)")
    add_length(result, paper.STEPS)
    add("--step", type=float, metavar="SECONDS", help=f"time step ({paper.STEP:g})")
    add(
        "--locked",
        action="store_true",
        default=None,
        help="yarns do not slide along each other: 3 instead of 5 unknowns a node",
    )
    add("--output", type=file_ending(*ENDINGS), default=Path("out/hang.usdc"), metavar="USD", help="(%(default)s)")
    add("--tubes", action="store_true", help="yarns as meshes, for programs that do not draw curves")
    add_pictures(result)
    add_recording(result)
    return result


def main(arguments: Sequence[str] | None = None) -> wy.Trajectory:
    """Simulates, writes, and tells what was made.

    Raises:
        InputError: an option or a file that cannot be used.
        SimulationError, KeyboardInterrupt: what ended the simulation, after the frames before it were written.
    """
    options = parser().parse_args(arguments)
    simulator = resumed(options, arguments) or wy.Simulator(**chosen(options))
    settle_length(options, simulator.step_size)
    make_folders([options.output, options.png, options.mp4, options.record])
    check_pictures(options)
    run = simulate(simulator, options, [options.output, options.record], after=options.resume)
    draw(run, options)
    tell(run, options)
    run.end()
    return run.trajectory


def chosen(options: argparse.Namespace) -> dict[str, Any]:
    """The scene and the time step that the options name."""
    checked_counts(options, "size", "rows", "columns")
    size = 17 if options.size is None else options.size
    rows = size if options.rows is None else options.rows
    columns = size if options.columns is None else options.columns
    step = paper.STEP if options.step is None else options.step
    fabric = options.fabric or "paper"
    if options.yarns is not None and fabric != "paper":
        raise wy.InputError(f"--yarns = {' '.join(map(str, options.yarns))} are the paper's: not of --fabric {fabric}")
    yarns = {} if options.yarns is None else {"yarns": options.yarns}
    cloth = woven_cloth(fabric, options, rows, columns, **yarns)
    wind = wy.Wind(velocity=tuple(options.wind or paper.WIND))
    return {"scene": paper.hung(cloth, wind=wind, sliding=not options.locked), "step": step}


def tell(run: Run, options: argparse.Namespace) -> None:
    """A few lines about what was made."""
    trajectory = run.trajectory
    weave = trajectory.cloth.weave
    sliding = np.abs(trajectory.euler - trajectory.cloth.euler).max()
    print(f"{weave.rows} × {weave.columns} yarns, {weave.name}: {len(trajectory)} frames, in {run.seconds:.2g} s")
    print(f"lowest point at z = {1e3 * trajectory.position[-1, :, 2].min():.3f} mm in the last frame")
    print(f"largest sliding of a yarn: {1e6 * sliding:.3f} µm")
    files = [options.output, options.record, options.png, options.mp4]
    print("written:", ", ".join(str(file) for file in files if file is not None))


if __name__ == "__main__":
    sys.exit(command(main))
