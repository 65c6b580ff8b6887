"""Pairs of nodes that are sewn together, and where their blocks stand in the matrix."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError, brief, finite_array, indices
from .topology import Topology

WIDTH = 8
"""Of the stencil with seams: that of a weave, and two slots for them."""


def checked_seams(value: Any, nodes: int) -> np.ndarray:
    """Gives pairs of different nodes [seams, 2], int32, the lower one first, or an InputError."""
    lists = isinstance(value, Sequence) and not isinstance(value, str)
    if not lists and not (isinstance(value, np.ndarray) and value.ndim):
        raise InputError(f"seams = {brief(value)}, must be pairs of nodes, [n, 2]")
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
    of_node = np.bincount(result.ravel())
    if of_node.max() > 2:
        raise InputError(f"seams has node {of_node.argmax()} {of_node.max()} times, must have at most two of a node")
    return result


def sewn(topology: Topology, seams: np.ndarray) -> tuple[Topology, np.ndarray]:
    """Makes room in the matrix for seams: the topology with a stencil ``WIDTH`` wide, and the block of each seam."""
    if not len(seams):
        return topology, np.zeros(0, dtype=np.int32)
    neighbour: np.ndarray = np.full((topology.nodes, WIDTH), -1, dtype=np.int32)
    neighbour[:, :6] = topology.neighbour
    slot = _slots(seams)
    neighbour[seams[:, 0], slot] = seams[:, 1]
    return dataclasses.replace(topology, neighbour=neighbour), (WIDTH * seams[:, 0] + slot).astype(np.int32)


def _slots(seams: np.ndarray) -> np.ndarray:
    """Picks one of the two slots for every seam, another one than that of a seam with the same lower or the same upper
    node: every slot of a node is one lower neighbour at most, too."""
    at: dict[tuple[int, int], list[int]] = {}
    for k, seam in enumerate(seams.tolist()):
        for side, node in enumerate(seam):
            at.setdefault((side, node), []).append(k)
    slot = np.full(len(seams), -1)
    for first in range(len(seams)):
        # along chains and rings of them, which share a lower and an upper node by turns
        todo = [] if slot[first] >= 0 else [first]
        slot[todo] = 6
        while todo:
            k = todo.pop()
            beside = {m for side in (0, 1) for m in at[side, int(seams[k, side])] if slot[m] < 0}
            slot[list(beside)] = 13 - slot[k]
            todo += beside
    return slot
