"""What is refused of obstacles, contact and their scenes, by name; and what goes together."""

import copy
import pickle

import numpy as np
import pytest
from internals import halved
from scipy.spatial.transform import Rotation
from touching import GROUND, folded, lifted, paper, shapes

import warp_yarn as wy
from warp_yarn.description.cloth import CLOTH_NUMBERS

NAN = float("nan")
SPHERE = {"center": (0.0, 0.0, 0.0), "radius": 1e-3}
BOX = {"center": (0.0, 0.0, 0.0), "half_extents": (1e-3, 1e-3, 1e-3)}
ROD = {"start": (0.0, 0.0, 0.0), "end": (1e-3, 0.0, 0.0), "radius": 1e-3}
MESH = {"vertices": np.eye(3), "faces": [[0, 1, 2]]}
PLANE = {"point": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}
WRONG = [
    (wy.Plane, PLANE, {"normal": (0.0, 0.0, 0.0)}, "normal is 0"),
    (wy.Plane, PLANE, {"normal": (0.0, NAN, 1.0)}, "normal"),
    (wy.Plane, PLANE, {"point": (0.0, 0.0)}, "point has shape"),
    (wy.Plane, PLANE, {"friction": -0.1}, "friction = -0.1"),
    (wy.Plane, PLANE, {"friction": NAN}, "friction"),
    (wy.Plane, PLANE, {"path": np.zeros((0, 3))}, "path has no step"),
    (wy.Plane, PLANE, {"path": np.zeros((4, 5))}, "path has shape"),
    (wy.Plane, PLANE, {"path": np.full((4, 3), np.inf)}, "path"),
    (wy.Plane, PLANE, {"path": np.ones((4, 7))}, r"path\[0\] = .* length 2"),
    (wy.Sphere, SPHERE, {"radius": 0.0}, "radius = 0"),
    (wy.Sphere, SPHERE, {"radius": -1.0}, "radius = -1"),
    (wy.Sphere, SPHERE, {"radius": "1"}, "radius"),
    (wy.Sphere, SPHERE, {"center": None}, "center"),
    (wy.Capsule, ROD, {"end": (0.0, 0.0, 0.0)}, "end - start is 0"),
    (wy.Capsule, ROD, {"radius": NAN}, "radius"),
    (wy.Cylinder, ROD, {"end": (0.0, 0.0, 0.0)}, "end - start is 0"),
    (wy.Cylinder, ROD, {"start": (0.0, 0.0, 0.0, 0.0)}, "start has shape"),
    (wy.Box, BOX, {"half_extents": (1.0, 0.0, 1.0)}, r"half_extents\[1\] = 0"),
    (wy.Box, BOX, {"rotation": (0.0, 0.0, 0.0, 0.0)}, "rotation = .* length 0"),
    (wy.Box, BOX, {"rotation": (0.0, 0.0, 1.0)}, "rotation has shape"),
    (wy.TriangleMesh, MESH, {"faces": [[0, 1, 3]]}, "faces names vertex 3"),
    (wy.TriangleMesh, MESH, {"faces": [[0, 1, -1]]}, "faces"),
    (wy.TriangleMesh, MESH, {"faces": np.zeros((0, 3), int)}, "faces has shape"),
    (wy.TriangleMesh, MESH, {"faces": [[0.0, 1.0, 2.0]]}, "faces"),
    (wy.TriangleMesh, MESH, {"faces": [[0, 1, 1]]}, r"faces\[0\] has no area"),
    (wy.TriangleMesh, MESH, {"vertices": np.eye(3)[:, :2]}, "vertices has shape"),
    *[
        (wy.Contact, {}, {name: value}, name)
        for name in ("stiffness", "distance", "range", "self_distance", "self_range", "slip_speed", "damping_speed")
        for value in (0.0, -1.0, NAN, "much")
    ],
    (wy.Contact, {}, {"friction": -1e-9}, "friction"),
    (wy.Contact, {}, {"method": "impulses"}, "method"),
    (wy.Contact, {}, {"samples": "edges"}, "samples"),
]


