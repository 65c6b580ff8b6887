"""Weaves, and the index arrays that the kernels run over."""

import functools
import itertools

import numpy as np
import pytest
from cases import YARNS
from reference import Oracle, draft

import warp_yarn as wy
from warp_yarn.description.topology import Topology

SIZES = ((3, 3), (5, 5), (4, 7), (9, 6))
CLOTHS = tuple(itertools.product(wy.WEAVES, SIZES))


@functools.cache
def woven(name: str, size: tuple[int, int]) -> tuple[Topology, Oracle]:
    """The topology, and the oracle's own idea of the same cloth."""
    cloth = wy.Cloth(wy.WEAVES[name](rows=size[0], columns=size[1]), yarns=YARNS[:1])
    return cloth.topology, Oracle(wy.Scene(cloth, pins=[0]))


def corner_nodes(t: Topology) -> np.ndarray:
    """(warp neighbour, crossing, weft neighbour) of every corner."""
    left, right, up, down = t.crossing_neighbours.T
    pairs = ((left, up), (left, down), (right, up), (right, down))
    return np.stack([np.stack([p, t.crossing_node, r], axis=1) for p, r in pairs], axis=1).reshape(-1, 3)


each = pytest.mark.parametrize(("name", "size"), CLOTHS, ids=[f"{name}-{j}x{i}" for name, (j, i) in CLOTHS])


@each
def test_counts(name: str, size: tuple[int, int]) -> None:
    t, _ = woven(name, size)
    rows, columns = size
    assert t.nodes == rows * columns
    assert t.yarn_direction.tolist() == [0] * rows + [1] * columns
    assert t.segment_nodes.shape == (rows * (columns - 1) + columns * (rows - 1), 2)
    assert t.bend_nodes.shape == (rows * (columns - 2) + columns * (rows - 2), 3)
    assert t.crossing_node.shape == ((rows - 2) * (columns - 2),)
    assert t.is_crossing.sum() == len(t.crossing_node)
    assert t.corner_jams.shape == t.corner_blocks.shape == (len(t.crossing_node), 4)
    assert t.triangle_nodes.shape == (2 * (rows - 1) * (columns - 1), 3)
    assert all(values.dtype == np.int32 for values in vars(t).values() if isinstance(values, np.ndarray))


@each
def test_elements_are_those_of_rows_and_columns(name: str, size: tuple[int, int]) -> None:
    """Each once."""
    t, o = woven(name, size)
    for length, nodes, yarn in ((2, t.segment_nodes, t.segment_yarn), (3, t.bend_nodes, t.bend_yarn)):
        expected = {
            (*(o.node(*at) for at in chain), chain[0][0] if direction == 0 else size[0] + chain[0][1], direction)
            for chain, direction, _ in o.chains(length)
        }
        actual = {(*map(int, n), int(y), int(t.yarn_direction[y])) for n, y in zip(nodes, yarn, strict=True)}
        assert actual == expected
        assert len(nodes) == len(expected)
    assert t.crossing_node.tolist() == [o.node(j, i) for j, i in o.crossings()]
    assert np.flatnonzero(t.is_crossing).tolist() == t.crossing_node.tolist()
    expected = [[o.node(j, i - 1), o.node(j, i + 1), o.node(j - 1, i), o.node(j + 1, i)] for j, i in o.crossings()]
    assert t.crossing_neighbours.tolist() == expected
    assert {tuple(n) for n in corner_nodes(t).tolist()} == {tuple(o.node(*at) for at in c) for c in o.corners()}
    assert {frozenset(n) for n in t.triangle_nodes.tolist()} == {frozenset(n) for n in o.triangles()}


@each
def test_nodes_of_a_yarn_stand_in_order(name: str, size: tuple[int, int]) -> None:
    """a < b, which the matrix' upper half rests on, and in the direction of growing u or v."""
    t, _ = woven(name, size)
    for nodes in (t.segment_nodes, t.bend_nodes):
        assert np.all(np.diff(nodes, axis=1) > 0)
    # and what shear rests on
    left, right, up, down = t.crossing_neighbours.T
    assert np.all(np.diff([up, left, t.crossing_node, right, down], axis=0) > 0)


