"""Pictures and movies: their size, their colours, that everything is in view, and that movies move."""

import inspect
import os
import subprocess
import sys

import imageio.v2 as imageio
import numpy as np
import pytest
from internals import Picture, picture_times
from waving import BLUE, RED, waving

import warp_yarn as wy
from warp_yarn.simulation.packing import SHAPES
from warp_yarn.view import camera, geometry, raster, render, solids, yarns

SIZE = (160, 120)


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    """Eight frames of 1 ms as a movie at a hundredth of the speed: 7 ms take 0.7 s, so 21 pictures after the first."""
    trajectory = waving(frames=8)
    path = tmp_path_factory.mktemp("movie") / "a.mp4"
    wy.write_mp4(path, trajectory, fps=30, slowdown=100.0, size=SIZE)
    with imageio.get_reader(path) as reader:
        pictures = [reader.get_data(k) for k in range(reader.count_frames())]
        return trajectory, reader.get_meta_data(), np.array(pictures)


def nearest(image, color):
    """Distance of the pixel nearest to a colour, as the largest difference of red, green or blue [0 to 1]."""
    return np.abs(image[..., :3] / 255.0 - color).max(axis=-1).min()


def test_picture_has_its_size_and_the_colours_of_the_yarns(tmp_path):
    wy.write_png(tmp_path / "a.png", waving(), frame=1, size=SIZE)
    assert os.listdir(tmp_path) == ["a.png"]
    image = imageio.imread(tmp_path / "a.png")
    assert image.shape == (120, 160, 3)
    # Light takes some of a colour away and adds white, less than this where it falls on a yarn straight.
    assert nearest(image, RED) < 0.12
    assert nearest(image, BLUE) < 0.12
    # All four corners are background, which is light and grey.
    corners = image[[0, 0, -1, -1], [0, -1, 0, -1]] / 255.0
    assert corners.min() > 0.7
    assert np.ptp(corners, axis=1).max() < 0.08


def test_each_frame_has_its_own_picture(tmp_path):
    trajectory = waving()
    images = []
    for frame in (0, 2, -1):
        wy.write_png(tmp_path / "a.png", trajectory, frame=frame, size=SIZE)
        images.append(imageio.imread(tmp_path / "a.png").astype(float))
    assert np.abs(images[0] - images[1]).mean() > 2.0
    assert np.array_equal(images[2], images[1])


def picture(trajectory, at=(0,), size=SIZE, view=camera.VIEW, **options):
    settings = {"camera": None, "selvedge": False, "kind": "picture", **options}
    return Picture(trajectory, np.array(at, dtype=float), size, view, **settings)


@pytest.mark.parametrize("size", [SIZE, (333, 250), (640, 64)])
def test_the_same_picture_is_the_same(tmp_path, monkeypatch, size):
    """To the last pixel: drawn again, after other pictures, and in bands as large pictures are."""
    images = []
    for frame in (0, 1, 0):
        wy.write_png(tmp_path / "a.png", waving(), frame=frame, size=size)
        images.append(imageio.imread(tmp_path / "a.png"))
    assert np.array_equal(images[0], images[2]) and not np.array_equal(images[0], images[1])
    drawn = picture(waving(frames=1), size=size)
    assert all(np.array_equal(drawn.drawn(0), images[0]) for _ in range(3))
    monkeypatch.setattr(raster, "BAND", 7 * 9 * size[0])
    assert np.array_equal(drawn.drawn(0), images[0])


def test_pictures_of_a_camera_that_stays_differ_where_the_cloth_is(tmp_path):
    """The frames of one trajectory, and another cloth far away: only background."""
    trajectory = waving(frames=6)
    steady = wy.steady_camera(trajectory, size=SIZE)
    images = []
    for shown, frame in ((trajectory, 0), (trajectory, 5), (waving(), 0), (moved(waving(), [9.0, 0.0, 0.0]), 0)):
        wy.write_png(tmp_path / "a.png", shown, frame=frame, size=SIZE, camera=steady)
        images.append(imageio.imread(tmp_path / "a.png").astype(int))
    assert np.array_equal(images[0], images[2])
    assert np.array_equal(images[3], np.broadcast_to(render.BACKGROUND, images[3].shape))
    on_cloth = [np.abs(image - images[3]).max(axis=2) > 8 for image in images]
    assert (on_cloth[0] ^ on_cloth[1]).sum() > 500
    for seen in on_cloth[:2]:
        rows, columns = np.nonzero(seen)
        assert rows.min() > 0 and rows.max() < 119 and columns.min() > 0 and columns.max() < 159


