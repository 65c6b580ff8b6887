"""Pictures and movies of a trajectory, drawn off-screen by PyVista."""

from __future__ import annotations

import ctypes.util
import dataclasses
import importlib
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tqdm

from ..description.obstacles import TriangleMesh
from ..errors import InputError, finite_array, integer, missing_extra, real
from ..io.files import atomic_write
from ..simulation.state import Trajectory
from .geometry import OBSTACLE_COLOR, Placed, Tubes, checked, placed, strands

VIEW = (0.8, 1.0, 0.4)
SIDES, SAMPLES = 16, 6
"""Corners of a yarn's ring, and rings a segment: facets are then under a pixel on a yarn 75 pixels wide."""
LENS = 24.0
"""Vertical angle of view [degrees]: narrow, so that near and far yarns look equally thick."""
MARGIN = 1.08
"""Size of the picture over that of what is in it."""
BACKGROUND = "#dbdee3"
ROUND = 96
"""Facets around an obstacle that is round."""
SURROUNDINGS = 0.15
"""How far about the yarns obstacles are in view, over the largest extent of these: what is beyond may be cut off."""
OVERSAMPLING = 5.0**0.5
"""Of VTK's anti-aliasing, along either axis."""
SURFACE = {"ambient": 0.15, "diffuse": 0.9, "specular": 0.12, "specular_power": 12}
LIGHTS = (((-0.6, 0.6, 0.9), 0.85), ((0.8, -0.3, 0.7), 0.35), ((0.0, -0.9, 0.4), 0.2), ((0.3, 0.9, -0.5), 0.4))
"""Where lights stand as the camera sees it (right, up, toward it), in distances to the camera, and how bright they are:
key light, fill, one from below for the undersides, one from behind for the rims."""


def write_png(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    frame: int = -1,
    size: Sequence[int] = (1280, 960),
    view: Sequence[float] = VIEW,
) -> None:
    """Draws one frame of a trajectory: every yarn a smooth tube in the colour of its material; and the obstacles, of a
    plane a rectangle beneath the cloth.

    Needs the extra ``render``. The same picture is the same to the last pixel on one machine. The file appears whole
    or not at all.

    Args:
        path: of the picture, ending in .png.
        trajectory: what to draw, at least one frame.
        frame: which frame; negative ones count from the end.
        size: width and height in pixels, at least 16, at most what the machine's OpenGL can draw (7327 in software).
        view: direction from the cloth to the camera, 3 numbers, not vertical.

    Raises:
        InputError: an argument is out of its range, the folder of `path` does not exist, PyVista is not installed, or
            the machine has no OpenGL.
    """
    _check_ending(path, ".png")
    size = _checked_size(size)
    position = checked(trajectory)
    frames = len(position)
    if not isinstance(frame, int | np.integer) or not -frames <= frame < frames:
        raise InputError(f"frame = {frame!r}, must be a whole number from {-frames} to {frames - 1}")
    shown = dataclasses.replace(trajectory, position=position[[frame]])
    at = np.array([range(frames)[frame]])
    with atomic_write(path) as temporary, _Picture(shown, size, view, at) as picture:
        picture.drawn(0, temporary)


def write_mp4(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    frames_per_second: float = 30.0,
    slowdown: float = 10.0,
    size: Sequence[int] = (960, 720),
    view: Sequence[float] = VIEW,
    progress: bool = False,
) -> None:
    """Draws a trajectory as a movie (H.264), seen by a camera that stands still.

    Picture k shows time k / (frames_per_second · slowdown); between two frames of the trajectory every node is taken
    to move along a straight line, and every obstacle to move and turn steadily. Needs the extra ``render``. The file
    appears whole or not at all.

    Args:
        path: of the movie, ending in .mp4.
        trajectory: what to draw, at least one frame.
        frames_per_second: pictures in one second of playing time, above 0.
        slowdown: seconds of playing time for one second of simulated time, above 0.
        size: width and height in pixels, even, at least 16, at most as of a picture.
        view: direction from the cloth to the camera, 3 numbers, not vertical.
        progress: show a progress bar.

    Raises:
        InputError: an argument is out of its range, the folder of `path` does not exist, PyVista or imageio is not
            installed, or the machine has no OpenGL.
    """
    _check_ending(path, ".mp4")
    rate = real("frames_per_second", frames_per_second, above=0.0)
    apart = 1.0 / (rate * real("slowdown", slowdown, above=0.0))
    size = _checked_size(size)
    if size[0] % 2 or size[1] % 2:
        raise InputError(f"size = {size}, must be even in a movie")
    imageio = _extra("imageio.v2")
    _extra("imageio_ffmpeg")
    position = checked(trajectory)
    at = _times(len(position), apart / trajectory.step)
    movie = dataclasses.replace(trajectory, position=_resampled(position, apart / trajectory.step))
    with atomic_write(path) as temporary, _Picture(movie, size, view, at) as picture:
        # Blocks of 2, since H.264 needs even sizes only and imageio would scale to multiples of 16.
        writer = imageio.get_writer(temporary, fps=rate, codec="libx264", quality=8, macro_block_size=2)
        with writer:
            for frame in tqdm.trange(len(movie), desc="drawing", unit="picture", disable=not progress):
                writer.append_data(picture.drawn(frame))


