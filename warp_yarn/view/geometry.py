"""What of a trajectory can be drawn: where its cloth is and which way it faces, and where obstacles are."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import warp as wp

from ..description.cloth import Cloth
from ..description.cloths import Cloths
from ..description.obstacles import Obstacle, TriangleMesh
from ..device import start
from ..device.exclusive import ALONE, compiling, refuse_recording
from ..errors import InputError, brief, finite_array
from ..kernels import Variant, build
from ..simulation.state import Trajectory

PALETTE = ((0.13, 0.56, 0.57), (0.96, 0.49, 0.37), (0.93, 0.75, 0.36), (0.36, 0.36, 0.60), (0.60, 0.65, 0.68))
"""Colours of yarns that name none: teal and coral as in figure 5 of the paper, then sand, indigo and grey."""

OBSTACLE_COLOR = (0.62, 0.60, 0.57)
"""Of all obstacles, sRGB: a grey that no yarn has by default."""

PLANE_MARGIN = 0.15
"""How far the rectangle that stands for a plane goes beyond what is above it, over the longer side of that."""

SURROUNDINGS = 0.15
"""How far about the cloth planes are in view, over its largest extent: what is beyond may be cut off."""

WHOLE = 4.0
"""Over that extent: the largest of cloth and an obstacle that are in view together, whole. Of a larger one, or one that
leaves, what is near is in view, as of a plane: all of it would leave the cloth too small."""

BACK = np.array([-1.0, -1.0, -1.0, 1.0])
"""Times a quaternion (x, y, z, w): what turns back."""


@dataclasses.dataclass(frozen=True)
class Placed:
    """An obstacle, and where it is drawn."""

    obstacle: Obstacle
    position: np.ndarray
    """[frames, 3] (m): of its origin; of a plane, the middle of the rectangle that stands for it."""
    rotation: np.ndarray
    """[frames, 4]: quaternions (x, y, z, w)."""
    width: float
    length: float
    """Along x and y, of a plane's rectangle [m]; of others 0."""

    @property
    def moves(self) -> bool:
        return bool((self.position != self.position[0]).any() or (self.rotation != self.rotation[0]).any())

    def world(self, points: np.ndarray) -> np.ndarray:
        """Takes points of the obstacle's own frame [points, 3] at every frame [frames, points, 3]."""
        return self.position[:, None] + _turned(self.rotation[:, None], points[None])

    def local(self, points: np.ndarray, frame: int) -> np.ndarray:
        """Places [points, 3] in the obstacle's own frame."""
        return _turned(self.rotation[frame] * BACK, points - self.position[frame])

    def matrix(self, frame: int) -> np.ndarray:
        """Makes the matrix [4, 4] from its own frame to the world."""
        result = np.eye(4)
        result[:3, :3] = _turned(self.rotation[frame], np.eye(3)).T
        result[:3, 3] = self.position[frame]
        return result

    def corners(self) -> np.ndarray:
        """Gives the corners of a box around it in its own frame [8, 3] (m); of a plane, of its rectangle [4, 3]."""
        obstacle = self.obstacle
        low, high = np.zeros(3), np.zeros(3)
        if obstacle.shape == "plane":
            high[:2] = 0.5 * self.width, 0.5 * self.length
        elif isinstance(obstacle, TriangleMesh):
            low, high = obstacle.vertices.min(axis=0), obstacle.vertices.max(axis=0)
        elif obstacle.shape == "box":
            high = obstacle.size
        elif obstacle.shape == "sphere":
            high = np.full(3, obstacle.size[0])
        else:
            half, radius, _ = obstacle.size
            high = np.array([radius, radius, half + (radius if obstacle.shape == "capsule" else 0.0)])
        if obstacle.shape != "mesh":
            low = -high
        return np.unique(np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T, axis=0)


def placed(trajectory: Trajectory, at: np.ndarray | None = None) -> list[Placed]:
    """Lists the obstacles of a trajectory's scene.

    Args:
        at: when its frames are, in frames since the first of the run [frames], which need not be whole; None: 0, 1, 2,
            ...
    """
    if trajectory.scene is None:
        return []
    at = np.arange(len(trajectory)) if at is None else np.asarray(at)
    result = []
    for obstacle in trajectory.scene.obstacles:
        position, rotation = _poses(obstacle, trajectory.start + trajectory.every * at)
        width = length = 0.0
        if obstacle.shape == "plane":
            # a rectangle of its own, which moves as it does, under all of the cloth at all times
            low, high = np.full(2, np.inf), np.full(2, -np.inf)
            for k, when in enumerate(at.tolist()):
                local = _turned(rotation[k] * BACK, between(trajectory.position, when) - position[k])[:, :2]
                low, high = np.minimum(low, local.min(axis=0)), np.maximum(high, local.max(axis=0))
            width, length = (high - low + 2.0 * PLANE_MARGIN * (high - low).max()).tolist()
            position = position + _turned(rotation, np.append(0.5 * (low + high), 0.0))
        result.append(Placed(obstacle, position, rotation, width, length))
    return result


