"""The equilibrium: against weights, formulas and dynamics; where there is none; with contact; gradients by one long
step."""

import numpy as np
import pytest
import torch
from cases import quick
from internals import watches_energy

import warp_yarn as wy
import warp_yarn.torch as wt

FABRICS = wy.fabrics.FABRICS


def weight(cloth: wy.Cloth) -> float:
    """Of all segments, by their lengths of yarn [N]."""
    topology = cloth.topology
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material][topology.segment_yarn]
    a, b = topology.segment_nodes.T
    return float((density * np.abs(cloth.euler[b] - cloth.euler[a]).max(axis=1)).sum() * 9.8)


def left(simulator: wy.Simulator) -> np.ndarray:
    """The force on every node that no pin holds, summed from the terms one by one [nodes, 3]."""
    total = sum(force for force, _ in simulator.forces().values())
    if simulator.scene.pin_stiffness is None:
        total[simulator.scene.pins] = 0.0
    return total


@pytest.mark.parametrize("stiffness", [1e4, None], ids=["springs", "exact"])
@pytest.mark.parametrize("fabric", quick(FABRICS, "handkerchief"))
@pytest.mark.parametrize("sliding", [False, True])
def test_a_hung_cloth_comes_to_rest(fabric, stiffness, sliding):
    cloth = FABRICS[fabric](rows=6, columns=6, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=stiffness, sliding=sliding)
    simulator = wy.Simulator(scene)
    found = simulator.relax()
    node = weight(cloth) / cloth.nodes
    assert found.residual <= 1.01e-3 * node
    assert np.abs(left(simulator)).max() <= found.residual * (1.0 + 1e-6)
    # the sum of 36 residuals at most
    np.testing.assert_allclose(found.reactions.sum(axis=0), [0.0, 0.0, weight(cloth)], atol=36 * found.residual)
    state = simulator.state
    assert not state.velocity.any() and not state.euler_velocity.any()
    # it stays: a thousandth of a node's weight moves it by far less in 10 ms than gravity would, 5e-4 m
    simulator.run(10)
    assert np.abs(simulator.state.position - state.position).max() < 2e-6
    # it hangs from its top row
    assert state.position[:, 2].max() < 1e-3


def test_yarns_that_are_pulled_follow_hooke():
    """V = ½ k_s Δs (l/Δs − 1)² of a segment: a pull F makes its length Δs (1 + F/k_s)."""
    cloth = wy.fabrics.cotton(rows=5, columns=4, pose="flat")
    top, bottom = ([cloth.node(row, i) for i in range(4)] for row in (0, -1))
    pull = 0.2
    scene = wy.Scene(
        cloth, gravity=None, sliding=False, pins=top, pin_stiffness=None, terms=["stretch", "applied"],
        forces={node: (0.0, pull, 0.0) for node in bottom},
    )  # fmt: skip
    simulator = wy.Simulator(scene)
    found = simulator.relax(residual=1e-9)
    length = simulator.state.position[bottom, 1] - simulator.state.position[top, 1]
    # 1e-9 N of 0.2 N
    np.testing.assert_allclose(length, 4 * cloth.spacing * (1.0 + pull / 20.0), rtol=1e-8)
    np.testing.assert_allclose(found.reactions, [[0.0, -pull, 0.0]] * 4, atol=1e-8)


@pytest.mark.slow
def test_dynamics_come_to_the_same_place():
    """Implicit Euler's damping, over 3 s."""
    cloth = wy.fabrics.handkerchief(rows=5, columns=5, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("all"), pin_stiffness=None, sliding=False)
    relaxed, ran = (wy.Simulator(scene, integrator="implicit-euler", step=5e-3) for _ in range(2))
    relaxed.relax(residual=1e-12)
    ran.run(600)
    np.testing.assert_allclose(ran.state.position, relaxed.state.position, atol=1e-8)


