"""Pairs of nodes that are sewn together, and where their blocks stand in the matrix."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import InputError, finite_array, indices
from .topology import Topology

WIDTH = 8
"""Of the stencil with seams: that of a weave, and two slots for them."""


def checked_seams(value: Any, nodes: int) -> np.ndarray:
    """Gives pairs of different nodes [seams, 2], int32, the lower one first, or an InputError."""
    if isinstance(value, str) or np.ndim(value) == 0:
        raise InputError(f"seams = {value!r}, must be pairs of nodes, [n, 2]")
    if len(value) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    pairs = finite_array("seams", value, (None, 2))
    result = np.empty(pairs.shape, dtype=np.int32)
    for k, pair in enumerate(np.asarray(value).tolist()):
        if pair[0] == pair[1]:
            raise InputError(f"seams[{k}] = {pair}, must be two different nodes")
        result[k] = np.sort(indices(f"seams[{k}]", pair, nodes, "node"))
    same, counts = np.unique(result, axis=0, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"seams has the nodes {same[counts.argmax()].tolist()} twice, must have each pair once")
    return result


def sewn(topology: Topology, seams: np.ndarray) -> tuple[Topology, np.ndarray]:
    """Makes room in the matrix for seams: the topology with a stencil ``WIDTH`` wide, and the block of each seam there.

    Raises:
        InputError: a node that is sewn to too many others.
    """
    if not len(seams):
        return topology, np.zeros(0, dtype=np.int32)
    neighbour: np.ndarray = np.full((topology.nodes, WIDTH), -1, dtype=np.int32)
    neighbour[:, :6] = topology.neighbour
    # every slot is one lower neighbour at most, too
    lower = np.zeros((topology.nodes, WIDTH), dtype=bool)
    blocks = np.empty(len(seams), dtype=np.int32)
    for k, (a, b) in enumerate(seams.tolist()):
        free = [slot for slot in range(6, WIDTH) if neighbour[a, slot] < 0 and not lower[b, slot]]
        if not free:
            raise InputError(
                f"seams[{k}] = [{a}, {b}] is one too many of one of these nodes, must be at most two of a node"
            )
        neighbour[a, free[0]], lower[b, free[0]] = b, True
        blocks[k] = WIDTH * a + free[0]
    return dataclasses.replace(topology, neighbour=neighbour), blocks
