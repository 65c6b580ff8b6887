"""Coarser and coarser grids of yarns over a cloth, as index arrays for the multilevel preconditioner.

Level 0 is the cloth. The next level keeps every second warp yarn and every second weft yarn, and the last of each, down
to a level of at most ``COARSEST`` nodes, which is solved exactly. What a level makes of a vector is interpolated
bilinearly to the level below, so a node there has one, two or four parents. The matrix of a level is R Aₗ Rᵀ of the one
below (Galerkin), R being the transpose of the interpolation.

Nothing here asks for a rectangle: nodes are known by their two yarns, and where a parent is missing, the others take
its part.
"""

import dataclasses

import numpy as np

from .topology import Topology

COARSEST = 9
"""Nodes of a level that is solved exactly: 3 × 3 yarns."""
FEWEST = 3
"""Yarns of a direction that are not coarsened further."""
OFFSETS = ((0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, -1), (1, 2), (1, -2), (2, 1), (2, -1))
"""Where the upper neighbours of a coarse node are, in (warp yarns, weft yarns): nothing else comes of R Aₗ Rᵀ, neither
of the cloth's stencil nor of this one."""
BLOCKS = 1 + len(OFFSETS)
"""Matrix blocks of a coarse node: its own, and those of its upper neighbours."""


@dataclasses.dataclass(frozen=True)
class Levels:
    """Index arrays, int32 where not said otherwise. Coarse nodes are numbered through all levels, finest first."""

    line_start: np.ndarray
    """[yarns + 1]: where the nodes of each of the cloth's yarns begin in ``line_node``; warp yarns first."""
    line_node: np.ndarray
    """[2 nodes]: the nodes of every yarn, in their order."""
    warp_lines: int
    lower: np.ndarray
    """[nodes, 6]: the node whose upper neighbour in this slot a node is, or -1."""
    level_start: np.ndarray
    """[levels + 1]: where the nodes of each coarse level begin."""
    coarse_line_start: np.ndarray
    coarse_line_node: np.ndarray
    coarse_warp_lines: int
    """As of the cloth, for the yarns of all coarse levels but the last: warp yarns of all levels first."""
    parent: np.ndarray
    """[nodes + coarse nodes, 4]: coarse nodes, -1 where there is none."""
    parent_weight: np.ndarray
    """[nodes + coarse nodes, 4] (float64)."""
    child_start: np.ndarray
    """[coarse nodes + 1]: where the children of each coarse node begin in ``child``."""
    child: np.ndarray
    """Nodes of the level below: of the cloth, or coarse ones."""
    child_weight: np.ndarray
    """(float64)"""
    block_start: np.ndarray
    """[BLOCKS · coarse nodes + 1]: where the parts of each matrix block begin in ``part``."""
    part: np.ndarray
    """Blocks of the level below: of the cloth, diagonal ones by their node and upper ones by nodes + stencil · node +
    slot; of a coarse level by BLOCKS · node + (0 or 1 + slot). What stands there transposed is ~ of that."""
    part_weight: np.ndarray
    """(float64)"""
    coarsest_slot: np.ndarray
    """[nodes of the last level, nodes of the last level]: which block of the first another one is, 0 its own; or -1."""

    @property
    def coarse_nodes(self) -> int:
        return int(self.level_start[-1])


