"""Impact zones, the paper's response to collisions: detection, projection, motions and gradients."""

import functools
import itertools

import numpy as np
import pytest
import torch
import warp as wp
from internals import fails_at_first, resolved_with_its_adjoint
from scipy.optimize import minimize
from warp_yarn.kernels.contact import continuous

import warp_yarn as wy
import warp_yarn.torch
from warp_yarn.device.impacts import Detection
from warp_yarn.device.projection import Constraints, NoWayOut, project, transposed

ZONES = wy.Contact(method="impact-zones")

# -- roots of cubics --------------------------------------------------------------------------------------------------


def roots_on_the_device(coefficients: np.ndarray) -> np.ndarray:
    roots = wp.zeros(len(coefficients), dtype=wp.vec3d, device="cpu")
    given = wp.array(coefficients, dtype=wp.vec4d, device="cpu")
    wp.launch(continuous.define().solve_cubics, len(coefficients), [given], [roots], device="cpu")
    return roots.numpy()


def expanded(*roots: float, scale: float = 1.0) -> np.ndarray:
    """Coefficients of the polynomial with these roots, lowest first."""
    return np.append(scale * np.poly(roots)[::-1], np.zeros(3 - len(roots)))


def test_roots_of_cubics_are_those_of_numpy():
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(4000, 4))
    # of coefficients of very different sizes, as of what hardly moves, and of lower degree
    coefficients[1000:2000] *= 10.0 ** rng.uniform(-12.0, 3.0, size=(1000, 4))
    coefficients[2000:2500, 3] = 0.0
    coefficients[2500:3000, 2:] = 0.0
    coefficients[3000:3500] *= 1e-15
    compared = 0
    for given, found in zip(coefficients, roots_on_the_device(coefficients), strict=True):
        exact = np.roots(np.trim_zeros(given[::-1], "f"))
        real = np.sort(exact[np.abs(exact.imag) < 1e-9].real)
        # NumPy's own roots have errors: those at the rim, or almost double, are for the next test
        size = np.abs(exact.imag)
        doubtful = ((size > 0.0) & (size < 1e-4)).any() or (np.diff(real) < 1e-4).any()
        if doubtful or np.minimum(np.abs(real), np.abs(real - 1.0)).min(initial=1.0) < 1e-7:
            continue
        inside = real[(real > 0.0) & (real < 1.0)]
        kept = found[found <= 1.0]
        assert len(kept) == len(inside), given
        # NumPy's are as good as eigenvalues of the companion matrix are; ours leave rounding
        assert kept == pytest.approx(inside, abs=1e-7)
        slope = np.abs(given[1] + 2.0 * given[2] * kept + 3.0 * given[3] * kept**2)
        left = np.abs(np.polyval(given[::-1], kept))
        assert (left <= 1e-15 * np.abs(given).sum() + 1e-15 * slope).all()
        compared += 1
    assert compared > 3500


def test_double_roots_and_roots_at_the_ends_are_found():
    rng = np.random.default_rng(1)
    cases = [((0.0,), 1), ((1.0,), 1), ((0.0, 0.5), 2), ((0.5, 0.5), 1), ((0.25, 0.25, 0.25), 1), ((0.0, 0.5, 1.0), 3)]
    cases += [((a, a, b), 2) for a, b in rng.uniform(0.1, 0.9, size=(500, 2)) if abs(a - b) > 1e-2]
    given = np.array([expanded(*roots, scale=scale) for roots, _ in cases for scale in (1.0, -3e-12)])
    for found, (roots, least) in zip(roots_on_the_device(given), [c for c in cases for _ in range(2)], strict=True):
        kept = found[found <= 1.0]
        assert len(kept) >= least
        # double roots are as far off as the square root of rounding
        for root in roots:
            assert np.abs(kept - root).min() < 1e-5
        for root in kept:
            assert np.abs(root - np.array(roots)).min() < 1e-5
    # what is not there, and what is 0 throughout
    assert (roots_on_the_device(np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])) > 1.0).all()
    assert roots_on_the_device(np.zeros((1, 4)))[0, 0] == 0.0


# -- detection --------------------------------------------------------------------------------------------------------


