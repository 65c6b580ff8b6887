"""Strips of a cloth, two neighbouring yarns each, as index arrays for the preconditioner where yarns hardly stretch.

A yarn's neighbour is the one at the next place of the weave. Along a strip are the places where at least one of the two
has a node; free ends of yarns are in none.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from .topology import Topology

SOURCES = 7
"""Matrix blocks of a place: between its two nodes; of both to both of the next place; of each to its second next."""


@dataclasses.dataclass(frozen=True)
class Strips:
    """Index arrays (int32)."""

    strip_phase: np.ndarray
    """[5]: where each of four phases begins, along the warp and the weft, of even and odd yarns. Strips of a phase have
    no node in common."""
    strip_start: np.ndarray
    """[strips + 1]: where the places of each begin."""
    strip_node: np.ndarray
    """[places, 2]: -1 where a yarn has none."""
    strip_source: np.ndarray
    """[places, SOURCES]: 1 + where a block stands: diagonal ones at their node, upper ones at nodes + stencil · node +
    slot; the negative of what stands there transposed; 0 where there is none."""


NONE = Strips(*(np.zeros(shape, dtype=np.int32) for shape in (5, 1, (0, 2), (0, SOURCES))))


def strips(topology: Topology, stencil: int) -> Strips:
    """Finds the strips of a cloth.

    Args:
        topology: its index arrays.
        stencil: how many upper neighbours of a node the matrix has: 2, 4, 6 or 8.
    """
    inside = np.flatnonzero(topology.is_end == 0)
    index = np.full(topology.place.max(axis=0) + 1, -1)
    index[tuple(topology.place[inside].T)] = inside
    nodes, starts, phases = [], [0], [0]
    for yarns in (index, index.T):
        for parity in range(2):
            for first in range(parity, len(yarns) - 1, 2):
                pair = yarns[first : first + 2].T
                if not (pair >= 0).any(axis=0).all():
                    continue
                pair = pair[(pair >= 0).any(axis=1)]
                # places apart from each other have no block between them
                nodes.append(pair)
                starts.append(starts[-1] + len(pair))
            phases.append(len(starts) - 1)
    node = np.concatenate(nodes) if nodes else np.zeros((0, 2), dtype=int)
    strip = np.repeat(np.arange(len(starts) - 1), np.diff(starts))

    def ahead(places: int) -> np.ndarray:
        """Give the nodes so many places on, of the same strip."""
        result = np.full_like(node, -1)
        if places < len(node):
            same = strip[places:] == strip[:-places]
            result[:-places][same] = node[places:][same]
        return result

    find = _finder(topology, stencil)
    a, b = node.T
    (next_a, next_b), (second_a, second_b) = ahead(1).T, ahead(2).T
    pairs = ((a, b), (a, next_a), (a, next_b), (b, next_a), (b, next_b), (a, second_a), (b, second_b))
    source = np.stack([find(*pair) for pair in pairs], axis=1)
    return Strips(*(np.array(values, dtype=np.int32) for values in (phases, starts, node, source)))


def _finder(topology: Topology, stencil: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Makes what finds the blocks between nodes and others, or 0."""
    near = topology.neighbour[:, :stencil]
    node, slot = np.nonzero(near >= 0)
    key = node * topology.nodes + near[node, slot]
    place = 1 + topology.nodes + stencil * node + slot
    order = np.argsort(key)
    key, place = key[order], place[order]

    def find(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        low, high = np.minimum(a, b), np.maximum(a, b)
        wanted = low * topology.nodes + high
        at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where((low >= 0) & (key[at] == wanted), np.where(a < b, place[at], -place[at]), 0)

    return find
