"""Every argument of a scene, a cloth and what they are made of is noticed: by ``replace``, ``same_as`` and recordings.

The arguments are looked up, so one that is new fails here until another value of it stands below, and then wherever it
is forgotten.
"""

import dataclasses
import inspect
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from internals import made_of, options_of

import warp_yarn as wy

YARNS = [wy.Yarn(density=2e-5, stretch=1e9, bend=0.2, radius=1.2e-4), wy.fabrics.denim.yarns[0]]
CLOTH = wy.Cloth(wy.Weave.plain(rows=6, columns=6), yarns=YARNS, crimp=0.07, pose="flat")
SCENE = wy.Scene(CLOTH, wind=wy.Wind(velocity=(0.0, 1.0, 0.0)), pins=[0, 5], seams=[[6, 30]], parameters={})
SQUARE = np.array([[0.0, 0.0], [5e-3, 0.0], [5e-3, 5e-3], [0.0, 5e-3]])

OF_YARN: dict[str, Any] = {
    "density": 3e-5,
    "stretch": 2e9,
    "bend": 0.3,
    "color": (0.1, 0.2, 0.3),
    "radius": 1.1e-4,
    "width": {"radius": None, "width": 1e-4, "thickness": 1.6e-4},
    "thickness": {"radius": None, "width": 1.6e-4, "thickness": 1e-4},
}
"""Of each argument another value, or several at once that go together."""
OF_WIND: dict[str, Any] = {"velocity": (0.0, 2.0, 0.0), "density": 1.0, "drag": 0.25}
OF_CONTACT: dict[str, Any] = {
    "method": "impact-zones",
    "stiffness": 7.0,
    "distance": 1e-4,
    "range": 2e-4,
    "self_distance": 3e-4,
    "self_range": 4e-4,
    "friction": 0.4,
    "slip_speed": 2e-3,
    "damping_speed": None,
    "samples": "nodes+mids",
    "thickness": {"method": "impact-zones", "thickness": 1e-4},
}
OF_CLOTH: dict[str, Any] = {
    "weave": wy.Weave.twill(rows=6, columns=6),
    "yarns": YARNS[::-1],
    "warp": [0, 0, 1, 1, 0, 1],
    "weft": [1, 1, 0, 0, 1, 0],
    "spacing": (1e-3, [1e-3, 1.1e-3, 1.2e-3, 1e-3, 1e-3]),
    "radius": {"yarns": [YARNS[0].replace(radius=None), YARNS[1]], "radius": 7e-5},
    "crimp": (0.05, [0.05, 0.06, 0.07, 0.08, 0.09, 0.1]),
    "shear": [[1e3, 2e3], [3e3, 4e3]],
    "friction": 0.3,
    "friction_stiffness": np.linspace(1e3, 2e3, 36),
    "friction_damping": 0.1,
    "friction_sharpness": 9.0,
    "parallel_stiffness": 2.0,
    "pose": CLOTH.position + np.array([0.0, 0.0, 1e-3]),
    "outline": SQUARE[:3],
    "holes": {"outline": SQUARE, "holes": [[[2.2e-3, 2.2e-3], [3.7e-3, 2.2e-3], [3.7e-3, 3.7e-3]]]},
}
OF_SCENE: dict[str, Any] = {
    "cloth": [CLOTH, CLOTH.replace(friction=0.4)],
    "gravity": [(0.0, 0.0, -9.8), (0.0, 0.0, -1.6)],
    "wind": [{"wind": SCENE.wind.replace(**{name: value})} for name, value in OF_WIND.items()] + [{"wind": None}],
    "pins": [0, 4],
    "pin_stiffness": None,
    "pin_path": np.ones((3, 2, 3)),
    "forces": {7: (0.0, 0.0, 1.0), 8: [(0.0, 0.0, 1.0), (0.0, 0.0, 2.0)]},
    "sliding": False,
    "terms": ["stretch", "gravity"],
    "published_scaling": True,
    "parameters": {"spring": 2.0},
    "obstacles": [wy.Plane(point=(0.0, 0.0, -1.0), normal=(0.0, 0.0, 1.0))],
    "self_contact": {"self_contact": True, "seams": ()},
    "contact": [
        {"contact": wy.Contact(**(value if isinstance(value, dict) else {name: value}))}
        for name, value in OF_CONTACT.items()
    ],
    "seams": [[6, 30], [7, 31]],
    "seam_stiffness": 5e3,
    "contact_force": "crimped",
    "crimp_interchange": True,
}
OTHERS = {wy.Yarn: OF_YARN, wy.Wind: OF_WIND, wy.Contact: OF_CONTACT, wy.Cloth: OF_CLOTH, wy.Scene: OF_SCENE}


