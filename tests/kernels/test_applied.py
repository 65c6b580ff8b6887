"""Forces that the user applies to nodes."""

import numpy as np
from cases import YARNS
from checks import TermChecks, error

import warp_yarn as wy


class TestApplied(TermChecks):
    term = "applied"


def test_impulse_of_a_force_that_varies() -> None:
    """Momentum grows by h F of each step; a path ends with its last step, a constant force does not."""
    cloth = wy.Cloth(wy.Weave.plain(rows=3, columns=4), yarns=YARNS[:2])
    path = np.array([[1.0, 0.0, -2.0], [0.5, 3.0, 0.0]]) * 1e-4
    constant = np.array([0.0, 1e-4, 2e-4])
    # An impulse on single nodes: without a stiffness nothing else couples them, and the solver stops at its tolerance.
    scene = wy.Scene(cloth, forces={5: path, 6: constant}, terms=["applied"], sliding=False)
    sim = wy.Simulator(scene, step=1e-3, integrator="linear", tolerance=1e-13)
    mass = sim.system().dense()
    steps = 4
    velocity = sim.run(steps).velocity.reshape(steps + 1, -1)
    momentum = (velocity @ mass).reshape(steps + 1, -1, 3).sum(axis=1)
    force = np.array([*path, [0.0] * 3, [0.0] * 3]) + constant
    # the tolerance of the solver
    assert error(np.diff(momentum, axis=0), sim.step_size * force) < 1e-11