def triple(p: np.ndarray) -> np.ndarray:
    """(p₁ − p₀)·((p₂ − p₀) × (p₃ − p₀)) of points [..., 4, 3]."""
    edges = p[..., 1:, :] - p[..., :1, :]
    return np.einsum("...i,...i->...", edges[..., 0, :], np.cross(edges[..., 1, :], edges[..., 2, :]))


def meets(start: np.ndarray, end: np.ndarray, of_edges: bool) -> bool | None:
    """Whether four points meet on their way and end beyond, by looking at many times; None: hard to tell."""
    t = np.linspace(0.0, 1.0, 2001)
    values = triple(start + t[:, None, None] * (end - start))
    for k in np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:])):
        low, high = t[k], t[k + 1]
        for _ in range(50):
            middle = 0.5 * (low + high)
            same = np.sign(triple(start + middle * (end - start))) == np.sign(values[k])
            low, high = (middle, high) if same else (low, middle)
        p = start + low * (end - start)
        if of_edges:
            basis, normal = np.stack([p[1] - p[0], p[2] - p[3]], axis=1), np.cross(p[1] - p[0], p[3] - p[2])
            s, u = np.linalg.lstsq(basis, p[2] - p[0], rcond=None)[0]
            weights, within = np.array([1 - s, s, u - 1, -u]), np.array([s, 1 - s, u, 1 - u])
        else:
            basis = np.stack([p[2] - p[1], p[3] - p[1]], axis=1)
            u, v = np.linalg.lstsq(basis, p[0] - p[1], rcond=None)[0]
            normal = np.cross(p[2] - p[1], p[3] - p[1])
            weights, within = np.array([1.0, u + v - 1.0, -u, -v]), np.array([1.0 - u - v, u, v])
        along = abs(normal @ (weights @ start)) / (np.linalg.norm(normal) * np.linalg.norm(weights @ start))
        if abs(within.min()) < 1e-3 or along < 2e-3:
            return None
        before, after = normal @ (weights @ start), normal @ (weights @ end)
        if within.min() > 0.0 and before * after < 0.0:
            return True
    return False


@pytest.mark.parametrize("of_edges", [False, True], ids=["vertex and face", "edges"])
def test_impacts_are_those_that_sampling_finds(of_edges):
    rng = np.random.default_rng(2)
    trials = 300
    start, end = rng.uniform(size=(2, trials, 6, 3))
    # each trial apart from the others: what the hierarchy is for
    place = 5.0 * np.array(list(itertools.product(range(7), repeat=3))[:trials])
    corners = np.array([[0, 1, 4], [2, 3, 5]] if of_edges else [[1, 2, 3]])
    faces = (6 * np.arange(trials)[:, None, None] + corners).reshape(-1, 3)
    detection = Detection(6 * trials, faces, touches_itself=True)
    found = detection.find((start + place[:, None]).reshape(-1, 3), (end + place[:, None]).reshape(-1, 3), near=0.0)
    pairs = {frozenset(vertices) for vertices in found.vertices.tolist()}
    met = 0
    for k in range(trials):
        expected = meets(start[k, :4], end[k, :4], of_edges)
        if expected is not None:
            assert (frozenset(range(6 * k, 6 * k + 4)) in pairs) == expected, k
            met += expected
    assert 15 < met < 285
    # beside, not beyond: the first place is on its side at the start, and not at the end
    gap = [found.gap((p + place[:, None]).reshape(-1, 3)) for p in (start, end)]
    assert (gap[0] > 0.0).all() and (gap[1] < 0.0).all()
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1.0)


def test_what_ends_near_is_found_with_its_side():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    detection = Detection(4, np.array([[1, 2, 3]]), touches_itself=True)
    for height, near, several in ((0.01, 0.02, 1), (-0.01, 0.02, 1), (0.03, 0.02, 0)):
        places = np.vstack([[0.2, 0.3, height], corners])
        found = detection.find(places, places, near)
        assert len(found.weights) == several
        if several:
            assert found.normals[0] == pytest.approx([0.0, 0.0, np.sign(height)])
            assert found.weights[0] == pytest.approx([1.0, -0.5, -0.2, -0.3])
            assert found.gap(places)[0] == pytest.approx(abs(height))


