"""The topology of a cloth that is cut to an outline, yarn by yarn.

What a line of the weave has inside the outline is a yarn of its own, so one that a hole cuts is two. Its nodes are the
places where it meets yarns of the other direction, all of them where the rectangle has them, and its free ends, where
it is cut. A free end nearer to the last of these places than ``SHORTEST`` of the distance to the next one is left off.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from .outline import runs, tolerance
from .topology import Topology, blocks_between
from .weave import Weave

SHORTEST = 0.25
"""Of the distance between yarns: a shorter free end is stiffer than it is worth."""


@dataclasses.dataclass(frozen=True)
class Cut:
    """A cloth that is cut.

    Attributes:
        topology: its index arrays.
        at: where nodes are along u and v [nodes, 2] (m).
        yarn_line: of every yarn, which warp or weft yarn of the weave it is of [yarns].
        index: the node where two yarns of the weave meet, -1 where there is none [rows, columns].
    """

    topology: Topology
    at: np.ndarray
    yarn_line: np.ndarray
    index: np.ndarray


@dataclasses.dataclass
class _Run:
    """What a line has inside: of a direction, from its first crossing place to its last, and its free ends."""

    direction: int
    line: int
    first: int
    last: int
    ends: tuple[float | None, float | None]


def cut(weave: Weave, lines: tuple[np.ndarray, np.ndarray], polygons: Sequence[np.ndarray]) -> Cut:
    """Cuts a weave.

    Args:
        weave: the draft.
        lines: where its weft yarns are along u [columns], and its warp yarns along v [rows] (m).
        polygons: the outline, and holes, as ``outline.checked_outline`` gives them.

    Raises:
        InputError: nothing is left that is woven, or it falls apart.
    """
    shape = (len(lines[1]), len(lines[0]))
    found = _one_piece(_runs(lines, polygons), shape)
    # nodes: the places, then free ends, and in the end by rows
    present = np.zeros(shape, dtype=bool)
    for run in found:
        present[_places(run)] = True
    place = np.argwhere(present)
    ends = [(run, side) for run in found for side in (0, 1) if run.ends[side] is not None]
    roots = np.array([_root(run, side) for run, side in ends], dtype=int).reshape(-1, 2)
    place = np.concatenate([place, roots])
    at = np.stack([lines[0][place[:, 1]], lines[1][place[:, 0]]], axis=1)
    for k, (run, side) in enumerate(ends):
        at[len(at) - len(ends) + k, run.direction] = run.ends[side]
    order = np.lexsort((at[:, 0], at[:, 1]))
    number = np.empty(len(at), dtype=np.int32)
    number[order] = np.arange(len(at))
    place, at = place[order], at[order]
    index: np.ndarray = np.full(shape, -1, dtype=np.int32)
    index[present] = number[: len(at) - len(ends)]
    is_end = np.zeros(len(at), dtype=np.int32)
    is_end[number[len(at) - len(ends) :]] = 1
    end_of = {(id(run), side): int(number[len(at) - len(ends) + k]) for k, (run, side) in enumerate(ends)}
    yarns = []
    for run in found:
        nodes = index[_places(run)]
        before, after = end_of.get((id(run), 0)), end_of.get((id(run), 1))
        yarns.append(np.concatenate([[] if before is None else [before], nodes, [] if after is None else [after]]))
    direction = np.array([run.direction for run in found], dtype=np.int32)
    topology = _topology(weave, yarns, direction, index, place, is_end)
    if not len(topology.crossing_node):
        raise InputError("outline leaves no crossing with a neighbour on each of its four sides, must be larger")
    return Cut(topology, at, np.array([run.line for run in found]), index)


def between(values: np.ndarray, grid: np.ndarray, root: np.ndarray, at: np.ndarray, columns: int) -> np.ndarray:
    """Interpolates what every node of a rectangle has along its yarns, at the nodes of what is cut out of it.

    Args:
        values: of the rectangle [nodes, any].
        grid: where its nodes are [nodes, 2].
        root: the node of the rectangle that each one that is left is at, or hangs at [left].
        at: where they are [left, 2].
        columns: of the rectangle.
    """
    off = at - grid[root]
    direction = np.abs(off).argmax(axis=1)
    off = off[np.arange(len(root)), direction]
    beyond = root + np.sign(off).astype(int) * np.where(direction == 0, 1, columns)
    gap = np.where(off == 0.0, 1.0, np.abs(grid[beyond] - grid[root]).max(axis=1))
    share = (np.abs(off) / gap)[:, None]
    return values[root] + share * (values[beyond] - values[root])


def _runs(lines: tuple[np.ndarray, np.ndarray], polygons: Sequence[np.ndarray]) -> list[_Run]:
    """Lists what all lines have inside, those of warp yarns first; what meets no other yarn falls off."""
    slack = tolerance((float(lines[0][-1]), float(lines[1][-1])))
    result = []
    for direction in (0, 1):
        along = lines[direction]
        for line, at in enumerate(lines[1 - direction].tolist()):
            for begin, end in runs(polygons, direction, at, slack):
                met = np.flatnonzero((along >= begin - slack) & (along <= end + slack)).tolist()
                if not met:
                    continue
                first, last = met[0], met[-1]
                ends: list[float | None] = [None, None]
                if first > 0 and along[first] - begin > SHORTEST * (along[first] - along[first - 1]):
                    ends[0] = begin
                if last + 1 < len(along) and end - along[last] > SHORTEST * (along[last + 1] - along[last]):
                    ends[1] = end
                if first < last or ends != [None, None]:
                    result.append(_Run(direction, line, first, last, (ends[0], ends[1])))
    return result


def _places(run: _Run) -> tuple[slice | int, slice | int]:
    """Tells where in the weave the places of a run are."""
    along = slice(run.first, run.last + 1)
    return (run.line, along) if run.direction == 0 else (along, run.line)


def _root(run: _Run, side: int) -> tuple[int, int]:
    """Tells the place in the weave that a free end is at."""
    along = run.last if side else run.first
    return (run.line, along) if run.direction == 0 else (along, run.line)


def _one_piece(found: list[_Run], shape: tuple[int, int]) -> list[_Run]:
    """Picks the runs that hang together; single yarns that do not fall off.

    Raises:
        InputError: there are none, or they are several pieces.
    """
    of: np.ndarray = np.full((2, *shape), -1)
    for k, run in enumerate(found):
        of[(run.direction, *_places(run))] = k
    both = (of >= 0).all(axis=0)
    warp, weft = of[:, both]
    label = np.arange(len(found))
    while True:
        least = np.minimum(label[warp], label[weft])
        before = label.copy()
        np.minimum.at(label, warp, least)
        np.minimum.at(label, weft, least)
        if (label == before).all():
            break
    pieces, counts = np.unique(label[warp], return_counts=True)
    if not len(pieces):
        raise InputError("outline leaves nothing that is woven, must be larger than the distance between yarns")
    if len(pieces) > 1:
        raise InputError(
            f"outline leaves {len(pieces)} pieces that do not hang together, of {', '.join(map(str, counts))} places "
            "where yarns meet: cut each by an outline of its own, and give Scene a list of them"
        )
    return [run for k, run in enumerate(found) if label[k] == pieces[0]]


def _topology(
    weave: Weave,
    yarns: list[np.ndarray],
    direction: np.ndarray,
    index: np.ndarray,
    place: np.ndarray,
    is_end: np.ndarray,
) -> Topology:
    """Makes the index arrays of yarns, each given by its nodes, in the order that a rectangle has."""

    def chains(length: int) -> tuple[np.ndarray, np.ndarray]:
        nodes = [np.stack([y[k : len(y) - length + 1 + k] for k in range(length)], axis=1) for y in yarns]
        yarn = np.repeat(np.arange(len(yarns)), [len(part) for part in nodes])
        chain = np.concatenate(nodes).astype(np.int32)
        order = np.lexsort((chain[:, 0], direction[yarn]))
        return chain[order], yarn[order].astype(np.int32)

    segment_nodes, segment_yarn = chains(2)
    bend_nodes, bend_yarn = chains(3)
    nodes = len(place)
    neighbour: np.ndarray = np.full((nodes, 6), -1, dtype=np.int32)
    neighbour[segment_nodes[:, 0], direction[segment_yarn]] = segment_nodes[:, 1]
    neighbour[bend_nodes[:, 0], 2 + direction[bend_yarn]] = bend_nodes[:, 2]
    around = np.pad(index, 1, constant_values=-1)
    inside = index >= 0
    neighbour[index[inside], 4] = around[2:, 2:][inside]
    neighbour[index[inside], 5] = around[2:, :-2][inside]

    before: np.ndarray = np.full((nodes, 2), -1, dtype=np.int32)
    before[segment_nodes[:, 1], direction[segment_yarn]] = segment_nodes[:, 0]
    # left, right, up, down
    beside = np.stack([before[:, 0], neighbour[:, 0], before[:, 1], neighbour[:, 1]], axis=1)
    crosses = (beside >= 0).all(axis=1) & (is_end[beside] == 0).all(axis=1) & (is_end == 0)
    crossing = np.flatnonzero(crosses).astype(np.int32)
    flipped = np.where(crosses, weave.flipped[place[:, 0], place[:, 1]], 0).astype(np.int32)
    corners = [beside[crossing][:, [p, r]] for p in (0, 1) for r in (2, 3)]
    jams = [np.all(flipped[pair] != flipped[crossing, None], axis=1) for pair in corners]
    triangles = _triangles(index, neighbour)
    return Topology(
        nodes=nodes,
        yarn_direction=direction,
        segment_nodes=segment_nodes,
        segment_yarn=segment_yarn,
        bend_nodes=bend_nodes,
        bend_yarn=bend_yarn,
        crossing_node=crossing,
        crossing_neighbours=beside[crossing],
        is_crossing=crosses.astype(np.int32),
        is_end=is_end,
        place=place.astype(np.int32),
        flipped=flipped,
        corner_jams=np.stack(jams, axis=1).astype(np.int32),
        corner_blocks=np.concatenate([blocks_between(pair, ((0, 1),), neighbour) for pair in corners], axis=1),
        triangle_nodes=triangles,
        triangle_blocks=blocks_between(triangles, ((0, 1), (1, 2), (2, 0)), neighbour),
        neighbour=neighbour,
    )


def _triangles(index: np.ndarray, neighbour: np.ndarray) -> np.ndarray:
    """Lists the triangles of every cell whose two yarns are there, as a rectangle has them; of a cell with one corner
    or one side cut away the triangle that is left."""
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    cell = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    top, bottom = (_beside(neighbour, 0, low, high) for low, high in ((a, b), (c, d)))
    left, right = (_beside(neighbour, 1, low, high) for low, high in ((a, c), (b, d)))
    # by the diagonal from a to d, and by that from b to c
    either = np.array([[[0, 1, 3], [0, 3, 2]], [[0, 1, 2], [1, 3, 2]]])
    there = np.array([[top & right, left & bottom], [top & left, right & bottom]])
    row, column = np.indices(a.shape)
    odd = ((row + column) % 2).ravel()
    every = np.arange(len(cell))
    first = there[odd, :, every]
    other = np.where(first.any(axis=1), odd, 1 - odd)
    kept = there[other, :, every]
    return cell[every[:, None, None], either[other]][kept]


def _beside(neighbour: np.ndarray, slot: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Tells whether the second node of each pair is the first one's next on its yarn."""
    return ((low >= 0) & (high >= 0) & (neighbour[low, slot] == high)).ravel()