def moved(trajectory, by):
    trajectory.position = trajectory.position + by
    return trajectory


SIDE = 1e-2
NEAR_BY = {
    "sphere": wy.Sphere(center=(0.02, 0.0, 0.04), radius=SIDE),
    "box": wy.Box(center=(0.03, 0.01, 0.04), half_extents=(SIDE, 2e-3, 2e-3)),
    "capsule": wy.Capsule(start=(0.03, 0.0, 0.045), end=(0.03, 0.01, 0.05), radius=2e-3),
    "cylinder": wy.Cylinder(start=(0.0, 0.0, 0.04), end=(0.01, 0.0, 0.04), radius=2e-3),
    "mesh": wy.TriangleMesh(SIDE * np.eye(3), [[0, 1, 2]], position=(0.01, -0.01, 0.03)),
    "moving": wy.Sphere(center=(0.02, 0.0, 0.05), radius=2e-3, path=[(0.03, 0.0, 0.05)]),
}
"""Beside a cloth of 5 mm, which they are up to 20 mm away from."""


@pytest.mark.parametrize("name", NEAR_BY)
def test_what_is_no_plane_is_in_the_picture_whole(name):
    """Its corners are in the picture of a camera that was not given, by the rule of three; and fill more of it."""
    trajectory = waving()
    alone = wy.steady_camera(trajectory, size=SIZE)
    trajectory.scene = wy.Scene(trajectory.cloth, obstacles=[NEAR_BY[name]])
    found = wy.steady_camera(trajectory, size=SIZE)
    assert found.distance > 1.05 * alone.distance
    high = np.tan(np.radians(0.5 * found.lens))
    for each in geometry.placed(trajectory):
        x, y, toward = np.moveaxis(found.seen(each.world(each.corners())), -1, 0)
        ahead = found.distance - toward
        assert np.abs(x / ahead).max() < high * SIZE[0] / SIZE[1] and np.abs(y / ahead).max() < high


@pytest.mark.parametrize(
    "obstacle",
    [
        wy.Plane(point=(0, 0, 0.0), normal=(0, 0, 1)),
        wy.Box(center=(0, 0, -1.0), half_extents=(1.0, 1.0, 1.0)),
        wy.Sphere(center=(1.0, 0, 0), radius=1e-3),
    ],
    ids=["plane", "table of 2 m", "ball at 1 m"],
)
def test_what_would_leave_the_cloth_too_small_is_not(obstacle):
    trajectory = waving()
    alone = wy.steady_camera(trajectory, size=SIZE)
    trajectory.scene = wy.Scene(trajectory.cloth, obstacles=[obstacle])
    assert wy.steady_camera(trajectory, size=SIZE).distance < 2.0 * alone.distance


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_from_straight_above_and_below_y_is_up(tmp_path, side):
    """A red weft yarn at large y, a blue warp yarn at large x, of a grey cloth that is flat."""
    grey = (0.5, 0.5, 0.5)
    trajectory = waving(colors=(RED, BLUE, grey), warp=[2] * 5 + [0], weft=[2] * 4 + [1], frames=1)
    trajectory.position[0] = trajectory.cloth.position
    wy.write_png(tmp_path / "a.png", trajectory, size=(120, 120), view=(0, 0, side))
    image = imageio.imread(tmp_path / "a.png").astype(int)
    red, blue = (image[..., a] - image[..., b] > 60 for a, b in ((0, 2), (2, 0)))
    assert red.sum() > 200 and blue.sum() > 200
    assert np.nonzero(red)[0].mean() < 40
    assert np.nonzero(blue)[1].mean() > 75 if side > 0 else np.nonzero(blue)[1].mean() < 45


def test_a_sphere_is_as_large_and_as_bright_as_it_is():
    """A disc of the radius that it has in perspective; its middle is lit as the formula says."""
    ball = geometry.Placed(wy.Sphere(center=(0, 0, 0), radius=1.0), np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]), 0, 0)
    vertices, normals, faces = solids.solid(ball)
    arrays = [raster.on_device(each, raster.wp.vec3) for each in (vertices, normals)]
    light = raster.on_device(np.ones(len(vertices)), float)
    surface = raster.Surface(raster.on_device(faces, raster.wp.vec3i), *arrays, light, (0.5, 0.25, 0.125))
    lamp = (0.0, 0.0, 1.0, 0.6)
    options = {"distance": 5.0, "focal": 400.0, "lamps": [lamp], "background": (1, 2, 3), "samples": 3}
    image = raster.picture([surface], (240, 200), **options)
    disc = (image != [1, 2, 3]).any(axis=2)
    # tangents from the eye: tan = r / √(d² − r²)
    assert np.sqrt(disc.sum() / np.pi) == pytest.approx(400.0 / 24.0**0.5, rel=0.005)
    rows, columns = np.nonzero(disc)
    assert (rows.mean(), columns.mean()) == (pytest.approx(99.5, abs=0.1), pytest.approx(119.5, abs=0.1))
    expected = np.array([0.5, 0.25, 0.125]) * (0.15 + 0.9 * 0.6) + 0.12 * 0.6
    np.testing.assert_allclose(image[100, 120] / 255.0, expected, atol=0.006)