def check_drawing(*, movies: bool = False) -> None:
    """Finds out whether pictures, or movies too, can be drawn, before there is anything to draw.

    Raises:
        InputError: an extra is not installed, or the machine has no OpenGL.
    """
    _pyvista()
    if movies:
        _extra("imageio.v2")
        _extra("imageio_ffmpeg")


class _Picture:
    """The yarns and obstacles in a scene of PyVista, and a camera that has the yarns of every frame in view, and of the
    obstacles what is near. ``at``: as of ``placed``."""

    def __init__(
        self, trajectory: Trajectory, size: tuple[int, int], view: Sequence[float], at: np.ndarray | None = None
    ):
        parts = strands(trajectory)
        radius = trajectory.cloth.radius
        self.obstacles = placed(trajectory, at)
        points = np.concatenate([part.points for part in parts], axis=1).reshape(-1, 3)
        around = [each.world(each.corners()).reshape(-1, 3) for each in self.obstacles]
        shown = [np.clip(corners, *_surroundings(points)) for corners in around]
        camera = _Camera.framing(np.concatenate([points, *shown]), radius, size[0] / size[1], view)
        pv = _pyvista()
        self.tubes = [Tubes.around(part, radius, sides=SIDES, samples=SAMPLES) for part in parts]
        self.plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
        self._check_size(size)
        # one colour: a gradient is drawn by a shader that leaves what the shading of nooks reads undefined, so that
        # pictures would differ from time to time
        self.plotter.set_background(BACKGROUND)
        self.meshes = []
        for tubes, part in zip(self.tubes, parts, strict=True):
            corners, vertices = tubes.faces()
            mesh = pv.PolyData(tubes.vertices(0), faces=np.insert(vertices, corners.cumsum() - corners, corners))
            self.meshes.append(mesh)
            actor = self.plotter.add_mesh(mesh, color=part.color, **SURFACE)
            actor.prop.interpolation = "Phong"
        self.actors = [
            self.plotter.add_mesh(_surface(pv, each), color=OBSTACLE_COLOR, smooth_shading=True, split_sharp_edges=True)
            for each in self.obstacles
        ]
        for actor in self.actors:
            for name, value in SURFACE.items():
                setattr(actor.prop, name, value)
        for place, intensity in LIGHTS:
            position = camera.world(camera.distance * np.array(place))
            self.plotter.add_light(pv.Light(position=position, focal_point=camera.world(), intensity=intensity))
        self.plotter.camera.position = camera.world([0.0, 0.0, camera.distance])
        self.plotter.camera.focal_point = camera.world()
        self.plotter.camera.up = camera.axes[1]
        self.plotter.camera.view_angle = LENS
        self.plotter.camera.clipping_range = camera.clipping_with(np.concatenate([points, *around]), radius)
        self.plotter.enable_anti_aliasing("ssaa")
        # Yarns darken where others are near: without it one does not see which lies over which.
        self.plotter.enable_ssao(radius=3.0 * radius, bias=0.1 * radius, kernel_size=16)

    def _check_size(self, size: tuple[int, int]) -> None:
        """Refuses what the machine's OpenGL has no textures for: it would be black."""
        textures = _extra("vtkmodules.vtkRenderingOpenGL2").vtkTextureObject
        self.plotter.render_window.Initialize()
        largest = int(textures.GetMaximumTextureSize(self.plotter.render_window) / OVERSAMPLING)
        if max(size) > largest > 0:
            self.plotter.close()
            raise InputError(f"size = {size}, must be at most {largest} pixels wide and high on this machine")

    def __enter__(self) -> _Picture:
        return self

    def __exit__(self, *_: object) -> None:
        self.plotter.close()

    def drawn(self, frame: int, path: Path | None = None) -> np.ndarray:
        """Draws one frame as an image [height, width, 3], written to path if one is given."""
        for mesh, tubes in zip(self.meshes, self.tubes, strict=True):
            mesh.points = tubes.vertices(frame)
            mesh.point_data.active_normals = tubes.normals(frame)
        for actor, each in zip(self.actors, self.obstacles, strict=True):
            actor.user_matrix = each.matrix(frame)
        self.plotter.render()
        return self.plotter.screenshot(path, return_img=True)


