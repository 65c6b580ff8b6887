"""Mass, inertia and mass rate of yarn segments."""

import numpy as np
import torch
from cases import Case, cases, joined
from checks import ROUNDING, SPEED, EnergyChecks, TermChecks, check_definite, error, matrix, natural
from reference import Tensor


class TestInertia(EnergyChecks):
    """∂T/∂q: plus the gradient of the kinetic energy."""

    term = "inertia"
    energy = "mass"
    sign = 1.0
    cases = cases(sliding=(True,))
    moves_with = "xsvw"

    def oracle_energy(self, case: Case) -> Tensor:
        return self.oracle(case).kinetic(case.q, case.v)

    def test_changes_no_momentum(self, case: Case) -> None:
        """T does not change when the whole cloth is moved."""
        force, _ = case.simulator("inertia").forces(case.state)["inertia"]
        assert error(force.sum(axis=0), np.zeros(3), natural(case.cloth, "inertia")) < ROUNDING


class TestMassRate(TermChecks):
    term = "mass_rate"
    cases = cases(sliding=(True,))
    moves_with = "xsvw"


class TestMass:
    cases = cases()

    def test_kinetic_energy(self, case: Case) -> None:
        expected = case.oracle("mass").kinetic(case.q, case.v)
        actual = case.simulator("mass").energy(case.state)["mass"]
        assert error(actual, expected, natural(case.cloth, "inertia") * case.cloth.longest_spacing) < ROUNDING

    def test_matrix_is_the_second_derivative_of_the_kinetic_energy(self, case: Case) -> None:
        a = matrix(case.simulator("mass"), case.state, mass=1.0)
        check_definite(a)
        n = len(a)
        assert error(a, case.oracle("mass").mass(case.q, case.v)[:n, :n]) < ROUNDING

    def test_momentum(self, case: Case) -> None:
        """M q̇ = ∂T/∂q̇, which the right-hand side carries, and which takes no step to get."""
        sim = case.simulator("mass")
        sim.system(case.state)
        s = sim.arrays["euler_momentum"].numpy() if case.sliding else []
        actual = joined(sim.arrays["momentum"].numpy(), s)
        expected = torch.func.grad(case.oracle("mass").kinetic, argnums=1)(case.q, case.v)[: len(actual)]
        assert error(actual, expected, natural(case.cloth, "inertia") * case.cloth.longest_spacing / SPEED) < ROUNDING

    def test_total_mass(self, case: Case) -> None:
        """The masses of all pairs of nodes add up to the yarns' density times length, wherever the crossings slide."""
        o, c = case.oracle("mass"), case.cloth
        n = c.nodes
        x = matrix(case.simulator("mass"), case.state, mass=1.0)[: 3 * n, : 3 * n].reshape(n, 3, n, 3)
        assert error(x.sum(axis=(0, 2)), o.total_mass() * np.eye(3)) < ROUNDING
