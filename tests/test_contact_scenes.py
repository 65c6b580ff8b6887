"""The scenes of touching, small and in this process; that recordings keep what is touched, and slopes."""

import dataclasses

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scripts import exit_code, load

import warp_yarn as wy
from warp_yarn.simulation.packing import SHAPES
from warp_yarn.simulation.state import FIELDS
from warp_yarn.view import geometry

touch = load("scenes/touch.py")
drape, fold, pull, stack = (load(f"scenes/{name}.py") for name in ("drape", "fold", "pull", "stack"))
slope = load("benchmarks/slope.py")
SCENES = {"drape": drape, "fold": fold, "pull": pull, "stack": stack}

QUARTER = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
HALF_TURN = (0.0, 1.0, 0.0, 0.0)


@pytest.fixture
def usd(tmp_path):
    return tmp_path / "out" / "a.usdc"


def small(usd, *arguments, rows=7, columns=7):
    return ["--rows", str(rows), "--columns", str(columns), "--output", str(usd), *map(str, arguments)]


# -- the look at every frame ------------------------------------------------------------------------------------------


def brute(corners, x):
    """Distance to triangles, over a fine grid on each."""
    s, t = (a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, 81)] * 2))
    s, t = s[s + t <= 1], t[s + t <= 1]
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    points = (a[:, None] + s[:, None] * b[:, None] + t[:, None] * c[:, None]).reshape(-1, 3)
    return np.linalg.norm(x[:, None] - points, axis=2).min(axis=1)


def test_distances_to_triangles_are_those_to_their_points():
    rng = np.random.default_rng(1)
    vertices, faces = drape.torus(2.0, 0.7, sides=5)
    x = rng.uniform(-3, 3, (60, 3))
    exact, rough = touch.to_triangles(x, vertices[faces]), brute(vertices[faces], x)
    # of a grid: above, by what half its width adds: 4 / 80 · √2/2
    assert (exact <= rough + 1e-12).all() and (rough - exact).max() < 0.035
    assert (exact > 0.05).any() and np.ptp(exact) > 1.0


@pytest.mark.parametrize("shape", SHAPES)
def test_the_look_knows_each_shape(shape):
    """Places at a distance by construction: along the normal of a point on the surface, where it is round or flat."""
    rng = np.random.default_rng(2)
    d = rng.uniform(0.1, 2.0, 50)[:, None]
    u = rng.normal(size=(50, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    flat = u * [1, 1, 0] / np.linalg.norm(u[:, :2], axis=1, keepdims=True)
    z = rng.uniform(-1, 1, 50)[:, None] * [0, 0, 1.0]
    upper, high = np.abs(u), z[:, 2:] > 0
    rim = np.linalg.norm(u[:, :2], axis=1, keepdims=True) * flat + upper * [0, 0, 1]
    ends = {"start": (0, 0, -1), "end": (0, 0, 1)}
    vertices, faces = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    obstacle, x = {
        "plane": (wy.Plane(point=(0, 0, 0), normal=(0, 0, 1)), u * [1, 1, 0] + d * [0, 0, 1]),
        "sphere": (wy.Sphere(center=(0, 0, 0), radius=2), (2 + d) * u),
        "capsule": (wy.Capsule(**ends, radius=2), np.where(high, [0, 0, 1] + (2 + d) * upper, z + (2 + d) * flat)),
        # beside it, and beyond its rim: out and up
        "cylinder": (wy.Cylinder(**ends, radius=2), np.where(high, z + (2 + d) * flat, 2 * flat + [0, 0, 1] + d * rim)),
        # from its corner, into the octant beyond
        "box": (wy.Box(center=(0, 0, 0), half_extents=(1, 2, 3)), [1, 2, 3] + d * upper),
        "mesh": (wy.TriangleMesh(vertices, faces), z @ [[0, 0, 0], [0, 0, 0], [1, 0, 0]] + d * [0, 0, -1]),
    }[shape]
    each = geometry.Placed(obstacle, np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]), 0.0, 0.0)
    np.testing.assert_allclose(touch.distances(each, x), d[:, 0], rtol=0, atol=1e-12)


