"""The multilevel line preconditioner against a dense computation of its definition, from the assembled matrix."""

import dataclasses
import functools
import itertools
import math
from unittest import mock

import numpy as np
import pytest
from cases import make_state

import warp_yarn as wy
from warp_yarn.device import defaults
from warp_yarn.device.threads import SOLVED
from warp_yarn.presets.fabrics import FABRICS

FEWEST, COARSEST = 3, 9
"""Yarns that are not coarsened further, and nodes of a level that is solved exactly."""


@functools.cache
def simulator(
    fabric: str,
    rows: int,
    columns: int,
    sliding: bool,
    pins: str = "none",
    precision: str = "double",
    with_strips: bool = False,
    **options,
) -> wy.Simulator:
    return simulator_of(FABRICS[fabric](rows=rows, columns=columns), sliding, pins, precision, with_strips, **options)


def simulator_of(
    cloth: wy.Cloth,
    sliding: bool,
    pins: str = "none",
    precision: str = "double",
    with_strips: bool | None = False,
    **options,
) -> wy.Simulator:
    """With strips, without, or by default."""
    held = [] if pins == "none" else cloth.corners("top")
    if pins == "exact":
        held = [*held, cloth.node(1, 1), cloth.node(1, 2)]
    acts = {"pins": held, "pin_stiffness": None if pins == "exact" else 1e4}
    scene = wy.Scene(cloth, sliding=sliding, **acts)
    limit = {None: defaults.INEXTENSIBLE, False: 0.0, True: math.inf}[with_strips]
    with mock.patch.object(defaults, "INEXTENSIBLE", limit):
        sim = wy.Simulator(scene, integrator="linear", preconditioner="multilevel", precision=precision, **options)
    return sim


def assemble(sim: wy.Simulator, name: str, stage: float):
    """The matrix of a state, which is factorized too; and what is free."""
    state = make_state(sim.scene.cloth, name, sim.scene.sliding)
    system = sim.system(state, weights=(1.0, stage, stage * stage))
    sim.model.factorize()
    return system.dense(), system.free


def apply(sim: wy.Simulator, r: np.ndarray) -> np.ndarray:
    """P⁻¹ r: what the conjugate gradient has before its first iteration, from a start of 0."""
    a, n = sim.arrays, 3 * sim.scene.cloth.nodes
    a.zero("solution", "euler_solution")
    a["rhs"].assign(r[:n].reshape(-1, 3))
    if sim.scene.sliding:
        a["euler_rhs"].assign(r[n:])
    arrays = {name: a[name] for name in SOLVED}
    sim.model.launch("multilevel_conjugate_gradient", 1, thread=0, most_iterations=0, **arrays)
    a.zero("status")
    parts = [a["t_x"].numpy().ravel()]
    if sim.scene.sliding:
        parts.append(a["t_s"].numpy())
    return np.concatenate(parts).astype(np.float64)


# -- the definition, dense --------------------------------------------------------------------------------------------


def inverse_where_free(m: np.ndarray, free: np.ndarray) -> np.ndarray:
    result = np.zeros_like(m)
    result[np.ix_(free, free)] = np.linalg.inv(m[np.ix_(free, free)])
    return result


