"""warp_yarn/presets/fabrics.py: that the named fabrics weigh, bend and shear as the sources say that they stand for."""

import functools
import math
from pathlib import Path

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS, NAMED
from warp_yarn.presets.named import KINDS, UNITS, Datum, NamedFabric, tables

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


# -- of data sheets --------------------------------------------------------------------------------------------------

ROWS, COLUMNS = 9, 10
GENERAL = {"gravity": None, "sliding": False}
named = pytest.mark.parametrize("name", NAMED)


@functools.cache
def specimen(name: str) -> wy.Simulator:
    """A flat piece in a laboratory without gravity."""
    return wy.Simulator(wy.Scene(NAMED[name](rows=ROWS, columns=COLUMNS, pose="flat"), **GENERAL))


def forces(simulator: wy.Simulator, position: np.ndarray) -> np.ndarray:
    """Of all terms on every node, held at a position [nodes, 3] (N)."""
    state = simulator.state
    state.position[:] = position
    return np.sum([force for force, _ in simulator.forces(state).values()], axis=0)


def resistance(simulator: wy.Simulator, held, amount: float) -> float:
    """Of a deformation to its amount, by the work of forces [J per unit of the amount]."""
    rate = (held(1.001 * amount) - held(0.999 * amount)) / (0.002 * amount)
    return -float((forces(simulator, held(amount)) * rate).sum())


def value(name: str, key: str) -> float:
    return NAMED[name].sources[key].value


@named
def test_mass_per_area_is_the_source_s(name):
    """What a cell more weighs: yarns more, less what either adds alone."""
    weighed = [[NAMED[name](rows=r, columns=c).mass for c in (5, 6)] for r in (4, 5)]
    cell = weighed[1][1] - weighed[1][0] - weighed[0][1] + weighed[0][0]
    area = 1e-4 / (value(name, "ends") * value(name, "picks"))
    # the sources' last digit, and that of the sett, are up to 1 % each
    assert cell / area == pytest.approx(value(name, "mass"), rel=0.02)
    assert NAMED[name].mass == pytest.approx(cell / area, rel=1e-9)


@named
@pytest.mark.parametrize("side", ["warp", "weft"])
def test_a_strip_pulls_as_its_yarns(name, side):
    """A tensile test: the force on one clamp over its width, at a strain of 1e-4; the model's straight yarns have
    kₛ (1 + c) each."""
    simulator, strain = specimen(name), 1e-4
    x, along = simulator.scene.cloth.position, ("warp", "weft").index(side)
    strained = x * (1.0 + strain * np.eye(3)[along])
    pulled = forces(simulator, strained).reshape(ROWS, COLUMNS, 3)
    clamp = pulled[:, 0, 0] if along == 0 else pulled[0, :, 1]
    width = len(clamp) / (100.0 * value(name, ("ends", "picks")[along]))
    by_hand = value(name, f"{side}_tension") * (1.0 + NAMED[name].crimp[along]) * len(clamp) / width
    # forces are linear in the strain: what is left is rounding
    assert clamp.sum() / width / strain == pytest.approx(by_hand, rel=1e-6)


def sheared(x: np.ndarray, angle: float) -> np.ndarray:
    """A trellis: weft yarns turn, and no yarn is strained."""
    return np.stack([x[:, 0] + x[:, 1] * math.sin(angle), x[:, 1] * math.cos(angle), 0.0 * x[:, 0]], axis=1)


def trellis(simulator: wy.Simulator, angle: float, area: float) -> float:
    """Force of a picture frame over the length of its sides [N/m]."""
    x = simulator.scene.cloth.position
    rows, columns = simulator.scene.cloth.weave.flipped.shape
    return resistance(simulator, lambda a: sheared(x, a), angle) / ((rows - 2) * (columns - 2) * area)


