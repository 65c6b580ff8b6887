"""Middles of segments as samples of contact: the law by an oracle whose samples come from rows and columns alone."""

import functools

import numpy as np
import pytest
import torch
from checks import check_definite, error
from internals import launch_one_by_one, look_after_stages, near_obstacles, near_pairs, numbers, put, upload
from reference import Tensor, tensor
from touching import (
    GROUND,
    SHAPES,
    TURNED,
    folded,
    law_of,
    lifted,
    middles,
    paper,
    parts_of,
    places_near,
    posed,
    shapes,
)

import warp_yarn as wy

CLOTH = paper(5, 6)
SMALL = {"self_distance": 3e-4, "self_range": 5e-4}
"""So short that neighbours may touch: many pairs in a small cloth."""
MIDS = {"samples": "nodes+mids"}
SIZE = CLOTH.nodes + 5 * 5 + 4 * 6


@functools.cache
def simulator_of(friction: float, damping_speed: float | None, shape: str | None = None) -> wy.Simulator:
    """A cloth that feels contact alone: with itself, or with one obstacle."""
    contact = wy.Contact(friction=friction, damping_speed=damping_speed, slip_speed=0.1, **SMALL, **MIDS)
    options = {"contact": contact, "sliding": False, "gravity": None}
    if shape is None:
        scene = wy.Scene(CLOTH, self_contact=True, terms=["self_contact"], **options)
    else:
        terms = ["obstacles", "meshes"] if shape == "mesh" else ["obstacles"]
        far = CLOTH.replace(pose=CLOTH.position + 1.0)
        if shape == "plane":
            far = CLOTH.replace(pose=CLOTH.position + TURNED.apply((0.0, 0.0, 1.0)))
        scene = wy.Scene(far, obstacles=[shapes(friction)[shape][0]], terms=terms, **options)
    return wy.Simulator(scene, integrator="implicit-euler")


def crumpled(seed: int = 0, *, speed: float = 0.3) -> wy.State:
    """Nodes by chance in a cube, with no two samples that may touch nearer than D."""
    random, of_nodes = np.random.default_rng(seed), middles(5, 6)
    far = np.triu(far_samples(), 1)
    while True:
        position = random.uniform(0.0, 2.4e-3, (CLOTH.nodes, 3))
        for _ in range(400):
            c = of_nodes @ position
            gap = np.linalg.norm(c[:, None] - c[None], axis=2) + np.where(far, 0.0, 1.0)
            p, q = np.unravel_index(gap.argmin(), gap.shape)
            if gap[p, q] > 3.05e-4:
                return posed(CLOTH, position, speed * random.standard_normal(position.shape))
            # push the two apart, by their nodes
            n = (c[p] - c[q]) / gap[p, q]
            position += 5e-5 * np.sign(of_nodes[p] - of_nodes[q])[:, None] * n


def far_samples() -> np.ndarray:
    """Which samples may touch each other [samples, samples]."""
    row, column = np.divmod(np.arange(CLOTH.nodes), 6)
    rest = middles(5, 6) @ (np.stack([column, row], axis=1) * CLOTH.spacing)
    return np.linalg.norm(rest[:, None] - rest[None], axis=2) >= 0.5 * np.pi * 8e-4


def force_of_pairs(position: np.ndarray, friction: float, damping_speed: float | None):
    """Of positions and velocities of nodes, and the energy."""
    law = law_of(simulator_of(friction, damping_speed), friction, "self_contact")
    of_nodes = tensor(middles(5, 6))
    c = middles(5, 6) @ position
    gap = np.linalg.norm(c[:, None] - c[None], axis=2)
    p, q = (torch.as_tensor(k) for k in np.nonzero(np.triu(far_samples(), 1) & (gap < 8e-4)))

    def force(x: Tensor, v: Tensor) -> Tensor:
        c, rate = of_nodes @ x, of_nodes @ v
        r = c[p] - c[q]
        gap = torch.linalg.vector_norm(r, dim=1)
        on_p = law.force(gap, r / gap[:, None], rate[p] - rate[q])
        return of_nodes.T @ torch.zeros_like(c).index_add(0, p, on_p).index_add(0, q, -on_p)

    def energy(x: Tensor) -> Tensor:
        c = of_nodes @ x
        return law.energy(torch.linalg.vector_norm(c[p] - c[q], dim=1)).sum()

    return force, energy, len(p)


