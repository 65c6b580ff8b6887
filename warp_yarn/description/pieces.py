"""Pieces of cloth: as much of a fabric as an outline needs, cut to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import InputError, integer
from .cloth import Cloth
from .outline import checked_polygon


def piece(
    fabric: Callable[..., Cloth], outline: Any, holes: Sequence[Any] = (), *, coarsened: int = 1, **options: Any
) -> Cloth:
    """Weaves as much of a fabric as an outline needs, and cuts it.

    Args:
        fabric: a function of rows and columns that makes a cloth with one distance between its warp and one between its
            weft yarns, such as ``wy.fabrics.cotton``.
        outline: the corners of a polygon (u, v) [n, 2] (m), anywhere in the plane, such as ``wy.outline.disc(0.1)``. In
            the pose "upright", which is the default, v points down: what was drawn with v up hangs upside down, unless
            (u, −v) is given. With ``pose="flat"`` u is x and v is y.
        holes: polygons in it.
        coarsened: n, yarns to one: ``Cloth.coarsened``.
        options: of the fabric.

    Returns:
        The cloth; the middle of its outline's bounds is at ``cloth.middle``.

    Raises:
        InputError: as of ``Cloth.cut``.
    """
    if not callable(fabric):
        raise InputError(
            f"fabric = {fabric!r}, must be a function that makes a Cloth, such as wy.fabrics.denim, not called"
        )
    for name in sorted({"rows", "columns", "size"} & set(options)):
        raise InputError(f"{name} = {options[name]!r}: a piece is as large as its outline needs, must be left out")
    corners = checked_polygon("outline", outline)
    low, high = corners.min(axis=0), corners.max(axis=0)
    sample = fabric(rows=3, columns=3, **options)
    if not isinstance(sample, Cloth):
        raise InputError(f"fabric = {fabric!r}, must be a function of rows and columns that makes a Cloth")
    warp, weft = sample.spacing if isinstance(sample.spacing, tuple) else (sample.spacing, sample.spacing)
    if np.ndim(warp) or np.ndim(weft):
        raise InputError("fabric has yarns at several distances, must have one: cut a cloth of it by Cloth.cut")
    n = integer("coarsened", coarsened, least=1)
    # what is a hair too far apart for rounding alone is no yarn more
    needed = np.ceil((high - low) / np.array([n * weft, n * warp]) * (1.0 - 1e-12)).astype(int)
    columns, rows = (n * np.maximum(needed, 2) + 1).tolist()
    cloth = fabric(rows=rows, columns=columns, **options).coarsened(n)
    # in the middle of what is woven, that both sides of a symmetric piece are alike
    shift = cloth.middle - 0.5 * (low + high)
    moved = [checked_polygon(f"holes[{k}]", hole) + shift for k, hole in enumerate(holes)]
    return cloth.cut(corners + shift, moved)
