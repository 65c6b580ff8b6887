"""What the scenes share: a run that loses no finished frame, output files, and how a command ends."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import warp as wp

import warp_yarn as wy
from warp_yarn.description.weave import woven
from warp_yarn.errors import integer, real
from warp_yarn.io.draft import ENDINGS
from warp_yarn.io.files import check_writable
from warp_yarn.presets.fabrics import FABRICS


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, or as much of one as was made.

    Args:
        trajectory: every frame that was finished, the first one the state it started from.
        seconds: wall time, with what had to be compiled.
        stop: what ended it early, to be raised once the frames are written; None: it was not.
    """

    trajectory: wy.Trajectory
    seconds: float
    stop: BaseException | None

    def end(self) -> None:
        """Raises what ended the run early."""
        if self.stop is not None:
            raise self.stop


def simulate(simulator: wy.Simulator, steps: int) -> Run:
    """Makes steps under a progress bar: Ctrl-C or a step that fails leaves every frame before it."""
    steps, begin, stop = integer("steps", steps, least=1), time.perf_counter(), None
    try:
        trajectory = simulator.run(steps, progress=None)
    except (wy.SimulationError, KeyboardInterrupt) as error:
        trajectory, stop = simulator.trajectory or simulator.run(0), error
    return Run(trajectory, time.perf_counter() - begin, stop)


def write_all(trajectory: wy.Trajectory, *writers: Callable[[], None]) -> None:
    """Calls what writes files, each even if another failed; then nothing that was simulated is lost.

    Raises:
        OSError: the first failure, after the frames were saved where temporary files go.
    """
    failures = []
    for write in writers:
        try:
            write()
        except OSError as error:
            failures.append(error)
    if failures:
        rescue = Path(tempfile.mkdtemp(prefix="warp_yarn-")) / "frames.npz"
        trajectory.save(rescue)
        print(f"All frames are kept in {rescue}, for --resume and Trajectory.load.", file=sys.stderr)
        raise failures[0]


def read_number(name: str, text: str, **allowed: float) -> float:
    """A number that was typed.

    Raises:
        InputError: it is none, or out of its range (as of ``errors.real``).
    """
    try:
        value: Any = float(text)
    except ValueError:
        value = text  # and real() says so
    return real(name, value, **allowed)


def file_ending(*endings: str) -> Callable[[str], Path]:
    """An argparse type: a path with one of these endings. Found out before a long run and not after it."""

    def path(text: str) -> Path:
        if not text.endswith(endings):
            raise argparse.ArgumentTypeError(f"{text!r} must end in {', '.join(endings)}")
        return Path(text)

    return path


def add_weave(parser: argparse.ArgumentParser) -> None:
    """The options --weave and --draft of what weaves a cloth."""

    def words(text: str) -> str:
        try:
            woven(text, rows=3, columns=3)
        except wy.InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return text

    text = f'{", ".join(wy.WEAVES)} (the paper\'s), or words such as "2/2 twill Z" and "satin 5/2" (that of the fabric)'
    parser.add_argument("--weave", type=words, metavar="WORDS", help=text)
    text = "a weaver's draft, .wif, .dtx or .wpo: its weave, repeated or cut to the size, and its colours"
    parser.add_argument("--draft", type=file_ending(*ENDINGS, *map(str.upper, ENDINGS)), metavar="FILE", help=text)


def woven_cloth(fabric: str, options: argparse.Namespace, rows: int, columns: int, **more: Any) -> wy.Cloth:
    """A cloth of a fabric, woven as --weave or --draft say."""
    make = FABRICS[fabric]
    if options.draft is None:
        # without words a fabric has its own weave
        return make(**({"weave": options.weave} if options.weave else {}), rows=rows, columns=columns, **more)
    if options.weave is not None:
        raise wy.InputError(f"--weave = {options.weave} does not go with --draft, which has its own")
    draft = wy.read_draft(options.draft).tiled(rows=rows, columns=columns)
    cloth = make(weave=draft.weave, rows=rows, columns=columns, **more)
    colored = draft.warp_colors is not None and draft.weft_colors is not None
    return draft.dyed(cloth) if colored else cloth


def add_slowdown(parser: argparse.ArgumentParser) -> None:
    """The option --slowdown of what is written to be played."""

    def positive(text: str) -> float:
        return read_number("--slowdown", text, above=0.0)

    text = "seconds of playing time for one of simulated time, in files (%(default)g)"
    parser.add_argument("--slowdown", type=positive, default=20.0, metavar="FACTOR", help=text)


def make_folders(paths: Sequence[Path | None]) -> None:
    """Makes the folders of output files, those that are given, and finds out now whether they can be written.

    Raises:
        OSError: they cannot.
    """
    for path in paths:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            check_writable(path)


def command(main: Callable[[Sequence[str] | None], Any], arguments: Sequence[str] | None = None) -> int:
    """Runs a scene's main and says on stderr what went wrong.

    Returns:
        Exit code: 0; 1 a simulation failed, or its gradient; 2 wrong arguments or files; 130 Ctrl-C.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # what a terminal cannot show becomes a question mark
            stream.reconfigure(errors="replace")
    wp.config.log_level = wp.LOG_WARNING
    try:
        main(arguments)
    except wy.SimulationError as error:
        print(f"The simulation failed in {error}", file=sys.stderr)
        return 1
    except wy.GradientError as error:
        print(f"There is no gradient: {error}", file=sys.stderr)
        return 1
    except (wy.InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped by Ctrl-C.", file=sys.stderr)
        return 130
    return 0
