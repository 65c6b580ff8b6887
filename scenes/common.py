"""What the scenes share: how long a run is, one that loses no finished frame, output files, and how a command ends."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import warp_yarn as wy
from warp_yarn.description.weave import woven
from warp_yarn.errors import integer, missing_extra, real
from warp_yarn.io.draft import ENDINGS
from warp_yarn.io.files import check_writable
from warp_yarn.io.films import RECORDINGS
from warp_yarn.presets.fabrics import FABRICS
from warp_yarn.simulation.pace import ROUNDING
from warp_yarn.view.camera import checked_view
from warp_yarn.view.render import check_drawing, checked_size

LEAST_YARNS = 3
"""Of a weave, either way."""
MISSING: list[tuple[str, str]] = []
"""Packages that a scene asked for and did not find, and the extras that they are of."""


@contextlib.contextmanager
def optional(extra: str) -> Iterator[None]:
    """Lets a scene go on without the packages of an extra that it imports, until it is to run: --help needs none."""
    try:
        yield
    except ModuleNotFoundError as error:
        MISSING.append((str(error.name), extra))


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the options of a scene that has all that it needs.

    Raises:
        InputError: a package is missing.
    """
    options = parser.parse_args(arguments)
    for package, extra in MISSING:
        raise missing_extra(package, "this scene needs", extra)
    return options


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


def add_length(parser: argparse.ArgumentParser, steps: int) -> None:
    """The options --steps, --seconds and --fps of a run, and --slowdown."""
    add = parser.add_argument
    add("--steps", type=int, help=f"how many ({steps})")
    add("--seconds", type=number_above("--seconds", 0.0), help="of simulated time, in place of --steps")
    text = "frames in a second of playing time; none: a frame a step. Slow motion takes more of them"
    add("--fps", type=number_above("--fps", 0.0), metavar="N", help=text)
    parser.set_defaults(steps_by_default=steps)
    add_slowdown(parser)


def settle_length(options: argparse.Namespace, step: float) -> None:
    """Says --seconds in steps, and finds out whether --fps frames can be made of them.

    Raises:
        InputError: both are given, or there would be more frames than steps.
    """
    step = real("--step", step, above=0.0)
    if options.seconds is not None:
        if options.steps is not None:
            raise wy.InputError(f"--steps {options.steps} and --seconds {options.seconds:g}, must be one of them")
        options.steps = max(1, math.ceil(options.seconds / step - ROUNDING))
    if options.steps is None:
        options.steps = options.steps_by_default
    integer("--steps", options.steps, least=1)
    rate = frames_a_second(options)
    if rate is not None and rate * step > 1.0 + ROUNDING:
        most = 1.0 / (step * options.slowdown)
        raise wy.InputError(
            f"--fps {options.fps:g} at --slowdown {options.slowdown:g}, must be at most {most:g}: a frame a step of "
            f"{step:g} s"
        )


def frames_a_second(options: argparse.Namespace) -> float | None:
    """Of simulated time, which plays slower; None: a frame a step."""
    return None if options.fps is None else options.fps * options.slowdown


BESIDE_A_RECORDING = (
    "--steps", "--seconds", "--fps", "--slowdown", "--output", "--tubes", "--png", "--mp4", "--pixels", "--view",
    "--record", "--resume",
)  # fmt: skip
"""Options of a run that goes on from a recording; all else is what that has."""


def add_recording(parser: argparse.ArgumentParser) -> None:
    """The options --record and --resume."""
    text = "the frames as numbers (.npz, .h5), for --resume and wy.Trajectory.load"
    parser.add_argument("--record", type=file_ending(*RECORDINGS), metavar="FILE", help=text)
    text = "go on from the end of a recording, at its frames a second"
    parser.add_argument("--resume", type=file_ending(*RECORDINGS), metavar="FILE", help=text)


def resumed(options: argparse.Namespace, arguments: Sequence[str] | None) -> wy.Simulator | None:
    """A simulator at the end of the recording that --resume names; None where it names none.

    Args:
        options: that were read of the arguments.
        arguments: as main() has them.

    Raises:
        InputError: an option of what the recording has itself; a recording that cannot be used.
    """
    if options.resume is None:
        return None
    for argument in sys.argv[1:] if arguments is None else arguments:
        name = argument.partition("=")[0]
        if name.startswith("--") and name not in BESIDE_A_RECORDING:
            raise wy.InputError(f"{name} does not go with --resume: {options.resume} has its own")
    return wy.Simulator.resumed(options.resume)


