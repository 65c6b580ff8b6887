"""Contact of a cloth with itself: its list of what is near, its law, and the system of equations that holds pairs."""

import functools

import numpy as np
import pytest
import torch
from checks import check_definite, error
from internals import launch_one_by_one, near_room, numbers, put, upload
from reference import Tensor, tensor
from touching import GROUND, far_apart, folded, law_of, lifted, paper, posed

import warp_yarn as wy

CLOTH = paper(6, 6)
SMALL = {"self_distance": 3e-4, "self_range": 5e-4}
"""So short that diagonal neighbours may touch: many pairs in a small cloth."""


def crumpled(cloth: wy.Cloth, seed: int, *, least: float, size: float) -> np.ndarray:
    """Random places in a cube, no two nearer than the least."""
    random, found = np.random.default_rng(seed), np.zeros((0, 3))
    while len(found) < cloth.nodes:
        place = random.uniform(0.0, size, 3)
        if not len(found) or np.linalg.norm(found - place, axis=1).min() > least:
            found = np.concatenate([found, place[None]])
    return found


@functools.cache
def simulator_of(friction: float = 0.3, damping_speed: float | None = 0.5) -> wy.Simulator:
    """A cloth that feels itself alone."""
    contact = wy.Contact(friction=friction, damping_speed=damping_speed, slip_speed=0.1, **SMALL)
    scene = wy.Scene(CLOTH, self_contact=True, contact=contact, terms=["self_contact"], sliding=False, gravity=None)
    return wy.Simulator(scene, integrator="implicit-euler")


def crumpled_state(seed: int = 0, *, speed: float = 0.3) -> wy.State:
    position = crumpled(CLOTH, seed, least=3.05e-4, size=2.2e-3)
    velocity = speed * np.random.default_rng(seed + 100).standard_normal(position.shape)
    return posed(CLOTH, position, velocity)


def pairs_of(position: Tensor, simulator: wy.Simulator) -> tuple[np.ndarray, np.ndarray]:
    """All that touch, each pair once."""
    gap = np.linalg.norm(position[:, None] - position[None], axis=2)
    return np.nonzero(np.triu(far_apart(CLOTH, simulator) & (gap < 8e-4), 1))


def expected_forces(state: wy.State, friction: float, damping_speed: float | None):
    """Of positions and velocities."""
    simulator = simulator_of(friction, damping_speed)
    law = law_of(simulator, friction, "self_contact")
    p, q = (torch.as_tensor(k) for k in pairs_of(state.position, simulator))

    def force(x: Tensor, v: Tensor) -> Tensor:
        r = x[p] - x[q]
        gap = torch.linalg.vector_norm(r, dim=1)
        on_p = law.force(gap, r / gap[:, None], v[p] - v[q])
        return torch.zeros_like(x).index_add(0, p, on_p).index_add(0, q, -on_p)

    return force


@pytest.mark.parametrize("seed", range(3))
def test_energy_and_force(seed: int) -> None:
    state, simulator = crumpled_state(seed), simulator_of()
    law = law_of(simulator, 0.3, "self_contact")
    p, q = pairs_of(state.position, simulator)
    assert len(p) > 20
    x = tensor(state.position).requires_grad_()
    energy = law.energy(torch.linalg.vector_norm(x[p] - x[q], dim=1)).sum()
    (slope,) = torch.autograd.grad(energy, x)
    # of sums of some tens of pairs, the nearest a hundredth of the range apart
    assert simulator.energy(state)["contact"] == pytest.approx(energy.item(), rel=1e-12)
    assert error(simulator.forces(posed(CLOTH, state.position))["self_contact"][0], -slope.numpy()) < 1e-12
    for friction, damping_speed in ((0.3, 0.5), (0.0, 0.5), (0.6, None)):
        expected = expected_forces(state, friction, damping_speed)(tensor(state.position), tensor(state.velocity))
        found = simulator_of(friction, damping_speed).forces(state)["self_contact"][0]
        assert error(found, expected.numpy()) < 1e-12
        # each pair is the same from both sides: only sums round
        assert np.abs(found.sum(axis=0)).max() < 1e-15 * np.abs(found).sum()


@pytest.mark.parametrize(("friction", "damping_speed"), [(0.0, 0.5), (0.6, None)])
def test_damping_matrix(friction: float, damping_speed: float | None) -> None:
    """−∂F/∂v, blocks of pairs and all, as ``system`` has it."""
    state, n = crumpled_state(), 3 * CLOTH.nodes
    force = expected_forces(state, friction, damping_speed)
    exact = -torch.autograd.functional.jacobian(
        lambda v: force(tensor(state.position), v), tensor(state.velocity)
    ).reshape(n, n)
    found = simulator_of(friction, damping_speed).system(state, weights=(0.0, 1.0, 0.0)).dense()
    assert error(found, exact.numpy()) < 1e-9
    check_definite(found)


