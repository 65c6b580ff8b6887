"""Trajectories as USD files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .errors import InputError, number, whole
from .files import whole_file
from .geometry import Strands, Tubes, strands
from .state import Trajectory

if TYPE_CHECKING:  # who writes no USD file need not load its library: functions import it
    from pxr import UsdGeom

ENDINGS = (".usd", ".usda", ".usdc")
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
    """Writes every frame of a trajectory as a USD file: /cloth, and below it one prim for each yarn material.

    Yarns are cubic Catmull-Rom curves (``UsdGeom.BasisCurves``) with their end points repeated, as wide as the yarn,
    over and under each other as the draft says. Frame k is at time code k. Lengths are in metres, z is up.
    The file appears whole or not at all.

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
    """
    from pxr import Usd, UsdGeom

    slowdown = number("slowdown", slowdown, above=0.0)
    sides = whole("sides", sides, least=3)
    if Path(path).suffix not in ENDINGS:
        raise InputError(f"path = {str(path)!r}, must end in {', '.join(ENDINGS)}")
    with whole_file(path) as temporary:
        parts = strands(trajectory)
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        rate = 1.0 / (trajectory.step * slowdown)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(trajectory) - 1)
        cloth = UsdGeom.Xform.Define(stage, "/cloth")
        stage.SetDefaultPrim(cloth.GetPrim())
        radius = trajectory.cloth.radius
        for part in parts:
            prim_path = cloth.GetPath().AppendChild(f"yarn_{part.material}")
            if tubes:
                shape = Tubes.around(part, radius, sides=sides, samples=TUBE_SAMPLES)
                _write_mesh(UsdGeom.Mesh.Define(stage, prim_path), shape, part)
            else:
                _write_curves(UsdGeom.BasisCurves.Define(stage, prim_path), part, radius)
        stage.Save()


def _write_curves(curves: UsdGeom.BasisCurves, part: Strands, radius: float) -> None:
    from pxr import UsdGeom, Vt

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
        _write_points(curves, frame, points[repeated], radius)


def _write_mesh(mesh: UsdGeom.Mesh, shape: Tubes, part: Strands) -> None:
    from pxr import Vt

    corners, vertices = shape.faces()
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(vertices.astype(np.int32)))
    _write_color(mesh, part)
    for frame in range(len(part.points)):
        _write_points(mesh, frame, shape.vertices(frame), 0.0)


def _write_color(shape: UsdGeom.PointBased, part: Strands) -> None:
    """displayColor is linear; the colours of yarns are those of a screen (sRGB)."""
    from pxr import Gf, UsdGeom

    color = np.array(part.color, dtype=np.float64)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*linear.tolist())])


def _write_points(shape: UsdGeom.PointBased, frame: int, points: np.ndarray, margin: float) -> None:
    from pxr import Vt

    points = points.astype(np.float32)
    shape.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), frame)
    extent = np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])
    shape.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)), frame)
