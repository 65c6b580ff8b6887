"""Old names of modules and of what is in them, which keep working for a release, with a DeprecationWarning."""

import importlib
import importlib.abc
import importlib.machinery
import sys
import warnings
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

MOVED = {
    "ablation": "simulation.ablation",
    "adjoint": "gradients.adjoint",
    "arrays": "device.arrays",
    "cloth": "description.cloth",
    "fabrics": "presets.fabrics",
    "files": "io.files",
    "geometry": "view.geometry",
    "learn": "calibration.learn",
    "model": "device.model",
    "paper": "presets.paper",
    "parts": "simulation.substepping",
    "published": "io.published",
    "render": "view.render",
    "scene": "description.scene",
    "simulator": "simulation.simulator",
    "state": "simulation.state",
    "system": "simulation.linear_system",
    "topology": "description.topology",
    "usd": "io.usd",
    "weave": "description.weave",
}
"""Old name of a module in the package, and its new one."""
QUIET = ("fabrics", "learn", "paper")
"""Names that users write, as ``warp_yarn.paper``: these are no mistake."""


class _Old(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds a module by its old name, and loads the new one in its place."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        package, _, name = fullname.rpartition(".")
        known = package == __package__ and name in MOVED
        return importlib.machinery.ModuleSpec(fullname, self) if known else None

    def create_module(self, spec: Any) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__.rpartition(".")[2]
        new = f"{__package__}.{MOVED[name]}"
        if name not in QUIET:
            warnings.warn(f"{module.__name__} is {new} now", DeprecationWarning, stacklevel=2)
        sys.modules[module.__name__] = importlib.import_module(new)


def install() -> None:
    """Lets old names be imported."""
    if not any(isinstance(finder, _Old) for finder in sys.meta_path):
        sys.meta_path.append(_Old())


def renamed(module: str, names: dict[str, str]) -> Callable[[str], Any]:
    """Makes the ``__getattr__`` of a module that finds what it has, {old name: new name}, by the old names too."""

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is {names[name]} now", DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return find


def renamed_attribute(old: str, new: str) -> Any:
    """Makes the property by which an object's attribute is found, and set, by its old name too."""

    def get(self: Any) -> Any:
        warnings.warn(f"{old} is {new} now", DeprecationWarning, stacklevel=2)
        return getattr(self, new)

    def put(self: Any, value: Any) -> None:
        warnings.warn(f"{old} is {new} now", DeprecationWarning, stacklevel=2)
        setattr(self, new, value)

    return property(get, put, doc=f"The old name of ``{new}``.")
