"""Contact forces that feel the tension of crimped yarns."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from cases import Case
from checks import TermChecks, error, natural
from crimped import CrimpCase, cases, cloth

import warp_yarn as wy

PRESSING = ("stretch", "bending", "shear")
TOLERANCE = 1e-12
"""As of the published one: of the normal."""


class TestContact:
    cases = cases(interchange=False)

    def test_normal_and_force(self, case: CrimpCase) -> None:
        normal, force = case.simulator(*PRESSING).contact(case.state)
        expected_normal, expected_force = case.oracle(*PRESSING).contact(case.q)
        assert error(normal, expected_normal) < TOLERANCE
        assert error(force, expected_force, natural(case.cloth, "stretch")) < TOLERANCE

    def test_of_stretch_and_of_bending_alone(self, case: CrimpCase) -> None:
        """A scene that lacks one of the two has the load of the other."""
        for terms in (("stretch", "shear"), ("bending", "shear")):
            force = case.simulator(*terms).contact(case.state)[1]
            expected = case.oracle(*terms).contact(case.q)[1]
            assert error(force, expected, natural(case.cloth, terms[0])) < TOLERANCE


class TestContactOfInterchange:
    cases = cases()

    def test_force(self, case: CrimpCase) -> None:
        """What holds the diameters, and what warp and weft pull with across a cloth that is not flat."""
        terms = ("crimp_interchange", "bending", "shear")
        force = case.simulator(*terms).contact(case.state)[1]
        expected = case.oracle(*terms).contact(case.q)[1]
        assert error(force, expected, natural(case.cloth, "stretch")) < TOLERANCE


class Reads(TermChecks):
    """What reads the contact force follows it, with its derivative; its matrix and right-hand side are as ever."""

    test_matrix = None
    test_right_hand_side = None


class TestShear(Reads):
    term = "shear"
    terms = (*PRESSING,)
    cases = cases(states=("rest", "taut", "random"), interchange=False)


class TestShearOfInterchange(Reads):
    term = "shear"
    terms = ("crimp_interchange", "bending", "shear")
    cases = cases(states=("rest", "taut", "random"))
    step = 2e-9
    tolerance_of_differences = 2e-8
    """As of crimp interchange itself."""


class TestFriction(Reads):
    term = "friction"
    terms = ("stretch", "bending", "friction")
    cases = cases(states=("taut", "random"), sliding=(True,), interchange=False)
    moves_with = "xsvwa"
    step = 1e-9
    tolerance_of_differences = 1e-7
    """As of friction, whose force turns over within 1e-6 m: 1e-16/1e-6 for rounding, of what is 1e-2 of its size."""

    def least(self, case: Case) -> float:
        return np.max(case.cloth.friction_damping)


# -- a fabric under tension ------------------------------------------------------------------------------------------

CRIMP, SPACING, STIFFNESS = 0.01, 0.747e-3, 3.9e3
"""Of Kevlar S706: p [m], kₛ [N]."""


@functools.cache
def s706(contact_force: str, weave: str = "plain") -> wy.Simulator:
    radius = 0.115e-3
    area = math.pi * radius**2
    # 400 fibres that slip: 3.3e-9 N m²
    yarn = wy.Yarn(density=66.7e-6, stretch=STIFFNESS / area, bend=3.3e-9 / area)
    c = wy.Cloth(
        wy.WEAVES[weave](rows=7, columns=7), yarns=[yarn], spacing=SPACING, radius=radius, crimp=CRIMP, pose="flat"
    )
    return wy.Simulator(wy.Scene(c, contact_force=contact_force))


def pulled(sim: wy.Simulator, tension: float) -> tuple[wy.State, float]:
    """All yarns with this tension, and the distance of crossings then."""
    # in a cloth whose yarns keep their crimp, kₛ times the strain times 1 + c
    strain = tension / (STIFFNESS * (1.0 + CRIMP))
    state = dataclasses.replace(sim.state, position=sim.scene.cloth.position * (1.0 + strain))
    border = sim.forces(state)["stretch"][0][sim.scene.cloth.node(3, 0)]
    assert abs(border[0] - tension) < 1e-9 * tension + 1e-9
    return state, SPACING * (1.0 + strain)


@pytest.mark.parametrize("tension", [1.0, 10.0, 19.5, 50.0, 100.0])
def test_a_flat_cloth_feels_tension(tension: float) -> None:
    """F_n = 2 T sin θ, tan θ = h/p and h = (4/3) p √c as woven, as a thread over its crossings; yarns' bending and
    √(1 + c/2) in h are the rest."""
    sim = s706("crimped")
    state, distance = pulled(sim, tension)
    height = 4.0 / 3.0 * SPACING * math.sqrt(CRIMP)
    expected = 2.0 * tension * math.sin(math.atan2(height, distance))
    middle = sim.scene.cloth.node(3, 3)
    assert abs(sim.contact(state)[1][middle] / expected - 1.0) < 0.05


def test_the_published_one_does_not() -> None:
    """Its stretch forces lie in the plane: 100 N or 1 N change nothing but how far apart crossings are."""
    sim = s706("published")
    middle = sim.scene.cloth.node(3, 3)
    low, high = (sim.contact(pulled(sim, tension)[0])[1][middle] for tension in (1.0, 100.0))
    assert high < low < 0.2


def test_floats_do_not_press() -> None:
    """In a twill a yarn rises over every other segment, T sin θ each."""
    plain, twill = s706("crimped"), s706("crimped", "twill")
    middle = plain.scene.cloth.node(3, 3)
    found = [sim.contact(pulled(sim, 50.0)[0])[1][middle] for sim in (plain, twill)]
    assert abs(found[1] / found[0] - 0.5) < 0.01


def test_heights_of_both_yarns_make_it() -> None:
    """Half of each: yarns of the weft without crimp leave the warp's half."""
    c = cloth("plain")
    forces = []
    for crimp in ((0.04, 0.04), (0.04, 0.0)):
        crimped = c.replace(crimp=crimp)
        sim = wy.Simulator(wy.Scene(crimped, contact_force="crimped", terms=("stretch", "shear")))
        state = dataclasses.replace(sim.state, position=1.1 * crimped.position)
        forces.append(sim.contact(state)[1][crimped.node(2, 2)])
    assert 0.4 < forces[1] / forces[0] < 0.6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contact_force": "tension"}, "contact_force = 'tension', must be one of"),
        ({"contact_force": "crimped", "crimp_interchange": True}, "must be 'published' with crimp_interchange"),
    ],
)
def test_options_that_are_refused(options: dict, message: str) -> None:
    with pytest.raises(wy.InputError, match=message):
        wy.Scene(cloth("plain"), **options)