@named
def test_it_shears_as_its_source_says(name):
    simulator, small = specimen(name), 1e-3
    area = 1e-4 / (value(name, "ends") * value(name, "picks"))
    measured = (trellis(simulator, small, area) - trellis(simulator, -small, area)) / (2.0 * small)
    pressed = simulator.contact()[1][simulator.scene.cloth.topology.crossing_node].mean()
    by_hand = 2.0 * math.pi * simulator.scene.cloth.shear * 0.25 * value(name, "warp_width") * value(name, "weft_width")
    by_hand *= 100.0 * (value(name, "ends") + value(name, "picks"))
    assert by_hand == pytest.approx(value(name, "shear"), rel=1e-9)
    # 1 N is eq. 5's unit; the lock of corners that can jam is 0.996 and more at the right angle
    assert measured == pytest.approx(by_hand * (1.0 + pressed), rel=0.01)
    assert 0.0 < pressed < 0.15  # what docs/fabrics.md says that contact adds


@pytest.mark.parametrize("name", [name for name in NAMED if value(name, "weave") == "plain"])
def test_yarns_of_a_plain_weave_press_as_bent_ones(name):
    """In the middle of a flat piece: ½ (8 k_b arctan t/((1 + c) L² (1 + t²))) of warp and weft, t = thickness/L: what
    bends a zigzag of yarns that pass from side to side."""
    fabric = NAMED[name]
    pressed = specimen(name).contact()[1].reshape(ROWS, COLUMNS)[ROWS // 2, COLUMNS // 2]
    expected = 0.0
    for side, crimp, apart in zip(("warp", "weft"), fabric.crimp, fabric.spacing[::-1], strict=True):
        t = value(name, f"{side}_thickness") / apart
        bend = value(name, f"{side}_bending") / (1.0 + crimp)
        expected += 4.0 * bend * math.atan(t) / (apart**2 * (1.0 + t**2))
    assert pressed == pytest.approx(expected, rel=1e-9)


@named
@pytest.mark.parametrize("side", ["warp", "weft"])
def test_it_bends_as_its_source_says(name, side):
    """Over a cylinder of 0.1 m: the moment over the width, over the curvature, is k_b/((1 + c) L)."""
    simulator, fabric, along = specimen(name), NAMED[name], ("warp", "weft").index(side)
    x, apart = simulator.scene.cloth.position, fabric.spacing[1 - along]
    number = np.round(x[:, along] / apart)

    def wound(curvature: float) -> np.ndarray:
        turn = curvature * apart
        radius = 0.5 * apart / math.sin(0.5 * turn)  # chords are as long as yarns at rest
        result = x.copy()
        result[:, along] = radius * np.sin(turn * number)
        result[:, 2] = radius * (1.0 - np.cos(turn * number))
        return result

    curvature = 10.0
    rows, columns = (ROWS, COLUMNS - 2) if along == 0 else (COLUMNS, ROWS - 2)
    area = rows * columns / (1e4 * value(name, "ends") * value(name, "picks"))
    moment = resistance(simulator, wound, curvature) / area
    expected = value(name, f"{side}_bending") / ((1.0 + fabric.crimp[along]) * fabric.spacing[along])
    assert moment / curvature == pytest.approx(expected, rel=1e-4)  # of the difference that gives the rate


@named
def test_the_mean_of_both_bendings_is_the_cloth_s(name):
    fabric = NAMED[name]
    bendings = [
        value(name, f"{side}_bending") / ((1.0 + crimp) * apart)
        for side, crimp, apart in zip(("warp", "weft"), fabric.crimp, fabric.spacing, strict=True)
    ]
    assert np.mean(bendings) == pytest.approx(value(name, "bending"), rel=1e-9)


@pytest.mark.parametrize(("name", "measured"), [("cotton_shirting", 1.157e-5), ("wool_tropical", 6.57e-6)])
def test_fibres_that_slip_bend_as_measured_within_the_known_factor(name, measured):
    """R_sf T_yarn T_fibre against KES-F (Matsudaira et al. 2015): within 2.5."""
    fabric = NAMED[name]
    free = wy.Yarn.from_tex(value(name, "warp_tex"), value(name, "warp_fibre"))
    bending = free.bend * math.pi * free.radius**2 / (1.0 + fabric.crimp[0])
    of_cloth = bending * 0.5 * sum(1.0 / apart for apart in fabric.spacing)
    assert 1.0 / 2.5 < of_cloth / measured < 2.5
    assert value(name, "bending") == measured


def test_twintex_is_fitted_at_20_degrees_and_predicts_30_and_40():
    """Picture frames of six laboratories, N/mm (Cao et al. 2008): .012 to .044, .030 to .0645, .060 to .137."""
    simulator = specimen("glass_twintex_plain")
    area = 1e-4 / (1.91 * 1.90)
    at_20, at_30, at_40, at_50 = (1e-3 * trellis(simulator, math.radians(a), area) for a in (20, 30, 40, 50))
    assert at_20 == pytest.approx(math.sqrt(0.012 * 0.044), rel=0.02)
    assert 0.030 < at_30 < 0.0645
    assert 0.060 < at_40 < 0.137
    assert at_50 > 0.21  # locked


@named
@pytest.mark.parametrize(("step", "steps"), [(1e-3, 10), (1.0 / 24.0, 2)])
def test_it_is_hung_thrown_and_clamped(name, step, steps):
    """At the defaults: thrown, its centre moves as a thrown point; held, it stays within reach of its pins."""
    flat = NAMED[name](rows=6, columns=7, pose="flat")
    edge = [flat.node(row, column) for row in range(6) for column in (0, 1)]
    wide = float(np.ptp(flat.position, axis=0).max())
    for scene in (wy.paper.hung(flat.replace(pose="upright")), wy.Scene(flat, pins=edge, pin_stiffness=None)):
        moved = wy.Simulator(scene, step=step).run(steps).position[-1] - scene.cloth.position
        assert 1e-9 < np.abs(moved).max() < 2.0 * wide
        assert np.abs(moved[list(scene.pins)]).max() < 1e-2 * wide
    simulator = wy.Simulator(wy.Scene(flat), step=step)
    state = simulator.state
    spinning = np.cross((10.0, -5.0, 20.0), flat.position - flat.position.mean(axis=0))
    state.velocity[:] = spinning + np.array([1.0, 0.5, 2.0])
    simulator.state = state
    thrown = simulator.run(steps)
    mass = np.zeros(flat.nodes)
    yarn = flat.topology.segment_yarn
    of_segments = np.array([each.density for each in flat.yarns])[flat.material[yarn]] * flat.segment_spacing
    for end in flat.topology.segment_nodes.T:
        np.add.at(mass, end, 0.5 * of_segments * (1.0 + flat.yarn_crimp[yarn]))
    centre = mass @ (thrown.position[-1] - thrown.position[0]) / mass.sum()
    t = thrown.time[-1]
    expected = np.array([1.0, 0.5, 2.0]) * t - (0.0, 0.0, 0.5 * 9.8 * t**2)
    # the default is of second order, exact in a steady fall; 1e-4 is what its tolerance leaves (test_free_motion.py)
    assert np.abs(centre - expected).max() < 1e-4 * (9.8 * t**2 + wide)


@named
def test_every_number_has_its_source(name):
    fabric = NAMED[name]
    cloth = fabric()
    assert wy.fabrics.__dict__[name] is fabric and cloth.weave.flipped.shape == (17, 17)
    needed = {"weave", "ends", "picks", "mass", "bending", "shear", "modulus", "friction"}
    of_yarns = ("fibre", "tex", "width", "thickness", "tension", "bending")
    needed |= {f"{side}_{number}" for side in ("warp", "weft") for number in of_yarns}
    assert needed <= set(fabric.sources) <= set(UNITS)
    for datum in fabric.sources.values():
        assert datum.kind in KINDS and len(datum.source) > 5
    # and the cloth is made of just these
    section = [math.pi * half * thick for half, thick in (yarn.halves(math.nan) for yarn in cloth.yarns)]
    for k, side in enumerate(("warp", "weft")):
        yarn = cloth.yarns[k]
        assert 1e6 * yarn.density == pytest.approx(value(name, f"{side}_tex"))
        assert yarn.stretch * section[k] == pytest.approx(value(name, f"{side}_tension"))
        assert yarn.bend * section[k] == pytest.approx(value(name, f"{side}_bending"))
        assert 2.0 * np.array(yarn.halves(math.nan)) == pytest.approx(
            [value(name, f"{side}_width"), value(name, f"{side}_thickness")]
        )
    assert (cloth.shear, cloth.friction) == (value(name, "modulus"), value(name, "friction"))
    assert cloth.weave.name == value(name, "weave")
    assert [*cloth.warp, *cloth.weft] == [0] * 17 + [1] * 17


def test_the_page_has_these_numbers():
    page = (Path(__file__).parents[1] / "docs" / "fabrics.md").read_text()
    assert page.endswith(f"{tables(NAMED)}\n")


def test_pieces_by_size():
    """4.6 ends and 3.2 picks a mm: 20 mm along the warp has 1 + 57 picks, 10 mm along the weft 1 + 52 ends."""
    for size in ((0.02, 0.01), [0.02, 0.01], np.array([0.02, 0.01])):
        cloth = wy.fabrics.cotton_shirting(size=size, pose="flat")
        assert (cloth.weave.rows, cloth.weave.columns) == (1 + 52, 1 + 57)
        assert np.ptp(cloth.position, axis=0) == pytest.approx([0.02, 0.01, 0.0], abs=0.5e-2 / 28.3)
    assert wy.fabrics.denim(size=0.005).weave.columns == 1 + 9
    for options, message in (
        ({"size": 1e-4}, r"size = 0.0001 m makes .*at least 3 × 3"),
        ({"size": -1.0}, "size = -1.0"),
        ({"size": (1.0, 2.0, 3.0)}, r"size = \(1.0, 2.0, 3.0\), must be a number, or two"),
        ({"size": 0.01, "rows": 5}, "goes with neither rows nor columns"),
        ({"size": "1 cm"}, "size = '1 cm'"),
        ({"rows": 2}, "rows = 2"),
        ({"radius": 1e-3}, "radius = 0.001: yarns of cotton shirting"),
    ):
        with pytest.raises(wy.InputError, match=message):
            wy.fabrics.cotton_shirting(**options)


def test_sheets_that_cannot_be():
    sheet = dict(wy.fabrics.denim.sources)
    made_of_others = ("_width", "_thickness", "_tension", "_bending", "modulus")
    made = {key: datum for key, datum in sheet.items() if not key.endswith(made_of_others)}
    assert NamedFabric("again", **{**made, "bending": sheet["bending"]})(rows=4).same_as(wy.fabrics.denim(rows=4))
    for change, message in (
        ({"end": Datum(3.0, "typical", "none")}, "a number of a fabric = 'end', must be one of weave, ends"),
        ({"ends": None}, "ends of again is missing"),
        ({"warp_fibre": Datum("asbestos", "typical", "none")}, "fibre = 'asbestos', must be one of cotton"),
        ({"ends": Datum(60.0, "typical", "none")}, "or they overlap"),
    ):
        changed = {key: datum for key, datum in {**made, **change}.items() if datum is not None}
        with pytest.raises(wy.InputError, match=message):
            NamedFabric("again", **changed)()
    with pytest.raises(wy.InputError, match="kind = 'guessed', must be one of measured"):
        Datum(1.0, "guessed", "none")
    with pytest.raises(wy.InputError, match=r"source of 1\.0 must not be empty"):
        Datum(1.0, "typical", "")
