"""Scripts as modules: those of scenes/ and benchmarks/, which are no packages; and how to look at what scenes make."""

import functools
import importlib.util
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

from pxr import Usd, UsdGeom

ROOT = Path(__file__).parents[1]


def imported(path: str) -> ModuleType:
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
    sys.modules.pop("common", None)  # which not every one of them imports
    return module


class Later:
    """Stands for a module, or what is in one, which is imported when something of it is first asked for, and not when
    tests are collected."""

    __slots__ = ("_found",)  # and no __dict__, which is that of what it stands for: monkeypatch looks there

    def __init__(self, find: Callable[[], object]):
        object.__setattr__(self, "_found", functools.cache(find))

    def __getattr__(self, name: str) -> Any:
        # pytest asks all that it finds for such names
        if name.startswith("_") and name not in ("__dict__", "__name__"):
            raise AttributeError(name)
        return getattr(self._found(), name)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self._found(), name, value)

    def __delattr__(self, name: str) -> None:
        delattr(self._found(), name)


def load(path: str) -> Any:
    """Gives a script of scenes/ or benchmarks/, by its path in the repository."""
    return Later(lambda: imported(path))


def beside(script: Any, name: str) -> Any:
    """Gives a module of a script's own folder, which the script imports."""

    def find() -> ModuleType:
        assert script.__name__  # the script is there
        return sys.modules[name]

    return Later(find)


def loaded() -> list[str]:
    """Lists the scripts that were imported."""
    return [name for name in sys.modules if name.startswith(("scenes_", "benchmarks_"))]


def exit_code(script: Any, arguments: Sequence[str]) -> int:
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
