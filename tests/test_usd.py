"""USD files: what the validators of usd-core do not see, such as extents, counts, and which yarn is on top."""

import dataclasses
import itertools
import math
import os

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation
from scripts import load
from waving import BLUE, RED, waving

import warp_yarn as wy
from warp_yarn.io import usd
from warp_yarn.simulation.packing import SHAPES
from warp_yarn.view import geometry, solids, yarns

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
    """The file's stage, which has to be kept, and its yarns by name; frames of 1 ms are at whole time codes."""
    wy.write_usd(path, trajectory, **{"fps": 1000.0, **options})
    stage = Usd.Stage.Open(str(path))
    shapes = {prim.GetName(): prim for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)}
    schema = UsdGeom.Mesh if options.get("tubes") else UsdGeom.BasisCurves
    return stage, {name: schema(prim) for name, prim in shapes.items()}


def points_of(shape, frame):
    return np.array(shape.GetPointsAttr().Get(frame), dtype=np.float64)


def curves_of(shape, frame):
    """The curves of a prim, each without its free ends and repeated end points."""
    return [curve[1:-1] for curve in with_ends(shape, frame)]


def with_ends(shape, frame):
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
    height = np.where(trajectory.cloth.weave.draft, -RADIUS, RADIUS)
    assert np.ptp(height[0]) and np.ptp(height[:, -1])
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
    for frame, (j, i) in itertools.product(range(len(trajectory)), np.argwhere(border)):
        # at right angles to the two yarns that meet there
        along_warp = x[frame, j, min(i + 1, 4)] - x[frame, j, max(i - 1, 0)]
        along_weft = x[frame, min(j + 1, 5), i] - x[frame, max(j - 1, 0), i]
        normal = np.cross(along_warp, along_weft)
        normal *= (-1.0 if trajectory.cloth.weave.draft[j, i] else 1.0) / np.linalg.norm(normal)
        np.testing.assert_allclose(apart[frame, j, i], 2 * RADIUS * normal, rtol=0, atol=2 * SINGLE)


def test_free_ends_stick_out_of_the_yarns_that_they_cross_last(tmp_path):
    """By four tenths of a spacing, straight on, from where they lie on it until they slope by a half; not below the
    cloth's middle."""
    trajectory = two_colored("plain")
    _stage, shapes = written(tmp_path / "a.usda", trajectory)
    x = trajectory.position.reshape(-1, 6, 5, 3)
    for frame in range(len(trajectory)):
        for curve, nodes in zip(with_ends(shapes["yarn_0"], frame), x[frame], strict=True):
            for end, before, tip in ((nodes[0], nodes[1], curve[0]), (nodes[-1], nodes[-2], curve[-1])):
                way = (end - before) / np.linalg.norm(end - before)
                off = tip - end - (RADIUS + 4e-4) * way
                assert abs(off @ way) < SINGLE
                leaves = math.atan(2.0)
                down = 0.5 * (RADIUS + 4e-4 - 2.0 * RADIUS * math.cos(leaves))
                height = max(RADIUS * (2.0 * math.sin(leaves) - 1.0) - down, 0.0)
                assert np.linalg.norm(off) == pytest.approx(height, abs=SINGLE)


def test_selvedges_turn_from_each_weft_yarn_to_the_next(tmp_path):
    trajectory = two_colored("twill")
    _stage, shapes = written(tmp_path / "a.usda", trajectory)
    _stage2, turned = written(tmp_path / "b.usda", trajectory, selvedge=True)
    assert list(shapes["yarn_0"].GetCurveVertexCountsAttr().Get()) == [9] * 6
    assert list(turned["yarn_0"].GetCurveVertexCountsAttr().Get()) == [9] * 6
    # five yarns with their free ends, which are joined by a point each
    assert list(turned["yarn_1"].GetCurveVertexCountsAttr().Get()) == [5 * 8 + 4 + 2]
    for frame in range(len(trajectory)):
        [one] = with_ends(turned["yarn_1"], frame)
        for k, curve in enumerate(with_ends(shapes["yarn_1"], frame)):
            np.testing.assert_array_equal(one[9 * k : 9 * k + 8], curve[::-1] if k % 2 else curve)
        tops = one[8::9]
        ends = np.array([(one[9 * k + 7], one[9 * k + 9]) for k in range(4)])
        # half circles
        distance = np.linalg.norm(ends - tops[:, None], axis=2)
        apart = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        np.testing.assert_allclose(distance, (0.5**0.5 * apart)[:, None].repeat(2, 1), rtol=0.15)
    arc = UsdGeom.PrimvarsAPI(turned["yarn_1"]).GetPrimvar("arc").Get()
    assert (np.diff(arc[1:-1]) > 0.0).all()
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(_stage2)


