"""Yarns that straighten at each other's expense."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
import warp as wp
from cases import Case
from checks import InternalChecks, check_definite, error, matrix
from crimped import CrimpCase, cases, cloth, scene
from internals import has_any, stiffness_at_evaluation
from reference import Tensor, clamped, crimped_crossing, crimped_segment, segments_of, tensor
from scipy.optimize import brentq
from torch.func import grad, hessian, jacrev, vmap
from warp_yarn.kernels import Variant, build
from warp_yarn.kernels.terms.crimped_segment import ROUND

import warp_yarn as wy
from warp_yarn.description import crimp as description
from warp_yarn.description.crimp import interchange

ROUNDING = 1e-13
"""As of all terms; of h, which is found to 1e-13 and then once more."""


def height(q: Tensor, parts: Tensor, k: Tensor, b: Tensor, woven: Tensor, total: Tensor) -> Tensor:
    """h by bisection, of the energy alone."""
    p, rest = segments_of(q)

    def slope(h: Tensor) -> Tensor:
        return grad(lambda h: side_energies(h, p, rest, k, b, woven, total) @ parts)(h)

    low, high = -3.0 * total, 4.0 * total
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = slope(middle) > 0.0
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return 0.5 * (low + high)


def side_energies(h: Tensor, p: Tensor, rest: Tensor, k: Tensor, b: Tensor, woven: Tensor, total: Tensor) -> Tensor:
    heights = torch.stack([h, h, total - h, total - h])
    return vmap(crimped_segment)(p, heights, rest, k.repeat_interleave(2), b.repeat_interleave(2), woven)


def compression(p: Tensor, h: Tensor, rest: Tensor, k: Tensor, b: Tensor, woven: Tensor) -> Tensor:
    """What a pushed yarn takes away from the second derivative in (p, h)."""

    def length(y: Tensor) -> Tensor:
        return torch.sqrt(y[0] ** 2 + 9.0 / 8.0 * y[1] ** 2)

    def of_length(along: Tensor) -> Tensor:
        return crimped_segment(along, tensor(0.0), rest, k, tensor(1e-30), woven)

    y = torch.stack([p, h])
    strain = length(y) / rest - 1.0
    limit = 3.0 * b / woven[1] ** 2 * (woven[0] / woven[1]) ** 2
    tension = torch.where(strain < 0.0, k * strain / (1.0 - k * strain / limit), 0.0)
    return tension * hessian(length)(y)


def expected_block(q: Tensor, h: Tensor, *parameters: Tensor, sliding: bool) -> Tensor:
    """The second derivative of W without what compression takes away, put together from that of every segment; with
    sliding, of the coupling through h that within each yarn alone."""
    parts, k, b, woven, total = parameters
    p, rest = segments_of(q)

    def of_all(y: Tensor) -> Tensor:
        return parts @ side_energies(y[8], y[:4], y[4:8], k, b, woven, total)

    y = torch.cat([p, rest, h[None]])
    second, slopes = hessian(of_all)(y), grad(of_all)(y)
    for side in range(4):
        sign, mine = (1.0, h) if side < 2 else (-1.0, total - h)
        yarn = side // 2
        less = parts[side] * compression(p[side], mine, rest[side], k[yarn], b[yarn], woven[side])
        signs = tensor([1.0, sign])
        which = torch.tensor([side, 8])
        second[which[:, None], which[None, :]] -= less * torch.outer(signs, signs)
    coupling = second[:8, 8]
    yarns = torch.arange(8) // 2 % 2
    same = (yarns[:, None] == yarns[None, :]).double() if sliding else torch.ones(8, 8)
    reduced = second[:8, :8].clone()
    if second[8, 8] > 0.0:
        reduced -= same * torch.outer(coupling, coupling) / second[8, 8]
    jacobian = jacrev(lambda q: torch.cat(segments_of(q)))(q)
    result = jacobian.mT @ reduced @ jacobian
    bent = hessian(lambda q: segments_of(q)[0] @ slopes[:4].clamp(min=0.0))(q)
    return result + bent


def expected_matrix(case: Case, sliding: bool) -> Tensor:
    """The sum of all crossings' blocks and those of straight segments."""
    o, size = case.oracle("crimp_interchange"), len(case.q)
    q, parameters = case.q[o.interchange.unknowns], o.interchange.parameters
    each = zip(q, vmap(height)(q, *parameters), *parameters, strict=True)
    blocks = torch.stack([expected_block(*crossing, sliding=sliding) for crossing in each])
    straight = clamped(o.straight.hessians(case.q))
    # of which methods that take one matrix a step need twice as much
    enough = 2.0 if sliding else 1.0
    return enough * o.interchange.matrix(blocks, size) + o.straight.matrix(straight, size)