def test_boxes_are_rounded_outwards():
    """A vertex that passes a face by 1e-9 at 1 km from 0, where single precision counts in 6e-5."""
    corners = 1000.0 + np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    detection = Detection(4, np.array([[1, 2, 3]]), touches_itself=True)
    for seed in range(50):
        above = 1000.0 + np.array([*np.random.default_rng(seed).uniform(0.1, 0.4, 2), 1e-9])
        below = above - [0.0, 0.0, 2e-9]
        assert len(detection.find(np.vstack([above, corners]), np.vstack([below, corners]), 0.0).weights) == 1


def test_there_is_room_for_more_impacts_than_at_first():
    """A grid that falls through a floor of two triangles: every node meets it."""
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(0.1, 0.9, 40), np.linspace(0.15, 0.85, 40)))
    nodes = np.column_stack([x, y, np.full(1600, 0.1)])
    floor = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    faces = np.array([[k, k + 1, k + 40] for k in range(1560) if k % 40 < 39])
    detection = Detection(1600, faces, fixed=floor, fixed_faces=np.array([[1600, 1601, 1602], [1600, 1602, 1603]]))
    found = detection.find(nodes, nodes - [0.0, 0.0, 0.2], 0.0)
    assert set(found.vertices[:, 0]) >= set(range(1600))


# -- projection -------------------------------------------------------------------------------------------------------


