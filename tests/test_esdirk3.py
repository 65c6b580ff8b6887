"""The method with an explicit stage: its coefficients, what it is for, and the slope that it keeps beside the state."""

import copy

import numpy as np
import pytest
import torch

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn.integrators.esdirk3 import GAMMA, MIDDLE, tableau

EXACT = {"tolerance": 1e-12, "newton_tolerance": 1e-9}


def butcher() -> tuple[np.ndarray, np.ndarray]:
    a_10, a_20, a_21, b_0, b_1, b_2 = tableau()
    a = np.array([[0, 0, 0, 0], [a_10, GAMMA, 0, 0], [a_20, a_21, GAMMA, 0], [b_0, b_1, b_2, GAMMA]])
    return a, a.sum(axis=1)


def test_its_coefficients_are_of_order_3_with_stages_of_order_2():
    a, c = butcher()
    b = a[-1]
    assert c == pytest.approx([0.0, 2.0 * GAMMA, MIDDLE, 1.0], abs=1e-14)
    assert a @ c == pytest.approx(c**2 / 2.0, abs=1e-14)
    conditions = (b.sum(), b @ c, b @ c**2, b @ a @ c)
    assert conditions == pytest.approx((1.0, 1.0 / 2.0, 1.0 / 3.0, 1.0 / 6.0), abs=1e-14)


def test_it_is_l_stable():
    a, _ = butcher()
    z = 1j * np.logspace(-4, 8, 400)
    rates = [np.linalg.solve(np.eye(4) - x * a, np.ones(4))[-1] for x in z]
    # of a stiffly accurate method the last stage is the step; rounding
    assert np.abs(rates).max() < 1.0 + 1e-12
    # as 1/z at most
    assert abs(rates[-1]) < 10.0 / abs(z[-1])


def thrown(**options) -> wy.Simulator:
    """A handkerchief that tumbles, whose stretching no step resolves."""
    cloth = wy.fabrics.handkerchief(rows=7, columns=7, pose="flat")
    simulator = wy.Simulator(wy.Scene(cloth), **options)
    state = simulator.state
    state.velocity[:] = np.cross((30.0, -10.0, 20.0), state.position - state.position.mean(axis=0))
    simulator.state = state
    return simulator


def test_a_tumbling_handkerchief_takes_a_tenth_of_the_error_of_sdirk2():
    fine = thrown(step=6.25e-5, integrator="esdirk3", newton_tolerance=1e-9).run(640).position[-1]
    errors = {}
    for method in ("sdirk2", "esdirk3"):
        errors[method] = np.abs(thrown(step=4e-3, integrator=method).run(10).position[-1] - fine).max()
    assert errors["esdirk3"] < 0.1 * errors["sdirk2"]


def hung(**options) -> wy.Simulator:
    cloth = wy.fabrics.handkerchief(rows=5, columns=6)
    scene = wy.Scene(cloth, pins=cloth.corners("top"), wind=wy.Wind(velocity=(0.0, 3.0, 0.0)), sliding=True)
    return wy.Simulator(scene, integrator="esdirk3", **options)


def test_runs_that_go_on_are_one_to_the_last_bit(tmp_path):
    """By the simulator itself, a copy of it, chunks, and a recording."""
    whole = hung().run(9)
    parts = hung(chunk=4)
    first = parts.run(5)
    again = copy.deepcopy(parts)
    first.save(tmp_path / "first.npz")
    resumed = wy.Simulator.resumed(wy.Trajectory.load(tmp_path / "first.npz"))
    for simulator in (parts, again, resumed):
        np.testing.assert_array_equal(simulator.run(4).position[-1], whole.position[-1])


