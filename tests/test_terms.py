"""What holds of every term there is, of one that is added too."""

import dataclasses
import inspect

import pytest
from cases import YARNS, Case, cloth, scene
from checks import matrix
from warp_yarn.kernels import TERMS, parameters

import warp_yarn as wy

KNOWN = ("friction",)
"""Terms whose damping the second solve of ROS2 has."""
ELSEWHERE = ("crimp_interchange",)
"""In the place of stretch in scenes of crimped cloth: tests/crimped.py."""
OF_CLOTH = {name: term for name, term in TERMS.items() if not term.touches and name not in ELSEWHERE}
"""Terms without contact, whose scenes are those of tests/kernels/test_obstacles.py."""
RANGES = [(p.name, end) for term in OF_CLOTH.values() for p in term.parameters for end in p.range]


@pytest.mark.parametrize("name", [name for name in OF_CLOTH if name != "mass"])
def test_ros2_knows_every_damping(name: str) -> None:
    """It solves with M + η D + η² H twice. A D that its second solve has in the matrix and not on the right-hand side
    would make it converge to another motion."""
    case = Case("plain", "random", True)
    damps = matrix(case.simulator(name), case.state, damping=1.0).any()
    assert damps == (TERMS[name].explicit_in_ros2 or name in KNOWN)


@pytest.mark.parametrize("name", OF_CLOTH)
def test_what_a_term_says_goes_together(name: str) -> None:
    term = TERMS[name]
    # the watch over energy has its work one way or the other
    assert not (term.works and term.energy)
    assert not term.energy_watched_as or term.energy
    # an energy that is not watched is counted for 0, and so may not be less
    if term.energy and not term.energy_watched_as:
        for state in ("rest", "random", "stretched", "folded"):
            case = Case("twill", state, True)
            assert case.simulator(name).energy(case.state)[name] >= 0.0


@pytest.mark.parametrize(("name", "end"), RANGES)
def test_ranges_of_inputs_are_those_of_descriptions(name: str, end: str) -> None:
    """What a gradient may be asked at is what Yarn, Cloth, Wind and Scene allow: the range is said twice."""

    def described(value: float) -> object:
        if parameters()[name].of == "yarn":
            return dataclasses.replace(YARNS[0], **{name: value})
        if name.startswith("wind_"):
            return wy.Wind(velocity=(0.0, 0.0, 0.0), **{name.removeprefix("wind_"): value})
        if name in inspect.signature(wy.Scene).parameters:
            return wy.Scene(cloth("plain"), **{name: value})
        return cloth("plain").replace(**{name: value})

    bound = parameters()[name].range[end]
    described(bound + 1e-9)
    with pytest.raises(wy.InputError, match=end.replace("least", "at least")):
        described(bound - 1e-9 if end == "least" else bound)
    if end == "least":
        described(bound)


def test_every_parameter_is_an_array() -> None:
    """In a scene that has all terms but contact."""
    arrays = wy.Simulator(scene("plain", None).replace(seams=[[0, 24]]), integrator="linear").arrays
    for name, parameter in ((p.name, p) for term in OF_CLOTH.values() for p in term.parameters):
        of_yarns = parameter.of == "yarn"
        assert arrays[name].shape == ((10,) if of_yarns else (1,))
        assert arrays[name].numpy().size == parameter.size * len(arrays[name])