@pytest.mark.parametrize(("kind", "right", "wrong", "words"), WRONG)
def test_wrong_arguments(kind: type, right: dict, wrong: dict, words: str) -> None:
    kind(**right)
    with pytest.raises(wy.InputError, match=words):
        kind(**{**right, **wrong})


def test_scenes_refuse_what_is_no_obstacle() -> None:
    for obstacles in (GROUND, [GROUND, 1], "plane"):
        with pytest.raises(wy.InputError, match="obstacles = "):
            wy.Scene(paper(4, 4), obstacles=obstacles)
    with pytest.raises(wy.InputError, match="contact = "):
        wy.Scene(paper(4, 4), contact={"friction": 0.3})
    with pytest.raises(wy.InputError, match="terms names 'obstacles', but there is no obstacle"):
        wy.Scene(paper(4, 4), terms=["obstacles"])
    with pytest.raises(wy.InputError, match="terms names 'self_contact', but there is no self_contact by a barrier"):
        wy.Scene(paper(4, 4), terms=["self_contact"])


@pytest.mark.parametrize("method", ["linear", "ros2", "implicit-midpoint"])
@pytest.mark.parametrize("options", [{"obstacles": [GROUND]}, {"self_contact": True}])
def test_methods_that_end_elsewhere_are_refused(method: str, options: dict) -> None:
    scene = wy.Scene(lifted(paper(4, 4), 2e-3), **options)
    with pytest.raises(wy.InputError, match=f"integrator = '{method}' with contact.*'implicit-euler', 'sdirk2'"):
        wy.Simulator(scene, integrator=method)


def test_a_preconditioner_without_pairs_is_refused() -> None:
    with pytest.raises(wy.InputError, match="preconditioner = 'jacobi' with self_contact"):
        wy.Simulator(wy.Scene(paper(4, 4), self_contact=True), preconditioner="jacobi")
    wy.Simulator(wy.Scene(lifted(paper(4, 4), 2e-3), obstacles=[GROUND]), preconditioner="jacobi").run(1)


@pytest.mark.parametrize("name", shapes())
def test_obstacles_are_copied_and_compared(name: str) -> None:
    obstacle = shapes()[name][0]
    assert obstacle.same_as(pickle.loads(pickle.dumps(obstacle))) and obstacle.same_as(copy.deepcopy(obstacle))
    assert obstacle.same_as(obstacle.replace())
    assert not obstacle.same_as(obstacle.replace(friction=0.9))
    assert not obstacle.same_as(obstacle.replace(path=[(0.0, 0.0, 0.0)]))
    assert not obstacle.same_as(shapes()["sphere" if name != "sphere" else "box"][0])


def test_an_obstacle_keeps_no_array_of_the_caller() -> None:
    path = np.zeros((2, 3))
    sphere = wy.Sphere(center=(0.0, 0.0, 0.0), radius=1e-3, path=path)
    path[:] = 1.0
    assert sphere.path[:, :3].max() == 0.0


def test_a_copied_simulator_goes_on_alike() -> None:
    simulator = wy.Simulator(wy.Scene(folded(), obstacles=[GROUND], self_contact=True), integrator="implicit-euler")
    simulator.run(25)
    other = pickle.loads(pickle.dumps(simulator))
    assert np.array_equal(other.run(10).position, simulator.run(10).position)
    assert len(other.contacts()) == len(simulator.contacts()) > 0


def test_what_is_not_modelled_holds_nothing_up() -> None:
    """Without its term, an obstacle is not there, nor is the cloth for itself."""
    cloth = folded(jitter=0.0)
    free = wy.Scene(cloth)
    scene = wy.Scene(cloth, obstacles=[GROUND], self_contact=True, terms=free.terms)
    simulator = wy.Simulator(scene, integrator="implicit-euler")
    alone = wy.Simulator(free, integrator="implicit-euler").run(40)
    assert np.array_equal(simulator.run(40).position, alone.position)
    assert alone.position[-1, :, 2].min() < 0.0 and len(simulator.contacts()) == 0