@pytest.mark.parametrize("options", [{"contact_force": "crimped"}, {"crimp_interchange": True}])
def test_cloths_without_crimp_are_refused(options: dict) -> None:
    with pytest.raises(wy.InputError, match="the cloth has no crimp, must be above 0"):
        wy.Scene(cloth("plain").replace(crimp=0.0), **options)


def test_yarns_that_do_not_bend_are_refused() -> None:
    yarns = [dataclasses.replace(cloth("plain").yarns[0], bend=0.0)]
    with pytest.raises(wy.InputError, match=r"yarns\[0\].bend = 0, must be above 0"):
        wy.Scene(cloth("plain").replace(yarns=yarns), crimp_interchange=True)
    wy.Scene(cloth("plain").replace(yarns=yarns), contact_force="crimped")


@pytest.mark.parametrize("options", [{"contact_force": "crimped"}, {"crimp_interchange": True}, {}])
def test_recordings_keep_it(options: dict, tmp_path) -> None:
    sim = wy.Simulator(wy.Scene(cloth("plain"), sliding=False, **options))
    sim.run(2).save(tmp_path / "run.npz")
    found = wy.Trajectory.load(tmp_path / "run.npz").scene
    assert found.same_as(sim.scene)
    assert found.terms == sim.scene.terms
    others = [wy.Scene(cloth("plain"), sliding=False, **other) for other in ({"contact_force": "crimped"}, {})]
    assert sum(found.same_as(other) for other in others) == (0 if "crimp_interchange" in options else 1)
