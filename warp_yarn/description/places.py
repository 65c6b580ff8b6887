"""Where nodes of a cloth are: by row and column, at corners, near a place, inside an outline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from ..errors import InputError, choice, finite_array
from .coarse import coarsened
from .crimp import pressed
from .cutting import Cut, between, cut
from .outline import checked_outline, checked_polygon, inside, tolerance
from .topology import Topology
from .weave import Weave
from .woven import OF_CROSSINGS, Woven


class Places(Woven):
    """A cloth of one weave, whose nodes have places.

    Attributes:
        weave: the draft, of the rectangle that the cloth is cut from.
        size: of that rectangle, along u and v [m].
    """

    weave: Weave
    size: tuple[float, float]
    topology: Topology
    _cut: Cut | None

    @property
    def nodes(self) -> int:
        return self.weave.rows * self.weave.columns if self._cut is None else self._cut.topology.nodes

    @property
    def columns(self) -> int:
        """Nodes of a warp yarn, which threads divide among them; all nodes where warp yarns do not have as many."""
        return self.weave.columns if self._cut is None else self.nodes

    @property
    def middle(self) -> np.ndarray:
        """The middle of the rectangle that the weave is, (u, v) [m]."""
        return 0.5 * np.array(self.size)

    def node(self, row: int, column: int) -> int:
        """Gives the index of a node; negative rows and columns count from the end."""
        rows, columns = self.weave.rows, self.weave.columns
        if not (isinstance(row, int | np.integer) and isinstance(column, int | np.integer)):
            raise InputError(f"node (row {row!r}, column {column!r}), must be two whole numbers")
        if not -rows <= row < rows or not -columns <= column < columns:
            raise InputError(f"node (row {row}, column {column}) is outside a cloth of {rows} × {columns}")
        if self._cut is None:
            return int(column % columns + (row % rows) * columns)
        node = int(self._cut.index[row, column])
        if node < 0:
            raise InputError(f"node (row {row}, column {column}) is cut away, must be one inside: cloth.nearest(u, v)")
        return node

    def place(self, node: int) -> str:
        """Tells where a node is, in words."""
        topology = self.topology
        row, column = topology.place[int(node)].tolist()
        return f"{'the free end at ' if topology.is_end[int(node)] else ''}row {row}, column {column}"

    @property
    def rest_place(self) -> np.ndarray:
        """Where nodes are at rest along u and v [nodes, 2], by which arcs along the cloth are compared (m)."""
        return self.rest_grid

    def nearest(self, u: float, v: float) -> int:
        """Finds the node nearest to a place in the plane of the cloth at rest (m)."""
        place = finite_array("place", (u, v), (2,))
        return int(np.linalg.norm(self.rest_grid - place, axis=1).argmin())

    def within(self, outline: Any) -> list[int]:
        """Lists the nodes inside an outline, or on it: corners [n, 2] in the plane of the cloth at rest (m)."""
        polygon = checked_polygon("outline", outline)
        return np.flatnonzero(inside([polygon], self.rest_grid, tolerance(self.size))).tolist()

    def corners(self, which: str = "all") -> list[int]:
        """Lists the nodes at the corners: "top" (row 0), "bottom" (the last row), or "all"."""
        choice("which", which, ("top", "bottom", "all"))
        if self._cut is not None and self.nodes < self.weave.rows * self.weave.columns:
            raise InputError("a cloth that is cut has no corners: take cloth.nearest(u, v), or cloth.within(outline)")
        top = [self.node(0, 0), self.node(0, -1)]
        bottom = [self.node(-1, 0), self.node(-1, -1)]
        return {"top": top, "bottom": bottom, "all": top + bottom}[which]

    def cut(self, outline: Any, holes: Sequence[Any] = ()) -> Self:
        """Cuts a cloth out of this one, which keeps its numbers and where its nodes are.

        Yarns end where the outline cuts them: a free end is a node, if it is a quarter of the distance to the next
        yarn or longer. Where a yarn has no next crossing on one side it crosses nothing, as on a rectangle's border.

        Args:
            outline: the corners of a polygon (u, v) [n, 2] (m) in the plane of the cloth at rest, such as
                ``wy.outline.disc(radius, center=cloth.middle)``.
            holes: polygons in it.

        Raises:
            InputError: a polygon that meets itself or another one or reaches beyond the cloth; nothing woven is left;
                what is left falls apart; the cloth is cut already.
        """
        if self._cut is not None:
            raise InputError("cut: the cloth is cut already, must be cut once: holes are an argument")
        found = cut(self.weave, self.lines, checked_outline(outline, holes, self.size))
        place = found.topology.place
        root = place[:, 1] + place[:, 0] * self.weave.columns
        changes: dict[str, Any] = {name: getattr(self, name) for name in OF_CROSSINGS}
        changes = {name: value[root] if np.ndim(value) == 1 else value for name, value in changes.items()}
        if not isinstance(self._arguments["pose"], str):
            changes["pose"] = between(self.position, self.rest_grid, root, found.at, self.weave.columns)
        return self.replace(outline=outline, holes=holes, **changes)

    def coarsened(self, n: int) -> Self:
        """Makes a cloth of one yarn for n of this one, for fewer nodes and longer steps.

        Kept: mass and stiffness along warp and weft of the whole cloth; bending, and shear (while it lies flat), per
        area; the angle at which it locks; its thickness; the springs and dampers of friction, and friction while the
        cloth lies flat. Yarns at the edges stand for (n + 1)/2. Crimp goes into mass and stiffness: what feels it
        (``crimp_interchange``, ``contact_force="crimped"``) refuses a coarse cloth.

        Not kept: folds and buckles of a few coarse distances; floats, which are n times as long; what a load on a
        crossing does to shear, through 1 + F_n; friction where yarns press by their tension over a curve, up to n⁴
        times too much, so that they stick there.

        Args:
            n: yarns to one, at least 1, a divisor of rows − 1 and of columns − 1.

        Raises:
            InputError: another n; a cloth that is cut.
        """
        return coarsened(self, n)  # type: ignore[arg-type,return-value]

    def pressed(self) -> Self:
        """Makes the same cloth of yarns as thick as their crimps leave room for, so that ``crimp_interchange`` leaves
        it at rest as it is woven.

        All thicknesses are taken by the same factor, that h₁ + h₂ of the crimps as woven is d₁ + d₂ at the mean
        crossing; widths, mass, tension and bending stiffness of each yarn stay. Yarns of data sheets are round, and
        mostly thicker than they are in the cloth.

        Raises:
            InputError: yarns have no crimp.
        """
        return pressed(self)  # type: ignore[arg-type,return-value]

    @property
    def lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Where weft yarns are along u [columns], and warp yarns along v [rows] (m)."""
        rows, columns = self.weave.rows, self.weave.columns
        if isinstance(self.spacing, float):
            return np.arange(columns) * self.spacing, np.arange(rows) * self.spacing
        v = np.append(0.0, np.cumsum(np.broadcast_to(self.spacing[0], rows - 1)))
        u = np.append(0.0, np.cumsum(np.broadcast_to(self.spacing[1], columns - 1)))
        return u, v