def test_curves_are_catmull_rom_with_their_ends_repeated(tmp_path):
    trajectory = waving()
    _stage, shapes = written(tmp_path / "a.usdc", trajectory)
    # Six warp and five weft yarns, alternating.
    assert {name: list(s.GetCurveVertexCountsAttr().Get()) for name, s in shapes.items()} == {
        "yarn_0": [9] * 3 + [10] * 3,
        "yarn_1": [9] * 3 + [10] * 2,
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


def test_yarns_say_which_they_are_and_how_far_along(tmp_path, tubes):
    """Also where they have slid, which is all that moves of u here."""
    trajectory = waving()
    trajectory.euler = trajectory.euler + np.array([0.0, 1e-4, 2e-4])[:, None, None] * [1.0, 0.0]
    _stage, shapes = written(tmp_path / "a.usdc", trajectory, tubes=tubes)
    warp, weft = [k for k in range(6)], [6 + k for k in range(5)]
    for name, expected in (("yarn_0", warp[::2] + weft[::2]), ("yarn_1", warp[1::2] + weft[1::2])):
        shape = shapes[name]
        yarn, arc = (UsdGeom.PrimvarsAPI(shape).GetPrimvar(each) for each in ("yarn", "arc"))
        assert (yarn.GetInterpolation(), arc.GetInterpolation()) == ("uniform", "vertex")
        if tubes:
            # the yarn of each face is that of what is connected with it
            faces, connected = mesh_of(shape)
            pairs = {(int(connected[face[0]]), k) for face, k in zip(faces, yarn.Get(), strict=True)}
            assert len(pairs) == len(expected) and sorted(k for _, k in pairs) == sorted(expected)
            assert len(arc.Get(1)) == len(points_of(shape, 1))
            continue
        assert list(yarn.Get()) == expected
        ends = np.cumsum(shape.GetCurveVertexCountsAttr().Get())
        for frame in range(3):
            for k, along in zip(expected, np.split(np.array(arc.Get(frame)), ends[:-1]), strict=True):
                nodes = 1e-3 * np.arange(5 if k < 6 else 6) + (1e-4 * frame if k < 6 else 0.0)
                np.testing.assert_allclose(along[2:-2], nodes, rtol=0, atol=1e-9)
                np.testing.assert_allclose(along[[1, -2]], nodes[[0, -1]] + [-7e-4, 7e-4], rtol=0, atol=1e-9)


def test_velocities_are_those_of_points(tmp_path, tubes):
    """Of a cloth that turns and moves as a rigid body, twice as slow as it is: ω × x + v, halved."""
    trajectory = waving(frames=1)
    spin, drift = np.array([3.0, -40.0, 15.0]), np.array([0.1, 0.0, -0.2])
    trajectory.velocity = np.cross(spin, trajectory.position) + drift
    _stage, shapes = written(tmp_path / "a.usdc", trajectory, tubes=tubes, slowdown=2.0, surface=True)
    assert len(shapes) == 3
    for shape in shapes.values():
        expected = 0.5 * (np.cross(spin, points_of(shape, 0)) + drift)
        # points in single precision, and a turn of 1e-4 R on their way
        np.testing.assert_allclose(shape.GetVelocitiesAttr().Get(0), expected, rtol=0, atol=1e-6 * 4)
    _stage2, without = written(tmp_path / "b.usdc", trajectory, tubes=tubes, velocities=False)
    assert not any(shape.GetVelocitiesAttr().HasAuthoredValue() for shape in without.values())


def test_a_cloth_at_rest_has_velocity_0(tmp_path, tubes):
    _stage, shapes = written(tmp_path / "a.usdc", waving(frames=2), tubes=tubes)
    for shape in shapes.values():
        assert np.array_equal(shape.GetVelocitiesAttr().Get(1), 0.0 * points_of(shape, 1))


def test_the_surface_is_the_cloths_middle_and_has_texture_coordinates(tmp_path):
    trajectory = waving()
    stage, _ = written(tmp_path / "a.usdc", trajectory, surface=True)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/cloth/surface"))
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()).reshape(6, 5, 2)
    np.testing.assert_allclose(st[..., 0], np.tile(np.linspace(0, 1, 5), (6, 1)), rtol=1e-6)
    np.testing.assert_allclose(st[..., 1], np.tile(np.linspace(1, 0, 6)[:, None], (1, 5)), rtol=1e-6, atol=1e-7)
    for frame in range(3):
        np.testing.assert_allclose(points_of(mesh, frame), trajectory.position[frame], rtol=0, atol=SINGLE)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    corners = trajectory.cloth.position[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert area == pytest.approx(4e-3 * 5e-3, rel=1e-12)


def test_each_material_has_its_own_yarns(tmp_path):
    """Their points are a radius from the nodes'."""
    trajectory = waving(colors=(RED, BLUE, None), warp=[2, 0, 0, 0, 0, 0], weft=[0, 0, 0, 0, 2])
    _stage, shapes = written(tmp_path / "a.usdc", trajectory)
    assert sorted(shapes) == ["yarn_0", "yarn_2"]
    top, right = curves_of(shapes["yarn_2"], 2)
    x = trajectory.position[2].reshape(6, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(top - x[0], axis=1), RADIUS, rtol=0, atol=SINGLE)
    np.testing.assert_allclose(np.linalg.norm(right - x[:, -1], axis=1), RADIUS, rtol=0, atol=SINGLE)


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
        material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        assert shader.GetInput("diffuseColor").Get() == colors[name]
    np.testing.assert_allclose(colors["yarn_0"], [0.21404114, 0.04 / 12.92, 1.0], rtol=1e-6)
    # Coral by default: more red than green, more green than blue.
    assert np.diff(colors["yarn_1"]).max() < -0.05


@pytest.mark.parametrize("slowdown, fps, apart", [(1.0, 24.0, 0.024), (20.0, 24.0, 0.48), (100.0, 30.0, 3.0)])
def test_frames_are_where_they_are_when_played(tmp_path, tubes, slowdown, fps, apart):
    """And the file says how much slower that is."""
    options = {} if fps == 24.0 else {"fps": fps}
    wy.write_usd(tmp_path / "a.usda", waving(frames=4), tubes=tubes, slowdown=slowdown, **options)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, pytest.approx(3.0 * apart, rel=1e-9))
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps
    assert stage.GetDefaultPrim().GetPath() == "/cloth"
    layer = stage.GetRootLayer()
    assert dict(layer.customLayerData) == {"slowdown": slowdown, "step": 1e-3}
    assert f"takes {slowdown:g} s to play" in layer.comment
    samples = UsdGeom.PointBased(stage.GetPrimAtPath("/cloth/yarn_0")).GetPointsAttr().GetTimeSamples()
    assert samples == pytest.approx([0.0, apart, 2 * apart, 3 * apart], rel=1e-9)


