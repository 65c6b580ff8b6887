"""Trajectories as USD files."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.obstacles import TriangleMesh
from ..errors import InputError, integer, real
from ..simulation.state import Trajectory
from ..view.geometry import OBSTACLE_COLOR, Placed, checked, placed
from ..view.yarns import Strands, Tubes, Weaving
from .files import atomic_write

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import Gf, Usd, UsdGeom, UsdShade

ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
COARSE = 1e-4
TUBE_SAMPLES = 4
"""Rings a segment: chords between them are within 7 % of the radius of the curve, in the paper's weaves."""
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
            yarn, and less high where others leave less room (see ``view.yarns.Tubes``). They are subdivision surfaces, so
            that programs draw them smooth; one that subdivides them draws them thinner, by 10 % with 8 sides.
        slowdown: seconds of playing time for one second of simulated time, above 0.
        sides: corners of a tube's ring, at least 3.
        fps: time codes in one second of playing time, above 0. Blender plays 24 in a second, whatever the file says.
        velocities: write how fast points move, for motion blur, in metres per second of playing time.
        surface: write /cloth/surface too, the cloth's middle as a mesh with texture coordinates ``st`` from 0 to 1 along
            u and against v.
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
        self.shapes = [self._yarns(strands, tubes, sides) for strands in self.weaving.strands]
        if surface:
            self.shapes.append(_Surface(stage, self.weaving))
        self._translate: UsdGeom.XformOp | None = None
        self._origin: tuple[np.ndarray, float] | None = None
        if obstacles:
            UsdGeom.Scope.Define(stage, "/obstacles")
            look = _material(stage, "/obstacles/material", OBSTACLE_COLOR)
            for k, each in enumerate(obstacles):
                shape = _write_obstacle(stage, f"/obstacles/{each.obstacle.shape}_{k}", each, self.apart)
                _bind(shape, look)

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
            _write_points(shape.prim, time, points - origin, shape.margin)
            if self.velocities:
                rate = (moved[0] - moved[1]) / (2.0 * ahead * self.slowdown) if moved else np.zeros_like(points)
                shape.prim.GetVelocitiesAttr().Set(_vectors(rate), time)
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

    def _yarns(self, strands: Strands, tubes: bool, sides: int) -> _Curves | _Mesh:
        look = _material(self.stage, f"/cloth/materials/yarn_{strands.material}", strands.color)
        path = f"/cloth/yarn_{strands.material}"
        rest = self.weaving.cloth.euler
        shape = _Mesh(self.stage, path, strands, rest, sides) if tubes else _Curves(self.stage, path, strands, rest)
        _bind(shape.prim, look)
        shape.prim.CreateDisplayColorPrimvar("constant").Set([_linear(strands.color)])
        return shape


def _write_obstacle(stage: Usd.Stage, path: str, placed: Placed, apart: float) -> UsdGeom.Gprim:
    from pxr import Gf, Usd, UsdGeom, Vt

    obstacle = placed.obstacle
    kinds = {"plane": "Plane", "sphere": "Sphere", "capsule": "Capsule", "cylinder": "Cylinder", "box": "Cube"}
    shape = getattr(UsdGeom, kinds.get(obstacle.shape, "Mesh")).Define(stage, path)
    translate = shape.AddTranslateOp()
    turn = shape.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    for frame in range(len(placed.position)) if placed.moves else (0,):
        time = [round(frame * apart, 9)] if placed.moves else []
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
    return shape


def origins(trajectory: Trajectory) -> np.ndarray:
    """Finds where points are counted from at each frame [frames, 3] (m): the origin; or, where single precision would
    move them by more than ``COARSE`` radii, the middle of the cloth, at all frames or at each."""
    position = trajectory.position
    low, high = position.min(axis=1), position.max(axis=1)
    reach = COARSE * trajectory.cloth.radius / np.finfo(np.float32).epsneg
    middle = 0.5 * (low.min(axis=0) + high.max(axis=0))
    for origin in (np.zeros(3), middle):
        if max(np.abs(low - origin).max(), np.abs(high - origin).max()) <= reach:
            return np.broadcast_to(origin, (len(position), 3))
    return 0.5 * (low + high)


