"""A small picture of the task of the box, drawn by NumPy alone: from the side above, from the top below."""

from __future__ import annotations

import numpy as np

from . import box

WIDTH, SIDE, TOP = 320, 160, 192
"""Pixels of the picture: its width, and the heights of both views."""
SCALE = 2000.0
"""Pixels a metre."""
LEFT, HIGHEST = -40e-3, 45e-3
"""x at the left edge, z at the upper edge [m]."""
BACKGROUND, TABLE, WALLS = (245, 245, 245), (160, 130, 100), (110, 120, 140)
FLOOR, YARN = (200, 200, 205), (200, 40, 40)
DOTS = 12
"""Along a yarn from node to node."""


def picture(position: np.ndarray, columns: int, place: np.ndarray) -> np.ndarray:
    """Draws nodes [nodes, 3], the yarns between them, and the box at a place; uint8 [height, width, 3]."""
    result = np.full((SIDE + TOP, WIDTH, 3), BACKGROUND, dtype=np.uint8)
    # of a view: its upper edge, how many rows above it, and the axis that it shows upwards
    for first, rows, axis, highest in ((0, SIDE, 2, HIGHEST), (SIDE, TOP, 1, 0.5 * TOP / SCALE)):
        view = result[first : first + rows]
        if axis == 2:
            _fill(view, FLOOR, highest, (LEFT, LEFT + WIDTH / SCALE), (-1.0, box.BOTTOM))
        else:
            view[:] = FLOOR
        table, _, *walls = box.obstacles(place)
        # from the side, through the wall in front
        for obstacle, color in ((table, TABLE), *((wall, WALLS) for wall in walls[: 2 if axis == 2 else 4])):
            low, high = obstacle.position - obstacle.size, obstacle.position + obstacle.size
            _fill(view, color, highest, (low[0], high[0]), (low[axis], high[axis]))
        points = _yarns(position, columns)
        row = np.floor((highest - points[:, axis]) * SCALE).astype(int)
        column = np.floor((points[:, 0] - LEFT) * SCALE).astype(int)
        seen = (row >= 0) & (row < rows) & (column >= 0) & (column < WIDTH)
        view[row[seen], column[seen]] = YARN
    return result


def _yarns(position: np.ndarray, columns: int) -> np.ndarray:
    """Lists points of all yarns [points, 3]."""
    grid = position.reshape(-1, columns, 3)
    part = np.linspace(0.0, 1.0, DOTS)[:, None, None, None]
    along = [a + part * (b - a) for a, b in ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:]))]
    return np.concatenate([points.reshape(-1, 3) for points in along])


def _fill(
    view: np.ndarray, color: tuple[int, ...], highest: float, x: tuple[float, float], y: tuple[float, float]
) -> None:
    """Fills a rectangle."""
    left, right = (int(np.clip(round((value - LEFT) * SCALE), 0, WIDTH)) for value in x)
    bottom, top = (int(np.clip(round((highest - value) * SCALE), 0, len(view))) for value in y)
    view[top:bottom, left:right] = color
