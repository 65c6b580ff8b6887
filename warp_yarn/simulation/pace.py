"""When the frames of a run are: after every step, or so many a second, whatever the step."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..errors import InputError, integer, real
from .checks import LARGEST

ROUNDING = 1e-6
"""Of a step: nearer than that to its end a frame is the step's own state."""


@dataclasses.dataclass(frozen=True)
class Pace:
    """When the frames of a run are, in steps since it began.

    A frame that falls between two steps is between their two states, on a straight line in time: no step is made
    shorter or longer for it.

    Args:
        steps: that the run makes; it ends with the first step at or after its last frame.
        every: steps from frame to frame, at least 1; an int where it is whole.
        frames: how many there are.
        before: frames of a run that this one goes on from, 0: there is none, and the first is the state it begins with.
        gone: steps since the first of those.
    """

    steps: int
    every: float = 1
    frames: int = 0
    before: int = 0
    gone: float = 0

    @classmethod
    def of(
        cls, step: float, steps: int | None, seconds: float | None, every: float, before: int = 0, gone: float = 0
    ) -> Pace:
        """Chooses by what a run is asked for, of steps of so many seconds.

        Raises:
            InputError: neither steps nor seconds, or both, or out of range.
        """
        if (steps is None) == (seconds is None):
            raise InputError(f"steps = {steps!r} and seconds = {seconds!r}, must be one of them")
        if seconds is None:
            length: float = integer("steps", steps, least=0)
        else:
            length = real("seconds", seconds, least=0.0) / step
            if length > LARGEST:
                raise InputError(f"seconds = {seconds!r}, must be at most {LARGEST} steps of {step:g} s")
        pace = cls(math.ceil(length - ROUNDING), every, 0, before, gone)
        frames = pace._count(length)
        pace = dataclasses.replace(pace, frames=frames)
        last = math.ceil(pace.places(frames - 1)[0]) if frames else 0
        return dataclasses.replace(pace, steps=max(last, pace.steps))

    def places(self, begin: int = 0, end: int | None = None) -> np.ndarray:
        """Lists when the frames from one to before another are [frames], in steps, whole where they are nearly so."""
        frames = np.arange(begin, self.frames if end is None else end)
        # in this order a run in two parts is that in one, to the last bit
        found = self.every * (self.before + frames) - self.gone
        near = np.round(found)
        return np.where(np.abs(found - near) < ROUNDING, near, found)

    def count(self, steps: float) -> int:
        """Counts the frames in the first so many steps, their end too."""
        return min(self.frames, self._count(steps))

    def _count(self, steps: float) -> int:
        return max(0, math.floor((steps + self.gone) / self.every + ROUNDING) + 1 - self.before)


def every_of(fps: float | None, step: float) -> float:
    """Gives the steps from frame to frame, of so many frames a second; None: 1.

    Raises:
        InputError: more frames than steps.
    """
    if fps is None:
        return 1
    every = 1.0 / (real("fps", fps, above=0.0) * step)
    if every < 1.0 - ROUNDING:
        raise InputError(f"fps = {fps!r}, must be at most {1.0 / step:g}, a frame a step of {step:g} s")
    near = round(every)
    return near if abs(every - near) < 1e-9 * near else every