def levels(topology: Topology, stencil: int, free: np.ndarray) -> Levels:
    """Builds the levels of a cloth.

    Args:
        topology: its index arrays.
        stencil: how many upper neighbours of a node the matrix has: 2, 4, 6 or 8.
        free: [nodes] whether a node moves; what is held takes no part in any level.
    """
    place = topology.place
    near = topology.neighbour[:, :stencil]
    node, slot = np.nonzero(near >= 0)
    other = near[node, slot]
    lower = np.full((topology.nodes, stencil), -1, dtype=np.int32)
    lower[other, slot] = node
    # every pair (a, b) of nodes with a block of the matrix, and where it stands
    every = np.arange(topology.nodes)
    upper = topology.nodes + stencil * node + slot
    pairs = np.concatenate([[every, every, every], [node, other, upper], [other, node, ~upper]], axis=1)

    starts, lines_of = [0], _yarns(topology)
    coarse_lines: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    parents, weights, children, parts = [], [], [], []
    active, own = np.asarray(free, dtype=bool), topology.is_end == 0
    while len(place) > COARSEST:
        kept = [_kept(place[:, d]) for d in range(2)]
        up, weight, coarse = _interpolation(place, kept, own)
        if len(coarse) in (0, len(place)):
            break
        weight = weight * active[:, None]
        up = np.where(weight > 0.0, up, -1)
        first = starts[-1]
        parents.append(np.where(up >= 0, up + first, -1))
        weights.append(weight)
        below, k = np.nonzero(up >= 0)
        children.append((up[below, k] + first, below + (starts[-2] if len(starts) > 1 else 0), weight[below, k]))
        block, source, factor = _galerkin(pairs, up, weight, coarse)
        parts.append((block + BLOCKS * first, source, factor))
        starts.append(first + len(coarse))
        pairs = _coarse_pairs(coarse, first)
        place, active = coarse, np.ones(len(coarse), dtype=bool)
        own = active
        if len(place) > COARSEST:
            for found, line in zip(coarse_lines, _lines(place), strict=True):
                found.extend(nodes + first for nodes in line)
    count = starts[-1]
    parents.append(np.full((len(place) if count else topology.nodes, 4), -1))
    weights.append(np.zeros(parents[-1].shape))
    child_start, child, child_weight = _grouped(children, count)
    block_start, part, part_weight = _grouped(parts, BLOCKS * count)
    line_start, line_node = _joined([*lines_of[0], *lines_of[1]])
    coarse_line_start, coarse_line_node = _joined([*coarse_lines[0], *coarse_lines[1]])
    return Levels(
        line_start=line_start,
        line_node=line_node,
        warp_lines=len(lines_of[0]),
        lower=lower,
        level_start=np.array(starts, dtype=np.int32),
        coarse_line_start=coarse_line_start,
        coarse_line_node=coarse_line_node,
        coarse_warp_lines=len(coarse_lines[0]),
        parent=np.concatenate(parents).astype(np.int32),
        parent_weight=np.concatenate(weights),
        child_start=child_start,
        child=child,
        child_weight=child_weight,
        block_start=block_start,
        part=part,
        part_weight=part_weight,
        coarsest_slot=_slots(place) if count else np.zeros((0, 0), dtype=np.int32),
    )


def _yarns(topology: Topology) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Lists the nodes of every warp yarn, and of every weft yarn, in their order; a node that one direction has no yarn
    at is a line of its own there."""
    result = []
    for direction in range(2):
        mine = topology.yarn_direction[topology.segment_yarn] == direction
        yarn = len(topology.yarn_direction) + np.arange(topology.nodes)
        yarn[topology.segment_nodes[mine]] = topology.segment_yarn[mine, None]
        order = np.argsort(yarn, kind="stable")
        result.append(np.split(order, np.flatnonzero(np.diff(yarn[order])) + 1))
    return result[0], result[1]


def _lines(place: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Lists the coarse nodes of every warp yarn, and of every weft yarn, in their order, from gap to gap."""
    result = []
    for yarn, along in (place.T, place.T[::-1]):
        order = np.lexsort((along, yarn))
        apart = (np.diff(yarn[order]) != 0) | (np.diff(along[order]) != 1)
        result.append(np.split(order, np.flatnonzero(apart) + 1))
    return result[0], result[1]


def _kept(yarn: np.ndarray) -> np.ndarray:
    """Picks the yarns of a direction that the next level keeps: every second and the last, or all of few."""
    yarns = np.unique(yarn)
    if len(yarns) <= FEWEST:
        return yarns
    return np.unique(np.append(yarns[::2], yarns[-1]))