def test_half_the_step_moves_obstacles_alike() -> None:
    """Ablation's run at half the step has them where they were, at every other step's end and at constant velocity."""
    t = 1e-3 * np.arange(1, 9)[:, None]
    turns = Rotation.from_rotvec(t * np.array([300.0, 20.0, 0.0])).as_quat() * (-1.0) ** np.arange(8)[:, None]
    box = wy.Box(center=(0.0, 0.0, 0.0), half_extents=(1e-3, 1e-3, 1e-3), path=np.hstack([t * (0.1, 0.0, 0.2), turns]))
    far = paper(4, 4)
    scene = wy.Scene(far.replace(pose=far.position + 1.0), obstacles=[box], gravity=None)
    (half,) = halved(scene, None).obstacles
    assert np.array_equal(half.path[1::2], box.path)
    fine = 0.5e-3 * np.arange(1, 17)[:, None]
    expected = Rotation.from_rotvec(fine * np.array([300.0, 20.0, 0.0]))
    assert (expected.inv() * Rotation.from_quat(half.path[:, 3:])).magnitude().max() < 1e-12
    assert np.abs(half.path[:, :3] - fine * (0.1, 0.0, 0.2)).max() < 1e-15


# -- several cloths ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["implicit-euler", "sdirk2"])
def test_cloths_apart_are_each_alone(method: str) -> None:
    """To the tolerance of one solve for all, beside a solve for each."""
    one, two = paper(5, 5), lifted(paper(4, 6, weave="twill"), 4e-2)
    exact = {"newton_tolerance": 1e-9, "tolerance": 1e-12, "integrator": method}
    both = wy.Simulator(wy.Scene([one, two], pins=[0, 4, 25, 30], self_contact=True), **exact).run(15)
    cloths = wy.Cloths([one, two])
    # what each has by default, of its own mass, they share
    shared = {name: getattr(cloths, name) for name in CLOTH_NUMBERS}
    for k, (cloth, pins) in enumerate(((one.replace(**shared), [0, 4]), (two.replace(**shared), [0, 5]))):
        alone = wy.Simulator(wy.Scene(cloth, pins=pins, self_contact=True), **exact).run(15)
        assert np.abs(both.position[:, cloths.nodes_of(k)] - alone.position).max() < 1e-12
        assert np.abs(both.euler_velocity[:, cloths.nodes_of(k)] - alone.euler_velocity).max() < 1e-9


def test_several_cloths_have_one_thread() -> None:
    with pytest.raises(wy.InputError, match="threads = 2 with several cloths"):
        wy.Simulator(wy.Scene([paper(4, 4), lifted(paper(4, 4), 1e-2)]), threads=2)
    with pytest.raises(wy.InputError, match=r"cloths\[1\].parallel_stiffness"):
        wy.Cloths([paper(4, 4), paper(4, 4).replace(parallel_stiffness=2.0)])
    for wrong in ([], [1], "cloth"):
        with pytest.raises(wy.InputError, match="cloth"):
            wy.Scene(wrong)


def test_several_cloths_are_written_as_usd(tmp_path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd

    scene = wy.Scene([lifted(paper(4, 4), 1.2e-3), lifted(paper(4, 5), 3.6e-3)], obstacles=[GROUND], self_contact=True)
    trajectory = wy.Simulator(scene, integrator="implicit-euler").run(3)
    file = tmp_path / "two.usda"
    wy.write_usd(file, trajectory)
    stage = Usd.Stage.Open(str(file))
    curves = [
        prim for prim in stage.Traverse() if prim.GetTypeName() in ("BasisCurves", "NurbsCurves", "Mesh", "Points")
    ]
    assert curves and stage.GetEndTimeCode() > stage.GetStartTimeCode()
