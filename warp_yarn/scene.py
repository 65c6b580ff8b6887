"""What happens to a cloth: gravity, wind, pins, applied forces, and which terms are modelled at all."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .cloth import Cloth
from .errors import InputError, choice, finite_array, indices, number
from .kernels import TERMS


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wind:
    """A constant wind.

    Args:
        velocity: of the air [m/s], 3 numbers.
        density: ρ_w, of the pressure [kg/m³], at least 0.
        drag: c_d, of the tangential drag [kg/(m² s)], at least 0.
    """

    velocity: tuple[float, float, float]
    density: float = 2.0
    drag: float = 0.5

    def __post_init__(self) -> None:
        finite_array("wind velocity", self.velocity, (3,))
        number("wind density", self.density, least=0.0)
        number("wind drag", self.drag, least=0.0)


class Scene:
    """A cloth, what acts on it, and the terms of the model that it wants.

    Args:
        cloth: the cloth.
        gravity: acceleration [m/s²], 3 numbers, or None.
        wind: a Wind, or None.
        pins: nodes that are held, such as ``cloth.corners("top")``.
        pin_stiffness: k_h of a pin's spring [N/m], above 0, or None: held exactly.
        pin_path: where the pins are to be at the end of each step [steps, pins, 3] (m); they stay at the last place.
            None: where the pose has them.
        forces: forces on nodes [N]: {node: 3 numbers, or steps × 3}. After its last step a force is 0; one that is
            given by 3 numbers does not end.
        sliding: whether yarns slide along each other. Without, nodes have 3 degrees of freedom, (u, v) stays at rest,
            and friction, parallel yarns, inertia and mass rate have no part.
        terms: the terms to model, by name; None: all that the scene has a use for. ``mass`` is always there.
        published_scaling: take the arguments of eq. 4's tanh in SI units, as published, instead of dimensionless.
    """

    def __init__(
        self,
        cloth: Cloth,
        *,
        gravity: Sequence[float] | None = (0.0, 0.0, -9.8),
        wind: Wind | None = None,
        pins: Sequence[int] = (),
        pin_stiffness: float | None = 1e4,
        pin_path: Any = None,
        forces: dict[int, Any] | None = None,
        sliding: bool = True,
        terms: Sequence[str] | None = None,
        published_scaling: bool = False,
    ):
        if not isinstance(cloth, Cloth):
            raise InputError(f"cloth = {cloth!r}, must be a Cloth")
        if wind is not None and not isinstance(wind, Wind):
            raise InputError(f"wind = {wind!r}, must be a Wind or None")
        self.cloth = cloth
        self.gravity = None if gravity is None else finite_array("gravity", gravity, (3,))
        self.wind = wind
        self.pins = indices("pins", pins, cloth.nodes, "node")
        self.pin_stiffness = None if pin_stiffness is None else number("pin_stiffness", pin_stiffness, above=0.0)
        self.pin_path = None if pin_path is None else finite_array("pin_path", pin_path, (None, len(self.pins), 3))
        if self.pin_path is not None and len(self.pin_path) == 0:
            raise InputError("pin_path has no step, must have at least one")
        forces = forces or {}
        self.force_nodes = indices("forces", list(forces), cloth.nodes, "node")
        self.force_path = self._force_path(forces)
        self.sliding = bool(sliding)
        self.published_scaling = bool(published_scaling)
        self.terms = self._terms(terms)

    def _force_path(self, forces: dict[int, Any]) -> np.ndarray:
        """[steps + 1, nodes with a force, 3]; the last row is what stays."""
        values = [np.asarray(value, dtype=np.float64) for value in forces.values()]
        steps = max((len(value) for value in values if value.ndim == 2), default=0)
        path = np.zeros((steps + 1, len(values), 3))
        for k, (node, value) in enumerate(zip(forces, values, strict=True)):
            if value.ndim == 2:
                path[: len(value), k] = finite_array(f"forces[{node}]", value, (None, 3))
            else:
                path[:, k] = finite_array(f"forces[{node}]", value, (3,))
        return path

    def _terms(self, names: Sequence[str] | None) -> tuple[str, ...]:
        useless = {name: "yarns do not slide (sliding=False)" for name, t in TERMS.items() if t.sliding_only}
        missing = {} if self.sliding else useless
        if self.gravity is None:
            missing["gravity"] = "gravity is None"
        if self.wind is None:
            missing["wind"] = "wind is None"
        if not len(self.pins) or self.pin_stiffness is None:
            missing["pins"] = "there is no pin with a stiffness"
        if not len(self.force_nodes):
            missing["applied"] = "forces is empty"
        if names is None:
            return tuple(name for name in TERMS if name not in missing)
        if isinstance(names, str):
            raise InputError(f"terms = {names!r}, must be a list of names")
        for name in names:
            choice("terms", name, TERMS)
            if name in missing:
                raise InputError(f"terms names {name!r}, but {missing[name]}")
        return tuple(name for name in TERMS if name in names or name == "mass")
