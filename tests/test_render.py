"""Pictures and movies: their size, their colours, that everything is in view, and that movies move."""

import ctypes.util
import os
import re
import subprocess
import sys

import imageio.v2 as imageio
import numpy as np
import pytest
import vtkmodules.vtkRenderingCore
from internals import Camera, Picture, pyvista, resampled
from waving import BLUE, RED, waving

import warp_yarn as wy
from warp_yarn.view import geometry, render

pytestmark = pytest.mark.slow  # VTK takes seconds to load and to draw

SIZE = (160, 120)


@pytest.fixture(scope="module")
def drawing():
    try:
        pyvista()
    except wy.InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def movie(drawing, tmp_path_factory):
    """Eight frames of 1 ms as a movie at a hundredth of the speed: 7 ms take 0.7 s, so 21 pictures after the first."""
    trajectory = waving(frames=8)
    path = tmp_path_factory.mktemp("movie") / "a.mp4"
    wy.write_mp4(path, trajectory, frames_per_second=30, slowdown=100.0, size=SIZE)
    with imageio.get_reader(path) as reader:
        pictures = [reader.get_data(k) for k in range(reader.count_frames())]
        return trajectory, reader.get_meta_data(), np.array(pictures)


def nearest(image, color):
    """Distance of the pixel nearest to a colour, as the largest difference of red, green or blue [0 to 1]."""
    return np.abs(image[..., :3] / 255.0 - color).max(axis=-1).min()


def test_picture_has_its_size_and_the_colours_of_the_yarns(drawing, tmp_path):
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


def test_each_frame_has_its_own_picture(drawing, tmp_path):
    trajectory = waving()
    images = []
    for frame in (0, 2, -1):
        wy.write_png(tmp_path / "a.png", trajectory, frame=frame, size=SIZE)
        images.append(imageio.imread(tmp_path / "a.png").astype(float))
    assert np.abs(images[0] - images[1]).mean() > 2.0
    assert np.array_equal(images[2], images[1])


@pytest.mark.parametrize("size", [SIZE, (333, 250), (640, 64)])
def test_the_same_picture_is_the_same(drawing, tmp_path, size):
    """To the last pixel: drawn again in one window, and in another one after other pictures."""
    images = []
    for frame in (0, 1, 0):
        wy.write_png(tmp_path / "a.png", waving(), frame=frame, size=size)
        images.append(imageio.imread(tmp_path / "a.png"))
    assert np.array_equal(images[0], images[2]) and not np.array_equal(images[0], images[1])
    with Picture(waving(frames=1), size, render.VIEW) as picture:
        assert all(np.array_equal(picture.drawn(0), images[0]) for _ in range(3))


@pytest.mark.parametrize("upright", [False, True])
def test_a_picture_larger_than_the_machine_draws_is_refused(drawing, tmp_path, upright):
    """And the largest is not black."""
    with pytest.raises(wy.InputError, match=r"size = .*, must be at most \d+ pixels wide and high") as error:
        wy.write_png(tmp_path / "a.png", waving(), size=(16, 100_000) if upright else (100_000, 16))
    assert os.listdir(tmp_path) == []
    largest = int(re.search(r"at most (\d+)", str(error.value))[1])
    if largest > 8000:
        pytest.skip("takes much memory")
    wy.write_png(tmp_path / "a.png", waving(), size=(16, largest) if upright else (largest, 16))
    assert imageio.imread(tmp_path / "a.png")[..., :3].min(axis=-1).max() > 200
    with pytest.raises(wy.InputError, match="must be at most"):
        wy.write_png(tmp_path / "a.png", waving(), size=(16, largest + 1) if upright else (largest + 1, 16))
    with pytest.raises(wy.InputError, match="must be at most"):
        wy.write_mp4(tmp_path / "a.mp4", waving(), size=(largest + 1, 16))


def test_the_upper_yarn_hides_the_lower_one(drawing, tmp_path):
    """A flat cloth, seen from almost above: its weft is on top where the draft has 0."""
    draft = np.zeros((5, 5))
    draft[1:-1, 2] = 1
    trajectory = waving(wy.Weave(draft), warp=[0] * 5, weft=[1] * 5, frames=1)
    trajectory.position[0] = trajectory.cloth.position
    wy.write_png(tmp_path / "a.png", trajectory, size=(201, 201), view=(0.0, -1e-3, 1.0))
    image = imageio.imread(tmp_path / "a.png")[..., :3].astype(float)
    camera = Camera.framing(geometry.strands(trajectory)[0].points[0], 3e-4, 1.0, (0.0, -1e-3, 1.0))
    # Orthographic to 2 %; a yarn is 12 pixels wide.
    across = (trajectory.cloth.position @ camera.axes.T - camera.centre)[:, :2]
    pixel = 100.5 + across * [1, -1] * 100.5 / (camera.distance * np.tan(np.radians(0.5 * render.LENS)))
    x, y = pixel.reshape(5, 5, 2)[1:-1, 1:-1].astype(int).transpose(2, 0, 1)
    red_on_top = image[y, x, 0] > image[y, x, 2]
    np.testing.assert_array_equal(red_on_top, draft[1:-1, 1:-1] == 1)


