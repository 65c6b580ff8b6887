"""Shear of warp against weft, and its lock."""

import functools
import math

import numpy as np
import pytest
import torch
from cases import BENT, YARNS, Case, cases
from checks import DIFFERENCES, InternalChecks, TermChecks, difference, error, force_of
from reference import RIGHT, Elements, Tensor, angle, lock, presence, unit
from torch.func import grad, hessian, vmap

import warp_yarn as wy


def corner(q: Tensor) -> Tensor:
    """φ of q = (x_p, x_c, x_r)."""
    return angle(unit(q[0:3] - q[3:6]), unit(q[6:9] - q[3:6]))


def gauss_newton(elements: Elements, q: Tensor) -> Tensor:
    """max(V'/(φ − π/2), 0.8 V'') ∇φ ∇φᵀ of every corner; at the right angle the factor is V''."""

    def energy(phi: Tensor, k: Tensor, jams: Tensor, l1: Tensor, l2: Tensor, *limits: Tensor) -> Tensor:
        return 0.5 * k * torch.where(jams, lock(phi, *limits), 1.0) * (phi - RIGHT) ** 2

    def fades(q: Tensor, k: Tensor, jams: Tensor, l1: Tensor, l2: Tensor, *limits: Tensor) -> tuple[Tensor, Tensor]:
        """s(l_p) s(l_r), and the positive parts of the second derivatives in each length with the angle held."""
        e1, e2 = q[0:3] - q[3:6], q[6:9] - q[3:6]
        total = torch.zeros(9, 9, dtype=torch.float64)
        largest = 0.5 * k * RIGHT**2 * torch.where(jams, lock(torch.zeros_like(k), *limits), 1.0)
        gain = energy(corner(q), k, jams, l1, l2, *limits) - largest
        ends = ((e1, l1, e2, l2, (1.0, -1.0, 0.0)), (e2, l2, e1, l1, (0.0, -1.0, 1.0)))
        for e, own, other, its, sign in ends:

            def fade(length: Tensor, e: Tensor = e, own: Tensor = own) -> Tensor:
                return presence(unit(e) * length, own)

            second = (gain * hessian(fade)(torch.linalg.vector_norm(e))).clamp(min=0.0)
            g = torch.cat([s * unit(e) for s in sign])
            total = total + second * presence(other, its) * torch.outer(g, g)
        return presence(e1, l1) * presence(e2, l2), total

    local = q[elements.unknowns]
    fade, along = vmap(fades)(local, *elements.parameters)
    phi = vmap(corner)(local)
    strain = phi - RIGHT
    at_rest = strain.abs() < 1e-9
    slope = vmap(grad(energy))(phi, *elements.parameters) / torch.where(at_rest, 1.0, strain)
    curvature = vmap(grad(grad(energy)))(phi, *elements.parameters)
    factor = torch.where(at_rest, curvature, torch.maximum(slope, 0.8 * curvature))
    g = vmap(grad(corner))(local)
    return elements.matrix((fade * factor)[:, None, None] * g[:, :, None] * g[:, None, :] + along, len(q))


class TestShear(InternalChecks):
    """Without contact: F_n = 0."""

    term = "shear"

    def expected_matrix(self, case: Case) -> Tensor:
        elements = self.oracle(case).elements("shear", case.q)
        return gauss_newton(elements, case.q)

    def test_some_corners_jam_and_some_do_not(self, case: Case) -> None:
        """Or the cases above would test little."""
        jams = self.oracle(case).elements("shear", case.q).parameters[1]
        assert 0 < int(jams.sum()) < len(jams)


class TestCollapsedSegments(TestShear):
    """Two neighbours of a crossing within 0.05 L of it."""

    cases = cases(states=("collapsed",))
    step = 2e-8
    """A thousandth of the shortest segment."""
    tolerance_of_differences = 1e-8
    """Of fourth-order differences over 1e-3 of that length, and 1e-16/1e-5 for rounding."""