def test_memory_of_a_picture_does_not_grow_with_the_frames(tmp_path):
    """Vertices and buffers are those of one frame."""
    few, many = picture(waving(frames=2), at=[0, 1]), picture(waving(frames=40), at=np.arange(40))
    sizes = [sum(tubes[0].places.nbytes for tubes in each.tubes) for each in (few, many)]
    assert sizes[0] == sizes[1]


def test_small_pictures_have_fewer_facets():
    thin, thick = (picture(waving(), size=size).tubes[0] for size in ((32, 24), (1280, 960)))
    assert thin[1] < thick[1] and len(thin[0].share) < len(thick[0].share)
    # within a quarter of a pixel of round
    half, sides = 3e-4 * picture(waving(), size=(1280, 960)).focal, thick[1]
    pixels = half / picture(waving(), size=(1280, 960)).camera.distance
    assert sides == render.MOST_SIDES or pixels * (1.0 - np.cos(np.pi / sides)) < 0.26


def test_the_upper_yarn_hides_the_lower_one(tmp_path):
    """A flat cloth, seen from almost above: its weft is on top where the draft has 0."""
    draft = np.zeros((5, 5))
    draft[1:-1, 2] = 1
    trajectory = waving(wy.Weave(draft), warp=[0] * 5, weft=[1] * 5, frames=1)
    trajectory.position[0] = trajectory.cloth.position
    wy.write_png(tmp_path / "a.png", trajectory, size=(201, 201), view=(0.0, -1e-3, 1.0))
    image = imageio.imread(tmp_path / "a.png")[..., :3].astype(float)
    seen = picture(trajectory, size=(201, 201), view=(0.0, -1e-3, 1.0)).camera
    # Orthographic to 2 %; a yarn is 12 pixels wide.
    across = seen.seen(trajectory.cloth.position)[:, :2]
    pixel = 100.5 + across * [1, -1] * 100.5 / (seen.distance * np.tan(np.radians(0.5 * seen.lens)))
    x, y = pixel.reshape(5, 5, 2)[1:-1, 1:-1].astype(int).transpose(2, 0, 1)
    red_on_top = image[y, x, 0] > image[y, x, 2]
    np.testing.assert_array_equal(red_on_top, draft[1:-1, 1:-1] == 1)


@pytest.mark.parametrize("view", [camera.VIEW, (0.0, -1.0, 0.0), (-3.0, 0.1, -5.0), (0.0, 0.0, 1.0)])
@pytest.mark.parametrize("aspect", [0.5, 2.0])
def test_camera_has_every_frame_in_view_and_is_no_farther_than_that(view, aspect):
    frames = waving(frames=6).position
    seen = wy.Camera.framing(frames, 3e-4, aspect, view)
    points = frames.reshape(-1, 3)
    toward = np.array(view) / np.linalg.norm(view)
    right = np.cross([0.0, 0.0, 1.0], toward) if view[:2] != (0.0, 0.0) else np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    depth = (seen.position - points) @ toward
    np.testing.assert_allclose(np.subtract(seen.position, seen.target), seen.distance * toward, atol=1e-15)
    extents = np.array([np.abs((points - seen.position) @ axis) for axis in (right, np.cross(toward, right))])
    slope = np.tan(np.radians(12.0)) * np.array([[aspect], [1.0]])
    # what a point needs of depth, with the margin: no point lacks any, and one has no more
    spare = depth - 1.08 * (extents + 3e-4) / slope
    assert spare.min() == pytest.approx(0.0, abs=1e-12 * seen.distance)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"target": (0, 0, 1)}, "target"),
        ({"up": (0, 0, 0)}, "up"),
        ({"lens": 0.0}, "lens"),
        ({"lens": 120.0}, "lens = 120"),
        ({"position": (0, np.nan, 0)}, "position"),
    ],
)
def test_wrong_cameras(options, message):
    with pytest.raises(wy.InputError, match=message):
        wy.Camera(**{"position": (0, 0, 1), "target": (0, 0, 0), **options})


