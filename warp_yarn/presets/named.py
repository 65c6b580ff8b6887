"""What a fabric by name is made of: the numbers of its data sheet with their sources, and the cloth that they make."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..description.cloth import Cloth, Yarn
from ..description.fibre import Spun, find
from ..description.weave import Weave, woven
from ..errors import InputError, choice, real

KINDS = {
    "measured": "of this very fabric, published by those who measured or make it",
    "derived": "by a formula from others of its numbers",
    "fitted": "so that the model gives what was measured",
    "typical": "of fabrics of its kind",
}
"""How a number is known."""

UNITS = {
    "weave": "",
    "ends": "1/cm",
    "picks": "1/cm",
    **{
        f"{side}_{name}": unit
        for side in ("warp", "weft")
        for name, unit in {
            "fibre": "",
            "tex": "tex",
            "twist": "1/m",
            "width": "m",
            "thickness": "m",
            "crimp": "1",
            "tension": "N",
            "bending": "N m²",
        }.items()
    },
    "mass": "kg/m²",
    "thickness": "m",
    "bending": "N m",
    "shear": "N/m",
    "modulus": "Pa",
    "friction": "1",
}
"""The numbers of a fabric, and their units: mass, thickness, bending (along and across, the mean) and shear (a radian)
are of the cloth; tension kₛ and bending k_b of a yarn; modulus S of a crossing."""

_NEEDED = ("weave", "ends", "picks", "warp_tex", "weft_tex", "warp_fibre", "weft_fibre", "shear", "friction", "mass")


@dataclasses.dataclass(frozen=True)
class Datum:
    """A number and how it is known.

    Args:
        value: the number, in the unit of its name; words, of a weave or a fibre.
        kind: one of ``KINDS``.
        source: where it is from.
    """

    value: Any
    kind: str
    source: str

    def __post_init__(self) -> None:
        choice("kind", self.kind, KINDS)
        if not self.source:
            raise InputError(f"source of {self.value!r} must not be empty")


measured = functools.partial(Datum, kind="measured")
derived = functools.partial(Datum, kind="derived")
typical = functools.partial(Datum, kind="typical")


class NamedFabric:
    """A fabric by name: call it to make a cloth of it.

    Args:
        name: in words.
        sheet: its numbers by the names of ``UNITS``. What is not there, of twist, width, thickness and crimp, is none,
            or that of a round yarn of its fibre's packing; where bending is there, its yarns are made to bend so.

    Attributes:
        sources: every number that the cloth is made of, by name: value, kind and source.
        yarns: of the warp, and of the weft.
        spacing: L of warp yarns, and of weft yarns [m].
        crimp: of warp yarns, and of weft yarns.
        shear: S [Pa].
        mass: of the cloth, of tex, sett and crimp [kg/m²].
    """

    def __init__(self, name: str, **sheet: Datum):
        self.name = name
        for key in sheet:
            choice("a number of a fabric", key, UNITS)
        for key in _NEEDED:
            if key not in sheet:
                raise InputError(f"{key} of {name} is missing")
        self._sheet = sheet
        self.spacing = 1e-2 / self._number("ends"), 1e-2 / self._number("picks")
        self.crimp = self._number("warp_crimp", 0.0), self._number("weft_crimp", 0.0)
        free = self._yarn("warp"), self._yarn("weft")
        softer = 1.0
        if "bending" in sheet:
            softer = self._number("bending") / float(np.mean(self._bends(free)))
        warp_yarn, weft_yarn = (dataclasses.replace(yarn, bend=softer * yarn.bend) for yarn in free)
        self.yarns = warp_yarn, weft_yarn
        (warp, _), (weft, _) = (yarn.halves(math.nan) for yarn in self.yarns)
        self.shear = self._number("shear") / (2.0 * math.pi * warp * weft * sum(1.0 / each for each in self.spacing))
        densities = zip(self.yarns, self.crimp, self.spacing, strict=True)
        self.mass = sum(yarn.density * (1.0 + crimp) / apart for yarn, crimp, apart in densities)
        self.sources: Mapping[str, Datum] = {**sheet, **self._made()}

    def __call__(
        self,
        rows: int | None = None,
        columns: int | None = None,
        weave: str | Weave | None = None,
        *,
        size: Any = None,
        **options: Any,
    ) -> Cloth:
        """Makes a cloth of it.

        Args:
            rows, columns: number of warp and of weft yarns, at least 3; 17 unless there is a size.
            weave: words, as of ``Weave.from_notation``, or a Weave of as many yarns; None: its own.
            size: in place of rows and columns: how long it is along the warp and along the weft [m], one number for
                both, or two.
            options: of the Cloth, to change it: ``pose``, ``friction``, ...; not radius, for its yarns have their
                sizes.
        """
        if size is not None:
            if rows is not None or columns is not None:
                raise InputError(f"size = {size!r} goes with neither rows nor columns")
            along, across = (size, size) if np.ndim(size) == 0 else self._two(size)
            columns = 1 + round(real("size", along, above=0.0) / self.spacing[1])
            rows = 1 + round(real("size", across, above=0.0) / self.spacing[0])
            if min(rows, columns) < 3:
                least = " × ".join(f"{2.0 * each * 1e3:g} mm" for each in self.spacing[::-1])
                raise InputError(f"size = {size!r} m makes {rows} × {columns} yarns, must be at least 3 × 3: {least}")
        if "radius" in options:
            raise InputError(f"radius = {options['radius']!r}: yarns of {self.name} have their own sizes (yarns=...)")
        rows, columns = 17 if rows is None else rows, 17 if columns is None else columns
        draft = woven(self._sheet["weave"].value if weave is None else weave, rows=rows, columns=columns)
        numbers = {
            "yarns": self.yarns,
            "warp": [0] * rows,
            "weft": [1] * columns,
            "spacing": self.spacing,
            "crimp": self.crimp,
            "shear": self.shear,
            "friction": self._number("friction"),
        }
        if "yarns" in options:  # others alternate, as in any cloth
            del numbers["warp"], numbers["weft"]
        return Cloth(draft, **{**numbers, **options})

    def __repr__(self) -> str:
        return f"NamedFabric({self.name})"

    def _two(self, size: Any) -> tuple[Any, Any]:
        if np.shape(size) != (2,):
            raise InputError(f"size = {size!r}, must be a number, or two: along the warp, and along the weft")
        return size[0], size[1]

    def _number(self, key: str, none: float = math.nan) -> float:
        return float(self._sheet[key].value) if key in self._sheet else none

    def _yarn(self, side: str) -> Yarn:
        """Makes a yarn that bends as its fibres do."""
        return Yarn.from_tex(
            self._number(f"{side}_tex"),
            self._sheet[f"{side}_fibre"].value,
            twist=self._number(f"{side}_twist", 0.0),
            width=self._size(f"{side}_width"),
            thickness=self._size(f"{side}_thickness"),
        )

    def _size(self, key: str) -> float | None:
        return self._number(key) if key in self._sheet else None

    def _bends(self, yarns: tuple[Yarn, Yarn]) -> list[float]:
        """Gives the cloth's bending stiffness along the warp, and along the weft [N m]."""
        of_all = zip(yarns, self.crimp, self.spacing, strict=True)
        return [stiffness(yarn)[1] / (1.0 + crimp) / apart for yarn, crimp, apart in of_all]

    def _made(self) -> dict[str, Datum]:
        """Says where the numbers are from that the sheet does not have."""
        made = {}
        for side, yarn in zip(("warp", "weft"), self.yarns, strict=True):
            fibre: Spun = self._sheet[f"{side}_fibre"].value
            of, halves = find(fibre), yarn.halves(math.nan)
            for name, half in zip(("width", "thickness"), halves, strict=True):
                if f"{side}_{name}" not in self._sheet:
                    made[f"{side}_{name}"] = derived(2.0 * half, source=f"packing {of.packing:g} of tex")
            tension, bending = stiffness(yarn)
            twist = " · cos² of the twist's angle" if f"{side}_twist" in self._sheet else ""
            made[f"{side}_tension"] = derived(tension, source=f"fibre's {of.modulus:.3g} N/tex · tex{twist}")
            if "bending" in self._sheet:
                made[f"{side}_bending"] = Datum(bending, "fitted", "bending of the cloth")
            else:
                source = f"fibres slip: {of.flexural:.3g} mN mm²/tex² · tex · {of.tex:.3g} tex of a fibre"
                made[f"{side}_bending"] = derived(bending, source=source)
        if "bending" not in self._sheet:
            made["bending"] = derived(float(np.mean(self._bends(self.yarns))), source="bending of the yarns")
        fitted = self._sheet["shear"].kind == "measured"
        made["modulus"] = Datum(self.shear, "fitted" if fitted else "derived", "shear of the cloth")
        return made


