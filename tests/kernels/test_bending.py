"""Bending of a yarn at a crossing."""

import functools
import math

import numpy as np
import pytest
import torch
from cases import Case, cases
from checks import InternalChecks, check_definite, error, matrix
from reference import Tensor, angle, clamped, presence, tensor, unit
from torch.func import grad, hessian, vmap
from warp_yarn.kernels.terms.bending import SERIES_BELOW

import warp_yarn as wy


def bend(q: Tensor) -> Tensor:
    """θ of q = (x_a, x_c, x_b, s_a, s_b)."""
    return angle(unit(q[6:9] - q[3:6]), unit(q[3:6] - q[0:3]))


def within_plane(q: Tensor, k: Tensor) -> Tensor:
    """(2k/Δs)(dθ − θ dΔs/Δs)², that is the second derivative of V in (θ, Δs)."""
    rest = q[10] - q[9]
    g = grad(bend)(q) - bend(q) / rest * tensor([0.0] * 9 + [-1.0, 1.0])
    return 2.0 * k / rest * torch.outer(g, g)


def across_plane(q: Tensor, k: Tensor) -> Tensor:
    """Positive part of the second derivative of V in the angles by which the two segments leave the yarn's plane."""
    e1, e2 = q[6:9] - q[3:6], q[0:3] - q[3:6]
    m = unit(torch.linalg.cross(e1, e2))

    def energy(turn: Tensor) -> Tensor:
        return k * angle(unit(unit(e1) + turn[0] * m), -unit(unit(e2) + turn[1] * m)) ** 2 / (q[10] - q[9])

    h = clamped(hessian(energy)(torch.zeros(2, dtype=torch.float64)))
    by_b, by_a = m / torch.linalg.vector_norm(e1), m / torch.linalg.vector_norm(e2)
    none = torch.zeros(3, dtype=torch.float64)
    turn = torch.stack([torch.cat([none, -by_b, by_b, none[:2]]), torch.cat([by_a, -by_a, none, none[:2]])])
    return turn.mT @ h @ turn


class TestBending(InternalChecks):
    term = "bending"

    def expected_matrix(self, case: Case) -> Tensor:
        """The exact second derivative where yarns are straight; elsewhere what the kernel's docstring says."""
        elements = self.oracle(case).bending
        if case.state_name in ("rest", "stretched"):
            return elements.matrix(elements.hessians(case.q), len(case.q))
        q, k = case.q[elements.unknowns], elements.parameters[0]
        return elements.matrix(vmap(within_plane)(q, k) + vmap(across_plane)(q, k), len(case.q))


def fading(q: Tensor, k: Tensor, l1: Tensor, l2: Tensor) -> tuple[Tensor, Tensor]:
    """s(l₁) s(l₂), and what a matrix has of it: the second derivative of (1 − s) k π²/Δs in Δs, and the positive parts
    of that of V in each length with the angle held."""
    e1, e2 = q[6:9] - q[3:6], q[0:3] - q[3:6]
    rest = q[10] - q[9]
    gain = k * (bend(q) ** 2 - math.pi**2) / rest
    part = presence(e1, l1) * presence(e2, l2)
    by_rest = tensor([0.0] * 9 + [-1.0, 1.0])
    total = 2.0 * (1.0 - part) * k * math.pi**2 / rest**3 * torch.outer(by_rest, by_rest)
    for e, own, other, its, ends in ((e1, l1, e2, l2, (6, 3)), (e2, l2, e1, l1, (0, 3))):

        def fade(stretched: Tensor, e: Tensor = e, own: Tensor = own) -> Tensor:
            return presence(unit(e) * stretched, own)

        second = (gain * hessian(fade)(torch.linalg.vector_norm(e))).clamp(min=0.0)
        g = torch.zeros(11, dtype=torch.float64)
        g = g.index_add(0, torch.arange(ends[0], ends[0] + 3), unit(e))
        g = g.index_add(0, torch.arange(ends[1], ends[1] + 3), -unit(e))
        total = total + second * presence(other, its) * torch.outer(g, g)
    return part, total


class TestCollapsedSegments(TestBending):
    """Two neighbours of a node within 0.05 L of it."""

    cases = cases(states=("collapsed",))
    step = 2e-8
    """A thousandth of the shortest segment."""
    tolerance_of_differences = 1e-8
    """Of fourth-order differences over 1e-3 of that length, and 1e-16/1e-5 for rounding."""

    def expected_matrix(self, case: Case) -> Tensor:
        """The same fades out, and the positive part of how it fades comes in."""
        elements = self.oracle(case).bending
        q, k = case.q[elements.unknowns], elements.parameters[0]
        fade, along = vmap(fading)(q, *elements.parameters)
        blocks = vmap(within_plane)(q, k) + vmap(across_plane)(q, k)
        return elements.matrix(fade[:, None, None] * blocks + along, len(case.q))