def test_the_look_finds_what_is_too_near(usd):
    made = drape.main(small(usd, "--over", "sphere", "--steps", 5))
    touch.look(made)
    inside = made.position.copy()
    inside[3, 24] -= [0, 0, 0.6e-3]
    with pytest.raises(wy.SimulationError, match=r"frame 3: nodes are 0\.000\d+ m from an obstacle"):
        touch.look(dataclasses.replace(made, position=inside))
    folded = made.position.copy()
    folded[2, -1] = folded[2, 0] + [0, 0, 1.4e-3]
    with pytest.raises(wy.SimulationError, match=r"frame 2: nodes are 0\.0014 m from each other"):
        touch.look(dataclasses.replace(made, position=folded))


# -- scenes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".npz", ".h5"])
@pytest.mark.parametrize("name", SCENES)
def test_a_resumed_run_is_the_uninterrupted_one(name, ending, usd, tmp_path):
    """To the last bit; what is pulled away goes on, and is not stopped where the recording ended."""
    size, record = {"rows": 10, "columns": 10}, tmp_path / f"a{ending}"
    own = {"pull": ["--beneath", "cloth"], "stack": ["--layers", 2], "fold": ["--fold", 4]}.get(name, [])
    main = SCENES[name].main
    whole = main(small(usd, "--steps", 6, *own, **size))
    main(small(usd, "--steps", 4, "--record", record, *own, **size))
    both = main(["--resume", str(record), "--steps", "2", "--output", str(usd), "--record", str(record)])
    for part in FIELDS:
        np.testing.assert_array_equal(getattr(both, part), getattr(whole, part))
    assert wy.Trajectory.load(record) == both and Usd.Stage.Open(str(usd)).GetEndTimeCode() > 0.0


def test_a_recording_settles_what_the_scene_is(usd, tmp_path, capsys):
    record = tmp_path / "a.npz"
    drape.main(small(usd, "--steps", 1, "--record", record))
    for option in (["--over", "box"], ["--rows", "7"], ["--rows=7"], ["--friction", "0.3"], ["--step", "1e-3"]):
        assert exit_code(drape, ["--resume", str(record), "--output", str(usd), *option]) == 2
        assert f"{option[0].partition('=')[0]} does not go with --resume" in capsys.readouterr().err


def test_a_fold_that_was_not_let_go_is_not_resumed(usd, tmp_path, capsys):
    record = tmp_path / "a.npz"
    cloth = touch.flat(touch.parser(None, "fold", rows=5, columns=5, steps=1).parse_args([]))
    pins, path = fold.carried(cloth, 3)
    wy.Simulator(wy.Scene(cloth, pins=pins, pin_path=path)).run(1).save(record)
    assert exit_code(fold, ["--resume", str(record), "--output", str(usd)]) == 2
    assert "ended within the fold" in capsys.readouterr().err


@pytest.mark.parametrize("integrator", ["implicit-euler", "sdirk2"])
@pytest.mark.parametrize("over", ["sphere", "box", "table", "torus"])
def test_a_cloth_drapes(over, integrator, usd, capsys):
    """main() looks at every frame, and fails where anything came too near."""
    made = drape.main(small(usd, "--over", over, "--steps", 40, "--integrator", integrator, rows=9, columns=9))
    found = touch.clearance(made)
    assert len(made) == 41 and 0.5e-3 < found.gap.min() < 1e-3
    # it fell at its sides, and lies where it is held
    assert made.position[-1, :, 2].min() < made.position[0, :, 2].min() - 5e-4
    assert np.ptp(made.position[-1, :, 2]) > 5e-4
    assert "nodes came as near as" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(usd))
    obstacles = [each for each in stage.GetPrimAtPath("/obstacles").GetChildren() if each.IsA(UsdGeom.Gprim)]
    assert len(obstacles) == (1 if over == "table" else 2)


def test_a_cloth_drapes_over_a_file(usd, tmp_path):
    pytest.importorskip("trimesh")
    vertices, faces = drape.torus(24.0, 9.0, sides=12)
    lines = ["v {} {} {}".format(*v) for v in vertices + np.array([5, 6, 7])] + [
        "f {} {} {}".format(*f + 1) for f in faces
    ]
    (tmp_path / "ring.obj").write_text("\n".join(lines))
    arguments = small(usd, "--mesh", tmp_path / "ring.obj", "--scale", 1e-4, "--steps", 10, "--weave", "satin")
    mesh = drape.main(arguments).scene.obstacles[1]
    # on the floor, beneath the cloth
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(18e-4, rel=0.1)
    low = (mesh.vertices + mesh.position).min(axis=0)
    high = (mesh.vertices + mesh.position).max(axis=0)
    assert low == pytest.approx([-high[0], -high[1], 0.0], abs=1e-12)


