"""USD files: what the validators of usd-core do not see, such as extents, counts, and which yarn is on top."""

import dataclasses
import os

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdValidation
from scripts import load
from waving import BLUE, RED, rotation, waving

import warp_yarn as wy
from warp_yarn.io import usd
from warp_yarn.simulation.state import SHAPES
from warp_yarn.view import geometry

SINGLE = 8e-9
"""Rounding to single precision of the coordinates here, which are under 1/16 m, and of a sum of some of them [m]."""
RADIUS = 3e-4


@pytest.fixture(params=[False, True], ids=["curves", "tubes"])
def tubes(request):
    return request.param


@pytest.fixture(params=list(wy.WEAVES))
def weave(request):
    return request.param


def written(path, trajectory, **options):
    """The file's stage, which has to be kept, and its yarns by name."""
    wy.write_usd(path, trajectory, **options)
    stage = Usd.Stage.Open(str(path))
    shapes = {prim.GetName(): prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)}
    schema = UsdGeom.Mesh if options.get("tubes") else UsdGeom.BasisCurves
    return stage, {name: schema(prim) for name, prim in shapes.items()}


def points_of(shape, frame):
    return np.array(shape.GetPointsAttr().Get(frame), dtype=np.float64)


def curves_of(shape, frame):
    """The curves of a prim, each without its repeated end points."""
    ends = np.cumsum(shape.GetCurveVertexCountsAttr().Get())
    return [curve[1:-1] for curve in np.split(points_of(shape, frame), ends[:-1])]


def two_colored(weave, **options):
    """Warp yarns of one material, weft yarns of the other."""
    return waving(weave, warp=[0] * 6, weft=[1] * 5, **options)


def woven(path, trajectory):
    """Where the file has warp and weft pass at each node, each [frames, rows, columns, 3]."""
    _stage, shapes = written(path, trajectory)
    warp, weft = (np.array([curves_of(shapes[k], f) for f in range(len(trajectory))]) for k in ("yarn_0", "yarn_1"))
    return warp, weft.swapaxes(1, 2)


def test_warp_is_under_weft_where_the_draft_has_0_and_over_it_where_it_has_1(tmp_path, weave):
    """On the flat cloth u × v is +z, so the points are known."""
    trajectory = two_colored(weave, frames=1)
    trajectory.position[0] = trajectory.cloth.position
    warp, weft = woven(tmp_path / "a.usda", trajectory)
    rest = trajectory.cloth.position.reshape(6, 5, 3)
    height = np.where(trajectory.cloth.weave.flipped, -RADIUS, RADIUS)
    height[[0, -1]] = height[:, [0, -1]] = 0.0
    offset = height[..., None] * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(warp[0], rest - offset, rtol=0, atol=SINGLE)
    np.testing.assert_allclose(weft[0], rest + offset, rtol=0, atol=SINGLE)


def test_yarns_of_a_moving_cloth_cross_at_a_diameter_along_its_normal(tmp_path, weave):
    """The normal here is from the singular vectors of each crossing and its neighbours."""
    trajectory = two_colored(weave)
    warp, weft = woven(tmp_path / "a.usdc", trajectory)
    apart, middle = weft - warp, 0.5 * (weft + warp)
    x = trajectory.position.reshape(-1, 6, 5, 3)
    np.testing.assert_allclose(middle, x, rtol=0, atol=SINGLE)
    for frame, row, column in np.ndindex(len(trajectory), 4, 3):
        j, i = row + 1, column + 1
        near = x[frame, [j, j, j, j - 1, j + 1], [i, i - 1, i + 1, i, i]]
        normal = np.linalg.svd(near - near.mean(axis=0))[2][2]
        normal *= np.sign(normal @ np.cross(near[2] - near[1], near[4] - near[3]))
        if trajectory.cloth.weave.flipped[j, i]:
            normal = -normal
        np.testing.assert_allclose(apart[frame, j, i], 2 * RADIUS * normal, rtol=0, atol=2 * SINGLE)
    border = np.ones((6, 5), dtype=bool)
    border[1:-1, 1:-1] = False
    assert np.abs(apart[:, border]).max() < SINGLE