def test_wind_and_weight_balance():
    cloth = wy.fabrics.handkerchief(rows=5, columns=5)
    scene = wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=None, wind=wy.Wind(velocity=(0.0, 4.0, 0.0)))
    simulator = wy.Simulator(scene)
    found = simulator.relax()
    wind, _ = simulator.forces()["wind"]
    outer = wind.sum(axis=0) - [0.0, 0.0, weight(cloth)]
    np.testing.assert_allclose(found.reactions.sum(axis=0), -outer, atol=25 * found.residual)
    assert wind.sum(axis=0)[1] > 0.1 * weight(cloth)


@pytest.mark.parametrize("pins", [(), (0,)], ids=["free", "pinned"])
def test_what_lies_on_the_ground_is_carried_by_it(pins):
    cloth = wy.fabrics.handkerchief(rows=5, columns=5, pose="flat")
    cloth = cloth.replace(pose=cloth.position + np.array([0.0, 0.0, 2.05 * cloth.radius]))
    plane = wy.Plane(point=(0, 0, 0), normal=(0, 0, 1))
    simulator = wy.Simulator(wy.Scene(cloth, pins=pins, pin_stiffness=None, obstacles=[plane]))
    found = simulator.relax()
    contacts = simulator.contacts()
    assert len(contacts) >= 16
    carried = (contacts.load[:, None] * contacts.normal).sum(axis=0)[2] + found.reactions[:, 2].sum()
    assert carried == pytest.approx(weight(cloth), abs=25 * found.residual)


def test_a_cloth_over_a_ball_is_carried_by_ball_and_pins():
    cloth = wy.fabrics.handkerchief(rows=7, columns=7, pose="flat")
    ball = wy.Sphere(center=cloth.position.mean(axis=0) - [0.0, 0.0, 2.0e-3 + 2.1 * cloth.radius], radius=2e-3)
    scene = wy.Scene(cloth, pins=cloth.corners("all"), pin_stiffness=None, obstacles=[ball])
    path = np.repeat(cloth.position[scene.pins][None], 20, axis=0)
    path[:, :, 2] -= np.linspace(0.0, 5e-4, 20)[:, None]
    simulator = wy.Simulator(scene.replace(pin_path=path))
    simulator.run(20)
    found = simulator.relax()
    contacts = simulator.contacts()
    ball_carries = (contacts.load[:, None] * contacts.normal).sum(axis=0)
    # friction of obstacles goes by speed, and holds nothing at rest
    assert np.abs(contacts.tangential).max() < 1e-12 * weight(cloth)
    assert ball_carries[2] > 0.1 * weight(cloth)
    carried = ball_carries + found.reactions.sum(axis=0)
    np.testing.assert_allclose(carried, [0.0, 0.0, weight(cloth)], atol=49 * found.residual)
    assert simulator.steps_done == 20
    np.testing.assert_allclose(simulator.state.position[scene.pins], path[-1], atol=1e-12)


# -- where there is none -----------------------------------------------------------------------------------------------


def test_what_nothing_holds_has_no_equilibrium():
    cloth = wy.fabrics.handkerchief(rows=4, columns=4)
    simulator = wy.Simulator(wy.Scene(cloth))
    before = simulator.state
    with pytest.raises(wy.InputError, match=r"nothing holds the cloth, no pin and no obstacle, and .* N move it"):
        simulator.relax()
    assert simulator.state == before
    simulator.run(2)


