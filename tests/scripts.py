"""Scripts as modules: those of scenes/ and benchmarks/, which are no packages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from unittest import mock

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
    del sys.modules["common"]
    return module
