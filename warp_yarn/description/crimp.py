"""How yarns are crimped: how much longer they are than what they cover, how high they rise, and where they do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..kernels.terms.crimp_interchange import ROUND

if TYPE_CHECKING:
    from .cloth import Cloth
    from .cloths import Cloths

NEXT_TO_NONE = 1e-9
"""A crimp that is rounding."""


def crimp_height(distance: float, length: float) -> float:
    """Computes how high a yarn rises between crossings, from one extreme of its axis to the other.

    Peirce's (4/3) p √c of a crimp c = length/distance − 1, to within c/4 of it. Woven yarns have the diameters that
    they rise by together, d₁ + d₂ = h₁ + h₂.

    Args:
        distance: p of neighbouring crossings [m].
        length: of the yarn between them [m], at least that.

    Returns:
        The height [m].
    """
    return float(np.sqrt(np.maximum(np.square(length) - np.square(distance), 0.0) / ROUND))


def woven(cloth: Cloth | Cloths) -> tuple[np.ndarray, np.ndarray]:
    """Measures the segments of every yarn as woven: mean distance of crossings, and mean length of yarn [yarns] (m)."""
    topology = cloth.topology
    a, b = topology.segment_nodes.T
    yarn = topology.segment_yarn
    along = topology.yarn_direction[yarn]
    distance = np.linalg.norm(cloth.position[b] - cloth.position[a], axis=1)
    length = cloth.euler[b, along] - cloth.euler[a, along]
    count = np.bincount(yarn)
    return np.bincount(yarn, distance) / count, np.bincount(yarn, length) / count


def yarn_crimp(cloth: Cloth | Cloths) -> np.ndarray:
    """Computes c of every yarn as woven [yarns]: its length over what it covers, less 1, and 0 where that is less."""
    distance, length = woven(cloth)
    crimp = length / distance - 1.0
    return np.where(crimp > NEXT_TO_NONE, crimp, 0.0)


def heights(cloth: Cloth | Cloths) -> np.ndarray:
    """Computes how high every yarn rises as woven [yarns] (m)."""
    distance = woven(cloth)[0]
    lengths = distance * (1.0 + yarn_crimp(cloth))
    return np.array([crimp_height(p, length) for p, length in zip(distance, lengths, strict=True)])


def lacks_crimp(cloth: Cloth | Cloths) -> str:
    """Says that no yarn is crimped, or ""."""
    if yarn_crimp(cloth).any():
        return ""
    return (
        "the yarns of the cloth have no crimp, must be longer than the distances between their crossings: spacing is "
        "the length of a yarn between crossings, a pose where these are"
    )


def lacks_bending(cloth: Cloth | Cloths) -> str:
    """Says which yarn does not resist bending, or ""."""
    for k, yarn in enumerate(cloth.yarns):
        if yarn.bend == 0.0:
            return f"yarns[{k}].bend = 0, must be above 0 for crimp_interchange: nothing would say how high a slack yarn is"
    return ""


def interchange(cloth: Cloth | Cloths) -> dict[str, np.ndarray]:
    """Finds what the term runs over, of every node, named as its struct names it.

    Returns:
        crimp_sides [nodes, 4]: of the segments left, right, up and down twice the part that is the node's own, and less
        than 0 where they are straight; crimp_around [nodes, 4]: the nodes at their other ends; crimp_corners
        [nodes, 4]: matrix blocks of a crossing's corners, as ``Topology.corner_blocks``; crimp_yarns [2 nodes]: the
        yarns of each node.
    """
    topology = cloth.topology
    a, b = topology.segment_nodes.T
    along = topology.yarn_direction[topology.segment_yarn]
    sides: np.ndarray = np.zeros((topology.nodes, 4), dtype=np.int32)
    around, corners = np.zeros_like(sides), np.zeros_like(sides)
    yarns: np.ndarray = np.zeros((topology.nodes, 2), dtype=np.int32)
    around[a, 2 * along + 1], around[b, 2 * along] = b, a
    yarns[a, along] = yarns[b, along] = topology.segment_yarn
    corners[topology.crossing_node] = topology.corner_blocks
    inside_a, inside_b = topology.is_crossing[a] != 0, topology.is_crossing[b] != 0
    between = np.where(topology.flipped[a] != topology.flipped[b], 1, -1)
    # one on the border continues as the crossing beside it, and a border yarn is straight
    sides[a, 2 * along + 1] = np.where(inside_a & inside_b, between, np.where(inside_a, 2, np.where(inside_b, 0, -2)))
    sides[b, 2 * along] = np.where(inside_a & inside_b, between, np.where(inside_b, 2, 0))
    return {
        "crimp_sides": sides,
        "crimp_around": around,
        "crimp_corners": corners,
        "crimp_yarns": yarns.ravel(),
    }