def test_curves_are_catmull_rom_with_their_ends_repeated(tmp_path):
    trajectory = waving()
    _stage, shapes = written(tmp_path / "a.usdc", trajectory)
    # Six warp and five weft yarns, alternating.
    assert {name: list(s.GetCurveVertexCountsAttr().Get()) for name, s in shapes.items()} == {
        "yarn_0": [7] * 3 + [8] * 3,
        "yarn_1": [7] * 3 + [8] * 2,
    }
    for shape in shapes.values():
        assert (shape.GetTypeAttr().Get(), shape.GetBasisAttr().Get()) == ("cubic", "catmullRom")
        assert shape.GetWrapAttr().Get() == "nonperiodic"
        counts = np.array(shape.GetCurveVertexCountsAttr().Get())
        for frame in range(len(trajectory)):
            points = points_of(shape, frame)
            assert len(points) == counts.sum()
            for curve in np.split(points, counts.cumsum()[:-1]):
                np.testing.assert_array_equal(curve[0], curve[1])
                np.testing.assert_array_equal(curve[-1], curve[-2])
                assert (np.linalg.norm(np.diff(curve[1:-1], axis=0), axis=1) > RADIUS).all()


def test_each_material_has_its_own_yarns(tmp_path):
    """Yarns on the border have no offset, so that their points are the nodes'."""
    trajectory = waving(colors=(RED, BLUE, None), warp=[2, 0, 0, 0, 0, 0], weft=[0, 0, 0, 0, 2])
    _stage, shapes = written(tmp_path / "a.usdc", trajectory)
    assert sorted(shapes) == ["yarn_0", "yarn_2"]
    top, right = curves_of(shapes["yarn_2"], 2)
    x = trajectory.position[2].reshape(6, 5, 3)
    np.testing.assert_allclose(top, x[0], rtol=0, atol=SINGLE)
    np.testing.assert_allclose(right, x[:, -1], rtol=0, atol=SINGLE)


def test_extents_hold_the_yarns_with_their_radius(tmp_path, tubes):
    trajectory = waving()
    _stage, shapes = written(tmp_path / "a.usdc", trajectory, tubes=tubes)
    for shape in shapes.values():
        assert shape.GetExtentAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
        for frame in range(3):
            points = points_of(shape, frame)
            margin = 0.0 if tubes else RADIUS
            expected = [points.min(axis=0) - margin, points.max(axis=0) + margin]
            np.testing.assert_allclose(shape.GetExtentAttr().Get(frame), expected, rtol=0, atol=SINGLE)
            by_usd = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(shape), frame)
            np.testing.assert_allclose(shape.GetExtentAttr().Get(frame), by_usd, rtol=0, atol=SINGLE)


def test_width_is_one_diameter_for_all(tmp_path):
    _stage, shapes = written(tmp_path / "a.usdc", waving())
    for shape in shapes.values():
        np.testing.assert_allclose(shape.GetWidthsAttr().Get(), [2 * RADIUS], rtol=1e-7)
        assert shape.GetWidthsInterpolation() == UsdGeom.Tokens.constant


def test_colours_are_linear_and_one_for_each_material(tmp_path, tubes):
    """sRGB 0.5 is 0.2140 linear, by its definition ((0.5 + 0.055)/1.055)^2.4; below 0.04045 it is divided by 12.92."""
    trajectory = waving(colors=((0.5, 0.04, 1.0), None))
    _stage, shapes = written(tmp_path / "a.usdc", trajectory, tubes=tubes)
    colors = {}
    for name, shape in shapes.items():
        primvar = shape.GetDisplayColorPrimvar()
        assert primvar.GetInterpolation() == UsdGeom.Tokens.constant
        [colors[name]] = primvar.Get()
    np.testing.assert_allclose(colors["yarn_0"], [0.21404114, 0.04 / 12.92, 1.0], rtol=1e-6)
    # Coral by default: more red than green, more green than blue.
    assert np.diff(colors["yarn_1"]).max() < -0.05


@pytest.mark.parametrize("slowdown", [1.0, 20.0])
def test_stage_metadata(tmp_path, tubes, slowdown):
    stage, _ = written(tmp_path / "a.usda", waving(frames=4), tubes=tubes, slowdown=slowdown)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(1000.0 / slowdown, rel=1e-12)
    assert stage.GetFramesPerSecond() == pytest.approx(1000.0 / slowdown, rel=1e-12)
    assert stage.GetDefaultPrim().GetPath() == "/cloth"


