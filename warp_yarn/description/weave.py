"""Weaves: which yarn is on top at each crossing."""

from __future__ import annotations

import importlib
import os
from typing import Any

import numpy as np

from ..errors import InputError, Named, choice, integer
from . import notation
from .fixed import Fixed

MOST_CROSSINGS = 16_000_000
"""Of a cloth: it takes some 2 kB each, and a size in mm instead of m a million times as many."""


class Weave(Fixed):
    """The draft of a cloth of rows × columns crossing nodes.

    The face of a cloth is the side where a flipped crossing has its warp yarn on top: z+ of a flat cloth, y+ of an
    upright one. Seen from there with the weft yarns counted upwards, warp yarns are counted from the right to the left.
    So the first end of weavers' drafts, which is on the left where the first pick is at the bottom, is the last row.

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
        self.name = name
        self._fix(draft=self.draft, name=name)

    @property
    def rows(self) -> int:
        """Number of warp yarns, which run along the columns' index."""
        return self.flipped.shape[0]

    @property
    def columns(self) -> int:
        """Number of weft yarns."""
        return self.flipped.shape[1]

    @classmethod
    def from_drawdown(
        cls, warp_on_top: Any, *, rows: int | None = None, columns: int | None = None, name: str = "draft"
    ) -> Weave:
        """Takes what weavers draw: the face, picks upwards, ends to the right.

        Args:
            warp_on_top: 0/1 array [picks, ends], 1 where the end is over the pick; row 0 is the first pick, column 0
                the first end.
            rows, columns: number of warp and of weft yarns, at least 3, for which it is repeated, or cut; None: as many
                as it has ends, and picks.
            name: what to call it in messages and files.
        """
        try:
            drawn = np.asarray(warp_on_top)
        except ValueError:  # ragged
            drawn = np.zeros(0)
        if drawn.ndim != 2 or not drawn.size:
            raise InputError("warp_on_top must be a two-dimensional array of 0 and 1, picks × ends")
        picks, ends = drawn.shape
        rows, columns = _counts(ends if rows is None else rows, picks if columns is None else columns)
        return cls(drawn[np.ix_(np.arange(columns) % picks, np.arange(rows) % ends)].T[::-1], name)

    @classmethod
    def from_notation(cls, text: str, *, rows: int, columns: int) -> Weave:
        """Makes a weave of the words that weavers have for it, such as "2/2 twill Z" or "satin 5/2".

        Args:
            text: the words: those of ``warp_yarn.description.notation.repeat``. A twill without a letter is a twill Z,
                which rises to the right on the face. (``Weave.twill`` and ``Weave.satin`` are the paper's.)
            rows, columns: number of warp and of weft yarns, at least 3.
        """
        return cls.from_drawdown(notation.repeat(text), rows=rows, columns=columns, name=" ".join(text.split()))

    @property
    def warp_on_top(self) -> np.ndarray:
        """The drawdown, as of ``from_drawdown`` [columns, rows], on the border too, where nothing crosses."""
        return self.draft[::-1].T

    def drawdown(self, path: str | os.PathLike) -> None:
        """Draws it as weavers do: see ``wy.write_drawdown``."""
        # by name: descriptions know nothing of what shows them, and need none of it
        importlib.import_module("warp_yarn.view.drawdown").write_drawdown(path, self)

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
    return np.indices(_counts(rows, columns))


def _counts(rows: int, columns: int) -> tuple[int, int]:
    """Gives the numbers of yarns, or an InputError before so many crossings fill the memory."""
    rows, columns = integer("rows", rows, least=3), integer("columns", columns, least=3)
    if rows * columns > MOST_CROSSINGS:
        many = f"{rows * columns:.3g} crossings, must be at most {MOST_CROSSINGS}: sizes are in metres"
        raise InputError(f"rows = {rows}, columns = {columns} make {many}")
    return rows, columns


WEAVES = Named("weave", {"plain": Weave.plain, "twill": Weave.twill, "satin": Weave.satin})
"""The paper's weaves by name (figure 5)."""


def woven(weave: Any, *, rows: int, columns: int) -> Weave:
    """Makes a weave of what a fabric may be asked for: one of ``WEAVES``, words of ``Weave.from_notation``, or a Weave.

    Raises:
        InputError: it is none of these, or a Weave of other numbers of yarns; more crossings than a cloth may have.
    """
    if isinstance(weave, Weave):
        if (weave.rows, weave.columns) != (rows, columns):
            raise InputError(
                f"weave = {weave!r}: rows = {rows}, columns = {columns} must be the same, such as by rows=weave.rows, "
                "columns=weave.columns"
            )
        return weave
    if isinstance(weave, str) and any(character.isdigit() for character in weave):
        return Weave.from_notation(weave, rows=rows, columns=columns)
    try:
        make = WEAVES[choice("weave", weave, WEAVES)]
    except InputError as error:
        raise InputError(f'{error}, or words such as "2/2 twill Z" and "satin 5/2", or a Weave') from None
    return make(rows=rows, columns=columns)
