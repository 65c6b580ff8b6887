"""What a scene reads of a cloth, or of several as one: where its yarns are at rest, their sizes, numbers of crossings.

A cloth whose numbers are the same everywhere (one distance of all yarns, one radius, no crimp, one number for all
crossings) is **plain**, and its kernels read single numbers. Any other is **general**: its kernels find these numbers
by segment, yarn and node.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, finite_array, indices, real
from .fixed import Fixed
from .topology import Topology
from .yarn import Yarn

OF_CROSSINGS = {
    "shear": {"least": 0.0},
    "friction": {"least": 0.0},
    "friction_stiffness": {"above": 0.0},
    "friction_damping": {"least": 0.0},
}
"""Numbers that crossings have, and their ranges."""

Numbers = float | np.ndarray
"""One number, or one of each."""
Each = float | Sequence | np.ndarray
"""As they are given."""


class Woven(Fixed):
    """A cloth, or several as one.

    Attributes:
        yarns: the materials.
        material: of every yarn, the warp yarns of a cloth before its weft yarns [yarns].
        topology: index arrays.
        general: whether any number is not the same everywhere.
        rest_grid: how far along u and along v nodes are from each other at rest, in space [nodes, 2] (m).
        halves: half the width and half the thickness of every yarn [yarns, 2] (m).
        yarn_crimp: of every yarn: its length is 1 + crimp times the distance that it covers at rest [yarns].
        euler: (u, v) of every node at rest [nodes, 2], lengths of material (m).
        position: of every node at rest [nodes, 3] (m).
        spacing: L, where it is the same everywhere [m].
    """

    yarns: tuple[Yarn, ...]
    material: np.ndarray
    topology: Topology
    general: bool
    rest_grid: np.ndarray
    halves: np.ndarray
    yarn_crimp: np.ndarray
    euler: np.ndarray
    position: np.ndarray
    spacing: Any

    @functools.cached_property
    def node_yarns(self) -> np.ndarray:
        """The warp yarn and the weft yarn of every node, counted among all yarns; -1: none [nodes, 2], int32."""
        topology = self.topology
        result = np.full((topology.nodes, 2), -1, dtype=np.int32)
        for end in range(2):
            yarn = topology.segment_yarn
            result[topology.segment_nodes[:, end], topology.yarn_direction[yarn]] = yarn
        return result

    @functools.cached_property
    def segment_spacing(self) -> np.ndarray:
        """Distance at rest between the nodes of every segment, in space [segments] (m)."""
        topology = self.topology
        if isinstance(self.spacing, float):
            return np.full(len(topology.segment_nodes), self.spacing)
        direction = topology.yarn_direction[topology.segment_yarn]
        ends = self.rest_grid[topology.segment_nodes, direction[:, None]]
        return ends[:, 1] - ends[:, 0]

    @functools.cached_property
    def node_spacing(self) -> np.ndarray:
        """Distance at rest from every node to the next one of its warp yarn and of its weft yarn, 0 at a yarn's end
        [nodes, 2] (m)."""
        topology = self.topology
        result = np.zeros((topology.nodes, 2))
        result[topology.segment_nodes[:, 0], topology.yarn_direction[topology.segment_yarn]] = self.segment_spacing
        return result

    @functools.cached_property
    def node_widths(self) -> np.ndarray:
        """Half the widths of the warp yarn and the weft yarn of every node, 0 where there is none [nodes, 2] (m)."""
        return np.where(self.node_yarns >= 0, self.halves[self.node_yarns, 0], 0.0)

    @functools.cached_property
    def corner_lock(self) -> np.ndarray:
        """φ_l of every corner [crossings, 4] (rad): left up, left down, right up, right down.

        φ_l = arcsin(b_p/L_p) + arcsin(b_r/L_r), p the corner's warp neighbour and r its weft neighbour, L the distance
        to it and b half the mean width of the two yarns that cross there and at the crossing: 2 arcsin(R/L) where all
        are the same.
        """
        topology, crossing = self.topology, self.topology.crossing_node
        angles = []
        for k, neighbour in enumerate(topology.crossing_neighbours.T):
            along = k // 2  # left and right along the warp yarn
            b = 0.5 * (self.node_widths[crossing, 1 - along] + self.node_widths[neighbour, 1 - along])
            distance = np.abs(self.rest_grid[neighbour, along] - self.rest_grid[crossing, along])
            angles.append(np.arcsin(np.minimum(b / distance, 1.0)))
        return np.stack([angles[p] + angles[r] for p in (0, 1) for r in (2, 3)], axis=1)

    @functools.cached_property
    def shortest_spacing(self) -> float:
        """Smallest distance of neighbouring nodes at rest [m]."""
        return float(self.segment_spacing.min())

    @functools.cached_property
    def longest_spacing(self) -> float:
        """Largest distance of neighbouring nodes at rest [m]."""
        return float(self.segment_spacing.max())

    @property
    def least_friction_damping(self) -> float:
        """Of all crossings [N s/m]."""
        at_nodes = self.at_nodes("friction_damping")
        return float(at_nodes[self.topology.crossing_node].min())

    @property
    def half_thickness(self) -> float:
        """Of the thickest yarn [m]."""
        return float(self.halves[:, 1].max())

    @functools.cached_property
    def mass(self) -> float:
        """Mass of all yarns [kg]."""
        density = np.array([yarn.density for yarn in self.yarns])[self.material]
        yarn = self.topology.segment_yarn
        return float((density[yarn] * (1.0 + self.yarn_crimp[yarn]) * self.segment_spacing).sum())

    @property
    def segment_mass(self) -> float:
        """Mean mass of a yarn's part between neighbouring crossings [kg]."""
        if isinstance(self.spacing, float) and not self.yarn_crimp.any():
            return float(np.mean([self.yarns[k].density for k in self.material]) * self.spacing)
        return self.mass / len(self.topology.segment_nodes)

    def entries(self, name: str) -> np.ndarray:
        """Tells which entry of one of ``OF_CROSSINGS``, flattened, every node has [nodes]."""
        value = getattr(self, name)
        if np.ndim(value) == 2:
            warp, weft = self.material[self.node_yarns].T
            return warp * len(self.yarns) + weft
        return np.arange(self.topology.nodes) * np.ndim(value)

    def at_nodes(self, name: str) -> np.ndarray:
        """Gives one of ``OF_CROSSINGS`` at every node [nodes]; it means something at crossings."""
        return np.ravel(getattr(self, name))[self.entries(name)]


