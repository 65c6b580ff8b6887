"""The law of contact and the distances to obstacles, against ``touching``."""

import functools

import numpy as np
import pytest
import torch
from checks import check_definite, error
from internals import near_faces, near_obstacles, upload
from reference import tensor
from touching import SHAPES, TURNED, gradient, law_of, paper, parts_of, places_near, posed, shapes

import warp_yarn as wy

CLOTH = paper(5, 5)
UP = TURNED.apply((0.0, 0.0, 1.0))
"""The plane's normal."""
TERMS = {shape: ["obstacles", "meshes"] if shape == "mesh" else ["obstacles"] for shape in SHAPES}
ROUNDING = 1e-11
"""Of forces by logarithms of gaps as small as a hundredth of their range, of places 1e-2 m away: 1e-16 · 1e-2/1e-5 · a
few."""


@functools.cache
def scene_on(shape: str, friction: float = 0.3, damping_speed: float | None = 0.5) -> wy.Simulator:
    """A cloth whose nodes feel nothing but one obstacle."""
    contact = wy.Contact(damping_speed=damping_speed, slip_speed=0.1)
    obstacle = shapes(friction)[shape][0]
    far = CLOTH.replace(pose=CLOTH.position + UP)
    scene = wy.Scene(far, obstacles=[obstacle], contact=contact, terms=TERMS[shape], sliding=False, gravity=None)
    return wy.Simulator(scene, integrator="implicit-euler")


def force_of(simulator: wy.Simulator, state: wy.State) -> np.ndarray:
    """Of the obstacle, on every node."""
    forces = simulator.forces(state)
    return forces["obstacles"][0] + forces.get("meshes", (0.0,))[0]


def touching_state(shape: str, *, speed: float = 0.3) -> wy.State:
    distance = shapes()[shape][1]
    law = law_of(scene_on(shape), 0.3)
    places = places_near(distance, CLOTH.nodes, law.distance + 0.02 * law.range, law.distance + 1.3 * law.range)
    velocity = speed * np.random.default_rng(1).standard_normal(places.shape)
    # some stick and some slide
    velocity[::2] *= 0.2
    return posed(CLOTH, places, velocity)


def expected_force(shape: str, state: wy.State, friction: float, damping_speed: float | None):
    """As a function of velocities."""
    parts = [gradient(distance, state.position) for distance in parts_of(shape)]
    law = law_of(scene_on(shape, friction, damping_speed), friction)
    return lambda v: sum(law.force(gap, n, v) for gap, n in parts)


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape != "mesh"])
def test_distance_and_normal(shape: str) -> None:
    """Those of places near and far, inside what touches and beyond: ``report_contacts`` looks at all."""
    simulator, distance = scene_on(shape), shapes()[shape][1]
    for low, high in ((1e-5, 5e-4), (5e-4, 1e-3), (1e-3, 8e-3)):
        places = places_near(distance, CLOTH.nodes, low, high)
        gap, n = gradient(distance, places)
        simulator.forces(posed(CLOTH, places))
        upload(simulator, posed(CLOTH, places))
        near = near_obstacles(simulator)
        # of places 1e-2 m away; an edge's normal is over the gap
        assert np.abs(near.gap - gap.numpy()).max() < 1e-16
        assert np.abs(near.normal - n.numpy()).max() < 1e-16 / low * 10.0
        assert np.abs(np.linalg.norm(near.normal, axis=1) - 1.0).max() < 1e-14
        # the gradient, by differences, but where an edge of faces is so near that they see it
        h = 1e-9
        for k in range(3):
            step = np.eye(3)[k] * h
            ends = [distance(tensor(places + f * step)).numpy() for f in (-2.0, -1.0, 1.0, 2.0)]
            slope = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * h)
            smooth = np.abs(ends[3] - 2.0 * gap.numpy() + ends[0]) < 1e-4 * h
            assert smooth.sum() >= 20
            assert np.abs(slope - near.normal[:, k])[smooth].max() < 1e-4


def test_faces_that_are_near() -> None:
    """All of a mesh that may push, with their distances and normals, and no other."""
    simulator = scene_on("mesh")
    law = law_of(simulator, 0.3)
    places = places_near(shapes()["mesh"][1], CLOTH.nodes, 1e-5, 1.5e-3)
    upload(simulator, posed(CLOTH, places))
    near = near_faces(simulator)
    parts = [gradient(distance, places) for distance in parts_of("mesh")]
    gap, n = np.array([gap.numpy() for gap, _ in parts]).T, np.array([n.numpy() for _, n in parts]).swapaxes(0, 1)
    touch = law.distance + law.range
    assert np.array_equal(np.bincount(near.sample, minlength=CLOTH.nodes), (gap < touch).sum(axis=1))
    for node in range(CLOTH.nodes):
        mine, its = near.sample == node, gap[node] < touch
        order, other = np.argsort(near.gap[mine]), np.argsort(gap[node, its])
        assert np.abs(near.gap[mine][order] - gap[node, its][other]).max(initial=0.0) < 1e-16
        # faces that meet in an edge are as near as each other, and from there in the same direction
        assert np.abs(near.normal[mine][order] - n[node, its][other]).max(initial=0.0) < 1e-10