def a_zone(seed: int, nodes: int = 6, impacts: int = 4) -> tuple[np.ndarray, np.ndarray, Constraints]:
    """Places, inverse masses and constraints of vertices and faces or edges among them."""
    rng = np.random.default_rng(seed)
    picked = np.array([rng.permutation(nodes)[:4] for _ in range(impacts)])
    inside = rng.dirichlet(np.ones(3), size=impacts)
    weights = np.column_stack([np.ones(impacts), -inside])
    normals = rng.normal(size=(impacts, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    limits = rng.uniform(-0.2, 0.4, size=impacts)
    return (
        rng.normal(size=(nodes, 3)),
        1.0 / rng.uniform(0.5, 2.0, size=nodes),
        Constraints(picked, weights, normals, limits),
    )


def gaps(constraints: Constraints, position: np.ndarray) -> np.ndarray:
    pulled = np.einsum("ki,kij->kj", constraints.weights, position[constraints.nodes])
    return np.einsum("kj,kj->k", pulled, constraints.normals) - constraints.limits


@pytest.mark.parametrize("seed", range(12))
def test_projection_is_scipys(seed):
    position, inverse_mass, constraints = a_zone(seed)
    found, _ = project(position, inverse_mass, constraints)
    mass = 1.0 / inverse_mass[:, None]
    other = minimize(
        lambda x: 0.5 * (mass * (x.reshape(-1, 3) - position) ** 2).sum(),
        position.ravel(),
        jac=lambda x: (mass * (x.reshape(-1, 3) - position)).ravel(),
        constraints={"type": "ineq", "fun": lambda x: gaps(constraints, x.reshape(-1, 3))},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )
    assert gaps(constraints, found).min() > -1e-10
    # as near as SLSQP comes
    assert np.abs(found - other.x.reshape(-1, 3)).max() < 1e-6


def test_projection_of_many_and_of_the_same_twice():
    """By the conditions themselves: what is active is met to rounding, pushes, and nothing else does."""
    position, inverse_mass, several = a_zone(0, nodes=60, impacts=50)
    twice = Constraints(*(np.concatenate([values, values]) for values in several))
    found, zones = project(position, inverse_mass, twice)
    gap = gaps(several, found)
    assert gap.min() > -1e-9
    force = np.zeros_like(position)
    for zone in zones:
        assert (zone.multipliers > 0.0).all()
        force[zone.nodes] += (zone.rows.T @ zone.multipliers).reshape(-1, 3)
    assert np.abs(found - position - inverse_mass[:, None] * force).max() < 1e-12
    work = (force * (found - position)).sum()
    assert 0.0 < work == pytest.approx((force**2 * inverse_mass[:, None]).sum())
    # impacts within a cloth leave its momentum as it was
    assert np.abs(force.sum(axis=0)).max() < 1e-10
    assert (np.abs(gap) < 1e-9).sum() >= sum(len(zone.multipliers) for zone in zones) // 2


def test_what_is_held_leaves_no_way_out():
    position, inverse_mass, constraints = a_zone(3)
    constraints = Constraints(*constraints[:3], constraints.limits + 5.0)
    inverse_mass[:] = 0.0
    with pytest.raises(NoWayOut) as raised:
        project(position, inverse_mass, constraints)
    assert raised.value.node in constraints.nodes


@pytest.mark.parametrize("seed", range(6))
def test_transposed_projection_against_differences(seed):
    """By x₁ and by masses, with the same impacts active."""
    position, inverse_mass, constraints = a_zone(seed)
    rng = np.random.default_rng(seed + 100)
    adjoint, direction, of_mass = rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), rng.normal(size=6)
    _, zones = project(position, inverse_mass, constraints)
    to_position, to_mass, *_ = transposed(zones, inverse_mass, adjoint)

    def move(size: float, by_mass: float) -> float:
        start, inverse = position + size * direction, 1.0 / (1.0 / inverse_mass + by_mass * of_mass)
        found, others = project(start, inverse, constraints)
        assert [len(zone.multipliers) for zone in others] == [len(zone.multipliers) for zone in zones]
        return float((adjoint * (found - start)).sum())

    e = 1e-4
    by_position = (8.0 * (move(e, 0) - move(-e, 0)) - (move(2 * e, 0) - move(-2 * e, 0))) / (12.0 * e)
    by_mass = (8.0 * (move(0, e) - move(0, -e)) - (move(0, 2 * e) - move(0, -2 * e))) / (12.0 * e)
    # rounding over the difference, 1e-15 / 1e-4, relative to sums of a few numbers of size 1
    assert (to_position * direction).sum() == pytest.approx(by_position, rel=1e-8, abs=1e-9)
    assert to_mass @ of_mass == pytest.approx(by_mass, rel=1e-8, abs=1e-9)


# -- motions ----------------------------------------------------------------------------------------------------------


def cloth(size: int = 5, pose: str = "flat", **options) -> wy.Cloth:
    """The paper's, whose parallel yarns do not just touch at rest: there is a kink."""
    return wy.paper.cloth(rows=size, columns=size, pose=pose, radius=4.8e-4, **options)


def penetrations(position: np.ndarray, faces: np.ndarray) -> int:
    """How many edges of triangles go through others, of all pairs."""
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    e, f = (index.ravel() for index in np.meshgrid(np.arange(len(edges)), np.arange(len(faces))))
    apart = (edges[e][:, :, None] != faces[f][:, None]).all(axis=(1, 2))
    (a, b), (p, q, r) = position[edges[e[apart]]].swapaxes(0, 1), position[faces[f[apart]]].swapaxes(0, 1)

    def volume(*points: np.ndarray) -> np.ndarray:
        return triple(np.stack(points, axis=1))

    beyond = volume(a, p, q, r) * volume(b, p, q, r) < 0.0
    through = np.sign([volume(a, b, p, q), volume(a, b, q, r), volume(a, b, r, p)])
    return int((beyond & (np.abs(through.sum(axis=0)) == 3)).sum())


def test_the_published_scene_against_a_wall():
    """The published code's kind: 5 × 5, upright, pinned by its top corners, blown by 5 m/s, 20 steps, its thickness."""
    blown = cloth(pose="upright")
    y = blown.position[:, 1].max()
    # within reach in 20 ms: without the wall the cloth gets 0.9 mm beyond
    wall = wy.Plane(point=(0.0, y + 6e-4, 0.0), normal=(0.0, -1.0, 0.0), friction=0.0)
    scene = wy.paper.hung(blown)
    free = wy.Simulator(scene, integrator="linear").run(20)
    assert free.position[-1, :, 1].max() > wall.position[1]
    held = scene.replace(obstacles=[wall], contact=wy.Contact(method="impact-zones", thickness=5e-4))
    run = wy.Simulator(held, integrator="linear").run(20)
    gap = wall.position[1] - run.position[:, :, 1]
    assert gap.min() > 5e-4 * (1.0 - 1e-9)
    assert (gap[-1] < 5e-4 * (1.0 + 1e-9)).sum() > 3


BLOCK = wy.Box(center=(2e-3, 2e-3, -5e-3), half_extents=(3e-3, 3e-3, 3e-3), friction=0.0)
TENT = wy.TriangleMesh(
    np.array([[2e-3, 2e-3, -1e-3], [-8e-3, -8e-3, -4e-3], [12e-3, -8e-3, -4e-3], [2e-3, 12e-3, -4e-3]]),
    np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]]),
    friction=0.0,
)
FLOORS = {
    "plane": wy.Plane(point=(0.0, 0.0, -2e-3), normal=(0.0, 0.2, 1.0), friction=0.0),
    "box": BLOCK,
    "mesh": TENT,
}


