"""The state on the device and the frames of a chunk beside it, copied in, out and back; and those that a run keeps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..device.arrays import STATE_TYPES
from ..device.exclusive import ALONE
from ..device.model import Model
from ..errors import InputError
from .checks import FRAME_BYTES
from .state import FIELDS, State, Trajectory


@dataclasses.dataclass
class Recording:
    """The frames of a run in the making.

    Args:
        first: steps done at frame 0.
        filled: frames that are there.
        open: whether the state is still what the last of them led to.
    """

    trajectory: Trajectory
    first: int
    filled: int = 1
    open: bool = True

    @property
    def last(self) -> int:
        """Steps done at its last frame."""
        return self.first + self.filled - 1


class Frames:
    """The state of a model on its device, and the frames of a chunk.

    Args:
        model: the model; its arrays get room for the frames.
        chunk: steps whose frames the device keeps, beside the one that they start from.

    Attributes:
        recording: the run that is kept; None: there is none.
    """

    def __init__(self, model: Model, chunk: int):
        self.model, self.arrays, self.scene, self.chunk = model, model.arrays, model.scene, chunk
        self.arrays.add_frames(chunk + 1)
        self.recording: Recording | None = None
        self.filled = 0
        """Steps of the chunk on the device that lead to the present state."""
        self.inputs_changed = False
        """Whether the last step was made with other inputs than those that are in place."""

    def moves(self, name: str) -> bool:
        """Tells whether this part of the state changes in the scene."""
        return self.arrays[name] is not None and (name != "euler" or self.scene.sliding)

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
            array = self.arrays[name]
            values[name] = None if array is None else array.numpy().reshape(nodes, width).astype(np.float64)
        values["position"] += self.arrays.origin
        if values["euler_velocity"] is None:
            values["euler_velocity"] = np.zeros((nodes, 2))
        if values["anchor"] is None:
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

    def restore(self, frame: int) -> None:
        """Puts the state of a frame of the chunk in place."""
        with ALONE:
            for name in FIELDS:
                if self.moves(name):
                    count = self.arrays[name].shape[0]
                    wp.copy(self.arrays[name], self.arrays[f"frame_{name}"], src_offset=frame * count, count=count)

    def copy(self, trajectory: Trajectory, at: int, count: int) -> None:
        """Copies the first frames of the chunk on the device to where they belong."""
        for name in FIELDS:
            if self.moves(name):
                kept = self.arrays[f"frame_{name}"].numpy().reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
                origin = self.arrays.origin if name == "position" else 0.0
                getattr(trajectory, name)[at : at + count] = kept[:count] + origin

    def room(self, frames: int, start: int) -> Trajectory:
        """Makes a trajectory that holds the present state in its first frame, and in all of what does not change."""
        present, values = self.state(), {}
        for name in FIELDS:
            first = getattr(present, name)
            values[name] = np.empty((frames, *first.shape))
            values[name][: 1 if self.moves(name) else frames] = first
        return Trajectory(self.scene.cloth, self.model.step_size, **values, scene=self.scene, start=start)

    def last_step(self) -> list[State] | None:
        """Copies the states before and after the last step; None where none led to the present state."""
        if not self.filled or self.inputs_changed:
            return None
        ends = [self.state(), self.state()]
        for name in FIELDS:
            if self.moves(name):
                kept = self.arrays[f"frame_{name}"].numpy().reshape(self.chunk + 1, self.scene.cloth.nodes, -1)
                origin = self.arrays.origin if name == "position" else 0.0
                setattr(ends[0], name, kept[self.filled - 1].astype(np.float64) + origin)
        return ends

    # -- a run that is kept ------------------------------------------------------------------------------------------

    def record(self, steps: int, start: int) -> Trajectory:
        """Begins to keep a run of so many steps, after ``start`` others; an InputError where memory has no room."""
        try:
            trajectory = self.room(steps + 1, start)
        except (MemoryError, ValueError) as error:
            size = (steps + 1) * FRAME_BYTES * self.scene.cloth.nodes / 2**30
            raise InputError(f"steps = {steps}, whose frames take {size:.3g} GiB, more than there is") from error
        self.recording = Recording(trajectory, start)
        return trajectory

    def keep(self, start: int, made: int) -> None:
        """Keeps the frames of a chunk that began after so many steps, if a run asks for them."""
        self.filled, self.inputs_changed = made, False
        recording = self.recording
        if recording is not None and recording.open and start == recording.last:
            at = start - recording.first
            if at + made < len(recording.trajectory):
                self.copy(recording.trajectory, at, made + 1)
                recording.filled = at + made + 1

    def close(self) -> None:
        """Says that the state is another now than what the frames led to."""
        self.filled = 0
        if self.recording is not None:
            self.recording.open = False

    def recorded(self, steps_done: int) -> Trajectory | None:
        """Gives the frames that are kept, if the state after so many steps is the last of them."""
        recording = self.recording
        if recording is None or not recording.open or recording.last != steps_done:
            return None
        return recording.trajectory.cut(recording.filled)
