"""Pictures and movies of a trajectory."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tqdm

from ..errors import InputError, integer, missing_extra, real
from ..io.files import atomic_write
from ..simulation.state import Trajectory
from . import raster
from .camera import VIEW, Camera
from .geometry import OBSTACLE_COLOR, Placed, between, checked, in_view, placed
from .solids import solid
from .yarns import Tubes, Weaving

LARGEST = 16384
"""Pixels of a picture, wide or high."""
SAMPLES = {"picture": 3, "movie": 2}
"""Of a pixel, along either axis."""
FACET = 0.25
"""How far a tube's facets may be from round, in pixels."""
MOST_SIDES, MOST_RINGS = 24, 8
BACKGROUND = (219, 222, 227)
LAMPS = (((-0.6, 0.6, 0.9), 0.85), ((0.8, -0.3, 0.7), 0.35), ((0.0, -0.9, 0.4), 0.2), ((0.3, 0.9, -0.5), 0.4))
"""Where light comes from as the camera sees it (right, up, toward it), and how bright it is: key light, fill, one from
below for the undersides, one from behind for the rims."""


def write_png(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    frame: int = -1,
    size: Sequence[int] = (1280, 960),
    view: Sequence[float] = VIEW,
    camera: Camera | None = None,
    selvedge: bool = False,
) -> None:
    """Draws one frame of a trajectory: every yarn a smooth tube in the colour of its material; and the obstacles, of a
    plane a rectangle beneath the cloth.

    Yarns are woven to the very edge, where free ends stick out by a fraction of a spacing that no simulation knows of.
    Needs the extra ``render``. The same picture is the same to the last pixel. The file appears whole or not at all.

    Args:
        path: of the picture, ending in .png.
        trajectory: what to draw, at least one frame.
        frame: which frame; negative ones count from the end.
        size: width and height in pixels, from 16 to 16384.
        view: direction from the cloth to the camera, 3 numbers, not 0; from straight above y is up in the picture.
        camera: where to look from; None: from where the frame fills the picture, with the obstacles that are not planes
            and, together with the cloth, no more than 4 times as large as that. ``Camera.of`` gives one for
            several pictures.
        selvedge: weft yarns turn at the edge and go on as the next one of their material, and do not end there.

    Raises:
        InputError: an argument is out of its range, the folder of `path` does not exist, or imageio is not installed.
    """
    _check_ending(path, ".png")
    size = checked_size("size", size)
    position = checked(trajectory)
    frames = len(position)
    if not isinstance(frame, int | np.integer) or not -frames <= frame < frames:
        raise InputError(f"frame = {frame!r}, must be a whole number from {-frames} to {frames - 1}")
    imageio = _extra("imageio.v2")
    at = np.array([range(frames)[frame]])
    scene = _Picture(trajectory, at, size, view, camera, selvedge, "picture")
    with atomic_write(path) as temporary:
        imageio.imwrite(temporary, scene.drawn(0))


def write_mp4(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    fps: float = 24.0,
    slowdown: float = 1.0,
    size: Sequence[int] = (960, 720),
    view: Sequence[float] = VIEW,
    camera: Camera | None = None,
    selvedge: bool = False,
    progress: bool | None = None,
    frames_per_second: float | None = None,
) -> None:
    """Draws a trajectory as a movie (H.264), seen by a camera that stands still.

    Picture k shows time k / (fps · slowdown); between two frames of the trajectory every node is taken
    to move along a straight line, and every obstacle to move and turn steadily. The file's comment says the slowdown.
    Needs the extra ``render``. The file appears whole or not at all.

    Args:
        path: of the movie, ending in .mp4.
        trajectory: what to draw, at least one frame.
        fps: pictures in one second of playing time, above 0.
        slowdown: seconds of playing time for one second of simulated time, above 0, as of ``write_usd``.
        size: width and height in pixels, even, from 16 to 16384.
        view, camera, selvedge: as of ``write_png``; without a camera every frame is in view.
        progress: show a progress bar; None: where stderr is a terminal.
        frames_per_second: the old name of fps.

    Raises:
        InputError: an argument is out of its range, the folder of `path` does not exist, or imageio is not installed.
    """
    _check_ending(path, ".mp4")
    if frames_per_second is not None:
        warnings.warn("write_mp4's frames_per_second is fps now", DeprecationWarning, stacklevel=2)
        fps = frames_per_second
    rate = real("fps", fps, above=0.0)
    slowdown = real("slowdown", slowdown, above=0.0)
    apart = 1.0 / (rate * slowdown)
    size = checked_size("size", size, movie=True)
    imageio = _extra("imageio.v2")
    _extra("imageio_ffmpeg")
    at = _times(len(checked(trajectory)), apart / trajectory.step)
    scene = _Picture(trajectory, at, size, view, camera, selvedge, "movie")
    with atomic_write(path) as temporary:
        # Blocks of 2, since H.264 needs even sizes only and imageio would scale to multiples of 16.
        said = ["-metadata", f"comment=One second of simulated time takes {slowdown:g} s to play."]
        options = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "output_params": said}
        writer = imageio.get_writer(temporary, fps=rate, **options)
        disable = None if progress is None else not progress
        with writer:
            for frame in tqdm.trange(len(at), desc="drawing", unit="picture", disable=disable):
                writer.append_data(scene.drawn(frame))


def check_drawing(*, movies: bool = False) -> None:
    """Finds out whether pictures, or movies too, can be drawn, before there is anything to draw.

    Raises:
        InputError: an extra is not installed.
    """
    for module in ("imageio.v2", "imageio_ffmpeg")[: 1 + movies]:
        _extra(module)