@pytest.mark.parametrize("floor", FLOORS)
def test_a_drop_does_not_penetrate(floor):
    """On a floor, a block that is smaller than the cloth, and the tip of a tent."""
    obstacle = FLOORS[floor]
    scene = wy.Scene(cloth(7), obstacles=[obstacle], contact=ZONES)
    simulator = wy.Simulator(scene, step=5e-4, integrator="linear")
    start = simulator.state
    start.velocity[:, 2] = -0.5
    simulator.state = start
    run = simulator.run(40)
    if floor == "plane":
        normal = np.array([0.0, 0.2, 1.0]) / np.hypot(0.2, 1.0)
        assert ((run.position - obstacle.position) @ normal).min() > 0.099e-3
        return
    vertices, faces = (TENT.vertices, TENT.faces) if floor == "mesh" else box_faces(BLOCK)
    both = np.concatenate([scene.cloth.topology.triangle_nodes, faces + scene.cloth.nodes])
    assert not any(penetrations(np.concatenate([frame, vertices]), both) for frame in run.position)
    # it was caught
    fallen = np.array([0.0, 0.0, -0.5 * 0.02 - 0.5 * 9.8 * 0.02**2])
    assert run.position[-1, :, 2].max() > fallen[2] + 5e-3


def box_faces(box: wy.Box) -> tuple[np.ndarray, np.ndarray]:
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        a, b, c, d = (k for k in range(8) if (k >> (2 - axis)) & 1 == side)
        faces += [[a, b, d], [a, d, c]]
    return box.position + signs * box.size, np.array(faces)


def test_a_cloth_at_rest_on_a_plane_stays():
    """The whole of the correction reaches the velocity: what lies does not sink, and has no speed."""
    lying = cloth()
    z = lying.position[:, 2].min()
    floor = wy.Plane(point=(0.0, 0.0, z - 1e-4), normal=(0.0, 0.0, 1.0), friction=0.0)
    simulator = wy.Simulator(wy.Scene(lying, obstacles=[floor], contact=ZONES), integrator="linear")
    run = simulator.run(50)
    assert np.abs(run.position[..., 2] - z).max() < 1e-12
    assert np.abs(run.velocity[-1, :, 2]).max() < 1e-9
    assert simulator.split_steps == {}


def two_sheets() -> tuple[wy.Scene, wy.State]:
    """Two cloths, one 1.5 mm above the other and turned and tilted a little, that fly at each other."""
    lower, upper = cloth(), cloth(4).position
    c, s = np.cos(0.4), np.sin(0.4)
    turn = np.array([[c, -s, 0.0], [s, c, 0.1], [0.0, 0.0, 1.0]])
    middle = lower.position.mean(axis=0)
    turned = (upper - upper.mean(axis=0)) @ turn.T + middle + [3e-4, 2e-4, 1.5e-3]
    scene = wy.Scene([lower, cloth(4, pose=turned)], gravity=None, self_contact=True, contact=ZONES)
    state = wy.Simulator(scene, integrator="linear").state
    state.velocity[lower.nodes :, 2] = -0.3
    return scene, state