def test_a_folded_cloth_lies_on_itself(usd):
    made = fold.main(small(usd, "--fold", 300, "--steps", 60, rows=5, columns=15))
    assert len(made) == 361 and not len(made.scene.pins)
    z = made.position[-1, :, 2].reshape(5, 15) / made.cloth.spacing
    x = made.position[-1, :, 0].reshape(5, 15) / made.cloth.spacing
    # the left edge is over the right part, and layers are 2 to 2.5 spacings apart
    assert (np.abs(x[:, 0] - x[:, -1]) < 4.0).all() and (x[:, 0] > x[:, 7]).all()
    assert 2.0 < np.median(z[:, 0] - z[:, -1]) < 2.6
    # it stays so without pins
    assert np.linalg.norm(made.velocity[-1], axis=1).max() < 0.02


def test_a_tray_takes_a_cloth_along_as_far_as_friction_can(usd):
    """Slowly: all of the way, but for creeping. Fast: by ½ μ g t² as long as it is beneath."""
    slow = pull.main(small(usd, "--acceleration", 1, "--speed", 0.05, "--steps", 100))
    went = (slow.position[-1] - slow.position[0])[:, 1]
    t = 1e-3 * np.arange(101)
    # ½ a t² until 50 ms, then steadily; it creeps back by less than ε t
    assert went == pytest.approx(0.05 * (t[-1] - 0.025), abs=1e-4)
    arguments = ["--acceleration", 50, "--speed", 2, "--friction", 0.2, "--steps", 12]
    fast = pull.main(small(usd, *arguments, rows=9, columns=9))
    went = (fast.position[:, :, 1] - fast.position[0, :, 1]).mean(axis=1)
    # implicit Euler, from rest: k (k + 1)/2 h² a; the load is there after a step or two
    k = np.arange(13)
    assert went[5:] == pytest.approx((0.2 * 9.8 * 1e-6 * k * (k + 1) / 2)[5:], rel=0.1)


def test_a_seed_moves_the_start_a_little(usd):
    plain, one, two, again = (
        pull.main(small(usd, "--steps", 1, *seed)).position[0]
        for seed in ([], ["--seed", 1], ["--seed", 2], ["--seed", 1])
    )
    assert np.array_equal(one, again) and not np.array_equal(one, two)
    assert 5e-6 < np.abs(one - plain).max() <= 1e-5


def test_a_cloth_is_pulled_from_under_another(usd):
    """The upper one is taken along by no more than friction can, and lies on the lower one meanwhile."""
    arguments = ["--beneath", "cloth", "--acceleration", 20, "--speed", 0.5, "--steps", 20]
    made = pull.main(small(usd, *arguments, rows=9, columns=9))
    lower, upper = (made.position[:, made.cloth.nodes_of(k)] for k in (0, 1))
    pulled = (lower[-1] - lower[0])[-1, 1]
    assert pulled == pytest.approx(0.5 * 20 * 0.02**2, rel=0.05)
    went = (upper[-1] - upper[0])[:, 1].mean()
    assert 0.0 < went < 0.5 * pulled
    assert 2.0e-3 < (upper[-1, :, 2].mean() - lower[-1, :, 2].mean()) < 2.6e-3
    assert touch.clearance(made).apart.min() > 1.5e-3


def test_the_way_of_a_tray_is_of_its_acceleration():
    t = np.linspace(0, 0.2, 2001)
    way = pull.way(20.0, 1.0, t)
    speed = np.gradient(way, t)
    assert speed[1:-1] == pytest.approx(np.minimum(20.0 * t, 1.0)[1:-1], abs=2e-3)


def test_a_zigzag_is_as_long_as_the_strip():
    profile = stack.zigzag(columns=6, layers=4)
    np.testing.assert_allclose(np.linalg.norm(np.diff(profile, axis=0), axis=1), 1.0, rtol=1e-12)
    assert len(profile) == 4 * 6 + 3 * 4
    apart = np.linalg.norm(profile[:, None] - profile[None], axis=2)
    # no two layers nearer than D + d̂ = 2.5 at the start
    far = np.abs(np.subtract.outer(np.arange(36), np.arange(36))) >= 0.5 * np.pi * 2.5
    assert apart[far].min() > 2.5


