"""Where cloth meets obstacles and itself in a step: the host's side of ``kernels/contact/continuous.py``.

Planes are no triangles: what is behind one at the end of a step is its impact, wherever it came from.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..description.obstacles import Box, Obstacle, Plane, TriangleMesh
from ..description.scene import Scene
from ..kernels.contact import continuous
from .exclusive import ALONE

ROOM = 1024
"""Impacts that there is room for at first."""
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""Of a box: which of its corners."""


NO_POINTS, NO_FACES = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)


@dataclasses.dataclass(frozen=True)
class Found:
    """Impacts: n·Σ w x is how far the first of two places is from the second, on the side that it belongs.

    Args:
        vertices: four of each, from ``nodes`` on those of obstacles [impacts, 4].
        weights: w [impacts, 4].
        normals: n [impacts, 3].
        kinds: what n and w follow from (``continuous.py``) [impacts].
        times: of the step, 1 of what is merely near [impacts].
    """

    vertices: np.ndarray
    weights: np.ndarray
    normals: np.ndarray
    kinds: np.ndarray
    times: np.ndarray

    def gap(self, places: np.ndarray) -> np.ndarray:
        """Compute n·Σ w x of all vertices' places [impacts] (m)."""
        return np.einsum("ki,kij,kj->k", self.weights, places[self.vertices], self.normals)

    def pick(self, rows: np.ndarray) -> Found:
        """Take some of them."""
        return Found(*(getattr(self, name)[rows] for name in NAMES))

    def and_these(self, others: Found) -> Found:
        """Join with others."""
        return Found(*(np.concatenate([getattr(self, name), getattr(others, name)]) for name in NAMES))


NAMES = tuple(field.name for field in dataclasses.fields(Found))


def none() -> Found:
    """Make an empty one."""
    whole = np.zeros(0, dtype=np.int32)
    return Found(np.zeros((0, 4), dtype=np.int64), np.zeros((0, 4)), np.zeros((0, 3)), whole, np.zeros(0))


