"""Single precision: the same source, another scalar."""

import functools

import numpy as np
import pytest
from cases import Case, make_state, scene
from checks import error, natural

import warp_yarn as wy

CLOTH = "plain"


@functools.cache
def simulator() -> wy.Simulator:
    return wy.Simulator(scene(CLOTH, None), precision="single")


@pytest.mark.parametrize("state_name", ["random", "slack", "stretched"])
def test_forces(state_name: str) -> None:
    """Those of double precision: 1e-7 for every number, times some ten operations that lose a digit at worst."""
    case = Case(CLOTH, state_name, True)
    single, double = simulator().forces(case.state), case.simulator().forces(case.state)
    assert single.keys() == double.keys()
    for term, parts in single.items():
        for actual, expected in zip(parts, double[term], strict=True):
            # a pin's force is the difference of positions, which have 1e-7 of the cloth's size
            assert error(actual, expected, natural(case.cloth, term)) < 1e-5, term


def test_contact() -> None:
    case = Case(CLOTH, "random", True)
    (single_normal, single), (normal, force) = simulator().contact(case.state), case.simulator().contact(case.state)
    assert error(single_normal, normal) < 1e-5
    assert error(single, force, natural(case.cloth, "stretch")) < 1e-5


@pytest.mark.parametrize("state_name", ["rest", "flat"])
def test_finite_where_directions_are_undefined(state_name: str) -> None:
    sim = simulator()
    state = make_state(sim.scene.cloth, state_name)
    assert all(np.isfinite(part).all() for parts in sim.forces(state).values() for part in parts)
    assert np.isfinite(sim.system(state).dense()).all()
    if state_name == "rest":
        assert not sim.forces(state)["bending"][0].any()
