"""Collision of parallel yarns."""

import dataclasses

import numpy as np
import pytest
from cases import YARNS, Case, cases
from checks import EnergyChecks
from reference import Tensor

import warp_yarn as wy


class TestParallel(EnergyChecks):
    term = "parallel"
    cases = cases(sliding=(True,))

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact second derivative, which is positive semi-definite."""
        elements = self.oracle(case).parallel
        return elements.matrix(elements.hessians(case.q), len(case.q))


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
