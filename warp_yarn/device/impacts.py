"""Where cloth meets obstacles and itself in a step: the host's side of ``kernels/contact/continuous.py``.

Planes are no triangles: what is behind one at the end of a step is its impact, wherever it came from.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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


class Found(NamedTuple):
    """Impacts: n·Σ w x is how far the first of two places is from the second, on the side that it belongs.

    Vertices from ``nodes`` on are those of obstacles.
    """

    vertices: np.ndarray
    """[impacts, 4]"""
    weights: np.ndarray
    """[impacts, 4]"""
    normals: np.ndarray
    """[impacts, 3]"""

    def gap(self, places: np.ndarray) -> np.ndarray:
        """Compute n·Σ w x of all vertices' places [impacts] (m)."""
        return np.einsum("ki,kij,kj->k", self.weights, places[self.vertices], self.normals)

    def __getitem__(self, rows: Any) -> Found:  # type: ignore[override]
        return Found(*(values[rows] for values in (self.vertices, self.weights, self.normals)))

    def and_these(self, others: Found) -> Found:
        """Join with others."""
        return Found(*(np.concatenate(pair) for pair in zip(tuple(self), tuple(others), strict=True)))


def none() -> Found:
    """Make an empty one."""
    return Found(np.zeros((0, 4), dtype=np.int64), np.zeros((0, 4)), np.zeros((0, 3)))


class Detection:
    """Finds impacts of a scene's cloth.

    Args:
        scene: the scene; its obstacles are planes, boxes and triangle meshes that stand still.
        device: of Warp.

    Attributes:
        nodes: of the cloth.
        obstacle: of every vertex of an obstacle, and of every plane behind them, the obstacle.
        fixed: where the vertices of obstacles are [vertices, 3] (m).
    """

    def __init__(self, scene: Scene, device: Any):
        self.device, self.nodes = device, scene.cloth.nodes
        several = list(enumerate(scene.obstacles))
        solid = [(k, *triangles_of(obstacle)) for k, obstacle in several if not isinstance(obstacle, Plane)]
        planes = [(k, obstacle) for k, obstacle in several if isinstance(obstacle, Plane)]
        up = np.array([[0.0, 0.0, 1.0]])
        self.normals = np.concatenate([np.zeros((0, 3)), *(turned(obstacle.rotation, up) for _, obstacle in planes)])
        points = np.array([obstacle.position for _, obstacle in planes]).reshape(-1, 3)
        self.fixed: np.ndarray = np.concatenate([*(vertices for _, vertices, _ in solid), points])
        self.obstacle = np.repeat(
            [*(k for k, _, _ in solid), *(k for k, _ in planes)], [*(len(v) for _, v, _ in solid), *(1 for _ in planes)]
        ).astype(int)
        self.first_plane = self.nodes + len(self.fixed) - len(planes)
        faces, first = [scene.cloth.topology.triangle_nodes], self.nodes
        for _, vertices, triangles in solid:
            faces.append(triangles + first)
            first += len(vertices)
        self._room = ROOM
        self._kernels = vars(continuous.define())
        self._looks = bool(solid) or scene.self_contact
        self._set_surface(np.concatenate(faces).astype(np.int32), len(faces[0]), scene.self_contact)

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
        points = self.fixed[self.first_plane - self.nodes :]
        gap = np.einsum("ipj,pj->ip", position[:, None] - points[None], self.normals)
        node, plane = np.nonzero(gap < near)
        vertices = np.column_stack([node, *[self.first_plane + plane] * 3]) if len(node) else none().vertices
        return Found(vertices, np.tile([1.0, -1.0, 0.0, 0.0], (len(node), 1)), self.normals[plane])

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
            found = Found(*(getattr(impacts, name).numpy()[:count] for name in ("vertices", "weights", "normals")))
        # a GPU finds them in any order
        return found[np.lexsort(found.vertices.T)]

    def _new_impacts(self) -> Any:
        impacts = self._kernels["Impacts"]()
        impacts.count = wp.zeros(1, dtype=int, device=self.device)
        for name, dtype in (("vertices", wp.vec4i), ("weights", wp.vec4d), ("normals", wp.vec3d)):
            setattr(impacts, name, wp.empty(self._room, dtype=dtype, device=self.device))
        return impacts

    def _boxes(self, lower: np.ndarray, upper: np.ndarray) -> tuple[wp.array, wp.array]:
        """Round boxes outwards to single precision."""
        infinite = np.float32(np.inf)
        rounded = np.nextafter(lower.astype(np.float32), -infinite), np.nextafter(upper.astype(np.float32), infinite)
        return tuple(wp.array(values, dtype=wp.vec3, device=self.device) for values in rounded)  # type: ignore


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