def test_points_move_and_nothing_else_does(tmp_path, tubes):
    _stage, shapes = written(tmp_path / "a.usdc", waving(), tubes=tubes)
    for shape in shapes.values():
        moving = {a.GetName() for a in shape.GetPrim().GetAuthoredAttributes() if a.GetNumTimeSamples()}
        assert moving == {"points", "extent"}
        assert shape.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
        assert np.abs(points_of(shape, 2) - points_of(shape, 0)).max() > RADIUS
        # With normals, curves are ribbons.
        assert not shape.GetNormalsAttr().HasAuthoredValue()
        assert not UsdGeom.PrimvarsAPI(shape).HasPrimvar("normals")


@pytest.mark.parametrize("ending", usd.ENDINGS)
def test_usd_validates_it(tmp_path, tubes, ending):
    stage, _ = written(tmp_path / f"a{ending}", waving(), tubes=tubes)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [(error.GetName(), error.GetMessage()) for error in errors] == []


# -- obstacles -------------------------------------------------------------------------------------------------------


touch = load("scenes/touch.py")
TURN = np.append(np.sin(0.2) * np.array([0.6, 0.0, 0.8]), np.cos(0.2))
TETRAHEDRON = (
    1e-3 * np.array([[2, 2, 1], [2, -2, 1], [-3, 0, 1], [0, 0, -2]]),
    [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
)


def obstacle(shape, **options):
    """One about the origin that is 1 mm high or more, whatever way it is turned, and 3 mm at most."""
    make = {
        "plane": lambda **o: wy.Plane(point=(0, 0, 1e-3), normal=(0.1, -0.2, 1.0), **o),
        "sphere": lambda **o: wy.Sphere(center=(0, 0, 0), radius=2e-3, **o),
        "capsule": lambda **o: wy.Capsule(start=(-1e-3, 1e-3, 0), end=(1e-3, -1e-3, 5e-4), radius=1e-3, **o),
        "cylinder": lambda **o: wy.Cylinder(start=(-1e-3, 1e-3, 0), end=(1e-3, -1e-3, 5e-4), radius=1.2e-3, **o),
        "box": lambda **o: wy.Box(center=(0, 0, 0), half_extents=(2e-3, 1e-3, 1.2e-3), rotation=TURN, **o),
        "mesh": lambda **o: wy.TriangleMesh(*TETRAHEDRON, rotation=TURN, **o),
    }
    return make[shape](**options)


def still(cloth, scene):
    """A trajectory of one frame, as the cloth is posed."""
    frame = cloth.position[None]
    euler = cloth.euler[None]
    return wy.Trajectory(cloth, 1e-3, frame, euler, 0 * frame, 0 * euler, euler, scene=scene)


def distance_to(prim, x, time):
    """Of places in the world, from what the file says."""
    to_world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))
    local = (np.c_[x, np.ones(len(x))] @ np.linalg.inv(to_world))[:, :3]
    norm = np.linalg.norm
    if prim.IsA(UsdGeom.Plane):
        shape = UsdGeom.Plane(prim)
        half = 0.5 * np.array([shape.GetWidthAttr().Get(), shape.GetLengthAttr().Get()])
        assert (np.abs(local[:, :2]) <= half).all() and shape.GetAxisAttr().Get() == "Z"
        return local[:, 2]
    if prim.IsA(UsdGeom.Sphere):
        return norm(local, axis=1) - UsdGeom.Sphere(prim).GetRadiusAttr().Get()
    if prim.IsA(UsdGeom.Cube):
        # out of a scaled cube, along the scaled axes
        scale = norm(to_world[:3, :3], axis=1)
        half = 0.5 * UsdGeom.Cube(prim).GetSizeAttr().Get() * scale
        return norm(np.maximum(np.abs(local * scale) - half, 0.0), axis=1)
    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        corners = np.array(mesh.GetPointsAttr().Get(), dtype=float)[mesh.GetFaceVertexIndicesAttr().Get()]
        return touch.to_triangles(local, corners.reshape(-1, 3, 3))
    shape = (UsdGeom.Capsule if prim.IsA(UsdGeom.Capsule) else UsdGeom.Cylinder)(prim)
    half, radius = 0.5 * shape.GetHeightAttr().Get(), shape.GetRadiusAttr().Get()
    assert shape.GetAxisAttr().Get() == "Z"
    if prim.IsA(UsdGeom.Capsule):
        return norm(local - np.clip(local[:, 2:], -half, half) * [0, 0, 1], axis=1) - radius
    by = np.stack([norm(local[:, :2], axis=1) - radius, np.abs(local[:, 2]) - half], axis=1)
    return norm(np.maximum(by, 0.0), axis=1)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("shape", SHAPES)
