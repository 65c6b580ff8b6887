"""Yarns of tex, fibre and twist: warp_yarn/description/fibre.py, Yarn.from_tex."""

import dataclasses
import math
import warnings

import numpy as np
import pytest

import warp_yarn as wy

TEX = 20.0


def section(yarn: wy.Yarn) -> float:
    half_width, half_thickness = yarn.halves(math.nan)
    return math.pi * half_width * half_thickness


def test_a_cotton_yarn_is_as_thick_as_peirce_found():
    """d = 0.0374 √tex mm."""
    for tex in (10.0, 20.0, 93.0):
        assert 2e3 * wy.Yarn.from_tex(tex).radius == pytest.approx(0.0374 * math.sqrt(tex), rel=2e-3)


def test_fibres_that_slip_are_a_hundred_times_softer_than_a_solid_rod():
    """Cotton of 20 tex: R_sf T_yarn T_fibre = 0.53 · 20 · 0.17 = 1.8 mN mm²; a rod of its stiffness E π R⁴/4."""
    yarn = wy.Yarn.from_tex(TEX)
    bending = yarn.bend * section(yarn)
    assert bending == pytest.approx(1.8e-9, rel=2e-3)
    rod = yarn.stretch * math.pi * yarn.radius**4 / 4.0
    assert 50.0 < rod / bending < 200.0


def test_flexural_rigidity_of_round_fibres_is_that_of_rods():
    """E/(4 π ρ), of E in N/tex and ρ in g/cm³, of fibres that are round."""
    for name in ("glass yarn", "glass roving", "kevlar km2"):
        fibre = wy.FIBRES[name]
        assert fibre.flexural == pytest.approx(fibre.modulus / (4.0 * math.pi * 1e-3 * fibre.density), rel=0.03)
    for name, across in (("glass yarn", 9e-6), ("glass roving", 17e-6), ("kevlar km2", 12e-6)):
        fibre = wy.FIBRES[name]
        assert fibre.tex == pytest.approx(1e6 * fibre.density * math.pi * across**2 / 4.0, rel=0.03)


def test_kevlar_of_600_den_has_the_tension_of_its_fibres():
    """84.6 GPa on 0.0463 mm²: 3.9 kN."""
    yarn = wy.Yarn.from_tex(66.7, "kevlar km2")
    assert yarn.stretch * section(yarn) == pytest.approx(84.6e9 * 0.0463e-6, rel=2e-3)


def test_twist_costs_tension():
    """cos²α of fibres on helices, tan α = π d twist: at 45 degrees half."""
    free = wy.Yarn.from_tex(TEX)
    twist = 1.0 / (2.0 * math.pi * free.radius)
    twisted = wy.Yarn.from_tex(TEX, twist=twist)
    assert twisted.stretch == pytest.approx(0.5 * free.stretch)
    assert (twisted.bend, twisted.radius) == (free.bend, free.radius)
    # of a flat yarn, that of a round one of its section
    flat = wy.Yarn.from_tex(TEX, width=4.0 * free.radius, thickness=free.radius, twist=twist)
    assert flat.stretch == pytest.approx(twisted.stretch)


def test_a_mixture_stretches_and_bends_as_its_parts_side_by_side():
    parts = {"polyester": 0.65, "cotton": 0.35}
    mixed = wy.Yarn.from_tex(TEX, parts)
    each = {name: wy.Yarn.from_tex(part * TEX, name) for name, part in parts.items()}
    for number in ("stretch", "bend"):
        whole = sum(getattr(yarn, number) * section(yarn) for yarn in each.values())
        assert getattr(mixed, number) * section(mixed) == pytest.approx(whole)
    assert section(mixed) == pytest.approx(sum(section(yarn) for yarn in each.values()))
    # alike fibres are none, whatever they are called
    alike = wy.Yarn.from_tex(TEX, {"cotton": 0.5, **{"viscose": 0.5}})
    assert alike.radius == pytest.approx(wy.Yarn.from_tex(TEX).radius)


