"""The state of a cloth, and a sequence of states."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from typing import Any, overload

import numpy as np

from ..description.cloth import CLOTH_NUMBERS, Cloth, Yarn
from ..description.cloths import Cloths
from ..description.obstacles import Box, Capsule, Contact, Cylinder, Obstacle, Plane, Sphere, TriangleMesh
from ..description.scene import Scene, Wind
from ..description.weave import Weave
from ..errors import InputError, brief, choice, finite_array, integer, real

FORMAT = 4
"""Of recordings: 1 had no number, no scene and no count of steps; 2 had no obstacles, no contact and one cloth; 3 had
every step, and did not say which method made them."""

SHAPES = {cls.shape: cls for cls in (Box, Capsule, Cylinder, Plane, Sphere, TriangleMesh)}


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


@dataclasses.dataclass(frozen=True, eq=False)
class End:
    """What a run goes on from.

    Args:
        state: after a whole step, in double precision.
        steps_done: steps until then.
        next_size: of the next part of a step, in steps, where steps follow their error.
    """

    state: State
    steps_done: int
    next_size: float = 1.0


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

        Args:
            path: of the file, ending in .h5 or .hdf5 (needs the extra ``data``), or an .npz of any name.
            precision: of the frames, "double" or "single"; what a run goes on from is always double.
            compression: from 0 (none, fast) to 9 (small, slow).

        Raises:
            InputError: an argument is out of its range, or the folder does not exist.
            OSError: the file cannot be written, such as to a full disk.
        """
        from ..io.recordings import save

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
        """Packs all but the frames into arrays."""
        end = self.end
        packed: dict[str, Any] = {"format": FORMAT, "start": self.start, "step": self.step, "every": self.every}
        if end is not None:
            state = end.state.checked(self.cloth.nodes)
            packed |= {"end_steps": end.steps_done, "end_next_size": end.next_size}
            packed |= {f"end_{name}": getattr(state, name) for name in FIELDS}
        if self.options is not None:
            packed["options"] = json.dumps(self.options, default=float)
        return {**packed, **_packed_cloths(self.cloth), **({} if self.scene is None else _packed(self.scene))}

    @classmethod
    def of_head(cls, data: Mapping[str, Any]) -> Trajectory:
        """Makes a trajectory without frames of what ``head`` packed; an InputError says what is wrong."""
        written = integer("format", data["format"].item(), least=1) if "format" in data else 1
        if written > FORMAT:
            raise InputError(f"format = {written}, this warp_yarn reads up to {FORMAT}: it needs a newer one")
        cloth, end = _unpacked_cloths(data), None
        if "end_steps" in data:
            state = State(**{name: data[f"end_{name}"] for name in FIELDS}).checked(cloth.nodes)
            steps = integer("end_steps", data["end_steps"].item(), least=0)
            end = End(state, steps, real("end_next_size", data["end_next_size"].item(), above=0.0))
        start = real("start", data["start"].item(), least=0.0) if "start" in data else 0
        every = real("every", data["every"].item(), above=0.0) if "every" in data else 1
        empty: dict[str, Any] = {name: np.empty((0, cloth.nodes, width)) for name, width in WIDTHS.items()}
        return cls(
            cloth,
            real("step", data["step"].item(), above=0.0),
            **empty,
            scene=_unpacked(cloth, data) if "scene_terms" in data else None,
            start=int(start) if start == int(start) else start,
            every=int(every) if every == int(every) else every,
            options=json.loads(data["options"].item()) if "options" in data else None,
            end=end,
        )


def _packed_cloths(cloth: Cloth | Cloths) -> dict[str, Any]:
    """Packs a cloth into arrays; of several each with its number before their names."""
    if isinstance(cloth, Cloths):
        parts = [_packed_cloths(each) for each in cloth.cloths]
        return {"cloths": len(parts)} | {
            f"cloth_{k}_{name}": parts[k][name] for k in range(len(parts)) for name in parts[k]
        }
    given = {name: getattr(cloth, name) for name in CLOTH_NUMBERS}
    if cloth._arguments["friction_damping"] is None:
        given["friction_damping"] = np.nan  # of its own mass, also where others are beside it
    return {
        "draft": cloth.weave.flipped,
        "weave": cloth.weave.name,
        "yarns": np.array([(yarn.density, yarn.stretch, yarn.bend) for yarn in cloth.yarns]),
        "colors": np.array([yarn.color or (np.nan,) * 3 for yarn in cloth.yarns]),
        "warp": cloth.warp,
        "weft": cloth.weft,
        "rest": cloth.position,
        **given,
    }