def simulate(
    simulator: wy.Simulator,
    options: argparse.Namespace,
    files: Sequence[Path | None] = (),
    *,
    steps: int | None = None,
    after: Path | None = None,
) -> Run:
    """Makes steps under a progress bar, and writes files as the frames come: Ctrl-C, SIGTERM, a full disk or a step
    that fails leaves every frame before it.

    Args:
        options: of ``add_length``.
        files: USD files and recordings, those that are given.
        steps: in place of those of the options.
        after: the recording that the run goes on from, whose frames come first.
    """
    begin, stop = time.perf_counter(), None
    given = [path for path in files if path is not None]
    with tempfile.TemporaryDirectory(prefix="warp_yarn-", ignore_cleanup_errors=True) as folder:
        # what is looked at afterwards, pictures among it, is read from a recording
        kept = next((path for path in given if path.suffix in RECORDINGS), Path(folder) / "frames.npz")
        paths = given if kept in given else [*given, kept]
        try:
            simulator.record(
                *paths,
                steps=options.steps if steps is None else steps,
                fps=frames_a_second(options),
                after=after,
                slowdown=options.slowdown,
                tubes=getattr(options, "tubes", False),
                progress=None,
            )
        except (wy.SimulationError, KeyboardInterrupt, OSError) as error:
            stop = error
        there = kept.exists()
        trajectory = wy.Trajectory.load(kept) if there else simulator.run(0)
        if isinstance(stop, wy.SimulationError):
            stop.trajectory = trajectory
        if isinstance(stop, OSError) and there and kept.parent == Path(folder):
            rescue(trajectory)
    return Run(trajectory, time.perf_counter() - begin, stop)


def rescue(trajectory: wy.Trajectory) -> None:
    """Saves frames where temporary files go, and says so."""
    path = Path(tempfile.mkdtemp(prefix="warp_yarn-")) / "frames.npz"
    trajectory.save(path)
    print(f"All frames are kept in {path}, for --resume and Trajectory.load.", file=sys.stderr)


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
        rescue(trajectory)
        raise failures[0]


def add_pictures(parser: argparse.ArgumentParser, shown: str = "the last frame") -> None:
    """The options --png and --mp4, and --pixels and --view of both.

    Args:
        shown: in the picture.
    """
    add = parser.add_argument
    add("--png", type=file_ending(".png"), metavar="FILE", help=f"a picture of {shown}")
    add("--mp4", type=file_ending(".mp4"), metavar="FILE", help="a movie")
    add("--pixels", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="of the picture, and of the movie")
    add(
        "--view", type=float, nargs=3, metavar=("X", "Y", "Z"), help="from the cloth to the camera; 0 0 1 is from above"
    )


def check_pictures(options: argparse.Namespace) -> None:
    """Finds out before a run whether pictures and movies that are asked for can be drawn.

    Raises:
        InputError: they cannot, or an option of theirs is out of its range.
    """
    if options.pixels is not None:
        checked_size("--pixels", options.pixels, movie=options.mp4 is not None)
    if options.view is not None:
        checked_view("--view", options.view)
    if options.png is not None or options.mp4 is not None:
        check_drawing(movies=options.mp4 is not None)


def pictures(
    trajectory: wy.Trajectory, options: argparse.Namespace, still: wy.Trajectory | None = None, **picture: Any
) -> list[Callable[[], None]]:
    """What writes the files that --png and --mp4 ask for.

    Args:
        still: whose last frame the picture shows; None: that of the trajectory.
        picture: size and view where the options have none.
    """
    if options.pixels is not None:
        picture["size"] = options.pixels
    if options.view is not None:
        picture["view"] = options.view
    writers: list[Callable[[], None]] = []
    if options.png is not None:
        writers.append(lambda: wy.write_png(options.png, trajectory if still is None else still, **picture))
    if options.mp4 is not None:
        rate = {} if getattr(options, "fps", None) is None else {"fps": options.fps}
        slow = {"slowdown": options.slowdown, **rate, **picture}
        writers.append(lambda: wy.write_mp4(options.mp4, trajectory, progress=None, **slow))
    return writers


def draw(run: Run, options: argparse.Namespace, **picture: Any) -> None:
    """Draws what --png and --mp4 ask for, as of ``pictures``."""
    write_all(run.trajectory, *pictures(run.trajectory, options, **picture))


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


def checked_counts(options: argparse.Namespace, *names: str) -> None:
    """Looks whether the options of these names, numbers of yarns, are enough for a weave, where they are given.

    Raises:
        InputError: they are not.
    """
    for name in names:
        if getattr(options, name) is not None:
            integer(f"--{name}", getattr(options, name), least=LEAST_YARNS)


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


def number_above(name: str, least: float) -> Callable[[str], float]:
    """An argparse type: a number above another. argparse would not say which numbers are."""

    def number(text: str) -> float:
        try:
            return read_number(name, text, above=least)
        except wy.InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return number


def add_slowdown(parser: argparse.ArgumentParser) -> None:
    """The option --slowdown of what is written to be played."""
    text = "seconds of playing time for one of simulated time, in files (%(default)g)"
    parser.add_argument("--slowdown", type=number_above("--slowdown", 0.0), default=20.0, metavar="FACTOR", help=text)


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