def test_a_state_that_is_set_begins_with_a_slope_of_its_own():
    """No state tells the slope: a run that goes on from one differs, by what a first step is off."""
    simulator = hung()
    simulator.run(5)
    parts, state = simulator.state, simulator.state
    ahead = simulator.run(4).position[-1]
    simulator.state = state
    again = simulator.run(4).position[-1]
    moved = np.abs(ahead - parts.position).max()
    assert 0.0 < np.abs(ahead - again).max() < 0.02 * moved
    # and it is the same each time, whatever was made before
    simulator.state = state
    np.testing.assert_array_equal(simulator.run(4).position[-1], again)


def test_looking_at_another_state_leaves_the_slope():
    simulator, other = hung(), hung()
    simulator.run(3)
    other.run(3)
    simulator.forces(hung().state)
    np.testing.assert_array_equal(simulator.run(3).position, other.run(3).position)


def test_a_relaxation_that_fails_leaves_the_slope():
    simulator, other = hung(), hung()
    simulator.run(3)
    other.run(3)
    with pytest.raises(wy.SimulationError):
        simulator.relax(most=1)
    np.testing.assert_array_equal(simulator.run(3).position, other.run(3).position)


def test_energy_that_is_gained_slowly_is_seen():
    """A handkerchief that spins by 0.3 a step gains 0.05 % in each, less than lies in its pressed crossings, which the
    watch adds up every 16th step alone."""
    simulator = thrown(step=8e-3, integrator="esdirk3")
    assert simulator.scene.gravity is not None
    simulator = wy.Simulator(simulator.scene.replace(gravity=None), step=8e-3, integrator="esdirk3")
    simulator.state = thrown().state
    start = sum(simulator.energy().values())
    simulator.run(120)
    # a step may gain 1 %, and 16 pass until the next audit
    assert sum(simulator.energy().values()) < 1.02 * start
    assert simulator.damped_steps


@pytest.mark.parametrize("fabric", ["paper", "handkerchief", "cotton"])
def test_pins_that_begin_to_move_raise_no_alarm(fabric):
    """The work of the explicit stage in a first step is that of the two stages that found its slope."""
    cloth = wy.presets.fabrics.FABRICS[fabric](rows=5, columns=5)
    pins, times = cloth.corners("top"), 1e-3 * np.arange(1, 4)
    way = 0.002 * (1.0 - np.cos(100.0 * np.pi * times))[:, None, None] * np.array([0.0, 1.0, 0.3])
    scene = wy.Scene(cloth, pins=pins, pin_stiffness=1e3, pin_path=cloth.position[pins] + way)
    simulator = wy.Simulator(scene, integrator="esdirk3")
    simulator.run(3)
    assert not simulator.damped_steps


def test_what_it_cannot_do_says_so():
    simulator = hung()
    simulator.run(2)
    with pytest.raises(wy.InputError, match="integrator = 'esdirk3', whose stages are not known from frames"):
        simulator.reactions()
    cloth = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    with pytest.raises(wy.InputError, match="integrator = 'esdirk3' with contact"):
        wy.Simulator(wy.Scene(cloth, obstacles=[wy.Plane(point=(0, 0, -1), normal=(0, 0, 1))]), integrator="esdirk3")
    with pytest.raises(wy.InputError, match="step_error"):
        wy.Simulator(wy.Scene(cloth), integrator="esdirk3", step_error=1e-3)


@pytest.mark.parametrize("every", [1, 2])
def test_its_gradient_does_not_depend_on_what_is_kept(every):
    cloth = wy.fabrics.handkerchief(rows=4, columns=4)
    scene = wy.Scene(cloth, pins=cloth.corners("top"))
    gradients = []
    for kept in (1, every):
        rollout = wt.Rollout(scene, 5, integrator="esdirk3", checkpoint_every=kept, **EXACT)
        stretch = torch.tensor([cloth.yarns[0].stretch], dtype=torch.float64, requires_grad=True)
        (rollout(stretch=stretch).position / 1e-3).square().sum().backward()
        gradients.append(float(stretch.grad))
    assert gradients[0] == pytest.approx(gradients[1], rel=1e-9) and gradients[0] != 0.0