def test_stiffness_matrix() -> None:
    """n nᵀ of −∂F/∂x along the line of each pair; the curvature of distances, which is negative, is left out."""
    state, simulator = posed(CLOTH, crumpled_state().position), simulator_of(0.0)
    law, x = law_of(simulator, 0.0, "self_contact"), state.position
    exact = np.zeros((CLOTH.nodes, 3, CLOTH.nodes, 3))
    for p, q in zip(*pairs_of(x, simulator), strict=True):
        gap = torch.tensor(np.linalg.norm(x[p] - x[q]), dtype=torch.float64)
        second = torch.func.grad(torch.func.grad(law.energy))(gap).item()
        n = (x[p] - x[q]) / gap.item()
        for i, j, sign in ((p, p, 1.0), (q, q, 1.0), (p, q, -1.0), (q, p, -1.0)):
            exact[i, :, j] += sign * second * np.outer(n, n)
    found = simulator.system(state, weights=(0.0, 0.0, 1.0)).dense()
    assert error(found, exact.reshape(found.shape)) < 1e-9
    check_definite(simulator.system(crumpled_state(), weights=(0.0, 1.0, 1.0)).dense())


# -- the list ----------------------------------------------------------------------------------------------------------


def listed(simulator: wy.Simulator) -> set[tuple[int, int]]:
    """Every entry of the list."""
    room, count = near_room(simulator), numbers(simulator, "near_count")
    near = numbers(simulator, "near").reshape(-1, room)
    return {(p, int(q)) for p in range(len(count)) for q in near[p, : count[p]]}


@pytest.mark.parametrize("seed", range(20))
def test_list_is_brute_force(seed: int) -> None:
    """That of a new state, and what touches in states up to half of the margin from where the list was made."""
    simulator, random = simulator_of(), np.random.default_rng(seed)
    position = crumpled(CLOTH, seed, least=3.05e-4, size=(2e-3, 3e-3, 8e-3)[seed % 3]) + random.uniform(-1.0, 1.0, 3)
    upload(simulator, posed(CLOTH, position))
    put(simulator, "near_position", np.nan)
    simulator.contacts()
    gap = np.linalg.norm(position[:, None] - position[None], axis=2)
    margin, apart = numbers(simulator, "near_margin")[0], far_apart(CLOTH, simulator)
    assert listed(simulator) == set(zip(*map(list, np.nonzero(apart & (gap < 8e-4 + margin))), strict=True))
    made_at = numbers(simulator, "near_position")
    for _ in range(5):
        moved = position + 0.14 * margin * random.uniform(-1.0, 1.0, position.shape) + random.uniform(-1.0, 1.0, 3)
        upload(simulator, posed(CLOTH, moved))
        found = simulator.contacts()
        # the cloth flies elsewhere, and its list stays
        assert np.array_equal(numbers(simulator, "near_position"), made_at)
        gap = np.linalg.norm(moved[:, None] - moved[None], axis=2)
        # those nearer than D have no force to be reported
        expected = np.nonzero(np.triu(apart & (gap > 3e-4) & (gap < 8e-4), 1))
        assert sorted(zip(found.node, found.other, strict=True)) == sorted(zip(*expected, strict=True))


def falling_fold(seed: int = 1, **options) -> wy.Simulator:
    """A folded strip that falls onto a plane and onto itself."""
    scene = wy.Scene(folded(seed=seed), obstacles=[GROUND], self_contact=True, sliding=options.pop("sliding", True))
    return wy.Simulator(scene, **{"integrator": "implicit-euler", **options})


@pytest.mark.parametrize(("speed", "away"), [(2.0, 5e-5), (0.3, 1e-4)])
def test_what_was_before_does_not_matter(speed: float, away: float) -> None:
    """A list that was made elsewhere leaves the same bits as a new one, whatever way nodes go from there."""
    simulator = falling_fold()
    simulator.run(20)
    state, results = simulator.state, []
    assert (simulator.contacts().other >= 0).any()
    state.velocity[:] += speed * np.cos(np.arange(len(state.velocity)) / 9.0)[:, None] * (0.0, 1.0, 0.3)
    for seed in (None, 1, 2):
        other = falling_fold()
        if seed is not None:
            random = np.random.default_rng(seed)
            moved = state.position + away * random.uniform(-1.0, 1.0, state.position.shape)
            upload(other, posed(other.scene.cloth, moved))
            other.contacts()
        other.state = state
        results.append(other.run(6).position)
    assert np.array_equal(results[0], results[1]) and np.array_equal(results[0], results[2])