class Detection:
    """Finds impacts of cloth.

    Args:
        nodes: of the cloth.
        faces: of the cloth [faces, 3].
        fixed: where other vertices stand still [vertices, 3] (m), counted on from the nodes.
        fixed_faces: of these [faces, 3].
        planes: points [planes, 3] (m) and normals [planes, 3] of planes.
        touches_itself: whether the cloth may.
        device: of Warp.

    Attributes:
        fixed: the points of planes are the last of them.
    """

    def __init__(
        self,
        nodes: int,
        faces: np.ndarray,
        *,
        fixed: np.ndarray = NO_POINTS,
        fixed_faces: np.ndarray = NO_FACES,
        planes: tuple[np.ndarray, np.ndarray] = (NO_POINTS, NO_POINTS),
        touches_itself: bool = False,
        device: Any = "cpu",
    ):
        self.device, self.nodes = device, nodes
        self.fixed: np.ndarray = np.concatenate([fixed, planes[0]])
        self._first_plane, self._normals = nodes + len(fixed), planes[1]
        self._room = ROOM
        self._kernels = vars(continuous.define())
        self._looks = len(fixed_faces) > 0 or touches_itself
        self._set_surface(np.concatenate([faces, fixed_faces]).astype(np.int32), len(faces), touches_itself)

    def _set_surface(self, faces: np.ndarray, of_cloth: int, touches_itself: bool) -> None:
        pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
        owned = np.full(len(pairs), -1, dtype=np.int32)
        owned[first] = np.arange(len(edges), dtype=np.int32)
        owned[first[self._flat(faces, edges, inverse.ravel())]] = -1
        self.faces, self.edges = faces, edges.astype(np.int32)
        surface = self._kernels["Surface"]()
        surface.nodes, surface.triangles, surface.touches_itself = self.nodes, of_cloth, int(touches_itself)
        surface.faces = wp.array(faces, dtype=wp.vec3i, device=self.device)
        surface.edges = wp.array(self.edges, dtype=wp.vec2i, device=self.device)
        surface.owned = wp.array(owned.reshape(-1, 3), dtype=wp.vec3i, device=self.device)
        self._surface = surface

    def _flat(self, faces: np.ndarray, edges: np.ndarray, edge: np.ndarray) -> np.ndarray:
        """Tell which edges of obstacles lie within a flat face, between two triangles of it [edges]: a node over one is
        over a triangle.

        Args:
            faces, edges: all of them.
            edge: of each side of each face.
        """
        corner = self.places(np.zeros((self.nodes, 3)))[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
        # of the two sides of an edge, the same normal or the opposite one
        spread = np.zeros((len(edges), 3, 3))
        np.add.at(spread, edge, np.repeat(normal[:, :, None] * normal[:, None], 3, axis=0))
        largest = np.linalg.eigvalsh(spread)[:, -1]
        return (edges[:, 0] >= self.nodes) & (np.bincount(edge) == 2) & (largest > 2.0 - 1e-9)

    def places(self, position: np.ndarray) -> np.ndarray:
        """Append the vertices of obstacles to those of the cloth."""
        return np.concatenate([position, self.fixed])

    def find(self, start: np.ndarray, end: np.ndarray, near: float) -> Found:
        """Find the impacts on the straight way between two positions [nodes, 3], and what ends nearer than ``near``
        [m]."""
        found = self._behind_planes(end, near)
        if self._looks:
            found = found.and_these(
                self._search(["vertices", "edges"], self.places(start), self.places(end), near, near)
            )
        return found

    def crossings(self, position: np.ndarray) -> np.ndarray:
        """Find the edges that go through faces: a vertex of the edge and three of the face [crossings, 4]."""
        if not self._looks:
            return none().vertices
        places = self.places(position)
        return self._search(["crossings"], places, places, 0.0).vertices

    def _behind_planes(self, position: np.ndarray, near: float) -> Found:
        points = self.fixed[self._first_plane - self.nodes :]
        gap = np.einsum("ipj,pj->ip", position[:, None] - points[None], self._normals)
        node, plane = np.nonzero(gap < near)
        vertices = np.column_stack([node, *[self._first_plane + plane] * 3]) if len(node) else none().vertices
        weights = np.tile([1.0, -1.0, 0.0, 0.0], (len(node), 1))
        kinds = np.full(len(node), continuous.PLANE, dtype=np.int32)
        return Found(vertices, weights, self._normals[plane], kinds, np.ones(len(node)))

    def _search(self, names: list[str], start: np.ndarray, end: np.ndarray, reach: float, *near: float) -> Found:
        """Launch kernels, by name, over the hierarchy of faces, and again where there was no room for all impacts."""
        low, high = np.minimum(start, end), np.maximum(start, end)
        with ALONE:
            self._surface.start = wp.array(start, dtype=wp.vec3d, device=self.device)
            self._surface.end = wp.array(end, dtype=wp.vec3d, device=self.device)
            tree = wp.Bvh(*self._boxes(low[self.faces].min(axis=1) - reach, high[self.faces].max(axis=1) + reach))
            of_edges = self._boxes(low[self.edges].min(axis=1), high[self.edges].max(axis=1))
            boxes = {"vertices": self._boxes(low, high), "edges": of_edges, "crossings": of_edges}
            while True:
                impacts = self._new_impacts()
                for name in names:
                    arguments = [tree.id, self._surface, *boxes[name], *near, impacts]
                    wp.launch(self._kernels[f"find_{name}"], len(boxes[name][0]), arguments, device=self.device)
                count = int(impacts.count.numpy()[0])
                if count <= self._room:
                    break
                self._room = 2 * count
            found = Found(*(getattr(impacts, name).numpy()[:count] for name in NAMES))
        # a GPU finds them in any order
        return found.pick(np.lexsort(found.vertices.T))

    def _new_impacts(self) -> Any:
        impacts = self._kernels["Impacts"]()
        impacts.count = wp.zeros(1, dtype=int, device=self.device)
        for name, dtype in zip(NAMES, (wp.vec4i, wp.vec4d, wp.vec3d, wp.int32, wp.float64), strict=True):
            setattr(impacts, name, wp.empty(self._room, dtype=dtype, device=self.device))
        return impacts

    def _boxes(self, lower: np.ndarray, upper: np.ndarray) -> tuple[wp.array, wp.array]:
        """Round boxes outwards to single precision."""
        infinite = np.float32(np.inf)
        rounded = np.nextafter(lower.astype(np.float32), -infinite), np.nextafter(upper.astype(np.float32), infinite)
        return tuple(wp.array(values, dtype=wp.vec3, device=self.device) for values in rounded)  # type: ignore


def detection_of(scene: Scene, device: Any) -> tuple[Detection, np.ndarray]:
    """Make what finds impacts of a scene's cloth with planes, boxes and triangle meshes that stand still, and with
    itself.

    Returns:
        It, and of each of its fixed vertices the obstacle.
    """
    several, cloth = list(enumerate(scene.obstacles)), scene.cloth
    solid = [(k, *triangles_of(obstacle)) for k, obstacle in several if not isinstance(obstacle, Plane)]
    planes = [(k, obstacle) for k, obstacle in several if isinstance(obstacle, Plane)]
    up, first, faces = np.array([[0.0, 0.0, 1.0]]), cloth.nodes, [NO_FACES]
    for _, vertices, triangles in solid:
        faces.append(triangles + first)
        first += len(vertices)
    detection = Detection(
        cloth.nodes,
        cloth.topology.triangle_nodes,
        fixed=np.concatenate([NO_POINTS, *(vertices for _, vertices, _ in solid)]),
        fixed_faces=np.concatenate(faces),
        planes=(
            np.concatenate([NO_POINTS, *(obstacle.position[None] for _, obstacle in planes)]),
            np.concatenate([NO_POINTS, *(turned(obstacle.rotation, up) for _, obstacle in planes)]),
        ),
        touches_itself=scene.self_contact,
        device=device,
    )
    counts = [len(vertices) for _, vertices, _ in solid] + [1] * len(planes)
    return detection, np.repeat([k for k, *_ in solid] + [k for k, _ in planes], counts).astype(int)


def triangles_of(obstacle: Obstacle) -> tuple[np.ndarray, np.ndarray]:
    """Give the vertices [vertices, 3] (m) and faces [faces, 3] of a box or a mesh."""
    if isinstance(obstacle, TriangleMesh):
        local, faces = obstacle.vertices, obstacle.faces
    else:
        assert isinstance(obstacle, Box)
        local, faces = CORNERS * obstacle.size, SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return turned(obstacle.rotation, local) + obstacle.position, faces


def turned(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors [n, 3] by a quaternion (x, y, z, w)."""
    axis, w = rotation[:3], rotation[3]
    side = np.cross(axis, vectors)
    return vectors + 2.0 * (w * side + np.cross(axis, side))
