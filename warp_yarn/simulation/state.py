"""The state of a cloth, and a sequence of states."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from ..description.cloth import CLOTH_NUMBERS, Cloth
from ..description.cloths import Cloths
from ..description.obstacles import Box, Capsule, Contact, Cylinder, Obstacle, Plane, Sphere, TriangleMesh
from ..description.scene import Scene, Wind
from ..description.weave import Weave
from ..description.yarn import SIZES, Yarn
from ..errors import InputError, choice, finite_array, integer, real
from ..io.files import atomic_write

FORMAT = 4
"""Of recordings: 1 had no number, no scene and no count of steps; 2 had no obstacles, no contact and one cloth; 3 had
single numbers of cloths, no crimp and no sizes of yarns."""

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


@dataclasses.dataclass(eq=False)
class Trajectory:
    """Every frame of a simulation, the initial state first: arrays as in State, with a leading axis of frames.

    A simulator goes on from one by ``simulator.state = trajectory[-1]`` and
    ``simulator.steps_done = trajectory.steps_done``.
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
    start: int = 0
    """Steps made before the first frame."""

    @property
    def steps_done(self) -> int:
        """Steps made until the last frame."""
        return self.start + len(self) - 1

    def __eq__(self, other: object) -> bool:
        """Tells whether two have the same frames of the same cloth, to the last bit."""
        if not isinstance(other, Trajectory):
            return NotImplemented
        if not self.cloth.same_as(other.cloth) or (self.step, self.start) != (other.step, other.start):
            return False
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in FIELDS)

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, frame: int) -> State:
        """Copies one frame, as a State; negative frames count from the end."""
        return State(*(getattr(self, name)[frame].copy() for name in FIELDS))

    @property
    def time(self) -> np.ndarray:
        """Time of every frame [s]."""
        return np.arange(len(self)) * self.step

    def cut(self, frames: int) -> Trajectory:
        """Takes the first frames of it."""
        parts: dict[str, Any] = {name: getattr(self, name)[:frames] for name in FIELDS}
        return dataclasses.replace(self, **parts)

    def joined(self, later: Trajectory) -> Trajectory:
        """Joins this and a run that went on from its last frame.

        Raises:
            InputError: it did not: its cloth, scene, step, steps before it or first frame (beyond what single precision
                keeps) are others.
        """
        if not isinstance(later, Trajectory):
            raise InputError(f"later = {later!r}, must be a Trajectory")
        if not len(self) or not len(later):
            raise InputError(f"trajectories of {len(self)} and {len(later)} frames, must have at least one each")
        if later.step != self.step:
            raise InputError(f"later.step = {later.step:g}, must be that of the frames before, {self.step:g}")
        if not later.cloth.same_as(self.cloth):
            raise InputError("later.cloth is another one than that of the frames before")
        if self.scene is not None and later.scene is not None and not later.scene.same_as(self.scene):
            raise InputError("later.scene is another one than that of the frames before")
        if later.start != self.steps_done:
            raise InputError(f"later.start = {later.start}, must be the steps until here, {self.steps_done}")
        for name in FIELDS:
            end, begin = getattr(self, name)[-1], getattr(later, name)[0]
            off = np.abs(begin - end).max()
            if off > 1e-6 * np.ptp(end, axis=0).max():
                raise InputError(f"later.{name}[0] is off by {off:g}, must be the last frame here")
        parts: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(later, name)[1:]]) for name in FIELDS
        }
        return dataclasses.replace(self, **parts)

    def save(self, path: str | os.PathLike) -> None:
        """Writes an .npz file with the cloth, its scene and every frame; it appears whole or not at all."""
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                format=FORMAT,
                start=self.start,
                step=self.step,
                **_packed_cloths(self.cloth),
                **{name: getattr(self, name) for name in FIELDS},
                **({} if self.scene is None else _packed(self.scene)),
            )

    @classmethod
    def load(cls, path: str | os.PathLike) -> Trajectory:
        """Reads what ``save`` wrote; an InputError says what is wrong with the file."""
        try:
            with np.load(path) as data:
                written = integer("format", data["format"].item(), least=1) if "format" in data else 1
                if written > FORMAT:
                    raise InputError(f"format = {written}, this warp_yarn reads up to {FORMAT}: it needs a newer one")
                cloth = _unpacked_cloths(data)
                frames = len(np.atleast_1d(data["position"]))
                if not frames:
                    raise InputError("has no frame, must have at least one")
                values: dict[str, Any] = {
                    name: finite_array(name, data[name], (frames, cloth.nodes, WIDTHS[name])) for name in FIELDS
                }
                return cls(
                    cloth,
                    real("step", data["step"].item(), above=0.0),
                    **values,
                    scene=_unpacked(cloth, data) if "scene_terms" in data else None,
                    start=integer("start", data["start"].item(), least=0) if "start" in data else 0,
                )
        except FileNotFoundError as error:
            raise InputError(f"{Path(path)}: there is no such file") from error
        except InputError as error:
            raise InputError(f"{Path(path)}: {error}") from error
        except Exception as error:  # zip, pickle and key errors of a foreign or truncated file
            raise InputError(f"{Path(path)}: not a recording of warp_yarn ({error})") from error


def _packed_cloths(cloth: Cloth | Cloths) -> dict[str, Any]:
    """Packs a cloth into arrays; of several each with its number before their names."""
    if isinstance(cloth, Cloths):
        parts = [_packed_cloths(each) for each in cloth.cloths]
        return {"cloths": len(parts)} | {
            f"cloth_{k}_{name}": parts[k][name] for k in range(len(parts)) for name in parts[k]
        }
    given = {name: cloth._arguments[name] for name in CLOTH_NUMBERS}
    if given["friction_damping"] is None:
        given["friction_damping"] = np.nan  # of its own mass, also where others are beside it
    for name in ("spacing", "crimp"):
        value = cloth._arguments[name]
        warp, weft = value if isinstance(value, tuple) else (value, None)
        given |= {name: warp} if weft is None else {name: warp, f"{name}_weft": weft}
    sizes = [[np.nan if size is None else size for size in yarn.sizes] for yarn in cloth.yarns]
    return {
        "draft": cloth.weave.draft,
        "weave": cloth.weave.name,
        "yarns": np.array([(yarn.density, yarn.stretch, yarn.bend) for yarn in cloth.yarns]),
        "sizes": np.array(sizes),
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
    if f"{of}sizes" in data:
        sizes = [dict(zip(SIZES, each, strict=True)) for each in data[f"{of}sizes"].tolist()]
        sizes = [{name: size for name, size in each.items() if not np.isnan(size)} for each in sizes]
        yarns = [dataclasses.replace(yarn, **each) for yarn, each in zip(yarns, sizes, strict=True)]

    def value(name: str) -> Any:
        array = data[f"{of}{name}"]
        return array if array.ndim else array.item()

    numbers = {name: value(name) for name in (*CLOTH_NUMBERS, "crimp") if f"{of}{name}" in data}
    for name in ("spacing", "crimp"):
        if f"{of}{name}_weft" in data:
            numbers[name] = numbers[name], value(f"{name}_weft")
    if np.isnan(numbers["friction_damping"]).any():
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
        # left out where they are what recordings of before have
        "pressing": None if scene.contact_force == "published" else scene.contact_force,
        "crimp_interchange": scene.crimp_interchange or None,
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
        contact_force=value("pressing").item() if "scene_pressing" in data else "published",
        crimp_interchange="scene_crimp_interchange" in data,
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
