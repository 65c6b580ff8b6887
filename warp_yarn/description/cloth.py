"""Yarns, and the cloth that is woven of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, choice, finite_array, indices, real
from .fixed import Fixed, Replaceable, says_why
from .sanity import warn_of_units
from .topology import Topology, rectangle
from .weave import Weave


@says_why
@dataclasses.dataclass(frozen=True, kw_only=True)
class Yarn(Replaceable):
    """A yarn material (paper, table 1).

    Args:
        density: ρ, mass per length [kg/m], above 0.
        stretch: Y, stretch modulus [Pa], at least 0. The stiffness of a yarn is kₛ = Y π R² [N].
        bend: B, bending modulus [Pa m²], at least 0. The stiffness of a yarn is k_b = B π R² [N m²].
        color: red, green, blue from 0 to 1, for pictures; None: chosen by its place in the cloth's list.
    """

    density: float
    stretch: float
    bend: float
    color: tuple[float, float, float] | None = None

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


CLOTH_NUMBERS = (
    "spacing",
    "radius",
    "shear",
    "friction",
    "friction_stiffness",
    "friction_damping",
    "friction_sharpness",
    "parallel_stiffness",
)
"""The cloth's own numbers, as its arguments and the kernels' arrays name them."""

POSES = ("upright", "flat")


class Cloth(Fixed):
    """A rectangle of woven cloth at rest.

    Node (row j, column i) has index i + j·columns. Warp yarn j runs through row j, along u; weft yarn i through
    column i, along v. At rest (u, v) = (i L, j L).

    Args:
        weave: the draft.
        yarns: the materials.
        warp, weft: the material (an index into yarns) of each warp yarn [rows] and weft yarn [columns]. None: they
            alternate, even yarns of the first material, odd ones of the second, and so on.
        spacing: L, distance of neighbouring crossings [m], above 0.
        radius: R of every yarn [m], above 0 and at most half the spacing.
        shear: S, shear modulus of a crossing [Pa], at least 0.
        friction: μ, friction coefficient of a crossing, at least 0.
        friction_stiffness: k_f, spring of a stuck crossing [N/m], above 0.
        friction_damping: d_f, damping of sliding [N s/m], at least 0; None: critical for the spring of a stuck
            crossing, 2 √(k_f m), m the mean mass of a yarn's part at a crossing.
        friction_sharpness: p of eq. 4, how sharply a crossing breaks away, above 0.
        parallel_stiffness: k_c, repulsion of parallel yarns [N/m], at least 0.
        pose: "upright", (i L, 0, (rows − 1 − j) L); "flat", (i L, j L, 0); or positions, nodes × 3 [m].
    """

    def __init__(
        self,
        weave: Weave,
        *,
        yarns: Sequence[Yarn],
        warp: Sequence[int] | np.ndarray | None = None,
        weft: Sequence[int] | np.ndarray | None = None,
        spacing: float = 1e-3,
        radius: float = 5e-4,
        shear: float = 1000.0,
        friction: float = 0.5,
        friction_stiffness: float = 1000.0,
        friction_damping: float | None = None,
        friction_sharpness: float = 10.0,
        parallel_stiffness: float = 1.0,
        pose: Any = "upright",
    ):
        if not isinstance(weave, Weave):
            raise InputError(f"weave = {weave!r}, must be a Weave, such as Weave.plain(rows=17, columns=17)")
        self.weave = weave
        if not isinstance(yarns, Sequence):
            raise InputError(f"yarns = {yarns!r}, must be a list of at least one Yarn")
        self.yarns = tuple(yarns)
        if not self.yarns or not all(isinstance(yarn, Yarn) for yarn in self.yarns):
            raise InputError(f"yarns = {yarns!r}, must be a list of at least one Yarn")
        self.warp = self._materials("warp", warp, weave.rows)
        self.weft = self._materials("weft", weft, weave.columns)
        self.spacing = real("spacing", spacing, above=0.0)
        self.radius = real("radius", radius, above=0.0)
        if self.radius > 0.5 * self.spacing * (1.0 + 1e-12):
            raise InputError(
                f"radius = {radius:g}, must be at most half the spacing ({0.5 * self.spacing:g}), or neighbouring "
                "yarns overlap"
            )
        self.shear = real("shear", shear, least=0.0)
        self.friction = real("friction", friction, least=0.0)
        self.friction_stiffness = real("friction_stiffness", friction_stiffness, above=0.0)
        damping = friction_damping
        if damping is None:
            mass = np.mean([self.yarns[k].density for k in self.material]) * self.spacing
            damping = 2.0 * float(np.sqrt(self.friction_stiffness * mass))
        self.friction_damping = real("friction_damping", damping, least=0.0)
        self.friction_sharpness = real("friction_sharpness", friction_sharpness, above=0.0)
        self.parallel_stiffness = real("parallel_stiffness", parallel_stiffness, least=0.0)
        self.position = self._pose(pose)
        self._fix(
            weave=weave,
            yarns=self.yarns,
            warp=None if warp is None else self.warp,
            weft=None if weft is None else self.weft,
            **{name: getattr(self, name) for name in CLOTH_NUMBERS if name != "friction_damping"},
            friction_damping=None if friction_damping is None else self.friction_damping,
            pose=pose if isinstance(pose, str) else self.position,
        )
        warn_of_units(self)

    def __repr__(self) -> str:
        return f"Cloth({self.weave}, {len(self.yarns)} yarns, spacing {self.spacing:g} m)"

    def same_as(self, other: Any) -> bool:
        """Tells whether another one is made of the same, whatever their weaves are called."""
        return (
            isinstance(other, Cloth)
            and np.array_equal(self.weave.flipped, other.weave.flipped)
            and [dataclasses.replace(yarn, color=None) for yarn in self.yarns]
            == [dataclasses.replace(yarn, color=None) for yarn in other.yarns]
            and all(getattr(self, name) == getattr(other, name) for name in CLOTH_NUMBERS)
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in ("warp", "weft", "position"))
        )

    @property
    def nodes(self) -> int:
        return self.weave.rows * self.weave.columns

    @functools.cached_property
    def topology(self) -> Topology:
        return rectangle(self.weave)

    @property
    def material(self) -> np.ndarray:
        """Material of every yarn, the warp yarns first [rows + columns]."""
        return np.concatenate([self.warp, self.weft])

    @property
    def stretch_stiffness(self) -> np.ndarray:
        """kₛ = Y π R² of every material [materials] (N)."""
        return np.array([yarn.stretch for yarn in self.yarns]) * np.pi * self.radius**2

    @property
    def euler(self) -> np.ndarray:
        """(u, v) of every node at rest [nodes, 2]."""
        row, column = np.divmod(np.arange(self.nodes), self.weave.columns)
        return np.stack([column, row], axis=1) * self.spacing

    def node(self, row: int, column: int) -> int:
        """Gives the index of a node; negative rows and columns count from the end."""
        rows, columns = self.weave.rows, self.weave.columns
        if not (isinstance(row, int | np.integer) and isinstance(column, int | np.integer)):
            raise InputError(f"node (row {row!r}, column {column!r}), must be two whole numbers")
        if not -rows <= row < rows or not -columns <= column < columns:
            raise InputError(f"node (row {row}, column {column}) is outside a cloth of {rows} × {columns}")
        return int(column % columns + (row % rows) * columns)

    @property
    def columns(self) -> int:
        """Nodes of a warp yarn, which threads divide among them."""
        return self.weave.columns

    def place(self, node: int) -> str:
        """Tells where a node is, in words."""
        row, column = divmod(int(node), self.weave.columns)
        return f"row {row}, column {column}"

    @property
    def rest_place(self) -> np.ndarray:
        """(u, v) at rest [nodes, 2], by which arcs along the cloth are compared (m)."""
        return self.euler

    def corners(self, which: str = "all") -> list[int]:
        """Lists the nodes at the corners: "top" (row 0), "bottom" (the last row), or "all"."""
        choice("which", which, ("top", "bottom", "all"))
        top = [self.node(0, 0), self.node(0, -1)]
        bottom = [self.node(-1, 0), self.node(-1, -1)]
        return {"top": top, "bottom": bottom, "all": top + bottom}[which]

    def _materials(self, name: str, value: Sequence[int] | np.ndarray | None, count: int) -> np.ndarray:
        if value is None:
            return np.arange(count) % len(self.yarns)
        if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray) or np.ndim(value) == 0:
            raise InputError(f"{name} = {value!r}, must be the materials of {count} yarns, a list of whole numbers")
        if len(value) != count:
            raise InputError(f"{name} names the material of {len(value)} yarns, must be of {count}")
        for k in value:
            indices(name, [k], len(self.yarns), "material")
        return np.array(value)

    def _pose(self, pose: Any) -> np.ndarray:
        if not isinstance(pose, str):
            return finite_array("pose", pose, (self.nodes, 3))
        choice("pose", pose, POSES)
        u, v = self.euler.T
        zero = np.zeros_like(u)
        height = (self.weave.rows - 1) * self.spacing
        return np.stack([u, zero, height - v] if pose == "upright" else [u, v, zero], axis=1)