def test_points_move_and_nothing_else_does(tmp_path, tubes):
    _stage, shapes = written(tmp_path / "a.usdc", waving(), tubes=tubes)
    for shape in shapes.values():
        moving = {a.GetName() for a in shape.GetPrim().GetAuthoredAttributes() if a.GetNumTimeSamples()}
        assert moving == {"points", "extent", "velocities", "primvars:arc"}
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
        wy.write_usd(tmp_path / "a.usdc", trajectory, fps=1000.0)
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
    drawn = [prim for prim in stage.GetPrimAtPath("/obstacles").GetChildren() if prim.IsA(UsdGeom.Gprim)]
    assert len(drawn) == 6
    assert all(UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0] for prim in drawn)
    assert not written(tmp_path / "b.usdc", waving())[0].GetPrimAtPath("/obstacles")


def triangles(tubes, sides):
    """The faces of tubes as triangles."""
    corners, vertices = tubes.faces(sides)
    faces = np.split(vertices, corners.cumsum()[:-1])
    return np.array([(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)])


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
        yarns = with_ends(curve, frame)
        assert yarn.max() + 1 == len(yarns)
        for k, nodes in enumerate(yarns):
            centres = catmull_rom(nodes, 400)
            mine = points[yarn == k]
            distance = np.linalg.norm(mine[:, None] - centres, axis=2)
            # the curve's points are not between the cloth's middle and its normals as those of tubes are: by about R
            # times the square of the angle of normals from node to node, up to 0.4 here
            np.testing.assert_allclose(distance.min(axis=1), 1e-4, rtol=0, atol=2e-5)
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


