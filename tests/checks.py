"""What every term is held to: its force, its energy, its Jacobian and its matrix, at every case of a class of tests."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch
from cases import WIND, Case, cases, joined
from reference import Oracle, Tensor, tensor

import warp_yarn as wy

ROUNDING = 1e-13
"""Of a sum of some tens of products in double precision, near a fold over the sine of 3 degrees."""
DIFFERENCES = 1e-9
"""Of fourth-order differences over 1e-4 spacings: (1e-4)⁴ for the order, times up to (1/0.06)⁴ where a yarn is folded
to within 0.06 of flat, and 1e-16/1e-4 for rounding."""
STEP = 1e-7
"""Of those differences [m]."""

SPEED = 1.0
"""Of the moving states [m/s], in magnitude."""


def natural(c: wy.Cloth, term: str) -> float:
    """A term's force at a displacement of one spacing [N]: what its rounding errors are relative to.

    A state may have no force of a term at all, or the small difference of large ones.
    """
    area, length = np.pi * c.halves.prod(axis=1).max(), c.longest_spacing
    density = max(yarn.density for yarn in c.yarns)
    return {
        "stretch": max(yarn.stretch for yarn in c.yarns) * area,
        "crimp_interchange": max(yarn.stretch for yarn in c.yarns) * area,
        "bending": max(yarn.bend for yarn in c.yarns) * area / length**2,
        "shear": np.max(c.shear) * area,
        "gravity": density * length * 9.8,
        "parallel": c.parallel_stiffness * length**2,
        "wind": WIND.density * length**2 * 25.0,
        "pins": 1e4 * length,
        "seams": 2e3 * length,
        "friction": np.max(c.friction_stiffness) * 1e-5,
        "applied": 1e-4,
        "inertia": density * SPEED**2,
        "mass_rate": density * SPEED**2,
    }[term]


def error(actual: object, expected: object, least: float = 0.0) -> float:
    """Largest difference, relative to the largest expected number or to `least`."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    assert np.isfinite(actual).all()
    return float(np.abs(actual - expected).max() / max(np.abs(expected).max(), least, 1e-300))


def force_of(sim: wy.Simulator, term: str, state: wy.State) -> np.ndarray:
    return joined(*sim.forces(state)[term])


def difference(case: Case, direction: np.ndarray, h: float, value: Callable[[wy.State], np.ndarray]) -> np.ndarray:
    """Derivative of value(state) along a direction: central differences of fourth order."""
    near = value(case.moved(direction, h)) - value(case.moved(direction, -h))
    far = value(case.moved(direction, 2.0 * h)) - value(case.moved(direction, -2.0 * h))
    return (8.0 * near - far) / (12.0 * h)


def matrix(
    sim: wy.Simulator, state: wy.State, *, mass: float = 0.0, damping: float = 0.0, stiffness: float = 0.0
) -> np.ndarray:
    """mass · M + damping · D + stiffness · H, as the scene's terms write them."""
    return sim.system(state, weights=(mass, damping, stiffness)).dense()


def check_definite(a: np.ndarray) -> None:
    """Symmetric, and no eigenvalue below 0, by more than rounding."""
    size = np.abs(a).max()
    # The two halves are one array; only diagonal blocks could differ, by the order in which they add up.
    assert np.abs(a - a.T).max() <= 1e-14 * size
    # An eigenvalue that is 0 (a rigid motion) comes out as some 1e-15 of the largest.
    assert np.linalg.eigvalsh(a).min() >= -1e-12 * size


