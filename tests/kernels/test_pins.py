"""Pins that hold nodes by a spring."""

import numpy as np
from cases import YARNS, Case
from checks import EnergyChecks, error
from reference import Tensor

import warp_yarn as wy


class TestPins(EnergyChecks):
    term = "pins"

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact second derivative."""
        elements = self.oracle(case).pins
        return elements.matrix(elements.hessians(case.q), len(case.q))


def test_target_is_the_path_where_there_is_one() -> None:
    cloth = wy.Cloth(wy.Weave.plain(rows=3, columns=4), yarns=YARNS[:1])
    path = np.arange(12.0).reshape(2, 2, 3) * 1e-3
    sim = wy.Simulator(wy.Scene(cloth, pins=[2, 7], pin_path=path, pin_stiffness=50.0, terms=["pins"]))
    # pins are at a row at the end of its step
    sim.steps_done = 1
    force, _ = sim.forces()["pins"]
    expected = np.zeros_like(force)
    expected[[2, 7]] = 50.0 * (path[0] - cloth.position[[2, 7]])
    # one product of two numbers
    assert error(force, expected) < 1e-15
