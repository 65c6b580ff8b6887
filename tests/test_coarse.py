"""Coarse cloths: what they keep of the fine ones, measured on both by the simulator's own energies and forces."""

import dataclasses
import math

import numpy as np
import pytest
from inputs import EXACT

import warp_yarn as wy

FABRICS = {
    "handkerchief": lambda **options: wy.fabrics.handkerchief(**options),
    "cotton twill": lambda **options: wy.fabrics.cotton(weave="twill", **options),
    "denim": lambda **options: wy.fabrics.denim(**options),
}
"""Plain with round yarns; floats; crimped, and another sett and yarn along warp and weft."""
ROUNDING = 1e-12
"""Of sums over some hundreds of crossings."""


def made(name: str, n: int, rows: int = 17, columns: int = 25) -> wy.Cloth:
    return FABRICS[name](rows=rows, columns=columns, pose="flat").coarsened(n)


def energies(c: wy.Cloth, position: np.ndarray) -> dict[str, float]:
    simulator = wy.Simulator(wy.Scene(c, gravity=None), integrator="linear")
    return simulator.energy(dataclasses.replace(simulator.state, position=position))


def bent(c: wy.Cloth, radius: float, along: int) -> np.ndarray:
    """The cloth round a cylinder."""
    x = c.position.copy()
    angle = x[:, along] / radius
    x[:, along], x[:, 2] = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    return x


each = pytest.mark.parametrize("name", FABRICS)
factor = pytest.mark.parametrize("n", [2, 4, 8])