class TestCrimpInterchange(InternalChecks):
    term = "crimp_interchange"
    cases = cases()
    step = 2e-9
    """Where a yarn gives way to being pushed is 1e-3 of its length away: (2e-6/1e-3)⁴."""
    tolerance = ROUNDING
    tolerance_of_differences = 2e-8
    """And 1e-16/2e-6 for rounding, of a force that is some 1e-2 of the natural one, and of pushed yarns' curvature."""

    def expected_matrix(self, case: Case) -> Tensor:
        """What the kernel's docstring says, at a first evaluation."""
        return expected_matrix(case, case.sliding)

    def oracle_energy(self, case: Case) -> Tensor:
        o = self.oracle(case)
        return o.interchange.energy(case.q) + o.straight.energy(case.q)


@pytest.mark.parametrize("case", cases(("taut",)), ids=str)
def test_matrix_in_tension_is_exact_or_more(case: CrimpCase) -> None:
    """Exact where yarns do not slide; with sliding, in a first evaluation never less, and later never less than half
    of that."""
    o = case.oracle("crimp_interchange")
    size, n = len(case.q), case.unknowns
    exact = o.interchange.matrix(o.interchange.hessians(case.q), size)
    exact = (exact + o.straight.matrix(o.straight.hessians(case.q), size))[:n, :n].numpy()
    found = matrix(case.simulator("crimp_interchange"), case.state, stiffness=1.0)
    if not case.sliding:
        assert error(found, exact) < 1e-12
        return
    assert np.linalg.eigvalsh(found - exact).min() > -1e-12 * np.abs(exact).max()
    later = stiffness_at_evaluation(case.simulator("crimp_interchange"), case.state, 2)
    assert np.linalg.eigvalsh(2.0 * later - exact).min() > -1e-12 * np.abs(exact).max()


@pytest.mark.parametrize("case", [case for case in cases(("taut", "random")) if case.sliding], ids=str)
def test_matrix_of_every_second_evaluation(case: CrimpCase) -> None:
    """That of the positions with Δs held, and ten times that of each Δs; apart, and so definite."""
    sim = wy.Simulator(case.simulator("crimp_interchange").scene, integrator="linear")
    found, n = stiffness_at_evaluation(sim, case.state, 1), 3 * case.cloth.nodes
    check_definite(found)
    second, whole = stiffness_at_evaluation(sim, case.state, 2), expected_matrix(case, sliding=False)
    assert error(found[:n, :n], whole[:n, :n]) < 1e-11
    assert not found[:n, n:].any()
    # with h held Δs is no softer
    assert np.linalg.eigvalsh(found[n:, n:] - 10.0 * second[n:, n:]).min() > -1e-11 * np.abs(found).max()


@pytest.mark.parametrize("case", cases(("rest", "taut", "knee")), ids=str)
def test_contact_force_is_what_holds_the_diameters(case: CrimpCase) -> None:
    """F_n = 2 ∂W/∂(d₁ + d₂), the offset of a yarn being half its height, in a cloth that is flat."""
    state = dataclasses.replace(case.state, position=case.state.position * [1.0, 1.0, 0.0])
    o = case.oracle("crimp_interchange", "shear")
    q = case.q.clone()
    q[2 : 3 * case.cloth.nodes : 3] = 0.0
    expected = 2.0 * vmap(grad(crimped_crossing, argnums=5))(q[o.interchange.unknowns], *o.interchange.parameters)
    found = case.simulator("crimp_interchange", "shear").contact(state)[1][case.cloth.topology.crossing_node]
    assert error(found, expected.clamp(min=0.0), 1e-3) < 1e-12