def test_free_modes_without_force_are_none():
    """Nothing holds a cloth in empty space, and nothing moves it: stretched, it goes back to where it is slack."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    simulator = wy.Simulator(wy.Scene(cloth, gravity=None, sliding=False))
    state = simulator.state
    state.position[:] = 1.1 * state.position
    simulator.state = state
    simulator.relax()
    a, b = cloth.topology.segment_nodes.T
    position = simulator.state.position
    length = np.linalg.norm(position[b] - position[a], axis=1)
    # crimp at crossings presses on the yarns: they are bent, and stretched a little by that
    np.testing.assert_allclose(length, cloth.spacing, rtol=1e-2)
    np.testing.assert_allclose(position.mean(axis=0), state.position.mean(axis=0), atol=1e-9)


def test_what_falls_beside_an_obstacle_says_so_and_stays():
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    ball = wy.Sphere(center=(10e-3, 0, -3e-3), radius=2e-3)
    simulator = wy.Simulator(wy.Scene(cloth, obstacles=[ball]))
    before = simulator.run(1)[-1]
    with pytest.raises(wy.SimulationError, match=r"found no equilibrium: .* N are left .* nothing holds it") as caught:
        simulator.relax()
    assert caught.value.trajectory.position[0, :, 2].max() < -1e-2
    assert simulator.state == before
    simulator.run(1)


def test_steps_that_are_too_few_say_how_far_they_came():
    cloth = wy.fabrics.cotton(rows=5, columns=5, pose="flat")
    simulator = wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top")))
    with pytest.raises(wy.SimulationError, match=r"asked for 1e-12 N; after as many steps as it may take \(most\)"):
        simulator.relax(residual=1e-12, most=2)
    for wrong, message in (({"residual": 0.0}, "residual"), ({"most": 0}, "most"), ({"residual": np.nan}, "residual")):
        with pytest.raises(wy.InputError, match=message):
            simulator.relax(**wrong)


def test_moving_obstacles_are_refused():
    path = np.tile([0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    plane = wy.Plane(point=(0, 0, -1.0), normal=(0, 0, 1), path=path)
    simulator = wy.Simulator(wy.Scene(wy.fabrics.handkerchief(rows=4, columns=4), pins=[0], obstacles=[plane]))
    with pytest.raises(wy.InputError, match="an obstacle moves along its path"):
        simulator.relax()


def test_a_run_goes_on_as_if_from_that_state():
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("top"))
    first = wy.Simulator(scene)
    first.run(3)
    first.relax()
    second = wy.Simulator(scene)
    second.state, second.steps_done = first.state, first.steps_done
    assert first.run(5) == second.run(5)
    assert watches_energy(first)


def test_single_precision_ends_where_it_can():
    cloth = wy.paper.cloth(rows=4, columns=4)
    scene = wy.Scene(cloth, pins=cloth.corners("top"), pin_stiffness=None, sliding=False)
    single, double = (wy.Simulator(scene, precision=precision) for precision in ("single", "double"))
    found = single.relax()
    double.relax()
    # yarns of 0.4 N over a millimetre, and positions of 2e-3 m that are rounded by 1e-10 m
    assert found.residual < 5e-3 * weight(cloth) / 16
    np.testing.assert_allclose(single.state.position, double.state.position, atol=1e-7)
    # yarns of 3 N, ten times as light
    cloth = wy.fabrics.handkerchief(rows=4, columns=4)
    simulator = wy.Simulator(wy.Scene(cloth, pins=[0]), precision="single")
    with pytest.raises(wy.InputError, match="residual = None, must be given here: positions in single precision leave"):
        simulator.relax()


# -- gradients ---------------------------------------------------------------------------------------------------------


def test_one_long_step_has_the_gradient_of_the_equilibrium():
    """The implicit function theorem: a step of implicit Euler of 10 s from rest solves for the equilibrium again."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("all"), pin_stiffness=None)
    modulus = cloth.yarns[0].stretch
    direction = np.random.default_rng(0).normal(size=(cloth.nodes, 3))

    def relaxed(stretch: float) -> wy.State:
        yarns = [yarn.replace(stretch=stretch) for yarn in cloth.yarns]
        simulator = wy.Simulator(scene.replace(cloth=cloth.replace(yarns=yarns)), tolerance=1e-12)
        simulator.relax(residual=1e-13)
        return simulator.state

    ends = [relaxed(modulus * factor).position for factor in (1.001, 0.999)]
    wanted = ((ends[0] - ends[1]) * direction).sum() / (0.002 * modulus)
    rollout = wt.Rollout(scene, 1, integrator="implicit-euler", step=10.0, tolerance=1e-12, energy_watch=False)
    stretch = torch.tensor([modulus], dtype=torch.float64, requires_grad=True)
    end = rollout(state=relaxed(modulus), stretch=stretch).position[-1]
    (end * torch.tensor(direction)).sum().backward()
    # differences of ±0.1 % leave 1e-6 of curvature, and what 10 s leave of inertia
    assert stretch.grad.item() == pytest.approx(wanted, rel=1e-4)