def _unpacked_cloths(data: Any) -> Cloth | Cloths:
    """Makes what ``_packed_cloths`` made arrays of."""
    if "cloths" in data:
        count = integer("cloths", data["cloths"].item(), least=1)
        return Cloths([_unpacked_cloth(data, f"cloth_{k}_") for k in range(count)])
    return _unpacked_cloth(data, "")


def _unpacked_cloth(data: Any, of: str) -> Cloth:
    yarns = [
        Yarn(density=d, stretch=s, bend=b, color=None if np.isnan(color).any() else tuple(color.tolist()))
        for (d, s, b), color in zip(data[f"{of}yarns"].tolist(), data[f"{of}colors"], strict=True)
    ]
    numbers = {name: data[f"{of}{name}"].item() for name in CLOTH_NUMBERS}
    if np.isnan(numbers["friction_damping"]):
        numbers["friction_damping"] = None
    return Cloth(
        Weave(data[f"{of}draft"], str(data[f"{of}weave"])),
        yarns=yarns,
        warp=data[f"{of}warp"].tolist(),
        weft=data[f"{of}weft"].tolist(),
        pose=data[f"{of}rest"],
        **numbers,
    )


def _packed(scene: Scene) -> dict[str, Any]:
    """Packs a scene into arrays; what is None is left out."""
    wind = scene.wind
    values = {
        "terms": np.array(scene.terms),
        "sliding": scene.sliding,
        "published_scaling": scene.published_scaling,
        "gravity": scene.gravity,
        "pins": scene.pins,
        "pin_stiffness": scene.pin_stiffness,
        "pin_path": scene.pin_path,
        "wind": None if wind is None else [*wind.velocity, wind.density, wind.drag],
        "force_nodes": scene.force_nodes,
        **{f"force_{node}": force for node, force in scene.forces.items()},
        "parameters": list(scene.parameters) or None,
        **{f"parameter_{name}": values for name, values in scene.parameters.items()},
        "self_contact": scene.self_contact,
        # None is a value of its own there, not always the default
        **{f"contact_{name}": np.nan if value is None else value for name, value in scene.contact._arguments.items()},
        "obstacles": np.array([obstacle.shape for obstacle in scene.obstacles], dtype=str),
    }
    for k, obstacle in enumerate(scene.obstacles):
        values.update({f"obstacle_{k}_{name}": value for name, value in obstacle._arguments.items()})
    return {f"scene_{name}": value for name, value in values.items() if value is not None}


def _unpacked(cloth: Cloth | Cloths, data: Any) -> Scene:
    """Makes the scene that ``_packed`` made arrays of."""

    def value(name: str) -> Any:
        return data.get(f"scene_{name}")

    wind, stiffness, named = value("wind"), value("pin_stiffness"), value("parameters")
    return Scene(
        cloth,
        gravity=value("gravity"),
        wind=None if wind is None else Wind(velocity=wind[:3], density=wind[3], drag=wind[4]),
        pins=value("pins"),
        pin_stiffness=None if stiffness is None else stiffness.item(),
        pin_path=value("pin_path"),
        forces={node: value(f"force_{node}") for node in value("force_nodes").tolist()},
        sliding=value("sliding").item(),
        terms=value("terms").tolist(),
        published_scaling=value("published_scaling").item(),
        parameters={} if named is None else {name: value(f"parameter_{name}").tolist() for name in named.tolist()},
        obstacles=_unpacked_obstacles(data),
        self_contact="scene_self_contact" in data and value("self_contact").item(),
        contact=Contact(**_arguments(data, "contact")),
    )


def _unpacked_obstacles(data: Any) -> list[Obstacle]:
    """Makes the obstacles, of which recordings of before have none."""
    shapes = data["scene_obstacles"].tolist() if "scene_obstacles" in data else []
    return [
        SHAPES[choice("obstacles", shape, SHAPES)](**_arguments(data, f"obstacle_{k}"))
        for k, shape in enumerate(shapes)
    ]


def _arguments(data: Any, group: str) -> dict[str, Any]:
    """Gives what something was made of: arrays, and numbers and names as such; NaN is None."""
    start = f"scene_{group}_"
    found = {name.removeprefix(start): data[name] for name in data if name.startswith(start)}
    values = {name: array if array.ndim else array.item() for name, array in found.items()}
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values.items()}
