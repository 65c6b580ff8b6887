"""What a USD file of a trajectory is made of: curves, tubes, a surface, obstacles and their materials."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from ..description.obstacles import TriangleMesh
from ..view.geometry import OBSTACLE_COLOR, Placed
from ..view.yarns import Strands, Tubes, Weaving

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import Gf, Usd, UsdGeom, UsdShade

TUBE_SAMPLES = 4
"""Rings a segment: chords between them are within 7 % of the radius of the curve, in the paper's weaves."""


class Shape:
    """A prim whose points move, and the length of yarn at them."""

    prim: Any
    margin = 0.0
    """By which it is wider than its points [m]."""

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Finds its points [points, 3] (m), of what ``Weaving.look`` gives."""
        raise NotImplementedError

    def slide(self, euler: np.ndarray, time: float | None) -> None:
        """Says how yarns have slid; None: they do not."""


class Curves(Shape):
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
        self._repeated = repeated = strands.repeated
        # gathered once, and not from the points of every frame
        self._drawn = dataclasses.replace(strands, places=strands.places[repeated], height=strands.height[repeated])
        self._arc = _primvars(self.prim, strands, strands.arc[repeated], strands.yarn)

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return self._drawn.points(places, normals)

    def slide(self, euler: np.ndarray, time: float | None) -> None:
        if time is not None:
            self._arc.Set(_floats(self.strands.slid(self.rest, euler)[self._repeated]), time)


class TubeMesh(Shape):
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


class Surface(Shape):
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
        bind(self.prim, material(stage, "/cloth/materials/surface", color))
        self.prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([linear(color)])

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


def material(stage: Usd.Stage, path: str, color: Sequence[float]) -> UsdShade.Material:
    """Writes a material of one colour, which is that of a screen (sRGB), matt as yarns are."""
    from pxr import Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, str(PurePosixPath(path).parent))
    result = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(linear(color))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    result.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return result


def bind(shape: Any, material: UsdShade.Material) -> None:
    from pxr import UsdShade

    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def linear(color: Sequence[float]) -> Gf.Vec3f:
    """Makes a displayColor, which is linear, of a colour; those of yarns are those of a screen (sRGB)."""
    from pxr import Gf

    screen = np.array(color, dtype=np.float64)
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    return Gf.Vec3f(*linear.tolist())


def _floats(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.FloatArray.FromNumpy(values.astype(np.float32))


def vectors(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(values.astype(np.float32))


def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the lowest and the highest coordinates [..., 3] of points [..., points, 3]."""
    rows = np.ascontiguousarray(points.swapaxes(-1, -2))  # in which NumPy looks for them many times as fast
    return rows.min(axis=-1), rows.max(axis=-1)


def write_points(shape: UsdGeom.PointBased, time: float, points: np.ndarray, margin: float) -> None:
    points = points.astype(np.float32)
    shape.GetPointsAttr().Set(vectors(points), time)
    low, high = bounds(points)
    extent = np.stack([low - margin, high + margin])
    shape.GetExtentAttr().Set(vectors(extent), time)


def write_obstacle(stage: Usd.Stage, path: str, placed: Placed, apart: float) -> UsdGeom.Gprim:
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
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([linear(OBSTACLE_COLOR)])
    shape.GetPrim().SetCustomData({"shape": obstacle.shape, "friction": obstacle.friction})
    return shape