def test_an_obstacle_is_drawn_where_cloth_touches_it(tmp_path, shape, moving):
    """The simulator's places of contact are on the file's surface, at every frame."""
    cloth = wy.paper.cloth(rows=5, columns=5, pose="flat")
    flat = cloth.position - cloth.position.mean(axis=0)
    k = np.arange(1, 4)[:, None]
    first = obstacle(shape)
    way = first.position + k * [2e-5, -1e-5, 1e-5]
    q = first.rotation + 0.01 * k * [1.0, -2.0, 3.0, 1.0]
    path = np.hstack([way, q / np.linalg.norm(q, axis=1, keepdims=True)])
    there = obstacle(shape, path=path if moving else None, friction=0.25)
    scene = wy.Scene(cloth, obstacles=[there])
    [each] = geometry.placed(still(cloth, scene))
    height = np.zeros(3)
    for _ in range(20):
        # down to where it touches
        height[2] += 0.95e-3 - touch.distances(each, each.local(flat + height, 0)).min()
    scene = scene.replace(cloth=cloth.replace(pose=flat + height))
    touched = 0
    for steps in (1, 2, 3):
        simulator = wy.Simulator(scene, integrator="implicit-euler")
        trajectory = simulator.run(steps)
        wy.write_usd(tmp_path / "a.usdc", trajectory)
        stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
        prim = stage.GetPrimAtPath(f"/obstacles/{shape}_0")
        touching = simulator.contacts()
        touched += len(touching)
        # single precision of the scale of a box, and of the points of a mesh
        np.testing.assert_allclose(distance_to(prim, touching.place, steps), 0.0, rtol=0, atol=2e-9)
        moved = {op.GetOpName() for op in UsdGeom.Xformable(prim).GetOrderedXformOps() if op.GetNumTimeSamples()}
        assert moved == ({"xformOp:translate", "xformOp:orient"} if moving else set())
        assert [prim.GetCustomDataByKey(key) for key in ("shape", "friction")] == [shape, 0.25]
    assert touched


def test_the_rectangle_of_a_plane_is_under_the_cloth_in_every_frame(tmp_path):
    trajectory = waving(frames=6)
    normal = np.array([1, 0.5, 2]) / 5.25**0.5
    plane = wy.Plane(point=(0.3, 0.1, 0), normal=normal, path=[[0.3 + 0.002 * k, 0.1, 0] for k in range(6)])
    trajectory = dataclasses.replace(trajectory, scene=wy.Scene(trajectory.cloth, obstacles=[plane]))
    stage, _ = written(tmp_path / "a.usda", trajectory)
    prim = stage.GetPrimAtPath("/obstacles/plane_0")
    for frame in range(6):
        expected = (trajectory.position[frame] - [0.3 + 0.002 * max(frame - 1, 0), 0.1, 0]) @ normal
        # distance_to asserts that they are over it
        np.testing.assert_allclose(distance_to(prim, trajectory.position[frame], frame), expected, rtol=0, atol=1e-15)
    assert UsdGeom.Plane(prim).GetWidthAttr().Get() < 0.1


def test_usd_validates_obstacles(tmp_path):
    trajectory = waving()
    several = [obstacle(shape, path=[[0, 0, 1e-4], [0, 0, 2e-4]]) for shape in SHAPES]
    trajectory = dataclasses.replace(trajectory, scene=wy.Scene(trajectory.cloth, obstacles=several))
    stage, _shapes = written(tmp_path / "a.usdc", trajectory)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [(error.GetName(), error.GetMessage()) for error in errors] == []
    assert stage.GetDefaultPrim().GetPath() == "/cloth"
    assert len(stage.GetPrimAtPath("/obstacles").GetChildren()) == 6
    assert not written(tmp_path / "b.usdc", waving())[0].GetPrimAtPath("/obstacles")


# -- tubes -----------------------------------------------------------------------------------------------------------


