"""Trajectories as USD files."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, integer, real
from ..simulation.state import Trajectory
from ..view.geometry import OBSTACLE_COLOR, Placed, checked, placed
from ..view.yarns import Strands, Weaving
from .files import atomic_write
from .usd_prims import Curves, Shape, Surface, TubeMesh, bind, linear, material, vectors, write_obstacle, write_points

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import UsdGeom

LAYERS = (".usd", ".usda", ".usdc")
ENDINGS = (*LAYERS, ".usdz")
COARSE = 1e-4
PENDING = 1 << 26
"""Bytes of frames that are kept in memory until they are written."""


def write_usd(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    tubes: bool = False,
    slowdown: float = 1.0,
    sides: int = 8,
    fps: float = 24.0,
    velocities: bool = True,
    surface: bool = False,
    selvedge: bool = False,
) -> None:
    """Writes every frame of a trajectory as a USD file: /cloth, and below it one prim for each yarn material; and
    /obstacles, where there are any, and below it one prim for each.

    Yarns are cubic Catmull-Rom curves (``UsdGeom.BasisCurves``) with their end points repeated, as wide as the yarn,
    over and under each other as the draft says, to the very edge, where free ends stick out by a fraction of a spacing
    that no simulation knows of. Each has the primvars ``yarn``, its index, warp yarns first, and ``arc``, the length
    of yarn from its node at u = 0 or v = 0 (m). Materials are ``UsdPreviewSurface``.

    A second of simulated time takes `slowdown` seconds to play, so frame k is at time code k · step · slowdown · fps,
    which need not be whole; the layer's comment and its custom data ``slowdown`` and ``step`` say so. Lengths are in
    metres, z is up. Points are in single precision. Where that would be too coarse, far from the origin, they are
    relative to a translation of /cloth, which is in double precision. The file appears whole or not at all; stages of
    this process that have an older one open show the new one.

    Obstacles are of the kind that USD has for their shape, a box a scaled cube, and a plane a rectangle beneath the
    cloth. Those that move have a translation and a rotation for each frame. Their custom data say shape and friction.

    Args:
        path: of the file, ending in .usd, .usda (text), .usdc (binary) or .usdz (one file, for exchange).
        trajectory: what to write, at least one frame.
        tubes: write meshes, for programs that do not draw curves: closed tubes, their sections as wide and high as the
            yarn, and less high where others leave less room (see ``view.yarns.Tubes``). They are subdivision surfaces,
            so that programs draw them smooth; one that subdivides them draws them thinner, by 10 % with 8 sides.
        slowdown: seconds of playing time for one second of simulated time, above 0.
        sides: corners of a tube's ring, at least 3.
        fps: time codes in one second of playing time, above 0. Blender plays 24 in a second, whatever the file says.
        velocities: write how fast points move, for motion blur, in metres per second of playing time.
        surface: write /cloth/surface too, the cloth's middle as a mesh with texture coordinates ``st`` from 0 to 1
            along u and against v.
        selvedge: weft yarns turn at the edge and go on as the next one of their material, and do not end there.

    Raises:
        InputError: an argument is out of its range, or the folder of `path` does not exist.
        OSError: the file cannot be written, such as to a full disk.
    """
    slowdown = real("slowdown", slowdown, above=0.0)
    sides = integer("sides", sides, least=3)
    fps = real("fps", fps, above=0.0)
    if Path(path).suffix not in ENDINGS:
        raise InputError(f"path = {str(path)!r}, must end in {', '.join(ENDINGS)}")
    position = checked(trajectory)
    options = {"tubes": tubes, "slowdown": slowdown, "sides": sides, "fps": fps}
    options |= {"velocities": velocities, "surface": surface, "selvedge": selvedge}
    with atomic_write(path) as temporary, writing(path):
        packed = temporary.suffix == ".usdz"
        layer = temporary.with_suffix(".usdc") if packed else temporary
        # of a function of its own, so that no stage holds the file when it is moved: Windows would not move it
        _write_frames(layer, trajectory, position, options)
        if packed:
            pack(layer, temporary)
    reload(path)


def _write_frames(layer: Path, trajectory: Trajectory, position: np.ndarray, options: dict[str, Any]) -> None:
    frames = UsdFrames(layer, trajectory, placed(trajectory), **options)
    for frame, origin in enumerate(origins(trajectory)):
        frames.add(position[frame], trajectory.velocity[frame], trajectory.euler[frame], origin)
    frames.close()


def pack(layer: Path, path: Path) -> None:
    """Makes a .usdz of a .usdc."""
    from pxr import Sdf

    writer = Sdf.ZipFileWriter.CreateNew(str(path))
    writer.AddFile(str(layer), layer.name)
    writer.Save()


@contextlib.contextmanager
def writing(path: str | os.PathLike) -> Iterator[None]:
    """Turns what USD says of a file that it cannot write into an OSError."""
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:
        lines = [line for line in str(error).splitlines() if line.strip()]
        raise OSError(f"{path} cannot be written: {lines[0].rpartition(' : ')[2]}") from error


def reload(path: str | os.PathLike) -> None:
    """Makes USD read a file again, where this process has it open: it keeps layers by their paths."""
    from pxr import Sdf

    real = os.path.realpath(path)
    for layer in Sdf.Layer.GetLoadedLayers():
        if layer.realPath and os.path.realpath(layer.realPath) == real:
            layer.Reload(force=True)


class UsdFrames:
    """A USD file in the making, to which frames are added as they come.

    Args:
        path: of the file, which is not there yet.
        trajectory: its cloth, scene and step; its frames do not matter.
        obstacles: where they are at each of the frames to come.
        others: as of ``write_usd``.
    """

    def __init__(
        self,
        path: Path,
        trajectory: Trajectory,
        obstacles: Sequence[Placed],
        *,
        tubes: bool,
        slowdown: float,
        sides: int,
        fps: float,
        velocities: bool,
        surface: bool,
        selvedge: bool,
    ):
        from pxr import Usd, UsdGeom

        self.apart = trajectory.step * slowdown * fps
        self.frames, self.pending, self.slowdown, self.velocities = 0, 0, slowdown, velocities
        self.stage = stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        layer = stage.GetRootLayer()
        layer.comment = f"One second of simulated time takes {slowdown:g} s to play, at {fps:g} time codes a second."
        layer.customLayerData = {"slowdown": slowdown, "step": trajectory.step}
        self.cloth = UsdGeom.Xform.Define(stage, "/cloth")
        stage.SetDefaultPrim(self.cloth.GetPrim())
        self.weaving = Weaving(trajectory.cloth, selvedge=selvedge)
        # a selvedge's yarns run on in each other, and so have no u and v of their own
        self.slides = not selvedge and (trajectory.scene is None or trajectory.scene.sliding)
        self.shapes: list[Shape] = [self._yarns(strands, tubes, sides) for strands in self.weaving.strands]
        if surface:
            self.shapes.append(Surface(stage, self.weaving))
        self._translate: UsdGeom.XformOp | None = None
        self._origin: tuple[np.ndarray, float] | None = None
        if obstacles:
            UsdGeom.Scope.Define(stage, "/obstacles")
            grey = material(stage, "/obstacles/materials/grey", OBSTACLE_COLOR)
            for k, each in enumerate(obstacles):
                shape = write_obstacle(stage, f"/obstacles/{each.obstacle.shape}_{k}", each, self.apart)
                bind(shape, grey)

    def add(self, position: np.ndarray, velocity: np.ndarray, euler: np.ndarray, origin: np.ndarray) -> None:
        """Writes a frame.

        Args:
            position: [nodes, 3] (m).
            velocity: [nodes, 3] (m/s).
            euler: (u, v) [nodes, 2] (m).
            origin: what points are written from [3] (m).
        """
        # whole where it is but for rounding, for programs that look at whole ones
        time = round(self.frames * self.apart, 9)
        self._place(origin, time)
        looks = [self.weaving.look(position)]
        speed = float(np.abs(velocity).max())
        if self.velocities:
            # a ten thousandth of a yarn there and back: all that a point depends on is smooth over that
            ahead = 1e-4 * self.weaving.strands[0].half.max() / max(speed, np.finfo(float).tiny)
            looks += [self.weaving.look(position + way * ahead * velocity) for way in (1.0, -1.0) if speed > 0.0]
        for shape in self.shapes:
            points, *moved = [shape.points(*look) for look in looks]
            self.pending += 2 * points.nbytes
            write_points(shape.prim, time, points - origin, shape.margin)
            if self.velocities:
                rate = (moved[0] - moved[1]) / (2.0 * ahead * self.slowdown) if moved else np.zeros_like(points)
                shape.prim.GetVelocitiesAttr().Set(vectors(rate), time)
            shape.slide(euler, time if self.slides else None)
        self.frames += 1
        self.stage.SetEndTimeCode(time)
        if self.pending > PENDING:
            self.pending = 0
            self.stage.Save()

    def close(self) -> None:
        """Writes what is left."""
        self.stage.Save()

    def _place(self, origin: np.ndarray, time: float) -> None:
        """Moves /cloth to where points are written from: once, or at every frame since that began to move."""
        from pxr import Gf

        before, self._origin = self._origin, (origin, time)
        if before is None or (self._translate is None and not origin.any()):
            if origin.any():
                self._translate = self.cloth.AddTranslateOp()
                self._translate.Set(Gf.Vec3d(*origin.tolist()))
            return
        if self._translate is None:
            self._translate = self.cloth.AddTranslateOp()
        moved = self._translate.GetNumTimeSamples() > 0
        if moved or (origin != before[0]).any():
            if not moved:
                self._translate.Set(Gf.Vec3d(*before[0].tolist()), before[1])
            self._translate.Set(Gf.Vec3d(*origin.tolist()), time)

    def _yarns(self, strands: Strands, tubes: bool, sides: int) -> Curves | TubeMesh:
        look = material(self.stage, f"/cloth/materials/yarn_{strands.material}", strands.color)
        path = f"/cloth/yarn_{strands.material}"
        rest = self.weaving.cloth.euler
        shape = TubeMesh(self.stage, path, strands, rest, sides) if tubes else Curves(self.stage, path, strands, rest)
        bind(shape.prim, look)
        shape.prim.CreateDisplayColorPrimvar("constant").Set([linear(strands.color)])
        return shape


def origins(trajectory: Trajectory) -> np.ndarray:
    """Finds where points are counted from at each frame [frames, 3] (m): the origin; or, where single precision would
    move them by more than ``COARSE`` radii, the middle of the cloth, at all frames or at each."""
    position = trajectory.position
    low, high = position.min(axis=1), position.max(axis=1)
    reach = COARSE * float(trajectory.cloth.halves.min()) / np.finfo(np.float32).epsneg
    middle = 0.5 * (low.min(axis=0) + high.max(axis=0))
    for origin in (np.zeros(3), middle):
        if max(np.abs(low - origin).max(), np.abs(high - origin).max()) <= reach:
            return np.broadcast_to(origin, (len(position), 3))
    return 0.5 * (low + high)