@pytest.mark.parametrize("name", ["plain", "twill", "satin"])
def test_every_segment_is_shared_out_once(name: str) -> None:
    """Its two halves among the nodes at its ends; and straight where no yarn changes sides."""
    c = cloth(name)
    sides = interchange(c)["crimp_sides"]
    a, b = c.topology.segment_nodes.T
    along = c.topology.yarn_direction[c.topology.segment_yarn]
    mine, its = sides[a, 2 * along + 1], sides[b, 2 * along]
    assert (np.abs(mine) + np.abs(its) == 2).all()
    assert np.abs(sides).sum() == 2 * len(a)
    crossing = c.topology.is_crossing != 0
    both = crossing[a] & crossing[b]
    assert ((mine[both] > 0) == (c.topology.flipped[a] != c.topology.flipped[b])[both]).all()


# -- cells of uniform cloth ------------------------------------------------------------------------------------------


@functools.cache
def cell(distance: float, length: float, stretch: float, bend: float = 1e-9, size: int = 5) -> wy.Simulator:
    """A square plain weave of one yarn, kₛ = stretch [N], k_b = bend [N m²], at rest as woven."""
    radius = 0.5 * wy.crimp_height(distance, length)
    area = math.pi * radius**2
    yarn = wy.Yarn(density=2e-5, stretch=stretch / area, bend=bend / area)
    c = wy.Cloth(
        wy.Weave.plain(rows=size, columns=size),
        yarns=[yarn],
        spacing=distance,
        crimp=length / distance - 1.0,
        radius=radius,
        pose="flat",
    )
    return wy.Simulator(wy.Scene(c, sliding=False, gravity=None, crimp_interchange=True))


def pulls(sim: wy.Simulator, along: float, across: float) -> tuple[float, float]:
    """What the yarns pull with at the border, of a cloth that is so much longer in each direction."""
    c = sim.scene.cloth
    state = dataclasses.replace(sim.state, position=c.position * [along, across, 1.0])
    force = sim.forces(state)["crimp_interchange"][0]
    return float(force[c.node(2, 0), 0]), float(force[c.node(0, 2), 1])


def pulled(sim: wy.Simulator, strain: float) -> tuple[float, float]:
    """Force of a warp yarn, and strain across, of a cloth that may draw in."""
    across = brentq(lambda across: pulls(sim, 1.0 + strain, across)[1], 0.5, 1.3, xtol=1e-14)
    return pulls(sim, 1.0 + strain, across)[0], across - 1.0


@pytest.mark.parametrize(("degrees", "expected"), [(23.70, 1026.0), (math.degrees(math.acos(1 / 1.05)), 1784.6)])
def test_moduli_of_leaf_and_kandil(degrees: float, expected: float) -> None:
    """E = 12 k_b p₂/(p₁ l³ sin²θ) · 2 and ν = 1 of a square cell, l = 0.525 mm and k_b = 1e-9 N m²: at θ = 23.7°, and
    at 5 % of crimp. Within what 200 N of stretch gives, that they know none of."""
    length, strain = 0.525e-3, 1e-4
    sim = cell(length * math.cos(math.radians(degrees)), length, 200.0)
    ends = [pulled(sim, sign * strain) for sign in (1.0, -1.0)]
    modulus = (ends[0][0] - ends[1][0]) / (2.0 * strain) / sim.scene.cloth.spacing
    assert abs(24e-9 / (length**3 * math.sin(math.radians(degrees)) ** 2) / expected - 1.0) < 1e-3
    assert abs(modulus / expected - 1.0) < 0.01
    assert abs(-(ends[0][1] - ends[1][1]) / (2.0 * strain) - 1.0) < 0.01


def test_both_sides_round_yarns_alike() -> None:
    assert ROUND == description.ROUND == 9.0 / 8.0


