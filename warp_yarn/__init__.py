"""Differentiable simulation of woven fabric, yarn by yarn."""

import importlib
import importlib.metadata
from types import ModuleType

from . import moved, view
from .description import outline
from .description.cloth import Cloth
from .description.cloths import Cloths
from .description.crimp import crimp_height
from .description.draft import Draft
from .description.fibre import FIBRES, Fibre
from .description.obstacles import Box, Capsule, Contact, Cylinder, Plane, Sphere, TriangleMesh
from .description.pieces import piece
from .description.scene import Scene, Wind
from .description.weave import WEAVES, Weave
from .description.yarn import Yarn
from .device import start
from .errors import (
    GradientError,
    InputError,
    NoAttributeError,
    SimulationError,
    WarpYarnError,
    WarpYarnWarning,
    missing_extra,
)
from .integrators.stage import StageMethod
from .integrators.tableau import sdirk
from .io.draft import read_draft, write_draft
from .io.published import Published, read_published
from .io.usd import write_usd
from .kernels import Term, TermParameter, Variant
from .presets import fabrics, paper
from .registration import register_integrator, register_term, unregister_integrator, unregister_term
from .simulation.simulator import Simulator
from .simulation.state import State, Trajectory
from .view.camera import Camera
from .view.drawdown import write_drawdown
from .view.render import steady_camera, write_mp4, write_png

moved.install()
start.be_quiet()

__version__ = importlib.metadata.version("warp_yarn")

__all__ = [
    "FIBRES",
    "WEAVES",
    "Box",
    "Camera",
    "Capsule",
    "Cloth",
    "Cloths",
    "Contact",
    "Cylinder",
    "Draft",
    "Fibre",
    "GradientError",
    "InputError",
    "Plane",
    "Published",
    "Scene",
    "SimulationError",
    "Simulator",
    "Sphere",
    "StageMethod",
    "State",
    "Term",
    "TermParameter",
    "Trajectory",
    "TriangleMesh",
    "Variant",
    "WarpYarnError",
    "WarpYarnWarning",
    "Weave",
    "Wind",
    "Yarn",
    "__version__",
    "crimp_height",
    "fabrics",
    "outline",
    "paper",
    "piece",
    "read_draft",
    "read_published",
    "register_integrator",
    "register_term",
    "sdirk",
    "steady_camera",
    "unregister_integrator",
    "unregister_term",
    "view",
    "write_draft",
    "write_drawdown",
    "write_mp4",
    "write_png",
    "write_usd",
]


def __getattr__(name: str) -> ModuleType:
    """Imports ``warp_yarn.torch`` when it is asked for."""
    if name != "torch":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return importlib.import_module(".torch", __name__)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        # what hasattr and getattr with a default take for an answer
        raise NoAttributeError(str(missing_extra("torch", "gradients need", "torch"))) from error
