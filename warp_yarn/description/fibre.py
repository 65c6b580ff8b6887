"""What yarns are spun of, and what that makes of a yarn: its thickness, tension and bending."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Mapping

from ..errors import InputError, Named, WarpYarnWarning, choice, real
from .fixed import Replaceable, says_why

TIGHTEST = math.pi / math.sqrt(12.0)
"""Packing of round fibres side by side as tightly as they go, 0.907."""
LOOSEST = 0.15
"""Packing below which a yarn is more air than any that is woven; spun ones are at 0.5 to 0.65."""
STEEPEST = math.radians(50.0)
"""Angle of a yarn's surface fibres to its axis; crepe yarns, the most twisted, come to 45 degrees."""
HEAVIEST = 1e4
"""tex: rovings for composites end below it."""


@says_why
@dataclasses.dataclass(frozen=True, kw_only=True)
class Fibre(Replaceable):
    """A kind of fibre.

    Args:
        density: of the fibre itself [kg/m³], above 0.
        modulus: specific modulus at first [N/tex, 1e6 N m/kg], at least 0.
        flexural: specific flexural rigidity R_sf [mN mm²/tex²], at least 0: a fibre of t tex bends with R_sf t².
        tex: mass of one fibre [tex, 1e-6 kg/m], above 0.
        packing: part of a yarn's section that is fibre where nothing else is known, above 0, at most 0.907.
        source: where the numbers are from.
    """

    density: float
    modulus: float
    flexural: float
    tex: float
    packing: float = 0.6
    source: str = ""

    def __post_init__(self) -> None:
        keep = functools.partial(object.__setattr__, self)  # frozen
        for name in ("density", "tex", "packing"):
            keep(name, real(name, getattr(self, name), above=0.0))
        for name in ("modulus", "flexural"):
            keep(name, real(name, getattr(self, name), least=0.0))
        check_packing(self.packing)


def check_packing(packing: float) -> float:
    """Raises an InputError where fibres cannot be packed so."""
    if packing > TIGHTEST:
        raise InputError(f"packing = {packing:g}, must be at most {TIGHTEST:.3f}, of round fibres side by side")
    return packing


_HEARLE = "Morton & Hearle, Physical Properties of Textile Fibres (as remembered)"
_FINE = "fineness usual"

FIBRES = Named("fibre", {
    "cotton": Fibre(density=1520, modulus=6.5, flexural=0.53, tex=0.17, source=f"{_HEARLE}; 5 to 8 N/tex; {_FINE}"),
    "viscose": Fibre(density=1520, modulus=6.5, flexural=0.35, tex=0.17, source=f"{_HEARLE}; {_FINE}"),
    "wool": Fibre(density=1310, modulus=2.7, flexural=0.24, tex=0.41, source=f"{_HEARLE}; 2.1 to 3.4 N/tex; {_FINE}"),
    "silk": Fibre(density=1340, modulus=7.3, flexural=0.19, tex=0.12, packing=0.75, source=f"{_HEARLE}; {_FINE}"),
    "nylon": Fibre(density=1140, modulus=2.6, flexural=0.14, tex=0.33, source=f"{_HEARLE}; {_FINE}"),
    "polyester": Fibre(
        density=1380, modulus=9.7, flexural=0.30, tex=0.17, source=f"{_HEARLE}; 8.8 to 10.6 N/tex; {_FINE}"
    ),
    "polypropylene": Fibre(
        density=910, modulus=7.1, flexural=0.51, tex=0.6, packing=0.65, source=f"{_HEARLE}; {_FINE} in glass rovings"
    ),
    # flexural: M & H's, and that of a round rod, E/(4 π ρ), of 72 GPa alike
    "glass yarn": Fibre(
        density=2560, modulus=28.1, flexural=0.89, tex=0.163, packing=0.75, source=f"{_HEARLE}; 72 GPa; 9 µm"
    ),
    "glass roving": Fibre(
        density=2560, modulus=28.1, flexural=0.89, tex=0.58, packing=0.75, source=f"{_HEARLE}; 72 GPa; 17 µm"
    ),
    # round rods: 84.6 GPa/1440 kg/m³ is 58.75 N/tex, over 4 π 1.44 g/cm³ is 3.25 mN mm²/tex²
    "kevlar km2": Fibre(
        density=1440, modulus=58.75, flexural=3.25, tex=0.167, packing=0.75,
        source="Cheng 2005, as quoted by others: 84.6 GPa, 1440 kg/m³, 12 µm; flexural of a round rod",
    ),
})  # fmt: skip
"""Fibres by name. Their numbers are typical of their kind, but for Kevlar's, which were measured."""

