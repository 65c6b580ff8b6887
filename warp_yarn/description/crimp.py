"""How yarns are crimped: how much longer they are than what they cover, how high they rise, and where they do."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, WarpYarnWarning, choice
from .woven import Woven

if TYPE_CHECKING:
    from .cloth import Cloth

CONTACT_FORCES = ("published", "crimped")
UNLIKE = 1.25
"""Times by which heights and thicknesses of yarns differ that hardly are of one cloth."""
ROUND = 9.0 / 8.0
"""β², by which yarns are round at their bends, as of ``kernels/terms/crimped_segment.py``."""


def crimp_height(distance: Any, length: Any) -> Any:
    """Computes how high a yarn rises between crossings, from one extreme of its axis to the other.

    Peirce's (4/3) p √c of a crimp c = length/distance − 1, to within c/4 of it. Woven yarns have the diameters that
    they rise by together, d₁ + d₂ = h₁ + h₂.

    Args:
        distance: p of neighbouring crossings [m], or an array of them.
        length: of the yarn between them [m], at least that.

    Returns:
        The height [m].
    """
    return np.sqrt(np.maximum(np.square(length) - np.square(distance), 0.0) / ROUND)


def heights(cloth: Woven) -> np.ndarray:
    """Computes how high every yarn rises as woven, over the mean of the distances between those that it crosses, of one
    that crosses a single one those of its ends [yarns] (m)."""
    topology, yarn = cloth.topology, cloth.topology.segment_yarn
    between = (topology.is_end[topology.segment_nodes] == 0).all(axis=1)
    counted = between | (np.bincount(yarn, between)[yarn] == 0)
    distance = np.bincount(yarn, cloth.segment_spacing * counted) / np.bincount(yarn, counted)
    return crimp_height(distance, distance * (1.0 + cloth.yarn_crimp))


def room(cloth: Woven) -> float:
    """Computes how high yarns rise together as woven, h₁ + h₂, over their thicknesses d₁ + d₂, the mean of crossings: 1
    where crimp interchange leaves the cloth at rest."""
    yarns = cloth.node_yarns[cloth.topology.crossing_node]
    return float((heights(cloth)[yarns].sum(axis=1) / (2.0 * cloth.halves[yarns, 1]).sum(axis=1)).mean())


def pressed(cloth: Cloth) -> Cloth:
    """Makes a cloth of yarns as thick as their crimps leave room for: see ``Cloth.pressed``."""
    if not cloth.yarn_crimp.any():
        raise InputError("pressed: the cloth has no crimp, must be above 0 in the warp or the weft")
    factor, yarns = room(cloth), []
    for yarn in cloth.yarns:
        half_width, half_thickness = yarn.halves(cloth.radius)
        yarns.append(
            dataclasses.replace(
                yarn,
                # kₛ and k_b of a section by this factor
                stretch=yarn.stretch / factor,
                bend=yarn.bend / factor,
                radius=None,
                width=2.0 * half_width,
                thickness=2.0 * factor * half_thickness,
            )
        )
    return cloth.replace(yarns=yarns)


def check_crimp(cloths: Sequence[Woven], contact_force: str, interchange: bool) -> None:
    """Refuses what a scene says of crimp where it does not go together, or a cloth is not for it, and warns of cloths
    that crimp interchange does not leave as they are woven.

    Raises:
        InputError: the argument, its value, and what it must be.
    """
    choice("contact_force", contact_force, CONTACT_FORCES)
    crimped = contact_force == "crimped"
    if interchange and crimped:
        raise InputError(
            "contact_force = 'crimped', must be 'published' with crimp_interchange, whose contact force is its own"
        )
    wanted = "crimp_interchange = True" if interchange else "contact_force = 'crimped'"
    for number, cloth in enumerate(cloths if interchange or crimped else ()):
        name = "the cloth" if len(cloths) == 1 else f"cloths[{number}]"
        if not cloth.yarn_crimp.any():
            raise InputError(f"{wanted}, but {name} has no crimp, must be above 0 in the warp or the weft")
        for k, yarn in enumerate(cloth.yarns):
            if interchange and yarn.bend == 0.0:
                raise InputError(
                    f"crimp_interchange = True, but yarns[{k}].bend = 0, must be above 0: nothing would say how high a "
                    "slack yarn is"
                )
        factor = room(cloth) if interchange else 1.0
        if not 1.0 / UNLIKE <= factor <= UNLIKE:
            warnings.warn(
                f"crimp_interchange = True: yarns of {name} rise {factor:.2g} times their thicknesses as they are "
                f"crimped, so it {'draws in' if factor < 1.0 else 'spreads'} at once: cloth.pressed() makes them as "
                "thick as there is room for",
                WarpYarnWarning,
                stacklevel=3,
            )


def interchange(cloth: Woven) -> dict[str, np.ndarray]:
    """Finds what the term runs over, of every node, named as its struct names it.

    Returns:
        crimp_sides [nodes, 4]: of the segments left, right, up and down twice the part that is the node's own, and less
        than 0 where they are straight; crimp_around [nodes, 4]: the nodes at their other ends; crimp_corners
        [nodes, 4]: matrix blocks of a crossing's corners, as ``Topology.corner_blocks``.
    """
    topology = cloth.topology
    a, b = topology.segment_nodes.T
    along = topology.yarn_direction[topology.segment_yarn]
    sides: np.ndarray = np.zeros((topology.nodes, 4), dtype=np.int32)
    around, corners = np.zeros_like(sides), np.zeros_like(sides)
    around[a, 2 * along + 1], around[b, 2 * along] = b, a
    corners[topology.crossing_node] = topology.corner_blocks
    inside_a, inside_b = topology.is_crossing[a] != 0, topology.is_crossing[b] != 0
    between = np.where(topology.flipped[a] != topology.flipped[b], 1, -1)
    # one on the border continues as the crossing beside it, and a border yarn is straight
    sides[a, 2 * along + 1] = np.where(inside_a & inside_b, between, np.where(inside_a, 2, np.where(inside_b, 0, -2)))
    sides[b, 2 * along] = np.where(inside_a & inside_b, between, np.where(inside_b, 2, 0))
    return {"crimp_sides": sides, "crimp_around": around, "crimp_corners": corners}