@each
@factor
def test_mass_and_size(name: str, n: int) -> None:
    fine, coarse = made(name, 1), made(name, n)
    assert coarse.nodes == (16 // n + 1) * (24 // n + 1)
    assert coarse.mass == pytest.approx(fine.mass, rel=ROUNDING)
    assert coarse.size == pytest.approx(fine.size, rel=ROUNDING)
    assert coarse.half_thickness == pytest.approx(fine.half_thickness, rel=ROUNDING)
    # where it is: the centre of mass
    gravity = [wy.Simulator(wy.Scene(c, terms=["gravity"])).forces()["gravity"][0][:, 2] for c in (fine, coarse)]
    centres = [force @ c.position[:, :2] / force.sum() for force, c in zip(gravity, (fine, coarse), strict=True)]
    assert centres[1] == pytest.approx(centres[0], rel=ROUNDING)


@each
@factor
@pytest.mark.parametrize("along", [0, 1])
def test_tension(name: str, n: int, along: int) -> None:
    """Work of a uniform strain, along the warp or the weft."""
    strain = np.ones(3)
    strain[along] = 1.01
    work = [energies(c, c.position * strain)["stretch"] for c in (made(name, 1), made(name, n))]
    assert work[1] == pytest.approx(work[0], rel=1e-10)


@each
@factor
def test_shear(name: str, n: int) -> None:
    """Work of a uniform shear of the flat cloth. What F_n changes of it with the angle, 1 − cos γ ≈ 2e-4 of F_n up to
    0.1 N, is of another size in the coarse cloth."""
    work = []
    for c in (made(name, 1), made(name, n)):
        x = c.position.copy()
        x[:, 0] += 0.02 * x[:, 1]
        work.append(energies(c, x)["shear"])
    assert work[1] == pytest.approx(work[0], rel=3e-4)


@each
@factor
@pytest.mark.parametrize("along", [0, 1])
def test_bending(name: str, n: int, along: int) -> None:
    """Work round a cylinder, per bend a length of the cloth: ½ k_b/(L (1 + c)) κ² an area, and the same of both. A bend
    at a coarse distance d is of chords, d²κ²/12 off the arc."""
    radius, work, lengths = 0.2, [], []
    for c in (made(name, 1), made(name, n)):
        count = (c.weave.columns, c.weave.rows)[along]
        work.append(energies(c, bent(c, radius, along))["bending"])
        lengths.append(c.size[along] * (count - 2) / (count - 1))
    assert work[1] / lengths[1] == pytest.approx(work[0] / lengths[0], rel=(lengths[1] / radius) ** 2 / 12.0 + 1e-6)
    # by hand: all yarns along, k_b = B π a b
    fine = made(name, 1)
    mine = fine.topology.yarn_direction == along
    k_b = sum(
        fine.yarns[material].bend * math.pi * halves.prod() / (1.0 + crimp)
        for material, halves, crimp in zip(fine.material[mine], fine.halves[mine], fine.yarn_crimp[mine], strict=True)
    )
    assert work[1] / lengths[1] == pytest.approx(0.5 * k_b / radius**2, rel=1e-2)


@each
@factor
def test_friction_of_the_flat_cloth(name: str, n: int) -> None:
    """μ F_n and springs of all crossings."""
    sums = []
    for c in (made(name, 1), made(name, n)):
        at = c.topology.crossing_node
        force = wy.Simulator(wy.Scene(c, gravity=None), integrator="linear").contact()[1]
        sums.append([(c.at_nodes("friction") * force)[at].sum(), c.at_nodes("friction_stiffness")[at].sum()])
    assert sums[1] == pytest.approx(sums[0], rel=1e-10)


@each
def test_corners_lock_at_the_same_angle(name: str) -> None:
    fine, coarse = made(name, 1), made(name, 4)
    assert np.ptp(coarse.corner_lock) < 1e-12
    assert coarse.corner_lock[0, 0] == pytest.approx(fine.corner_lock[0, 0], rel=1e-12)


def test_numbers_of_their_own_are_shared_out() -> None:
    """Yarns of two materials, distances and crossings that differ: sums and their first moments stay."""
    rng = np.random.default_rng(5)
    yarns = [
        wy.Yarn(density=2e-4, stretch=5e6, bend=1e-4, radius=2e-4, color=(1, 0, 0)),
        wy.Yarn(density=3e-4, stretch=2e6, bend=2e-4, width=4e-4, thickness=2e-4),
    ]
    warp, weft = rng.integers(0, 2, 9), rng.integers(0, 2, 13)
    fine = wy.Cloth(
        wy.Weave.plain(rows=9, columns=13),
        yarns=yarns,
        warp=warp,
        weft=weft,
        spacing=(rng.uniform(8e-4, 1.2e-3, 8), rng.uniform(8e-4, 1.2e-3, 12)),
        crimp=(0.02, rng.uniform(0.0, 0.05, 13)),
        friction_damping=rng.uniform(0.1, 0.2, 117),
        shear=[[700.0, 400.0], [500.0, 1200.0]],
        pose="flat",
    )
    coarse = fine.coarsened(4)
    assert coarse.mass == pytest.approx(fine.mass, rel=ROUNDING)
    for along in (0, 1):
        strain = np.ones(3)
        strain[along] = 1.01
        work = [energies(c, c.position * strain)["stretch"] for c in (fine, coarse)]
        assert work[1] == pytest.approx(work[0], rel=1e-10)
    damping = [c.at_nodes("friction_damping")[c.topology.crossing_node].sum() for c in (fine, coarse)]
    assert damping[1] == pytest.approx(damping[0], rel=ROUNDING)
    # a coarse yarn stands where every fourth is, and has its colour
    assert np.array_equal(coarse.position, fine.position.reshape(9, 13, 3)[::4, ::4].reshape(-1, 3))
    assert [coarse.yarns[k].color for k in coarse.warp] == [yarns[k].color for k in warp[::4]]


def test_a_pose_is_that_of_every_nth_yarn() -> None:
    fine = made("handkerchief", 1)
    posed = fine.replace(pose=bent(fine, 0.1, 0))
    assert np.array_equal(posed.coarsened(8).position, posed.position.reshape(17, 25, 3)[::8, ::8].reshape(-1, 3))


def test_one_is_the_same_cloth() -> None:
    fine = made("denim", 1)
    assert fine.coarsened(1) is fine


@pytest.mark.parametrize(
    ("n", "message"),
    [(0, "n = 0"), (3, "n = 3, must divide the 16 distances between 17 rows"), (16, "two or more"), (1.5, "n = 1.5")],
)
def test_bad_factors(n: float, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        made("denim", 1).coarsened(n)


def test_what_feels_crimp_refuses_it() -> None:
    coarse = made("denim", 4)
    for options in ({"crimp_interchange": True}, {"contact_force": "crimped"}):
        with pytest.raises(wy.InputError, match="no crimp"):
            wy.Scene(coarse, **options)


def test_what_is_cut_refuses() -> None:
    c = made("handkerchief", 1)
    with pytest.raises(wy.InputError, match="coarsen it first"):
        c.cut(wy.outline.disc(7e-3, center=c.middle)).coarsened(2)


def test_pieces() -> None:
    """Of half as many yarns, and as heavy to within the yarn at each end of a row."""
    fine, coarse = (wy.piece(wy.fabrics.handkerchief, wy.outline.disc(0.02), coarsened=n, pose="flat") for n in (1, 2))
    assert coarse.nodes < 0.35 * fine.nodes
    assert coarse.mass == pytest.approx(fine.mass, rel=0.03)
    # 100 g/m²
    assert fine.mass == pytest.approx(0.1 * math.pi * 0.02**2, rel=0.03)


@pytest.mark.parametrize("name", ["handkerchief", "denim"])
def test_a_coarse_strip_sags_as_the_fine_one(name: str) -> None:
    """Clamped at one end, under its weight, at rest: w ℓ⁴/8B while that is small. The bend at the clamp is that of a
    whole distance d, of which half is held, so that ℓ is longer by d/2."""
    tips, free = [], 28.0
    for n in (1, 2, 4):
        c = FABRICS[name](rows=9, columns=33, pose="flat").coarsened(n)
        u = c.rest_grid[:, 0]
        clamped = np.flatnonzero(u <= u.max() / 8.0 + 1e-9).tolist()
        scene = wy.Scene(c, pins=clamped, pin_stiffness=None, sliding=False)
        simulator = wy.Simulator(scene, integrator="linear", step=2e-2, tolerance=EXACT)
        simulator.run(60)
        tips.append(simulator.state.position[u == u.max(), 2].mean())
    assert tips[0] < -1e-3
    for n, tip in ((2, tips[1]), (4, tips[2])):
        assert tip / tips[0] == pytest.approx(((free + 0.5 * n) / (free + 0.5)) ** 4, rel=0.03)
