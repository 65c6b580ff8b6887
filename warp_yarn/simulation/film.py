"""Runs from frame to frame: one at a time, or into files as they come, and on from such a file."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import tqdm

from ..description.scene import Scene
from ..device.exclusive import ALONE
from ..device.memory import go_on, memory
from ..errors import InputError
from ..io.files import deferred
from ..io.films import RECORDINGS, film, open_films
from .alone import alone
from .pace import Pace, every_of
from .packing import warn_of_functions
from .state import FIELDS, End, State, Trajectory
from .stepper import Stepper
from .substepping import Substepping

SHOWN = (".usd", ".usda", ".usdc", ".usdz", ".mp4", ".png")
"""How the names of files end that are made to be looked at."""
DECIDING = (
    "step", "integrator", "precision", "preconditioner", "tolerance", "newton_tolerance", "max_iterations",
    "step_error", "energy_watch",
)  # fmt: skip
"""Options of a simulator that decide how its steps come out; the others say where and how fast."""


class Filming:
    """Makes films. A base of the simulator, which has these:

    Attributes:
        scene: what is simulated.
        stepper: makes its steps.
        substepping: makes them in parts.
        lock: held while one thread uses it.
        step_size: h [s].
        chunk: steps whose frames the device keeps.
    """

    scene: Scene
    stepper: Stepper
    substepping: Substepping
    lock: threading.RLock
    step_size: float
    chunk: int
    state: Any
    steps_done: Any

    def frames(
        self,
        steps: int | None = None,
        *,
        seconds: float | None = None,
        fps: float | None = None,
        progress: bool | None = False,
    ) -> Iterator[State]:
        """Makes steps, and gives every frame as it comes, the present state first; none is kept.

        Arguments and errors are those of ``run``. The simulator is at the frame that was given, or, where that lies
        between two steps, at the later of them; after the last frame it makes what is left of its steps. Between
        frames it may be looked into, and its state may be set; but not stepped.

        Raises:
            InputError: also where the simulator made other steps between two frames.
            SimulationError: where a step cannot be made; it has the state before it.
        """
        return iter(Walk(self, Pace.of(self.step_size, steps, seconds, every_of(fps, self.step_size)), progress))

    def record(
        self,
        *paths: str | os.PathLike,
        steps: int | None = None,
        seconds: float | None = None,
        fps: float | None = None,
        after: str | os.PathLike | None = None,
        precision: str = "double",
        compression: int = 0,
        progress: bool | None = False,
        **shown: Any,
    ) -> int:
        """Makes steps, and writes every frame to files as it comes, the present state first; memory holds a few.

        A file appears when the run ends, with the frames until then: at its end, and also after Ctrl-C, SIGTERM, a step
        that fails, or where a disk is full. Recordings have what ``resumed`` needs, to the last bit; but a scene with
        functions is left out of them, with a WarpYarnWarning: no file holds them.

        Args:
            paths: of USD files (.usd, .usdc; .usda is kept in memory until its end, and .usdz then needs room for two)
                and recordings (.npz; .h5 and .hdf5 need the extra ``data``).
            steps, seconds, fps, progress: as of ``run``.
            after: a recording that ended where the simulator is. Its frames come first, and the new ones go on in their
                time, at its frames a second. It may be one of ``paths``.
            precision: of the frames in recordings, "double" or "single".
            compression: of recordings, from 0 (none, fast) to 9 (small, slow).
            shown: how USD files show it: slowdown, tubes, sides, velocities, surface and selvedge of ``write_usd``.

        Returns:
            How many frames were written.

        Raises:
            InputError: before the first step, an argument out of its range, a file that cannot be written, an extra
                that is not installed; and as of ``frames``.
            OSError: a file cannot be written, such as to a full disk; it has the frames before, and so do the others.
            SimulationError: where a step cannot be made.
        """
        if not paths:
            raise InputError("record() needs a path at least")
        earlier = None if after is None else _Earlier(after, self)
        every, gone = every_of(fps, self.step_size), 0.0
        head = self.stepper.frames.room(0, self.steps_done)
        if earlier is not None:
            every = earlier.every(fps)
            head.start, gone = earlier.head.start, self.steps_done - earlier.head.start
        head.step, head.every = every * self.step_size, every
        pace = Pace.of(self.step_size, steps, seconds, every, 0 if earlier is None else earlier.count, gone)
        written = {"precision": precision, "compression": compression}
        walk, makers = Walk(self, pace, progress), [film(path, head, written, shown) for path in paths]
        for path in paths:
            if Path(path).suffix in RECORDINGS:
                warn_of_functions(path, head.scene)
        with open_films(makers) as films:
            if earlier is not None:
                # an incomplete copy would take the place of the whole
                films.wanted = False
                films.take(earlier.frames())
                films.wanted = True
            before = films.frames
            try:
                films.take(walk)
            finally:
                with deferred():
                    films.end = walk.end(films.frames - before)
        return films.frames

    @classmethod
    def resumed(cls, recording: str | os.PathLike | Trajectory, **options: Any) -> Self:
        """Makes a simulator that goes on from the end of a recording: its scene, method, step, state and steps done.

        Args:
            recording: a Trajectory, or the path of what it or ``record`` wrote.
            options: of the simulator, in place of the recorded ones, or such as device and threads, which recordings do
                not have.

        Raises:
            InputError: it has no scene, or cannot be read.
        """
        if not isinstance(recording, Trajectory):
            if Path(recording).suffix.lower() in SHOWN:
                raise InputError(
                    f"recording = {str(recording)!r}, must be a Trajectory or end in {', '.join(RECORDINGS)}: what is "
                    "made to be looked at has no state to go on from; name a recording in record(...) beside it"
                )
            recording = Trajectory.load(recording, slice(-1, None))
        if recording.scene is None:
            raise InputError(
                "the recording has no scene to go on with: its scene had functions, or an older warp_yarn wrote it"
            )
        made = {"step": recording.step / recording.every, **(recording.options or {}), **options}
        simulator: Any = cls(recording.scene, **made)  # type: ignore[call-arg]  # of the simulator, not of its base
        end = recording.end
        simulator.state = recording[-1] if end is None else end.state
        simulator.steps_done = recording.steps_done
        if end is not None:
            simulator.substepping.next_size = end.next_size
            with ALONE:
                go_on(simulator.stepper.model, end.watched, end.steps_done)
        return simulator

    @property
    @alone
    def trajectory(self) -> Trajectory | None:
        """The frames of the last run where an exception ended it, the one that it started from first; None where none
        did, or where the state is no longer the last of them."""
        return self.stepper.frames.recorded(self.stepper.steps_done, self.substepping.next_size)

    @alone
    def chunk_trajectory(self, frames: int) -> Trajectory:
        """Copies the first frames of the chunk that the device holds."""
        trajectory = self.stepper.frames.room(frames, self.stepper.steps_done - frames + 1)
        self.stepper.frames.copy(trajectory, 0, frames)
        return trajectory

    def moves(self, name: str) -> bool:
        """Tells whether this part of the state changes in this scene."""
        return self.stepper.frames.moves(name)

    @alone
    def _record(self, pace: Pace) -> None:
        self.stepper.frames.record(pace, self.stepper.steps_done)

    @alone
    def _end(self) -> End:
        """Gives what a run goes on from that ends here."""
        return End(self.state, self.steps_done, self.substepping.next_size, memory(self.stepper.model))


class Walk:
    """Makes the steps of a run from frame to frame.

    Args:
        simulator: who makes them.
        pace: when the frames are.
        progress: as of ``Simulator.run``.
    """

    def __init__(self, simulator: Any, pace: Pace, progress: bool | None):
        self.simulator, self.pace, self.progress = simulator, pace, progress
        self.begin: int = simulator.steps_done
        self.at = 0
        """Steps made."""
        self.before: End = simulator._end()
        """At the last step before the frame in the making, or at the frame."""

    def __iter__(self) -> Iterator[State]:
        self.begin = self.simulator.steps_done
        with bar(self.pace.steps, self.progress) as shown:
            for place in self.pace.places().tolist():
                self._go(int(place), shown)
                self.before = self.simulator._end()
                frame, share = self.before.state, place - int(place)
                if share:
                    self._go(int(place) + 1, shown)
                    frame = between(frame, self.simulator.state, share)
                yield frame
            self._go(self.pace.steps, shown)

    def end(self, frames: int) -> End:
        """Gives what another run goes on from, for whom so many frames are there: no later than the next."""
        next_place = self.pace.places()[frames] if frames < self.pace.frames else np.inf
        now = self.simulator._end()
        return now if now.steps_done - self.begin <= next_place else self.before

    def _go(self, goal: int, shown: tqdm.tqdm | None) -> None:
        simulator = self.simulator
        while self.at < goal:
            with simulator.lock:
                if simulator.steps_done != self.begin + self.at:
                    raise InputError(
                        f"the simulator is after {simulator.steps_done} steps, and its frames after "
                        f"{self.begin + self.at}: it may not be stepped, nor its steps be set, between frames"
                    )
                asked = min(simulator.chunk, goal - self.at)
                made = simulator.run_chunk(asked)
                self.at += made
                if shown is not None:
                    shown.set_description("simulating", refresh=False)
                    shown.update(made)
                if made < asked:
                    simulator.fail(self.at + 1, simulator.stepper.frames.room(1, simulator.steps_done))


class _Earlier:
    """The recording that a run goes on from."""

    def __init__(self, path: str | os.PathLike, simulator: Filming):
        # who records after nothing need not read
        from ..io import recordings

        self.path, self._stream = Path(path), recordings.stream
        self.head, self.count = recordings.head_of(path)
        self.simulator = simulator
        head, scene = self.head, simulator.scene
        step = head.step / head.every
        if head.scene is None:
            raise InputError(f"after = {str(path)!r}: has no scene, such as one with functions, which no file holds")
        if not head.scene.same_as(scene):
            raise InputError(f"after = {str(path)!r}: is of another scene")
        if abs(step - simulator.step_size) > 1e-12 * step:
            raise InputError(f"after = {str(path)!r}: has steps of {step:g} s, must be {simulator.step_size:g}")
        last = Trajectory.load(path, slice(-1, None))
        if last.steps_done != simulator.steps_done:
            raise InputError(
                f"after = {str(path)!r}: ends after {last.steps_done} steps, the simulator is after "
                f"{simulator.steps_done}"
            )

    def every(self, fps: float | None) -> float:
        """Gives its steps from frame to frame, if it has so many frames a second."""
        every = self.head.every
        if fps is not None and abs(every_of(fps, self.simulator.step_size) - every) > 1e-9 * every:
            raise InputError(f"fps = {fps!r}, must be {1.0 / self.head.step:g} as in {str(self.path)!r}, or None")
        return every

    def frames(self) -> Iterator[State]:
        """Reads its frames, a few at a time."""
        return self._stream(self.path)


def between(before: State, after: State, share: float) -> State:
    """Makes the state on the straight line between two; what is the same in both stays so to the last bit."""
    a, b = ([getattr(state, name) for name in FIELDS] for state in (before, after))
    return State(*(x + share * (y - x) for x, y in zip(a, b, strict=True)))


def bar(steps: int, progress: bool | None) -> contextlib.AbstractContextManager[tqdm.tqdm | None]:
    """Makes a progress bar where one is wanted. Elsewhere there is none at all: tqdm's lock does not survive Ctrl-C."""
    if progress is None:
        progress = sys.stderr is not None and sys.stderr.isatty()
    return tqdm.tqdm(total=steps, unit="step", leave=False, desc="starting") if progress else contextlib.nullcontext()