def lines(a: np.ndarray, rows: int, columns: int, free: np.ndarray, part: float = 0.5) -> np.ndarray:
    """Σ over yarns (L⁻¹ − part · D⁻¹), of a matrix of positions. Of one with rates behind them L has both rates of each
    node, the one across the yarn coupled to its own node alone."""
    nodes = rows * columns
    rates = len(a) > 3 * nodes
    result = np.zeros_like(a)
    grid = np.arange(nodes).reshape(rows, columns)
    yarns = [(0, line) for line in grid] + [(1, line) for line in grid.T]
    for direction, line in yarns:
        of_rates = [direction, 1 - direction] if rates else []
        unknowns = [
            np.concatenate([3 * i + np.arange(3), [3 * nodes + 2 * i + d for d in of_rates]]).astype(int) for i in line
        ]
        every = np.concatenate(unknowns)
        k, at = len(unknowns[0]), np.split(np.arange(len(every)), len(line))
        m = np.zeros((len(every), len(every)))
        for p, q in itertools.product(range(len(line)), repeat=2):
            block = a[np.ix_(unknowns[p], unknowns[q])].copy()
            if p != q:
                block[4:] = block[:, 4:] = 0.0
            if abs(p - q) <= 1:
                m[np.ix_(at[p], at[q])] += block
            elif abs(p - q) == 2:
                # beyond the next node: on the diagonal of both, this one when it is p
                m[np.ix_(at[p], at[p])] += 0.5 * (block + block.T)
        moves = free[every]
        result[np.ix_(every, every)] += inverse_where_free(m, moves)
        for p in range(len(line)):
            x = at[p][:3]
            result[np.ix_(every[x], every[x])] -= part * inverse_where_free(m[np.ix_(x, x)], moves[x])
        assert k in (3, 5)
    return result


