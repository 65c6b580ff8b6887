"""A yarn material."""

from __future__ import annotations

import dataclasses
import functools
import math

from ..errors import InputError, finite_array, real
from . import fibre as fibres
from .fixed import Replaceable, says_why

SIZES = ("radius", "width", "thickness")
"""Sizes that a yarn may have of its own."""


@says_why
@dataclasses.dataclass(frozen=True, kw_only=True)
class Yarn(Replaceable):
    """A yarn material (paper, table 1).

    A yarn may have a size of its own: either radius, or both width and thickness, the axes of its elliptic section. The
    width is across the yarn in the plane of the cloth, by which neighbours touch and crossings lock; the thickness
    across the cloth, by which warp and weft pass over each other. Sections are π/4 · width · thickness.

    Args:
        density: ρ, mass per length [kg/m], above 0.
        stretch: Y, stretch modulus [Pa], at least 0. The stiffness of a yarn is kₛ = Y · section [N].
        bend: B, bending modulus [Pa m²], at least 0. The stiffness of a yarn is k_b = B · section [N m²].
        color: red, green, blue from 0 to 1, for pictures; None: chosen by its place in the cloth's list.
        radius: R [m], above 0; None: that of the cloth, where width and thickness are None too.
        width, thickness: [m], above 0.
    """

    density: float
    stretch: float
    bend: float
    color: tuple[float, float, float] | None = None
    radius: float | None = None
    width: float | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        keep = functools.partial(object.__setattr__, self)  # frozen
        keep("density", real("density", self.density, above=0.0))
        keep("stretch", real("stretch", self.stretch, least=0.0))
        keep("bend", real("bend", self.bend, least=0.0))
        if self.color is not None:
            color = finite_array("color", self.color, (3,))
            if color.min() < 0.0 or color.max() > 1.0:
                raise InputError(f"color = {self.color}, must be three numbers from 0 to 1")
            keep("color", tuple(color.tolist()))
        for name in SIZES:
            if getattr(self, name) is not None:
                keep(name, real(name, getattr(self, name), above=0.0))
        if (self.width is None) != (self.thickness is None):
            raise InputError(f"width = {self.width} and thickness = {self.thickness}, must both be given, or neither")
        if self.radius is not None and self.width is not None:
            raise InputError(
                f"radius = {self.radius:g} and width = {self.width:g}, must be radius, or width and thickness"
            )

    @classmethod
    def from_tex(
        cls,
        tex: float,
        fibre: fibres.Spun = "cotton",
        *,
        twist: float = 0.0,
        packing: float | None = None,
        radius: float | None = None,
        width: float | None = None,
        thickness: float | None = None,
        color: tuple[float, float, float] | None = None,
    ) -> Yarn:
        """Makes a yarn of fibres that slip past each other as it bends.

        It bends as all its fibres together, k_b = R_sf · tex · tex of one fibre, some hundred times softer than a solid
        rod of its size, and within a factor of 2.5 of what is measured on cloth; free of friction between fibres. It
        stretches as they do, kₛ = modulus · tex · cos²α, α the angle of the fibres at the surface, tan α = π d twist
        (fibres on ideal helices; d the diameter of a round yarn of the same section).

        Args:
            tex: mass per length [g/km, 1e-6 kg/m], above 0.
            fibre: a name of ``wy.FIBRES``, a ``wy.Fibre``, or parts by mass: {"polyester": 0.5, "cotton": 0.5}.
            twist: [turns/m], at least 0.
            packing: part of the section that is fibre, above 0, at most 0.907; None: that of the fibre. It gives what
                is not known of the size: the radius of a round yarn, or the width, or the thickness.
            radius, width, thickness: [m], above 0, where they are known: radius, or width or thickness or both.
            color: as of a Yarn.

        Warns of counts, twists and sizes that no yarn has.
        """
        of = fibres.find(fibre)
        tex, twist = real("tex", tex, above=0.0), real("twist", twist, least=0.0)
        size = fibres.sizes(of, tex, packing, radius, width, thickness)
        yarn = cls(density=1e-6 * tex, stretch=0.0, bend=0.0, color=color, **size)
        half_width, half_thickness = yarn.halves(math.nan)
        angle = math.atan(2.0 * math.pi * math.sqrt(half_width * half_thickness) * twist)
        fibres.warn_of_counts(of, tex, twist, angle)
        section = math.pi * half_width * half_thickness
        tension = of.modulus * tex * math.cos(angle) ** 2
        return dataclasses.replace(yarn, stretch=tension / section, bend=1e-9 * of.flexural * tex * of.tex / section)

    @property
    def sizes(self) -> tuple[float | None, ...]:
        """What it has of ``SIZES`` of its own."""
        return tuple(getattr(self, name) for name in SIZES)

    def halves(self, radius: float) -> tuple[float, float]:
        """Gives half the width and half the thickness [m], in a cloth of this radius."""
        if self.width is not None and self.thickness is not None:
            return 0.5 * self.width, 0.5 * self.thickness
        own = radius if self.radius is None else self.radius
        return own, own
