"""Outlines of cloths: polygons in the plane of a cloth at rest, corners (u, v) in metres, and what is inside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, finite_array, integer, real

__all__ = ["disc", "rectangle"]


def disc(radius: float, *, center: Sequence[float] = (0.0, 0.0), sides: int = 128) -> np.ndarray:
    """Makes the outline of a disc.

    Args:
        radius: of its corners [m], above 0.
        center: (u, v) [m].
        sides: of the polygon, at least 3.

    Returns:
        Its corners [sides, 2] (m).
    """
    size = real("radius", radius, above=0.0)
    angle = 2.0 * np.pi * np.arange(integer("sides", sides, least=3)) / sides
    return finite_array("center", center, (2,)) + size * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def rectangle(length: float, width: float, *, angle: float = 0.0, center: Sequence[float] = (0.0, 0.0)) -> np.ndarray:
    """Makes the outline of a rectangle, or of a strip on the bias.

    Args:
        length, width: its sides [m], above 0.
        angle: from the warp yarns, which run along u, to its length [degrees]; 45 of a strip on the bias.
        center: (u, v) [m].

    Returns:
        Its corners [4, 2] (m), the first two at one end of its length, the others at the other end.
    """
    half = 0.5 * np.array([real("length", length, above=0.0), real("width", width, above=0.0)])
    turned = np.deg2rad(real("angle", angle))
    along = np.array([np.cos(turned), np.sin(turned)])
    across = np.array([-along[1], along[0]])
    signs = np.array([[-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]]) * half
    return finite_array("center", center, (2,)) + signs @ np.stack([along, across])


def checked_polygon(name: str, value: Any) -> np.ndarray:
    """Gives the corners of a polygon that does not touch itself [corners, 2], or an InputError."""
    corners = finite_array(name, value, (None, 2))
    if len(corners) < 3:
        raise InputError(f"{name} has {len(corners)} corners, must have at least 3, (u, v) each")
    if len(corners) > 3 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]  # closed already
    edges = np.roll(corners, -1, axis=0) - corners
    (short,) = np.nonzero((edges == 0.0).all(axis=1))
    if len(short):
        k = int(short[0])
        raise InputError(f"{name}[{k}] and {name}[{(k + 1) % len(corners)}] are the same corner")
    # neighbours share a corner, and may not fold back
    before = np.roll(edges, 1, axis=0)
    (folded,) = np.nonzero((_cross(before, edges) == 0.0) & ((before * edges).sum(axis=1) < 0.0))
    if len(folded):
        raise InputError(f"{name} turns back on itself at {name}[{int(folded[0])}], must enclose an area")
    meet = _touching(corners, corners)
    count = np.arange(len(corners))
    for near in (-1, 0, 1):
        meet[count, (count + near) % len(corners)] = False
    if meet.any():
        a, b = np.argwhere(meet)[0].tolist()
        raise InputError(
            f"{name} meets itself: the edges from {name}[{a}] and from {name}[{b}], must be a simple polygon"
        )
    return corners


def checked_outline(outline: Any, holes: Any, size: tuple[float, float]) -> list[np.ndarray]:
    """Checks an outline and holes in a cloth of a size (u, v) [m]: gives all polygons, the outline first."""
    polygons = [checked_polygon("outline", outline)]
    slack = tolerance(size)
    low, high = polygons[0].min(axis=0), polygons[0].max(axis=0)
    if (low < -slack).any() or (high > np.array(size) + slack).any():
        raise InputError(
            f"outline reaches from ({low[0]:g}, {low[1]:g}) to ({high[0]:g}, {high[1]:g}) m, must be inside the cloth, "
            f"from (0, 0) to ({size[0]:g}, {size[1]:g}); wy.piece weaves as much as an outline needs"
        )
    if isinstance(holes, str) or not isinstance(holes, Sequence):
        raise InputError("holes must be a list of polygons")
    for k, hole in enumerate(holes):
        name, corners = f"holes[{k}]", checked_polygon(f"holes[{k}]", hole)
        for m, other in enumerate(polygons):
            what = "outline" if m == 0 else f"holes[{m - 1}]"
            if _touching(corners, other).any():
                raise InputError(f"{name} meets {what}, must be apart from it")
            within = _contains(other, corners[:1])[0]
            around = _contains(corners, other[:1])[0]
            if m == 0 and not within:
                raise InputError(f"{name} is outside of the outline, must be inside")
            if m > 0 and (within or around):
                raise InputError(f"{name} and {what} are one within the other, must be apart")
        polygons.append(corners)
    return polygons


def tolerance(size: tuple[float, float]) -> float:
    """Computes what rounding leaves uncertain about places in a cloth of a size [m]."""
    return 1e-9 * max(size)


def inside(polygons: Sequence[np.ndarray], points: np.ndarray, slack: float) -> np.ndarray:
    """Tells which points [points, 2] are inside of the first polygon and of none of the others, or on an edge."""
    result = np.zeros(len(points), dtype=bool)
    for polygon in polygons:
        result ^= _contains(polygon, points)
    for polygon in polygons:
        result |= _distance(polygon, points) <= slack
    return result


def runs(polygons: Sequence[np.ndarray], axis: int, at: float, slack: float) -> list[tuple[float, float]]:
    """Lists where a line is inside, (begin, end) each [m].

    Args:
        polygons: the outline, and holes.
        axis: 0 of a line along u, 1 of one along v.
        at: where it is along the other axis [m].
        slack: what is nearer than that is the same [m].
    """
    found = []
    for corners in polygons:
        x, y = corners[:, axis], corners[:, 1 - axis] - at
        x_next, y_next = np.roll(x, -1), np.roll(y, -1)
        found.append(x[np.abs(y) <= slack])
        crossed = (y < 0.0) != (y_next < 0.0)
        share = y[crossed] / (y[crossed] - y_next[crossed])
        found.append(x[crossed] + share * (x_next[crossed] - x[crossed]))
    places = np.sort(np.concatenate(found))
    places = places[np.append(True, np.diff(places) > slack)] if len(places) else places
    middle = np.empty((max(len(places) - 1, 0), 2))
    middle[:, axis] = 0.5 * (places[:-1] + places[1:])
    middle[:, 1 - axis] = at
    result: list[tuple[float, float]] = []
    for k in np.flatnonzero(inside(polygons, middle, slack)).tolist():
        begin, end = float(places[k]), float(places[k + 1])
        if result and result[-1][1] == begin:
            begin = result.pop()[0]
        result.append((begin, end))
    return result


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _touching(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Tells which edges of two polygons meet [edges, edges]."""
    a0, a1 = a[:, None], np.roll(a, -1, axis=0)[:, None]
    b0, b1 = b[None], np.roll(b, -1, axis=0)[None]
    near = (np.minimum(a0, a1) <= np.maximum(b0, b1)) & (np.minimum(b0, b1) <= np.maximum(a0, a1))
    astride_b = _cross(b1 - b0, a0 - b0) * _cross(b1 - b0, a1 - b0) <= 0.0
    astride_a = _cross(a1 - a0, b0 - a0) * _cross(a1 - a0, b1 - a0) <= 0.0
    return near.all(axis=-1) & astride_a & astride_b


def _contains(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tells which points are inside of a polygon; on its edge either."""
    a, b = polygon[None], np.roll(polygon, -1, axis=0)[None]
    x, y = points[:, None, 0], points[:, None, 1]
    crossed = (a[..., 1] > y) != (b[..., 1] > y)
    rise = np.where(crossed, b[..., 1] - a[..., 1], 1.0)
    right = x < a[..., 0] + (y - a[..., 1]) / rise * (b[..., 0] - a[..., 0])
    return (crossed & right).sum(axis=1) % 2 == 1


def _distance(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Computes how far points are from the edges of a polygon."""
    a, edge = polygon[None], (np.roll(polygon, -1, axis=0) - polygon)[None]
    from_a = points[:, None] - a
    share = np.clip((from_a * edge).sum(axis=-1) / (edge * edge).sum(axis=-1), 0.0, 1.0)
    return np.linalg.norm(from_a - share[..., None] * edge, axis=-1).min(axis=1)
