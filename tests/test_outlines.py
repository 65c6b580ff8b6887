"""Cloths cut to outlines: what is left of the yarns, forces on it, runs, gradients, files and pictures.

What is inside is found a second time here, by Matplotlib at points along every yarn, and forces come of the oracle's
energies of an element over that list.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from cases import YARNS
from inputs import EXACT, WIND
from matplotlib.path import Path
from reference import Elements, bending, gravity, stretch, tensor

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.view.yarns import Weaving

SAMPLES = 20000
"""Points along a yarn: its ends are found to a distance of 17 mm over that."""
L = 1e-3


def square(rows: int = 13, columns: int = 15, **options: object) -> wy.Cloth:
    return wy.Cloth(
        wy.Weave.plain(rows=rows, columns=columns), **{"yarns": YARNS[:1], "radius": 3e-4, "pose": "flat", **options}
    )


def box(u0: float, v0: float, u1: float, v1: float) -> np.ndarray:
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) * L


ELL = np.array([[0.3, 0.4], [13.6, 0.4], [13.6, 4.45], [6.55, 4.45], [6.55, 11.7], [0.3, 11.7]]) * L
CUTS = {
    "all": (box(0, 0, 14, 12), []),
    "off the yarns": (box(0.4, 0.6, 13.3, 11.2), []),
    "disc": (wy.outline.disc(5.7 * L, center=(7.1 * L, 6.05 * L), sides=48), []),
    "bias": (wy.outline.rectangle(11 * L, 5 * L, angle=45.0, center=(7.2 * L, 6.1 * L)), []),
    "ell": (ELL, []),
    "hole": (box(0, 0, 14, 12), [wy.outline.disc(2.3 * L, center=(7.1 * L, 6.05 * L), sides=24)]),
    "two holes": (box(0, 0, 14, 12), [box(2.5, 2.5, 4.5, 4.5), box(8.4, 6.4, 11.7, 9.6)]),
}
each = pytest.mark.parametrize("name", CUTS)


def cut(name: str, **options: object) -> wy.Cloth:
    outline, holes = CUTS[name]
    return square(**options).cut(outline, holes)


def is_inside(name: str, points: np.ndarray) -> np.ndarray:
    outline, holes = CUTS[name]

    # by a hair larger, so that what is on the edge is inside
    def contains(polygon: np.ndarray, by: float) -> np.ndarray:
        middle = polygon.mean(axis=0)
        return Path(middle + (polygon - middle) * (1.0 + by)).contains_points(points)

    result = contains(outline, 1e-6)
    for hole in holes:
        result &= ~contains(hole, -1e-6)
    return result


def yarns_of(name: str, rows: int = 13, columns: int = 15) -> list[list[tuple[float, float, bool]]]:
    """Every yarn that is left, warp yarns first: (u, v, whether a free end) of its nodes."""
    found = []
    for direction, count, nodes in ((0, rows, columns), (1, columns, rows)):
        for line in range(count):
            along = np.linspace(0.0, (nodes - 1) * L, SAMPLES)
            points = np.stack([along, np.full(SAMPLES, line * L)], axis=1)
            inside = np.concatenate([[False], is_inside(name, points[:, :: 1 - 2 * direction]), [False]])
            change = np.flatnonzero(np.diff(inside.astype(int)))
            for begin, end in zip(along[change[::2]], along[change[1::2] - 1], strict=True):
                slack = 3.0 * along[1]
                places = [k for k in range(nodes) if begin - slack <= k * L <= end + slack]
                if not places:
                    continue
                yarn = [(k * L, False) for k in places]
                if places[0] > 0 and places[0] * L - begin > 0.25 * L:
                    yarn.insert(0, (begin, True))
                if places[-1] < nodes - 1 and end - places[-1] * L > 0.25 * L:
                    yarn.append((end, True))
                if len(yarn) > 1:
                    found.append([((s, line * L) if direction == 0 else (line * L, s)) + (free,) for s, free in yarn])
    return found


def numbered(c: wy.Cloth, yarn: list[tuple[float, float, bool]]) -> list[int]:
    """The nodes of a yarn of the list."""
    nodes = [c.nearest(u, v) for u, v, _ in yarn]
    assert np.abs(c.rest_grid[nodes] - np.array(yarn)[:, :2]).max() < 3e-6
    assert [bool(c.topology.is_end[node]) for node in nodes] == [free for *_, free in yarn]
    return nodes


@each
def test_what_is_left_of_the_yarns(name: str) -> None:
    c = cut(name)
    chains = [numbered(c, yarn) for yarn in yarns_of(name)]
    for length, mine in ((2, c.topology.segment_nodes), (3, c.topology.bend_nodes)):
        expected = {tuple(chain[k : k + length]) for chain in chains for k in range(len(chain) - length + 1)}
        assert expected == set(map(tuple, mine.tolist()))
    assert {node for chain in chains for node in chain} == set(range(c.nodes))
    # a crossing has a place where yarns meet on each of its four sides
    beside = {node: set() for node in range(c.nodes)}
    for chain in chains:
        for a, b in itertools.pairwise(chain):
            beside[a].add(b)
            beside[b].add(a)
    ends = set(np.flatnonzero(c.topology.is_end).tolist())
    assert set(c.topology.crossing_node.tolist()) == {
        node for node, near in beside.items() if len(near) == 4 and not near & ends and node not in ends
    }
    # yarns run through increasing nodes, and up comes before left, right before down
    assert (np.diff(c.topology.segment_nodes) > 0).all()
    left, right, up, down = c.topology.crossing_neighbours.T
    assert (up < left).all() and (right < down).all()


@each
def test_mass_is_that_of_the_yarns(name: str) -> None:
    c = cut(name)
    lengths = [abs(yarn[-1][0] - yarn[0][0]) + abs(yarn[-1][1] - yarn[0][1]) for yarn in yarns_of(name)]
    assert c.mass == pytest.approx(YARNS[0].density * sum(lengths), rel=1e-3)


@each
def test_area_of_the_wind_is_that_of_the_cells(name: str) -> None:
    """Cells whole, and halves of those with one corner cut away; none outside, none twice."""
    c = cut(name)
    corners = c.rest_grid[c.topology.triangle_nodes]
    (a, b), (p, q) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    areas = 0.5 * np.abs(a * q - b * p)
    assert areas == pytest.approx(0.5 * L**2)
    middles = corners.mean(axis=1)
    assert is_inside(name, middles).all()
    assert len(np.unique(np.round(middles / L, 3), axis=0)) == len(middles)
    whole = sum(
        is_inside(name, np.array([[i, j], [i + 1, j], [i, j + 1], [i + 1, j + 1]]) * L).all()
        for i in range(14)
        for j in range(12)
    )
    if name in ("all", "ell", "two holes"):
        assert len(middles) >= 2 * (whole - 1)


def state_of(c: wy.Cloth, seed: int = 3) -> wy.State:
    """Every node 0.1 L from rest; crossings 0.05 L along both yarns."""
    rng = np.random.default_rng(seed)
    inside = (c.topology.is_crossing != 0)[:, None]
    euler = c.euler + rng.uniform(-0.05, 0.05, (c.nodes, 2)) * L * inside
    still = np.zeros((c.nodes, 3))
    return wy.State(c.position + rng.uniform(-0.1, 0.1, (c.nodes, 3)) * L, euler, still, np.zeros((c.nodes, 2)), euler)


@each
def test_forces_are_those_of_the_oracle(name: str) -> None:
    """Stretch, bending, gravity of every yarn."""
    c = cut(name)
    state = state_of(c)
    direction = [0 if yarn[0][1] == yarn[1][1] else 1 for yarn in yarns_of(name)]
    chains = [numbered(c, yarn) for yarn in yarns_of(name)]
    q = tensor(np.concatenate([state.position.ravel(), state.euler.ravel()]))

    def unknowns(nodes: list[int]) -> list[int]:
        return [3 * node + k for node in nodes for k in range(3)]

    def slides(nodes: tuple[int, int], d: int) -> list[int]:
        return [3 * c.nodes + 2 * node + d for node in nodes]

    segments, bends, rests = [], [], []
    for chain, d in zip(chains, direction, strict=True):
        for a, b in itertools.pairwise(chain):
            segments.append(unknowns([a, b]) + slides((a, b), d))
        for a, m, b in zip(chain[:-2], chain[1:-1], chain[2:], strict=True):
            bends.append(unknowns([a, m, b]) + slides((a, b), d))
            at = c.rest_grid[[a, m, b], d]
            rests.append([at[2] - at[1], at[1] - at[0]])
    area = math.pi * 3e-4**2
    yarn, count = YARNS[0], len(segments)
    k = tensor([yarn.stretch * area] * count)
    elements = {
        "stretch": Elements(torch.tensor(segments), stretch, (k, tensor([1.0] * count))),
        "gravity": Elements(
            torch.tensor(segments), gravity, (tensor([yarn.density] * count), tensor([[0.0, 0.0, -9.8]] * count))
        ),
        "bending": Elements(
            torch.tensor(bends), bending, (tensor([yarn.bend * area] * len(bends)), *tensor(rests).T.contiguous())
        ),
    }
    crossing = np.repeat(c.topology.is_crossing != 0, 2)
    for term, of in elements.items():
        simulator = wy.Simulator(wy.Scene(c, terms=[term]), integrator="linear")
        x, s = simulator.forces(state)[term]
        force = of.force(q).numpy()
        expected_x, expected_s = force[: 3 * c.nodes], force[3 * c.nodes :] * crossing
        # sums of some products in double precision
        assert np.abs(x.ravel() - expected_x).max() < 1e-12 * np.abs(expected_x).max()
        assert np.abs(s.ravel() - expected_s).max() < 1e-12 * max(np.abs(expected_s).max(), np.abs(expected_x).max())
        assert simulator.energy(state)[term] == pytest.approx(of.energy(q).item(), rel=1e-12)


@each
def test_inside_it_is_the_rectangle(name: str) -> None:
    """Every force on crossings that are three crossings and more from the edge: shear reads the contact forces of
    neighbours, these their bends, and these the heights of their neighbours."""
    whole, c = square(), cut(name)
    state = state_of(whole)
    place = c.topology.place
    index = place[:, 1] + place[:, 0] * whole.columns
    picked = wy.State(
        *(getattr(state, field)[index] for field in ("position", "euler", "velocity", "euler_velocity", "anchor"))
    )
    ends = c.topology.is_end != 0
    beside = np.sign(c.rest_grid - whole.rest_grid[index])
    picked = dataclasses.replace(
        picked,
        euler=np.where(ends[:, None], c.euler, picked.euler),
        position=picked.position + 0.3 * L * np.pad(beside, ((0, 0), (0, 1))),
    )
    deep = c.topology.is_crossing != 0
    for _ in range(3):
        nodes = c.topology.crossing_neighbours
        deep[c.topology.crossing_node] &= deep[nodes].all(axis=1)
    if name in ("all", "off the yarns", "disc"):
        assert deep.any()
    mine, others = (wy.Simulator(wy.Scene(each, wind=WIND), integrator="linear") for each in (c, whole))
    expected = others.forces(state)
    for term, (x, s) in mine.forces(picked).items():
        if term == "wind":  # whose triangles are those of whole cells
            continue
        for actual, wanted in ((x, expected[term][0][index]), (s, expected[term][1][index])):
            size = max(np.abs(wanted).max(), 1e-9)
            assert np.abs(actual - wanted)[deep].max(initial=0.0) < 1e-12 * size
    for actual, wanted in zip(mine.contact(picked), others.contact(state), strict=True):
        assert np.abs(actual - wanted[index])[deep].max(initial=0.0) < 1e-12


def test_all_of_it_is_the_rectangle_to_the_last_bit() -> None:
    whole = square(5, 6, pose="upright")
    runs = []
    for c in (whole, whole.cut(box(0, 0, 5, 4))):
        scene = wy.Scene(c, wind=WIND, pins=[0, 5])
        runs.append(wy.Simulator(scene).run(4))
        assert not c.general
    assert np.array_equal(runs[0].position, runs[1].position)
    assert np.array_equal(runs[0].euler, runs[1].euler)


@each
@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
def test_matrix(name: str, sliding: bool) -> None:
    """Symmetric, positive semi-definite; of stretch it is the oracle's exact part, and of all terms every block of the
    forces' differences that is not 0 has its place: no force between nodes that the matrix knows nothing of."""
    c = cut(name)
    state = state_of(c)
    simulator = wy.Simulator(wy.Scene(c, wind=WIND, sliding=sliding), integrator="linear")
    a = simulator.system(state, weights=(0.0, 0.0, 1.0)).dense()
    assert np.abs(a - a.T).max() <= 1e-13 * np.abs(a).max()
    assert np.linalg.eigvalsh(a).min() >= -1e-11 * np.abs(a).max()


