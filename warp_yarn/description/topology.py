"""Index arrays of a cloth: what the kernels run over.

Kernels know nothing of rows and columns. Another kind of cloth (cut to an outline: ``cutting.py``, several side by
side) is another function that returns a Topology, with nodes numbered so that every yarn runs through increasing
indices, and so that of a crossing's neighbours up comes before left, and right before down.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .weave import Weave


@dataclasses.dataclass(frozen=True)
class Topology:
    """Index arrays, int32, named as the kernels name them.

    The yarn coordinate of node i along direction d (0 warp, u; 1 weft, v) is Eulerian coordinate 2 i + d.
    """

    nodes: int
    yarn_direction: np.ndarray
    """[yarns]: 0 of a warp yarn, 1 of a weft yarn."""
    segment_nodes: np.ndarray
    """[segments, 2]: neighbouring nodes a < b of one yarn."""
    segment_yarn: np.ndarray
    bend_nodes: np.ndarray
    """[bends, 3]: three consecutive nodes a < c < b of one yarn."""
    bend_yarn: np.ndarray
    crossing_node: np.ndarray
    """[crossings]: the nodes where yarns cross, that is all but the border: those whose four neighbours are
    places where yarns meet."""
    crossing_neighbours: np.ndarray
    """[crossings, 4]: left, right, up, down."""
    is_crossing: np.ndarray
    """[nodes]: 1 at a crossing."""
    is_end: np.ndarray
    """[nodes]: 1 at the free end of a yarn that is cut between two others; no other yarn is there."""
    place: np.ndarray
    """[nodes, 2]: row and column in the weave, of a free end those of the node that it hangs at."""
    flipped: np.ndarray
    """[nodes]: the draft."""
    corner_jams: np.ndarray
    """[crossings, 4]: 1 where a crossing is flipped against both its left and up, left and down, right and up, right
    and down neighbours."""
    corner_blocks: np.ndarray
    """[crossings, 4]: matrix blocks between the same two neighbours, in a stencil six wide. In the rows of up, left, up
    and right: nodes are numbered so that up comes before left and right, and these before down."""
    triangle_nodes: np.ndarray
    """[triangles, 3]: none at free ends."""
    triangle_blocks: np.ndarray
    """[triangles, 3]: matrix blocks of its edges, in a stencil six wide."""
    neighbour: np.ndarray
    """[nodes, 6]: upper neighbours in the matrix, -1 where there is none (see ``kernels/linear/block_matrix.py``)."""


def side_by_side(parts: Sequence[Topology]) -> Topology:
    """Joins several cloths to one, their nodes and yarns numbered on from one to the next."""
    nodes = np.cumsum([0, *(part.nodes for part in parts)])
    yarns = np.cumsum([0, *(len(part.yarn_direction) for part in parts)])
    # no place in the weave is that of two nodes
    places = np.cumsum([[0, 0], *(part.place.max(axis=0) + 1 for part in parts)], axis=0)

    def moved(name: str, by: np.ndarray) -> np.ndarray:
        values = [getattr(part, name) for part in parts]
        joined = [np.where(value >= 0, value + shift, value) for value, shift in zip(values, by, strict=False)]
        return np.concatenate(joined).astype(values[0].dtype)

    still = np.zeros_like(nodes)
    offsets = {
        **dict.fromkeys(
            ("segment_nodes", "bend_nodes", "crossing_node", "crossing_neighbours", "triangle_nodes"), nodes
        ),
        **dict.fromkeys(("segment_yarn", "bend_yarn"), yarns),
        **dict.fromkeys(("corner_blocks", "triangle_blocks"), 6 * nodes),
        **dict.fromkeys(("yarn_direction", "is_crossing", "is_end", "flipped", "corner_jams"), still),
        "neighbour": nodes,
        "place": places,
    }
    return Topology(nodes=int(nodes[-1]), **{name: moved(name, by) for name, by in offsets.items()})


def blocks_between(nodes: np.ndarray, pairs: tuple[tuple[int, int], ...], neighbour: np.ndarray) -> np.ndarray:
    """Finds the matrix blocks between two of the nodes of each element, in a stencil six wide [elements, pairs].

    Args:
        nodes: of every element [elements, nodes].
        pairs: which two of them.
        neighbour: as of the topology.
    """
    result = np.empty((len(nodes), len(pairs)), dtype=np.int32)
    for k, (a, b) in enumerate(pairs):
        low, high = np.minimum(nodes[:, a], nodes[:, b]), np.maximum(nodes[:, a], nodes[:, b])
        result[:, k] = 6 * low + (neighbour[low] == high[:, None]).argmax(axis=1)
    return result


def rectangle(weave: Weave) -> Topology:
    """Takes a whole rectangle of the weave; node index = column + row·columns."""
    rows, columns = weave.rows, weave.columns
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    row, column = np.indices((rows, columns), dtype=np.int32)

    def along(warp: tuple[np.ndarray, ...], weft: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Lists the node tuples of the warp yarns and then the weft yarns, and the yarn of each."""
        nodes = [np.stack([part.ravel() for part in parts], axis=1) for parts in (warp, weft)]
        yarns = [row.ravel()[nodes[0][:, 0]], rows + column.ravel()[nodes[1][:, 0]]]
        return np.concatenate(nodes), np.concatenate(yarns)

    segment_nodes, segment_yarn = along((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
    bend_nodes, bend_yarn = along((index[:, :-2], index[:, 1:-1], index[:, 2:]), (index[:-2], index[1:-1], index[2:]))

    neighbour: np.ndarray = np.full((rows, columns, 6), -1, dtype=np.int32)
    neighbour[:, :-1, 0] = index[:, 1:]
    neighbour[:-1, :, 1] = index[1:]
    neighbour[:, :-2, 2] = index[:, 2:]
    neighbour[:-2, :, 3] = index[2:]
    neighbour[:-1, :-1, 4] = index[1:, 1:]
    neighbour[:-1, 1:, 5] = index[1:, :-1]
    neighbour = neighbour.reshape(-1, 6)

    crossing = index[1:-1, 1:-1].ravel()
    left, right, up, down = crossing - 1, crossing + 1, crossing - columns, crossing + columns
    flipped = weave.flipped.astype(np.int32).ravel()
    corners = [np.stack([p, r], axis=1) for p in (left, right) for r in (up, down)]
    jams = [np.all(flipped[pair] != flipped[crossing, None], axis=1) for pair in corners]

    # Two triangles to a cell; their diagonal alternates like a checkerboard.
    cell = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1).reshape(-1, 4)
    even = ((row + column)[:-1, :-1] % 2 == 0).reshape(-1, 1, 1)
    triangle_nodes = np.where(even, cell[:, [[0, 1, 3], [0, 3, 2]]], cell[:, [[0, 1, 2], [1, 3, 2]]]).reshape(-1, 3)

    is_crossing = np.zeros(rows * columns, dtype=np.int32)
    is_crossing[crossing] = 1
    return Topology(
        nodes=rows * columns,
        yarn_direction=np.repeat(np.array([0, 1], dtype=np.int32), (rows, columns)),
        segment_nodes=segment_nodes,
        segment_yarn=segment_yarn,
        bend_nodes=bend_nodes,
        bend_yarn=bend_yarn,
        crossing_node=crossing,
        crossing_neighbours=np.stack([left, right, up, down], axis=1),
        is_crossing=is_crossing,
        is_end=np.zeros(rows * columns, dtype=np.int32),
        place=np.stack([row.ravel(), column.ravel()], axis=1),
        flipped=flipped,
        corner_jams=np.stack(jams, axis=1).astype(np.int32),
        corner_blocks=np.concatenate([blocks_between(pair, ((0, 1),), neighbour) for pair in corners], axis=1),
        triangle_nodes=triangle_nodes,
        triangle_blocks=blocks_between(triangle_nodes, ((0, 1), (1, 2), (2, 0)), neighbour),
        neighbour=neighbour,
    )
