"""Weaves: which yarn is on top at each crossing."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError, integer


class Weave:
    """The draft of a cloth of rows × columns crossing nodes.

    Args:
        draft: 0/1 array, rows × columns, at least 3 × 3. 1 where the crossing is flipped: the weft passes on the other
            side of the warp than at a 0. Border nodes are yarn ends, where nothing crosses: their entries count as 0.
        name: what to call it in messages and files.

    Attributes:
        flipped: the draft, with 0 on the border [rows, columns].
        draft: the draft as given, whose border pictures show [rows, columns].
    """

    def __init__(self, draft: Any, name: str = "draft"):
        try:
            array = np.asarray(draft)
            flipped = array.astype(bool)
            valid = array.ndim == 2 and bool(np.isin(array, (0, 1)).all())
        except (TypeError, ValueError):
            valid = False
        if not valid:
            raise InputError("draft must be a two-dimensional array of 0 and 1, rows × columns")
        if min(flipped.shape) < 3:
            raise InputError(
                f"a weave of {flipped.shape[0]} × {flipped.shape[1]} has no crossing inside, must be at least 3 × 3"
            )
        self.draft = flipped.copy()
        self.draft.setflags(write=False)
        self.flipped = np.zeros_like(flipped)
        self.flipped[1:-1, 1:-1] = flipped[1:-1, 1:-1]
        self.flipped.setflags(write=False)
        self.name = name

    @property
    def rows(self) -> int:
        """Number of warp yarns, which run along the columns' index."""
        return self.flipped.shape[0]

    @property
    def columns(self) -> int:
        """Number of weft yarns."""
        return self.flipped.shape[1]

    @classmethod
    def plain(cls, *, rows: int, columns: int) -> Weave:
        """Goes over one, under one."""
        j, i = _grid(rows, columns)
        return cls((i + j) % 2 == 1, "plain")

    @classmethod
    def twill(cls, *, rows: int, columns: int) -> Weave:
        """Goes over two, under two, shifted by one from row to row."""
        j, i = _grid(rows, columns)
        return cls((i + j % 4) % 4 < 2, "twill")

    @classmethod
    def satin(cls, *, rows: int, columns: int) -> Weave:
        """Goes under one, over three, the single crossings scattered."""
        j, i = _grid(rows, columns)
        r = (j - 1) % 4
        return cls((i - 1 + 3 * (r // 2) + 2 * (r % 2)) % 4 == 0, "satin")

    def __repr__(self) -> str:
        return f"Weave({self.name}, {self.rows} × {self.columns})"


def _grid(rows: int, columns: int) -> np.ndarray:
    return np.indices((integer("rows", rows, least=3), integer("columns", columns, least=3)))


WEAVES = {"plain": Weave.plain, "twill": Weave.twill, "satin": Weave.satin}
"""The paper's weaves by name (figure 5)."""