def test_layers_of_a_stack_settle_two_and_a_half_spacings_apart(usd, capsys):
    made = stack.main(small(usd, "--layers", 3, "--steps", 250, rows=5, columns=9))
    assert "layers lie" in capsys.readouterr().out
    z = made.position[-1, :, 2].reshape(5, -1)[2] / made.cloth.spacing
    middle = z[[4, 4 + 13, 4 + 26]]
    assert (np.diff(middle) > 2.0).all() and (np.diff(middle) < 2.5).all()
    assert 0.5 < middle[0] < 1.0
    # 1 mm/s: it lies
    assert np.linalg.norm(made.velocity[-1], axis=1).max() < 1e-3


@pytest.mark.parametrize(
    ("scene", "arguments", "named"),
    [
        ("drape", ["--over", "cloud"], "--over"),
        ("drape", ["--mesh", "nowhere.obj"], "nowhere.obj"),
        ("drape", ["--scale", "0"], "--scale"),
        ("drape", ["--integrator", "linear"], "--integrator"),
        ("drape", ["--friction", "-1"], "friction = -1"),
        ("drape", ["--steps", "0"], "--steps = 0"),
        ("fold", ["--fold", "0"], "--fold = 0"),
        ("pull", ["--speed", "0"], "--speed"),
        ("pull", ["--beneath", "cloth", "--columns", "8"], "--columns of a cloth beneath another = 8"),
        ("pull", ["--acceleration", "fast"], "--acceleration"),
        ("stack", ["--layers", "1"], "--layers = 1"),
        ("stack", ["--columns", "2"], "--columns = 2"),
    ],
)
def test_wrong_arguments_end_with_code_2_and_a_message(scene, arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert exit_code(SCENES[scene], arguments) == 2
    told = capsys.readouterr()
    assert named in told.err and "Traceback" not in told.err
    assert not list(tmp_path.rglob("*.usdc"))


# -- recordings -------------------------------------------------------------------------------------------------------


def every_obstacle():
    path = np.hstack([np.linspace(0, 1e-4, 12).reshape(4, 3), np.tile(QUARTER, (4, 1))])
    return [
        wy.Plane(point=(0, 0, -2e-3), normal=(0.1, 0.2, 0.7), friction=0.1, path=path[:, :3] - np.array([0, 0, 2e-3])),
        wy.Sphere(center=(5e-3, 0, -4e-3), radius=1e-3, friction=0.2),
        wy.Capsule(start=(1, 0, 0), end=(1, 0.1, 0.3), radius=0.05),
        wy.Cylinder(start=(1, 1, 0), end=(1.2, 1.1, 0.3), radius=0.05, path=path + np.eye(7)[0] + np.eye(7)[1]),
        wy.Box(center=(2, 0, 0), half_extents=(0.1, 0.2, 0.3), rotation=QUARTER, friction=0.0),
        wy.TriangleMesh(
            *drape.torus(0.2, 0.1, sides=4), position=(3, 0, 0), rotation=HALF_TURN, path=path + 3 * np.eye(7)[0]
        ),
    ]


LAWS = [
    None,
    wy.Contact(damping_speed=None),
    wy.Contact(stiffness=40.0, distance=4e-4, range=6e-4, self_distance=2e-3, self_range=5e-4, friction=0.4),
    wy.Contact(slip_speed=1e-4, damping_speed=0.1),
]


@pytest.mark.parametrize("law", LAWS)
def test_a_recording_goes_on_with_its_obstacles(tmp_path, law):
    cloth = wy.paper.cloth(rows=4, columns=4, pose="flat")
    obstacles = every_obstacle()
    scene = wy.Scene(cloth, obstacles=obstacles, self_contact=law is not None, contact=law)
    whole = wy.Simulator(scene).run(5)
    wy.Simulator(scene).run(2).save(tmp_path / "a.npz")
    first = wy.Trajectory.load(tmp_path / "a.npz")
    assert first.scene.same_as(scene) and first.scene.contact == scene.contact
    assert all(type(mine) is type(its) for mine, its in zip(first.scene.obstacles, obstacles, strict=True))
    simulator = wy.Simulator(first.scene, step=first.step)
    simulator.state, simulator.steps_done = first[-1], first.steps_done
    assert first.joined(simulator.run(3)) == whole


@pytest.mark.parametrize("fabric", ["paper", "handkerchief"])
def test_a_recording_has_several_cloths(tmp_path, fabric):
    """Handkerchief's friction damping is of each cloth's mass."""
    make = wy.fabrics.FABRICS[fabric]
    below, above = make(rows=4, columns=5, weave="twill", pose="flat"), make(rows=3, columns=4, pose="flat")
    below = below.replace(yarns=[wy.Yarn(density=1e-3, stretch=1e5, bend=1e-4), *below.yarns])
    above = above.replace(pose=above.position + 2.6e-3 * np.array([0, 0, 1]))
    scene = wy.Scene([below, above], self_contact=True, obstacles=[wy.Plane(point=(0, 0, -1e-3), normal=(0, 0, 1))])
    whole = wy.Simulator(scene).run(4)
    wy.Simulator(scene).run(2).save(tmp_path / "a.npz")
    first = wy.Trajectory.load(tmp_path / "a.npz")
    assert first.scene.same_as(scene) and len(first.cloth.cloths) == 2
    simulator = wy.Simulator(first.scene, step=first.step)
    simulator.state, simulator.steps_done = first[-1], first.steps_done
    assert first.joined(simulator.run(2)) == whole
    # each material of either cloth has its prim, of as many yarns
    wy.write_usd(tmp_path / "a.usdc", whole)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    yarns = [each for each in stage.GetPrimAtPath("/cloth").GetChildren() if each.IsA(UsdGeom.Gprim)]
    counts = [len(UsdGeom.BasisCurves(prim).GetCurveVertexCountsAttr().Get()) for prim in yarns]
    assert sum(counts) == 4 + 5 + 3 + 4 and len(counts) == len(np.unique(scene.cloth.material))


def test_a_recording_of_before_contact_is_read(tmp_path):
    scene = wy.Scene(wy.paper.cloth(rows=3, columns=3), pins=[0])
    wy.Simulator(scene).run(1).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as data:
        before = {name: data[name] for name in data if "contact" not in name and "obstacle" not in name}
    np.savez(tmp_path / "b.npz", **{**before, "format": 2})
    assert wy.Trajectory.load(tmp_path / "b.npz").scene.same_as(scene)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene_obstacles": np.array(["cloud"])}, "obstacles = 'cloud', must be one of box"),
        ({"scene_obstacle_0_radius": np.array(-1.0)}, "radius = -1"),
        ({"scene_obstacle_0_center": None}, "not a recording of warp_yarn"),
        ({"scene_contact_friction": np.array(-1.0)}, "contact friction = -1"),
    ],
)
def test_a_damaged_recording_is_refused(tmp_path, changes, message):
    scene = wy.Scene(wy.paper.cloth(rows=3, columns=3), obstacles=[wy.Sphere(center=(1, 0, 0), radius=0.5)])
    wy.Simulator(scene).run(1).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as data:
        arrays = {name: data[name] for name in data} | changes
    np.savez(tmp_path / "b.npz", **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(wy.InputError, match=f"b.npz: .*{message}"):
        wy.Trajectory.load(tmp_path / "b.npz")


# -- poses and pictures -----------------------------------------------------------------------------------------------


def test_an_obstacle_moves_and_turns_steadily_between_frames():
    cloth = wy.paper.cloth(rows=3, columns=3)
    angle = np.array([0.3, 0.9, 1.2])
    turns = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    # the same rotation, by the other quaternion
    turns[1] *= -1.0
    path = np.hstack([[[1, 0, 0], [1, 2, 0], [1, 2, 4]], turns])
    box = wy.Box(center=(0, 0, 0), half_extents=(1, 1, 1), path=path)
    still = wy.Simulator(wy.Scene(cloth)).run(0)
    at = np.array([0.0, 0.5, 1.0, 1.25, 2.5, 3.0, 7.0])
    frames = np.tile(cloth.position, (7, 1, 1))
    shown = dataclasses.replace(still, scene=wy.Scene(cloth, obstacles=[box]), position=frames)
    [each] = geometry.placed(shown, at)
    expected = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 0.5, 0], [1, 2, 2], [1, 2, 4], [1, 2, 4]]
    np.testing.assert_allclose(each.position, expected, rtol=0, atol=1e-15)
    for frame, turned in enumerate([0.0, 0.15, 0.3, 0.45, 1.05, 1.2, 1.2]):
        x = each.world(np.array([[1.0, 0, 0]]))[frame, 0] - each.position[frame]
        np.testing.assert_allclose(x, [np.cos(turned), np.sin(turned), 0], rtol=0, atol=1e-14)
        np.testing.assert_allclose(each.matrix(frame)[:3, 0], x, rtol=0, atol=1e-14)
    later = dataclasses.replace(shown, start=2)
    np.testing.assert_array_equal(geometry.placed(later, at[:1])[0].position[0], [1, 2, 0])


