"""Trajectories as USD files."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.cloth import Cloth
from ..description.cloths import Cloths
from ..errors import InputError, integer, real
from ..simulation.state import End, State, Trajectory
from ..view.geometry import OBSTACLE_COLOR, checked, placed
from ..view.yarns import Strands, Weaving
from .films import Film
from .usd_prims import (
    TUBE_SAMPLES,
    Curves,
    Shape,
    Surface,
    TubeMesh,
    bind,
    bounds,
    linear,
    material,
    vectors,
    write_obstacle,
    write_points,
)

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import UsdGeom

LAYERS = (".usd", ".usda", ".usdc")
ENDINGS = (*LAYERS, ".usdz")
COARSE = 1e-4
SAVE_BYTES = 1 << 21
"""Of points that are kept in memory until a file is saved."""
CORNERS = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T == 1
"""Of a box, whether they are at its higher end."""


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
    position = checked(trajectory)
    look = options(
        tubes=tubes,
        slowdown=slowdown,
        sides=sides,
        fps=fps,
        velocities=velocities,
        surface=surface,
        selvedge=selvedge,
    )
    stage = Stage(path, trajectory[:0], look, whole=trajectory)
    with stage.all_or_nothing():
        for frame, origin in enumerate(origins(trajectory)):
            stage.write(position[frame], trajectory.velocity[frame], trajectory.euler[frame], origin)
        stage.frames = len(trajectory)
    stage.finish(None)


def options(
    *,
    tubes: bool = False,
    slowdown: float = 1.0,
    sides: int = 8,
    fps: float = 24.0,
    velocities: bool = True,
    surface: bool = False,
    selvedge: bool = False,
) -> dict[str, Any]:
    """Checks what ``write_usd`` takes beside a path and frames.

    Raises:
        InputError: one of them is out of its range.
    """
    return {
        "tubes": tubes,
        "slowdown": real("slowdown", slowdown, above=0.0),
        "sides": integer("sides", sides, least=3),
        "fps": real("fps", fps, above=0.0),
        "velocities": velocities,
        "surface": surface,
        "selvedge": selvedge,
    }


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


class Stage(Film):
    """A USD file in the making. A binary one is saved now and then, and what was saved takes no memory.

    Args:
        path: where it shall appear.
        head: a trajectory without frames.
        look: what ``options`` gives.
        whole: all of the frames, where they are known from the beginning.
    """

    def __init__(
        self, path: str | os.PathLike, head: Trajectory, look: Mapping[str, Any], *, whole: Trajectory | None = None
    ):
        if Path(path).suffix not in ENDINGS:
            raise InputError(f"path = {str(path)!r}, must end in {', '.join(ENDINGS)}")
        self.head, self.whole, self.look = head, whole, look
        self.apart = head.step * look["slowdown"] * look["fps"]
        self.length, self._unsaved = 0, 0
        self._boxes: list[np.ndarray] = []
        """Corners of a box around the cloth [8, 3] of each frame."""
        self._translate: UsdGeom.XformOp | None = None
        self._origin: tuple[np.ndarray, float] | None = None
        # a selvedge's yarns run on in each other, and so have no u and v of their own
        self.slides = not look["selvedge"] and (head.scene is None or head.scene.sliding)
        self.weaving = Weaving(head.cloth, selvedge=look["selvedge"])
        around = TUBE_SAMPLES * look["sides"] if look["tubes"] else 1
        # for what is not saved when the disk is full, and the frame that it is full at
        size = self._size(around * sum(2 + len(strands.places) for strands in self.weaving.strands))
        super().__init__(path, reserve=SAVE_BYTES + 2 * size if whole is None else 0)
        packed = self.temporary.suffix == ".usdz"
        self._layer = self.temporary.with_suffix(".usdc") if packed else self.temporary
        with self.all_or_nothing(), writing(path):
            self._begin()

    def _begin(self) -> None:
        from pxr import Usd, UsdGeom

        slowdown, fps = self.look["slowdown"], self.look["fps"]
        self.stage = stage = Usd.Stage.CreateNew(str(self._layer))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        layer = stage.GetRootLayer()
        layer.comment = f"One second of simulated time takes {slowdown:g} s to play, at {fps:g} time codes a second."
        layer.customLayerData = {"slowdown": slowdown, "step": self.head.step}
        self.cloth = UsdGeom.Xform.Define(stage, "/cloth")
        stage.SetDefaultPrim(self.cloth.GetPrim())
        self.shapes: list[Shape] = [self._yarns(strands) for strands in self.weaving.strands]
        if self.look["surface"]:
            self.shapes.append(Surface(stage, self.weaving))

    def _size(self, points: int) -> int:
        """Counts the bytes that so many points take in a frame."""
        return 4 * points * (3 * (1 + bool(self.look["velocities"])) + self.slides)

    def add(self, state: State) -> None:
        low, high = bounds(state.position[None])
        [origin] = _origins(low, high, self.weaving.cloth)
        self._boxes.append(np.where(CORNERS, high, low))
        self.write(state.position, state.velocity, state.euler, origin)

    def write(self, position: np.ndarray, velocity: np.ndarray, euler: np.ndarray, origin: np.ndarray) -> None:
        """Adds a frame, and saves where there is much to save.

        Args:
            position: [nodes, 3] (m).
            velocity: [nodes, 3] (m/s).
            euler: (u, v) [nodes, 2] (m).
            origin: what points are written from [3] (m).
        """
        with writing(self.path):
            # whole where it is but for rounding, for programs that look at whole ones
            time = round(self.length * self.apart, 9)
            self._place(origin, time)
            speed = float(np.abs(velocity).max()) if self.look["velocities"] else 0.0
            # a millionth of a yarn: all that a point depends on is smooth over that
            ahead = 1e-6 * self.weaving.strands[0].half.max() / max(speed, np.finfo(float).tiny)
            # far from 0, positions are too coarse to be so little ahead
            near = position - origin
            looks = self.weaving.looks(np.stack([near, near + ahead * velocity] if speed > 0.0 else [near]))
            for shape in self.shapes:
                points, *moved = [shape.points(*look) for look in looks]
                self._unsaved += self._size(len(points))
                write_points(shape.prim, time, points, shape.margin)
                if self.look["velocities"]:
                    rate = (moved[0] - points) / (ahead * self.look["slowdown"]) if moved else np.zeros_like(points)
                    shape.prim.GetVelocitiesAttr().Set(vectors(rate), time)
                shape.slide(euler, time if self.slides else None)
        self.length += 1
        if self._unsaved > SAVE_BYTES and self._layer.suffix != ".usda":
            self._save()

    def _save(self) -> None:
        """Saves what is not."""
        if self.whole is None:
            self.needs(self._unsaved)
        with writing(self.path):
            self.stage.Save()
        self._unsaved = 0

    def close(self, end: End | None) -> None:
        from pxr import UsdGeom

        self.stage.SetEndTimeCode(round((self.length - 1) * self.apart, 9))
        frames = self.whole or dataclasses.replace(self.head, position=np.array(self._boxes))
        with writing(self.path):
            for k, each in enumerate(placed(frames)):
                UsdGeom.Scope.Define(self.stage, "/obstacles")
                grey = material(self.stage, "/obstacles/materials/grey", OBSTACLE_COLOR)
                path = f"/obstacles/{each.obstacle.shape}_{k}"
                bind(write_obstacle(self.stage, path, each, self.apart), grey)
        self._save()
        # no stage may hold the file when it is moved: Windows would not move it
        self.drop()
        if self._layer != self.temporary:
            self.needs(self._layer.stat().st_size)
            pack(self._layer, self.temporary)

    def drop(self) -> None:
        self.cloth = self.stage = self._translate = None
        self.shapes = []

    def finish(self, end: End | None) -> None:
        super().finish(end)
        reload(self.path)

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

    def _yarns(self, strands: Strands) -> Curves | TubeMesh:
        look = material(self.stage, f"/cloth/materials/yarn_{strands.material}", strands.color)
        path = f"/cloth/yarn_{strands.material}"
        rest = self.weaving.cloth.euler
        shape: Curves | TubeMesh
        if self.look["tubes"]:
            shape = TubeMesh(self.stage, path, strands, rest, self.look["sides"])
        else:
            shape = Curves(self.stage, path, strands, rest)
        bind(shape.prim, look)
        shape.prim.CreateDisplayColorPrimvar("constant").Set([linear(strands.color)])
        return shape


def origins(trajectory: Trajectory) -> np.ndarray:
    """Finds where points are counted from at each frame [frames, 3] (m): the origin; or, where single precision would
    move them by more than ``COARSE`` radii, the middle of the cloth, at all frames or at each."""
    return _origins(*bounds(trajectory.position), trajectory.cloth)


def _origins(low: np.ndarray, high: np.ndarray, cloth: Cloth | Cloths) -> np.ndarray:
    reach = COARSE * float(cloth.halves.min()) / np.finfo(np.float32).epsneg
    middle = 0.5 * (low.min(axis=0) + high.max(axis=0))
    for origin in (np.zeros(3), middle):
        if max(np.abs(low - origin).max(), np.abs(high - origin).max()) <= reach:
            return np.broadcast_to(origin, (len(low), 3))
    return 0.5 * (low + high)