def test_movie_has_its_size_length_and_rate(movie):
    _, about, pictures = movie
    assert about["fps"] == 30.0
    assert about["codec"] == "h264"
    assert pictures.shape == (22, 120, 160, 3)


def test_movie_moves_steadily_and_its_camera_stands(movie):
    _, _, pictures = movie
    steps = np.abs(np.diff(pictures.astype(float), axis=0)).mean(axis=(1, 2, 3))
    # A third of a frame from each picture to the next: none stands still.
    assert steps.min() > 0.25 * steps.max() > 0.25
    border = np.concatenate([pictures[:, :3].reshape(22, -1), pictures[:, :, :3].reshape(22, -1)], axis=1)
    # Compression
    assert np.abs(border.astype(float) - border[0]).max() < 8.0


def test_a_movie_is_from_the_first_to_the_last_frame(movie):
    trajectory, _, pictures = movie
    scene = picture(trajectory, at=np.arange(8))
    last, first = scene.drawn(7).astype(float), scene.drawn(0).astype(float)
    assert np.abs(pictures[-1] - last).mean() < 0.2 * np.abs(pictures[-1] - first).mean()
    assert np.abs(pictures[0] - first).mean() < 0.2 * np.abs(pictures[0] - last).mean()


def test_pictures_of_a_movie_are_along_straight_lines_between_frames():
    position = np.array([[[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], [[1.0, 4.0, 0.0]]])
    expected = [[0, 0, 0], [0.75, 0, 0], [1, 2, 0]]
    found = [geometry.between(position, at)[0] for at in picture_times(3, 0.75)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    # Neither the last frame is lost to rounding, nor is one past it made up.
    for rate, slowdown, count in ((24, 10, 121), (30, 1, 16), (30, 20, 301), (25, 7, 88)):
        times = picture_times(501, 1.0 / (rate * slowdown) / 1e-3)
        assert len(times) == count
        np.testing.assert_allclose(times, np.arange(count) * 1e3 / (rate * slowdown), rtol=1e-12)
    assert len(picture_times(1, 0.3)) == 1


@pytest.mark.parametrize(
    "progress, terminal, shown", [(False, True, 0), (True, False, 1), (None, True, 1), (None, False, 0)]
)
def test_progress_bar_on_request_or_on_terminals(tmp_path, monkeypatch, capsys, progress, terminal, shown):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    wy.write_mp4(tmp_path / "a.mp4", waving(frames=2), slowdown=100.0, size=(64, 48), progress=progress)
    assert ("drawing" in capsys.readouterr().err) == bool(shown)


def fails(*_):
    raise OSError("no space left")


@pytest.mark.parametrize("write, name", [(wy.write_png, "a.png"), (wy.write_mp4, "a.mp4")])
def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch, write, name):
    (tmp_path / name).write_bytes(b"precious")
    drawn = Picture.drawn
    last = 0 if name == "a.png" else 1
    monkeypatch.setattr(Picture, "drawn", lambda self, k: fails() if k == last else drawn(self, k))
    with pytest.raises(OSError, match="no space left"):
        write(tmp_path / name, waving(frames=101), size=SIZE)
    assert os.listdir(tmp_path) == [name]
    assert (tmp_path / name).read_bytes() == b"precious"


@pytest.mark.parametrize(
    "write, name, options, message",
    [
        (wy.write_png, "a.jpg", {}, "must end in .png"),
        (wy.write_mp4, "a.avi", {}, "must end in .mp4"),
        (wy.write_png, "missing/a.png", {}, "does not exist"),
        (wy.write_mp4, "missing/a.mp4", {}, "does not exist"),
        (wy.write_png, "a.png", {"frame": 3}, "frame = 3, must be a whole number from -3 to 2"),
        (wy.write_png, "a.png", {"frame": 0.5}, "frame = 0.5"),
        (wy.write_png, "a.png", {"size": 640}, "size = 640, must be a width and a height"),
        (wy.write_png, "a.png", {"size": (640, 8)}, r"size\[1\] = 8, must be a whole number, from 16 to 16384"),
        (wy.write_mp4, "a.mp4", {"size": (641, 480)}, r"size = \(641, 480\), must be even"),
        (wy.write_mp4, "a.mp4", {"slowdown": -1.0}, "slowdown = -1.0"),
        (wy.write_mp4, "a.mp4", {"fps": 0}, "fps = 0"),
        (wy.write_png, "a.png", {"view": (0, 0, 0)}, r"view = \(0, 0, 0\), must not be 0"),
        (wy.write_png, "a.png", {"size": (640, 16385)}, r"size\[1\] = 16385, must be a whole number, from 16 to 16384"),
        (wy.write_png, "a.png", {"camera": (0, 0, 1)}, "must be a Camera"),
        (wy.write_png, "a.png", {"view": (1, 0)}, "view has shape"),
    ],
)
def test_wrong_arguments(tmp_path, write, name, options, message):
    with pytest.raises(wy.InputError, match=message):
        write(tmp_path / name, waving(), **options)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("write, name", [(wy.write_png, "a.png"), (wy.write_mp4, "a.mp4")])
def test_wrong_trajectories(tmp_path, write, name):
    with pytest.raises(wy.InputError, match="must be a Trajectory"):
        write(tmp_path / name, None)
    with pytest.raises(wy.InputError, match="no frame"):
        write(tmp_path / name, waving().cut(0))


@pytest.mark.parametrize("module", ["imageio.v2", "imageio_ffmpeg"])
def test_absent_packages_are_named(tmp_path, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        wy.InputError, match=rf"{module.split('.')[0]} is not .*pip install .\.\[render\].*pip install .imageio"
    ):
        wy.write_mp4(tmp_path / "a.mp4", waving(), size=SIZE)
    assert os.listdir(tmp_path) == []


TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


@pytest.mark.parametrize("shape", SHAPES)
def test_solids_are_closed_face_outward_and_are_as_large_as_they_are(shape):
    """By the volume within their faces, and normals at right angles to the surface."""
    half, radius = 0.7, 0.5
    make = {
        "plane": (wy.Plane(point=(0, 0, 0), normal=(0, 0, 1)), 0.0),
        "sphere": (wy.Sphere(center=(0, 0, 0), radius=radius), 4 / 3 * np.pi * radius**3),
        "capsule": (
            wy.Capsule(start=(0, 0, -half), end=(0, 0, half), radius=radius),
            np.pi * radius**2 * 2 * half + 4 / 3 * np.pi * radius**3,
        ),
        "cylinder": (wy.Cylinder(start=(0, 0, -half), end=(0, 0, half), radius=radius), np.pi * radius**2 * 2 * half),
        "box": (wy.Box(center=(0, 0, 0), half_extents=(0.5, 0.6, 0.7)), 8 * 0.5 * 0.6 * 0.7),
        "mesh": (
            wy.TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]),
            1 / 6,
        ),
    }
    obstacle, volume = make[shape]
    placed = geometry.Placed(obstacle, np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]), 1.0, 2.0)
    vertices, normals, faces = solids.solid(placed)
    corners = vertices[faces]
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # 96 facets around
    assert np.einsum("ij,ij->", corners[:, 0], area) / 3.0 == pytest.approx(volume, rel=3e-3)
    if shape == "plane":
        np.testing.assert_allclose(area.sum(axis=0), [0, 0, 2.0], atol=1e-12)
    real = np.linalg.norm(area, axis=1) > 1e-12
    cosine = np.einsum("ijk,ik->ij", normals[faces], yarns.unit(area))[real]
    assert cosine.min() > 0.98