@pytest.mark.parametrize("seed", range(3))
def test_energy_and_force_of_pairs(seed: int) -> None:
    state = crumpled(seed)
    x, v = tensor(state.position).requires_grad_(), tensor(state.velocity)
    for friction, damping_speed in ((0.3, 0.5), (0.0, 0.5), (0.6, None)):
        force, energy, pairs = force_of_pairs(state.position, friction, damping_speed)
        assert pairs > 100
        simulator = simulator_of(friction, damping_speed)
        found = simulator.forces(state)["self_contact"][0]
        # of sums of some tens of pairs, the nearest a hundredth of the range apart
        assert error(found, force(x, v).detach().numpy()) < 1e-11
        assert np.abs(found.sum(axis=0)).max() < 1e-14 * np.abs(found).sum()
        total = energy(x)
        assert simulator.energy(state)["contact"] == pytest.approx(total.item(), rel=1e-12)
        (slope,) = torch.autograd.grad(total, x)
        assert error(simulator.forces(posed(CLOTH, state.position))["self_contact"][0], -slope.numpy()) < 1e-11


@pytest.mark.parametrize(("friction", "damping_speed"), [(0.0, 0.5), (0.6, None)])
def test_damping_matrix_of_pairs(friction: float, damping_speed: float | None) -> None:
    """−∂F/∂v, with what couples all four nodes of two middles."""
    state, n = crumpled(), 3 * CLOTH.nodes
    force, _, _ = force_of_pairs(state.position, friction, damping_speed)
    exact = -torch.autograd.functional.jacobian(
        lambda v: force(tensor(state.position), v), tensor(state.velocity)
    ).reshape(n, n)
    simulator = simulator_of(friction, damping_speed)
    found = simulator.system(state, weights=(0.0, 1.0, 0.0)).dense()
    assert error(found, exact.numpy()) < 1e-9
    check_definite(found)
    check_definite(simulator.system(state, weights=(0.0, 1.0, 1.0)).dense())


@pytest.mark.parametrize("shape", SHAPES)
def test_obstacles(shape: str) -> None:
    """Energy, force and damping's matrix, of nodes and middles near every shape."""
    friction, of_nodes = 0.3, tensor(middles(5, 6))
    simulator, parts = simulator_of(friction, None, shape), parts_of(shape)
    law, distance = law_of(simulator, friction), shapes()[shape][1]
    # a place about which there is room for all nodes within the range, or nearly
    places, k = places_near(distance, 400, law.distance + 0.2 * law.range, law.distance + 0.5 * law.range), 0
    random = np.random.default_rng(1)
    while True:
        position = places[k] + 1.5e-4 * random.standard_normal((CLOTH.nodes, 3))
        if distance(of_nodes @ tensor(position)).min() > law.distance * 1.01:
            break
        k += 1
    state = posed(CLOTH, position, 0.1 * random.standard_normal(position.shape))
    x, v = tensor(state.position).requires_grad_(), tensor(state.velocity)
    c = of_nodes @ x
    energy = sum(law.energy(part(c)).sum() for part in parts)
    (slope,) = torch.autograd.grad(energy, x)
    assert simulator.energy(state)["contact"] == pytest.approx(energy.item(), rel=1e-10)

    gaps = [(part(c).detach(), torch.autograd.grad(part(c).sum(), c)[0]) for part in parts if True]

    def force(v: Tensor) -> Tensor:
        return of_nodes.T @ sum(law.force(gap, n, of_nodes @ v) for gap, n in gaps)

    def found(state: wy.State) -> np.ndarray:
        forces = simulator.forces(state)
        return forces["obstacles"][0] + forces.get("meshes", (0.0,))[0]

    assert error(found(posed(CLOTH, position)), -slope.numpy()) < 1e-10
    assert (np.abs(slope.numpy()).max(axis=1) > 0.0).sum() > 10
    assert error(found(state), force(v).numpy()) < 1e-10
    n = 3 * CLOTH.nodes
    exact = -torch.autograd.functional.jacobian(force, v).reshape(n, n)
    matrix = simulator.system(state, weights=(0.0, 1.0, 0.0)).dense()
    assert error(matrix, exact.numpy()) < 1e-9
    check_definite(simulator.system(state, weights=(0.0, 1e-3, 1e-6)).dense())


