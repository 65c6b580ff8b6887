"""How yarns are crimped: how much longer they are than what they cover, how high they rise, and where they do."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError, choice
from .woven import Woven

CONTACT_FORCES = ("published", "crimped")
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
    """Computes how high every yarn rises as woven, over the mean of the distances that it covers [yarns] (m)."""
    yarn = cloth.topology.segment_yarn
    distance = np.bincount(yarn, cloth.segment_spacing) / np.bincount(yarn)
    return crimp_height(distance, distance * (1.0 + cloth.yarn_crimp))


def check_crimp(cloth: Woven, contact_force: str, interchange: bool) -> None:
    """Refuses what a scene says of crimp where it does not go together, or the cloth is not for it.

    Raises:
        InputError: the argument, its value, and what it must be.
    """
    choice("contact_force", contact_force, CONTACT_FORCES)
    crimped = contact_force == "crimped"
    if interchange and crimped:
        raise InputError(
            "contact_force = 'crimped', must be 'published' with crimp_interchange, whose contact force is its own"
        )
    if (interchange or crimped) and not cloth.yarn_crimp.any():
        wanted = "crimp_interchange = True" if interchange else "contact_force = 'crimped'"
        raise InputError(f"{wanted}, but the cloth has no crimp, must be above 0 in the warp or the weft")
    for k, yarn in enumerate(cloth.yarns):
        if interchange and yarn.bend == 0.0:
            raise InputError(
                f"crimp_interchange = True, but yarns[{k}].bend = 0, must be above 0: nothing would say how high a "
                "slack yarn is"
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
