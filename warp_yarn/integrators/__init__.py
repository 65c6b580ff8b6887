"""Time integration: one method a file, each with its step and the adjoint of its step side by side.

A method is a class that says its ``name``, ``order`` and, in its docstring, its stability; ``advance`` makes a step of
the model's state arrays; ``prepare_adjoint`` and ``backward_step`` are its reverse (``linear.py`` says
what they leave).
"""

from typing import Any

from .esdirk3 import ESDIRK3
from .implicit_euler import ImplicitEuler
from .implicit_midpoint import ImplicitMidpoint
from .linear import LinearlyImplicitEuler
from .ros2 import ROS2
from .sdirk2 import SDIRK2

INTEGRATORS: dict[str, Any] = {
    method.name: method for method in (LinearlyImplicitEuler, ImplicitEuler, ImplicitMidpoint, SDIRK2, ROS2, ESDIRK3)
}
"""Every method by its name."""