def test_what_is_known_of_a_size_is_kept_and_packing_gives_the_rest():
    full = 1e-6 * TEX / 1520.0
    for packing in (None, 0.5):
        of = section(wy.Yarn.from_tex(TEX, packing=packing))
        assert of == pytest.approx(full / (0.6 if packing is None else packing))
        for known in ({"width": 2e-4}, {"thickness": 2e-4}):
            yarn = wy.Yarn.from_tex(TEX, packing=packing, **known)
            assert section(yarn) == pytest.approx(of)
            assert {name: getattr(yarn, name) for name in known} == known
    yarn = wy.Yarn.from_tex(TEX, width=2e-4, thickness=1e-4, color=(1, 0, 0))
    assert (yarn.width, yarn.thickness, yarn.radius, yarn.color) == (2e-4, 1e-4, None, (1.0, 0.0, 0.0))
    assert wy.Yarn.from_tex(TEX, radius=1e-4).radius == 1e-4
    # whatever the size, the yarn pulls and bends as its fibres
    for other in (yarn, wy.Yarn.from_tex(TEX, radius=1e-4)):
        assert other.stretch * section(other) == pytest.approx(6.5 * TEX)
        assert other.bend * section(other) == pytest.approx(0.53e-9 * TEX * 0.17)


def test_a_fibre_of_one_s_own():
    flax = wy.Fibre(density=1500, modulus=18.0, flexural=0.6, tex=0.3)
    yarn = wy.Yarn.from_tex(40.0, flax)
    assert yarn.stretch * section(yarn) == pytest.approx(720.0)
    assert wy.FIBRES["cotton"] != dataclasses.replace(wy.FIBRES["cotton"], tex=0.2)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"tex": 2e-5}, "tex = 2e-05 is less than one fibre"),
        ({"tex": 2e4}, "is a rope, of 20 g a metre"),
        ({"twist": 1e4}, r"turns the fibres at the surface by 79 degrees"),
        ({"radius": 0.08}, r"6.5e-07 fibre, the rest air.*Sizes are in m"),
        ({"width": 8e-5, "thickness": 8e-5}, "is 2.6 fibre"),
    ],
)
def test_numbers_that_make_no_sense_warn(arguments, told):
    with pytest.warns(UserWarning, match=told) as caught:
        wy.Yarn.from_tex(**{"tex": TEX, **arguments})
    assert {warning.filename for warning in caught} == {__file__}


def test_usual_yarns_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in wy.FIBRES:
            for tex in np.geomspace(1.0, 5000.0, 9):
                # a twist factor of 60: crepe
                wy.Yarn.from_tex(float(tex), name, twist=60e2 / math.sqrt(tex))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"tex": 0.0}, "tex = 0.0"),
        ({"tex": "20"}, "tex = '20'"),
        ({"twist": -1.0}, "twist = -1.0"),
        ({"fibre": "steel"}, "fibre = 'steel', must be one of cotton"),
        ({"fibre": {"cotton": 0.5}}, "parts must add up to 1"),
        ({"fibre": {"cotton": 1.5, "wool": -0.5}}, r"fibre\['wool'\] = -0.5"),
        ({"fibre": {}}, "fibre = {}"),
        ({"fibre": 3}, "fibre = 3"),
        ({"packing": 0.95}, "packing = 0.95, must be at most 0.907"),
        ({"packing": 0.0}, "packing = 0.0"),
        ({"packing": 0.5, "radius": 1e-4}, "packing = 0.5 is given, and the size too"),
        ({"radius": 1e-4, "width": 1e-4}, "radius and width are given"),
        ({"radius": 0.0}, "radius = 0.0"),
        ({"thickness": -1e-4}, "thickness = -0.0001"),
        ({"color": (2, 0, 0)}, "color"),
    ],
)
def test_what_cannot_be(arguments, told):
    with pytest.raises(wy.InputError, match=told):
        wy.Yarn.from_tex(**{"tex": TEX, **arguments})


@pytest.mark.parametrize("change", [{"density": 0}, {"tex": -1}, {"packing": 2}, {"modulus": -1}, {"flexural": "x"}])
def test_fibres_that_cannot_be(change):
    with pytest.raises(wy.InputError, match=next(iter(change))):
        wy.Fibre(**{"density": 1500, "modulus": 5, "flexural": 0.5, "tex": 0.2, **change})