def in_view(obstacles: Iterable[Placed], low: np.ndarray, high: np.ndarray) -> Iterator[np.ndarray]:
    """Gives points [n, 3] (m) of each obstacle that a picture shall have in it beside a cloth in a box [3], [3] (m)."""
    size = float((high - low).max())
    for each in obstacles:
        corners = each.world(each.corners()).reshape(-1, 3)
        both = np.maximum(corners.max(axis=0), high) - np.minimum(corners.min(axis=0), low)
        whole = each.obstacle.shape != "plane" and both.max() <= WHOLE * size
        yield corners if whole else np.clip(corners, low - SURROUNDINGS * size, high + SURROUNDINGS * size)


def between(position: np.ndarray, at: float) -> np.ndarray:
    """Gives positions [nodes, 3] at a frame, which need not be whole: in between along straight lines."""
    before = min(int(at), len(position) - 1)
    after = min(before + 1, len(position) - 1)
    if before == at:
        return position[before]
    share = at - before
    return (1.0 - share) * position[before] + share * position[after]


def _poses(obstacle: Obstacle, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes poses after so many steps: at constant velocity and spin from the end of one to that of the next."""
    path = np.append(obstacle.position, obstacle.rotation)[None]
    if obstacle.path is not None:
        path = np.concatenate([path, obstacle.path])
    steps = np.clip(steps, 0, len(path) - 1)
    before = steps.astype(int)
    after = np.minimum(before + 1, len(path) - 1)
    share = (steps - before)[:, None]
    position = (1.0 - share) * path[before, :3] + share * path[after, :3]
    q, r = path[before, 3:], path[after, 3:]
    cosine = (q * r).sum(axis=1, keepdims=True)
    r = np.where(cosine < 0.0, -r, r)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    sine = np.maximum(np.sin(angle), np.finfo(float).tiny)
    small = angle < 1e-6
    of_q = np.where(small, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    of_r = np.where(small, share, np.sin(share * angle) / sine)
    return position, of_q * q + of_r * r


def _turned(q: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Gives points turned by quaternions (x, y, z, w)."""
    twice = 2.0 * np.cross(q[..., :3], points)
    return points + q[..., 3:] * twice + np.cross(q[..., :3], twice)


def checked(trajectory: Trajectory) -> np.ndarray:
    """Gives the positions of a trajectory that can be drawn [frames, nodes, 3] (m), or an InputError."""
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"trajectory = {brief(trajectory)}, must be a Trajectory, such as Simulator.run returns")
    position = finite_array("trajectory.position", trajectory.position, (None, trajectory.cloth.nodes, 3))
    if not len(position):
        raise InputError("trajectory has no frame, must have at least one")
    return position


_CROSSINGS: weakref.WeakKeyDictionary[Cloth | Cloths, list[Any]] = weakref.WeakKeyDictionary()
"""Of cloths that were drawn, on the device: arguments of the kernel that finds normals, for which a film asks at every
frame."""


def contact_normals(cloth: Cloth | Cloths, position: np.ndarray) -> np.ndarray:
    """Computes unit normals from warp to weft at the crossings, 0 on the border, of positions [frames, nodes, 3]."""
    device = start.device("cpu")
    with ALONE, compiling():
        refuse_recording(device)
        kernel = build(Variant(wp.float64, True))["contact_normal"]
        if cloth not in _CROSSINGS:
            topology = cloth.topology
            kinds = {"crossing_node": int, "crossing_neighbours": wp.vec4i, "flipped": int}
            _CROSSINGS[cloth] = [wp.array(getattr(topology, k), dtype=kind, device=device) for k, kind in kinds.items()]
        positions = wp.array(position, dtype=wp.vec3d, device=device)
        normals = wp.zeros_like(positions)
        dim = len(_CROSSINGS[cloth][0])
        for frame in range(len(position)):
            wp.launch(kernel, dim=dim, inputs=[*_CROSSINGS[cloth], positions[frame], normals[frame]], device=device)
        return normals.numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scales to length 1. Where a yarn has shrunk to a point it has no direction; 0 there keeps its tube finite."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(float).tiny)
