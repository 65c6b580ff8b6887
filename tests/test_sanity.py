"""Numbers that are likely in another unit are warned of, and none that real fabrics have; what cannot be changed says
so."""

import pickle
import re
import warnings

import numpy as np
import pytest

import warp_yarn as wy
from warp_yarn.presets.fabrics import FABRICS


def cloth(area: float, spacing: float = 1e-3, radius: float | None = None) -> wy.Cloth:
    """A cloth of so many kg/m²: two yarns cross in each square of the spacing."""
    yarn = wy.Yarn(density=area * spacing / 2.0, stretch=1e7, bend=1e-3)
    radius = spacing / 4.0 if radius is None else radius
    return wy.Cloth(wy.Weave.plain(rows=4, columns=5), yarns=[yarn], spacing=spacing, radius=radius)


FINE = {
    **{name: make for name, make in FABRICS.items()},
    "paper's 4.8 kg/m2": lambda: cloth(4.8),
    "kevlar, 180 g/m2 of 17 x 17 in 25.4 mm": lambda: cloth(0.18, 25.4e-3 / 17),
    "glass, 1.8 kg/m2": lambda: cloth(1.8, 5e-3),
    "carbon spread tow, 80 g/m2 of tapes of 20 mm": lambda: cloth(0.08, 20e-3),
    "silk chiffon, 12 g/m2": lambda: cloth(0.012, 2.5e-4),
    "parachute nylon, 33 g/m2": lambda: cloth(0.033, 2e-4),
    "a fishing net": lambda: cloth(0.05, 4e-2, 1e-3),
    "conveyor belt, 12 kg/m2": lambda: cloth(12.0, 6e-3),
}