@pytest.fixture(autouse=True)
def _with_a_spring(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A registered term, for ``parameters``."""
    from warp_yarn.kernels import TERMS

    term = wy.Term(
        name="springs",
        elements="nodes",
        define=TERMS["gravity"].define,
        parameters=(wy.TermParameter("spring", "N/m", default=1.0),),
    )
    monkeypatch.setitem(TERMS, "springs", term)


def changes(of: dict[str, Any]) -> list[Any]:
    """(argument, changes), one or several of each argument."""
    result = []
    for name, value in of.items():
        several = value if isinstance(value, list) and value and all(isinstance(each, dict) for each in value) else None
        for each in several or [value if isinstance(value, dict) and name in value else {name: value}]:
            result.append(pytest.param(each, id=name))
    return result


def recorded(scene: wy.Scene, path: Path) -> wy.Scene:
    c = scene.cloth
    rest = [np.zeros((1, c.nodes, width)) for width in (3, 2, 3, 2, 2)]
    wy.Trajectory(c, 1e-3, *rest, scene=scene).save(path)
    found = wy.Trajectory.load(path).scene
    assert found is not None
    return found


@pytest.mark.parametrize("kind", OTHERS, ids=lambda kind: kind.__name__)
def test_no_argument_is_missing_here(kind: type) -> None:
    assert set(OTHERS[kind]) == set(inspect.signature(kind).parameters)


def held(base: Any, changed: Any, again: Callable[[Any], Any], tmp_path: Path) -> None:
    """Asserts that a scene is told from another one, and is itself after ``replace``, pickling and recording."""
    assert not base.same_as(changed) and not changed.same_as(base)
    for same in (changed.replace(), pickle.loads(pickle.dumps(changed)), recorded(changed, tmp_path / "a.npz")):
        assert changed.same_as(same) and same.same_as(changed) and not base.same_as(same)
    assert again(changed).same_as(base) and not again(changed).same_as(changed)


@pytest.mark.parametrize("change", changes(OF_SCENE))
def test_of_scenes(change: dict[str, Any], tmp_path: Path) -> None:
    changed = SCENE.replace(**change)
    held(SCENE, changed, lambda scene: scene.replace(**{name: made_of(SCENE)[name] for name in change}), tmp_path)


@pytest.mark.parametrize("change", changes(OF_CLOTH))
def test_of_cloths(change: dict[str, Any], tmp_path: Path) -> None:
    changed = CLOTH.replace(**change)

    def back(scene: wy.Scene) -> wy.Scene:
        return wy.Scene(scene.cloth.replace(**{name: made_of(CLOTH)[name] for name in change}))

    held(wy.Scene(CLOTH), wy.Scene(changed), back, tmp_path)
    if not {"friction_sharpness", "parallel_stiffness"} & set(change):  # which several cloths share
        held(wy.Scene([CLOTH, CLOTH]), wy.Scene([CLOTH, changed]), lambda _: wy.Scene([CLOTH, CLOTH]), tmp_path)


@pytest.mark.parametrize("change", changes(OF_YARN))
def test_of_yarns(change: dict[str, Any], tmp_path: Path) -> None:
    """A colour is no difference to the motion, and is recorded."""
    yarn = YARNS[0].replace(**change)
    cloth = CLOTH.replace(yarns=[yarn, YARNS[1]])
    assert yarn != YARNS[0] and yarn.replace() == yarn
    assert recorded(wy.Scene(cloth), tmp_path / "a.npz").cloth.yarns[0] == yarn
    assert cloth.same_as(CLOTH) == (set(change) == {"color"})


def test_of_obstacles(tmp_path: Path) -> None:
    """Of every shape, by its arguments; all of them numbers that may be larger."""
    place = {"center": (0.0, 0.0, -9.0), "start": (0.0, 0.0, -9.0), "end": (0.0, 1.0, -9.0), "point": (0.0, 0.0, -9.0)}
    size = {"radius": 1.0, "half_extents": (1.0, 1.0, 1.0), "normal": (0.0, 0.6, 0.8)}
    mesh = {"vertices": np.eye(3) - 9.0, "faces": [[0, 1, 2]], "position": (0.0, 0.0, -9.0)}
    given = {**place, **size, **mesh, "rotation": (0.0, 0.0, 0.0, 1.0), "friction": 0.3, "path": np.ones((2, 3)) - 9.0}
    others = {**{name: 1.5 * np.array(value) for name, value in given.items()}, "faces": [[0, 2, 1]]}
    others |= {"rotation": (0.0, 0.6, 0.0, 0.8), "normal": (0.0, 0.8, 0.6), "start": (0.0, 0.0, -8.0)}
    for kind in (wy.Plane, wy.Sphere, wy.Capsule, wy.Cylinder, wy.Box, wy.TriangleMesh):
        names = inspect.signature(kind).parameters
        base = kind(**{name: given[name] for name in names})
        for name in names:
            changed = base.replace(**{name: others[name]})
            scenes = [wy.Scene(CLOTH, obstacles=[each]) for each in (base, changed)]
            assert not base.same_as(changed) and not scenes[0].same_as(scenes[1]), (kind, name)
            assert recorded(scenes[1], tmp_path / "a.npz").same_as(scenes[1]), (kind, name)


def test_of_a_simulator() -> None:
    """Copies keep every option, and those that decide how steps come out are recorded."""
    names = set(inspect.signature(wy.Simulator).parameters) - {"scene"}
    sim = wy.Simulator(wy.Scene(CLOTH, terms=[]))
    assert set(options_of(sim)) == names
    where = {"device", "threads", "chunk", "differentiable", "hook"}  # where and how fast, or no number
    assert set(sim.run(0).options or ()) == names - where


def test_fields_of_a_dataclass_are_its_arguments() -> None:
    """So that ``dataclasses.replace`` makes all of it."""
    for kind in (wy.Yarn, wy.Wind):
        assert [field.name for field in dataclasses.fields(kind)] == list(inspect.signature(kind).parameters)
