"""Gravity on a yarn segment."""

import numpy as np
from cases import GRAVITY, Case
from checks import ROUNDING, EnergyChecks, error


class TestGravity(EnergyChecks):
    term = "gravity"

    def test_weight(self, case: Case) -> None:
        """All of it: the yarns' density times length times g."""
        mass = self.oracle(case).total_mass()
        force, _ = self.simulator(case).forces(case.state)["gravity"]
        assert error(force.sum(axis=0), mass * np.array(GRAVITY)) < ROUNDING
