"""What the scenes share: a run that loses no finished frame, output files, and how a command ends."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tqdm
import warp as wp

import warp_yarn as wy
from warp_yarn.errors import number, whole
from warp_yarn.state import FIELDS


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, or as much of one as was made.

    Args:
        trajectory: every frame that was finished, the first one the state it started from.
        seconds: wall time of each step.
        stop: what ended it early, to be raised once the frames are written; None: it was not.
    """

    trajectory: wy.Trajectory
    seconds: list[float]
    stop: BaseException | None

    def end(self) -> None:
        """Raises what ended the run early."""
        if self.stop is not None:
            raise self.stop


def simulate(
    simulator: wy.Simulator, steps: int, *, watch: Callable[[int, wy.State], None] = lambda step, state: None
) -> Run:
    """Makes steps under a progress bar, one by one: Ctrl-C or a step that fails leaves every frame before it.

    Args:
        watch: called after each step with its number, from 1, and the state.
    """
    steps = whole("steps", steps, least=1)
    states, seconds, stop = [simulator.state], [], None

    def made() -> wy.Trajectory:
        frames = (np.stack([getattr(state, name) for state in states]) for name in FIELDS)
        return wy.Trajectory(simulator.scene.cloth, simulator.step_size, *frames)

    try:
        # The first step compiles the kernels where they changed, which takes many seconds, and says so meanwhile.
        with tqdm.trange(1, steps + 1, unit="step", desc="compiling", disable=None) as bar:
            for k in bar:
                start = time.perf_counter()
                if simulator.run_chunk(1) == 0:
                    simulator.fail(k, made())
                seconds.append(time.perf_counter() - start)
                states.append(simulator.state)
                watch(k, states[-1])
                bar.set_description("simulating", refresh=False)
    except (wy.SimulationError, KeyboardInterrupt) as error:
        stop = error
    return Run(made(), seconds, stop)


def file_ending(*endings: str) -> Callable[[str], Path]:
    """An argparse type: a path with one of these endings. Found out before a long run and not after it."""

    def path(text: str) -> Path:
        if not text.endswith(endings):
            raise argparse.ArgumentTypeError(f"{text!r} must end in {', '.join(endings)}")
        return Path(text)

    return path


def add_slowdown(parser: argparse.ArgumentParser) -> None:
    """The option --slowdown of what is written to be played."""

    def positive(text: str) -> float:
        return number("--slowdown", text, above=0.0)

    text = "seconds of playing time for one of simulated time, in files (%(default)g)"
    parser.add_argument("--slowdown", type=positive, default=20.0, metavar="FACTOR", help=text)


def make_folders(paths: Sequence[Path | None]) -> None:
    """The folders of output files, those that are given."""
    for path in paths:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)


def command(main: Callable[[Sequence[str] | None], Any], arguments: Sequence[str] | None = None) -> int:
    """Runs a scene's main and says on stderr what went wrong.

    Returns:
        Exit code: 0; 1 a simulation failed, or its gradient; 2 wrong arguments or files; 130 Ctrl-C.
    """
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