class TermChecks:
    """Tests of a term, at each of its cases: inherit, and name the term.

    A term that reads what others do (the contact force, the force on s) names the scene's terms as well.
    """

    term: str
    terms: tuple[str, ...] = ()
    cases: tuple[Case, ...] = cases()
    moves_with = "xs"
    """What its force depends on: x, s, their rates v and w, the anchor a."""
    step = STEP
    """Of differences [m]; shorter where there is a kink or a sharp bend nearby."""
    tolerance = ROUNDING
    tolerance_of_differences = DIFFERENCES
    part = "stiffness"
    """Which part of the matrix `expected_matrix` is: mass, damping or stiffness."""

    def simulator(self, case: Case) -> wy.Simulator:
        return case.simulator(*(self.terms or (self.term,)))

    def oracle(self, case: Case) -> Oracle:
        return case.oracle(*(self.terms or (self.term,)))

    def least(self, case: Case) -> float:
        return natural(case.cloth, self.term)

    def least_of_matrix(self, case: Case) -> float:
        """A stiffness, or a damping where the term has that."""
        return self.least(case) / case.cloth.longest_spacing

    def matrix(self, case: Case, part: str) -> np.ndarray:
        """What the term adds to a part of the matrix."""
        result = matrix(self.simulator(case), case.state, **{part: 1.0})
        others = tuple(term for term in self.terms if term != self.term)
        return result - matrix(case.simulator(*others), case.state, **{part: 1.0}) if others else result

    def expected_matrix(self, case: Case) -> Tensor:
        """Nothing, unless a term says otherwise."""
        return torch.zeros(5 * case.cloth.nodes, 5 * case.cloth.nodes)

    def test_force(self, case: Case) -> None:
        """The oracle's."""
        expected = self.oracle(case).force(self.term, case.q, case.v, case.anchor).numpy()
        actual = force_of(self.simulator(case), self.term, case.state)
        n = 3 * case.cloth.nodes
        assert error(actual[:n], expected[:n], self.least(case)) < self.tolerance
        assert error(actual[n:], expected[n:], self.least(case)) < self.tolerance

    def test_jacobian(self, case: Case) -> None:
        """Central differences of the force are the oracle's exact derivative, along random directions."""
        o, sim, n = self.oracle(case), self.simulator(case), case.cloth.nodes
        directions = case.directions(4, self.moves_with)

        def along(dq: Tensor, dv: Tensor, da: Tensor) -> Tensor:
            return torch.func.jvp(functools.partial(o.force, self.term), (case.q, case.v, case.anchor), (dq, dv, da))[1]

        expected = torch.func.vmap(along)(*torch.split(tensor(directions), [5 * n, 5 * n, 2 * n], dim=1))
        force = functools.partial(force_of, sim, self.term)
        actual = [difference(case, direction, self.step, force) for direction in directions]
        assert error(actual, expected, self.least(case) / case.cloth.longest_spacing) < self.tolerance_of_differences

    def test_matrix(self, case: Case) -> None:
        """Symmetric, positive semi-definite, and what the term's docstring says."""
        a = self.matrix(case, self.part)
        check_definite(a)
        n = len(a)
        expected = self.expected_matrix(case)[:n, :n].detach().numpy()
        assert error(a, expected, self.least_of_matrix(case)) < 1e2 * self.tolerance

    def test_right_hand_side(self, case: Case) -> None:
        """h F + (M + h D) q̇, with the D of the matrix."""
        sim = self.simulator(case)
        h = sim.step_size
        a = matrix(sim, case.state, mass=1.0, damping=h)
        n = len(a)
        force = sum(joined(*force) for force in sim.forces(case.state).values())
        system = sim.system(case.state)
        expected = h * force[:n] + a @ case.v.numpy()[:n]
        assert error(system.rhs[system.free], expected[system.free], h * self.least(case)) < self.tolerance


class EnergyChecks(TermChecks):
    """Tests of a conservative term."""

    energy = ""
    """The name of its energy, where that is another term's."""
    sign = -1.0

    def oracle_energy(self, case: Case) -> Tensor:
        return self.oracle(case).elements(self.term, case.q).energy(case.q)

    def test_energy(self, case: Case) -> None:
        """The oracle's."""
        actual = self.simulator(case).energy(case.state)[self.energy or self.term]
        assert error(actual, self.oracle_energy(case), self.least(case) * case.cloth.longest_spacing) < self.tolerance

    def test_force_is_minus_the_gradient_of_the_energy(self, case: Case) -> None:
        """Of the kernel's own, by central differences along random directions."""
        sim = self.simulator(case)
        force = force_of(sim, self.term, case.state)
        for direction in (*case.directions(3, "x"), *case.directions(3 * case.sliding, "s")):
            slope = difference(case, direction, self.step, lambda s: np.array(sim.energy(s)[self.energy or self.term]))
            moved = direction[: len(force)]
            size = np.abs(force) @ np.abs(moved) + self.least(case)
            assert abs(slope - self.sign * force @ moved) < DIFFERENCES * size


class InternalChecks(EnergyChecks):
    """Tests of a conservative term that acts between the nodes of the cloth alone."""

    def test_neither_pushes_nor_turns_the_cloth(self, case: Case) -> None:
        force, _ = self.simulator(case).forces(case.state)[self.term]
        x = case.state.position
        assert error(force.sum(axis=0), np.zeros(3), np.abs(force).max() + self.least(case)) < self.tolerance
        size = np.abs(x).max() * np.abs(force).max() + self.least(case) * case.cloth.longest_spacing
        assert error(np.cross(x, force).sum(axis=0), np.zeros(3), size) < self.tolerance
