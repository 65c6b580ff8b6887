"""The cloth that is woven of yarns."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, choice, finite_array, real
from .cutting import Cut, cut
from .outline import checked_outline
from .places import Places
from .sanity import warn_of_units
from .topology import Topology, rectangle
from .weave import Weave
from .woven import (
    OF_CROSSINGS,
    Each,
    Numbers,
    check_room,
    checked_crimp,
    checked_materials,
    checked_of_crossings,
    checked_spacing,
)
from .yarn import Yarn

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


class Cloth(Places):
    """A rectangle of woven cloth at rest, or what is cut out of one.

    Node (row j, column i) of a rectangle has index i + j·columns. Warp yarn j runs through row j, along u; weft yarn i
    through column i, along v. Where all yarns are equally far apart, (u, v) = (i L, j L) at rest.

    Args:
        weave: the draft.
        yarns: the materials.
        warp, weft: the material (an index into yarns) of each warp yarn [rows] and weft yarn [columns]. None: they
            alternate, even yarns of the first material, odd ones of the second, and so on.
        spacing: L, distance of neighbouring yarns [m], above 0: one of all, or (warp, weft), that of neighbouring warp
            yarns (of rows, so the length of weft segments) and that of neighbouring weft yarns (of columns, the length
            of warp segments), each a number or one for each gap [rows − 1], [columns − 1].
        radius: R of yarns that have no size of their own [m], above 0. Neighbouring yarns must not overlap: half the
            sum of their widths is at most their distance.
        crimp: how much longer than the distance that it covers at rest a yarn is, over that distance, at least 0: one
            of all, or (warp, weft), each a number or one for each yarn [rows], [columns]. (u, v) are lengths of yarn,
            1 + crimp times the distances; a yarn is unstrained as woven, and its crimp stays the same as it stretches.
        shear: S, shear modulus of a crossing [Pa], at least 0. One number, or one for each pair of materials
            [materials of warp yarns, materials of weft yarns], or one for each node [nodes], of which those on the
            border mean nothing; as are the next three.
        friction: μ, friction coefficient of a crossing, at least 0.
        friction_stiffness: k_f, spring of a stuck crossing [N/m], above 0.
        friction_damping: d_f, damping of sliding [N s/m], at least 0; None: critical for the spring of a stuck
            crossing, 2 √(k_f m), m the mean mass of a yarn's part at a crossing.
        friction_sharpness: p of eq. 4, how sharply a crossing breaks away, above 0.
        parallel_stiffness: k_c, repulsion of parallel yarns [N/m], at least 0.
        pose: "upright", (u, 0, height − v) of a node u along the warp and v along the weft from the first one: u points
            to the right, along x, and v down, along −z, so that an outline hangs with its large v below; "flat",
            (u, v, 0); or positions, nodes × 3 [m].
        outline: what is cut out of the rectangle: the corners of a polygon (u, v) [n, 2] (m), in its plane at rest,
            (0, 0) being its first node; None: all of it. See ``cut``.
        holes: polygons that are cut out of that, apart from it and from each other.
    """

    def __init__(
        self,
        weave: Weave,
        *,
        yarns: Sequence[Yarn],
        warp: Sequence[int] | np.ndarray | None = None,
        weft: Sequence[int] | np.ndarray | None = None,
        spacing: Each = 1e-3,
        radius: float = 5e-4,
        crimp: Each = 0.0,
        shear: Each = 1000.0,
        friction: Each = 0.5,
        friction_stiffness: Each = 1000.0,
        friction_damping: Each | None = None,
        friction_sharpness: float = 10.0,
        parallel_stiffness: float = 1.0,
        pose: Any = "upright",
        outline: Any = None,
        holes: Sequence[Any] = (),
    ):
        if not isinstance(weave, Weave):
            raise InputError(f"weave = {weave!r}, must be a Weave, such as Weave.plain(rows=17, columns=17)")
        self.weave = weave
        if not isinstance(yarns, Sequence):
            raise InputError(f"yarns = {yarns!r}, must be a list of at least one Yarn")
        self.yarns = tuple(yarns)
        if not self.yarns or not all(isinstance(yarn, Yarn) for yarn in self.yarns):
            raise InputError(f"yarns = {yarns!r}, must be a list of at least one Yarn")
        self.warp = checked_materials("warp", warp, weave.rows, len(self.yarns))
        self.weft = checked_materials("weft", weft, weave.columns, len(self.yarns))
        self.spacing = checked_spacing(spacing, weave.rows, weave.columns)
        self.radius = real("radius", radius, above=0.0)
        self.crimp = checked_crimp(crimp, weave.rows, weave.columns)
        self._measure(outline, holes)
        self.shear = self._of_crossings("shear", shear)
        self.friction = self._of_crossings("friction", friction)
        self.friction_stiffness = self._of_crossings("friction_stiffness", friction_stiffness)
        if friction_damping is None:
            damping = 2.0 * np.sqrt(self.friction_stiffness * self.segment_mass)
            self.friction_damping: Numbers = float(damping) if np.ndim(damping) == 0 else damping
        else:
            self.friction_damping = self._of_crossings("friction_damping", friction_damping)
        self.friction_sharpness = real("friction_sharpness", friction_sharpness, above=0.0)
        self.parallel_stiffness = real("parallel_stiffness", parallel_stiffness, least=0.0)
        self.position = self._pose(pose)
        every = (self.spacing, self.crimp, *(getattr(self, name) for name in OF_CROSSINGS))
        self.general = bool(
            not all(isinstance(value, float) for value in every) or self.crimp or (self.halves != self.radius).any()
        )
        self._fix(
            weave=weave,
            yarns=self.yarns,
            warp=None if warp is None else self.warp,
            weft=None if weft is None else self.weft,
            **{name: getattr(self, name) for name in CLOTH_NUMBERS if name not in ("radius", "friction_damping")},
            radius=float(radius),
            crimp=self.crimp,
            friction_damping=None if friction_damping is None else self.friction_damping,
            pose=pose if isinstance(pose, str) else self.position,
            outline=self.outline,
            holes=self.holes,
        )
        warn_of_units(self)

    def __repr__(self) -> str:
        if isinstance(self.spacing, float):
            return f"Cloth({self.weave}, {len(self.yarns)} yarns, spacing {self.spacing:g} m)"
        warp, weft = (f"{np.mean(each):g}" for each in self.spacing)
        return f"Cloth({self.weave}, {len(self.yarns)} yarns, spacing {warp} m × {weft} m)"

    def same_as(self, other: Any) -> bool:
        """Tells whether another one is made of the same, whatever their weaves are called."""
        arrays = (*CLOTH_NUMBERS[2:], "warp", "weft", "rest_grid", "halves", "yarn_crimp", "position")
        return (
            isinstance(other, Cloth)
            and np.array_equal(self.weave.flipped, other.weave.flipped)
            and [dataclasses.replace(yarn, color=None) for yarn in self.yarns]
            == [dataclasses.replace(yarn, color=None) for yarn in other.yarns]
            and np.array_equal(self.topology.segment_nodes, other.topology.segment_nodes)
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in arrays)
        )

    @functools.cached_property
    def topology(self) -> Topology:  # type: ignore[override]
        return rectangle(self.weave) if self._cut is None else self._cut.topology

    @property
    def stretch_stiffness(self) -> np.ndarray:
        """kₛ = Y · section of every material [materials] (N)."""
        halves = np.array([yarn.halves(self.radius) for yarn in self.yarns])
        return np.array([yarn.stretch for yarn in self.yarns]) * np.pi * (halves[:, 0] * halves[:, 1])

    def _measure(self, outline: Any, holes: Sequence[Any]) -> None:
        """Finds the yarns, their sizes and crimps, where nodes are at rest, and (u, v)."""
        rows = self.weave.rows
        halves = np.array([yarn.halves(self.radius) for yarn in self.yarns])
        of_lines = halves[np.concatenate([self.warp, self.weft])]
        if (of_lines == of_lines[0, 0]).all():
            self.radius = float(of_lines[0, 0])
            if isinstance(self.spacing, float) and self.radius > 0.5 * self.spacing * (1.0 + 1e-12):
                raise InputError(
                    f"radius = {self.radius:g}, must be at most half the spacing ({0.5 * self.spacing:g}), or "
                    "neighbouring yarns overlap"
                )
        gaps = (self.spacing, self.spacing) if isinstance(self.spacing, float) else self.spacing
        check_room(gaps[0], of_lines[:rows, 0], "warp")
        check_room(gaps[1], of_lines[rows:, 0], "weft")
        lines = self.lines
        self.size = float(lines[0][-1]), float(lines[1][-1])
        self._cut: Cut | None = None
        self.outline: np.ndarray | None = None
        self.holes: tuple[np.ndarray, ...] = ()
        yarn_line = np.arange(rows + self.weave.columns)
        if outline is None:
            if len(holes):
                raise InputError("holes without an outline, must have one: [[0, 0], [u, 0], [u, v], [0, v]] of all")
            row, column = np.divmod(np.arange(self.nodes), self.weave.columns)
            self.rest_grid = np.stack([lines[0][column], lines[1][row]], axis=1)
        else:
            self.outline, *several = checked_outline(outline, holes, self.size)
            self.holes = tuple(several)
            self._cut = cut(self.weave, lines, [self.outline, *several])
            self.rest_grid = self._cut.at
            yarn_line = self._cut.yarn_line + rows * self._cut.topology.yarn_direction
            if self._cut.topology.is_end.any():
                self.spacing = gaps  # a free end's is its own
        self.material = np.concatenate([self.warp, self.weft])[yarn_line]
        self.halves = of_lines[yarn_line]
        self.yarn_crimp = np.zeros(len(yarn_line))
        self.euler = self.rest_grid
        if crimp := self.crimp:
            each = (crimp, crimp) if isinstance(crimp, float) else crimp
            of_all = [np.broadcast_to(each[0], rows), np.broadcast_to(each[1], self.weave.columns)]
            self.yarn_crimp = np.concatenate(of_all)[yarn_line]
            longer = np.append(1.0 + self.yarn_crimp, 1.0)  # the last of a node without such a yarn
            self.euler = self.rest_grid * longer[self.node_yarns]

    def _of_crossings(self, name: str, value: Any) -> Numbers:
        return checked_of_crossings(name, value, self.nodes, len(self.yarns))

    def _pose(self, pose: Any) -> np.ndarray:
        if not isinstance(pose, str):
            return finite_array("pose", pose, (self.nodes, 3))
        choice("pose", pose, POSES)
        u, v = self.rest_grid.T
        zero = np.zeros_like(u)
        return np.stack([u, zero, v.max() - v] if pose == "upright" else [u, v, zero], axis=1)