def test_nothing_of_it_is_imported_before_it_is_needed(tmp_path):
    code = "import sys, warp_yarn; sys.exit(any(m in sys.modules for m in ('viser', 'imageio')))"
    # elsewhere than in the checkout, whose warp_yarn/ would hide the installed one
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def test_movies_and_usd_files_have_the_same_names_and_defaults(tmp_path):
    """And say how slow they are: a second of a movie without a slowdown is one of the simulation."""
    of_movie, of_usd = (inspect.signature(write).parameters for write in (wy.write_mp4, wy.write_usd))
    same = {name: parameter.default for name, parameter in of_movie.items() if name in of_usd}
    assert {"fps": 24.0, "slowdown": 1.0, "selvedge": False}.items() <= same.items()
    assert same == {name: of_usd[name].default for name in same}
    trajectory = waving(frames=101)
    wy.write_mp4(tmp_path / "a.mp4", trajectory, size=(64, 48))
    with imageio.get_reader(tmp_path / "a.mp4") as reader:
        assert reader.count_frames() == 3  # at 0, 1/24 and 2/24 s, of 0.1 s
    assert b"One second of simulated time takes 1 s to play" in (tmp_path / "a.mp4").read_bytes()


def test_the_old_name_of_a_movie_s_rate(tmp_path):
    with pytest.warns(DeprecationWarning, match="frames_per_second is fps now"):
        wy.write_mp4(tmp_path / "a.mp4", waving(frames=2), frames_per_second=30, slowdown=100.0, size=SIZE)
    with imageio.get_reader(tmp_path / "a.mp4") as reader:
        assert reader.get_meta_data()["fps"] == 30
