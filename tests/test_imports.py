"""What never imports what: device code knows nothing of the rest, and importing warp_yarn loads no more than it needs.

The rules are those of the rooms, which their docstrings say. One that names a room that is gone fails.
"""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest
from warp_yarn.kernels import TERMS

ROOT = Path(__file__).parents[1]
FOLDERS = {"warp_yarn": "warp_yarn", "kernels": "warp_yarn.kernels"}
"""Folders of the package and their names in it."""

TERM_MODULES = {term.define.__module__ for term in TERMS.values() if not term.touches}
K, W = "warp_yarn.kernels", "warp_yarn"

FORBIDDEN = {
    f"{K}.core": {f"{K}.{room}" for room in ("terms", "linear", "nonlinear", "stepping", "contact")},
    f"{K}.terms": {f"{K}.{room}" for room in ("linear", "nonlinear", "stepping", "contact")},
    f"{K}.linear": {f"{K}.{room}" for room in ("terms", "nonlinear", "stepping", "contact")},
    f"{K}.nonlinear": {f"{K}.{room}" for room in ("terms", "linear", "stepping", "contact")},
    f"{K}.stepping": {f"{K}.terms", f"{K}.contact"},
    f"{K}.contact": {f"{K}.{room}" for room in ("terms", "nonlinear", "stepping")},
    f"{K}.drawing": {f"{K}.{room}" for room in ("core", "terms", "linear", "nonlinear", "stepping", "contact")},
    f"{W}.description": {
        "warp", f"{W}.device", f"{W}.simulation", f"{W}.integrators", f"{W}.gradients", f"{W}.calibration", f"{W}.io",
        f"{W}.view", f"{W}.presets",
    },
    f"{W}.device": {f"{W}.{room}" for room in ("integrators", "gradients", "calibration", "io", "view", "presets")},
    f"{W}.integrators": {f"{K}.terms", f"{W}.gradients", f"{W}.calibration", f"{W}.io", f"{W}.view", f"{W}.presets"},
    f"{W}.simulation": {f"{W}.{room}" for room in ("gradients", "calibration", "view", "presets")},
    f"{W}.io": {f"{W}.simulation.simulator", f"{W}.device.model", f"{W}.integrators", f"{W}.gradients"},
    f"{W}.view": {f"{W}.simulation.simulator", f"{W}.device.model", f"{W}.integrators", f"{W}.gradients"},
    f"{W}.presets": {f"{W}.simulation", f"{W}.device", f"{W}.gradients", f"{W}.io"},
    f"{W}.envs": {K, f"{W}.device", f"{W}.integrators", f"{W}.calibration", f"{W}.io", f"{W}.view"},
}  # fmt: skip
"""What no module of a room imports."""
TERMS_BY_NAME = {f"{W}.description.scene", f"{W}.description.selection"}
"""A scene looks up which terms there are; no other description knows kernels."""

ONLY = {
    "torch": {f"{W}.gradients.{module}" for module in ("checkpoints", "fabric", "inputs", "parts", "rollout", "run")}
    | {f"{W}.calibration.problem", f"{W}.envs.gradient", f"{W}.envs.throw", f"{W}.envs.throws"},
    "gymnasium": {f"{W}.envs", f"{W}.envs.throw"},
    "stable_baselines3": set(),
    "pxr": {f"{W}.io.usd", f"{W}.io.usd_prims"},
    "h5py": {f"{W}.io.published", f"{W}.io.recordings"},
    "dtx_to_wif": {f"{W}.io.draft"},
    "viser": set(),
    "scenes": set(),
    "benchmarks": set(),
    "tests": set(),
    "common": set(),
}
"""Where a package may be imported at all; view/ asks for viser by name."""

BETWEEN_TERMS = {(f"{K}.terms.jamming", f"{K}.terms.stretch")}
BETWEEN_TERMS |= {(f"{K}.terms.crimp_interchange", f"{K}.terms.{name}") for name in ("stretch", "bending")}
"""The barrier between crossings takes k_s of the yarn from there, and crimp interchange k_b too."""


def modules() -> dict[str, Path]:
    """Every module of the package by its name."""
    found = {}
    for folder, package in FOLDERS.items():
        for file in sorted((ROOT / folder).rglob("*.py")):
            parts = file.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = file
    return found


MODULES = modules()