@pytest.mark.parametrize("make", FINE.values(), ids=FINE)
def test_real_fabrics_raise_no_alarm(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fabric = make()
        wy.Scene(fabric, wind=wy.Wind(velocity=(0, 60, 0)), gravity=(0, 0, -25.0))
        wy.Scene([fabric, fabric.replace(pose=fabric.position + 1.0)])


WRONG = {
    "spacing in mm": (lambda: cloth(0.1, 1.0, 0.5), r"spacing = 1 m, usual is 1e-05 to 0.05 m: .* 1e-3 for a milli"),
    "radius in mm": (lambda: cloth(0.1, 1.0, 0.5), r"radius = 0.5 m, usual is 1e-06 to 0.02 m"),
    "spacing in km": (lambda: cloth(0.1, 1e-6), r"spacing = 1e-06 m"),
    "1 g/m2": (lambda: cloth(1e-3), r"make a cloth of 1 g/m², fabrics have 2 to 30000 g/m²: is density in kg/m\?"),
    "100 kg/m2": (lambda: cloth(100.0), r"make a cloth of 1e\+05 g/m²"),
    "tex for kg/m": (lambda: cloth(2e4), "1 tex is 1e-6 kg/m"),
    "gravity in mm": (
        lambda: wy.Scene(cloth(0.1), gravity=(0, 0, -9800)),
        r"gravity = 9800 m/s², usual is at most 200",
    ),
    "one row of it": (lambda: wy.Scene(cloth(0.1), gravity=[(0, 0, -9.8), (0, 980, 0)]), "gravity = 980 m/s²"),
    "wind in mm": (lambda: wy.Wind(velocity=(0, 5000, 0)), "wind velocity = 5000 m/s, usual is at most 350 m/s"),
}


@pytest.mark.parametrize("name", WRONG)
def test_another_unit_is_warned_of(name):
    make, message = WRONG[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    assert all(issubclass(warning.category, wy.WarpYarnWarning) for warning in caught)
    assert any(re.search(message, str(warning.message)) for warning in caught)


def test_a_warning_names_the_line_that_made_it():
    with pytest.warns(wy.WarpYarnWarning) as caught:
        cloth(1e-3)
    assert caught[0].filename == __file__


TAPE = {"density": 2e-4, "stretch": 1e7, "bend": 1e-3}


def uneven(gap: float = 1e-3, crimp: float = 0.1, **size: float) -> wy.Cloth:
    """A cloth of unequal distances, of a yarn with a size of its own and one without."""
    yarns = [wy.Yarn(**TAPE), wy.Yarn(**TAPE, **size)]
    spacing = [1e-3, gap, 1e-3], 2e-3
    return wy.Cloth(wy.Weave.plain(rows=4, columns=5), yarns=yarns, spacing=spacing, radius=2e-4, crimp=(0.0, crimp))


WRONG_UNEVEN = {
    "a gap in mm": ({"gap": 1.0}, r"^spacing = 1 m, usual"),
    "a gap in km": ({"gap": 1e-6, "radius": 1e-7}, None),
    "a yarn's radius": ({"radius": 5e-7}, r"^radius = 5e-07 m, usual is 1e-06 to 0.02 m"),
    "a yarn's width": ({"width": 1e-3, "thickness": 1e-6}, r"^thickness = 1e-06 m, usual is 2e-06 to 0.04 m"),
    "crimp in %": ({"crimp": 8.0}, r"^crimp = 8, usual is at most 0.6: it has to be a part of the distance"),
}


@pytest.mark.parametrize("name", WRONG_UNEVEN)
def test_one_number_of_several_is_warned_of(name):
    given, message = WRONG_UNEVEN[name]
    if message is None:  # yarns of the cloth's own radius would overlap there
        with pytest.raises(wy.InputError, match="overlap"):
            uneven(**given)
        return
    with pytest.warns(wy.WarpYarnWarning, match=message) as caught:
        uneven(**given)
    assert len(caught) == 1 and caught[0].filename == __file__


@pytest.mark.filterwarnings("error")
def test_uneven_cloths_raise_no_alarm():
    uneven()
    uneven(width=8e-4, thickness=1e-4)
    wy.Scene([uneven(), uneven(radius=1e-4).replace(pose=uneven().position + 1.0)])


def test_counts_of_yarns_are_warned_of_alike():
    with pytest.warns(wy.WarpYarnWarning, match="tex is g/km"):
        wy.Yarn.from_tex(3e4)


def apart(distance: float) -> wy.Scene:
    """Two cloths whose edges are sewn together, so many spacings apart."""
    upper = wy.fabrics.handkerchief(rows=4, columns=4, pose="flat")
    lower = upper.replace(pose=upper.position + np.array([0.0, (3.0 + distance) * upper.spacing, 0.0]))
    return wy.Scene([upper, lower], seams=[[upper.node(-1, k), upper.nodes + lower.node(0, k)] for k in range(4)])


def carried(first: float, later: float = 0.1, steps: int = 5) -> wy.Scene:
    """A cloth whose pins move so many spacings in the first step, and in each later one."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4)
    way = cloth.spacing * (first + later * np.arange(steps))
    path = cloth.position[[0, 3]] + way[:, None, None] * np.array([0.0, 0.6, 0.8])
    return wy.Scene(cloth, pins=[0, 3], pin_path=path)


def rolling(first: float, later: float = 0.1, steps: int = 5) -> wy.Scene:
    """The same of a ball."""
    cloth = wy.fabrics.handkerchief(rows=4, columns=4)
    way = cloth.spacing * (first + later * np.arange(steps))
    center = np.array([0.0, 0.0, -0.1])
    balls = [wy.Sphere(center=center, radius=0.01, path=center + way[:, None] * [1.0, 0.0, 0.0])]
    return wy.Scene(cloth, obstacles=[wy.Plane(point=(0, 0, -1), normal=(0, 0, 1)), *balls])


FAR = {
    "seams": (lambda: apart(20.0), r"seams\[0\] = \[12, 16\] are 0.02 m apart at the start, 20 spacings: .* pin_path"),
    "pins": (lambda: carried(8.0), r"pin_path begins 0.008 m from its pins, 8 spacings: a jump .* begin"),
    "pins at once": (lambda: carried(8.0, steps=1), r"pin_path begins 0.008 m from its pins, 8 spacings"),
    "obstacle": (lambda: rolling(8.0), r"path of obstacles\[1\] begins 0.008 m from it, 8 spacings: a jump"),
}
NEAR = {
    "seams": lambda: apart(1.1),
    "pins": lambda: carried(1.0),
    "pins that fly": lambda: carried(8.0, 8.0),
    "obstacle": lambda: rolling(1.0),
    "a ball that flies": lambda: rolling(8.0, 8.0),
}


@pytest.mark.parametrize("name", FAR)
def test_what_is_far_at_the_start_is_warned_of(name):
    make, message = FAR[name]
    with pytest.warns(wy.WarpYarnWarning, match=message) as caught:
        make()
    assert len(caught) == 1 and caught[0].filename == __file__


@pytest.mark.parametrize("make", NEAR.values(), ids=NEAR)
@pytest.mark.filterwarnings("error")
def test_what_is_near_is_not(make):
    make()


PLANE = {"point": (0, 0, 0), "normal": (0, 0, 1)}
THINGS = {
    "weave": (lambda: wy.Weave.plain(rows=4, columns=4), "name", "other"),
    "yarn": (lambda: wy.paper.YARNS[1], "stretch", 1.0),
    "fibre": (lambda: wy.FIBRES["cotton"], "tex", 0.2),
    "draft": (lambda: wy.Draft(threading=[[1], [2]], treadling=[[1], [2]]), "name", "other"),
    "cloth": (lambda: wy.paper.cloth(rows=4, columns=4), "radius", 4e-4),
    "wind": (lambda: wy.Wind(velocity=(0, 1, 0)), "velocity", (0.0, 2.0, 0.0)),
    "contact": (wy.Contact, "friction", 0.1),
    "plane": (lambda: wy.Plane(**PLANE), "friction", 0.1),
    "sphere": (lambda: wy.Sphere(center=(0, 0, 0), radius=1.0), "friction", 0.1),
    "capsule": (lambda: wy.Capsule(start=(0, 0, 0), end=(1, 0, 0), radius=1.0), "friction", 0.1),
    "cylinder": (lambda: wy.Cylinder(start=(0, 0, 0), end=(1, 0, 0), radius=1.0), "friction", 0.1),
    "box": (lambda: wy.Box(center=(0, 0, 0), half_extents=(1, 1, 1)), "friction", 0.1),
    "scene": (lambda: wy.Scene(wy.paper.cloth(rows=4, columns=4)), "gravity", None),
}


@pytest.mark.parametrize("name", THINGS)
def test_what_simulators_would_not_see_cannot_be_set(name):
    make, attribute, value = THINGS[name]
    thing = make()
    before = getattr(thing, attribute)
    for act in (lambda: setattr(thing, attribute, value), lambda: delattr(thing, attribute)):
        with pytest.raises(wy.NoAttributeError, match=rf"{name}\.{attribute} cannot be"):
            act()
    with pytest.raises(wy.NoAttributeError, match=rf"{name}\.replace\({attribute}=...\)"):
        setattr(thing, attribute, value)
    assert getattr(thing, attribute) is before
    assert getattr(thing.replace(**{attribute: value}), attribute) == value
    assert getattr(thing, attribute) is before
    with pytest.raises(wy.InputError, match=r"replace\(colour=...\): must be one of"):
        thing.replace(colour=1)
    again = pickle.loads(pickle.dumps(thing))
    with pytest.raises(wy.NoAttributeError):
        setattr(again, attribute, value)


def test_cloths_and_arrays_cannot_be_changed():
    fabric = wy.paper.cloth(rows=4, columns=4)
    cloths = wy.Cloths([fabric])
    with pytest.raises(wy.NoAttributeError):
        cloths.radius = 1.0
    scene = wy.Scene(fabric, gravity=np.array([0.0, 0.0, -9.8]), pins=[0], pin_path=np.zeros((2, 1, 3)))
    for array in (fabric.position, fabric.weave.flipped, scene.gravity, scene.pins, scene.pin_path, cloths.position):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize("name", ["scene", "step_size", "step_error", "chunk"])
def test_a_simulator_says_what_it_was_made_with(name):
    simulator = wy.Simulator(wy.Scene(wy.paper.cloth(rows=4, columns=4)))
    with pytest.raises(wy.NoAttributeError, match=rf"simulator\.{name} cannot be set: .* make another Simulator"):
        setattr(simulator, name, getattr(simulator, name))


def test_a_step_in_milliseconds():
    scene = wy.Scene(wy.paper.cloth(rows=3, columns=3))
    with pytest.warns(wy.WarpYarnWarning, match=r"step = 1 s, usual is at most 0.2 s: it has to be in seconds"):
        wy.Simulator(scene, step=1.0)


@pytest.mark.parametrize(
    "make",
    [
        lambda: wy.fabrics.denim(size=10),
        lambda: wy.piece(wy.fabrics.denim, wy.outline.rectangle(20.0, 6.0)),
        lambda: wy.paper.cloth(rows=100_000, columns=100_000),
        lambda: wy.Weave.satin(rows=5000, columns=5000),
        lambda: wy.Weave.from_drawdown([[0, 1], [1, 0]], rows=5000, columns=5000),
    ],
)
def test_sizes_in_millimetres_are_refused_before_they_fill_the_memory(make):
    with pytest.raises(wy.InputError, match=r"rows = \d+, columns = \d+ make .* crossings, must be at most 16000000"):
        make()


def test_a_piece_is_of_a_fabric_and_not_of_a_cloth():
    with pytest.raises(wy.InputError, match="must be a function that makes a Cloth"):
        wy.piece(wy.fabrics.denim(), wy.outline.disc(0.01))


def test_single_precision_warns_of_stiff_light_yarns() -> None:
    """Where it is far off: a piece that hangs by a corner, after 30 ms."""
    for fabric, warned in (("handkerchief", False), ("denim", True)):
        c = getattr(wy.fabrics, fabric)(rows=6, columns=6, pose="flat")
        scene = wy.Scene(c, pins=[0], sliding=False)
        double = wy.Simulator(scene).run(30).position[-1]
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            single = wy.Simulator(scene, precision="single").run(30).position[-1]
        texts = [str(each.message) for each in found if each.category is wy.WarpYarnWarning]
        assert len(texts) == warned and all("precision = 'single' rounds the pull of a yarn" in text for text in texts)
        moved = np.abs(double - c.position).max()
        assert (np.abs(single - double).max() > 0.02 * moved) == warned
