"""Several cloths as one: what a scene takes that has more than one."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from .cloth import CLOTH_NUMBERS, Cloth
from .topology import side_by_side
from .woven import OF_CROSSINGS, Woven

APART = 1e3
"""Times the largest cloth, by which cloths are apart where arcs along a cloth are compared: they may always touch."""


class Cloths(Woven):
    """Cloths side by side, whose nodes are numbered on from one to the next.

    They share the parallel stiffness and the friction sharpness, and have their own weaves, sizes, poses, yarns and
    other numbers.

    Args:
        cloths: at least one.

    Attributes:
        first_node: the first node of each cloth [cloths].
        spacing, radius, shear, friction, friction_stiffness, friction_damping: as of a Cloth, where all cloths have the
            same one number; else those of crossings are by node [nodes], and the others None.
    """

    radius: float | None
    shear: float | np.ndarray
    friction: float | np.ndarray
    friction_stiffness: float | np.ndarray
    friction_damping: float | np.ndarray
    friction_sharpness: float
    parallel_stiffness: float

    def __init__(self, cloths: Sequence[Cloth]):
        if not isinstance(cloths, Sequence) or not cloths or not all(isinstance(cloth, Cloth) for cloth in cloths):
            raise InputError(f"cloths = {cloths!r}, must be a list of at least one Cloth")
        self.cloths = tuple(cloths)
        self.general = any(cloth.general for cloth in cloths)
        for name in CLOTH_NUMBERS:
            self._share(name)
        counts = np.array([cloth.nodes for cloth in cloths])
        self.first_node = np.cumsum(counts) - counts
        self.yarns = tuple(yarn for cloth in cloths for yarn in cloth.yarns)
        kinds = np.cumsum([0, *(len(cloth.yarns) for cloth in cloths)])
        self.material = np.concatenate([cloth.material + k for cloth, k in zip(cloths, kinds, strict=False)])
        for name in ("position", "euler", "rest_grid", "halves"):
            setattr(self, name, np.concatenate([getattr(cloth, name) for cloth in cloths]))
        self.yarn_crimp = np.concatenate([cloth.yarn_crimp for cloth in cloths])
        size = APART * max(np.abs(cloth.rest_grid).max() for cloth in cloths)
        self.rest_place = np.concatenate([cloth.rest_grid + k * size for k, cloth in enumerate(cloths)])
        self.topology = side_by_side([cloth.topology for cloth in cloths])
        self._fix(cloths=self.cloths)

    def _share(self, name: str) -> None:
        """Sets a number to that of all cloths, or to those of their nodes."""
        values = [getattr(cloth, name) for cloth in self.cloths]
        single = all(isinstance(value, float) for value in values)
        if single and all(cloth._arguments[name] is None for cloth in self.cloths):
            # what each has by default, of its own mass
            values = [float(np.mean(values))] * len(values)
        if single and values == [values[0]] * len(values):
            setattr(self, name, values[0])
            return
        if name not in (*OF_CROSSINGS, "spacing", "radius"):
            k = next(k for k, value in enumerate(values) if value != values[0])
            raise InputError(
                f"cloths[{k}].{name} = {values[k]:g} and cloths[0].{name} = {values[0]:g}, must be the same: "
                "a scene has one for all its cloths"
            )
        self.general = True
        nodes = name in OF_CROSSINGS
        setattr(self, name, np.concatenate([cloth.at_nodes(name) for cloth in self.cloths]) if nodes else None)

    def __repr__(self) -> str:
        return f"Cloths({', '.join(map(repr, self.cloths))})"

    def same_as(self, other: Cloth | Cloths) -> bool:
        """Tells whether another one is made of the same cloths, in the same order."""
        return (
            isinstance(other, Cloths)
            and len(self.cloths) == len(other.cloths)
            and all(mine.same_as(its) for mine, its in zip(self.cloths, other.cloths, strict=True))
        )

    @functools.cached_property
    def segment_spacing(self) -> np.ndarray:
        return np.concatenate([cloth.segment_spacing for cloth in self.cloths])

    @property
    def nodes(self) -> int:
        return len(self.position)

    @property
    def columns(self) -> int:
        """All nodes: there are no rows of all cloths."""
        return self.nodes

    @property
    def stretch_stiffness(self) -> np.ndarray:
        """kₛ = Y π R² of every material [materials] (N)."""
        return np.concatenate([cloth.stretch_stiffness for cloth in self.cloths])

    def node(self, cloth: int, row: int, column: int) -> int:
        """Gives the index of a node of one of the cloths; negative rows and columns count from the end."""
        return int(self.first_node[self._checked(cloth)]) + self.cloths[cloth].node(row, column)

    def _checked(self, cloth: int) -> int:
        if not isinstance(cloth, int | np.integer) or not 0 <= cloth < len(self.cloths):
            raise InputError(f"cloth = {cloth!r}, must be from 0 to {len(self.cloths) - 1}")
        return int(cloth)

    def nodes_of(self, cloth: int) -> slice:
        """Tells where the nodes of one of the cloths stand in arrays of nodes."""
        first = int(self.first_node[self._checked(cloth)])
        return slice(first, first + self.cloths[cloth].nodes)

    def place(self, node: int) -> str:
        """Tells where a node is, in words."""
        k = int(np.searchsorted(self.first_node, node, side="right")) - 1
        return f"cloth {k}, {self.cloths[k].place(node - int(self.first_node[k]))}"


def as_one(cloth: Cloth | Cloths | Sequence[Cloth]) -> Cloth | Cloths:
    """Gives what a scene is made of: a cloth, or several."""
    if isinstance(cloth, Cloth | Cloths):
        return cloth
    if isinstance(cloth, Sequence) and len(cloth) == 1 and isinstance(cloth[0], Cloth):
        return cloth[0]
    if isinstance(cloth, Sequence) and not isinstance(cloth, str):
        return Cloths(cloth)
    raise InputError(f"cloth = {cloth!r}, must be a Cloth, or a list of them")