def test_cloths_do_not_pass_each_other():
    scene, state = two_sheets()
    simulator = wy.Simulator(scene, step=5e-4, integrator="linear")
    simulator.state = state
    run = simulator.run(40)
    faces = scene.cloth.topology.triangle_nodes
    assert not any(penetrations(frame, faces) for frame in run.position)
    upper = np.arange(scene.cloth.nodes) >= 25
    # one pushes the other, and together they have the momentum that they had: conjugate gradients leave 1e-6 of it
    assert run.velocity[-1, ~upper, 2].mean() < -0.05
    segments, yarn = scene.cloth.topology.segment_nodes, scene.cloth.topology.segment_yarn
    density = np.array([y.density for y in scene.cloth.yarns])[scene.cloth.material][yarn]
    mass = np.bincount(segments.ravel(), np.repeat(density, 2), minlength=scene.cloth.nodes)
    before, after = (mass @ run.velocity[k, :, 2] for k in (0, -1))
    assert after == pytest.approx(before, rel=1e-4)


def test_a_cloth_falls_onto_itself():
    """A strip that is folded over, whose upper half falls on the lower."""
    strip = wy.Cloth(
        wy.Weave.plain(rows=4, columns=12), yarns=[wy.Yarn(density=2e-3, stretch=5e5, bend=1e-6)], pose="flat"
    )
    scene = wy.Scene(strip, self_contact=True, contact=ZONES, gravity=(0.0, 0.0, -9.8))
    simulator = wy.Simulator(scene, step=5e-4, integrator="linear")
    state = simulator.state
    x = state.position[:, 0] - state.position[:, 0].min()
    bend = np.maximum(x - 4e-3, 0.0)
    # half of it stands in an arc of radius 1.2 mm above the rest, and falls on
    radius = 1.2e-3
    angle = np.minimum(bend / radius, np.pi)
    state.position[:, 0] += -bend + radius * np.sin(angle) - np.maximum(bend - np.pi * radius, 0.0)
    state.position[:, 2] += radius * (1.0 - np.cos(angle))
    state.velocity[:, 2] = np.where(bend > np.pi * radius, -0.5, 0.0)
    simulator.state = state
    run = simulator.run(20)
    faces = strip.topology.triangle_nodes
    assert not any(penetrations(frame, faces) for frame in run.position)
    free = wy.Simulator(scene.replace(self_contact=False), step=5e-4, integrator="linear")
    free.state = state
    assert any(penetrations(frame, faces) for frame in free.run(20).position)


def test_pins_that_are_driven_into_a_box_end_in_an_error():
    hung = cloth(pose="upright")
    pins = hung.corners("top")
    path = hung.position[pins] - np.arange(1, 30)[:, None, None] * [0.0, 0.0, 2e-4]
    below = hung.position[pins].mean(axis=0) - [0.0, 0.0, 6e-3]
    box = wy.Box(center=below, half_extents=(1e-2, 1e-2, 1e-3), friction=0.0)
    scene = wy.Scene(hung, pins=pins, pin_stiffness=None, pin_path=path, obstacles=[box], contact=ZONES, sliding=False)
    with pytest.raises(wy.SimulationError, match="no way out") as raised:
        wy.Simulator(scene, integrator="linear").run(60)
    assert raised.value.node >= 0
    assert len(raised.value.trajectory) > 5


def test_rounds_that_do_not_end_are_an_error(monkeypatch):
    monkeypatch.setattr("warp_yarn.device.impact_zones.MOST_ROUNDS", 1)
    scene, state = two_sheets()
    simulator = wy.Simulator(scene, step=5e-4, integrator="linear")
    simulator.state = state
    with pytest.raises(wy.SimulationError, match="rounds of impact zones"):
        simulator.run(40)


# -- what cannot be combined ------------------------------------------------------------------------------------------


