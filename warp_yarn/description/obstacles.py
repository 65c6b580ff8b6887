"""Obstacles that cloth touches, and the law of contact.

An obstacle is a shape in its own frame, and a pose: p, where its origin is, and R, how it is turned. Rotations are
quaternions (x, y, z, w).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, choice, finite_array, missing_extra, real
from .fixed import Fixed

ROUNDING = 1e-15
"""Of a length of 1: what was normalized stays as it is, to the last bit."""
UNTURNED = (0.0, 0.0, 0.0, 1.0)
SAMPLES = ("nodes", "nodes+mids")
METHODS = ("barrier", "impact-zones")
SPEED = 3.0
"""Of a node whose kinetic energy the default stiffness stops within its range [m/s]: fabric that falls or is thrown."""


class Obstacle(Fixed):
    """What the obstacles have in common.

    Attributes:
        shape: name of the shape.
        size: its numbers [3] (m); what they mean depends on the shape.
        position, rotation: the pose at the beginning, [3] (m) and [4].
        path: poses at the end of each step [steps, 7], or None: it stands still.
        friction: μ.
    """

    shape: str
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    path: np.ndarray | None
    friction: float

    def _place(
        self, size: Sequence[float] | np.ndarray, position: np.ndarray, rotation: np.ndarray, friction: Any, path: Any
    ) -> None:
        """Takes what all obstacles have; the arguments of each are fixed by itself."""
        self.size = np.array(size, dtype=np.float64)
        self.position, self.rotation = position, rotation
        self.friction = real("friction", friction, least=0.0)
        self.path = None if path is None else self._poses(path)

    def _poses(self, path: Any) -> np.ndarray:
        width = 7 if np.ndim(path) == 2 and np.shape(path)[1] == 7 else 3
        poses = finite_array("path", path, (None, width))
        if len(poses) == 0:
            raise InputError("path has no step, must have at least one")
        if width == 3:
            return np.hstack([poses, np.tile(self.rotation, (len(poses), 1))])
        poses[:, 3:] = [unit_quaternion(f"path[{k}]", q) for k, q in enumerate(poses[:, 3:])]
        return poses

    def same_as(self, other: Obstacle) -> bool:
        """Tells whether another one is of the same shape, size, pose, path and friction."""
        mine, its = vars(self), vars(other)
        names = (mine.keys() | its.keys()) - {"_arguments"}
        pairs = [(np.asarray(mine.get(name)), np.asarray(its.get(name))) for name in names]
        return type(self) is type(other) and all(np.array_equal(a, b) for a, b in pairs)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(friction {self.friction:g}{', moving' if self.path is not None else ''})"


class Plane(Obstacle):
    """A half-space that cloth stays out of.

    Args:
        point: a point of its surface [m], 3 numbers: p.
        normal: out of it, 3 numbers, not all 0.
        friction: μ, at least 0.
        path: where p is at the end of each step [steps, 3] (m), or with rotations that turn z into the normal
            [steps, 7]; it stays at the last. None: it stands still.
    """

    shape = "plane"

    def __init__(self, *, point: Any, normal: Any, friction: float = 0.3, path: Any = None):
        normal = _direction("normal", normal)
        self._place((0.0, 0.0, 0.0), finite_array("point", point, (3,)), _turn_z_to(normal), friction, path)
        self._fix(point=self.position, normal=normal, friction=self.friction, path=self.path)


class Sphere(Obstacle):
    """A ball.

    Args:
        center: p [m], 3 numbers.
        radius: above 0 [m].
        friction, path: as of Plane.
    """

    shape = "sphere"

    def __init__(self, *, center: Any, radius: float, friction: float = 0.3, path: Any = None):
        radius = real("radius", radius, above=0.0)
        center = finite_array("center", center, (3,))
        self._place((radius, 0.0, 0.0), center, np.array(UNTURNED), friction, path)
        self._fix(center=center, radius=radius, friction=self.friction, path=self.path)


class _Rod(Obstacle):
    """What lies along a straight line: size (half its length, radius, 0), p in its middle, z along it."""

    def __init__(self, *, start: Any, end: Any, radius: float, friction: float = 0.3, path: Any = None):
        start, end = finite_array("start", start, (3,)), finite_array("end", end, (3,))
        radius = real("radius", radius, above=0.0)
        along = _direction("end - start", end - start)
        half = 0.5 * float(np.linalg.norm(end - start))
        self._place((half, radius, 0.0), 0.5 * (start + end), _turn_z_to(along), friction, path)
        self._fix(start=start, end=end, radius=radius, friction=self.friction, path=self.path)


class Capsule(_Rod):
    """A rod with round ends.

    Args:
        start, end: of its axis [m], 3 numbers each; p is in the middle, and z along the axis.
        radius: above 0 [m].
        friction, path: as of Plane.
    """

    shape = "capsule"


class Cylinder(_Rod):
    """A rod with flat ends.

    Args:
        start, end: centers of its ends [m], 3 numbers each; p is in the middle, and z along the axis.
        radius: above 0 [m].
        friction, path: as of Plane.
    """

    shape = "cylinder"


class Box(Obstacle):
    """A box.

    Args:
        center: p [m], 3 numbers.
        half_extents: half of its edges along its own x, y, z [m], each above 0.
        rotation: quaternion (x, y, z, w).
        friction, path: as of Plane.
    """

    shape = "box"

    def __init__(
        self, *, center: Any, half_extents: Any, rotation: Any = UNTURNED, friction: float = 0.3, path: Any = None
    ):
        half = finite_array("half_extents", half_extents, (3,))
        for k, value in enumerate(half):
            real(f"half_extents[{k}]", float(value), above=0.0)
        center, rotation = finite_array("center", center, (3,)), unit_quaternion("rotation", rotation)
        self._place(half, center, rotation, friction, path)
        self._fix(center=center, half_extents=half, rotation=rotation, friction=self.friction, path=self.path)


class TriangleMesh(Obstacle):
    """A surface of triangles, which cloth may touch from both sides. Nodes keep off it, not what is between them: an
    edge sharper than the spacing of the yarns pokes through.

    Args:
        vertices: [vertices, 3] (m), in the mesh's own frame.
        faces: three vertices each [faces, 3].
        position: p [m], 3 numbers.
        rotation: quaternion (x, y, z, w).
        friction, path: as of Plane.
    """

    shape = "mesh"

    def __init__(
        self,
        vertices: Any,
        faces: Any,
        *,
        position: Any = (0.0, 0.0, 0.0),
        rotation: Any = UNTURNED,
        friction: float = 0.3,
        path: Any = None,
    ):
        self.vertices = finite_array("vertices", vertices, (None, 3))
        faces = np.array(faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer) or not len(faces):
            raise InputError(f"faces has shape {faces.shape}, must be (any, 3), whole numbers, and one face at least")
        if faces.min() < 0 or faces.max() >= len(self.vertices):
            raise InputError(f"faces names vertex {faces.max()}, must be from 0 to {len(self.vertices) - 1}")
        self.faces = faces.astype(np.int32)
        corner = self.vertices[self.faces]
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        if area.min() == 0.0:
            raise InputError(f"faces[{int(area.argmin())}] has no area, must be a triangle")
        position, rotation = finite_array("position", position, (3,)), unit_quaternion("rotation", rotation)
        self._place((0.0, 0.0, 0.0), position, rotation, friction, path)
        self._fix(
            vertices=self.vertices,
            faces=self.faces,
            position=position,
            rotation=rotation,
            friction=self.friction,
            path=self.path,
        )

    @classmethod
    def read(cls, file: str | os.PathLike[str], *, scale: float = 1.0, **options: Any) -> TriangleMesh:
        """Reads any file that trimesh reads (extra ``meshes``).

        Args:
            file: such as an .obj, .stl or .ply.
            scale: metres of a unit of the file.
            options: position, rotation, friction, path.

        Raises:
            InputError: no trimesh, or a file without triangles.
        """
        scale = real("scale", scale, above=0.0)
        try:
            import trimesh
        except ModuleNotFoundError as error:
            raise missing_extra("trimesh", "files of meshes need", "meshes") from error
        try:
            mesh: Any = trimesh.load(str(file), force="mesh", process=False)
            return cls(scale * np.asarray(mesh.vertices), np.asarray(mesh.faces), **options)
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{os.fspath(file)} could not be read as a mesh: {error}") from error


class Contact(Fixed):
    """The law of contact (``kernels/contact/barrier.py`` has its formulas), or the paper's impact zones.

    A barrier pushes within the implicit stage, with friction: the integrators are "implicit-euler" and "sdirk2".

    Impact zones put the end of a step where nothing has met (``warp_yarn/device/impact_zones.py``): the integrator is
    "linear", obstacles are Plane, Box and TriangleMesh, stand still and have friction 0, what touches are the triangles
    through the crossings, and there is no friction. Of the options below they have ``thickness`` alone.

    Args:
        method: "barrier" or "impact-zones".
        stiffness: κ of a contact [N/m], above 0; None: m (3 m/s / range)², m the mean mass of a node, and with mids a
            third of that, of two samples of cloth a ninth: as many more touch.
        distance: D, how near samples may come to obstacles [m], above 0; None: the yarns' radius, half
            the thickness of the thickest.
        range: d̂, beyond D, over which obstacles push [m], above 0; None: the same.
        self_distance: D of cloth on cloth, between samples [m], above 0; None: 1.5 spacings, of the
            longest, or 3 of those radii if that is more.
        self_range: d̂ of cloth on cloth [m], above 0; None: that spacing.
        friction: μ of cloth on cloth, at least 0; None: 0.3 of a barrier. (Each obstacle has its own.)
        slip_speed: ε, at which friction reaches μ f_n [m/s], above 0: what sticks creeps, at ε (1 − √(1 − r)) under a
            share r of that.
        damping_speed: v_d of normal damping [m/s], above 0; None: no damping.
        samples: what touches: "nodes", or "nodes+mids", the middles of all segments of yarn too: what is thinner than
            the spacing does not slip through, and layers slide on each other smoothly. It has three times as many
            samples, and nine times as many pairs of them.
        thickness: of impact zones, by which what has met is put apart [m], above 0; None: a tenth of the spacing.

    Raises:
        InputError: an option of the other method.
    """

    def __init__(
        self,
        *,
        method: str = "barrier",
        stiffness: float | None = None,
        distance: float | None = None,
        range: float | None = None,
        self_distance: float | None = None,
        self_range: float | None = None,
        friction: float | None = None,
        slip_speed: float = 1e-3,
        damping_speed: float | None = 0.5,
        samples: str = "nodes",
        thickness: float | None = None,
    ):
        def optional(name: str, value: Any) -> float | None:
            return None if value is None else real(name, value, above=0.0)

        self.method = choice("contact method", method, METHODS)
        self.stiffness = optional("contact stiffness", stiffness)
        self.distance = optional("contact distance", distance)
        self.range = optional("contact range", range)
        self.self_distance = optional("contact self_distance", self_distance)
        self.self_range = optional("contact self_range", self_range)
        if friction is None:
            friction = 0.3 if self.method == "barrier" else 0.0
        self.friction = real("contact friction", friction, least=0.0)
        self.slip_speed = real("contact slip_speed", slip_speed, above=0.0)
        self.damping_speed = optional("contact damping_speed", damping_speed)
        self.samples = choice("contact samples", samples, SAMPLES)
        self.thickness = optional("contact thickness", thickness)
        self._refuse_options()
        self._fix(**vars(self))

    def _refuse_options(self) -> None:
        """Refuses options that the method does not have."""
        if self.method == "barrier":
            if self.thickness is not None:
                raise InputError(f"contact thickness = {self.thickness:g} with a barrier: must be None")
            return
        lengths = ("stiffness", "distance", "range", "self_distance", "self_range")
        wanted = {**dict.fromkeys(lengths), "friction": 0.0, "slip_speed": 1e-3, "damping_speed": 0.5}
        wanted["samples"] = "nodes"
        for name, value in wanted.items():
            if getattr(self, name) != value:
                raise InputError(
                    f"contact {name} = {getattr(self, name)} with impact zones, which have thickness alone: "
                    f"must be {value}, its default"
                )

    def check_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Refuses obstacles that impact zones cannot keep cloth from.

        Raises:
            InputError: such an obstacle.
        """
        for k, obstacle in enumerate(obstacles if self.method == "impact-zones" else ()):
            name = f"obstacles[{k}] with impact zones"
            if not isinstance(obstacle, Plane | Box | TriangleMesh):
                raise InputError(f"{name} is a {type(obstacle).__name__}, must be a Plane, a Box or a TriangleMesh")
            if obstacle.friction != 0.0:
                raise InputError(f"{name} has friction = {obstacle.friction:g}, must be 0: they know none")
            if obstacle.path is not None:
                raise InputError(f"{name} has a path, must be None: it has to stand still")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Contact) and self._arguments == other._arguments

    def __hash__(self) -> int:
        return hash(tuple(self._arguments.items()))


def unit_quaternion(name: str, value: Any) -> np.ndarray:
    """Gives a rotation, of length 1, or an InputError."""
    q = finite_array(name, value, (4,))
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > 1e-6:
        raise InputError(f"{name} = {q.tolist()} has length {length:g}, must be a rotation: a quaternion of length 1")
    return q / (length if abs(length - 1.0) > ROUNDING else 1.0)


def _direction(name: str, value: Any) -> np.ndarray:
    vector = finite_array(name, value, (3,))
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError(f"{name} is 0, must have a direction")
    return vector / (length if abs(length - 1.0) > ROUNDING else 1.0)


def _turn_z_to(n: np.ndarray) -> np.ndarray:
    """Finds the shortest rotation that turns z into a unit vector, as a quaternion."""
    if n[2] < -1.0 + 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    q = np.array([-n[1], n[0], 0.0, 1.0 + n[2]])
    return q / np.linalg.norm(q)
