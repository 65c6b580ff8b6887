"""Contact of warp and weft at a crossing."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from cases import BENT, YARNS, Case, cases, simulator
from checks import error, natural

import warp_yarn as wy

PRESSING = ("stretch", "bending", "shear")
TOLERANCE = 1e-12
"""Rounding: the normal's errors are 1e-16 over the relative gap of the two small eigenvalues, some 1e-2 where rough."""


def rotated(state: wy.State, matrix: np.ndarray, shift: float = 0.0) -> wy.State:
    return dataclasses.replace(state, position=state.position @ matrix.T + shift)


class TestContact:
    cases = cases()

    def test_normal_and_force(self, case: Case) -> None:
        """The oracle's: an eigenvector by another algorithm, forces by automatic differentiation."""
        normal, force = case.simulator(*PRESSING).contact(case.state)
        expected_normal, expected_force = case.oracle(*PRESSING).contact(case.q)
        assert error(normal, expected_normal) < TOLERANCE
        assert error(force, expected_force, natural(case.cloth, "stretch")) < TOLERANCE
        assert error(np.linalg.norm(normal, axis=1), case.cloth.topology.is_crossing) < 1e-15

    def test_some_crossings_press_and_some_do_not(self, case: Case) -> None:
        """Both sides of the ReLU, or the cases above would test little."""
        if case.state_name in BENT:
            _, force = case.simulator(*PRESSING).contact(case.state)
            assert 0 < np.count_nonzero(force) < np.count_nonzero(case.cloth.topology.is_crossing)

    def test_turns_with_the_cloth(self, case: Case) -> None:
        sim = case.simulator(*PRESSING)
        turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
        turn *= np.linalg.det(turn)
        normal, force = sim.contact(case.state)
        turned_normal, turned_force = sim.contact(rotated(case.state, turn))
        assert error(turned_normal, normal @ turn.T) < TOLERANCE
        assert error(turned_force, force, natural(case.cloth, "stretch")) < TOLERANCE

    def test_far_from_the_origin(self, case: Case) -> None:
        """10 m away positions have 1e-15 m left, 1e-12 of the spacing and 1e-10 of what the normal is made of."""
        normal, _ = case.simulator(*PRESSING).contact(case.state)
        away, _ = case.simulator(*PRESSING).contact(rotated(case.state, np.eye(3), shift=10.0))
        assert error(away, normal) < 1e-9


@pytest.mark.parametrize("name", ["plain", "twill", "satin"])
def test_normal_at_rest(name: str) -> None:
    """Along right × down, reversed where flipped: the two larger eigenvalues are equal here."""
    case = Case(name, "rest", True)
    c = case.cloth
    x = c.position.reshape(c.weave.rows, c.weave.columns, 3)
    up = np.cross(x[0, 1] - x[0, 0], x[1, 0] - x[0, 0]) / c.spacing**2
    sign = np.where(c.weave.flipped, -1.0, 1.0).ravel() * (c.topology.is_crossing != 0)
    normal, _ = case.simulator(*PRESSING).contact(case.state)
    assert error(normal, sign[:, None] * up) < 1e-15


def test_nodes_at_one_place_have_no_normal() -> None:
    sim = simulator("plain", PRESSING)
    normal, _ = sim.contact(dataclasses.replace(sim.state, position=np.ones((25, 3))))
    assert not normal.any()


def test_nodes_on_one_line_leave_everything_finite() -> None:
    """Every plane through the line fits, so there is either no normal or any one."""
    cloth = wy.Cloth(wy.Weave.plain(rows=4, columns=4), yarns=YARNS[:2], pose="flat")
    sim = wy.Simulator(wy.Scene(cloth))
    along = np.array([2.0, -1.0, 2.0]) / 3.0
    state = dataclasses.replace(sim.state, position=cloth.spacing * np.arange(16)[:, None] * along)
    normal, force = sim.contact(state)
    assert np.isfinite(force).all()
    length = np.linalg.norm(normal, axis=1)
    assert np.all((length == 0.0) | (np.abs(length - 1.0) < 1e-15))
    assert all(np.isfinite(part).all() for both in sim.forces(state).values() for part in both)
    assert np.isfinite(sim.system(state).dense()).all()


@pytest.mark.parametrize("state_name", ["rest", "random"])
@pytest.mark.parametrize("name", ["plain", "twill", "satin"])
def test_adjoint_of_the_normal(name: str, state_name: str) -> None:
    """Written by hand in the kernel; held to differences of the normal along a random direction."""
    case = Case(name, state_name, True)
    n, vec3 = case.cloth.nodes, wp.types.vector(3, wp.float64)
    sim = wy.Simulator(case.simulator(*PRESSING).scene, differentiable=True)
    position = wp.array(case.state.position, dtype=vec3, requires_grad=True)
    normal = wp.zeros(n, dtype=vec3, requires_grad=True)
    seed = np.random.default_rng(3).normal(size=(n, 3))
    with wp.Tape() as tape:
        sim.model.launch("contact_normal", "crossings", position=position, normal=normal)
    tape.backward(grads={normal: wp.array(seed, dtype=vec3)})
    gradient = position.grad.numpy()

    for direction in case.directions(3, "x"):
        h = 1e-7
        moved = [sim.contact(case.moved(direction, step * h))[0] for step in (1.0, -1.0, 2.0, -2.0)]
        slope = np.sum(seed * (8.0 * (moved[0] - moved[1]) - (moved[2] - moved[3]))) / (12.0 * h)
        expected = np.sum(gradient.ravel() * direction[: 3 * n])
        assert abs(slope - expected) < 1e-9 * np.sum(np.abs(gradient.ravel() * direction[: 3 * n]))