def tables(fabrics: Mapping[str, NamedFabric]) -> str:
    """Writes all numbers of fabrics with their sources, a table of Markdown for each."""
    written = []
    for name, fabric in fabrics.items():
        rows = [f"### {name}\n\n{fabric.name}\n\n| | value | | |\n|---|---|---|---|"]
        for key, datum in _once(fabric.sources).items():
            value = _written(datum.value, UNITS[key.split(", ")[0]])
            rows.append(f"| {key} | {value} | {datum.kind} | {datum.source} |")
        written.append("\n".join(rows))
    return "\n\n".join(written)


def _written(value: Any, unit: str) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{100.0 * part:g} % {name}" for name, part in value.items())
    return value if isinstance(value, str) else f"{value:.4g} {unit}".removesuffix(" 1")


def _once(sources: Mapping[str, Datum]) -> dict[str, Datum]:
    """Says once what warp and weft have alike."""
    alike = {
        key.partition("_")[2]
        for key, datum in sources.items()
        if key.startswith("warp_") and sources.get(f"weft_{key.partition('_')[2]}") == datum
    }
    result = {}
    for key in UNITS:
        side, _, name = key.partition("_")
        if key not in sources or (side == "weft" and name in alike):
            continue
        result[f"{key}, weft_{name}" if side == "warp" and name in alike else key] = sources[key]
    return result


def stiffness(yarn: Yarn) -> tuple[float, float]:
    """Gives kₛ [N] and k_b [N m²] of a yarn that has its own size."""
    width, thickness = yarn.halves(math.nan)
    section = math.pi * width * thickness
    return yarn.stretch * section, yarn.bend * section