def catmull_rom(points, samples):
    """Points on the curve through points, whose ends are repeated, by the recursion of Barry and Goldman."""
    p = np.concatenate([points[:1], points, points[-1:]])
    t = np.linspace(0.0, 1.0, samples)[:, None]
    curve = []
    for a, b, c, d in zip(p, p[1:], p[2:], p[3:], strict=False):
        ab, bc, cd = -t * a + (1 + t) * b, (1 - t) * b + t * c, (2 - t) * c + (t - 1) * d
        abc, bcd = ((1 - t) * ab + (1 + t) * bc) / 2, ((2 - t) * bc + t * cd) / 2
        curve.append((1 - t) * abc + t * bcd)
    return np.concatenate(curve)


def mesh_of(shape):
    """Faces as lists of vertices, and the yarn of each vertex."""
    corners = np.array(shape.GetFaceVertexCountsAttr().Get())
    faces = np.split(np.array(shape.GetFaceVertexIndicesAttr().Get()), corners.cumsum()[:-1])
    yarn = np.arange(max(face.max() for face in faces) + 1)
    while True:
        # Faces pass on the smallest vertex that they are connected to.
        before = yarn.copy()
        for face in faces:
            yarn[face] = yarn[face].min()
        if (before == yarn).all():
            return faces, np.unique(yarn, return_inverse=True)[1]


@pytest.fixture
def thin(tmp_path):
    """Curves and tubes of yarns thin enough that no part of a tube is nearer to another part of its own curve."""
    trajectory = waving(radius=1e-4)
    stage, curves = written(tmp_path / "curves.usdc", trajectory)
    stage_of_tubes, meshes = written(tmp_path / "tubes.usdc", trajectory, tubes=True, sides=6)
    yield [(curves[name], meshes[name]) for name in curves]
    del stage, stage_of_tubes


@pytest.mark.slow
@pytest.mark.parametrize("frame", [0, 2])
def test_tubes_are_at_the_radius_from_their_curves_and_face_outward(thin, frame):
    for curve, mesh in thin:
        faces, yarn = mesh_of(mesh)
        points = points_of(mesh, frame)
        yarns = curves_of(curve, frame)
        assert yarn.max() + 1 == len(yarns)
        for k, nodes in enumerate(yarns):
            centres = catmull_rom(nodes, 400)
            mine = points[yarn == k]
            distance = np.linalg.norm(mine[:, None] - centres, axis=2)
            # Samples of the curve are up to 4 µm apart, which adds (2 µm)²/2R.
            np.testing.assert_allclose(distance.min(axis=1), 1e-4, rtol=0, atol=2e-8 + SINGLE)
            volume = 0.0
            for face in (f for f in faces if yarn[f[0]] == k):
                corner = points[face]
                middle = corner.mean(axis=0)
                # Newell's normal; on a flat polygon twice its area
                normal = np.cross(corner - middle, np.roll(corner, -1, axis=0) - middle).sum(axis=0)
                nearest = centres[np.linalg.norm(middle - centres, axis=1).argmin()]
                along = {0: nodes[0] - nodes[1], len(centres) - 1: nodes[-1] - nodes[-2]}
                cap = len(face) == 6
                out = min(along.values(), key=lambda a: -a @ normal) if cap else middle - nearest
                assert normal @ out > 0.0
                volume += (middle - nodes[0]) @ normal / 6.0
            length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
            # A hexagon's area along the curve (Pappus); chords at 4 to a segment are 1 % shorter.
            assert volume == pytest.approx(3.0 * np.sin(np.pi / 3) * 1e-8 * length, rel=0.02)


def test_tubes_are_closed(thin):
    for _, mesh in thin:
        faces, _ = mesh_of(mesh)
        edges = [tuple(edge) for face in faces for edge in zip(face, np.roll(face, -1), strict=True)]
        assert len(set(edges)) == len(edges)
        assert {(b, a) for a, b in edges} == set(edges)
        assert UsdGeom.Mesh.ValidateTopology(
            mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(points_of(mesh, 0))
        )[0]


def test_rings_do_not_twist():
    """From ring to ring, and at a yarn's first ring from frame to frame, no vector turns by more than the yarn does."""
    trajectory = waving(frames=20)
    for part in geometry.strands(trajectory):
        tubes = geometry.Tubes.around(part, sides=8, samples=4)
        _, _, tangents = part.sampled(4)
        across = tubes.across
        first = tubes.counts.cumsum() - tubes.counts
        inside = np.setdiff1d(np.arange(tubes.counts.sum()), first)
        turned = (tangents[:, inside] * tangents[:, inside - 1]).sum(axis=-1)
        moved = (tangents[1:, first] * tangents[:-1, first]).sum(axis=-1)
        for k in range(2):
            assert ((across[:, inside, k] * across[:, inside - 1, k]).sum(axis=-1) >= turned - 1e-12).all()
            assert ((across[1:, first, k] * across[:-1, first, k]).sum(axis=-1) >= moved - 1e-12).all()
        frames = np.concatenate([across, tangents[:, :, None]], axis=2)
        np.testing.assert_allclose(frames @ frames.swapaxes(2, 3), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(frames), 1.0, rtol=0, atol=1e-12)