def imported(source: str, name: str, is_package: bool) -> set[str]:
    """Names that a module's source imports, wherever it does: modules and, of ``from a import b``, a and a.b."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = name.split(".")
            kept = parts[: len(parts) - node.level + is_package] if node.level else []
            base = ".".join([*kept, *([node.module] if node.module else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return found


@functools.cache
def of(name: str) -> set[str]:
    file = MODULES[name]
    return imported(file.read_text(), name, file.name == "__init__.py")


def reaches(names: set[str], forbidden: set[str]) -> set[str]:
    """Which of the names are one of the forbidden modules, or within one."""
    return {name for name in names if any(name == f or name.startswith(f"{f}.") for f in forbidden)}


def test_imports_are_read_as_python_does():
    source = "import a.b\nfrom . import c\nfrom .d import e\ndef f():\n    from ..g import h\n    import i"
    expected = {"a.b", "p.q", "p.q.c", "p.q.d", "p.q.d.e", "p.g", "p.g.h", "i"}
    assert imported(source, "p.q.m", False) == expected
    assert imported(source, "p.q", True) == expected
    assert reaches({"warp", "warp_yarn.description.cloth", "warp.types"}, {"warp"}) == {"warp", "warp.types"}


@pytest.mark.parametrize("name", [name for name in MODULES if name == K or name.startswith(f"{K}.")])
def test_kernels_import_warp_and_themselves(name):
    known = reaches(of(name), {"warp", K}) | reaches(of(name), set(sys.stdlib_module_names))
    assert of(name) == known


@pytest.mark.parametrize("room", FORBIDDEN)
def test_what_is_forbidden(room):
    importers = {name for name in MODULES if name == room or name.startswith(f"{room}.")}
    assert room in importers and len(importers) > 1
    found = {name: reaches(of(name), FORBIDDEN[room]) for name in importers}
    assert not {name: names for name, names in found.items() if names}


def test_every_room_says_what_belongs_there():
    rooms = {name for name, file in MODULES.items() if file.name == "__init__.py"}
    assert set(FORBIDDEN) < rooms
    assert not {name for name in rooms if not ast.get_docstring(ast.parse(MODULES[name].read_text()))}


def test_descriptions_know_no_kernels():
    descriptions = {name for name in MODULES if name.startswith(f"{W}.description")}
    assert {name for name in descriptions if reaches(of(name), {K})} == TERMS_BY_NAME


def test_terms_import_each_other_where_it_is_declared():
    pairs = {(name, term) for name in TERM_MODULES for term in reaches(of(name), {term for term in TERM_MODULES})}
    assert {(a, ".".join(b.split(".")[:4])) for a, b in pairs} == BETWEEN_TERMS


@pytest.mark.parametrize("package", ONLY)
def test_packages_are_imported_in_their_place(package):
    assert {name for name in MODULES if reaches(of(name), {package})} == ONLY[package]


def test_importing_the_package_loads_no_extra():
    """In a process of its own: making a scene, too, needs Warp, NumPy and tqdm alone."""
    program = (
        "import sys, warp_yarn as wy; wy.paper.hung_cloth(rows=3, columns=3); wy.fabrics.cotton(); wy.write_usd;"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"warp", "warp_yarn", "numpy"} <= loaded
    extras = {"pxr", "torch", "viser", "imageio", "h5py", "scipy", "matplotlib", "newton"}
    extras |= {"gymnasium", "stable_baselines3"}
    assert not loaded & extras
    assert "dtx_to_wif" not in loaded


# -- the tests --------------------------------------------------------------------------------------------------------

TESTS = {file.relative_to(ROOT / "tests").as_posix(): file for file in sorted((ROOT / "tests").rglob("*.py"))}
KNOW_THE_INSIDE = {
    "internals.py",
    # these look at arrays and launches themselves, which no public call gives
    "kernels/test_contact.py",
    "kernels/test_declarations.py",
    "kernels/test_friction.py",
    "kernels/test_inertia.py",
    "kernels/test_multilevel.py",
    "kernels/test_reference_forces.py",
}
"""Files that reach into the package; the others do by the functions of tests/internals.py."""


def reached(source: str) -> set[str]:
    """Insides that a test reaches into: names that begin with an underscore, arrays by name, and a simulator's model
    and stepper."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute):
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            inside = node.attr.startswith("_") and not node.attr.startswith("__") and not own
            within = isinstance(node.value, ast.Attribute) and node.value.attr in ("model", "stepper")
            if inside or within:
                found.add(ast.unparse(node))
        elif isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute) and node.value.attr == "arrays":
            found.add(ast.unparse(node))
    return found


def test_insides_are_seen():
    source = "a._b; self._c; a.__dict__; sim.arrays['x']; a.model(4).b; sim.model.launch(); arrays['y']; s.stepper.d"
    assert reached(source) == {"a._b", "sim.arrays['x']", "sim.model.launch", "s.stepper.d"}


def test_the_insides_of_the_package_are_reached_in_one_file():
    assert {name for name, file in TESTS.items() if reached(file.read_text())} == KNOW_THE_INSIDE


def test_tests_import_no_other_tests():
    modules = {file.stem for file in TESTS.values() if file.stem.startswith("test_")}
    found = {name: imported(file.read_text(), name, False) & modules for name, file in TESTS.items()}
    assert not {name: names for name, names in found.items() if names}


def test_collecting_tests_imports_no_script(scripts_at_collection):
    """Of scenes/ and benchmarks/, by the tests that were collected with this one."""
    assert not scripts_at_collection
