"""Steps in chunks, whose frames stay on the device for as long; and what is left to do after an exception."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..device.exclusive import ALONE, compiling, refuse_recording, uninterrupted
from ..device.graphs import GraphCache
from ..device.memory import record
from ..device.model import Model
from ..errors import InputError
from ..kernels.core.status import CROWDED, GAINED, IMPACT
from .checks import LARGEST
from .frames import Frames
from .hooks import prepare
from .state import State
from .substepping import Substepping


@dataclasses.dataclass(frozen=True)
class _StepInParts:
    """A step that is being made in parts.

    Args:
        frame: of the chunk, that it starts from.
        counts: of the substepping before it.
        ledger: what the watch over energy had written down by then.
    """

    frame: int
    counts: tuple[float, int, int, int]
    ledger: dict[str, np.ndarray]


class Stepper:
    """Makes steps. An exception may come between any two of its operations: ``settle`` comes before the next call.
    Whoever calls it holds the simulator's lock.

    Args:
        model: with the state that the first step starts from.
        integrator: makes a step at once.
        substepping: makes one in parts.
        frames: of a chunk.

    Attributes:
        steps_done: steps since the beginning.
        split_steps: which of them could not be made at once by the method, and their smallest part [s].
        damped_steps: those of them that the fallback made, or parts of them.
        before_step: a hook, called before each step; None: there is none.
    """

    def __init__(self, model: Model, integrator: Any, substepping: Substepping, frames: Frames):
        self.model, self.arrays = model, model.arrays
        self.integrator, self.substepping, self.frames = integrator, substepping, frames
        self.steps_done = 0
        self.split_steps: dict[int, float] = {}
        self.damped_steps: set[int] = set()
        self.before_step: Callable[[], None] | None = None
        self._graphs = GraphCache(model.device)
        self._chunk: int | None = None
        """Steps done when the chunk began that is being made, and None where none is: frames on the device."""
        self._step_in_parts: _StepInParts | None = None
        self._team = contextlib.ExitStack()
        """Ends the helpers of a chunk."""
        self._owed: Callable[[], None] | None = None
        """Puts the device into the state that it ought to have; None: it has it."""

    # -- after exceptions --------------------------------------------------------------------------------------------

    def begin_from(self, state: State, steps_done: int | None = None) -> None:
        """Takes another state in, or, after an exception, before anything else."""
        self.frames.close()

        def begin() -> None:
            self.frames.upload(state)
            self.model.energy.forget()
            self.substepping.next_size = 1.0
            if steps_done is not None:
                self.steps_done, self.split_steps, self.damped_steps = steps_done, {}, set()
                self.substepping.reset()

        self.owe(begin)
        self.pay()

    def count_from(self, steps_done: int) -> None:
        """Takes the present state for that after so many steps."""
        self.frames.close()
        # pins may be elsewhere then, which is no gain of energy
        self.owe(self.model.energy.forget)
        self.pay()
        self.steps_done = steps_done

    def owe(self, action: Callable[[], None]) -> None:
        """Puts by what ``pay`` does, or, after an exception, whatever comes next."""
        self._owed = action

    def pay(self) -> None:
        """Does what is owed."""
        if self._owed is not None:
            self._owed()
            self._owed = None

    def settle(self) -> None:
        """Finishes or takes back what an exception left half done; after another one meanwhile it begins anew."""
        self._end_team()
        if self._chunk is not None:
            self._close_chunk(self._chunk, self._frames_made())
        self.pay()

    def _frames_made(self) -> int:
        """Counts the steps of the chunk that are whole."""
        if self._step_in_parts is not None:
            return self._step_in_parts.frame
        failed = int(self.arrays["status"].numpy()[2])
        return failed - 1 if failed else int(self.arrays["counters"].numpy()[0])

    def _close_chunk(self, base: int, made: int) -> None:
        """Ends a chunk after so many whole steps, and keeps its frames if a run asks for them."""
        parted = self._step_in_parts
        if parted is not None:
            self.substepping.counts = parted.counts
            self.split_steps.pop(base + parted.frame + 1, None)
            self.damped_steps.discard(base + parted.frame + 1)
            with ALONE:
                self.arrays.put("damps", 0)
                self.model.energy.recall(parted.ledger)
        self.integrator.set_times(self.model.step_size, self.model.step_size)
        self.frames.restore(made)
        self.frames.keep(base, made)
        self.steps_done = base + made
        self._chunk = self._step_in_parts = None

    # -- steps -------------------------------------------------------------------------------------------------------

    def make_chunk(self, steps: int) -> int:
        """Makes at most ``frames.chunk`` steps, into the frames on the device; the state is frame 0.

        Returns:
            How many steps were made; fewer than asked for where one failed (``arrays["status"]`` says how).
        """
        try:
            prepare(self)
            with ALONE, compiling():
                refuse_recording(self.model.device)
                self.settle()
                if self.model.threads.count > 1:
                    uninterrupted(lambda: self._team.enter_context(self.model.threads.at_hand()))
            return self._make_steps(steps)
        finally:
            self._end_team()

    def _make_steps(self, steps: int) -> int:
        base = self.steps_done
        if base + steps > LARGEST:
            raise InputError(f"steps = {steps} after {base}, must end at step {LARGEST} at most")
        self.arrays.put("status", 0, 0, 0)
        self._count(0)
        self._graphs.run("record", lambda: record(self.model))
        self._chunk = base
        made = 0
        while made < steps:
            if self.substepping.allowed is None:
                made += self._advance(steps - made)
            if made < steps and not self._make_in_parts(made):
                self._close_chunk(base, made)
                return made
            made = min(made + 1, steps)
        self.frames.keep(base, made)
        self.steps_done = base + made
        self._chunk = None
        return made

    def _end_team(self) -> None:
        if self.model.threads.count > 1:
            uninterrupted(self._team.close)

    def _count(self, frame: int) -> None:
        """Tells the device which frame of the chunk the present state is."""
        self.arrays.put("counters", frame, self.steps_done + frame)

    def _advance(self, steps: int) -> int:
        """Makes steps until one fails, and counts those that were made."""
        status = self.arrays.values_of("status") if self.model.device.is_cpu else np.zeros(1)
        first = int(self.arrays.values_of("counters")[0])
        for _ in range(steps):
            self.integrator.advance()
            if status[0]:  # on the CPU the array itself; elsewhere looking would wait for every step
                break
        status = self.arrays.values_of("status")
        return int(status[2]) - 1 - first if status[0] else steps

    def _status(self) -> int:
        """Reads what went wrong, or 0."""
        return int(self.arrays.values_of("status")[0])

    def make_room(self) -> None:
        """Makes room for more nodes near each, and captures anew: what was captured has the arrays of before."""
        with ALONE:
            self.model.contact.make_room()
        self.integrator.forget_graphs()
        self.substepping.forget_graphs()
        self.arrays.put("status", 0, 0, 0)

    def _make_in_parts(self, frame: int) -> bool:
        """Makes the step after a frame of the chunk in parts; where that fails too, ``status`` says what it was."""
        parts = self.substepping
        self._step_in_parts = _StepInParts(frame, parts.counts, self.model.energy.memory())
        gained, damped, whole = False, parts.damped, parts.allowed is None
        while whole and self._status() == CROWDED:
            self.make_room()
            self.frames.restore(frame)
            self._count(frame)
            self.integrator.advance()
            if not self._status():
                self._step_in_parts = None
                return True
        if whole:
            gained = parts.can_damp and self._status() in (GAINED, IMPACT)
            self.frames.restore(frame)
            self.arrays.put("status", 0, 0, 0)
            parts.next_size = 1.0 if gained else 0.5
        smallest = parts.make(lambda: self._count(frame), self.make_room, gained=gained)
        self.integrator.set_times(self.model.step_size, self.model.step_size)
        if not smallest:
            return False
        self._count(frame + 1)
        if whole:
            self.split_steps[self.steps_done + frame + 1] = smallest * self.model.step_size
        if parts.damped > damped:
            self.damped_steps.add(self.steps_done + frame + 1)
        self._step_in_parts = None
        return True
