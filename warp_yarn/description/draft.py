"""Weavers' drafts: how a loom is set up and moved, and the yarns that it weaves with."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, finite_array, flag, integer
from .cloth import Cloth
from .fixed import Replaceable, says_why
from .weave import MOST_CROSSINGS, Weave
from .woven import OF_CROSSINGS

MOST_THREADS = 10_000
"""Ends, picks, shafts and treadles."""

OF_THREADS = ("colors", "spacing", "thickness")
"""What may be known of each end and pick."""

Groups = Sequence[Sequence[int]]
"""Of each end its shafts, and the like; counted from 1, as weavers do."""


@says_why
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Draft(Replaceable):
    """What a loom weaves. Ends, picks, shafts and treadles count from 1 in what it is made of.

    Args:
        threading: the shafts of each end, none to several, but not none of all.
        treadling: the treadles of each pick; without a tie-up, the shafts (a liftplan).
        tieup: the shafts of each treadle; None: there is a liftplan.
        rising: whether shafts rise that are trodden; else they sink, and the rest are up.
        warp_colors, weft_colors: red, green, blue from 0 to 1 [ends, 3] and [picks, 3]; None: not known.
        warp_spacing, weft_spacing: the width that each end and pick takes up [m], at least 0; None: not known. In files
            of many programs it is what the program begins with, and no fabric's sett.
        warp_thickness, weft_thickness: of each end and pick [m], at least 0; None: not known.
        name: of one line.

    Raises:
        InputError: numbers that are out of range, or more than 10 000 threads or 16 million squares.
    """

    threading: Groups
    treadling: Groups
    tieup: Groups | None = None
    rising: bool = True
    warp_colors: np.ndarray | None = None
    weft_colors: np.ndarray | None = None
    warp_spacing: np.ndarray | None = None
    weft_spacing: np.ndarray | None = None
    warp_thickness: np.ndarray | None = None
    weft_thickness: np.ndarray | None = None
    name: str = "draft"

    def __post_init__(self) -> None:
        keep = functools.partial(object.__setattr__, self)  # frozen
        keep("threading", _groups("threading", self.threading, MOST_THREADS))
        if not any(self.threading):
            raise InputError("threading has no end on any shaft, must have at least one")
        if self.tieup is not None:
            keep("tieup", _groups("tieup", self.tieup, MOST_THREADS, least=0))
        treadles = MOST_THREADS if self.tieup is None else len(self.tieup)
        keep("treadling", _groups("treadling", self.treadling, treadles))
        keep("rising", flag("rising", self.rising))
        for squares, what in ((self.ends, "ends"), (self.shafts, "shafts")):
            if self.picks * squares > MOST_CROSSINGS:
                raise InputError(f"{self.picks} picks × {squares} {what}, must be at most {MOST_CROSSINGS} squares")
        for thread, count in (("warp", self.ends), ("weft", self.picks)):
            for kind in OF_THREADS:
                keep(f"{thread}_{kind}", _of_threads(f"{thread}_{kind}", getattr(self, f"{thread}_{kind}"), count))
        readable = "".join(character if character.isprintable() else " " for character in str(self.name))
        keep("name", " ".join(readable.split()) or "draft")

    @classmethod
    def from_weave(cls, weave: Weave) -> Draft:
        """Finds a loom for a weave: ends that move alike are on one shaft, picks that are alike have one treadle.

        It has the border of the weave as that was given, though nothing crosses there.
        """
        if not isinstance(weave, Weave):
            raise InputError(f"weave = {weave!r}, must be a Weave")
        drawn = weave.warp_on_top
        shaft, threading = _first_of_a_kind(drawn.T)
        treadle, treadling = _first_of_a_kind(drawn)
        tieup = [(np.flatnonzero(drawn[pick, shaft]) + 1).tolist() for pick in treadle]
        return cls(threading=threading, treadling=treadling, tieup=tieup, name=weave.name)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Draft):
            return NotImplemented
        for field in dataclasses.fields(self):
            mine, its = getattr(self, field.name), getattr(other, field.name)
            arrays = isinstance(mine, np.ndarray) and isinstance(its, np.ndarray)
            if not (np.array_equal(mine, its) if arrays else type(mine) is type(its) and mine == its):
                return False
        return True

    __hash__ = None  # type: ignore[assignment]  # of arrays

    def __repr__(self) -> str:
        return f"Draft({self.name}, {self.ends} ends, {self.picks} picks, {self.shafts} shafts)"

    @property
    def ends(self) -> int:
        """Number of warp yarns."""
        return len(self.threading)

    @property
    def picks(self) -> int:
        """Number of weft yarns."""
        return len(self.treadling)

    @functools.cached_property
    def shafts(self) -> int:
        """The highest shaft that there is."""
        moved = self.treadling if self.tieup is None else self.tieup
        return max((group[-1] for group in (*self.threading, *moved) if group), default=0)

    @functools.cached_property
    def moved(self) -> np.ndarray:
        """The liftplan [picks, shafts]: True where a shaft rises (or sinks), column 0 the first shaft."""
        result: np.ndarray = np.zeros((self.picks, self.shafts), dtype=bool)
        if self.tieup is None:
            for pick, shafts in enumerate(self.treadling):
                result[pick, [shaft - 1 for shaft in shafts]] = True
            return result
        tied = [sum(1 << (shaft - 1) for shaft in shafts) for shafts in self.tieup]
        size = (self.shafts + 7) // 8
        for pick, treadles in enumerate(self.treadling):
            together = functools.reduce(int.__or__, (tied[treadle - 1] for treadle in treadles), 0)
            bits = np.frombuffer(together.to_bytes(size, "little"), dtype=np.uint8)
            result[pick] = np.unpackbits(bits, count=self.shafts, bitorder="little")
        return result

    @functools.cached_property
    def warp_on_top(self) -> np.ndarray:
        """The drawdown [picks, ends]: True where an end is over a pick. Row 0 is the first pick, column 0 the first
        end."""
        # eight picks to a byte: an end may be on many shafts
        packed = np.packbits(self.moved, axis=0).T
        ends: np.ndarray = np.zeros((self.ends, packed.shape[1]), dtype=np.uint8)
        for end, shafts in enumerate(self.threading):
            if shafts:
                ends[end] = np.bitwise_or.reduce(packed[[shaft - 1 for shaft in shafts]], axis=0)
        moved = np.unpackbits(ends, axis=1, count=self.picks).view(bool).T
        return moved if self.rising else ~moved

    @property
    def spacing(self) -> float | tuple[np.ndarray, np.ndarray] | None:
        """The distances of neighbouring yarns, as of a Cloth [m]: half of what each of the two takes up. One number
        where all are the same, or those of its warp yarns [ends − 1] and weft yarns [picks − 1]; None: not known."""
        if self.warp_spacing is None or self.weft_spacing is None:
            return None
        warp, weft = (0.5 * (widths[1:] + widths[:-1]) for widths in (self.warp_spacing, self.weft_spacing))
        every = np.append(warp, weft)
        if every.size and (every == every[0]).all():
            return float(every[0])
        return warp[::-1], weft  # the last end first, as of the weave

    @property
    def weave(self) -> Weave:
        """Its weave, a warp yarn for each end, the last end first, and a weft yarn for each pick: see ``Weave``.

        The outermost yarns cross nothing. A draft that is a repeat is ``tiled`` first.
        """
        if min(self.ends, self.picks) < 3:
            raise InputError(
                f"a draft of {self.ends} ends and {self.picks} picks makes no cloth, must have at least 3 of each, "
                "such as by draft.tiled(rows=17, columns=17)"
            )
        return Weave.from_drawdown(self.warp_on_top, name=self.name)

    def tiled(self, *, rows: int, columns: int) -> Draft:
        """Repeats or cuts it to a number of ends, the rows of its weave, and of picks, its columns; at least 3."""
        counts = {"warp": integer("rows", rows, least=3), "weft": integer("columns", columns, least=3)}
        changes: dict[str, Any] = {
            "threading": [self.threading[k % self.ends] for k in range(counts["warp"])],
            "treadling": [self.treadling[k % self.picks] for k in range(counts["weft"])],
        }
        for thread, count in counts.items():
            for kind in OF_THREADS:
                values = getattr(self, f"{thread}_{kind}")
                if values is not None:
                    changes[f"{thread}_{kind}"] = values[np.arange(count) % len(values)]
        return dataclasses.replace(self, **changes)

    def dyed(self, cloth: Cloth) -> Cloth:
        """Gives a cloth of as many yarns the draft's colours, and changes nothing else.

        Args:
            cloth: of a warp yarn for each end and a weft yarn for each pick. Each of its yarns becomes several, one of
                each colour that it has now.

        Raises:
            InputError: the draft has no colours, or the cloth other numbers of yarns.
        """
        if not isinstance(cloth, Cloth):
            raise InputError(f"cloth = {cloth!r}, must be a Cloth")
        if self.warp_colors is None or self.weft_colors is None:
            raise InputError(f"{self!r} has no colors, must have them of warp and weft")
        if (cloth.weave.rows, cloth.weave.columns) != (self.ends, self.picks):
            raise InputError(
                f"the cloth has {cloth.weave.rows} warp and {cloth.weave.columns} weft yarns, must have {self.ends} "
                f"and {self.picks}; draft.tiled(...) makes the draft as large"
            )
        # as Weave.from_drawdown does, the last end first
        colors = np.concatenate([self.warp_colors[::-1], self.weft_colors])
        kinds, place = np.unique(np.column_stack([cloth.material, colors]), axis=0, return_inverse=True)
        place = place.ravel()  # NumPy 2.0 has it in two dimensions
        yarns = [dataclasses.replace(cloth.yarns[int(kind[0])], color=tuple(kind[1:].tolist())) for kind in kinds]
        before = kinds[:, 0].astype(int)
        numbers = {name: cloth._arguments[name] for name in OF_CROSSINGS}
        # by pair of materials
        pairs = {name: value[np.ix_(before, before)] for name, value in numbers.items() if np.ndim(value) == 2}
        return cloth.replace(yarns=yarns, warp=place[: self.ends], weft=place[self.ends :], **pairs)


def _groups(name: str, groups: Any, most: int, least: int = 1) -> tuple[tuple[int, ...], ...]:
    """Gives groups of numbers from 1 to `most`, in order, each once; 0 is none."""
    try:
        lists = [list(group) for group in groups]
    except TypeError as error:
        raise InputError(f"{name} = {groups!r}, must be a list of lists of whole numbers") from error
    if not least <= len(lists) <= MOST_THREADS:
        raise InputError(f"{name} has {len(lists)} entries, must have {least} to {MOST_THREADS}")
    result = []
    for k, group in enumerate(lists):
        for number in group:
            integer(f"{name}[{k}]", number, least=0, most=most)
        result.append(tuple(sorted({int(number) for number in group} - {0})))
    return tuple(result)


def _of_threads(name: str, values: Any, count: int) -> np.ndarray | None:
    if values is None:
        return None
    colors = name.endswith("colors")
    array = finite_array(name, values, (count, 3) if colors else (count,))
    outside = array[(array < 0.0) | (array > (1.0 if colors else np.inf))]
    if outside.size:
        raise InputError(f"{name} has {outside[0]:g}, must be {'from 0 to 1' if colors else 'at least 0'}")
    array.setflags(write=False)
    return array


def _first_of_a_kind(rows: np.ndarray) -> tuple[list[int], list[list[int]]]:
    """Finds which rows are the first of their kind, and for each row the number of its kind, from 1, in a list."""
    found: dict[bytes, int] = {}
    first, kinds = [], []
    for k, row in enumerate(rows):
        kind = found.setdefault(row.tobytes(), len(found) + 1)
        if kind > len(first):
            first.append(k)
        kinds.append([kind])
    return first, kinds
