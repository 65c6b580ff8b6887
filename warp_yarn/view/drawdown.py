"""Drafts and weaves as weavers draw them, as PNG files."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

from ..description.draft import Draft
from ..description.weave import Weave
from ..errors import InputError, integer
from ..io.files import atomic_write

LARGEST = 1600
"""Pixels that a picture has at most, along its longer side, where squares are as large as fit."""

MOST_PIXELS = 25_000_000

SQUARE = 20
"""Pixels of a square, at most, where they are as large as fit."""

PAPER, INK, LINE, BORDER = (255, 255, 255), (20, 20, 20), (150, 150, 150), (225, 225, 225)

Squares = np.ndarray
"""Colours of squares [rows, columns, 3], the top row first."""


def write_drawdown(path: str | os.PathLike, drawn: Draft | Weave, *, square: int | None = None) -> None:
    """Draws a weave, or a draft, on squared paper: the face of the cloth, the first pick at the bottom and the first
    end at the left. Turned by half a turn it is as programs for handweavers have it, the first pick at the top and the
    first end at the right.

    Of a weave: black where the warp is on top, white where the weft is, grey on the border, where nothing crosses. Of a
    draft: the drawdown in the colours of its threads, if it has any, or else black where the warp is on top; above it
    the threading, the first shaft at the bottom; at its right the treadling, or the liftplan, the first treadle or
    shaft at the left; in the corner the tie-up; and the threads' colours along the outer edges.

    Args:
        path: ending in .png. The file appears whole or not at all.
        drawn: the Weave or the Draft.
        square: pixels of a square, from 1 to 64, from 4 on with lines between them; None: up to 20, as many as fit into
            1600.

    Raises:
        InputError: an argument is out of its range, the picture had more than 25 million pixels, or the folder of
            `path` does not exist.
    """
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"path = {str(path)!r}, must end in .png")
    if isinstance(drawn, Weave):
        squares = _inked(drawn.warp_on_top)
        squares[[0, -1]] = squares[:, [0, -1]] = BORDER
        paper = np.ones(squares.shape[:2], dtype=bool)
    elif isinstance(drawn, Draft):
        squares, paper = _draft(drawn)
    else:
        raise InputError(f"drawn = {drawn!r}, must be a Draft or a Weave")
    longer = max(squares.shape[:2])
    size = max(1, min(SQUARE, LARGEST // longer)) if square is None else integer("square", square, least=1, most=64)
    if squares.shape[0] * squares.shape[1] * size**2 > MOST_PIXELS:
        raise InputError(
            f"a picture of {squares.shape[1]} × {squares.shape[0]} squares of {size} pixels, must be at most "
            f"{MOST_PIXELS} pixels"
        )
    pixels = _ruled(squares[::-1], paper[::-1], size)
    with atomic_write(path) as temporary:
        temporary.write_bytes(_png(pixels))


def _draft(draft: Draft) -> tuple[Squares, np.ndarray]:
    """Puts the parts of a draft together, the bottom row first, and says which squares are there [rows, columns]."""
    threading: np.ndarray = np.zeros((draft.shafts, draft.ends), dtype=bool)
    for end, shafts in enumerate(draft.threading):
        threading[[shaft - 1 for shaft in shafts], end] = True
    if draft.tieup is None:
        right, corner = draft.moved, np.zeros((0, 0), dtype=bool)
    else:
        right = np.zeros((draft.picks, len(draft.tieup)), dtype=bool)
        for pick, treadles in enumerate(draft.treadling):
            right[pick, [treadle - 1 for treadle in treadles]] = True
        corner = np.zeros((draft.shafts, len(draft.tieup)), dtype=bool)
        for treadle, shafts in enumerate(draft.tieup):
            corner[[shaft - 1 for shaft in shafts], treadle] = True
    drawdown = _inked(draft.warp_on_top)
    colored = draft.warp_colors is not None and draft.weft_colors is not None
    if colored:
        warp, weft = (np.round(255.0 * np.asarray(c)).astype(np.uint8) for c in (draft.warp_colors, draft.weft_colors))
        drawdown = np.where(draft.warp_on_top[..., None], warp[None], weft[:, None])
    # an empty row and column between the parts
    up, over = draft.picks + 1, draft.ends + 1
    shape = (up + draft.shafts + 2 * colored, over + right.shape[1] + 2 * colored)
    squares = np.full((*shape, 3), PAPER, dtype=np.uint8)
    paper: np.ndarray = np.zeros(shape, dtype=bool)

    def put(part: Squares, row: int, column: int) -> None:
        place = np.s_[row : row + len(part), column : column + part.shape[1]]
        squares[place], paper[place] = part, True

    put(drawdown, 0, 0)
    put(_inked(threading), up, 0)
    put(_inked(right), 0, over)
    put(_inked(corner), up, over)
    if colored:
        put(warp[None], shape[0] - 1, 0)
        put(weft[:, None], 0, shape[1] - 1)
    return squares, paper


def _inked(marks: np.ndarray) -> Squares:
    return np.where(marks[..., None], np.array(INK, dtype=np.uint8), np.array(PAPER, dtype=np.uint8))


def _ruled(squares: Squares, paper: np.ndarray, size: int) -> np.ndarray:
    """Draws squares of so many pixels, with lines around those that are there if there is room."""
    pixels = squares.repeat(size, axis=0).repeat(size, axis=1)
    if size < 4:
        return pixels
    pixels = np.pad(pixels, ((0, 1), (0, 1), (0, 0)), constant_values=255)
    above = np.pad(paper, ((0, 1), (0, 0))) | np.pad(paper, ((1, 0), (0, 0)))
    left = np.pad(paper, ((0, 0), (0, 1))) | np.pad(paper, ((0, 0), (1, 0)))
    lines = np.zeros(pixels.shape[:2], dtype=bool)
    lines[::size, :-1] |= above.repeat(size, axis=1)
    lines[:-1, ::size] |= left.repeat(size, axis=0)
    # the last pixel of a corner at the bottom right
    lines[-1, -1] = lines[-2, -1]
    pixels[lines] = LINE
    return pixels


def _png(pixels: np.ndarray) -> bytes:
    """Makes a PNG file of red, green and blue [height, width, 3]."""
    height, width, _ = pixels.shape
    lines = np.pad(pixels.reshape(height, -1), ((0, 0), (1, 0)))  # each begins with a 0: not filtered

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