@pytest.mark.parametrize("view", [render.VIEW, (0.0, -1.0, 0.0), (-3.0, 0.1, -5.0)])
@pytest.mark.parametrize("aspect", [0.5, 2.0])
def test_camera_has_every_frame_in_view_and_is_no_farther_than_that(view, aspect):
    points = np.concatenate([part.points.reshape(-1, 3) for part in geometry.strands(waving(frames=6))])
    camera = Camera.framing(points, 3e-4, aspect, view)
    eye = camera.world([0.0, 0.0, camera.distance])
    toward = np.array(view) / np.linalg.norm(view)
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    depth = (eye - points) @ toward
    extents = [(np.abs((points - eye) @ axis) + 3e-4) / depth for axis in (right, np.cross(toward, right))]
    fraction = np.array(extents) / np.tan(np.radians(12.0)) / [[aspect], [1.0]]
    assert fraction.max() == pytest.approx(1.0 / render.MARGIN, rel=1e-12)
    near, far = camera.clipping
    assert 0.0 < near < depth.min() - 3e-4
    assert far > depth.max() + 3e-4


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
    with Picture(trajectory, SIZE, render.VIEW) as picture:
        last, first = picture.drawn(7).astype(float), picture.drawn(0).astype(float)
    assert np.abs(pictures[-1] - last).mean() < 0.2 * np.abs(pictures[-1] - first).mean()
    assert np.abs(pictures[0] - first).mean() < 0.2 * np.abs(pictures[0] - last).mean()


def test_pictures_of_a_movie_are_along_straight_lines_between_frames():
    position = np.array([[[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], [[1.0, 4.0, 0.0]]])
    expected = [[0, 0, 0], [0.75, 0, 0], [1, 2, 0]]
    np.testing.assert_allclose(resampled(position, 0.75)[:, 0], expected, rtol=0, atol=1e-15)
    # Neither the last frame is lost to rounding, nor is one past it made up.
    long = np.arange(501.0)[:, None, None]
    for rate, slowdown, count in ((24, 10, 121), (30, 1, 16), (30, 20, 301), (25, 7, 88)):
        pictures = resampled(long, 1.0 / (rate * slowdown) / 1e-3)
        assert len(pictures) == count
        np.testing.assert_allclose(pictures[:, 0, 0], np.arange(count) * 1e3 / (rate * slowdown), rtol=1e-12)
    assert len(resampled(position[:1], 0.3)) == 1


def test_progress_bar_on_request_only(drawing, tmp_path, capsys):
    for progress in (False, True):
        wy.write_mp4(tmp_path / "a.mp4", waving(frames=2), slowdown=100.0, size=(64, 48), progress=progress)
        assert ("drawing" in capsys.readouterr().err) is progress


def fails(*_):
    raise OSError("no space left")


@pytest.mark.parametrize("write, name", [(wy.write_png, "a.png"), (wy.write_mp4, "a.mp4")])
def test_a_write_that_fails_leaves_what_was_there(drawing, tmp_path, monkeypatch, write, name):
    (tmp_path / name).write_bytes(b"precious")
    drawn = Picture.drawn
    monkeypatch.setattr(Picture, "drawn", lambda self, k, *path: fails() if k or path else drawn(self, k))
    with pytest.raises(OSError, match="no space left"):
        write(tmp_path / name, waving(frames=8), size=SIZE)
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
        (wy.write_png, "a.png", {"size": (640, 8)}, r"size\[1\] = 8, must be a whole number, at least 16"),
        (wy.write_mp4, "a.mp4", {"size": (641, 480)}, r"size = \(641, 480\), must be even"),
        (wy.write_mp4, "a.mp4", {"slowdown": -1.0}, "slowdown = -1.0"),
        (wy.write_mp4, "a.mp4", {"frames_per_second": 0}, "frames_per_second = 0"),
        (wy.write_png, "a.png", {"view": (0, 0, 1)}, r"view = \(0, 0, 1\), must not be vertical"),
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


@pytest.mark.parametrize("module", ["pyvista", "imageio.v2", "imageio_ffmpeg"])
def test_absent_packages_are_named(tmp_path, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        wy.InputError, match=rf"{module.split('.')[0]} is not .*pip install .\.\[render\].*pip install .pyvista"
    ):
        wy.write_mp4(tmp_path / "a.mp4", waving(), size=SIZE)
    assert os.listdir(tmp_path) == []


def test_a_machine_without_opengl_gets_an_error_and_no_crash(tmp_path, monkeypatch):
    """VTK then has only a window for a library that is not there, which crashes once it is drawn in."""
    window = type("vtkOSOpenGLRenderWindow", (), {})
    monkeypatch.setattr(vtkmodules.vtkRenderingCore, "vtkRenderWindow", window)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(wy.InputError, match="no OpenGL"):
        wy.write_png(tmp_path / "a.png", waving(), size=SIZE)
    assert os.listdir(tmp_path) == []


def test_nothing_of_it_is_imported_before_it_is_needed(tmp_path):
    code = "import sys, warp_yarn; sys.exit(any(m in sys.modules for m in ('pyvista', 'vtkmodules', 'imageio')))"
    # elsewhere than in the checkout, whose warp_yarn/ would hide the installed one
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)
