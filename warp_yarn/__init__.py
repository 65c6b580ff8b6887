"""Differentiable simulation of woven fabric, yarn by yarn."""

from .cloth import Cloth, Yarn
from .errors import GradientError, InputError, SimulationError, WarpYarnError
from .scene import Scene, Wind
from .simulator import Simulator
from .state import State, Trajectory
from .weave import WEAVES, Weave

__all__ = [
    "WEAVES",
    "Cloth",
    "GradientError",
    "InputError",
    "Scene",
    "SimulationError",
    "Simulator",
    "State",
    "Trajectory",
    "WarpYarnError",
    "Weave",
    "Wind",
    "Yarn",
]