def test_the_same_twice_and_after_more_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for one node near each is not enough: it grows, and the bits are those of enough room from the start."""
    first, again = falling_fold().run(40), falling_fold()
    assert first.position.tobytes() == again.run(40).position.tobytes()
    monkeypatch.setattr("warp_yarn.device.contact.NEAR_ROOM", 1)
    small = falling_fold()
    assert small.run(40).position.tobytes() == first.position.tobytes()
    assert near_room(small) > 1 and not small.split_steps
    assert small.contacts().node.tolist() == again.contacts().node.tolist()


def test_captured_is_eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Launched one by one, with loops of Python, steps come out the same to the last bit."""
    captured = falling_fold().run(30)
    launch_one_by_one(monkeypatch)
    assert falling_fold().run(30).position.tobytes() == captured.position.tobytes()


# -- the system of equations -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "locked"])
@pytest.mark.parametrize(
    ("preconditioner", "threads"),
    [("incomplete", 1), ("multilevel", 1), pytest.param("incomplete", 2, marks=pytest.mark.slow)],
)
def test_solution_is_that_of_the_dense_system(preconditioner: str, threads: int, sliding: bool) -> None:
    cloth = folded(8, 17)
    scene = wy.Scene(cloth, obstacles=[GROUND], self_contact=True, sliding=sliding)
    options = {"preconditioner": preconditioner, "integrator": "implicit-euler"}
    simulator = wy.Simulator(scene, **options)
    simulator.run(25)
    assert (simulator.contacts().other >= 0).sum() >= 8
    state = simulator.state
    with np.errstate(all="ignore"):
        simulator = wy.Simulator(scene, **options, threads=threads)
    simulator.state = state
    system = simulator.system()
    dense, free = system.dense(), system.free
    check_definite(dense)
    unpaired = dense.copy()
    far = np.kron(far_apart(cloth, simulator), np.ones((3, 3)))[: 3 * cloth.nodes, : 3 * cloth.nodes] > 0
    unpaired[: 3 * cloth.nodes, : 3 * cloth.nodes][far] = 0.0
    assert not np.array_equal(unpaired, dense)
    model, a = simulator.model, simulator.arrays
    model.factorize()
    random = np.random.default_rng(0)
    b, n = random.standard_normal(len(dense)) * free, 3 * cloth.nodes
    expected = np.zeros_like(b)
    expected[free] = np.linalg.solve(dense[np.ix_(free, free)], b[free])
    for start in (0.0, 1.0):
        a["rhs"].assign(b[:n].reshape(-1, 3))
        a["solution"].assign(start * random.standard_normal((cloth.nodes, 3)))
        if sliding:
            a["euler_rhs"].assign(b[n:])
            a["euler_solution"].assign(0.0 * b[n:])
        a.put("tolerance", 1e-11)
        with model.threads.at_hand() if threads > 1 else np.errstate():
            model.solve()
        found = numbers(simulator, "solution").ravel()
        if sliding:
            found = np.concatenate([found, numbers(simulator, "euler_solution")])
        # the tolerance, by the root of the condition number, 1e4
        assert np.linalg.norm((found - expected)[free]) < 1e-7 * np.linalg.norm(expected)


# -- momentum ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_momentum_is_kept(friction: float) -> None:
    """By two sheets that fly at each other, askew: linear momentum always, and where there is no friction (of balls'
    centres, beside which it has a lever) all torques of a stage cancel too. Yarns are locked, so that masses stay."""
    cloths = [lifted(paper(5, 5), 0.0, 5e-5, 1), lifted(paper(4, 4), 2.6e-3, 5e-5, 2)]
    scene = wy.Scene(cloths, gravity=None, self_contact=True, sliding=False, contact=wy.Contact(friction=friction))
    simulator = wy.Simulator(scene, integrator="implicit-euler", newton_tolerance=1e-12, tolerance=1e-12)
    state = simulator.state
    state.velocity[:25] += (0.05, 0.1, 0.4)
    state.velocity[25:] += (-0.1, 0.0, -0.5)
    simulator.state = state
    mass, touched = simulator.system(weights=(1.0, 0.0, 0.0)).dense(), 0
    p = (mass @ state.velocity.ravel()).reshape(-1, 3)
    for _ in range(12):
        simulator.run(1)
        touched += (simulator.contacts().other >= 0).any()
        state, before = simulator.state, p
        p = (mass @ state.velocity.ravel()).reshape(-1, 3)
        arm = state.position - state.position.mean(axis=0)
        assert np.abs((p - before).sum(axis=0)).max() < 1e-9 * np.abs(p).sum()
        if not friction:
            turned = np.cross(arm, p - before)
            assert np.abs(turned.sum(axis=0)).max() < 1e-9 * np.abs(np.cross(arm, p)).sum()
    assert touched >= 3


def test_forces_have_no_torque_without_friction() -> None:
    state = crumpled_state()
    force = simulator_of(0.0).forces(state)["self_contact"][0]
    torques = np.cross(state.position, force)
    assert np.abs(torques.sum(axis=0)).max() < 1e-14 * np.abs(torques).sum()