@pytest.mark.slow
def test_obstacles_are_in_pictures_where_they_are(tmp_path):
    """A sphere seen from the side beneath a cloth, and then above it: grey on background, a yarn where it was."""
    import imageio.v2 as imageio

    cloth = wy.paper.cloth(rows=5, columns=5, pose="flat")
    sphere = wy.Sphere(center=(2e-3, 2e-3, -1.8e-3), radius=1.2e-3, path=[[2e-3, 2e-3, 1.8e-3]])
    still = wy.Simulator(wy.Scene(cloth, gravity=None)).run(1)
    images = []
    for frame, scene in ((0, [sphere]), (1, [sphere]), (1, [])):
        shown = dataclasses.replace(still, scene=wy.Scene(cloth, obstacles=scene))
        wy.write_png(tmp_path / "a.png", shown, frame=frame, size=(160, 120), view=(0, -1, 0))
        images.append(imageio.imread(tmp_path / "a.png").astype(float))
    grey = [(np.ptp(image, axis=2) < 16) & (image.max(axis=2) < 190) & (image.max(axis=2) > 90) for image in images]
    rows = np.arange(120)[:, None]
    counts = [mask.sum() for mask in grey]
    assert counts[0] > 300 and counts[1] > 300 and counts[2] < 50
    # below the middle of the picture, then above it
    assert (grey[0] * rows).sum() / counts[0] > 65 and (grey[1] * rows).sum() / counts[1] < 55