@pytest.mark.parametrize("case", cases(states=("rest", "stretched")), ids=str)
def test_straight_yarns_have_no_force_at_all(case: Case) -> None:
    x, s = case.simulator("bending").forces(case.state)["bending"]
    assert not x.any()
    assert not s.any()


# -- one angle at a time ---------------------------------------------------------------------------------------------

LENGTH = 1e-3
YARN = wy.Yarn(density=2e-3, stretch=5e5, bend=1.4e-4)
K = YARN.bend * np.pi * 5e-4**2


@functools.cache
def one_bend() -> wy.Simulator:
    cloth = wy.Cloth(wy.Weave.plain(rows=3, columns=3), yarns=[YARN], pose="flat", spacing=LENGTH)
    return wy.Simulator(wy.Scene(cloth, terms=["bending"]))


def bent(theta: float) -> tuple[wy.Simulator, wy.State]:
    """3 × 3 nodes of which the warp yarns all turn by theta, at a node that stands at 0 for full precision."""
    sim = one_bend()
    x = np.zeros((3, 3, 3))
    x[:, :, 1] = LENGTH * np.arange(3)[:, None]
    x[:, 0, 0] = -LENGTH
    x[:, 2, 0], x[:, 2, 2] = LENGTH * np.cos(theta), LENGTH * np.sin(theta)
    return sim, wy.State(x.reshape(9, 3), sim.state.euler, np.zeros((9, 3)), np.zeros((9, 2)))


def energy_and_force(theta: float) -> tuple[float, float, float]:
    """Of one warp yarn: V, and the sizes of the forces on its two ends."""
    sim, state = bent(theta)
    x, _ = sim.forces(state)["bending"]
    return sim.energy(state)["bending"] / 3.0, float(np.linalg.norm(x[2])), float(np.linalg.norm(x[0]))


ANGLES = (1e-12, 1e-8, 1e-5, 1e-3, 0.03, 0.033, 0.3, 1.0, 0.5 * np.pi, 2.0, 3.0, 3.14)


@pytest.mark.parametrize("theta", ANGLES)
def test_closed_form(theta: float) -> None:
    """V = k θ²/Δs and |F| = 2 k θ/(Δs l) on either end, from nearly straight to nearly flat."""
    rest = 2.0 * LENGTH
    # Coordinates of 1 come with errors of 1e-16, which an angle ε from flat divides by ε: 1.6e-3 for the last.
    tolerance = 1e-14 if theta < 3.0 else 1e-12
    expected = (K * theta**2 / rest, 2.0 * K * theta / (rest * LENGTH), 2.0 * K * theta / (rest * LENGTH))
    for actual, wanted in zip(energy_and_force(theta), expected, strict=True):
        assert error(actual, wanted) < tolerance


def test_series_goes_over_into_the_closed_form() -> None:
    """No jump where sin²θ passes SERIES_BELOW."""
    below, above = (float(np.arcsin(np.sqrt(SERIES_BELOW * (1.0 + e)))) for e in (-1e-9, 1e-9))
    v, f, _ = np.array(energy_and_force(above)) / np.array(energy_and_force(below))
    assert abs(v * (below / above) ** 2 - 1.0) < 1e-14
    assert abs(f * (below / above) - 1.0) < 1e-14
    a, b = (matrix(*bent(theta), stiffness=1.0) for theta in (below, above))
    # The matrix itself changes by some θ dθ = 1e-12 between the two angles.
    assert error(a, b) < 1e-11


@pytest.mark.parametrize("name", ["plain", "twill", "satin"])
def test_flat_fold_is_finite(name: str) -> None:
    """Folded onto itself a yarn has the energy of θ = π; the direction of its force is undefined, and finite."""
    case = Case(name, "flat", True)
    sim, o, n = case.simulator("bending"), case.oracle("bending"), case.cloth.nodes
    q = case.q[o.bending.unknowns]
    assert float(vmap(bend)(q).max()) == np.pi
    assert error(sim.energy(case.state)["bending"], o.bending.energy(case.q)) < 1e-14
    x, s = sim.forces(case.state)["bending"]
    assert np.isfinite(x).all()
    assert error(s.ravel(), o.force("bending", case.q, case.v, case.anchor)[3 * n :]) < 1e-14
    check_definite(matrix(sim, case.state, stiffness=1.0))