class TestPressedShear(TermChecks):
    """With the contact force of stretch and bending, which the matrix takes as constant and the Jacobian does not."""

    term = "shear"
    terms = ("stretch", "bending", "shear")
    cases = cases(states=BENT)
    step = 1e-9
    """F_n has a kink at 0, which some crossing is always near."""
    tolerance_of_differences = 1e-8
    """1e-16/1e-6 for rounding, times the stiffness of stretch over that of shear, some 100."""
    expected_matrix = TestShear.expected_matrix

    def test_force_is_minus_the_gradient_of_the_energy(self, case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
        """F_n is held at its value."""
        sim = self.simulator(case)
        force = force_of(sim, "shear", case.state)
        monkeypatch.setattr(sim.arrays, "contact", False)
        for direction in case.directions(3, "x"):
            slope = difference(case, direction, 1e-7, lambda state: np.array(sim.energy(state)["shear"]))
            moved = direction[: len(force)]
            assert abs(slope + force @ moved) < DIFFERENCES * (np.abs(force) @ np.abs(moved))


@pytest.mark.parametrize("case", cases(states=("rest", "stretched")), ids=str)
def test_matrix_is_exact_at_the_right_angle(case: Case) -> None:
    """Where the corners do not jam."""
    elements = case.oracle("shear").elements("shear", case.q)
    free = elements.of((~elements.parameters[1]).tolist())
    expected = free.matrix(free.hessians(case.q), len(case.q))
    actual = gauss_newton(free, case.q)
    assert error(actual, expected) < 1e-12


# -- the lock --------------------------------------------------------------------------------------------------------


@functools.cache
def cross_weave(radius: float) -> wy.Simulator:
    """3 × 3 nodes whose only crossing is flipped against all its neighbours: four corners that can jam."""
    weave = wy.Weave([[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    cloth = wy.Cloth(weave, yarns=YARNS[:1], radius=radius, pose="flat")
    return wy.Simulator(wy.Scene(cloth, terms=["shear"]))


def at_angle(sim: wy.Simulator, phi: float) -> wy.State:
    """Both warp neighbours at one place and both weft neighbours at another, so that all four corners are phi."""
    x = sim.state.position
    length = sim.scene.cloth.spacing
    x[4] = 0.0
    x[[3, 5]] = [length, 0.0, 0.0]
    x[[1, 7]] = [length * math.cos(phi), length * math.sin(phi), 0.0]
    state = sim.state
    state.position = x
    return state


def stiffening(radius: float, phi: float) -> float:
    """k_s of eq. 5 over its unlocked value, from the kernel's energy."""
    sim = cross_weave(radius)
    c = sim.scene.cloth
    unlocked = 4 * 0.5 * c.shear * math.pi * radius**2 * c.spacing * (phi - RIGHT) ** 2
    return sim.energy(at_angle(sim, phi))["shear"] / unlocked


ANGLES = (1e-6, 0.1, 0.5, 1.0, 1.04, 1.06, 1.2, 1.5, 1.6, 2.0, 2.5, 3.0, 3.1)


@pytest.mark.parametrize("phi", ANGLES)
@pytest.mark.parametrize("radius", [5e-4, 2e-4, 5e-5])
def test_lock(radius: float, phi: float) -> None:
    """Eq. 5."""
    expected = float(lock(torch.tensor(phi, dtype=torch.float64), 2.0 * math.asin(radius / 1e-3), 1e-3 / radius))
    # (φ − π/2)² keeps 1e-14 where the angle is nearest to the right one
    assert stiffening(radius, phi) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("radius", [5e-4, 2e-4, 5e-5])
def test_limits_of_the_lock(radius: float) -> None:
    """γ³ = (√2 L/R)³ where the corner is shut; 1 where it is far open, and γ³ growing all the way in between."""
    # The transition leaves 1 − tanh(π φ_l/(2σ²)) of the other value: at the least radius much, so near 0 is its lock.
    shut = 2.0 * math.asin(radius / 1e-3)
    rest = 1.0 - math.tanh(RIGHT * shut / 0.36)
    assert stiffening(radius, 1e-4) == pytest.approx((math.sqrt(2.0) * 1e-3 / radius) ** 3, rel=rest + 1e-3)
    rest = 1.0 - math.tanh(RIGHT * (RIGHT - shut) / 0.36)
    assert stiffening(radius, RIGHT - 1e-3) == pytest.approx(1.0, abs=rest + 1e-6)
    closing = [stiffening(radius, phi) for phi in np.linspace(shut, 1e-4, 30)]
    assert np.all(np.diff(closing) > 0.0)


@pytest.mark.parametrize("radius", [5e-4, 2e-4, 5e-5])
def test_a_corner_that_can_jam_pushes_back_at_every_angle(radius: float) -> None:
    """Towards the right angle, from a shut corner to a flat one: what γ ≥ 0 is for."""
    sim = cross_weave(radius)
    for phi in np.linspace(1e-3, math.pi - 1e-3, 60):
        force, _ = sim.forces(at_angle(sim, phi))["shear"]
        opening = np.array([-math.sin(phi), math.cos(phi), 0.0])
        assert force[1] @ opening * (phi - RIGHT) < 0.0


@pytest.mark.parametrize("phi", [0.0, math.pi])
def test_flat_corner_is_finite(phi: float) -> None:
    sim = cross_weave(5e-4)
    state = at_angle(sim, phi)
    force, _ = sim.forces(state)["shear"]
    assert np.isfinite(force).all()
    assert np.isfinite(sim.system(state).dense()).all()