@pytest.mark.parametrize("shape", SHAPES)
def test_energy_and_force(shape: str) -> None:
    """The energy, the force of what rests, which is minus its gradient, and that of what moves."""
    state, simulator = touching_state(shape), scene_on(shape)
    law, x = law_of(scene_on(shape), 0.3), tensor(state.position).requires_grad_()
    energy = sum(law.energy(distance(x)).sum() for distance in parts_of(shape))
    (slope,) = torch.autograd.grad(energy, x)
    assert simulator.energy(state)["contact"] == pytest.approx(energy.item(), rel=ROUNDING)
    at_rest = force_of(simulator, posed(CLOTH, state.position))
    assert error(at_rest, -slope.numpy()) < ROUNDING
    assert (np.abs(slope.numpy()).max(axis=1) > 0.0).sum() > 10
    for friction, damping_speed in ((0.3, 0.5), (0.0, 0.5), (0.6, None)):
        expected = expected_force(shape, state, friction, damping_speed)(tensor(state.velocity))
        moving = force_of(scene_on(shape, friction, damping_speed), state)
        assert error(moving, expected.numpy()) < ROUNDING


@pytest.mark.parametrize(("friction", "damping_speed"), [(0.0, 0.5), (0.6, None), (0.6, 0.5)])
def test_damping_matrix(friction: float, damping_speed: float | None) -> None:
    """−∂F/∂v where no part is left out: without friction, or without damping. With both, what is left out is how
    friction depends on the load."""
    state = touching_state("box")
    force = expected_force("box", state, friction, damping_speed)
    v = tensor(state.velocity)
    exact = -torch.autograd.functional.jacobian(lambda v: force(v).sum(dim=0), v).permute(1, 0, 2).numpy()
    simulator = scene_on("box", friction, damping_speed)
    found = simulator.system(state, weights=(0.0, 1.0, 0.0)).dense()
    check_definite(found)
    blocks = found.reshape(CLOTH.nodes, 3, CLOTH.nodes, 3)
    assert np.abs(blocks[~np.eye(CLOTH.nodes, dtype=bool)[:, None, :, None].repeat(3, 1).repeat(3, 3)]).max() == 0.0
    diagonal = np.stack([blocks[i, :, i] for i in range(CLOTH.nodes)])
    if friction and damping_speed:
        _, n = gradient(shapes()["box"][1], state.position)
        across = np.eye(3) - n.numpy()[:, :, None] * n.numpy()[:, None, :]
        along = np.einsum("ni,nij,nj->n", n, exact, n)
        exact = np.einsum("nij,njk,nkl->nil", across, exact, across) + along[:, None, None] * (np.eye(3) - across)
    assert error(diagonal, exact) < 1e-9


def test_stiffness_matrix() -> None:
    """−∂F/∂x of a plane, which has no curvature, damping's part included; of others it leaves a negative part out."""
    state = touching_state("plane")
    state.velocity[:] *= np.linalg.norm(state.velocity, axis=1, keepdims=True) > 0.3
    distance, simulator = shapes()["plane"][1], scene_on("plane", 0.0)
    law, v = law_of(simulator, 0.0), tensor(state.velocity)

    def force(x: torch.Tensor) -> torch.Tensor:
        n = torch.autograd.grad(distance(x).sum(), x, create_graph=True)[0]
        return law.force(distance(x), n, v).sum(dim=0)

    x = tensor(state.position).requires_grad_()
    exact = -torch.autograd.functional.jacobian(force, x).permute(1, 0, 2).numpy()
    found = simulator.system(state, weights=(0.0, 0.0, 1.0)).dense()
    check_definite(found)
    blocks = found.reshape(CLOTH.nodes, 3, CLOTH.nodes, 3)
    assert error(np.stack([blocks[i, :, i] for i in range(CLOTH.nodes)]), exact) < 1e-9


@pytest.mark.parametrize("shape", SHAPES)
def test_matrix_is_definite(shape: str) -> None:
    check_definite(scene_on(shape).system(touching_state(shape), weights=(0.0, 1e-3, 1e-6)).dense())


def test_the_barrier_ends_smoothly() -> None:
    """Energy, force and stiffness fall as the third, second and first power of what is left to the end of the range."""
    simulator = scene_on("plane", 0.0)
    obstacle, law = shapes()["plane"][0], law_of(scene_on("plane"), 0.0)
    values = []
    for left in (1e-2, 1e-3):
        places = obstacle.position + (law.distance + (1.0 - left) * law.range) * UP
        state = posed(CLOTH, np.tile(places, (CLOTH.nodes, 1)))
        force = np.linalg.norm(simulator.forces(state)["obstacles"][0][0])
        stiffness = np.linalg.norm(simulator.system(state, weights=(0.0, 0.0, 1.0)).dense()[:3, :3])
        values.append((simulator.energy(state)["contact"], force, stiffness))
    # the next power is as much smaller as what is left
    assert np.log10(np.divide(*values)) == pytest.approx([3.0, 2.0, 1.0], abs=0.01)
    beyond = obstacle.position + (law.distance + 1.0001 * law.range) * UP
    assert simulator.energy(posed(CLOTH, np.tile(beyond, (CLOTH.nodes, 1))))["contact"] == 0.0


def test_damping_never_pulls() -> None:
    """What flies off is not held, and what comes is slowed down more than what rests."""
    simulator, obstacle = scene_on("plane", 0.0), shapes()["plane"][0]
    places = np.tile(obstacle.position + 7e-4 * UP, (CLOTH.nodes, 1))
    speeds = np.linspace(-20.0, 20.0, CLOTH.nodes)
    force = simulator.forces(posed(CLOTH, places, speeds[:, None] * UP))["obstacles"][0]
    load = force @ UP
    assert load.min() > 0.0 and (np.diff(load) < 0.0).all()
