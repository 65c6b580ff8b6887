"""Trajectories as USD files."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.obstacles import TriangleMesh
from ..errors import InputError, integer, real
from ..simulation.state import FIELDS, End, State, Trajectory
from ..view.geometry import OBSTACLE_COLOR, Placed, Strands, Tubes, checked, placed, strands
from .films import Film

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import Gf, Usd, UsdGeom

ENDINGS = (".usd", ".usda", ".usdc")
COARSE = 1e-4
SAVE_BYTES = 1 << 21
"""Of points that are kept in memory until a file is saved."""
CORNERS = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T == 1
"""Of a box, whether they are at its higher end."""
TUBE_SAMPLES = 4
"""Rings a segment: chords between them are within 7 % of the radius of the curve, in the paper's weaves."""


def write_usd(
    path: str | os.PathLike,
    trajectory: Trajectory,
    *,
    tubes: bool = False,
    slowdown: float = 1.0,
    sides: int = 8,
) -> None:
    """Writes every frame of a trajectory as a USD file: /cloth, and below it one prim for each yarn material; and
    /obstacles, where there are any, and below it one prim for each.

    Yarns are cubic Catmull-Rom curves (``UsdGeom.BasisCurves``) with their end points repeated, as wide as the yarn,
    over and under each other as the draft says. Frame k is at time code k. Lengths are in metres, z is up.
    Points are in single precision. Where that would be too coarse, far from the origin, they are relative to a
    translation of /cloth, which is in double precision. The file appears whole or not at all; stages of this process
    that have an older one open show the new one.

    Obstacles are of the kind that USD has for their shape, a box a scaled cube, and a plane a rectangle beneath the
    cloth. Those that move have a translation and a rotation for each frame. Their custom data say shape and friction.

    Args:
        path: of the file, ending in .usd, .usda (text) or .usdc (binary).
        trajectory: what to write, at least one frame.
        tubes: write meshes around the same curves, for programs that do not draw curves: closed tubes, their vertices
            at the yarn's radius. They are subdivision surfaces, so that programs draw them smooth; one that
            subdivides them draws them thinner, by 10 % with 8 sides.
        slowdown: seconds of playing time for one second of simulated time, above 0.
        sides: corners of a tube's ring, at least 3.

    Raises:
        InputError: an argument is out of its range, or the folder of `path` does not exist.
        OSError: the file cannot be written, such as to a full disk.
    """
    sides = integer("sides", sides, least=3)
    checked(trajectory)
    stage = Stage(path, trajectory[:0], slowdown=slowdown, tubes=tubes, sides=sides, whole=trajectory)
    few = max(1, SAVE_BYTES // (24 * trajectory.cloth.nodes))
    with stage.all_or_nothing():
        for first in range(0, len(trajectory), few):
            stage.write(trajectory[first : first + few])
        stage.frames = len(trajectory)
    stage.finish(None)


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


class Stage(Film):
    """A USD file in the making. A binary one is saved now and then, and what was saved takes no memory.

    Args:
        path: where it shall appear.
        head: a trajectory without frames.
        slowdown, tubes, sides: as of ``write_usd``.
        whole: all of the frames, where they are known from the beginning.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        head: Trajectory,
        *,
        slowdown: float,
        tubes: bool,
        sides: int = 8,
        whole: Trajectory | None = None,
    ):
        from pxr import Usd, UsdGeom

        slowdown = real("slowdown", slowdown, above=0.0)
        if Path(path).suffix not in ENDINGS:
            raise InputError(f"path = {str(path)!r}, must end in {', '.join(ENDINGS)}")
        self.head, self.whole, self.tubes, self.sides = head, whole, tubes, sides
        self.length, self._unsaved = 0, 0
        self._origins = None if whole is None else origins(whole)
        self._translate: UsdGeom.XformOp | None = None
        self._boxes: list[np.ndarray] = []
        """Corners of a box around the cloth [8, 3] of each frame."""
        self._last: dict[int, Tubes] = {}
        # for what is not saved when the disk is full, and the frame that it is full at
        frame = 24 * head.cloth.nodes * (TUBE_SAMPLES * sides if tubes else 1)
        super().__init__(path, reserve=SAVE_BYTES + 2 * frame if whole is None else 0)
        with self.all_or_nothing(), writing(path):
            self.stage = stage = Usd.Stage.CreateNew(str(self.temporary))
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
            rate = 1.0 / (head.step * slowdown)
            stage.SetTimeCodesPerSecond(rate)
            stage.SetFramesPerSecond(rate)
            stage.SetStartTimeCode(0)
            self.cloth = UsdGeom.Xform.Define(stage, "/cloth")
            stage.SetDefaultPrim(self.cloth.GetPrim())

    def add(self, state: State) -> None:
        parts: dict[str, Any] = {name: getattr(state, name)[None] for name in FIELDS}
        self.write(dataclasses.replace(self.head, **parts))

    def write(self, frames: Trajectory) -> None:
        """Adds some frames, and saves where there is much to save."""
        from pxr import UsdGeom

        first, radius = self.length, self.head.cloth.radius
        with writing(self.path):
            origin = self._placed(frames, first)
            for part in strands(frames):
                path = self.cloth.GetPath().AppendChild(f"yarn_{part.material}")
                if self.tubes:
                    before = self._last.get(part.material)
                    shape = Tubes.around(part, radius, sides=self.sides, samples=TUBE_SAMPLES, before=before)
                    self._last[part.material] = shape
                    _write_mesh(UsdGeom.Mesh.Define(self.stage, path), shape, part, origin, first)
                else:
                    _write_curves(UsdGeom.BasisCurves.Define(self.stage, path), part, radius, origin, first)
                self._unsaved += 12 * part.points.size // 3 * (TUBE_SAMPLES * self.sides if self.tubes else 1)
        self.length += len(frames)
        if self._unsaved > SAVE_BYTES and self.path.suffix != ".usda":
            self._save()

    def _placed(self, frames: Trajectory, first: int) -> np.ndarray:
        """Finds where the points of frames are counted from [frames, 3] (m), and writes it down."""
        from pxr import Gf

        low, high = bounds(frames.position)
        self._boxes += list(np.where(CORNERS, high[:, None], low[:, None]))
        given = self._origins
        origin = _origins(low, high, self.head.cloth.radius) if given is None else given[first : first + len(frames)]
        if self._translate is None and origin.any():
            self._translate = self.cloth.AddTranslateOp()
            for frame in {0, first - 1} if first else ():
                self._translate.Set(Gf.Vec3d(0.0), frame)
        if self._translate is not None:
            stays = given is not None and (given == given[0]).all()
            for frame, place in enumerate(origin[:1].tolist() if stays else origin.tolist(), first):
                self._translate.Set(Gf.Vec3d(*place), *(() if stays else (frame,)))
        return origin

    def _save(self) -> None:
        """Saves what is not."""
        if self.whole is None:
            self.needs(self._unsaved)
        with writing(self.path):
            self.stage.Save()
        self._unsaved = 0

    def close(self, end: End | None) -> None:
        from pxr import UsdGeom

        self.stage.SetEndTimeCode(self.length - 1)
        frames = self.whole or dataclasses.replace(self.head, position=np.array(self._boxes))
        with writing(self.path):
            for k, each in enumerate(placed(frames)):
                UsdGeom.Scope.Define(self.stage, "/obstacles")
                _write_obstacle(self.stage, f"/obstacles/{each.obstacle.shape}_{k}", each)
        self._save()
        # no stage may hold the file when it is moved: Windows would not move it
        self.drop()

    def drop(self) -> None:
        self.cloth = self.stage = self._translate = None

    def finish(self, end: End | None) -> None:
        super().finish(end)
        reload(self.path)


def _write_obstacle(stage: Usd.Stage, path: str, placed: Placed) -> None:
    from pxr import Gf, Usd, UsdGeom, Vt

    obstacle = placed.obstacle
    kinds = {"plane": "Plane", "sphere": "Sphere", "capsule": "Capsule", "cylinder": "Cylinder", "box": "Cube"}
    shape = getattr(UsdGeom, kinds.get(obstacle.shape, "Mesh")).Define(stage, path)
    translate = shape.AddTranslateOp()
    turn = shape.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    for frame in range(len(placed.position)) if placed.moves else (0,):
        time = [frame] if placed.moves else []
        translate.Set(Gf.Vec3d(*placed.position[frame].tolist()), *time)
        x, y, z, w = placed.rotation[frame].tolist()
        turn.Set(Gf.Quatd(w, x, y, z), *time)
    if obstacle.shape == "plane":
        shape.CreateWidthAttr(placed.width)
        shape.CreateLengthAttr(placed.length)
        shape.CreateDoubleSidedAttr(True)
    elif obstacle.shape == "box":
        shape.CreateSizeAttr(2.0)
        shape.AddScaleOp().Set(Gf.Vec3f(*obstacle.size.tolist()))
    elif obstacle.shape == "sphere":
        shape.CreateRadiusAttr(float(obstacle.size[0]))
    elif isinstance(obstacle, TriangleMesh):
        shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(obstacle.vertices.astype(np.float32)))
        shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(obstacle.faces), 3, dtype=np.int32)))
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(obstacle.faces.ravel()))
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        shape.CreateDoubleSidedAttr(True)
    else:
        shape.CreateHeightAttr(2.0 * float(obstacle.size[0]))
        shape.CreateRadiusAttr(float(obstacle.size[1]))
    # z, as of planes: what the schemas have by default
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(shape), Usd.TimeCode.Default()))
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([_linear(OBSTACLE_COLOR)])
    shape.GetPrim().SetCustomData({"shape": obstacle.shape, "friction": obstacle.friction})


def origins(trajectory: Trajectory) -> np.ndarray:
    """Finds where points are counted from at each frame [frames, 3] (m): the origin; or, where single precision would
    move them by more than ``COARSE`` radii, the middle of the cloth, at all frames or at each."""
    return _origins(*bounds(trajectory.position), trajectory.cloth.radius)


def _origins(low: np.ndarray, high: np.ndarray, radius: float) -> np.ndarray:
    reach = COARSE * radius / np.finfo(np.float32).epsneg
    middle = 0.5 * (low.min(axis=0) + high.max(axis=0))
    for origin in (np.zeros(3), middle):
        if max(np.abs(low - origin).max(), np.abs(high - origin).max()) <= reach:
            return np.broadcast_to(origin, (len(low), 3))
    return 0.5 * (low + high)


def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the lowest and the highest coordinates [..., 3] of points [..., points, 3]."""
    rows = np.ascontiguousarray(points.swapaxes(-1, -2))  # in which NumPy looks for them many times as fast
    return rows.min(axis=-1), rows.max(axis=-1)


def _write_curves(curves: UsdGeom.BasisCurves, part: Strands, radius: float, origin: np.ndarray, first: int) -> None:
    from pxr import UsdGeom, Vt

    if not first:
        curves.CreateTypeAttr(UsdGeom.Tokens.cubic)
        curves.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
        # Repeated end points instead of `pinned`, whose segments Storm miscounts.
        curves.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        curves.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy((part.counts + 2).astype(np.int32)))
        curves.CreateWidthsAttr([2.0 * radius])
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        _write_color(curves, part)
    repeated = part.repeated
    for frame, points in enumerate(part.points):
        _write_points(curves, first + frame, points[repeated] - origin[frame], radius)


def _write_mesh(mesh: UsdGeom.Mesh, shape: Tubes, part: Strands, origin: np.ndarray, first: int) -> None:
    from pxr import Vt

    if not first:
        corners, vertices = shape.faces()
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(vertices.astype(np.int32)))
        _write_color(mesh, part)
    for frame in range(len(part.points)):
        _write_points(mesh, first + frame, shape.vertices(frame) - origin[frame], 0.0)


def _write_color(shape: UsdGeom.PointBased, part: Strands) -> None:
    """Writes a yarn's colour, which is that of a screen (sRGB), as displayColor, which is linear."""
    from pxr import UsdGeom

    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([_linear(part.color)])


def _linear(color: Sequence[float]) -> Gf.Vec3f:
    """Makes a displayColor, which is linear, of a colour; those of yarns are those of a screen (sRGB)."""
    from pxr import Gf

    screen = np.array(color, dtype=np.float64)
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    return Gf.Vec3f(*linear.tolist())


def _write_points(shape: UsdGeom.PointBased, frame: int, points: np.ndarray, margin: float) -> None:
    from pxr import Vt

    points = points.astype(np.float32)
    shape.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), frame)
    low, high = bounds(points)
    extent = np.stack([low - margin, high + margin])
    shape.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)), frame)
