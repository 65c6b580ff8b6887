"""What a trajectory looks like: every yarn a smooth curve over and under the others, and a tube around it.

At a crossing a warp yarn passes at x − R n and a weft yarn at x + R n, n the contact normal from warp to weft. On the
border there is no normal and no offset. Between these points runs the Catmull-Rom spline through them.
"""

from __future__ import annotations

import dataclasses
import weakref
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

BACK = np.array([-1.0, -1.0, -1.0, 1.0])
"""Times a quaternion (x, y, z, w): what turns back."""

CATMULL_ROM = 0.5 * np.array(
    [[0.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [2.0, -5.0, 4.0, -1.0], [-1.0, 3.0, -3.0, 1.0]]
)
"""Weights of four consecutive points by powers of t; the curve runs from the second (t = 0) to the third (t = 1)."""


@dataclasses.dataclass(frozen=True)
class Strands:
    """All yarns of one material."""

    material: int
    """Index into the cloth's yarns."""
    color: tuple[float, float, float]
    """Red, green, blue from 0 to 1, sRGB."""
    counts: np.ndarray
    """[yarns]: points of each yarn."""
    points: np.ndarray
    """[frames, sum of counts, 3]: where the yarns pass at their nodes, yarn after yarn [m]."""

    @property
    def repeated(self) -> np.ndarray:
        """For each control point its index in points: those of a yarn in order, the first and the last twice."""
        times = np.ones(self.counts.sum(), dtype=int)
        ends = self.counts.cumsum()
        np.add.at(times, ends - self.counts, 1)
        np.add.at(times, ends - 1, 1)
        return np.repeat(np.arange(len(times)), times)

    def sampled(self, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Finds points on the curves, `samples` a segment and the last end.

        Returns:
            The number of points of each yarn [yarns], the points [frames, sum, 3] (m), unit tangents there.
        """
        counts = (self.counts - 1) * samples + 1
        first = np.repeat(self.counts.cumsum() - self.counts, counts)
        last = np.repeat(self.counts.cumsum() - 1, counts)
        along = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
        segment = np.minimum(first + along // samples, last - 1)
        t = (along - (segment - first) * samples) / samples
        one = np.ones_like(t)
        weights = np.stack([one, t, t**2, t**3], axis=1) @ CATMULL_ROM
        slopes = np.stack([0 * one, one, 2 * t, 3 * t**2], axis=1) @ CATMULL_ROM
        centres = np.zeros((len(self.points), len(t), 3))
        tangents = np.zeros_like(centres)
        for k in range(4):
            points = self.points[:, np.clip(segment + k - 1, first, last)]
            centres += weights[:, k, None] * points
            tangents += slopes[:, k, None] * points
        return counts, centres, _unit(tangents)


@dataclasses.dataclass(frozen=True)
class Tubes:
    """Tubes around strands: rings of vertices along each yarn, and a flat cap at each end."""

    centres: np.ndarray
    """[frames, rings, 3] (m)."""
    across: np.ndarray
    """[frames, rings, 2, 3]: two unit vectors that span each ring; with the yarn's direction they are right-handed."""
    counts: np.ndarray
    """[yarns]: rings of each yarn."""
    radius: float
    sides: int

    @classmethod
    def around(cls, strands: Strands, radius: float, *, sides: int, samples: int, before: Tubes | None = None) -> Tubes:
        """Makes tubes with `samples` rings a segment; rings do not twist, along the yarn or from frame to frame, nor
        from the last frame of those before."""
        counts, centres, tangents = strands.sampled(samples)
        start = counts.cumsum() - counts
        first = np.empty_like(tangents)
        # Any start at a right angle will do for frame 0. Later frames follow it: chosen anew, rings would jump.
        if before is None:
            axis = np.eye(3)[np.abs(tangents[0, start]).argmin(axis=1)]
            first[0, start] = _unit(np.cross(tangents[0, start], axis))
        else:
            one, other = before.across[-1, start].swapaxes(0, 1)
            first[0, start] = _transported(one, np.cross(one, other), tangents[0, start])
        for frame in range(1, len(first)):
            first[frame, start] = _transported(
                first[frame - 1, start], tangents[frame - 1, start], tangents[frame, start]
            )
        for k in range(1, counts.max()):
            i = start[counts > k] + k
            first[:, i] = _transported(first[:, i - 1], tangents[:, i - 1], tangents[:, i])
        return cls(centres, np.stack([first, np.cross(tangents, first)], axis=2), counts, radius, sides)

    def normals(self, frame: int) -> np.ndarray:
        """Finds unit vectors out of the yarn at every vertex of one frame [rings · sides, 3], ring after ring."""
        angle = 2.0 * np.pi * np.arange(self.sides) / self.sides
        return (np.stack([np.cos(angle), np.sin(angle)], axis=1) @ self.across[frame]).reshape(-1, 3)

    def vertices(self, frame: int) -> np.ndarray:
        """Finds the vertices of one frame [rings · sides, 3] (m)."""
        return np.repeat(self.centres[frame], self.sides, axis=0) + self.radius * self.normals(frame)

    def faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Lists the number of corners of each face, and the vertices at them, counter-clockwise seen from outside."""
        side = np.arange(self.sides)
        end = self.counts.cumsum()
        ring = np.delete(np.arange(end[-1]), end - 1)[:, None] * self.sides
        this, following = ring + side, ring + np.roll(side, -1)
        quads = np.stack([this, following, following + self.sides, this + self.sides], axis=2)
        caps = np.stack(
            [(end - self.counts)[:, None] * self.sides + side[::-1], (end - 1)[:, None] * self.sides + side]
        )
        corners = np.repeat([4, self.sides], [quads.shape[0] * self.sides, 2 * len(end)])
        return corners, np.concatenate([quads.ravel(), caps.ravel()])


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
    points = trajectory.position
    result = []
    for obstacle in trajectory.scene.obstacles:
        position, rotation = _poses(obstacle, trajectory.start + trajectory.every * at)
        width = length = 0.0
        if obstacle.shape == "plane":
            # a rectangle of its own, which moves as it does, under all of the cloth at all times
            local = _turned(rotation[:, None] * BACK, points - position[:, None])[..., :2]
            low, high = local.min(axis=(0, 1)), local.max(axis=(0, 1))
            width, length = (high - low + 2.0 * PLANE_MARGIN * (high - low).max()).tolist()
            position = position + _turned(rotation, np.append(0.5 * (low + high), 0.0))
        result.append(Placed(obstacle, position, rotation, width, length))
    return result


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


def strands(trajectory: Trajectory) -> list[Strands]:
    """Lists the yarns of every material that the cloth uses, at every frame."""
    position = checked(trajectory)
    cloth = trajectory.cloth
    offset = cloth.radius * contact_normals(cloth, position)
    result = []
    for k, nodes, counts, side in _layout(cloth):
        points = position[:, nodes] + side[:, None] * offset[:, nodes]
        result.append(Strands(k, cloth.yarns[k].color or PALETTE[k % len(PALETTE)], counts, points))
    return result


_LAYOUTS: weakref.WeakKeyDictionary[Cloth | Cloths, list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]] = (
    weakref.WeakKeyDictionary()
)
"""Of cloths that were drawn: a film asks for every frame."""
_CROSSINGS: weakref.WeakKeyDictionary[Cloth | Cloths, list[Any]] = weakref.WeakKeyDictionary()
"""Of the same cloths, on the device: arguments of the kernel that finds normals."""


def _layout(cloth: Cloth | Cloths) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Lists the yarns of every material: its number, their nodes one after the other, how many each has, and on which
    side of each node the yarn is."""
    if cloth in _LAYOUTS:
        return _LAYOUTS[cloth]
    topology = cloth.topology
    order = np.argsort(topology.segment_yarn, kind="stable")
    segments = topology.segment_nodes[order]
    starts = np.flatnonzero(np.diff(topology.segment_yarn[order], prepend=-1))
    yarns = [np.append(run[:, 0], run[-1, 1]) for run in np.split(segments, starts[1:])]
    result = []
    for k in np.unique(cloth.material).tolist():
        mine = np.flatnonzero(cloth.material == k)
        nodes = np.concatenate([yarns[y] for y in mine])
        counts = np.array([len(yarns[y]) for y in mine])
        result.append((k, nodes, counts, np.repeat(2.0 * topology.yarn_direction[mine] - 1.0, counts)))
    _LAYOUTS[cloth] = result
    return result


def checked(trajectory: Trajectory) -> np.ndarray:
    """Gives the positions of a trajectory that can be drawn [frames, nodes, 3] (m), or an InputError."""
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"trajectory = {brief(trajectory)}, must be a Trajectory, such as Simulator.run returns")
    position = finite_array("trajectory.position", trajectory.position, (None, trajectory.cloth.nodes, 3))
    if not len(position):
        raise InputError("trajectory has no frame, must have at least one")
    return position


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


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Scales to length 1. Where a yarn has shrunk to a point it has no direction; 0 there keeps its tube finite."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(float).tiny)


def _transported(vectors: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Carries unit vectors at right angles to `before`, by the smallest rotation that takes `before` to `after`."""
    along = (vectors * after).sum(axis=-1, keepdims=True)
    fold = 1.0 + (before * after).sum(axis=-1, keepdims=True)
    moved = vectors - (before + after) * (along / np.maximum(fold, 1e-12))
    # Rounding adds up over hundreds of rings and frames, and a yarn folded flat has no smallest rotation.
    return _unit(moved - after * (moved * after).sum(axis=-1, keepdims=True))
