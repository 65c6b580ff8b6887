"""Scripts as modules: those of scenes/ and benchmarks/, which are no packages; and how to look at what scenes make."""

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from unittest import mock

from pxr import Usd, UsdGeom

ROOT = Path(__file__).parents[1]


def load(path: str) -> ModuleType:
    """Imports a script as running it would, with its own folder first on the path: each folder has a ``common``."""
    file = ROOT / path
    name = "_".join(file.relative_to(ROOT).with_suffix("").parts)
    spec = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    # dataclasses look their module up by its name
    sys.modules[name] = module
    sys.modules.pop("common", None)
    with mock.patch.object(sys, "path", [str(file.parent), *sys.path]):
        spec.loader.exec_module(module)
    sys.modules.pop("common", None)
    return module


def exit_code(script: ModuleType, arguments: Sequence[str]) -> int:
    """What running a scene with these arguments would return."""
    try:
        return script.command(script.main, arguments)
    except SystemExit as exit:  # argparse
        return exit.code


def samples(path: Path) -> list[int]:
    """Number of frames of each yarn material in a USD file."""
    stage = Usd.Stage.Open(str(path))
    shapes = [UsdGeom.PointBased(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.PointBased)]
    return [shape.GetPointsAttr().GetNumTimeSamples() for shape in shapes]
