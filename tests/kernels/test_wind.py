"""Wind on the cloth's triangles."""

import numpy as np
import pytest
import torch
from cases import Case
from checks import ROUNDING, TermChecks, error
from reference import Tensor

import warp_yarn as wy


class TestWind(TermChecks):
    term = "wind"
    moves_with = "xv"
    part = "damping"

    def least_of_matrix(self, case: Case) -> float:
        """At the wind's 5 m/s."""
        return self.least(case) / 5.0

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact derivative by velocity."""
        o = self.oracle(case)
        return -torch.func.jacrev(lambda v: o.force("wind", case.q, v, case.anchor))(case.v)

    def test_stiffness_is_left_out(self, case: Case) -> None:
        assert not self.matrix(case, "stiffness").any()


@pytest.mark.parametrize(
    ("relative", "pressure"),
    [((0.0, 5.0, 0.0), (0.0, 50.0, 0.0)), ((0.0, -5.0, 0.0), (0.0, -50.0, 0.0)), ((3.0, 0.0, -4.0), (1.5, 0.0, -2.0))],
)
def test_flat_sheet(relative: tuple[float, ...], pressure: tuple[float, ...]) -> None:
    """Across an upright sheet ρ_w v² = 2 · 5² Pa, along it c_d v; only the velocity relative to the cloth counts."""
    cloth = wy.Cloth(wy.Weave.plain(rows=4, columns=6), yarns=[wy.Yarn(density=2e-3, stretch=5e5, bend=1.4e-4)])
    sim = wy.Simulator(wy.Scene(cloth, wind=wy.Wind(velocity=(1.0, 2.0, 3.0), density=2.0, drag=0.5), terms=["wind"]))
    state = sim.state
    state.velocity[:] = np.array([1.0, 2.0, 3.0]) - relative
    force, _ = sim.forces(state)["wind"]
    area = 3.0 * 5.0 * cloth.spacing**2
    assert error(force.sum(axis=0), area * np.array(pressure)) < ROUNDING