def test_rings_of_a_yarn_in_a_plane_keep_their_angle_to_it():
    """The yarns of a flat cloth; vectors that were only projected from ring to ring would turn."""
    trajectory = two_colored("plain", frames=1)
    turn = rotation(np.array([0.5, -0.7, 0.9]))
    trajectory.position[0] = trajectory.cloth.position @ turn.T
    warp, weft = geometry.strands(trajectory)
    for part, normal in ((warp, turn[:, 1]), (weft, turn[:, 0])):
        tubes = geometry.Tubes.around(part, sides=8, samples=4)
        for across in np.split(tubes.across[0], tubes.counts.cumsum()[:-1]):
            cosines = across @ normal
            assert 0.05 < np.abs(cosines[0, 0]) < 0.999
            np.testing.assert_allclose(cosines, np.broadcast_to(cosines[0], cosines.shape), rtol=0, atol=1e-12)


def test_a_yarn_shrunk_to_a_point_or_folded_stays_finite(tmp_path, tubes):
    trajectory = waving(frames=4)
    x = trajectory.position.reshape(4, 6, 5, 3)
    x[1] = x[1, 0, 0]
    x[2, :, 3:] = x[2, :, 1::-1]
    _stage, shapes = written(tmp_path / "a.usdc", trajectory, tubes=tubes)
    for shape in shapes.values():
        assert all(np.isfinite(points_of(shape, frame)).all() for frame in range(4))
        assert all(np.isfinite(shape.GetExtentAttr().Get(frame)).all() for frame in range(4))


# -- files and arguments ---------------------------------------------------------------------------------------------


def fails(*_):
    raise OSError("no space left")


@pytest.mark.parametrize("existing", [None, b"precious"])
def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch, tubes, existing):
    path = tmp_path / "a.usdc"
    if existing is not None:
        path.write_bytes(existing)
    monkeypatch.setattr(usd, "_write_points", fails)
    with pytest.raises(OSError, match="no space left"):
        wy.write_usd(path, waving(), tubes=tubes)
    assert os.listdir(tmp_path) == ([] if existing is None else ["a.usdc"])
    assert existing is None or path.read_bytes() == existing


def test_a_full_disk_leaves_what_was_there(tmp_path):
    resource = pytest.importorskip("resource")
    path, trajectory = tmp_path / "a.usdc", waving()
    wy.write_usd(path, trajectory)
    size = path.stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, hard))
    try:
        with pytest.raises(OSError, match=r"a\.usdc cannot be written: .*File too large"):
            wy.write_usd(path, waving(frames=50))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == ["a.usdc"]
    assert path.stat().st_size == size


def test_no_stage_holds_the_file_when_it_is_moved(tmp_path, monkeypatch):
    """Windows would not move it."""
    seen, move = [], os.replace

    def replace(source, target):
        seen.append(Sdf.Layer.Find(str(source)))
        move(source, target)

    monkeypatch.setattr(os, "replace", replace)
    wy.write_usd(tmp_path / "a.usdc", waving())
    assert seen == [None]


def test_a_file_is_replaced(tmp_path):
    wy.write_usd(tmp_path / "a.usdc", waving(frames=2))
    wy.write_usd(str(tmp_path / "a.usdc"), waving(frames=3))
    assert Usd.Stage.Open(str(tmp_path / "a.usdc")).GetEndTimeCode() == 2.0
    assert os.listdir(tmp_path) == ["a.usdc"]


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("a.obj", {}, "must end in .usd, .usda, .usdc"),
        ("a", {}, "must end in .usd, .usda, .usdc"),
        ("missing/a.usdc", {}, "does not exist"),
        ("a.usdc", {"slowdown": 0.0}, "slowdown = 0.0, must be finite and above 0"),
        ("a.usdc", {"slowdown": np.inf}, "slowdown"),
        ("a.usdc", {"sides": 2}, "sides = 2, must be a whole number, at least 3"),
    ],
)
def test_wrong_arguments(tmp_path, name, options, message):
    with pytest.raises(wy.InputError, match=message):
        wy.write_usd(tmp_path / name, waving(), **options)
    assert os.listdir(tmp_path) == []