@each
def test_triangles_all_turn_the_same_way_and_cover_the_cloth(name: str, size: tuple[int, int]) -> None:
    t, _ = woven(name, size)
    row, column = np.divmod(t.triangle_nodes, size[1])
    (x1, x2), (y1, y2) = np.diff(column, axis=1).T, np.diff(row, axis=1).T
    assert np.all(x1 * y2 - x2 * y1 == 1)


@each
def test_corners_jam_between_opposite_neighbours(name: str, size: tuple[int, int]) -> None:
    t, o = woven(name, size)
    flipped = np.array(o.flipped).ravel()
    for (p, c, r), jams in zip(corner_nodes(t), t.corner_jams.ravel(), strict=True):
        assert jams == (flipped[c] != flipped[p] and flipped[c] != flipped[r])


@each
def test_matrix_slots(name: str, size: tuple[int, int]) -> None:
    """Upper neighbours: next and second next along both yarns, and the two diagonal ones; -1 beyond the border."""
    t, o = woven(name, size)
    offsets = ((0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, -1))
    for j, i in itertools.product(*map(range, size)):
        expected = [o.node(j + dj, i + di) if j + dj < size[0] and 0 <= i + di < size[1] else -1 for dj, di in offsets]
        assert t.neighbour[o.node(j, i)].tolist() == expected


@each
def test_blocks_are_those_of_their_pairs(name: str, size: tuple[int, int]) -> None:
    """Block 6 n + k couples node n with its upper neighbour k."""
    t, _ = woven(name, size)
    for nodes, blocks, pairs in (
        (corner_nodes(t), t.corner_blocks.reshape(-1, 1), ((0, 2),)),
        (t.triangle_nodes, t.triangle_blocks, ((0, 1), (1, 2), (2, 0))),
    ):
        for k, pair in enumerate(pairs):
            low, slot = np.divmod(blocks[:, k], 6)
            coupled = np.stack([low, t.neighbour[low, slot]], axis=1)
            assert np.array_equal(coupled, np.sort(nodes[:, pair], axis=1))


# -- weaves ----------------------------------------------------------------------------------------------------------


@each
def test_weave_follows_its_formula(name: str, size: tuple[int, int]) -> None:
    t, o = woven(name, size)
    weave = wy.WEAVES[name](rows=size[0], columns=size[1])
    assert weave.flipped.tolist() == draft(name, *size)
    assert t.flipped.reshape(size).tolist() == o.flipped
    assert (weave.rows, weave.columns, weave.name) == (*size, name)


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("plain", [".#.#", "#.#.", ".#.#", "#.#."]),
        ("twill", ["..##", ".##.", "##..", "#..#"]),
        ("satin", ["#...", "..#.", ".#..", "...#"]),
    ],
)
def test_weave_looks_as_it_is_called(name: str, inside: list[str]) -> None:
    """Over one under one; over two under two, shifted by one; one in four, no two beside each other.

    Drawn of the crossings inside a 6 × 6 cloth, by hand from the formulas.
    """
    flipped = wy.WEAVES[name](rows=6, columns=6).flipped[1:-1, 1:-1]
    assert ["".join("#" if f else "." for f in row) for row in flipped] == inside


@pytest.mark.parametrize("kind", [bool, int, float, list])
def test_any_draft(kind: type) -> None:
    """Of 0 and 1; the border is never flipped."""
    values = np.random.default_rng(5).integers(0, 2, (5, 7))
    values[0], values[:, -1] = 1, 1
    weave = wy.Weave(values.tolist() if kind is list else values.astype(kind), name="mine")
    inside = np.zeros((5, 7), dtype=bool)
    inside[1:-1, 1:-1] = True
    assert np.array_equal(weave.flipped, (values == 1) & inside)
    assert np.array_equal(wy.Cloth(weave, yarns=YARNS[:1]).topology.flipped, weave.flipped.ravel())