# -- what a Cloth is given -------------------------------------------------------------------------------------------


def checked_materials(name: str, value: Sequence[int] | np.ndarray | None, count: int, materials: int) -> np.ndarray:
    """Checks the materials of the yarns of a direction; None: they alternate."""
    if value is None:
        return np.arange(count) % materials
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray) or np.ndim(value) == 0:
        raise InputError(f"{name} = {value!r}, must be the materials of {count} yarns, a list of whole numbers")
    if len(value) != count:
        raise InputError(f"{name} names the material of {len(value)} yarns, must be of {count}")
    for k in value:
        indices(name, [k], materials, "material")
    return np.array(value)


def checked_spacing(value: Any, rows: int, columns: int) -> float | tuple[Numbers, Numbers]:
    """Checks distances: one, or those of warp yarns and of weft yarns, each a number or one for each gap."""
    if is_number(value):
        return real("spacing", value, above=0.0)
    if len(value) != 2:
        raise InputError(f"spacing = {value!r}, must be a number, or two: of warp yarns, and of weft yarns")
    warp = checked_numbers("spacing[0]", value[0], rows - 1, "the distances of neighbouring warp yarns", above=0.0)
    weft = checked_numbers("spacing[1]", value[1], columns - 1, "the distances of neighbouring weft yarns", above=0.0)
    return simplest(warp, weft)


def checked_crimp(value: Any, rows: int, columns: int) -> float | tuple[Numbers, Numbers]:
    """Checks crimps: one, or those of warp yarns and of weft yarns, each a number or one for each yarn."""
    if is_number(value):
        return real("crimp", value, least=0.0)
    if len(value) != 2:
        raise InputError(f"crimp = {value!r}, must be a number, or two: of warp yarns, and of weft yarns")
    warp = checked_numbers("crimp[0]", value[0], rows, "those of the warp yarns", least=0.0)
    weft = checked_numbers("crimp[1]", value[1], columns, "those of the weft yarns", least=0.0)
    return simplest(warp, weft)


def is_number(value: Any) -> bool:
    """Tells whether a value is to be one number, and no list of them."""
    if isinstance(value, np.ndarray):
        return value.ndim == 0
    return isinstance(value, str) or not isinstance(value, Sequence) or len(value) == 0


def simplest(warp: Numbers, weft: Numbers) -> float | tuple[Numbers, Numbers]:
    """Gives one number where all are the same."""
    every = np.append(warp, weft)
    return float(every[0]) if (every == every[0]).all() else (warp, weft)


def checked_numbers(name: str, value: Any, count: int, what: str, **allowed: float) -> Numbers:
    """Gives a number, or an array of so many; one number where all are the same."""
    if is_number(value):
        return real(name, value, **allowed)
    array = finite_array(name, value, (None,))
    if len(array) != count:
        raise InputError(f"{name} has {len(array)} numbers, must be one, or {count}: {what}")
    for k, each in enumerate(array.tolist()):
        real(f"{name}[{k}]", each, **allowed)
    return float(array[0]) if (array == array[0]).all() else array


def checked_of_crossings(name: str, value: Any, nodes: int, materials: int) -> Numbers:
    """Gives one of ``OF_CROSSINGS``: a number, one of each pair of materials, or one of each node."""
    if is_number(value):
        return real(name, value, **OF_CROSSINGS[name])
    # a list of lists, or a matrix
    array = finite_array(name, value, (None,) * (1 if is_number(value[0]) else 2))
    if array.shape not in ((nodes,), (materials, materials)):
        raise InputError(
            f"{name} has shape {array.shape}, must be a number, ({materials}, {materials}): by the materials of the "
            f"warp yarn and the weft yarn, or ({nodes},): by node"
        )
    for where in np.ndindex(array.shape):
        real(f"{name}[{', '.join(map(str, where))}]", array[where].item(), **OF_CROSSINGS[name])
    return array


def check_room(distance: Numbers, halves: np.ndarray, kind: str) -> None:
    """Raises an InputError where neighbouring yarns of one direction overlap.

    Args:
        distance: of neighbours [yarns - 1].
        halves: half the widths [yarns].
        kind: "warp" or "weft".
    """
    distance = np.broadcast_to(distance, len(halves) - 1)
    needed = halves[:-1] + halves[1:]
    k = int((needed / distance).argmax())
    if needed[k] > distance[k] * (1.0 + 1e-12):
        raise InputError(
            f"{kind} yarns {k} and {k + 1} are {2.0 * halves[k]:g} m and {2.0 * halves[k + 1]:g} m wide, and "
            f"{distance[k]:g} m apart: half their widths, together {needed[k]:g} m, must be at most that, or they "
            "overlap"
        )
