"""warp_yarn/presets/fabrics.py: that the named fabrics weigh, bend and shear as the sources say that they stand for."""

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS

GF = 9.80665e-3
"""N: the force of the textile laboratories' units."""


def laboratory(cloth: wy.Cloth) -> dict[str, float]:
    """What a laboratory would measure: kg/m², N m of bending along a yarn's direction, N/m a radian of shear."""
    (yarn,) = cloth.yarns
    section = np.pi * cloth.radius**2
    return {
        "mass": 2.0 * yarn.density / cloth.spacing,
        "bending": yarn.bend * section / cloth.spacing,
        # four corners a node, each ½ S π R² L (φ − π/2)², on the area L²
        "shear": 4.0 * cloth.shear * section / cloth.spacing,
    }


def test_cotton_is_what_shirts_are_made_of():
    cloth = wy.fabrics.cotton(rows=5, columns=6)
    measured = laboratory(cloth)
    assert 0.08 < measured["mass"] < 0.13
    # KES-F of cotton broad cloth: 0.118 gf cm²/cm (Matsudaira et al. 2015)
    assert measured["bending"] == pytest.approx(0.118 * GF * 1e-2, rel=0.05)
    # apparel: 0.5 to 2.5 gf/(cm deg)
    assert 0.5 < measured["shear"] / (GF / 1e-2 / np.radians(1.0)) < 2.5
    # Peirce: 0.0374 √tex mm is the diameter of a cotton yarn
    assert 2.0 * cloth.radius == pytest.approx(0.0374e-3 * np.sqrt(20.0), rel=0.05)
    assert cloth.stretch_stiffness == pytest.approx([20.0])
    assert cloth.spacing == pytest.approx(1.0 / 2300.0)


def test_a_handkerchief_is_a_soft_open_cloth():
    cloth = wy.fabrics.handkerchief(rows=5, columns=6)
    measured = laboratory(cloth)
    assert measured["mass"] == pytest.approx(0.1)
    # the middle half of 618 fabrics, along the warp (Feng 2022)
    assert 4.1e-6 < measured["bending"] < 3.6e-5
    assert cloth.stretch_stiffness == pytest.approx([3.0])
    assert 2.0 * cloth.radius < cloth.spacing


@pytest.mark.parametrize("name", FABRICS)
def test_fabrics_are_made_alike(name):
    cloth = FABRICS[name](rows=4, columns=5, weave="twill", pose="flat", friction=0.2)
    assert (cloth.weave.name, cloth.weave.rows, cloth.weave.columns) == ("twill", 4, 5)
    assert cloth.friction == 0.2
    assert not cloth.position[:, 2].any()
    with pytest.raises(wy.InputError, match=r"weave = 'knit'.*plain"):
        FABRICS[name](rows=4, columns=5, weave="knit")
    with pytest.raises(wy.InputError, match=r"rows = 2.*at least 3"):
        FABRICS[name](rows=2)
    with pytest.raises(wy.InputError, match="radius"):
        FABRICS[name](radius=1e-3)


@pytest.mark.parametrize("name", FABRICS)
def test_fabrics_fall_and_hang(name):
    """Let go by two corners for 2 ms: nothing has moved farther than a free fall, and gravity has pulled."""
    cloth = FABRICS[name](rows=5, columns=5, pose="flat")
    moved = wy.Simulator(wy.Scene(cloth, pins=cloth.corners("top"))).run(2).position[-1] - cloth.position
    # implicit Euler, the least exact of the methods, falls by 1.5 times ½ g t² in two steps
    assert -1.6 * 0.5 * 9.8 * 2e-3**2 < moved[:, 2].min() < -1e-6
