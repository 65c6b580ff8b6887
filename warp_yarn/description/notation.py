"""Weaves by the words that weavers have for them: "2/2 twill Z", "satin 5/2", "warp rib 2/2"."""

from __future__ import annotations

import math
import re

import numpy as np

from ..errors import InputError

MOST = 1000
"""Yarns of a repeat."""

FORMS = (
    '"plain"; "2/2 twill", "3/1 twill S", "3/2/1/2 twill Z"; "satin 5/2", "sateen 5/2"; "warp rib 2/2", "weft rib 2/2";'
    ' "panama 2/2"; "2/2 herringbone", "2/2 herringbone 12"'
)

SYNONYMS = {
    "tabby": "plain",
    "basket": "panama",
    "hopsack": "panama",
    "matt": "panama",
    "warp satin": "satin",
    "weft satin": "sateen",
    "z twill": "twill z",
    "s twill": "twill s",
    "z herringbone": "herringbone z",
    "s herringbone": "herringbone s",
}


def repeat(text: str) -> np.ndarray:
    """Finds the smallest repeat of a weave in words.

    Figures are floats by turns, of the warp over and under the weft: 3/1 is warp over three, under one; of a twill,
    along its first pick from the left.

    - plain: 1/1.
    - twill: the pattern moves by one end from pick to pick, in a twill Z (without a letter, too) to the right, in a
      twill S to the left, where the first pick is at the bottom and the first end at the left.
    - satin n/s: n ends; from one end to the next, where it is under the weft rises by s picks. sateen n/s: where it is
      over the weft.
    - warp rib a/b: neighbouring ends are opposite, floats run along the warp and ribs across; weft rib a/b:
      neighbouring picks are opposite.
    - panama a/b: both; plain weave of groups of yarns. Also called basket, hopsack and matt.
    - herringbone: a twill that turns after so many ends (the number at the end; twice its repeat without one), where an
      end and its neighbour are opposite all along. Its floats over and under must be the same, as of 2/2.

    Args:
        text: the words, in either order, capitals or not.

    Returns:
        The repeat [picks, ends], True where warp is on top; row 0 is the first pick, column 0 the first end.

    Raises:
        InputError: the words are none of these, or the numbers make no such weave.
    """
    if not isinstance(text, str):
        raise InputError(f"weave = {text!r}, must be words such as {FORMS}")
    figures = re.findall(r"\d+(?:\s*/\s*\d+)+", text)
    rest = re.sub(r"\d+(?:\s*/\s*\d+)+", " ", text)
    lone = re.findall(r"\d+", rest)
    words = " ".join(re.sub(r"\d+", " ", rest).lower().replace("weave", " ").split())
    kind, _, direction = SYNONYMS.get(words, words).partition(" ")
    if kind in ("warp", "weft") and direction == "rib":
        kind, direction = f"{kind} rib", ""
    make = _KINDS.get(kind)
    turning = kind == "herringbone"
    takes_direction = turning or kind == "twill"
    if (
        make is None
        or len(figures) != (kind != "plain")
        or len(lone) > turning
        or direction not in (("", "z", "s") if takes_direction else ("",))
    ):
        raise InputError(f"weave = {text!r}, must be words such as {FORMS}")
    numbers = [int(figure) for figure in re.findall(r"\d{1,9}", figures[0])] if figures else [1, 1]
    if min(numbers) < 1 or sum(numbers) > MOST:
        raise InputError(f"weave = {text!r}: its numbers must be at least 1, and {MOST} at most all together")
    try:
        result = make(numbers, int(lone[0][:9]) if lone else 0)
    except InputError as error:
        raise InputError(f"weave = {text!r}: {error}") from None
    return result[-np.arange(len(result))] if direction == "s" else result  # the first pick is the same


def _floats(numbers: list[int]) -> np.ndarray:
    """Makes one yarn: over so many, under so many, and so on."""
    if len(numbers) % 2:
        raise InputError("its figures must be over and under by turns, an even number of them, such as 2/2 or 3/2/1/2")
    return np.repeat(np.arange(len(numbers)) % 2 == 0, numbers)


def _twill(numbers: list[int], _: int) -> np.ndarray:
    row = _floats(numbers)
    return np.stack([np.roll(row, pick) for pick in range(len(row))])


def _satin(numbers: list[int], _: int) -> np.ndarray:
    if len(numbers) != 2:
        raise InputError("must have two figures, ends and step, such as satin 5/2")
    ends, step = numbers
    steps = [s for s in range(2, ends - 1) if math.gcd(s, ends) == 1]
    if not steps:
        raise InputError(f"there is no satin of {ends} ends: must be 5, or 7 and more")
    if step not in steps:
        raise InputError(f"the step of {ends} ends must be one of {', '.join(map(str, steps))}")
    result: np.ndarray = np.ones((ends, ends), dtype=bool)
    end = np.arange(ends)
    result[step * end % ends, end] = False
    return result


def _warp_rib(numbers: list[int], _: int) -> np.ndarray:
    return np.not_equal.outer(_floats(numbers), [False, True])


def _panama(numbers: list[int], _: int) -> np.ndarray:
    return np.equal.outer(_floats(numbers), _floats(numbers))


def _herringbone(numbers: list[int], ends: int) -> np.ndarray:
    first = _twill(numbers, 0)
    half = len(first) // 2
    if (np.roll(first, half, axis=0) == first).any():
        raise InputError("its floats over and under must be the same, such as 2/2 or 3/3")
    ends = ends or 2 * len(first)
    if not 2 <= ends <= MOST:
        raise InputError(f"it must turn after 2 to {MOST} ends")
    end, pick = np.arange(2 * ends), np.arange(len(first))
    # the ends of the second half are those of the first from the last to the first, each its opposite
    shift = np.where(end < ends, end, 2 * ends - 1 - end + half)
    return first[(pick[:, None] - shift) % len(first), 0]


_KINDS = {
    "plain": _twill,
    "twill": _twill,
    "satin": _satin,
    "sateen": lambda numbers, _: ~_satin(numbers, 0),
    "warp rib": _warp_rib,
    "weft rib": lambda numbers, _: _warp_rib(numbers, 0).T,
    "panama": _panama,
    "herringbone": _herringbone,
}