def steady_camera(trajectory: Trajectory, *, size: Sequence[int] = (1280, 960), view: Sequence[float] = VIEW) -> Camera:
    """Finds a camera that has every frame of a trajectory in view, for pictures of several of them.

    Args:
        trajectory: what is to be drawn, at least one frame.
        size, view: as of ``write_png``.

    Raises:
        InputError: an argument is out of its range.
    """
    size, at = checked_size("size", size), np.arange(len(checked(trajectory)))
    return framed(trajectory, Weaving(trajectory.cloth), placed(trajectory, at), at, size, view)


def framed(
    trajectory: Trajectory,
    weaving: Weaving,
    obstacles: Sequence[Placed],
    at: np.ndarray,
    size: tuple[int, int],
    view: Sequence[float],
) -> Camera:
    """Finds a camera that has the yarns at so many times in view, and obstacles as ``in_view`` says."""
    half = max(float(strands.half.max()) for strands in weaving.strands)
    low, high = trajectory.position.min(axis=(0, 1)), trajectory.position.max(axis=(0, 1))

    def frames() -> Iterator[np.ndarray]:
        for when in at:
            look = weaving.look(between(trajectory.position, when))
            yield np.concatenate([strands.points(*look) for strands in weaving.strands])
        yield from in_view(obstacles, low, high)

    return Camera.framing(frames(), half, size[0] / size[1], view)


class _Picture:
    """What is in a picture at so many times, in frames of the trajectory, which need not be whole.

    Without a camera it has the yarns of all of them in view, and obstacles as ``in_view`` says.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        at: np.ndarray,
        size: tuple[int, int],
        view: Sequence[float],
        camera: Camera | None,
        selvedge: bool,
        kind: str,
    ):
        self.trajectory, self.at, self.size, self.samples = trajectory, at, size, SAMPLES[kind]
        self.weaving = Weaving(trajectory.cloth, selvedge=selvedge)
        self.obstacles = placed(trajectory, at)
        if camera is not None and not isinstance(camera, Camera):
            raise InputError(f"camera = {camera!r}, must be a Camera")
        self.camera = camera or framed(trajectory, self.weaving, self.obstacles, at, size, view)
        self.focal = 0.5 * size[1] / np.tan(np.radians(0.5 * self.camera.lens))
        self.tubes = []
        for strands in self.weaving.strands:
            pixels = self.focal / self.camera.distance
            thick, long = pixels * strands.half.max(), pixels * np.abs(np.diff(strands.arc)).min()
            sides = int(np.clip(np.pi / np.arccos(max(1.0 - FACET / max(thick, 2 * FACET), 0.5)), 6, MOST_SIDES))
            tubes = Tubes.around(strands, samples=int(np.clip(long / 6.0, 2, MOST_RINGS)))
            full = np.repeat(strands.half[:, 1], tubes.counts)
            rings, cap = tubes.capped
            # 1 among other yarns, 0 at a free end
            covered = tubes.between((strands.across[:, 0] > 0.0).astype(float))
            shade = np.stack([tubes.height, 1.0 / (1.6 * full), covered], axis=1)
            faces = raster.on_device(tubes.triangles(sides), raster.wp.vec3i)
            self.tubes.append((tubes, sides, faces, rings, np.column_stack([shade[rings], cap])))
        self.solids = [solid(each) for each in self.obstacles]

    def drawn(self, frame: int) -> np.ndarray:
        """Draws it at one of the times [height, width, 3]."""
        places, normals = self.weaving.look(between(self.trajectory.position, self.at[frame]))
        surfaces = []
        for tubes, sides, faces, rings, shade in self.tubes:
            centre, across = tubes.rings(places, normals)
            seen = {"centre": self.camera.seen(centre)[rings], "across": (across @ self.camera.axes.T)[rings]}
            surfaces.append(raster.tube(sides, faces, tubes.strands.color, half=tubes.half[rings], shade=shade, **seen))
        for each, (vertices, out, corners) in zip(self.obstacles, self.solids, strict=True):
            matrix = each.matrix(frame)
            surfaces.append(
                raster.Surface(
                    raster.on_device(corners, raster.wp.vec3i),
                    raster.on_device(self.camera.seen(vertices @ matrix[:3, :3].T + matrix[:3, 3]), raster.wp.vec3),
                    raster.on_device(out @ matrix[:3, :3].T @ self.camera.axes.T, raster.wp.vec3),
                    raster.on_device(np.ones(len(vertices)), float),
                    OBSTACLE_COLOR,
                    two_sided=True,
                )
            )
        lamps = [(*(np.array(way) / np.linalg.norm(way)), bright) for way, bright in LAMPS]
        return raster.picture(
            surfaces,
            self.size,
            distance=self.camera.distance,
            focal=self.focal,
            lamps=lamps,
            background=BACKGROUND,
            samples=self.samples,
        )


def _times(frames: int, apart: float) -> np.ndarray:
    """Lists 0, apart, 2 apart, ... up to the last frame."""
    # Where a picture falls on the last frame, rounding must not lose it.
    return np.arange(np.floor((frames - 1) / apart + 1e-9) + 1.0) * apart


def _check_ending(path: str | os.PathLike, ending: str) -> None:
    if Path(path).suffix != ending:
        raise InputError(f"path = {str(path)!r}, must end in {ending}")


def checked_size(name: str, size: Sequence[int], *, movie: bool = False) -> tuple[int, int]:
    """Gives a width and a height in pixels, or an InputError."""
    if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
        raise InputError(f"{name} = {size!r}, must be a width and a height in pixels")
    width, height = (integer(f"{name}[{k}]", size[k], least=16, most=LARGEST) for k in (0, 1))
    if movie and (width % 2 or height % 2):
        raise InputError(f"{name} = {width, height}, must be even in a movie")
    return width, height


def _extra(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing_extra(module.partition(".")[0], "pictures need", "render") from error