# -- what is cut and posed otherwise ----------------------------------------------------------------------------------


def test_places() -> None:
    c = cut("hole")
    assert c.place(c.node(0, 0)) == "row 0, column 0"
    with pytest.raises(wy.InputError, match="is cut away"):
        c.node(6, 7)
    free = int(np.flatnonzero(c.topology.is_end)[0])
    assert c.place(free).startswith("the free end at row")
    around = c.within(wy.outline.disc(3.5 * L, center=(7.1 * L, 6.05 * L)))
    distance = np.linalg.norm(c.rest_grid - np.array([7.1, 6.05]) * L, axis=1)
    assert set(around) == set(np.flatnonzero(distance <= 3.5 * L).tolist())
    with pytest.raises(wy.InputError, match="no corners"):
        c.corners()


def test_a_posed_cloth_is_cut_where_it_is() -> None:
    """Free ends lie between their nodes."""
    c = square()
    x = c.position.copy()
    x[:, 2] = 2.0 * x[:, 0] + x[:, 1]
    left = c.replace(pose=x).cut(*CUTS["disc"])
    assert left.topology.is_end.any()
    assert left.position[:, 2] == pytest.approx(2.0 * left.rest_grid[:, 0] + left.rest_grid[:, 1])


@pytest.mark.parametrize(
    ("outline", "holes", "message"),
    [
        (box(0, 0, 14, 12)[[0, 2, 1, 3]], [], "meets itself"),
        (box(0, 0, 14, 12)[:2], [], "2 corners, must have at least 3"),
        (box(0, 0, 15, 12), [], "must be inside the cloth"),
        (box(0.2, 0.2, 0.8, 0.8), [], "nothing that is woven"),
        (box(0, 0, 1, 12), [], "no crossing"),
        (box(0, 0, 14, 12), [box(12, 2, 16, 4)], "meets outline"),
        (box(0, 0, 14, 12), [box(2, 2, 5, 5), box(4, 4, 7, 7)], r"holes\[1\] meets holes\[0\]"),
        (box(0, 0, 14, 12), [box(2, 2, 7, 7), box(3, 3, 5, 5)], "one within the other"),
        (box(0, 0, 6, 12), [box(8, 2, 10, 4)], "outside of the outline"),
        ([[0, 0], [0.014, 0], [float("nan"), 0.01]], [], "finite"),
        ([[0, 0], [0.014, 0], [0.014, 0], [0, 0.01]], [], "same corner"),
        # a bow tie with a waist of no yarn
        (np.array([[0, 0], [14, 0], [7.45, 6], [14, 12], [0, 12], [7.2, 6]]) * L, [], "hang together"),
    ],
)
def test_bad_outlines(outline: object, holes: list, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        square().cut(outline, holes)


def test_cut_once() -> None:
    with pytest.raises(wy.InputError, match="cut already"):
        cut("disc").cut(box(3, 3, 9, 9))


@pytest.mark.parametrize("name", ["disc", "bias", "hole"])
def test_saved_runs(name: str, tmp_path: object) -> None:
    scene = wy.Scene(cut(name, radius=2.5e-4, spacing=(1e-3, 1e-3)), pins=[0, 1], seams=[[2, 9]], seam_stiffness=30.0)
    simulator = wy.Simulator(scene, integrator="linear")
    trajectory = simulator.run(2)
    trajectory.save(tmp_path / "run.npz")
    loaded = wy.Trajectory.load(tmp_path / "run.npz")
    assert np.array_equal(loaded.position, trajectory.position)
    assert loaded.scene.same_as(scene)
    again = wy.Simulator(loaded.scene, integrator="linear").run(2)
    assert np.array_equal(again.position, trajectory.position)


# -- runs and gradients -----------------------------------------------------------------------------------------------

RUNS = {
    "disc": lambda: wy.Scene(
        cut("disc"), wind=WIND, pins=cut("disc").within(wy.outline.disc(1.5 * L, center=(7 * L, 6 * L)))
    ),
    "bias": lambda: wy.Scene(cut("bias"), wind=WIND, pins=[0, 1]),
    "hole": lambda: wy.Scene(cut("hole"), wind=WIND, pins=[0, 14]),
    "seamed": lambda: seamed(),
}


def seamed() -> wy.Scene:
    """A disc and a square, sewn together at the disc's lower edge."""
    disc, other = cut("disc", pose="upright"), square(5, 7)
    place = other.position[:, [0, 2, 1]] * [1.0, 1.0, -1.0] + [4e-3, 0.0, -1.5e-3]
    disc_edge = [int(np.lexsort((disc.position[:, 2], np.abs(disc.position[:, 0] - (4 + k) * L)))[0]) for k in range(7)]
    top = [other.node(0, k) for k in range(7)]
    pairs = [[a, disc.nodes + b] for a, b in zip(disc_edge, top, strict=True)]
    return wy.Scene([disc, other.replace(pose=place)], pins=[0, 1, 2], seams=pairs, seam_stiffness=200.0)


@pytest.mark.parametrize("name", RUNS)
def test_gradient(name: str) -> None:
    """Of a weighted sum of where nodes end, along random changes of materials, seams and the state: that of central
    differences, to (1e-5)² of the order and 1e-14/1e-5 of solves to rounding."""
    scene = RUNS[name]()
    rollout = wt.Rollout(scene, 3, step=5e-4, integrator="sdirk2", tolerance=EXACT, newton_tolerance=1e-12)
    start = jittered_of(scene)
    rng = np.random.default_rng(1)
    weights = torch.tensor(rng.standard_normal((scene.cloth.nodes, 3)))
    names = ["stretch", "density", "bend", "shear", "friction"] + (["seam_stiffness"] if len(scene.seams) else [])
    cloth, scale = scene.cloth, {"position": 1e-4, "velocity": 0.1}
    values = {each: torch.tensor([getattr(yarn, each) for yarn in cloth.yarns]).double() for each in names[:3]}
    values |= {each: torch.tensor(getattr(cloth, each, 0.0) or scene.seam_stiffness).double() for each in names[3:]}
    values |= start

    def loss(given: dict[str, torch.Tensor]) -> torch.Tensor:
        return (rollout(**given).position[-1] * weights).sum()

    inputs = {each: value.clone().requires_grad_() for each, value in values.items()}
    found = torch.autograd.grad(loss(inputs), list(inputs.values()))
    for each, gradient in zip(inputs, found, strict=True):
        direction = torch.tensor(rng.choice([-1.0, 1.0], tuple(gradient.shape)))
        size = 1e-5 * scale.get(each, float(values[each].abs().max()))
        with torch.no_grad():
            ends = [loss({**values, each: values[each] + sign * size * direction}) for sign in (1.0, -1.0)]
        slope = float(ends[0] - ends[1]) / (2.0 * size)
        expected = float((gradient * direction).sum())
        assert expected != 0.0
        assert slope == pytest.approx(expected, rel=2e-5, abs=1e-12 / size), each


def jittered_of(scene: wy.Scene) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(3)
    n = scene.cloth.nodes
    return {
        "position": torch.tensor(scene.cloth.position + 2e-5 * rng.standard_normal((n, 3))),
        "velocity": torch.tensor(0.05 * rng.standard_normal((n, 3))),
    }


@pytest.mark.parametrize("name", RUNS)
def test_momentum(name: str) -> None:
    """Of a free cloth without gravity nor wind: seams and free ends push nothing on. Locked, for then the mass does not
    change, and momentum is linear in the velocities, which methods keep."""
    scene = RUNS[name]().replace(gravity=None, wind=None, pins=[], sliding=False)
    simulator = wy.Simulator(scene, step=1e-4, tolerance=EXACT, newton_tolerance=1e-12)
    start = jittered_of(scene)
    simulator.state = dataclasses.replace(
        simulator.state, position=start["position"].numpy(), velocity=start["velocity"].numpy()
    )

    def momentum() -> np.ndarray:
        a = simulator.system(simulator.state, weights=(1.0, 0.0, 0.0)).dense()
        return (a @ simulator.state.velocity.ravel()).reshape(-1, 3).sum(axis=0)

    before = momentum()
    simulator.run(3)
    assert momentum() == pytest.approx(before, abs=1e-9 * np.abs(before).max() + 1e-15)


def test_seams_hold() -> None:
    """Two cloths one above the other, the lower one hanging by its seam: each spring gives way by its force over k."""
    scene = seamed()
    disc = scene.cloth.cloths[0]
    held = np.flatnonzero(disc.position[:, 2] > np.quantile(disc.position[:, 2], 0.5)).tolist()
    scene = scene.replace(pins=held, pin_stiffness=None, sliding=False)
    simulator = wy.Simulator(scene, step=5e-3, integrator="linear", tolerance=EXACT)
    simulator.run(200)
    gap = np.linalg.norm(np.diff(simulator.state.position[scene.seams], axis=1), axis=2)
    pull = np.diff(simulator.state.position[scene.seams][:, :, 2], axis=1).sum() * -200.0
    # the weight of the lower cloth, by masses of its yarns
    assert pull == pytest.approx(9.8 * scene.cloth.cloths[1].mass, rel=1e-2)
    assert gap.max() < 2e-3


@pytest.mark.parametrize(
    ("seams", "message"),
    [
        ([[1, 1]], "two different nodes"),
        ([[0, 10**6]], r"seams\[0\]"),
        ([[0, 1], [1, 0]], "twice"),
        ([[0, 5], [0, 6], [0, 7]], "seams has node 0 3 times, must have at most two of a node"),
        ([[12, 20], [12, 21], [1, 12], [2, 12]], "seams has node 12 4 times"),
        ([[0, 5], [6]], "seams must be an array of numbers"),
        ({(0, 5)}, "pairs of nodes"),
        (None, "pairs of nodes"),
        ([0, 1], "seams"),
        ("all", "pairs of nodes"),
    ],
)
def test_bad_seams(seams: object, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        wy.Simulator(wy.Scene(square(5, 5), seams=seams))


CHAINS = {
    "chain": [[1, 24], [1, 22], [0, 23], [0, 22]],
    "ring": [[0, 22], [1, 22], [1, 23], [2, 23], [2, 24], [0, 24]],
    "tangle": [[3, 20], [3, 7], [7, 15], [15, 20], [12, 24], [1, 12]],
}


@pytest.mark.parametrize("name", CHAINS)
def test_seams_in_any_order(name: str) -> None:
    """Of whatever order and way round they are given, the matrix is the sum of what each has alone."""
    c, seams = square(5, 5), CHAINS[name]
    state = state_of(c)

    def stiffness(seams: object) -> np.ndarray:
        simulator = wy.Simulator(wy.Scene(c, terms=["seams"], seams=seams), integrator="linear")
        return simulator.system(state, weights=(0.0, 0.0, 1.0)).dense()

    expected = sum(stiffness([seam]) for seam in seams)
    rng = np.random.default_rng(3)
    for order in [range(len(seams)), *(rng.permutation(len(seams)) for _ in range(8))]:
        given = [seams[k] if rng.integers(2) else seams[k][::-1] for k in order]
        assert np.abs(stiffness(given) - expected).max() <= 1e-13 * np.abs(expected).max()


def test_a_piece_is_as_large_as_its_outline() -> None:
    for name in ("rows", "columns", "size"):
        with pytest.raises(wy.InputError, match=f"{name} = 5: a piece is as large as its outline needs"):
            wy.piece(wy.fabrics.handkerchief, wy.outline.disc(5e-3), **{name: 5})


def test_seams_do_not_go_with_self_contact() -> None:
    with pytest.raises(wy.InputError, match="self_contact"):
        wy.Scene(square(5, 5), seams=[[0, 9]], self_contact=True)


# -- with crimp, and with contact -------------------------------------------------------------------------------------


def crimped(name: str) -> wy.Cloth:
    crimp = (0.05, 0.08)
    radius = 0.25 * sum(wy.crimp_height(L, L * (1.0 + c)) for c in crimp)
    return cut(name, crimp=crimp, radius=radius)


@pytest.mark.parametrize("name", ["disc", "bias", "hole"])
@pytest.mark.parametrize("options", [{"crimp_interchange": True}, {"contact_force": "crimped"}], ids=str)
def test_seams_leave_every_other_block_where_it_is(name: str, options: dict) -> None:
    """The matrix with seams less theirs is that without, whose stencil is narrower; so are the forces."""
    c = crimped(name)
    state = state_of(c)
    plain = wy.Scene(c, wind=WIND, **options)
    seams = {"seams": [[0, c.nodes - 1], [5, 9]], "seam_stiffness": 40.0}
    matrices = [
        wy.Simulator(scene, integrator="linear").system(state, weights=(0.0, 0.0, 1.0)).dense()
        for scene in (plain, plain.replace(**seams), wy.Scene(c, terms=["seams"], **seams))
    ]
    size = np.abs(matrices[0]).max()
    assert np.abs(matrices[2]).max() > 0.0
    assert np.abs(matrices[1] - matrices[2] - matrices[0]).max() < 1e-13 * size
    forces = [wy.Simulator(scene, integrator="linear").forces(state) for scene in (plain, plain.replace(**seams))]
    for term, (x, s) in forces[0].items():
        assert np.array_equal(forces[1][term][0], x) and np.array_equal(forces[1][term][1], s)


@pytest.mark.parametrize("name", ["disc", "bias", "hole"])
def test_crimp_interchange_is_conservative(name: str) -> None:
    """Also where yarns end: forces are those of the energy, by central differences of fourth order, h = 1e-7 m."""
    c = crimped(name)
    state, rng = state_of(c), np.random.default_rng(2)
    simulator = wy.Simulator(wy.Scene(c, terms=["crimp_interchange"], crimp_interchange=True), integrator="linear")
    force, along = simulator.forces(state)["crimp_interchange"]
    inside = (c.topology.is_crossing != 0)[:, None]
    for _ in range(3):
        dx, ds = rng.standard_normal((c.nodes, 3)), rng.standard_normal((c.nodes, 2)) * inside

        def energy(h: float, dx: np.ndarray = dx, ds: np.ndarray = ds) -> float:
            moved = dataclasses.replace(state, position=state.position + h * dx, euler=state.euler + h * ds)
            return simulator.energy(moved)["crimp_interchange"]

        h = 1e-7
        slope = (8.0 * (energy(h) - energy(-h)) - (energy(2.0 * h) - energy(-2.0 * h))) / (12.0 * h)
        expected = -(force * dx).sum() - (along * ds).sum()
        assert slope == pytest.approx(expected, abs=1e-7 * (np.abs(force * dx).sum() + np.abs(along * ds).sum()))


@pytest.mark.parametrize("name", ["disc", "hole"])
def test_a_cut_cloth_lies_on_a_sphere(name: str) -> None:
    """No node of it, free ends too, is nearer than half its thickness."""
    c = cut(name)
    middle = np.array([7.1, 6.05, 0.0]) * L
    ball = wy.Sphere(radius=3.5 * L, center=middle - [0.0, 0.0, 4.2 * L])
    simulator = wy.Simulator(wy.Scene(c, obstacles=[ball]), step=1e-3)
    trajectory = simulator.run(40)
    away = np.linalg.norm(trajectory.position - (middle - [0.0, 0.0, 4.2 * L]), axis=2) - 3.5 * L
    assert away.min() > 0.0
    assert trajectory.position[-1, :, 2].min() < -1.0 * L


@pytest.mark.parametrize("name", ["disc", "bias", "hole", "ell"])
@pytest.mark.parametrize("shape", ["curves", "mesh"])
def test_usd(name: str, shape: str, tmp_path: object) -> None:
    """A curve a yarn, from its first node to its last; finite."""
    usd = pytest.importorskip("pxr.UsdGeom")
    stages = pytest.importorskip("pxr.Usd")
    c = cut(name)
    trajectory = wy.Simulator(wy.Scene(c), integrator="linear").run(2)
    path = tmp_path / "cut.usda"
    wy.write_usd(path, trajectory, tubes=shape == "mesh")
    stage = stages.Stage.Open(str(path))
    kind = usd.BasisCurves if shape == "curves" else usd.Mesh
    found = [kind(prim) for prim in stage.Traverse() if prim.IsA(kind)]
    assert found
    points = np.concatenate([np.array(each.GetPointsAttr().Get(1)) for each in found])
    assert np.isfinite(points).all()
    if shape == "curves":
        counts = np.concatenate([np.array(each.GetCurveVertexCountsAttr().Get()) for each in found])
        # both ends of a curve are there twice; where another yarn crosses the last node, a free end comes after it
        yarns = yarns_of(name)
        places = [place[:2] for yarn in yarns for place in yarn]
        crossed = [sum(places.count(yarn[end][:2]) == 2 for end in (0, -1)) for yarn in yarns]
        assert sorted(counts.tolist()) == sorted(
            len(yarn) + 2 + more for yarn, more in zip(yarns, crossed, strict=True)
        )


def test_pictures_of_a_cut_cloth_show_the_weave_to_its_edge() -> None:
    """Also where yarns that cross have no crossing in the model: over and under are those of the draft there."""
    c = cut("disc")
    weaving = Weaving(c)
    edge = np.flatnonzero(weaving.crossed & (c.topology.is_crossing == 0))
    assert len(edge) > 20
    over = {}
    for strands in weaving.strands:
        starts = strands.counts.cumsum() - strands.counts
        for begin, count, yarn in zip(starts, strands.counts, strands.yarn, strict=True):
            for k in range(begin, begin + count):
                over[int(strands.places[k]), int(c.topology.yarn_direction[yarn])] = strands.height[k]
    row, column = c.topology.place[edge].T
    warp_on_top = c.weave.draft[row, column]
    assert 0 < warp_on_top.sum() < len(edge)
    for node, top in zip(edge.tolist(), warp_on_top, strict=True):
        assert (over[node, 0] > 0.0) == top and over[node, 0] * over[node, 1] < 0.0


def test_two_cloths_that_are_sewn_together_are_written(tmp_path: object) -> None:
    """Every yarn of both has its curve, and both ends of the seam stay together in the file."""
    usd = pytest.importorskip("pxr.UsdGeom")
    stages = pytest.importorskip("pxr.Usd")
    upper = wy.fabrics.handkerchief(rows=5, columns=6, pose="flat")
    lower = upper.replace(pose=upper.position + np.array([0.0, 4.1e-3, 0.0]))
    seams = [[upper.node(-1, k), upper.nodes + lower.node(0, k)] for k in range(6)]
    trajectory = wy.Simulator(wy.Scene([upper, lower], seams=seams, pins=upper.corners("top"))).run(3)
    wy.write_usd(tmp_path / "sewn.usda", trajectory)
    stage = stages.Stage.Open(str(tmp_path / "sewn.usda"))
    curves = [usd.BasisCurves(prim) for prim in stage.Traverse() if prim.IsA(usd.BasisCurves)]
    assert sum(len(each.GetCurveVertexCountsAttr().Get()) for each in curves) == 2 * (5 + 6)
    points = np.concatenate([np.array(each.GetPointsAttr().Get(3)) for each in curves])
    assert np.isfinite(points).all()
    # free ends stick out on both sides, by less than a spacing
    assert 8.1e-3 < np.ptp(points[:, 1]) < 10.1e-3
    pair = trajectory.position[-1][np.array(seams)]
    assert np.linalg.norm(pair[:, 0] - pair[:, 1], axis=1).max() < 0.1e-3