@dataclasses.dataclass(frozen=True)
class _Camera:
    axes: np.ndarray
    """[3, 3]: unit vectors right, up and toward the camera."""
    centre: np.ndarray
    """What it looks at, along these axes [3] (m)."""
    distance: float
    clipping: tuple[float, float]

    @classmethod
    def framing(cls, points: np.ndarray, radius: float, aspect: float, view: Sequence[float]) -> _Camera:
        """Looks along −view from as near as has all points in the picture, with their yarns around them."""
        toward = finite_array("view", view, (3,))
        right = np.cross([0.0, 0.0, 1.0], toward)
        if np.linalg.norm(right) <= 1e-6 * np.linalg.norm(toward):
            raise InputError(f"view = {tuple(view)}, must not be vertical")
        toward /= np.linalg.norm(toward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(toward, right), toward])
        seen = points @ axes.T
        centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
        seen -= centre
        slope = np.tan(np.radians(0.5 * LENS)) * np.array([aspect, 1.0])
        distance = (seen[:, 2] + MARGIN * ((np.abs(seen[:, :2]) + radius) / slope).max(axis=1)).max()
        reach = np.abs(seen[:, 2]).max() + 2.0 * radius
        return cls(axes, centre, distance, (max(distance - reach, 0.01 * distance), distance + reach))

    def clipping_with(self, points: np.ndarray, radius: float) -> tuple[float, float]:
        """Sets how near and far it sees, to have points in the picture that it was not framed for."""
        depth = self.distance - (points @ self.axes[2] - self.centre[2])
        near = max(depth.min() - 2.0 * radius, 0.01 * self.distance)
        return min(self.clipping[0], near), max(self.clipping[1], depth.max() + 2.0 * radius)

    def world(self, place: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Finds a place seen from the centre along the axes, in the cloth's coordinates."""
        return (self.centre + np.asarray(place)) @ self.axes


def _surroundings(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the box [3], [3] (m) in which obstacles are to be in view, about all that is drawn of the yarns."""
    low, high = points.min(axis=0), points.max(axis=0)
    more = SURROUNDINGS * (high - low).max()
    return low - more, high + more


def _surface(pv: Any, placed: Placed) -> Any:
    """Makes an obstacle in its own frame, as a mesh of PyVista."""
    obstacle, axis = placed.obstacle, (0.0, 0.0, 1.0)
    if isinstance(obstacle, TriangleMesh):
        return pv.PolyData(obstacle.vertices, faces=np.insert(obstacle.faces, 0, 3, axis=1))
    if obstacle.shape == "plane":
        return pv.Plane(direction=axis, i_size=placed.width, j_size=placed.length)
    if obstacle.shape == "box":
        x, y, z = obstacle.size
        return pv.Box((-x, x, -y, y, -z, z))
    if obstacle.shape == "sphere":
        return pv.Sphere(radius=obstacle.size[0], theta_resolution=ROUND, phi_resolution=ROUND)
    half, radius, _ = obstacle.size
    if obstacle.shape == "cylinder":
        return pv.Cylinder(direction=axis, radius=radius, height=2.0 * half, resolution=ROUND)
    return pv.Capsule(direction=axis, radius=radius, cylinder_length=2.0 * half, resolution=ROUND)


def _times(frames: int, apart: float) -> np.ndarray:
    """Lists 0, apart, 2 apart, ... up to the last frame."""
    # Where a picture falls on the last frame, rounding must not lose it.
    return np.arange(np.floor((frames - 1) / apart + 1e-9) + 1.0) * apart


def _resampled(position: np.ndarray, apart: float) -> np.ndarray:
    """Interpolates positions at frames 0, apart, 2 apart, ... up to the last, in between them along straight lines."""
    last, at = len(position) - 1, _times(len(position), apart)
    before = np.minimum(at.astype(int), last)
    after = np.minimum(before + 1, last)
    share = (at - before)[:, None, None]
    return (1.0 - share) * position[before] + share * position[after]


def _check_ending(path: str | os.PathLike, ending: str) -> None:
    if Path(path).suffix != ending:
        raise InputError(f"path = {str(path)!r}, must end in {ending}")


def _checked_size(size: Sequence[int]) -> tuple[int, int]:
    if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
        raise InputError(f"size = {size!r}, must be a width and a height in pixels")
    return integer("size[0]", size[0], least=16), integer("size[1]", size[1], least=16)


def _extra(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise missing_extra(name, "pictures need", "render") from error


_LOADING = threading.Lock()
"""Two threads that import PyVista at once each see half of it."""


def _pyvista() -> Any:
    """Imports PyVista, where VTK can draw; where it cannot, VTK would end the process by a segmentation fault."""
    with _LOADING:
        pv = _loaded_pyvista()
        # it imports what draws when that is first asked for
        _ = pv.Plotter, pv.PolyData, pv.Light
        return pv


def _loaded_pyvista() -> Any:
    pv = _extra("pyvista")
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # By itself VTK tries X11 first, and crashes where that is not installed.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    _extra("vtkmodules.vtkRenderingOpenGL2")  # which makes the window below one of a kind that this machine can open
    window = _extra("vtkmodules.vtkRenderingCore").vtkRenderWindow()
    if type(window).__name__ == "vtkOSOpenGLRenderWindow" and ctypes.util.find_library("OSMesa") is None:
        raise InputError("this machine has no OpenGL, which pictures need: install EGL, such as by apt install libegl1")
    return pv
