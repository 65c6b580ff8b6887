"""The state on the device and the frames of a chunk beside it, copied in, out and back; and those that a run keeps."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import warp as wp

from ..device.arrays import MOVING, STATE_TYPES
from ..device.declarations import SLOPES
from ..device.exclusive import ALONE
from ..device.memory import memory
from ..device.model import Model
from ..errors import InputError
from .checks import FRAME_BYTES
from .pace import Pace
from .state import FIELDS, End, State, Trajectory


@dataclasses.dataclass
class Recording:
    """The frames of a run in the making.

    Args:
        first: steps done at frame 0.
        pace: when its frames are.
        kept: frames that are there, and steps made until then.
        open: whether the state is still what the last of them led to.
    """

    trajectory: Trajectory
    first: int
    pace: Pace
    kept: tuple[int, int] = (1, 0)
    open: bool = True

    @property
    def last(self) -> int:
        """Steps done until where it is kept."""
        return self.first + self.kept[1]


class Frames:
    """The state of a model on its device, and the frames of a chunk.

    Args:
        model: the model; its arrays get room for the frames.
        chunk: steps whose frames the device keeps, beside the one that they start from.

    Attributes:
        recording: the run that is kept; None: there is none.
        options: of the simulator, which trajectories tell.
    """

    def __init__(self, model: Model, chunk: int):
        self.model, self.arrays, self.scene, self.chunk = model, model.arrays, model.scene, chunk
        self.arrays.add_frames(chunk + 1)
        self.recording: Recording | None = None
        self.options: dict[str, Any] | None = None
        self.filled = 0
        """Steps of the chunk on the device that lead to the present state."""
        self.inputs_changed = False
        """Whether the last step was made with other inputs than those that are in place."""

    def moves(self, name: str) -> bool:
        """Tells whether this part of the state changes in the scene."""
        return self.arrays.get(name) is not None and (name != "euler" or self.scene.sliding)

    def rest(self) -> State:
        """Makes the state of a cloth at rest; it shares the cloth's arrays."""
        cloth = self.scene.cloth
        euler, still = cloth.euler, np.zeros((cloth.nodes, 3))
        return State(cloth.position, euler, still, still[:, :2], anchor=euler)

    def state(self) -> State:
        """Copies the present state."""
        nodes = self.scene.cloth.nodes
        values: dict[str, Any] = {}
        for name, width in STATE_TYPES.items():
            if self.arrays[name] is not None:
                values[name] = self.arrays.values_of(name).reshape(nodes, width).astype(np.float64)
        values["position"] += self.arrays.origin
        if "euler_velocity" not in values:
            values["euler_velocity"] = np.zeros((nodes, 2))
        if "anchor" not in values:
            values["anchor"] = values["euler"].copy()
        return State(**values)

    def upload(self, state: State) -> None:
        """Puts a state that was checked on the device."""
        for name in FIELDS:
            array = self.arrays[name]
            if array is not None:
                value = np.asarray(getattr(state, name))
                if name == "position":
                    value = value - self.arrays.origin
                array.assign(value if array.dtype == self.arrays.variant.vec3 else value.ravel())
        # no step has left them
        for name in SLOPES:
            if self.moves(name):
                self.arrays[name].fill_(math.nan)

    def restore(self, frame: int) -> None:
        """Puts the state of a frame of the chunk in place."""
        with ALONE:
            for name in MOVING:
                if self.moves(name):
                    count = self.arrays[name].shape[0]
                    wp.copy(self.arrays[name], self.arrays[f"frame_{name}"], src_offset=frame * count, count=count)

    def copy(self, trajectory: Trajectory, at: int, count: int) -> None:
        """Copies the first frames of the chunk on the device to where they belong."""
        for name in FIELDS:
            if self.moves(name):
                kept, origin = self._of_chunk(name)
                getattr(trajectory, name)[at : at + count] = kept[:count] + origin

    def _of_chunk(self, name: str) -> tuple[np.ndarray, np.ndarray | float]:
        """Gives what the frames of the chunk on the device have of the state [frames, nodes, ...], and the place that
        it is counted from."""
        kept = self.arrays.values_of(f"frame_{name}").reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
        return kept, self.arrays.origin if name == "position" else 0.0

    def room(self, frames: int, start: int) -> Trajectory:
        """Makes a trajectory that holds the present state in its first frame, and in all of what does not change."""
        present = self.state()
        values: dict[str, Any] = {}
        for name in FIELDS:
            first = getattr(present, name)
            values[name] = np.empty((frames, *first.shape))
            values[name][: 1 if self.moves(name) else frames] = first
        values |= {"scene": self.scene, "start": start, "options": self.options}
        return Trajectory(self.scene.cloth, self.model.step_size, **values)

    def last_step(self) -> list[State] | None:
        """Copies the states before and after the last step; None where none led to the present state."""
        if not self.filled or self.inputs_changed:
            return None
        ends = [self.state(), self.state()]
        for name in FIELDS:
            if self.moves(name):
                kept, origin = self._of_chunk(name)
                setattr(ends[0], name, kept[self.filled - 1].astype(np.float64) + origin)
        return ends

    # -- a run that is kept ------------------------------------------------------------------------------------------

    def record(self, pace: Pace, start: int) -> Trajectory:
        """Begins to keep the frames of a run, after ``start`` steps; an InputError where memory has no room."""
        try:
            trajectory = self.room(pace.frames, start)
        except (MemoryError, ValueError) as error:
            size = pace.frames * FRAME_BYTES * self.scene.cloth.nodes / 2**30
            raise InputError(f"steps = {pace.steps}, whose frames take {size:.3g} GiB, more than there is") from error
        trajectory.step, trajectory.every = pace.every * self.model.step_size, pace.every
        self.recording = Recording(trajectory, start, pace)
        return trajectory

    def keep(self, start: int, made: int) -> None:
        """Keeps the frames of a chunk that began after so many steps, if a run asks for them."""
        self.filled, self.inputs_changed = made, False
        recording = self.recording
        if recording is None or not recording.open or start != recording.last:
            return
        filled, at = recording.kept
        if at + made <= recording.pace.steps:
            if recording.pace.every == 1:
                upto = min(at + made + 1, len(recording.trajectory))
                self.copy(recording.trajectory, at, upto - at)
            else:
                upto = recording.pace.count(at + made)
                self._copy_between(recording.trajectory, filled, recording.pace.places(filled, upto) - at)
            recording.kept = (upto, at + made)

    def _copy_between(self, trajectory: Trajectory, at: int, places: np.ndarray) -> None:
        """Copies frames to where they belong that are after so many steps of the chunk, which need not be whole."""
        before = places.astype(int)
        after, share = np.ceil(places).astype(int), (places - before)[:, None, None]
        for name in FIELDS:
            if self.moves(name) and len(places):
                made, origin = self._of_chunk(name)
                # what stands still does so to the last bit
                kept = made[before] + share * (made[after] - made[before])
                getattr(trajectory, name)[at : at + len(places)] = kept + origin

    def close(self) -> None:
        """Says that the state is another now than what the frames led to."""
        self.filled = 0
        if self.recording is not None:
            self.recording.open = False

    def recorded(self, steps_done: int, next_size: float) -> Trajectory | None:
        """Gives the frames that are kept, if the state after so many steps is what they led to."""
        recording = self.recording
        if recording is None or not recording.open or recording.last != steps_done:
            return None
        filled, _ = recording.kept
        frames = recording.trajectory.cut(filled)
        if filled:
            frames.end = End(self.state(), steps_done, next_size, memory(self.model))
        return frames