def test_sections_are_across_the_yarn_and_as_wide_along_the_cloth_as_it_is():
    """Whatever the weave, rings are at right angles to their yarn, and their width to the cloth's normal too."""
    trajectory = waving("satin", radius=1e-4)
    weaving = yarns.Weaving(trajectory.cloth)
    for frame, strands in itertools.product(range(3), weaving.strands):
        look = weaving.look(trajectory.position[frame])
        tubes = yarns.Tubes.around(strands, samples=40)
        centre, across = tubes.rings(*look)
        frames = np.concatenate([across, np.cross(across[:, :1], across[:, 1:])], axis=1)
        np.testing.assert_allclose(frames @ frames.swapaxes(1, 2), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-12)
        inside = np.delete(np.arange(len(centre) - 1), tubes.counts.cumsum()[:-1] - 1)
        ahead = yarns.unit(centre[inside + 1] - centre[inside])
        # chords of a 40th of a segment, in which a yarn turns by up to 0.05, and normals that are not held for fixed
        assert (ahead * frames[inside, 2]).sum(axis=1).min() > 0.99
        at_nodes = tubes.share == 0.0
        normal = look[1][tubes.places[at_nodes, 1]]
        np.testing.assert_allclose((across[at_nodes, 0] * normal).sum(axis=1), 0.0, atol=1e-12)


