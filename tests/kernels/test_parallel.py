"""Collision of parallel yarns."""

import dataclasses

import numpy as np
import pytest
from cases import YARNS, Case, cases
from checks import EnergyChecks
from reference import Tensor

import warp_yarn as wy

SQUEEZED = cases(states=("squeezed",), sliding=(True,))


class TestParallel(EnergyChecks):
    term = "parallel"
    cases = cases(sliding=(True,))

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact second derivative, which is positive semi-definite."""
        elements = self.oracle(case).parallel
        return elements.matrix(elements.hessians(case.q), len(case.q))


class TestBarrier(TestParallel):
    """Crossings within a tenth of the radius of one another, and of the end of a yarn."""

    cases = SQUEEZED
    step = 1e-8
    """A thousandth of the least Δs."""
    tolerance = 1e-12
    """Coordinates of 6e-3 m leave 1e-18 m of that Δs."""


@pytest.mark.parametrize("case", SQUEEZED, ids=str)
def test_barrier_is_twice_differentiable_where_it_ends(case: Case) -> None:
    """Just within its reach its force is the square of the way, so that neither force nor matrix has a jump."""
    sim, c = case.simulator("parallel"), case.cloth
    a, b = c.node(1, 1), c.node(1, 2)
    k, _, stiffness, reach = (float(p[c.columns]) for p in case.oracle("parallel").parallel.parameters)

    def force(rest: float) -> float:
        euler = c.euler.copy()
        euler[b, 0] = euler[a, 0] + rest * reach
        return float(sim.forces(dataclasses.replace(sim.state, euler=euler, anchor=None))["parallel"][1][a, 0])

    penalty = force(1.5)
    within = [force(x) - penalty for x in (0.99, 0.98)]
    # the penalty goes on linearly
    slope = k * reach
    guard = [-(f + slope * (1.5 - x)) for f, x in zip(within, (0.99, 0.98), strict=True)]
    # 2 left log + left²/x of left = 1 − x is 3 left² to within left
    assert guard[0] == pytest.approx(stiffness * 3.0 * 0.01**2, rel=0.02)
    assert guard[1] == pytest.approx(stiffness * 3.0 * 0.02**2, rel=0.04)


def test_barrier_grows_without_bound() -> None:
    """At least as 1/Δs: no speed of a crossing gets through."""
    sim, state = SQUEEZED[0].simulator("parallel"), SQUEEZED[0].state
    c = SQUEEZED[0].cloth
    a, b = c.node(1, 1), c.node(1, 2)
    forces = []
    for rest in (1e-7, 1e-9, 1e-11):
        euler = state.euler.copy()
        euler[a, 0] = 1e-3
        euler[b, 0] = 1e-3 + rest
        forces.append(sim.forces(dataclasses.replace(state, euler=euler))["parallel"][1][b, 0])
    assert np.all(np.diff(np.log10(forces)) > 1.99)


@pytest.mark.parametrize("weave", ["plain", "twill"])
@pytest.mark.parametrize("direction", [0, 1])
def test_acts_within_its_distance_and_pushes_apart(weave: str, direction: int) -> None:
    """Nothing at 4R < Δs; where two crossings come nearer than 2R, each goes its way."""
    cloth = wy.Cloth(wy.WEAVES[weave](rows=5, columns=5), yarns=YARNS[:1], radius=2e-4)
    sim = wy.Simulator(wy.Scene(cloth, terms=["parallel"]))
    assert sim.energy()["parallel"] == 0.0
    assert not np.any(sim.forces()["parallel"][1])
    euler = cloth.euler.copy()
    a, b = cloth.node(2, 2), cloth.node(2, 3) if direction == 0 else cloth.node(3, 2)
    euler[a, direction] += 0.35 * cloth.spacing
    euler[b, direction] -= 0.35 * cloth.spacing
    _, s = sim.forces(dataclasses.replace(sim.state, euler=euler, anchor=None))["parallel"]
    assert s[a, direction] < 0.0 < s[b, direction]
    assert np.count_nonzero(s) == 2
    assert s[a, direction] == pytest.approx(-s[b, direction], rel=1e-15)
