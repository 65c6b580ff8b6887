"""Old names of modules and of what is in them, which keep working for a release."""

import importlib
import sys
import warnings

import pytest

import warp_yarn as wy
from warp_yarn.moved import MOVED, QUIET


@pytest.mark.parametrize("name", [name for name in MOVED if name not in QUIET])
def test_an_old_name_is_the_new_module_and_says_so(name: str) -> None:
    sys.modules.pop(f"warp_yarn.{name}", None)
    with pytest.warns(DeprecationWarning, match=rf"warp_yarn\.{name} is warp_yarn\.{MOVED[name]} now"):
        old = importlib.import_module(f"warp_yarn.{name}")
    assert old is importlib.import_module(f"warp_yarn.{MOVED[name]}")


def test_names_that_users_write_are_quiet() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in QUIET:
            importlib.import_module(f"warp_yarn.{name}")
    assert wy.paper is importlib.import_module("warp_yarn.paper")


def test_an_unknown_name_is_no_module() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"warp_yarn\.nothing"):
        importlib.import_module("warp_yarn.nothing")


def test_names_of_before_in_modules_work_and_say_so() -> None:
    """A Fabric was beside the Rollout, and is among what users write."""
    rollout = importlib.import_module("warp_yarn.gradients.rollout")
    with pytest.warns(DeprecationWarning, match=r"gradients\.rollout\.Fabric is warp_yarn\.torch\.Fabric now"):
        assert rollout.Fabric is wy.torch.Fabric
    assert wy.torch.Rollout is rollout.Rollout and wy.torch.Frames is rollout.Frames
    with pytest.raises(AttributeError, match="no attribute 'Fabrics'"):
        _ = rollout.Fabrics


RENAMED = {
    "errors": {"number": "real", "whole": "integer"},
    "io.files": {"whole_file": "atomic_write"},
    "simulation.linear_system": {"System": "LinearSystem", "gather": "read_system"},
    "simulation.substepping": {"Parts": "Substepping"},
}


@pytest.mark.parametrize(("module", "old"), [(module, old) for module, names in RENAMED.items() for old in names])
def test_an_old_name_in_a_module_is_the_new_one_and_says_so(module: str, old: str) -> None:
    found, new = importlib.import_module(f"warp_yarn.{module}"), RENAMED[module][old]
    with pytest.warns(DeprecationWarning, match=rf"warp_yarn\.{module}\.{old} is {new} now") as warned:
        assert getattr(found, old) is getattr(found, new)
    assert warned[0].filename == __file__
    with pytest.raises(AttributeError, match=rf"warp_yarn\.{module}' has no attribute 'nothing'"):
        _ = found.nothing


def test_old_attributes_are_read_and_set_as_the_new_ones() -> None:
    simulator = wy.Simulator(wy.paper.hung_cloth(rows=3, columns=3))
    with pytest.warns(DeprecationWarning, match="parts is substepping now"):
        parts = simulator.parts
    assert parts is simulator.substepping
    for old, new in (("size", "next_size"), ("tried", "last_size"), ("made", "accepted")):
        with pytest.warns(DeprecationWarning, match=f"{old} is {new} now"):
            setattr(parts, old, 7)
        with pytest.warns(DeprecationWarning, match=f"{old} is {new} now"):
            assert getattr(parts, old) == 7 == getattr(parts, new)