PLANE = wy.Plane(point=(0.0, 0.0, -1.0), normal=(0.0, 0.0, 1.0), friction=0.0)
REFUSED = {
    "sdirk2": lambda: wy.Simulator(wy.Scene(cloth(), obstacles=[PLANE], contact=ZONES)),
    "linear": lambda: wy.Simulator(wy.Scene(cloth(), obstacles=[PLANE]), integrator="linear"),
    "must be a Plane, a Box or a TriangleMesh": lambda: wy.Scene(
        cloth(), obstacles=[wy.Sphere(center=(0, 0, -1), radius=0.1, friction=0.0)], contact=ZONES
    ),
    "friction = 0.3": lambda: wy.Scene(cloth(), obstacles=[PLANE.replace(friction=0.3)], contact=ZONES),
    "has a path": lambda: wy.Scene(cloth(), obstacles=[PLANE.replace(path=[(0, 0, -2)])], contact=ZONES),
    "contact friction = 0.2": lambda: wy.Contact(method="impact-zones", friction=0.2),
    "contact stiffness": lambda: wy.Contact(method="impact-zones", stiffness=1.0),
    "contact thickness = 0.001 with a barrier": lambda: wy.Contact(thickness=1e-3),
    "contact thickness = 0": lambda: wy.Contact(method="impact-zones", thickness=0.0),
    "'barrier'": lambda: wy.Simulator(
        wy.Scene(cloth(), obstacles=[PLANE], contact=ZONES), integrator="linear"
    ).contacts(),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_combined_is_refused(name):
    with pytest.raises(wy.InputError, match=name):
        REFUSED[name]()


@pytest.mark.parametrize("name", ["plane", "box", "through", "itself"])
def test_an_overlapping_start_is_refused(name):
    flat = cloth()
    x, y, z = flat.position.mean(axis=0)
    below = dict(point=(x, y, z + 1e-3), normal=(0.0, 0.0, 1.0), friction=0.0)
    obstacles = {
        "plane": [wy.Plane(**below)],
        "box": [wy.Box(center=(x, y, z), half_extents=(1.0, 1.0, 1.0), friction=0.0)],
        "through": [wy.Box(center=(x, y, z), half_extents=(1e-3, 1e-3, 1e-3), friction=0.0)],
        "itself": [],
    }[name]
    scene = wy.Scene(flat, obstacles=obstacles, self_contact=name == "itself", contact=ZONES)
    if name != "itself":
        with pytest.raises(wy.InputError, match=r"node \d+ .* obstacles\[0\], a"):
            wy.Simulator(scene, integrator="linear")
        return
    simulator = wy.Simulator(scene, integrator="linear")
    state = simulator.state
    state.position[:2] = flat.position[[6, 7, 11]].mean(axis=0)
    state.position[:2, 2] += [-1e-4, 1e-4]
    with pytest.raises(wy.InputError, match=r"node \d+ .* and node \d+"):
        simulator.state = state


# -- gradients --------------------------------------------------------------------------------------------------------


@functools.cache
def a_bent_state(size: int = 5) -> dict[str, torch.Tensor]:
    """Positions where no yarn is straight, and velocities towards what is 2 mm below."""
    rng = np.random.default_rng(5)
    flat = cloth(size)
    position = flat.position + 5e-5 * rng.normal(size=(flat.nodes, 3))
    velocity = 0.05 * rng.normal(size=(flat.nodes, 3)) + [0.0, 0.0, -0.5]
    return {"position": torch.tensor(position), "velocity": torch.tensor(velocity)}


SOURCES = {"gravity": "gravity", "yarn_density": "density"}
SCALES = {"position": 1e-5, "velocity": 1e-2, "gravity": 1.0, "yarn_density": 1e-4}


def compare(
    scene: wy.Scene,
    steps: int,
    names: tuple[str, ...],
    bound: float,
    *,
    given: dict[str, torch.Tensor] | None = None,
    prepare=lambda simulator: None,
    **options,
) -> None:
    """A gradient with Richardson differences along one direction for each input."""
    rollout = wy.torch.Rollout(scene, steps, integrator="linear", frames=[steps], tolerance=1e-12, **options)
    prepare(rollout.simulator)
    generator = torch.Generator().manual_seed(0)
    own = rollout.defaults
    acts = {name: own[source] for name, source in SOURCES.items() if source in own}
    given = {**acts, **(a_bent_state() if given is None else given)}
    at_position, at_velocity = torch.randn((2, scene.cloth.nodes, 3), dtype=torch.float64, generator=generator)

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        frames = rollout(**values)
        return (frames.position[-1] * at_position).sum() + 1e-3 * (frames.velocity[-1] * at_velocity).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    loss(leaves).backward()
    for name in names:
        direction = SCALES[name] * torch.randn(given[name].shape, dtype=torch.float64, generator=generator)

        def difference(e: float, name: str = name, direction: torch.Tensor = direction) -> float:
            with torch.no_grad():
                ends = [loss({**given, name: given[name] + s * direction}) for s in (e, -e)]
            return float(ends[0] - ends[1]) / (2.0 * e)

        # beyond 1e-2 yarns buckle within the difference
        wanted = (4.0 * difference(1e-3) - difference(2e-3)) / 3.0
        assert float((leaves[name].grad * direction).sum()) == pytest.approx(wanted, rel=bound), name


GROUNDS = {
    "plane": wy.Plane(point=(0.0, 0.0, -2e-3), normal=(0.0, 0.2, 1.0), friction=0.0),
    "box": wy.Box(center=(0.0, 0.0, -12e-3), half_extents=(0.1, 0.1, 0.01), friction=0.0),
}


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("ground", GROUNDS)
def test_gradients_through_impacts(ground, every):
    """On planes and flat faces normals do not turn: nothing is left out."""
    scene = wy.Scene(cloth(friction_damping=0.1), obstacles=[GROUNDS[ground]], contact=ZONES)
    compare(scene, 12, ("position", "velocity", "gravity", "yarn_density"), 1e-6, checkpoint_every=every)


def test_gradients_through_an_impact_in_a_step_that_was_split():
    ground = wy.Plane(point=(0.0, 0.0, -4e-4), normal=(0.0, 0.0, 1.0), friction=0.0)
    scene = wy.Scene(cloth(friction_damping=0.1), obstacles=[ground], contact=ZONES)
    seen = []

    def prepare(simulator: wy.Simulator) -> None:
        fails_at_first(simulator, 6e-4)
        seen.append(simulator)

    compare(scene, 4, ("position", "velocity", "gravity"), 1e-6, prepare=prepare)
    assert list(seen[0].split_steps) == [1]


@pytest.mark.parametrize("seed", range(4))
def test_adjoint_of_all_rounds_against_differences(seed):
    """Of a way on which one sheet flies through another: faces, edges, times, and a second round."""
    scene, state = two_sheets()
    simulator = wy.Simulator(scene, step=5e-4, integrator="linear")
    rng = np.random.default_rng(seed)
    shape, upper = (scene.cloth.nodes, 3), np.arange(scene.cloth.nodes) >= 25
    inverse_mass, adjoint = 1.0 / rng.uniform(0.5, 2.0, size=shape[0]), rng.normal(size=shape)
    start = state.position + 2e-5 * rng.normal(size=shape)
    end = start + 1e-4 * rng.normal(size=shape)
    end[upper, 2] -= 1.5e-3 + 3e-4 * seed
    directions = rng.normal(size=(2, *shape))
    _, *gradients, active = resolved_with_its_adjoint(simulator, start, end, inverse_mass, adjoint)
    assert sum(active[-1]) > 10

    def move(by_start: float, by_end: float) -> float:
        ends = start + by_start * directions[0], end + by_end * directions[1]
        found, _, _, others = resolved_with_its_adjoint(simulator, *ends, inverse_mass, adjoint)
        assert others == active
        return float((adjoint * (found - ends[1])).sum())

    e = 1e-9
    for k, gradient in enumerate(gradients):
        wanted = (move(*(e * np.eye(2)[k])) - move(*(-e * np.eye(2)[k]))) / (2.0 * e)
        # rounding of places, 1e-18, over the difference
        assert (gradient * directions[k]).sum() == pytest.approx(wanted, rel=1e-6)


def test_gradients_between_cloths():
    """Where normals and weights follow from all positions, and the time of impacts matters."""
    scene, state = two_sheets()
    scene = wy.Scene(
        [part.replace(friction_damping=0.1) for part in scene.cloth.cloths],
        gravity=None,
        self_contact=True,
        contact=ZONES,
    )
    state.position += 3e-5 * np.random.default_rng(7).normal(size=state.position.shape)
    given = {"position": torch.tensor(state.position), "velocity": torch.tensor(state.velocity)}
    compare(scene, 12, ("position", "velocity"), 1e-5, given=given, step=5e-4)