@pytest.mark.parametrize("crimp", [0.01, 0.05, 0.1])
def test_heights_of_peirce(crimp: float) -> None:
    """h = (4/3) p √c, and h₁ + h₂ = d₁ + d₂ of a cloth at rest, whose yarns neither pull nor press."""
    distance = 0.5e-3
    found = wy.crimp_height(distance, distance * (1.0 + crimp))
    assert abs(found / (4.0 / 3.0 * distance * math.sqrt(crimp)) - 1.0) < 0.03
    sim = cell(distance, distance * (1.0 + crimp), 200.0)
    assert abs(2.0 * found / (4.0 * sim.scene.cloth.radius) - 1.0) < 1e-12
    force, _ = sim.forces()["crimp_interchange"]
    assert np.abs(force).max() < 1e-11 * 200.0
    assert sim.contact()[1].max() < 1e-11 * 200.0


def test_unequal_crimps_have_the_ratio_of_leaf_and_kandil() -> None:
    """ν₁₂ = p₂ tan θ₂/(p₁ tan θ₁) of yarns as long as 1.04 and 1.1 times what they cover, and the reverse."""
    distance, crimps = 0.5e-3, (0.04, 0.1)
    radius = 0.25 * sum(wy.crimp_height(distance, distance * (1.0 + c)) for c in crimps)
    area, found = math.pi * radius**2, []
    for crimp in (crimps, crimps[::-1]):
        c = wy.Cloth(
            wy.Weave.plain(rows=5, columns=5),
            yarns=[wy.Yarn(density=2e-5, stretch=500.0 / area, bend=1e-9 / area)],
            spacing=distance,
            crimp=crimp,
            radius=radius,
            pose="flat",
        )
        sim = wy.Simulator(wy.Scene(c, sliding=False, gravity=None, crimp_interchange=True))
        found.append(-(pulled(sim, 1e-4)[1] - pulled(sim, -1e-4)[1]) / 2e-4)
    tangents = [math.tan(math.acos(1.0 / (1.0 + c))) for c in crimps]
    assert abs(found[0] / (tangents[1] / tangents[0]) - 1.0) < 0.02
    assert abs(found[0] * found[1] - 1.0) < 0.02


def test_soft_until_straight_and_then_stiff() -> None:
    """The knee is at the crimp: far before, the slope is Leaf and Kandil's; beyond, the yarn's own."""
    crimp, stretch = 0.05, 50.0
    sim = cell(0.5e-3, 0.525e-3, stretch)

    def slope(strain: float) -> float:
        return (pulled(sim, strain + 1e-4)[0] - pulled(sim, strain - 1e-4)[0]) / 2e-4

    own = stretch / (1.0 + crimp)
    assert slope(0.0) < 0.03 * own
    # the weft still resists being bent further
    assert 0.9 * own < slope(0.1) < 1.1 * own
    strains = np.linspace(0.0, 0.1, 21)
    forces = [pulled(sim, strain)[0] for strain in strains]
    # where the line of the stiff yarn meets no force
    start = strains[-1] - forces[-1] / slope(0.1)
    assert abs(start - crimp) < 0.2 * crimp
    assert np.all(np.diff(forces) > 0.0)


def test_there_is_nothing_of_it_in_other_scenes() -> None:
    c = cloth("plain")
    sim = wy.Simulator(wy.Scene(c))
    assert "crimp_interchange" not in sim.scene.terms
    assert "stretch" in sim.scene.terms
    assert "stretch" not in scene("plain", None, True).terms
    assert not has_any(sim, "crimp_sides", "crimp_around", "crimp_corners", "contact_offset")


def test_single_precision() -> None:
    case = CrimpCase("twill", "knee", True)
    sim = wy.Simulator(case.simulator("crimp_interchange").scene, precision="single")
    expected = case.simulator("crimp_interchange").forces(case.state)["crimp_interchange"]
    found = sim.forces(case.state)["crimp_interchange"]
    for mine, its in zip(found, expected, strict=True):
        # strains are small differences of lengths of 1e-7
        assert error(mine, its) < 1e-4


def test_modules_of_their_own() -> None:
    """Who has no such scene compiles none of it."""
    kernels = build(Variant(wp.float64, True))
    for name in ("crimp_interchange", "crimp_interchange_energy", "crimped_stretch_load", "crimped_bending_load"):
        assert "crimp" in kernels[name].module.name
    assert "crimp" not in kernels["stretch"].module.name