# -- benchmarks/slope.py ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["implicit-euler", "sdirk2"])
@pytest.mark.parametrize(("tolerance", "allowed"), [(1e-6, 0.01), (None, 0.05)])
@pytest.mark.parametrize(("friction", "share"), [(0.1, 0.9), (0.5, 0.5), (0.5, 0.98), (0.3, 1.02), (1.0, 1.5)])
def test_cloth_on_a_slope_creeps_and_slides_as_the_closed_forms(integrator, tolerance, allowed, friction, share):
    cloth = wy.paper.cloth(rows=3, columns=3, pose="flat")
    angle = np.arctan(share * friction)
    row = slope.measured(cloth, friction, angle, duration=0.1, integrator=integrator, newton_tolerance=tolerance)
    assert row["what"] == ("creep" if share < 1 else "slide")
    assert row["off"] < allowed
    # as by hand: 9.8 (sin 45° − ...) and 1 mm/s (1 − √(1 − r))
    by_hand = {(0.5, 0.5): 2.9289e-4, (1.0, 1.5): 9.8 * (1.5 - 1.0) / np.hypot(1.0, 1.5)}
    if (friction, share) in by_hand:
        assert row["measured"] == pytest.approx(by_hand[friction, share], rel=allowed)


@pytest.mark.slow
def test_the_chart_of_slopes_from_the_command(monkeypatch, tmp_path, capsys):
    for name, value in (("FRICTIONS", (0.3,)), ("SHARES", (0.5, 1.5)), ("ANGLES", (10, 30)), ("DURATION", 0.02)):
        monkeypatch.setattr(slope, name, value)
    monkeypatch.setattr(slope, "one_core", lambda: None)
    arguments = ["--size", "3", "--output", str(tmp_path / "s.csv"), "--plot", str(tmp_path / "s.png")]
    slope.main(arguments)
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    # two integrators, two tolerances, two shares, and a map of 10 × 2
    assert len((tmp_path / "s.csv").read_text().splitlines()) == 1 + 8 + 20
    assert "off by" in capsys.readouterr().out