class _Shape:
    """A prim whose points move, and the length of yarn at them."""

    prim: Any
    margin = 0.0
    """By which it is wider than its points [m]."""

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Finds its points [points, 3] (m), of what ``Weaving.look`` gives."""
        raise NotImplementedError

    def slide(self, euler: np.ndarray, time: float | None) -> None:
        """Says how yarns have slid; None: they do not."""


class _Curves(_Shape):
    def __init__(self, stage: Usd.Stage, path: str, strands: Strands, rest: np.ndarray):
        from pxr import UsdGeom, Vt

        self.strands, self.rest, self.prim = strands, rest, UsdGeom.BasisCurves.Define(stage, path)
        self.prim.CreateTypeAttr(UsdGeom.Tokens.cubic)
        self.prim.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
        # Repeated end points instead of `pinned`, whose segments Storm miscounts.
        self.prim.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        self.prim.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy((strands.counts + 2).astype(np.int32)))
        widths = 2.0 * strands.half[:, 0]
        if (widths == widths[0]).all():
            self.prim.CreateWidthsAttr([widths[0]])
            self.prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        else:
            # a width for each curve is what programs do not read
            self.prim.CreateWidthsAttr(_floats(np.repeat(widths, strands.counts + 2)))
            self.prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        self.margin = 0.5 * float(widths.max())
        self._repeated = strands.repeated
        self._arc = _primvars(self.prim, strands, strands.arc[self._repeated], strands.yarn)

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return self.strands.points(places, normals)[self._repeated]

    def slide(self, euler: np.ndarray, time: float | None) -> None:
        if time is not None:
            self._arc.Set(_floats(self.strands.slid(self.rest, euler)[self._repeated]), time)


class _Mesh(_Shape):
    """Tubes."""

    def __init__(self, stage: Usd.Stage, path: str, strands: Strands, rest: np.ndarray, sides: int):
        from pxr import UsdGeom

        self.tubes, self.sides, self.rest = Tubes.around(strands, samples=TUBE_SAMPLES), sides, rest
        self.prim = UsdGeom.Mesh.Define(stage, path)
        _faces(self.prim, *self.tubes.faces(sides))
        # faces of the tubes, and then two caps of each
        walls = np.repeat(strands.yarn, (self.tubes.counts - 1) * sides)
        yarn = np.concatenate([walls, strands.yarn, strands.yarn])
        self._arc = _primvars(self.prim, strands, np.repeat(self.tubes.between(strands.arc), sides), yarn)

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return self.tubes.vertices(places, normals, self.sides)

    def slide(self, euler: np.ndarray, time: float | None) -> None:
        if time is not None:
            arc = self.tubes.between(self.tubes.strands.slid(self.rest, euler))
            self._arc.Set(_floats(np.repeat(arc, self.sides)), time)


class _Surface(_Shape):
    """The cloth's middle."""

    def __init__(self, stage: Usd.Stage, weaving: Weaving):
        from pxr import Sdf, UsdGeom, Vt

        self.prim = UsdGeom.Mesh.Define(stage, "/cloth/surface")
        triangles, euler = weaving.cloth.topology.triangle_nodes, weaving.cloth.euler
        self.nodes = weaving.cloth.nodes
        _faces(self.prim, np.full(len(triangles), 3), triangles)
        self.prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.loop)
        self.prim.CreateDoubleSidedAttr(True)
        low = euler.min(axis=0)
        st = (euler - low) / np.ptp(euler, axis=0)
        # pictures have their first row at the top
        st[:, 1] = 1.0 - st[:, 1]
        primvar = UsdGeom.PrimvarsAPI(self.prim).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        primvar.Set(Vt.Vec2fArray.FromNumpy(st.astype(np.float32)))
        color = weaving.strands[0].color
        _bind(self.prim, _material(stage, "/cloth/materials/surface", color))
        self.prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([_linear(color)])

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return places[: self.nodes]


def _primvars(prim: Any, strands: Strands, arc: np.ndarray, yarn: np.ndarray) -> UsdGeom.Primvar:
    """Writes the yarn of every curve or face, and the length of yarn at every point, as it is at rest."""
    from pxr import Sdf, UsdGeom, Vt

    primvars = UsdGeom.PrimvarsAPI(prim)
    kinds = Sdf.ValueTypeNames
    primvars.CreatePrimvar("yarn", kinds.IntArray, "uniform").Set(Vt.IntArray.FromNumpy(yarn.astype(np.int32)))
    result = primvars.CreatePrimvar("arc", kinds.FloatArray, "vertex")
    result.Set(_floats(arc))
    return result


def _faces(mesh: UsdGeom.Mesh, corners: np.ndarray, vertices: np.ndarray) -> None:
    from pxr import Vt

    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(vertices.ravel().astype(np.int32)))


def _material(stage: Usd.Stage, path: str, color: Sequence[float]) -> UsdShade.Material:
    """Writes a material of one colour, which is that of a screen (sRGB), matt as yarns are."""
    from pxr import Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, Sdf.Path(path).GetParentPath()) if path.count("/") > 2 else None
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(_linear(color))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def _bind(shape: Any, material: UsdShade.Material) -> None:
    from pxr import UsdShade

    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def _linear(color: Sequence[float]) -> Gf.Vec3f:
    """Makes a displayColor, which is linear, of a colour; those of yarns are those of a screen (sRGB)."""
    from pxr import Gf

    screen = np.array(color, dtype=np.float64)
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    return Gf.Vec3f(*linear.tolist())


def _floats(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.FloatArray.FromNumpy(values.astype(np.float32))


def _vectors(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(values.astype(np.float32))


def _write_points(shape: UsdGeom.PointBased, time: float, points: np.ndarray, margin: float) -> None:
    points = points.astype(np.float32)
    shape.GetPointsAttr().Set(_vectors(points), time)
    extent = np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
    shape.GetExtentAttr().Set(_vectors(extent), time)
