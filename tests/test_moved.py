"""Old names of modules, which keep working for a release."""

import importlib
import warnings

import pytest

import warp_yarn as wy
from warp_yarn.moved import MOVED, QUIET


@pytest.mark.parametrize("name", [name for name in MOVED if name not in QUIET])
def test_an_old_name_is_the_new_module_and_says_so(name: str) -> None:
    import sys

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
