"""Friction that sticks and slips: a yarn pulled out of a weave, and yarns under a steady pull."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scripts import exit_code, load

import warp_yarn as wy

pullout = load("scenes/pullout.py")
MOTION = {"speed": 5e-4, "distance": 1e-5}
VIBRATION = 0.05
"""Of the yarn, √(k m) v = 1.5e-5 N at 0.5 mm/s, relative to the limit of three crossings, 4.4e-4 N."""


@functools.cache
def pulled(step: float = 1e-3, **options: object) -> pullout.Pull:
    return pullout.pull(pullout.cloth(size=5), **MOTION, step=step, **options)


def limit() -> float:
    """Σ μ F_n of the yarn."""
    return float(pullout.cloth(size=5).friction * pulled().limit[0])


def test_breaks_away_at_the_limit_and_slips_at_it() -> None:
    """As exact Coulomb friction, but for the yarn's vibration."""
    found = pulled()
    exact = pullout.coulomb(pullout.cloth(size=5), found.contact, found.distance)
    assert found.force.max() == pytest.approx(limit(), rel=VIBRATION)
    assert found.force[10:] == pytest.approx(limit(), rel=VIBRATION)
    assert np.abs(found.force - exact).max() < VIBRATION * limit()
    # it sticks first: no crossing slides by its spring's reach until the yarn has stretched
    assert found.slid[1].min() < 0.1 * found.distance[1]
    assert found.slid[-1].min() > 0.7 * found.distance[-1]


def test_the_same_for_steps_of_1_ms_and_of_a_tenth() -> None:
    coarse, fine = pulled(), pulled(1e-4)
    assert np.abs(coarse.force - fine.force[::10]).max() < VIBRATION * limit()
    assert coarse.force[10:].mean() == pytest.approx(fine.force[100:].mean(), rel=0.01)


def test_published_scaling_neither_sticks_nor_slips() -> None:
    """A spring all the way: it neither breaks away at the limit nor keeps a level."""
    published = pulled(published_scaling=True)
    assert np.diff(published.force).min() > 0.0
    assert published.force[-1] > 1.5 * limit()


def test_ranks_of_the_weaves() -> None:
    """Plain above twill and satin, and denser above looser, as measured on real cloth."""
    forces = {}
    for weave in ("plain", "twill", "satin"):
        for size, spacing in ((7, 1e-3), (5, 1.5e-3)):
            fabric = pullout.cloth(weave, size, spacing=spacing)
            forces[weave, size] = pullout.pull(fabric, **MOTION, step=1e-3).force.max()
    assert forces["plain", 7] > 2.0 * max(forces["twill", 7], forces["satin", 7])
    assert forces["plain", 5] > max(forces["twill", 5], forces["satin", 5])
    assert all(forces[weave, 7] > 1.5 * forces[weave, 5] for weave in ("plain", "twill", "satin"))


@pytest.mark.parametrize(("share", "slides"), [(0.9, False), (1.1, True)])
def test_steady_pull(share: float, slides: bool) -> None:
    """A yarn under a steady force on its end stays a little under its limit, and slides ever faster a little above."""
    fabric = pullout.cloth(size=5)
    row = 2
    free = [fabric.node(row, 0), fabric.node(row, -1)]
    pins = [node for node in range(fabric.nodes) if node not in free]
    # the weft yarn at the pulled end must not hold it either
    fabric = wy.Cloth(
        fabric.weave,
        yarns=fabric.yarns,
        warp=[0] * 5,
        weft=[1, 0, 0, 0, 1],
        pose="flat",
        friction_damping=pullout.DAMPING,
    )
    start = wy.Scene(fabric, gravity=None, pins=pins, pin_stiffness=None)
    load = float(wy.Simulator(start).contact()[1][[fabric.node(row, i) for i in (1, 2, 3)]].sum())
    force = (share * fabric.friction * load, 0.0, 0.0)
    scene = wy.Scene(fabric, gravity=None, pins=pins, pin_stiffness=None, forces={free[1]: force})
    trajectory = wy.Simulator(scene, integrator="sdirk2").run(20 if slides else 15)
    slid = fabric.euler[fabric.node(row, 1), 0] - trajectory.euler[:, fabric.node(row, 1), 0]
    if slides:
        assert slid[-1] > 1e-4
        assert slid[-1] > 2.0 * slid[12]
    else:
        # stretched by the pull, and then at rest
        assert np.abs(slid[12:] - slid[-1]).max() < 1e-9
        assert 0.0 <= slid[-1] < 5e-6


@pytest.mark.slow
def test_command_writes_a_chart_and_numbers(tmp_path) -> None:
    png, csv = tmp_path / "a.png", tmp_path / "a.csv"
    options = ["--size", "5", "--distance", "5e-6", "--png", str(png), "--csv", str(csv)]
    assert exit_code(pullout, options) == 0
    assert png.read_bytes().startswith(b"\x89PNG")
    assert len(csv.read_text().splitlines()) == 1 + 6 + 51 + 6 + 6
    assert exit_code(pullout, ["--size", "3"]) == 2
