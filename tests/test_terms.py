"""What holds of every term there is, of one that is added too."""

import pytest
from cases import Case
from checks import matrix
from warp_yarn.kernels import TERMS

from warp_yarn.integrators.ros2 import EXPLICIT

KNOWN = ("friction",)
"""Terms whose damping the second solve of ROS2 has."""


@pytest.mark.parametrize("name", [name for name in TERMS if name != "mass"])
def test_ros2_knows_every_damping(name: str) -> None:
    """It solves with M + η D + η² H twice. A D that its second solve has in the matrix and not on the right-hand side
    would make it converge to another motion."""
    case = Case("plain", "random", True)
    damps = matrix(case.simulator(name), case.state, damping=1.0).any()
    assert damps == (name in (*EXPLICIT, *KNOWN))