def test_wrong_trajectories(tmp_path):
    path, trajectory = tmp_path / "a.usdc", waving()
    with pytest.raises(wy.InputError, match="must be a Trajectory"):
        wy.write_usd(path, None)
    with pytest.raises(wy.InputError, match="no frame"):
        wy.write_usd(path, trajectory.cut(0))
    trajectory.position[1, 4, 2] = np.nan
    with pytest.raises(wy.InputError, match=r"trajectory.position\[1, 4, 2\] is nan"):
        wy.write_usd(path, trajectory)
    assert os.listdir(tmp_path) == []


# -- far from the origin, and again ----------------------------------------------------------------------------------


def in_world(shape, frame):
    """Points in double precision, as USD places them."""
    matrix = np.array(shape.ComputeLocalToWorldTransform(frame))
    return points_of(shape, frame) @ matrix[:3, :3] + matrix[3, :3]


@pytest.mark.parametrize("offset", [0.5, 1e3, 1e5, -1e7])
def test_a_cloth_far_away_keeps_its_shape(tmp_path, tubes, offset):
    """Its points are as near to the right ones as single precision brings a cloth to them that lies at the origin."""
    near, far = waving(), waving()
    middle = near.position.mean(axis=(0, 1))
    near.position -= middle
    far.position += np.array([offset, 0.0, -offset]) - middle
    _near, shapes = written(tmp_path / "near.usdc", near, tubes=tubes)
    _far, moved = written(tmp_path / "far.usdc", far, tubes=tubes)
    for name, shape in shapes.items():
        for frame in range(3):
            expected = in_world(shape, frame) + np.array([offset, 0.0, -offset])
            # doubles there have their own unit
            assert np.abs(in_world(moved[name], frame) - expected).max() < SINGLE + 1e-4 * RADIUS + 4e-16 * abs(offset)
            low, high = np.array(moved[name].GetExtentAttr().Get(frame))
            points = points_of(moved[name], frame)
            assert (low <= points.min(axis=0) + SINGLE).all() and (high >= points.max(axis=0) - SINGLE).all()


def test_a_cloth_that_moves_far_is_followed(tmp_path, tubes):
    """From the origin to 100 km away: no one translation is near to all of it."""
    trajectory, still = waving(), waving()
    way = np.array([[0.0, 0.0, 0.0], [1e2, 0.0, 0.0], [1e5, 0.0, -1e5]])
    trajectory.position += way[:, None]
    _still, shapes = written(tmp_path / "still.usdc", still, tubes=tubes)
    _stage, moved = written(tmp_path / "a.usdc", trajectory, tubes=tubes)
    for name, shape in shapes.items():
        for frame in range(3):
            expected = in_world(shape, frame) + way[frame]
            assert np.abs(in_world(moved[name], frame) - expected).max() < SINGLE + 1e-4 * RADIUS + 1e-10


def test_a_cloth_that_is_near_has_no_translation(tmp_path):
    stage, _ = written(tmp_path / "a.usdc", waving())
    assert not UsdGeom.Xformable(stage.GetPrimAtPath("/cloth")).GetOrderedXformOps()


@pytest.mark.parametrize("ending", usd.ENDINGS)
def test_a_rewritten_file_is_read_anew(tmp_path, monkeypatch, ending):
    """By stages that have it open, and by those opened later, whatever the path is called."""
    monkeypatch.chdir(tmp_path)
    os.symlink(f"a{ending}", f"link{ending}")
    for k, (first, again) in enumerate([("a", "a"), ("a", "link"), ("link", "a"), (str(tmp_path / "a"), "a")]):
        wy.write_usd(f"{first}{ending}", waving(frames=2 + k))
        stage = Usd.Stage.Open(f"{first}{ending}")
        wy.write_usd(f"{again}{ending}", waving(frames=9 + k))
        assert Usd.Stage.Open(f"{first}{ending}").GetEndTimeCode() == 8.0 + k
        assert stage.GetEndTimeCode() == 8.0 + k
        assert os.path.islink(f"link{ending}")