# -- contact of cloths, cloths of several numbers, single precision ----------------------------------------------------


def stacked(fabric, precision: str = "double", **options) -> wy.Simulator:
    """Two cloths above the ground, one above the other."""
    cloth = fabric(rows=5, columns=5, pose="flat")
    apart = 1.3 * max(1.5 * cloth.longest_spacing, 3.0 * cloth.half_thickness)
    upper = cloth.replace(pose=cloth.position + np.array([0.0, 0.0, apart]))
    ground = wy.Plane(point=(0, 0, -1.5 * cloth.half_thickness), normal=(0, 0, 1))
    scene = wy.Scene([cloth, upper], obstacles=[ground], self_contact=True, **options)
    return wy.Simulator(scene, precision=precision)


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("fabric", [wy.fabrics.handkerchief, wy.fabrics.glass_7628], ids=["plain", "general"])
def test_cloths_that_lie_on_each_other_come_to_rest(fabric, precision):
    simulator = stacked(fabric, precision, sliding=False)
    cloth = simulator.scene.cloth
    node = weight(cloth) / cloth.nodes
    if precision == "single":
        with pytest.raises(wy.InputError, match=r"residual = None, must be given here: .* precision='double'"):
            simulator.relax()
        if cloth.general:  # rounding of its stiff yarns' stretch is more than it weighs
            return
    found = simulator.relax(residual=None if precision == "double" else 1e-6)
    forces = simulator.forces()
    of_upper = forces["self_contact"][0][25:, 2].sum()
    off = 25.0 * found.residual if precision == "double" else 0.1 * weight(cloth)
    assert of_upper == pytest.approx(0.5 * weight(cloth), abs=off)
    assert forces["obstacles"][0][:, 2].sum() == pytest.approx(weight(cloth), abs=2.0 * off)
    if precision == "double":
        assert found.residual <= 1.01e-3 * node
        before = simulator.state.position
        simulator.run(5)
        assert np.abs(simulator.state.position - before).max() < 2e-6


def test_rounding_is_told_of():
    """In single precision sliding stops short of what is asked for."""
    cloth = wy.paper.cloth(rows=6, columns=6, pose="flat")
    scene = wy.Scene(cloth, pins=cloth.corners("all"), pin_stiffness=None)
    simulator = wy.Simulator(scene, precision="single")
    with pytest.raises(wy.SimulationError, match=r"\(most\); rounding alone may leave .* N"):
        simulator.relax(most=20)


def test_obstacles_that_are_placed_elsewhere_press():
    """A sheet on its corners, and a ball that is set into it: what it presses with is what pins take more."""
    cloth = wy.fabrics.handkerchief(rows=7, columns=7, pose="flat")
    middle = cloth.position.mean(axis=0)
    ball = wy.Sphere(center=middle + np.array([0.0, 0.0, 9e-3]), radius=3e-3, friction=0.0)
    scene = wy.Scene(cloth, pins=cloth.corners("all"), pin_stiffness=None, obstacles=[ball], sliding=False)
    simulator = wy.Simulator(scene)
    simulator.relax()
    presses = []
    for _ in range(3):
        # its barrier begins 2 R above the cloth, which it presses down each time
        above = simulator.state.position[24] + np.array([0.0, 0.0, 3e-3 + 1.3 * cloth.radius])
        simulator.place_obstacles([above])
        found = simulator.relax()
        push = simulator.forces()["obstacles"][0][:, 2].sum()
        assert found.reactions[:, 2].sum() == pytest.approx(weight(cloth) - push, abs=49 * found.residual)
        presses.append(-push)
    assert 0.0 < presses[0] < presses[1] < presses[2]