def strips(a: np.ndarray, place: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Σ over neighbouring yarns S⁻¹, of a matrix of positions, from the two yarns [nodes, 2] of each node."""
    result = np.zeros_like(a)
    for direction, first in itertools.product(range(2), range(place.max())):
        nodes = np.flatnonzero(np.isin(place[:, direction], (first, first + 1)))
        side, at = place[nodes, direction], place[nodes, 1 - direction]
        if len(set(side)) < 2:
            continue
        every = (3 * nodes[:, None] + np.arange(3)).ravel()
        m = a[np.ix_(every, every)]
        for p, q in itertools.product(range(len(nodes)), repeat=2):
            rows, columns = (slice(3 * k, 3 * k + 3) for k in (p, q))
            apart = abs(at[p] - at[q])
            if apart == 2 and side[p] == side[q]:
                m[rows, rows] += 0.5 * (m[rows, columns] + m[rows, columns].T)
            if apart > 1:
                m[rows, columns] = 0.0
        result[np.ix_(every, every)] += inverse_where_free(m, free[every])
    return result


def interpolation(count: int) -> np.ndarray:
    """From every second yarn, and the last, to all of them."""
    kept = np.arange(count) if count <= FEWEST else np.unique(np.append(np.arange(0, count, 2), count - 1))
    result = np.zeros((count, len(kept)))
    for i in range(count):
        result[i] = [np.interp(i, kept, unit) for unit in np.eye(len(kept))]
    return result


def dense_preconditioner(
    a: np.ndarray, rows: int, columns: int, free: np.ndarray, with_strips: bool = False
) -> np.ndarray:
    """P⁻¹ by its definition."""
    result = lines(a, rows, columns, free, 0.25)
    n = 3 * rows * columns
    if with_strips:
        place = np.indices((rows, columns)).reshape(2, -1).T
        result[:n, :n] += strips(a[:n, :n], place, free[:n])
    small = a[:n, :n] * np.outer(free[:n], free[:n])
    # from the unknowns of a level to those of the cloth
    carried = np.diag(free[:n].astype(float))
    while rows * columns > COARSEST:
        down, across = interpolation(rows), interpolation(columns)
        step = np.kron(np.kron(down, across), np.eye(3))
        carried = carried @ step
        small = step.T @ small @ step
        rows, columns = down.shape[1], across.shape[1]
        moves = np.diag(small) > 0.0
        part = inverse_where_free(small, moves) if rows * columns <= COARSEST else lines(small, rows, columns, moves)
        result[:n, :n] += carried @ part @ carried.T
    return result


def all_of_it(sim: wy.Simulator) -> np.ndarray:
    """P⁻¹ as a matrix, from what it makes of unit vectors."""
    unknowns = sim.scene.cloth.nodes * (5 if sim.scene.sliding else 3)
    return np.stack([apply(sim, unit) for unit in np.eye(unknowns)], axis=1)


def scaled(m: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Of units that differ, by a diagonal."""
    size = np.sqrt(np.diag(by))
    size = np.where(size > 0.0, size, 1.0)
    return m / np.outer(size, size)


CASES = [
    ("paper", 5, 5, True, "none", "random", 1e-3),
    ("paper", 7, 5, False, "springs", "stretched", 1e-2),
    ("handkerchief", 5, 12, True, "exact", "random", 3e-4),
    ("handkerchief", 9, 9, False, "exact", "folded", 1e-3),
    ("cotton", 12, 5, True, "springs", "slack", 1e-3),
    ("cotton", 6, 7, True, "exact", "squeezed", 1e-4),
    ("cotton", 3, 3, True, "springs", "random", 1e-3),
    ("cotton", 3, 11, False, "none", "random", 1e-3),
    ("handkerchief", 4, 4, True, "none", "rest", 1 / 60),
]


@pytest.mark.parametrize("with_strips", [False, True])
@pytest.mark.parametrize(("fabric", "rows", "columns", "sliding", "pins", "state", "stage"), CASES)
def test_it_is_its_definition_symmetric_and_positive(fabric, rows, columns, sliding, pins, state, stage, with_strips):
    sim = simulator(fabric, rows, columns, sliding, pins, with_strips=with_strips)
    a, free = assemble(sim, state, stage)
    found, expected = all_of_it(sim), dense_preconditioner(a, rows, columns, free, with_strips)
    # rounding, times the condition of a line or of the coarsest level: up to some 1e6, of the stiffest yarns
    assert np.abs(scaled(found - expected, expected)).max() < 1e-8
    assert np.abs(scaled(found - found.T, expected)).max() < 1e-8
    # what is held takes no part
    assert not found[~free].any()
    assert not found[:, ~free].any()
    inside = scaled(found, expected)[np.ix_(free, free)]
    assert np.linalg.eigvalsh(0.5 * (inside + inside.T)).min() > 1e-7


@pytest.mark.parametrize("sliding", [False, True])
def test_in_single_precision(sliding):
    sim = simulator("handkerchief", 5, 8, sliding, "springs", "single", sliding)
    a, free = assemble(sim, "random", 1e-3)
    found, expected = all_of_it(sim), dense_preconditioner(a, 5, 8, free, sliding)
    # 6e-8 times a condition of some 1e4
    assert np.abs(scaled(found - expected, expected)).max() < 5e-3
    inside = scaled(found, expected)[np.ix_(free, free)]
    assert np.linalg.eigvalsh(0.5 * (inside + inside.T)).min() > 0.0


@pytest.mark.parametrize("with_strips", [False, True])
@pytest.mark.parametrize(("fabric", "rows", "columns", "sliding", "pins", "state", "stage"), CASES)
def test_a_solve_is_numpys(fabric, rows, columns, sliding, pins, state, stage, with_strips):
    sim = simulator(fabric, rows, columns, sliding, pins, with_strips=with_strips, tolerance=1e-12)
    a, free = assemble(sim, state, stage)
    n = 3 * sim.scene.cloth.nodes
    rng = np.random.default_rng(1)
    b = rng.normal(size=len(a)) * np.sqrt(np.diag(a))
    # what is held has a velocity of its own, which the others feel; and the solve has a start
    start = np.where(free, 0.1, 1.0) * rng.normal(size=len(a)) / np.sqrt(np.where(np.diag(a) > 0.0, np.diag(a), 1.0))
    if sliding:
        # the border has no rates
        start[n:][~free[n:]] = 0.0
    arrays = sim.arrays
    arrays["rhs"].assign(b[:n].reshape(-1, 3))
    arrays["solution"].assign(start[:n].reshape(-1, 3))
    if sliding:
        arrays["euler_rhs"].assign(b[n:])
        arrays["euler_solution"].assign(start[n:])
    sim.model.solve()
    assert arrays["status"].numpy()[0] == 0
    parts = [arrays["solution"].numpy().ravel(), *([arrays["euler_solution"].numpy()] if sliding else [])]
    found = np.concatenate(parts)
    np.testing.assert_array_equal(found[~free], start[~free])
    inner = a[np.ix_(free, free)]
    expected = np.linalg.solve(inner, b[free] - a[np.ix_(free, ~free)] @ start[~free])
    off = found[free] - expected
    # in the norm of A the error falls as the preconditioned residual does, within the root of the condition that P
    # leaves; what rounding leaves of either solution is as large as the matrix is ill-conditioned, up to 7e7
    allowed = 1e-11 + 1e-15 * np.linalg.cond(scaled(inner, inner))
    assert off @ inner @ off < allowed**2 * (expected @ inner @ expected)


@pytest.mark.parametrize("with_strips", [False, True])
@pytest.mark.parametrize("sliding", [False, True])
def test_two_threads_make_the_same_iterates(sliding, with_strips):
    ends = []
    for threads in (1, 2):
        options = {"threads": threads, "tolerance": 1e-3, "with_strips": with_strips}
        sim = simulator("handkerchief", 5, 17, sliding, "exact", **options)
        assert sim.model.threads.count == threads
        start = sim.state
        start.velocity[:] = np.random.default_rng(3).normal(0.0, 0.1, start.velocity.shape)
        sim.state = start
        velocity = sim.run(1).velocity[-1]
        ends.append((velocity, int(sim.arrays["iterations"].numpy()[0])))
    (one, count), (two, count_of_two) = ends
    assert count == count_of_two > 5
    # sums in another order; another iterate would be 1e-3 off
    assert np.abs(one - two).max() < 1e-9 * np.abs(one).max()


def test_levels_of_tiny_cloths():
    levels = {size: simulator("paper", size, size, False).arrays.level_start for size in (3, 4, 5, 9)}
    # 3 × 3 is solved by its lines; 4 × 4 and 5 × 5 have a level of 3 × 3; 9 × 9 one of 5 × 5 and one of 3 × 3
    assert levels == {3: [0], 4: [0, 9], 5: [0, 9], 9: [0, 25, 34]}


def test_it_is_the_default_where_the_incomplete_factorization_fails():
    """Rates that friction does not hold: there it stops where the solution is 100 % off, and says that it converged."""

    def chosen(cloth: wy.Cloth, step: float, **options) -> str:
        return wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top"), **options), step=step).model.preconditioner

    paper, handkerchief = (FABRICS[name](rows=5, columns=5) for name in ("paper", "handkerchief"))
    without = [name for name in wy.Scene(paper).terms if name != "friction"]
    assert chosen(handkerchief, 1e-4) == chosen(handkerchief, 1e-3) == "multilevel"
    assert chosen(handkerchief, 1e-4, sliding=False) == "incomplete"
    assert chosen(handkerchief, 1e-3, sliding=False) == "multilevel"
    assert chosen(paper, 1e-3) == "incomplete"
    assert chosen(paper, 1e-3, terms=without) == "multilevel"


def test_a_sliding_handkerchief_is_solved_by_default():
    """To the tolerance, at a size where the incomplete factorization's sweeps have grown out of all bounds."""
    cloth = FABRICS["handkerchief"](rows=61, columns=9, pose="flat")
    sim = wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top")), step=3e-4, integrator="linear")
    state = sim.state
    state.velocity[:] = np.random.default_rng(5).normal(0.0, 0.1, state.velocity.shape)
    sim.state = state
    system = sim.system()
    a, free = system.dense(), system.free
    sim.run(1)
    found = np.concatenate([sim.state.velocity.ravel(), sim.state.euler_velocity.ravel()])[free]
    expected = np.linalg.solve(a[np.ix_(free, free)], system.rhs[free])
    # 1e-6 of the residual, times the root of the condition that P leaves; seen: 1e-4, and 1 of the other's
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def jittered(cloth: wy.Cloth, share: float, sliding: bool) -> wy.State:
    """Make a state with nodes wrong by this share of a spacing, and crossings by a third of it along their yarns."""
    rng = np.random.default_rng(7)
    off = share * cloth.spacing
    position = cloth.position + rng.uniform(-off, off, (cloth.nodes, 3))
    slid = (cloth.topology.is_crossing != 0)[:, None] * float(sliding)
    euler = cloth.euler + rng.uniform(-off / 3.0, off / 3.0, (cloth.nodes, 2)) * slid
    return wy.State(position, euler, rng.normal(0.0, 0.1, (cloth.nodes, 3)), np.zeros((cloth.nodes, 2)))


def iterations(sim: wy.Simulator, state: wy.State) -> int:
    """Of a solve from the present velocities to 1e-6."""
    sim.state = state
    sim.system()
    sim.model.factorize()
    sim.arrays.zero("status", "euler_solution")
    sim.model.copy(solution="velocity")
    sim.arrays.put("tolerance", 1e-6)
    sim.model.solve()
    assert sim.arrays["status"].numpy()[0] == 0
    return int(sim.arrays["iterations"].numpy()[0])


def stiff(factor: float, rows: int, columns: int) -> wy.Cloth:
    """Make the paper's cloth with yarns that are as much stiffer."""
    cloth = FABRICS["paper"](rows=rows, columns=columns, pose="flat")
    yarns = [dataclasses.replace(yarn, stretch=factor * yarn.stretch) for yarn in cloth.yarns]
    return cloth.replace(yarns=yarns)


@pytest.mark.parametrize("sliding", [False, True])
def test_iterations_of_kinked_yarns_that_hardly_stretch(sliding):
    cloth = stiff(1e5, 13, 11)
    state = jittered(cloth, 0.05, False)
    alone, beside = (iterations(simulator_of(cloth, sliding, with_strips=which), state) for which in (False, None))
    # seen: 147 and 55, 179 and 60
    assert beside < 75
    assert alone > 2 * beside


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_iterations_of_crumpled_cloth_that_slides(share):
    """Few more than of the same that does not: with the rates along a line alone they are two to four times as many."""
    cloth = FABRICS["cotton"](rows=15, columns=15, pose="flat")
    count = [iterations(simulator_of(cloth, sliding), jittered(cloth, share, sliding)) for sliding in (False, True)]
    # seen: 39 and 44, 37 and 57
    assert count[1] < 1.9 * count[0]


def test_strips_of_a_cloth_with_a_hole():
    """Whose yarns have gaps and free ends."""
    cloth = FABRICS["handkerchief"](rows=9, columns=9, pose="flat")
    cloth = cloth.cut(wy.outline.disc(3.8e-3, center=(4e-3, 4e-3)), [wy.outline.disc(1.6e-3, center=(4e-3, 4e-3))])
    topology = cloth.topology
    assert topology.is_end.any()
    off = np.random.default_rng(8).uniform(-1e-4, 1e-4, (cloth.nodes, 3))
    state = wy.State(cloth.position + off, cloth.euler, np.zeros((cloth.nodes, 3)), np.zeros((cloth.nodes, 2)))
    found = []
    for with_strips in (False, True):
        sim = simulator_of(cloth, False, with_strips=with_strips)
        a = sim.system(state, weights=(1.0, 1e-3, 1e-6)).dense()
        sim.model.factorize()
        found.append(all_of_it(sim))
    # ends are in none: somewhere else, each on its own
    place = topology.place.copy()
    ends = topology.is_end != 0
    place[ends] = 100 + 10 * np.arange(ends.sum())[:, None]
    expected = strips(a, place, np.ones(len(a), dtype=bool))
    assert np.abs(scaled(found[1] - found[0] - expected, found[1])).max() < 1e-8


def test_strips_are_the_default_where_yarns_hardly_stretch():
    def chosen(cloth: wy.Cloth, step: float = 1e-3) -> bool:
        return simulator_of(cloth, False, with_strips=None, step=step).arrays.dims["strips"] > 0

    assert chosen(stiff(1e4, 5, 5))
    assert not chosen(stiff(1e4, 5, 5), 1e-4)
    assert not chosen(stiff(1e2, 5, 5))
    for name in ("handkerchief", "cotton", "kevlar_s706", "glass_twintex_plain"):
        assert not chosen(getattr(wy.fabrics, name)(rows=5, columns=5))
