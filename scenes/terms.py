"""What a scene does not need: how far each term, and sliding, moves the cloth, and what it costs.

python scenes/terms.py                        the paper's 17 × 17 cloth in the wind, 50 steps of 0.5 ms
python scenes/terms.py --fabric cotton        the same of another fabric
python scenes/terms.py my_scene.py --step 1e-3 --steps 200

The file is Python, and sets `scene` to a warp_yarn.Scene (and `state` to a warp_yarn.State to start from, if it likes):

    import warp_yarn as wy
    cloth = wy.paper.cloth("twill", rows=9, columns=9)
    scene = wy.Scene(cloth, pins=cloth.corners("top"), sliding=True)

The scene is run as it is, at half its step, and with each of its terms left out; pins and forces always stay. What
moves the cloth by less than half the step does is lost in the error of the step anyway.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import checked_counts, command

import warp_yarn as wy
from warp_yarn.errors import brief, integer
from warp_yarn.integrators import INTEGRATORS
from warp_yarn.presets import paper
from warp_yarn.presets.fabrics import FABRICS
from warp_yarn.simulation.ablation import Ablation, ablate


def parser() -> argparse.ArgumentParser:
    result = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    add = result.add_argument
    add("file", nargs="?", type=Path, help="a Python file that sets `scene`; none: a hung cloth in a wind")
    add("--fabric", choices=FABRICS, help="of the hung cloth (paper)")
    add("--size", type=int, metavar="N", help="rows and columns of the hung cloth (17)")
    add("--steps", type=int, default=50, help="how many (%(default)s)")
    add("--step", type=float, default=5e-4, metavar="SECONDS", help="time step (%(default)g)")
    add("--integrator", choices=INTEGRATORS, help="(the simulator's default)")
    add("--repeats", type=int, default=7, help="timed runs of each (%(default)s)")
    return result


def main(arguments: Sequence[str] | None = None) -> Ablation:
    """Measures, and tells what was found.

    Raises:
        InputError: an option or a file that cannot be used.
        SimulationError: the scene itself cannot be simulated.
    """
    options = parser().parse_args(arguments)
    scene, state = chosen(options)
    method = {} if options.integrator is None else {"integrator": options.integrator}
    steps, repeats = integer("--steps", options.steps, least=1), integer("--repeats", options.repeats, least=1)
    found = ablate(scene, steps=steps, step=options.step, repeats=repeats, start=state, **method)
    weave, cost = scene.cloth.weave, f"{1e3 * found.seconds:.3g} ms each"
    print(f"{weave.rows} × {weave.columns} yarns, {steps} steps of {1e3 * options.step:g} ms, {cost}")
    print("\n".join(found.lines()))
    return found


def chosen(options: argparse.Namespace) -> tuple[wy.Scene, wy.State | None]:
    """The scene that the options name, and where it starts."""
    if options.file is None:
        checked_counts(options, "size")
        size = 17 if options.size is None else options.size
        return paper.hung(FABRICS[options.fabric or "paper"](rows=size, columns=size)), None
    for name in ("fabric", "size"):
        if getattr(options, name) is not None:
            raise wy.InputError(f"--{name} does not go with a file: {options.file} has its own cloth")
    if not options.file.is_file():
        raise wy.InputError(f"{options.file}: there is no such file")
    names = names_set_by(options.file)
    scene, state = names.get("scene"), names.get("state")
    if not isinstance(scene, wy.Scene):
        raise wy.InputError(f"{options.file}: must set `scene` to a warp_yarn.Scene")
    if not isinstance(state, wy.State | None):
        raise wy.InputError(f"{options.file}: sets `state` to {brief(state)}, must be a warp_yarn.State")
    return scene, state


def names_set_by(file: Path) -> dict[str, Any]:
    """What a Python file sets.

    Raises:
        InputError: it is none, or fails: with the line.
    """
    try:
        return runpy.run_path(str(file))
    except (SyntaxError, ValueError) as error:  # ValueError: of bytes that are no text
        if isinstance(error, wy.InputError):
            raise wy.InputError(f"{file}{line_of(error, file)}: {error}") from error
        if isinstance(error, SyntaxError) or not line_of(error, file):
            raise wy.InputError(f"{file}: is no Python file that sets `scene` ({error})") from error
        raise wy.InputError(f"{file}{line_of(error, file)}: {type(error).__name__}: {error}") from error
    except (Exception, SystemExit) as error:
        raise wy.InputError(f"{file}{line_of(error, file)}: {type(error).__name__}: {error}") from error


def line_of(error: BaseException, file: Path) -> str:
    """Where in a file it was raised, or nothing."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""


if __name__ == "__main__":
    sys.exit(command(main))