@pytest.mark.parametrize("seed", range(4))
def test_list_is_brute_force(seed: int) -> None:
    simulator, state = simulator_of(0.3, 0.5), crumpled(seed)
    upload(simulator, state)
    put(simulator, "near_position", np.nan)
    found = near_pairs(simulator)
    c = middles(5, 6) @ state.position
    gap = np.linalg.norm(c[:, None] - c[None], axis=2)
    within = 8e-4 + numbers(simulator, "near_margin")[0]
    # in whatever order segments are: by their places
    expected = sorted(gap[np.triu(far_samples(), 1) & (gap < within)])
    assert np.allclose(sorted(found.gap), expected, rtol=0.0, atol=1e-15) and len(expected) == len(found.gap)


@pytest.mark.parametrize("preconditioner", ["incomplete", "multilevel"])
def test_solution_is_that_of_the_dense_system(preconditioner: str) -> None:
    scene = wy.Scene(folded(6, 17), obstacles=[GROUND], self_contact=True, contact=wy.Contact(**MIDS))
    simulator = wy.Simulator(scene, integrator="implicit-euler", preconditioner=preconditioner)
    simulator.run(25)
    touching = simulator.contacts()
    assert ((touching.other >= 0) & (touching.node_end >= 0)).sum() > 8
    system = simulator.system()
    dense, free, n = system.dense(), system.free, 3 * scene.cloth.nodes
    check_definite(dense)
    model, a, random = simulator.model, simulator.arrays, np.random.default_rng(0)
    model.factorize()
    b = random.standard_normal(len(dense)) * free
    expected = np.zeros_like(b)
    expected[free] = np.linalg.solve(dense[np.ix_(free, free)], b[free])
    for start in (0.0, 1.0):
        a["rhs"].assign(b[:n].reshape(-1, 3))
        a["solution"].assign(start * random.standard_normal((n // 3, 3)))
        a["euler_rhs"].assign(b[n:])
        a["euler_solution"].assign(0.0 * b[n:])
        a.put("tolerance", 1e-11)
        model.solve()
        found = np.concatenate([numbers(simulator, "solution").ravel(), numbers(simulator, "euler_solution")])
        # the tolerance, by the root of the condition number, 1e4
        assert np.linalg.norm((found - expected)[free]) < 1e-7 * np.linalg.norm(expected)


# -- motions -----------------------------------------------------------------------------------------------------------


def rod_under(samples: str) -> wy.Simulator:
    """A sheet that falls on a rod as thin as a needle, halfway between two rows of nodes."""
    cloth = lifted(paper(6, 6), 2e-3)
    rod = wy.Capsule(start=(-1e-2, 2.5e-3, 0.0), end=(2e-2, 2.5e-3, 0.0), radius=2e-5, friction=0.0)
    contact = wy.Contact(distance=2e-4, range=2e-4, samples=samples)
    return wy.Simulator(wy.Scene(cloth, obstacles=[rod], contact=contact), integrator="implicit-euler")


def test_middles_rest_on_what_nodes_pass() -> None:
    falls, rests = rod_under("nodes"), rod_under("nodes+mids")
    for simulator in (falls, rests):
        simulator.run(45)
    assert falls.state.position[:, 2].max() < -2e-3
    height = (middles(6, 6) @ rests.state.position)[:, 2]
    # the two rows beside the rod hang over it
    assert height.max() > 2e-4 and (rests.contacts().node_end >= 0).sum() > 3


def crumpling(seed: int) -> wy.Scene:
    cloth = paper(9, 6, pose="upright")
    random = np.random.default_rng(seed)
    position = cloth.position + np.array([0.0, 0.0, 1.5e-3]) + 3e-5 * random.standard_normal(cloth.position.shape)
    t = 1e-3 * np.arange(1, 41)[:, None]
    ball = wy.Sphere(center=(2.5e-3, -6e-3, 4e-3), radius=3e-3, path=(2.5e-3, -6e-3, 4e-3) + t * (0.0, 0.5, 0.0))
    scene = wy.Scene(cloth.replace(pose=position), obstacles=[GROUND, ball], self_contact=True)
    return scene.replace(contact=wy.Contact(**MIDS))


@pytest.mark.parametrize(
    ("method", "seed"),
    [
        ("implicit-euler", 0),
        *(pytest.param(m, s, marks=pytest.mark.slow) for m in ("implicit-euler", "sdirk2") for s in (1, 2)),
    ],
)
def test_nothing_penetrates(method: str, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """At any stage: neither obstacles, one of which is driven into the cloth, nor the cloth itself."""
    scene = crumpling(seed)
    simulator = wy.Simulator(scene, integrator=method)
    state = simulator.state
    state.velocity[:] += (0.0, 0.0, -0.8)
    simulator.state = state
    of_nodes, least, seen = middles(9, 6), [], []
    row, column = np.divmod(np.arange(54), 6)
    rest = of_nodes @ (np.stack([column, row], axis=1) * scene.cloth.spacing)
    far = np.triu(np.linalg.norm(rest[:, None] - rest[None], axis=2) >= 0.5 * np.pi * 2.5e-3, 1)

    def look(touches: bool = False) -> None:
        c = of_nodes @ numbers(simulator, "position")
        gap = np.linalg.norm(c[:, None] - c[None], axis=2)[far].min()
        least.append((near_obstacles(simulator).gap.min() / 5e-4, gap / 1.5e-3))
        seen.append(touches)

    look_after_stages(simulator, look, monkeypatch)
    for _ in range(40):
        simulator.run(1)
        look()
    assert np.min(least) > 1.0 and sum(seen) > 10
    assert np.min(least, axis=0)[0] < 2.0


# at 5 m/s it is a matter of rounding whether the sheet is taken along or the plate has passed it after two steps
@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_a_fast_obstacle_takes_cloth_along(speed: float) -> None:
    """A plate that fits between two rows of nodes comes upon a sheet: by as much as 3 spacings a step."""
    cloth = lifted(paper(6, 6, pose="upright"), 0.0, 2e-5)
    at, t = np.array([2.5e-3, -1e-3, 2.5e-3]), 1e-3 * np.arange(1, 8 if speed < 2.0 else 4)[:, None]
    plate = wy.Box(center=at, half_extents=(2e-3, 1e-4, 3e-4), path=at + t * (0.0, speed, 0.0))
    farthest = []
    for samples in ("nodes", "nodes+mids"):
        contact = wy.Contact(distance=1e-4, range=1e-4, samples=samples)
        scene = wy.Scene(cloth, gravity=None, obstacles=[plate], contact=contact)
        simulator = wy.Simulator(scene, integrator="implicit-euler")
        simulator.run(len(t))
        farthest.append((middles(6, 6) @ simulator.state.position)[:, 1].max())
    # nodes alone let it pass
    assert farthest[0] < 1e-4 and farthest[1] > plate.path[-1, 1] + 2e-4


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_momentum_is_kept(friction: float) -> None:
    cloths = [lifted(paper(5, 5), 0.0, 5e-5, 1), lifted(paper(4, 4), 2.6e-3, 5e-5, 2)]
    contact = wy.Contact(friction=friction, **MIDS)
    scene = wy.Scene(cloths, gravity=None, self_contact=True, sliding=False, contact=contact)
    simulator = wy.Simulator(scene, integrator="implicit-euler", newton_tolerance=1e-12, tolerance=1e-12)
    state = simulator.state
    state.velocity[:25] += (0.05, 0.1, 0.4)
    state.velocity[25:] += (-0.1, 0.0, -0.5)
    simulator.state = state
    mass, touched = simulator.system(weights=(1.0, 0.0, 0.0)).dense(), 0
    p = (mass @ state.velocity.ravel()).reshape(-1, 3)
    for _ in range(8):
        simulator.run(1)
        touched += len(simulator.contacts())
        state, before = simulator.state, p
        p = (mass @ state.velocity.ravel()).reshape(-1, 3)
        arm = state.position - state.position.mean(axis=0)
        assert np.abs((p - before).sum(axis=0)).max() < 1e-9 * np.abs(p).sum()
        if not friction:
            turned = np.cross(arm, p - before)
            assert np.abs(turned.sum(axis=0)).max() < 1e-9 * np.abs(np.cross(arm, p)).sum()
    assert touched > 20


def test_what_lies_lies_as_high() -> None:
    """The default stiffness is of as much cloth, of however many samples."""
    heights = []
    for samples in ("nodes", "nodes+mids"):
        scene = wy.Scene(lifted(paper(7, 7), 1.1e-3), obstacles=[GROUND], contact=wy.Contact(samples=samples))
        simulator = wy.Simulator(scene, integrator="implicit-euler", step=2e-3)
        simulator.run(150)
        assert np.abs(simulator.state.velocity).max() < 1e-3
        heights.append(simulator.state.position[24, 2])
    # a hundredth of what a cloth lies below the end of the range, which a third of the stiffness would double
    assert heights[0] == pytest.approx(heights[1], abs=2e-7) and heights[0] < 1e-3 - 5e-6


def test_the_same_twice_and_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """And after more room for what is near."""
    scene = wy.Scene(folded(), obstacles=[GROUND], self_contact=True, contact=wy.Contact(**MIDS))
    first = wy.Simulator(scene, integrator="implicit-euler").run(25).position.tobytes()
    assert wy.Simulator(scene, integrator="implicit-euler").run(25).position.tobytes() == first
    monkeypatch.setattr("warp_yarn.device.contact.NEAR_ROOM", 1)
    launch_one_by_one(monkeypatch)
    assert wy.Simulator(scene, integrator="implicit-euler").run(25).position.tobytes() == first


def test_nodes_alone_have_no_arrays_of_middles() -> None:
    simulator = wy.Simulator(wy.Scene(folded(), obstacles=[GROUND], self_contact=True), integrator="implicit-euler")
    names = ("sample_position", "sample_force", "sample_block", "node_segments", "taken_by")
    assert all(simulator.arrays.get(name) is None for name in names)


def test_contacts_tell_middles() -> None:
    scene = wy.Scene(lifted(paper(5, 6), 1.1e-3), obstacles=[GROUND], contact=wy.Contact(**MIDS))
    simulator = wy.Simulator(scene, integrator="implicit-euler")
    simulator.run(120)
    found, x = simulator.contacts(), simulator.state.position
    assert len(found) == SIZE and (found.node_end < 0).sum() == 30
    ends = np.where(found.node_end < 0, found.node, found.node_end)
    middle = 0.5 * (x[found.node] + x[ends])
    assert np.abs(found.place[:, :2] - middle[:, :2]).max() < 1e-15 and np.abs(found.gap - middle[:, 2]).max() < 1e-15
    assert found.load.sum() == pytest.approx(-simulator.forces()["gravity"][0][:, 2].sum(), rel=1e-3)
    cloth = lifted(paper(5, 6), 1.1e-3)
    ball = wy.Sphere(center=(2.5e-3, 2e-3, 0.0), radius=7e-4)
    with pytest.raises(wy.InputError, match=r"the middle between node 14 \(.*\) and node 15 \(.* from obstacles\[0\]"):
        wy.Simulator(scene.replace(cloth=cloth, obstacles=[ball]), integrator="implicit-euler")


def roughness(samples: str, load: float, places: int) -> tuple[float, tuple[float, float]]:
    """The largest sideways force over the load of two rigid sheets that lie on each other somewhere, without friction,
    and how far apart they lie, in spacings: at a load on a node, in parts of κ d̂ of a node."""
    lower, upper = paper(15, 15), paper(5, 5)
    contact = wy.Contact(friction=0.0, samples=samples)
    scene = wy.Scene([lower, lifted(upper, 5e-3)], self_contact=True, gravity=None, contact=contact, sliding=False)
    simulator = wy.Simulator(scene, integrator="implicit-euler")
    reach = float(numbers(simulator, "self_contact_range")[0])
    stiffness = float(numbers(simulator, "self_contact_stiffness")[0]) * (1.0 if samples == "nodes" else 9.0)
    wanted = load * stiffness * reach * 25.0
    random, state, largest, heights = np.random.default_rng(0), simulator.state, 0.0, []
    for _ in range(places):
        at = np.array([*random.uniform(4.5e-3, 5.5e-3, 2), 0.0])

        def force(height: float, at: np.ndarray = at) -> np.ndarray:
            state.position[225:] = upper.position + at + (0.0, 0.0, height)
            return simulator.forces(state)["self_contact"][0][225:].sum(axis=0)

        low, high = 1.52e-3, 2.5e-3
        while high - low > 1e-8:
            middle = 0.5 * (low + high)
            # nearer than D has no load
            f = force(middle)
            low, high = (middle, high) if not np.isfinite(f).all() or f[2] > wanted else (low, middle)
        f = force(high)
        largest = max(largest, float(np.hypot(f[0], f[1]) / f[2]))
        heights.append(high / lower.spacing)
    return largest, (min(heights), max(heights))


@pytest.mark.parametrize(("load", "of_nodes", "of_middles"), [(1e-3, 0.30, 0.08), (1e-1, 0.12, 0.03)])
def test_layers_slide_more_smoothly(load: float, of_nodes: float, of_middles: float) -> None:
    """Of balls that lock, as crowns of a weave do: at a sheet's own weight, about, and pressed together."""
    nodes, _ = roughness("nodes", load, 6)
    middles, heights = roughness("nodes+mids", load, 6)
    assert nodes < of_nodes and middles < of_middles and middles < 0.5 * nodes
    assert 2.1 < heights[0] < heights[1] < 2.5