def _interpolation(
    place: np.ndarray, kept: list[np.ndarray], own: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finds the parents [nodes, 4] and their weights, and the places of the coarse nodes [coarse, 2] by the kept yarns'
    count. What does not have a place of its own has the parents of what is there, and moves with it."""
    sides = []
    for d in range(2):
        # the place of a yarn between those that are kept
        after = np.searchsorted(kept[d], place[:, d])
        exact = kept[d][after] == place[:, d]
        sides.append((np.where(exact, after, after - 1), after, np.where(exact, 1.0, 0.5), np.where(exact, 0.0, 0.5)))
    stays = own & (sides[0][3] == 0.0) & (sides[1][3] == 0.0)
    coarse = np.stack([sides[0][1], sides[1][1]], axis=1)[stays]
    order = np.lexsort((coarse[:, 1], coarse[:, 0]))
    coarse = coarse[order]
    index = np.full((len(kept[0]), len(kept[1])), -1)
    index[coarse[:, 0], coarse[:, 1]] = np.arange(len(coarse))
    up, weight = np.full((len(place), 4), -1), np.zeros((len(place), 4))
    for k in range(4):
        j, i = k // 2, k % 2
        up[:, k] = index[sides[0][j], sides[1][i]]
        weight[:, k] = sides[0][2 + j] * sides[1][2 + i] * (up[:, k] >= 0)
    total = weight.sum(axis=1, keepdims=True)
    return up, weight / np.where(total > 0.0, total, 1.0), coarse


def _galerkin(
    pairs: np.ndarray, up: np.ndarray, weight: np.ndarray, coarse: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lists what every block of R A Rᵀ is made of: its number on this level, the block below, and its weight."""
    slot_of = _slot_table()
    a, b, source = pairs
    found = []
    for k in range(4):
        for m in range(4):
            row, column = up[a, k], up[b, m]
            some = (row >= 0) & (column >= row)
            # what is sewn together may be anywhere: that has no part in the levels
            apart = coarse[column * some] - coarse[row * some] + 2
            some &= ((apart >= 0) & (apart < len(slot_of))).all(axis=1)
            row, apart = row[some], apart[some]
            found.append(
                (BLOCKS * row + slot_of[tuple(apart.T)], source[some], weight[a[some], k] * weight[b[some], m])
            )
    return tuple(np.concatenate(values) for values in zip(*found, strict=True))  # type: ignore[return-value]


def _slot_table() -> np.ndarray:
    """Numbers the block of a coarse node for a neighbour that is (j − 2, i − 2) yarns away, or -1."""
    slots = np.full((5, 5), -1, dtype=np.int32)
    slots[2, 2] = 0
    for k, (j, i) in enumerate(OFFSETS):
        slots[2 + j, 2 + i] = 1 + k
    return slots


def _slots(place: np.ndarray) -> np.ndarray:
    """Finds which block of the first of two nodes the second one is."""
    apart = np.clip(place[None, :] - place[:, None], -3, 3) + 3
    return np.pad(_slot_table(), 1, constant_values=-1)[apart[..., 0], apart[..., 1]]


def _coarse_pairs(coarse: np.ndarray, first: int) -> np.ndarray:
    """Lists every pair (a, b) of coarse nodes with a block, and where it stands."""
    index = np.full(coarse.max(axis=0) + 5, -1)
    j, i = coarse.T + 2
    every = np.arange(len(coarse))
    index[j, i] = every
    own = BLOCKS * (first + every)
    found = [np.stack([every, every, own])]
    for slot, (down, across) in enumerate(OFFSETS):
        other = index[j + down, i + across]
        some = other >= 0
        a, b, source = every[some], other[some], own[some] + 1 + slot
        found += [np.stack([a, b, source]), np.stack([b, a, ~source])]
    return np.concatenate(found, axis=1)


def _grouped(items: list[tuple], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sorts (group, value, weight) of many, group by group: where each begins, values and weights."""
    if not items:
        return np.zeros(count + 1, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0)
    group, value, weight = (np.concatenate(parts) for parts in zip(*items, strict=True))
    order = np.argsort(group, kind="stable")
    start = np.searchsorted(group[order], np.arange(count + 1))
    return start.astype(np.int32), value[order].astype(np.int32), weight[order]


def _joined(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Joins lists of nodes, one behind the other, and where each begins."""
    start = np.cumsum([0, *(len(line) for line in lines)])
    nodes = np.concatenate(lines) if lines else np.zeros(0)
    return start.astype(np.int32), nodes.astype(np.int32)
