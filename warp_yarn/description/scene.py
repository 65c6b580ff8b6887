"""What happens to a cloth: gravity, wind, pins, applied forces, and which terms are modelled at all."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import InputError, choice, finite_array, indices, number
from ..kernels import TERMS
from .cloth import Cloth, Fixed
from .cloths import Cloths, as_one
from .obstacles import Contact, Obstacle


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
        # copies: an array that the caller writes to again is not this wind
        keep = functools.partial(object.__setattr__, self)
        keep("velocity", tuple(finite_array("wind velocity", self.velocity, (3,)).tolist()))
        keep("density", number("wind density", self.density, least=0.0))
        keep("drag", number("wind drag", self.drag, least=0.0))


class Scene(Fixed):
    """A cloth, what acts on it, and the terms of the model that it wants. It does not change: ``replace`` makes
    another one.

    Args:
        cloth: the cloth, or several, whose nodes are numbered on from one to the next (``Cloths``).
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
        obstacles: what the cloth may touch: Plane, Sphere, Capsule, Cylinder, Box, TriangleMesh.
        self_contact: whether the cloth may touch itself; else it passes through itself.
        contact: the law of contact; None: as ``Contact()``.
    """

    def __init__(
        self,
        cloth: Cloth | Cloths | Sequence[Cloth],
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
        obstacles: Sequence[Obstacle] = (),
        self_contact: bool = False,
        contact: Contact | None = None,
    ):
        if wind is not None and not isinstance(wind, Wind):
            raise InputError(f"wind = {wind!r}, must be a Wind or None")
        self.cloth = as_one(cloth)
        self.gravity = None if gravity is None else finite_array("gravity", gravity, (3,))
        self.wind = wind
        self.pins = indices("pins", pins, self.cloth.nodes, "node")
        self.pin_stiffness = None if pin_stiffness is None else number("pin_stiffness", pin_stiffness, above=0.0)
        self.pin_path = None if pin_path is None else finite_array("pin_path", pin_path, (None, len(self.pins), 3))
        if self.pin_path is not None and len(self.pin_path) == 0:
            raise InputError("pin_path has no step, must have at least one")
        checked = self._checked_forces(forces)
        self.force_nodes = indices("forces", list(checked), self.cloth.nodes, "node")
        self.force_path = self._force_path(checked)
        self.sliding = bool(sliding)
        self.published_scaling = bool(published_scaling)
        if not isinstance(obstacles, Sequence) or not all(isinstance(obstacle, Obstacle) for obstacle in obstacles):
            raise InputError(f"obstacles = {obstacles!r}, must be a list of Plane, Sphere, Capsule, Cylinder, Box, ...")
        self.obstacles = tuple(obstacles)
        self.self_contact = bool(self_contact)
        if contact is not None and not isinstance(contact, Contact):
            raise InputError(f"contact = {contact!r}, must be a Contact or None")
        self.contact = Contact() if contact is None else contact
        self.terms = self._terms(terms)
        self._fix(
            cloth=self.cloth,
            gravity=self.gravity,
            wind=wind,
            pins=self.pins,
            pin_stiffness=self.pin_stiffness,
            pin_path=self.pin_path,
            forces=checked,
            sliding=self.sliding,
            terms=None if terms is None else self.terms,
            published_scaling=self.published_scaling,
            obstacles=self.obstacles,
            self_contact=self.self_contact,
            contact=contact,
        )

    def __repr__(self) -> str:
        return f"Scene({self.cloth}, terms {', '.join(self.terms)}, sliding {self.sliding})"

    @property
    def forces(self) -> dict[int, np.ndarray]:
        """Forces on nodes [N]: {node: 3 numbers, or steps × 3}, the argument that would give these."""
        result = {}
        for k, node in enumerate(self.force_nodes.tolist()):
            path = self.force_path[:, k]
            result[node] = path[-1] if (path == path[-1]).all() else path[:-1]
        return result

    def same_as(self, other: Scene) -> bool:
        """Whether another one asks for the same motion."""

        def values(scene: Scene) -> list[np.ndarray]:
            missing = np.zeros(0)
            arrays = [scene.gravity, scene.pins, scene.pin_path, scene.force_nodes, scene.force_path]
            return [missing if array is None else array for array in arrays]

        names = ("wind", "pin_stiffness", "sliding", "terms", "published_scaling", "self_contact", "contact")
        return (
            self.cloth.same_as(other.cloth)
            and len(self.obstacles) == len(other.obstacles)
            and all(mine.same_as(its) for mine, its in zip(self.obstacles, other.obstacles, strict=True))
            and all(getattr(self, name) == getattr(other, name) for name in names)
            and all(np.array_equal(a, b) for a, b in zip(values(self), values(other), strict=True))
        )

    @staticmethod
    def _checked_forces(forces: Any) -> dict[int, np.ndarray]:
        """{node: 3 numbers, or steps × 3}."""
        if forces is None:
            return {}
        if not isinstance(forces, Mapping):
            raise InputError(f"forces = {forces!r}, must be a dictionary, {{node: 3 numbers, or steps × 3}}")
        result = {}
        for node, value in forces.items():
            name = f"forces[{node!r}]"
            try:
                steps = np.ndim(value) == 2
            except ValueError as error:  # ragged
                raise InputError(f"{name} must be an array of numbers, got {value!r}") from error
            result[node] = finite_array(name, value, (None, 3) if steps else (3,))
            result[node].setflags(write=False)
        return result

    @staticmethod
    def _force_path(forces: dict[int, np.ndarray]) -> np.ndarray:
        """[steps + 1, nodes with a force, 3]; the last row is what stays."""
        steps = max((len(value) for value in forces.values() if value.ndim == 2), default=0)
        path = np.zeros((steps + 1, len(forces), 3))
        for k, value in enumerate(forces.values()):
            path[: len(value) if value.ndim == 2 else steps + 1, k] = value
        return path

    def _terms(self, names: Sequence[str] | None) -> tuple[str, ...]:
        if names is not None and (isinstance(names, str) or not isinstance(names, Iterable)):
            raise InputError(f"terms = {names!r}, must be a list of names")
        names = None if names is None else tuple(names)
        useless = {name: "yarns do not slide (sliding=False)" for name, t in TERMS.items() if t.sliding_only}
        missing = {} if self.sliding else useless
        if self.gravity is None:
            missing["gravity"] = "gravity is None"
        if self.wind is None:
            missing["wind"] = "wind is None"
        if not len(self.pins) or self.pin_stiffness is None:
            missing["pins"] = "there is no pin with a stiffness"
        if not self.obstacles:
            missing["obstacles"] = "there is none"
        if not self.self_contact:
            missing["self_contact"] = "self_contact is False"
        if not len(self.force_nodes):
            missing["applied"] = "forces is empty"
        if names is None:
            return tuple(name for name in TERMS if name not in missing)
        for name in names:
            choice("terms", name, TERMS)
            if name in missing:
                raise InputError(f"terms names {name!r}, but {missing[name]}")
        return tuple(name for name in TERMS if name in names or name == "mass")