Spun = str | Fibre | Mapping[str, float]
"""What a yarn is spun of: a name, a Fibre, or parts by mass of names."""


def find(fibre: Spun) -> Fibre:
    """Looks a fibre up, or mixes several: {"polyester": 0.5, "cotton": 0.5}, parts by mass that add up to 1."""
    if isinstance(fibre, Fibre):
        return fibre
    if isinstance(fibre, str):
        return FIBRES[choice("fibre", fibre, FIBRES)]
    if not isinstance(fibre, Mapping) or not fibre:
        raise InputError(f"fibre = {fibre!r}, must be one of {', '.join(FIBRES)}, a Fibre, or parts by mass of names")
    parts = [(find(name), real(f"fibre[{name!r}]", part, above=0.0)) for name, part in fibre.items()]
    if abs(sum(part for _, part in parts) - 1.0) > 1e-9:
        raise InputError(f"fibre = {dict(fibre)}, parts must add up to 1")
    tex = sum(part * each.tex for each, part in parts)
    return Fibre(
        density=1.0 / sum(part / each.density for each, part in parts),
        modulus=sum(part * each.modulus for each, part in parts),
        # fibres of all kinds bend each for itself: Σ part · R_sf · t times the yarn's tex
        flexural=sum(part * each.flexural * each.tex for each, part in parts) / tex,
        tex=tex,
        packing=sum(part * each.packing for each, part in parts),
        source="; ".join(each.source for each, _ in parts),
    )


def sizes(
    fibre: Fibre,
    tex: float,
    packing: float | None,
    radius: float | None,
    width: float | None,
    thickness: float | None,
) -> dict[str, float]:
    """Finds a yarn's radius, or its width and thickness [m], of which packing gives what is not known.

    Raises:
        InputError: there is more than one way to the same size.
    """
    known = {"radius": radius, "width": width, "thickness": thickness}
    given = {name: real(name, value, above=0.0) for name, value in known.items() if value is not None}
    whole = "radius" in given or len(given) == 2
    if len(given) > 1 and "radius" in given:
        raise InputError(f"radius and {' and '.join([*given][1:])} are given, must be one of both")
    if packing is not None:
        if whole:
            raise InputError(f"packing = {packing!r} is given, and the size too, must be one of both")
        packing = check_packing(real("packing", packing, above=0.0))
    full = 1e-6 * tex / fibre.density  # m², of fibre
    if whole:
        section = math.pi * given["radius"] ** 2 if radius else 0.25 * math.pi * given["width"] * given["thickness"]
        if not LOOSEST <= full / section <= TIGHTEST:
            warnings.warn(
                f"a yarn of {tex:g} tex and this size is {full / section:.2g} fibre, the rest air: usual are 0.5 to "
                f"0.8, and no more than {TIGHTEST:.2f} is possible. Sizes are in m, tex is g/km.",
                WarpYarnWarning,
                stacklevel=3,
            )
        return given
    section = full / (fibre.packing if packing is None else packing)
    if not given:
        return {"radius": math.sqrt(section / math.pi)}
    other = "thickness" if "width" in given else "width"
    return {**given, other: 4.0 * section / math.pi / next(iter(given.values()))}


def warn_of_counts(fibre: Fibre, tex: float, twist: float, angle: float) -> None:
    """Warns where a count or a twist makes no sense."""
    if tex < fibre.tex:
        text = f"tex = {tex:g} is less than one fibre of {fibre.tex:g} tex. tex is g/km, 1e-6 kg/m."
        warnings.warn(text, WarpYarnWarning, stacklevel=3)
    if tex > HEAVIEST:
        text = f"tex = {tex:g} is a rope, of {tex * 1e-3:g} g a metre. tex is g/km, 1e-6 kg/m."
        warnings.warn(text, WarpYarnWarning, stacklevel=3)
    if angle > STEEPEST:
        warnings.warn(
            f"twist = {twist:g} turns/m turns the fibres at the surface by {math.degrees(angle):.0f} degrees from the "
            "yarn's axis: yarns break before. A twist factor K [tex½/cm] makes 100 K/√tex turns/m.",
            WarpYarnWarning,
            stacklevel=3,
        )
