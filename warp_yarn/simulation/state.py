"""The state of a cloth, and a sequence of states."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any, overload

import numpy as np

from ..description.cloth import Cloth
from ..description.cloths import Cloths
from ..description.scene import Scene
from ..errors import InputError, brief, finite_array, integer, real
from .packing import packed, packed_cloths, unpacked, unpacked_cloths, warn_of_functions

FORMAT = 6
"""Of recordings: 1 had no number, no scene and no count of steps; 2 had no obstacles, no contact and one cloth; 3 had
single numbers of cloths, no crimp and no sizes of yarns; 4 had every step, and did not say which method made them;
5 had no wind that changes from step to step, no outlines and no seams, or else every step."""


@dataclasses.dataclass(eq=False)
class State:
    """Where every node is, and how it moves. NumPy, float64.

    Args:
        position: x [nodes, 3] (m).
        euler: (u, v) [nodes, 2] (m).
        velocity: ẋ [nodes, 3] (m/s).
        euler_velocity: (u̇, v̇) [nodes, 2] (m/s).
        anchor: (ū, v̄), where friction's springs are anchored [nodes, 2] (m); None: at (u, v), no spring is strained.
    """

    position: np.ndarray
    euler: np.ndarray
    velocity: np.ndarray
    euler_velocity: np.ndarray
    anchor: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"State({len(self.position)} nodes)"

    def __eq__(self, other: object) -> bool:
        """Tells whether two are the same, to the last bit."""
        if not isinstance(other, State):
            return NotImplemented
        pairs = [(getattr(self, name), getattr(other, name)) for name in FIELDS[:-1]]
        anchors = (state.euler if state.anchor is None else state.anchor for state in (self, other))
        return all(np.array_equal(a, b) for a, b in [*pairs, tuple(anchors)])

    def checked(self, nodes: int) -> State:
        """Copies it, with every array finite and of the right shape; an InputError says what is not. Δs > 0 is left to
        the simulator."""
        euler = finite_array("state.euler", self.euler, (nodes, 2))
        return State(
            finite_array("state.position", self.position, (nodes, 3)),
            euler,
            finite_array("state.velocity", self.velocity, (nodes, 3)),
            finite_array("state.euler_velocity", self.euler_velocity, (nodes, 2)),
            euler.copy() if self.anchor is None else finite_array("state.anchor", self.anchor, (nodes, 2)),
        )


FIELDS = tuple(field.name for field in dataclasses.fields(State))
WIDTHS = {"position": 3, "euler": 2, "velocity": 3, "euler_velocity": 2, "anchor": 2}
"""Numbers of a node."""
WATCHED = "end_watched_"
"""Before the names of what the watch over energy has written down, in recordings."""


@dataclasses.dataclass(frozen=True, eq=False)
class End:
    """What a run goes on from.

    Args:
        state: after a whole step, in double precision.
        steps_done: steps until then.
        next_size: of the next part of a step, in steps, where steps follow their error.
        watched: what the watch over energy has written down, by name.
    """

    state: State
    steps_done: int
    next_size: float = 1.0
    watched: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(eq=False)
class Trajectory:
    """Frames of a simulation, the initial state first: arrays as in State, with a leading axis of frames.

    ``trajectory[3]`` is a State, ``trajectory[::10]`` a Trajectory, which shares its arrays.
    ``Simulator.resumed(trajectory)`` goes on from its end.
    """

    cloth: Cloth | Cloths
    step: float
    """Time from frame to frame [s]."""
    position: np.ndarray
    euler: np.ndarray
    velocity: np.ndarray
    euler_velocity: np.ndarray
    anchor: np.ndarray
    scene: Scene | None = None
    """What was simulated; None: not known."""
    start: float = 0
    """Steps made before the first frame: a whole number, but where that is a frame between two steps."""
    every: float = 1
    """Steps from frame to frame. Where that is no whole number, frames between two steps are on a straight line."""
    options: dict[str, Any] | None = None
    """What the simulator was made with that decides how its steps come out, by name; None: not known."""
    end: End | None = None
    """What a run goes on from that left these frames; None: the last of them, where it is the state after a step."""

    @property
    def steps_done(self) -> int:
        """Steps made until the end; an InputError where the last frame lies between two, and no end is known."""
        if self.end is not None:
            return self.end.steps_done
        last = self.start + self.every * (len(self) - 1)
        if abs(last - round(last)) > 1e-6:
            raise InputError(f"the last frame is after {last:g} steps, which no run goes on from")
        return round(last)

    def __repr__(self) -> str:
        frames = f"{len(self)} frame{'' if len(self) == 1 else 's'}"
        return f"Trajectory({frames} of {self.cloth.nodes} nodes, {self.step:g} s apart, {self.cloth})"

    def __eq__(self, other: object) -> bool:
        """Tells whether two have the same frames of the same cloth, to the last bit."""
        if not isinstance(other, Trajectory):
            return NotImplemented
        times = [(trajectory.step, trajectory.start, trajectory.every) for trajectory in (self, other)]
        if not self.cloth.same_as(other.cloth) or times[0] != times[1]:
            return False
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in FIELDS)

    def __len__(self) -> int:
        return len(self.position)

    @overload
    def __getitem__(self, frame: int) -> State: ...

    @overload
    def __getitem__(self, frame: slice) -> Trajectory: ...

    def __getitem__(self, frame: int | slice) -> State | Trajectory:
        """Copies one frame, as a State; negative frames count from the end. Takes some of them, as a Trajectory."""
        if not isinstance(frame, slice):
            return State(*(getattr(self, name)[frame].copy() for name in FIELDS))
        begin, _, stride = frame.indices(len(self))
        if stride < 1:
            raise InputError(f"trajectory[::{stride}], must take frames in their order")
        parts: dict[str, Any] = {name: getattr(self, name)[frame] for name in FIELDS}
        taken = range(len(self))[frame]
        return dataclasses.replace(
            self,
            **parts,
            step=self.step * stride,
            start=self.start + self.every * begin,
            every=self.every * stride,
            end=self.end if taken and taken[-1] == len(self) - 1 else None,
        )

    @property
    def time(self) -> np.ndarray:
        """Time of every frame [s]."""
        return np.arange(len(self)) * self.step

    def cut(self, frames: int) -> Trajectory:
        """Takes the first frames of it."""
        return self[:frames]

    def joined(self, later: Trajectory) -> Trajectory:
        """Joins this and a run that went on from its last frame.

        Raises:
            InputError: it did not: its cloth, scene, step, steps before it or first frame (beyond what single precision
                keeps) are others.
        """
        if not isinstance(later, Trajectory):
            raise InputError(f"later = {brief(later)}, must be a Trajectory")
        if not len(self) or not len(later):
            raise InputError(f"trajectories of {len(self)} and {len(later)} frames, must have at least one each")
        if later.step != self.step:
            raise InputError(f"later.step = {later.step:g}, must be that of the frames before, {self.step:g}")
        if not later.cloth.same_as(self.cloth):
            raise InputError("later.cloth is another one than that of the frames before")
        if self.scene is not None and later.scene is not None and not later.scene.same_as(self.scene):
            raise InputError("later.scene is another one than that of the frames before")
        if later.every != self.every:
            raise InputError(f"later.every = {later.every:g}, must be that of the frames before, {self.every:g}")
        last = self.start + self.every * (len(self) - 1)
        if abs(later.start - last) > 1e-6:
            raise InputError(f"later.start = {later.start:g}, must be the steps until here, {last:g}")
        for name in FIELDS:
            end, begin = getattr(self, name)[-1], getattr(later, name)[0]
            off = np.abs(begin - end).max()
            if off > 1e-6 * np.ptp(end, axis=0).max():
                raise InputError(f"later.{name}[0] is off by {off:g}, must be the last frame here")
        parts: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(later, name)[1:]]) for name in FIELDS
        }
        return dataclasses.replace(self, **parts, end=later.end)

    def save(self, path: str | os.PathLike, *, precision: str = "double", compression: int = 6) -> None:
        """Writes the cloth, its scene, every frame, and what a run goes on from; the file appears whole or not at all.
        A scene with functions is left out, with a WarpYarnWarning: no file holds them.

        Args:
            path: of the file, ending in .h5 or .hdf5 (needs the extra ``data``), or an .npz of any name.
            precision: of the frames, "double" or "single"; what a run goes on from is always double.
            compression: from 0 (none, fast) to 9 (small, slow).

        Raises:
            InputError: an argument is out of its range, or the folder does not exist.
            OSError: the file cannot be written, such as to a full disk.
        """
        from ..io.recordings import save

        warn_of_functions(path, self.scene)
        save(path, self, precision, compression)

    @classmethod
    def load(cls, path: str | os.PathLike, frames: slice | None = None) -> Trajectory:
        """Reads what ``save`` or ``Simulator.record`` wrote; an InputError says what is wrong with the file.

        Args:
            frames: which of them, such as ``slice(0, None, 10)``: the others take no memory. None: all.
        """
        from ..io.recordings import load

        return load(path, frames)

    def head(self) -> dict[str, Any]:
        """Packs all but the frames into arrays; a scene with functions is left out."""
        end, scene = self.end, self.scene
        values: dict[str, Any] = {"format": FORMAT, "start": self.start, "step": self.step, "every": self.every}
        if end is not None:
            state = end.state.checked(self.cloth.nodes)
            values |= {"end_steps": end.steps_done, "end_next_size": end.next_size}
            values |= {f"end_{name}": getattr(state, name) for name in FIELDS}
            values |= {f"{WATCHED}{name}": value for name, value in end.watched.items()}
        if self.options is not None:
            values["options"] = json.dumps(self.options, default=float)
        known = {} if scene is None or scene.functions else packed(scene)
        return {**values, **packed_cloths(self.cloth), **known}

    @classmethod
    def of_head(cls, data: Mapping[str, Any]) -> Trajectory:
        """Makes a trajectory without frames of what ``head`` packed; an InputError says what is wrong."""
        written = integer("format", data["format"].item(), least=1) if "format" in data else 1
        if written > FORMAT:
            raise InputError(f"format = {written}, this warp_yarn reads up to {FORMAT}: it needs a newer one")
        cloth, end = unpacked_cloths(data), None
        if "end_steps" in data:
            state = State(**{name: data[f"end_{name}"] for name in FIELDS}).checked(cloth.nodes)
            steps = integer("end_steps", data["end_steps"].item(), least=0)
            watched = {name.removeprefix(WATCHED): data[name] for name in data if name.startswith(WATCHED)}
            end = End(state, steps, real("end_next_size", data["end_next_size"].item(), above=0.0), watched)
        start = real("start", data["start"].item(), least=0.0) if "start" in data else 0
        every = real("every", data["every"].item(), above=0.0) if "every" in data else 1
        empty: dict[str, Any] = {name: np.empty((0, cloth.nodes, width)) for name, width in WIDTHS.items()}
        return cls(
            cloth,
            real("step", data["step"].item(), above=0.0),
            **empty,
            scene=unpacked(cloth, data) if "scene_terms" in data else None,
            start=int(start) if start == int(start) else start,
            every=int(every) if every == int(every) else every,
            options=json.loads(data["options"].item()) if "options" in data else None,
            end=end,
        )