def winding(points, vertices, faces):
    """How often closed surfaces go around points: the solid angles of their triangles over 4 π."""
    a, b, c = (vertices[faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(each, axis=2) for each in (a, b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2((a * np.cross(b, c)).sum(2), below).sum(1) / (2.0 * np.pi)


def test_the_winding_number_tells_inside_from_outside():
    cube = wy.Box(center=(0, 0, 0), half_extents=(1, 1, 1))
    vertices, _, faces = solids.solid(geometry.Placed(cube, np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]), 0.0, 0.0))
    found = winding(np.array([[0.9, 0.9, -0.9], [0.0, 0.0, 0.0], [1.1, 0.0, 0.0], [3.0, 2.0, 1.0]]), vertices, faces)
    np.testing.assert_allclose(found, [1, 1, 0, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("radius, off", [(2e-4, 0.1), (2.8e-4, 0.1), (4e-4, 0.1), (5e-4, 0.25)])
def test_tubes_do_not_run_through_each_other(weave, radius, off):
    """On a flat cloth, of any cover: a yarn with a little of its section taken off is outside of the others. A tenth is
    for facets, and for yarns that are not straight over the width of what crosses them; at the fullest cover, where
    neighbours touch all along, there is no room between them for those that pass."""
    trajectory = two_colored(weave, frames=1, radius=radius)
    weaving = yarns.Weaving(trajectory.cloth)
    look = weaving.look(trajectory.cloth.position)
    tubes = [yarns.Tubes.around(strands, samples=6) for strands in weaving.strands]
    for one, others in (tubes, tubes[::-1]):
        centre, _ = one.rings(*look)
        second = slice(one.counts[0], one.counts[:2].sum())
        vertices = one.vertices(*look, 12).reshape(-1, 12, 3)[second]
        smaller = centre[second, None] + (1.0 - off) * (vertices - centre[second, None])
        around = winding(smaller.reshape(-1, 3), others.vertices(*look, 12), triangles(others, 12))
        assert np.abs(around).max() < 0.5


OUTLINES = {
    "rectangle": lambda c: wy.outline.rectangle(*c.size, center=c.middle),
    "bias": lambda c: wy.outline.rectangle(7e-3, 3.5e-3, angle=45.0, center=c.middle),
    "disc": lambda c: wy.outline.disc(3.3e-3, center=c.middle),
}


@pytest.mark.slow
@pytest.mark.parametrize("shape", OUTLINES)
@pytest.mark.parametrize("weaves, radius", [("plain", 3.3e-4), ("plain", 5e-4), ("2/2 twill", 4.5e-4)])
def test_free_ends_are_whole_and_in_no_other_yarn(weaves, shape, radius):
    """Of what is cut out of a flat cloth: the sections of free ends are those of the yarn, and a quarter less of them
    is outside of all yarns of the other direction."""
    size = 6 if shape == "rectangle" else 11
    weave = wy.Weave.from_notation(weaves, rows=size, columns=size)
    yarns_of_both = [wy.Yarn(density=5e-5, stretch=1e7, bend=0.05)] * 2
    whole = wy.Cloth(weave, yarns=yarns_of_both, warp=[0] * size, weft=[1] * size, radius=radius, pose="flat")
    cloth = whole.cut(OUTLINES[shape](whole))
    weaving = yarns.Weaving(cloth)
    look = weaving.look(cloth.position)
    tubes = [yarns.Tubes.around(strands, samples=4) for strands in weaving.strands]
    for one, others in (tubes, tubes[::-1]):
        crossed = one.strands.across[:, 0] > 0.0
        ends = crossed[one.points].sum(axis=1) == 1
        np.testing.assert_allclose(one.half[ends], radius, rtol=1e-12)
        centre, _ = one.rings(*look)
        smaller = centre[:, None] + 0.75 * (one.vertices(*look, 8).reshape(-1, 8, 3) - centre[:, None])
        around = winding(smaller[ends].reshape(-1, 3), others.vertices(*look, 8), triangles(others, 8))
        assert np.abs(around).max() < 0.5


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
    monkeypatch.setattr(usd, "write_points", fails)
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
    wy.write_usd(str(tmp_path / "a.usdc"), waving(frames=3), fps=1000)
    assert Usd.Stage.Open(str(tmp_path / "a.usdc")).GetEndTimeCode() == 2.0
    assert os.listdir(tmp_path) == ["a.usdc"]


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("a.obj", {}, "must end in .usd, .usda, .usdc, .usdz"),
        ("a", {}, "must end in .usd, .usda, .usdc, .usdz"),
        ("missing/a.usdc", {}, "does not exist"),
        ("a.usdc", {"slowdown": 0.0}, "slowdown = 0.0, must be finite and above 0"),
        ("a.usdc", {"slowdown": np.inf}, "slowdown"),
        ("a.usdc", {"fps": 0.0}, "fps = 0.0, must be finite and above 0"),
        ("a.usdc", {"fps": np.nan}, "fps"),
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


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
def test_velocities_are_as_exact_far_away(tmp_path, tubes, offset):
    """Differences are taken where positions are fine enough for them."""
    trajectory = waving(frames=1)
    spin = np.array([3.0, -40.0, 15.0])
    trajectory.velocity = np.cross(spin, trajectory.position)
    _stage, near = written(tmp_path / "near.usdc", trajectory, tubes=tubes)
    trajectory.position = trajectory.position + offset
    _far, far = written(tmp_path / "far.usdc", trajectory, tubes=tubes)
    # of 0.3 m/s; positions at 1e6 m are rounded by 1e-10 m, of yarns of 3e-4 m that turn by that over their half height
    bound = 1e-6 + 1e-9 * offset
    for name, shape in far.items():
        expected = near[name].GetVelocitiesAttr().Get(0)
        np.testing.assert_allclose(shape.GetVelocitiesAttr().Get(0), expected, rtol=0, atol=bound)


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
        wy.write_usd(f"{again}{ending}", waving(frames=9 + k), fps=1000)
        assert Usd.Stage.Open(f"{first}{ending}").GetEndTimeCode() == 8.0 + k
        assert stage.GetEndTimeCode() == 8.0 + k
        assert os.path.islink(f"link{ending}")
