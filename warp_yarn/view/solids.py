"""Obstacles as triangles."""

from __future__ import annotations

import numpy as np

from ..description.obstacles import TriangleMesh
from .geometry import Placed, unit

ROUND = 96
"""Facets around what is round."""
SHARP = 0.8
"""Cosine of the angle to its neighbours from which a face of a mesh has an edge."""


def solid(placed: Placed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Makes an obstacle in its own frame.

    Returns:
        Vertices [vertices, 3] (m), unit normals there, and faces [faces, 3], counter-clockwise seen from outside.
    """
    obstacle = placed.obstacle
    if isinstance(obstacle, TriangleMesh):
        return _mesh(obstacle.vertices, obstacle.faces)
    if obstacle.shape == "plane":
        return _sides(placed.corners()[[0, 2, 1, 3]][None], np.array([[0.0, 0.0, 1.0]]))
    if obstacle.shape == "box":
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        right = np.roll(axes, 1, axis=1)
        up = np.cross(axes, right)
        corners = [axes + i * right + j * up for i, j in ((-1, -1), (1, -1), (-1, 1), (1, 1))]
        return _sides(np.stack(corners, axis=1) * obstacle.size, axes)
    quarter = np.linspace(0.0, 0.5 * np.pi, ROUND // 4 + 1)
    if obstacle.shape == "sphere":
        angle = np.concatenate([-quarter[::-1], quarter[1:]])
        way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return _revolved(obstacle.size[0] * way, way)
    half, radius, _ = obstacle.size
    if obstacle.shape == "cylinder":
        rim = np.array([[0.0, half], [radius, half]])
        top = np.concatenate([rim, rim[1:]])
        out = np.array([[0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    else:
        out = np.stack([np.cos(quarter), np.sin(quarter)], axis=1)[::-1]
        top = radius * out + [0.0, half]
    mirror = [1.0, -1.0]
    return _revolved(np.concatenate([(top * mirror), top[::-1]]), np.concatenate([out * mirror, out[::-1]]))


def _sides(corners: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Makes rectangles [rectangles, 4, 3] of their corners: the first, to the right, above it, and the last."""
    faces = 4 * np.arange(len(corners))[:, None, None] + np.array([[0, 1, 3], [0, 3, 2]])
    return corners.reshape(-1, 3), np.repeat(normals, 4, axis=0), faces.reshape(-1, 3)


def _revolved(profile: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turns a profile about z, [points, 2] (radius, z) (m), from below to above."""
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def turned(points: np.ndarray) -> np.ndarray:
        flat = points[:, None, :1] * circle
        return np.concatenate([flat, np.broadcast_to(points[:, None, 1:], (*flat.shape[:2], 1))], axis=2).reshape(-1, 3)

    ring = (ROUND * np.arange(len(profile) - 1))[:, None] + np.arange(ROUND)
    this, following = ring, np.roll(ring, -1, axis=1)
    faces = [[this, following, following + ROUND], [this, following + ROUND, this + ROUND]]
    return turned(profile), turned(normals), np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in faces])


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gives every face vertices of its own, with normals that are smooth but at sharp edges."""
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = np.zeros_like(vertices)
    np.add.at(around, faces, area[:, None])
    smooth, flat = unit(around)[faces], np.broadcast_to(unit(area)[:, None], corners.shape)
    normals = np.where((smooth * flat).sum(axis=2, keepdims=True) > SHARP, smooth, flat)
    return corners.reshape(-1, 3), normals.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
