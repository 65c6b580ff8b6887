"""What happens to a cloth: gravity, wind, pins, applied forces, and which terms are modelled at all."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import InputError, finite_array, flag, indices, real
from ..kernels import TERMS, TermParameter, own
from .cloth import Cloth
from .cloths import Cloths, as_one
from .crimp import check_crimp
from .fixed import Fixed, Replaceable, says_why
from .obstacles import Contact, Obstacle
from .sanity import warn_of_acceleration, warn_of_distances, warn_of_speed
from .seams import checked_seams
from .selection import checked_parameters, selected_terms
from .varying import checked_vectors, of_time


@says_why
@dataclasses.dataclass(frozen=True, kw_only=True)
class Wind(Replaceable):
    """A wind.

    Args:
        velocity: of the air [m/s]: 3 numbers; a row for every step [steps, 3], of which the last one stays; a function
            of time [s], which gives 3 numbers; or gusts, a function of (position, time) that gives [nodes, 3] of
            positions [nodes, 3] (m), or a ``wp.func`` of a node's position and the time, which is evaluated on the
            device, in the simulator's precision. Functions are evaluated in the middle of each step, for all of it.
        density: ρ_w, of the pressure [kg/m³], at least 0.
        drag: c_d, of the tangential drag [kg/(m² s)], at least 0.
    """

    velocity: Any
    density: float = 2.0
    drag: float = 0.5

    def __post_init__(self) -> None:
        # copies: an array that the caller writes to again is not this wind
        keep = functools.partial(object.__setattr__, self)
        velocity: Any = checked_vectors("wind velocity", self.velocity)
        if isinstance(velocity, np.ndarray):
            velocity = tuple(velocity.tolist() if velocity.ndim == 1 else map(tuple, velocity.tolist()))
        warn_of_speed(velocity)
        keep("velocity", velocity)
        keep("density", real("wind density", self.density, least=0.0))
        keep("drag", real("wind drag", self.drag, least=0.0))


class Scene(Fixed):
    """A cloth, what acts on it, and the terms of the model that it wants. It does not change: ``replace`` makes
    another one.

    Args:
        cloth: the cloth, or several, whose nodes are numbered on from one to the next (``Cloths``).
        gravity: acceleration [m/s²], 3 numbers; a row for every step [steps, 3], of which the last one stays; a
            function of time, as of a wind's; or None.
        wind: a Wind, or None.
        pins: nodes that are held, such as ``cloth.corners("top")``.
        pin_stiffness: k_h of a pin's spring [N/m], above 0, or None: held exactly.
        pin_path: where the pins are to be at the end of each step [steps, pins, 3] (m); they stay at the last place.
            None: where the pose has them. A WarpYarnWarning says where its first step is a jump from there.
        forces: forces on nodes [N]: {node: 3 numbers, or steps × 3, or a function of time}. After its last step a force
            is 0; one that is given by 3 numbers does not end.
        sliding: whether yarns slide along each other. Without, nodes have 3 degrees of freedom, (u, v) stays at rest,
            and friction, parallel yarns, inertia and mass rate have no part.
        terms: the terms to model, by name; None: all that the scene has a use for, and of those that were registered
            (``wy.register_term``) the ones that ``parameters`` names a parameter of. ``mass`` is always there.
        published_scaling: take the arguments of eq. 4's tanh in SI units, as published, instead of dimensionless.
        parameters: of registered terms: {name: value}, in the unit and range that the term gives them. One of the yarns
            takes a number for all materials, or one for each; a vector 3 numbers. What is left out has its default.
        obstacles: what the cloth may touch: Plane, Sphere, Capsule, Cylinder, Box, TriangleMesh.
        self_contact: whether the cloth may touch itself; else it passes through itself.
        contact: the law of contact; None: as ``Contact()``.
        seams: pairs of nodes that are sewn together [n, 2], of one cloth or of two, at most two of a node. Nodes of a
            second cloth are those of its own, and ``nodes`` of the first more. They do not go with self_contact, which
            would hold them apart.
        seam_stiffness: k of the spring of each pair [N/m], above 0.
        contact_force: what presses warp and weft together at a crossing: "published", eq. 3, whose stretch forces are
            those of the straight segments; "crimped", of segments that rise by the crimp of the yarns, so that a flat
            cloth's feels their tension.
        crimp_interchange: whether yarns that are crimped straighten at each other's expense before they stretch: the
            term of that name, in place of stretch, with a contact force of its own. Yarns must be crimped as woven,
            and as thick as they rise by that: ``cloth.pressed()``.
    """

    def __init__(
        self,
        cloth: Cloth | Cloths | Sequence[Cloth],
        *,
        gravity: Any = (0.0, 0.0, -9.8),
        wind: Wind | None = None,
        pins: Sequence[int] = (),
        pin_stiffness: float | None = 1e4,
        pin_path: Any = None,
        forces: dict[int, Any] | None = None,
        sliding: bool = True,
        terms: Sequence[str] | None = None,
        published_scaling: bool = False,
        parameters: Mapping[str, Any] | None = None,
        obstacles: Sequence[Obstacle] = (),
        self_contact: bool = False,
        contact: Contact | None = None,
        seams: Any = (),
        seam_stiffness: float = 1e4,
        contact_force: str = "published",
        crimp_interchange: bool = False,
    ):
        if wind is not None and not isinstance(wind, Wind):
            raise InputError(f"wind = {wind!r}, must be a Wind or None")
        self.cloth = as_one(cloth)
        self.gravity = None if gravity is None else of_time("gravity", checked_vectors("gravity", gravity))
        self.wind = wind
        self.pins = indices("pins", pins, self.cloth.nodes, "node")
        self.pin_stiffness = None if pin_stiffness is None else real("pin_stiffness", pin_stiffness, above=0.0)
        self.pin_path = None if pin_path is None else finite_array("pin_path", pin_path, (None, len(self.pins), 3))
        if self.pin_path is not None and len(self.pin_path) == 0:
            raise InputError("pin_path has no step, must have at least one")
        checked = _checked_forces(forces)
        self.functions = _functions(self.gravity, wind, checked)
        self.force_nodes = indices("forces", list(checked), self.cloth.nodes, "node")
        self.force_path = _force_path(checked)
        self.seams = checked_seams(seams, self.cloth.nodes)
        self.seam_stiffness = real("seam_stiffness", seam_stiffness, above=0.0)
        if len(self.seams) and flag("self_contact", self_contact):
            raise InputError("seams with self_contact=True, must be False: it would hold apart what is sewn together")
        self.sliding = flag("sliding", sliding)
        self.published_scaling = flag("published_scaling", published_scaling)
        self._parameters = checked_parameters(parameters, len(self.cloth.yarns))
        if not isinstance(obstacles, Sequence) or not all(isinstance(obstacle, Obstacle) for obstacle in obstacles):
            raise InputError(f"obstacles = {obstacles!r}, must be a list of Plane, Sphere, Capsule, Cylinder, Box, ...")
        self.obstacles = tuple(obstacles)
        self.self_contact = flag("self_contact", self_contact)
        if contact is not None and not isinstance(contact, Contact):
            raise InputError(f"contact = {contact!r}, must be a Contact or None")
        self.contact = Contact() if contact is None else contact
        self.contact.check_obstacles(self.obstacles)
        self.contact_force = contact_force
        self.crimp_interchange = flag("crimp_interchange", crimp_interchange)
        cloths = self.cloth.cloths if isinstance(self.cloth, Cloths) else (self.cloth,)
        check_crimp(cloths, contact_force, self.crimp_interchange)
        self.terms = selected_terms(self, terms)
        warn_of_acceleration(self.gravity)
        warn_of_distances(self)
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
            parameters=self._parameters,
            obstacles=self.obstacles,
            self_contact=self.self_contact,
            contact=contact,
            seams=self.seams,
            seam_stiffness=self.seam_stiffness,
            contact_force=self.contact_force,
            crimp_interchange=self.crimp_interchange,
        )

    def __repr__(self) -> str:
        return f"Scene({self.cloth}, terms {', '.join(self.terms)}, sliding {self.sliding})"

    @property
    def has_barrier(self) -> bool:
        """Tells whether what touches does so by a barrier."""
        return self.contact.method == "barrier"

    @property
    def has_impact_zones(self) -> bool:
        """Tells whether impact zones keep the cloth from obstacles and itself."""
        return self.contact.method == "impact-zones" and (bool(self.obstacles) or self.self_contact)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of registered terms that were given, the argument that would give these; a copy."""
        return dict(self._parameters)

    @property
    def registered(self) -> dict[str, TermParameter]:
        """The parameters of the scene's registered terms, by name."""
        terms = (TERMS[name] for name in self.terms if name in TERMS)
        return {parameter.name: parameter for term in terms if not own(term) for parameter in term.parameters}

    def registered_value(self, name: str) -> np.ndarray:
        """Finds a value of ``registered``, given or by default: (), a vector (3), or of every material [yarns]."""
        parameter = self.registered[name]
        value = np.array(self._parameters.get(name, parameter.default), dtype=np.float64)
        return np.broadcast_to(value, (len(self.cloth.yarns),)) if parameter.of == "yarn" else value

    @property
    def forces(self) -> dict[int, Any]:
        """Forces on nodes [N]: {node: 3 numbers, or steps × 3, or a function}, the argument that would give these."""
        result: dict[int, Any] = {}
        for k, node in enumerate(self.force_nodes.tolist()):
            path = self.force_path[:, k]
            result[node] = path[-1] if (path == path[-1]).all() else path[:-1]
        return result | {node: function for node, function in self.functions.items() if isinstance(node, int)}

    def same_as(self, other: Scene) -> bool:
        """Tells whether another one asks for the same motion."""

        def values(scene: Scene) -> list[np.ndarray]:
            missing = np.zeros(0)
            arrays = [scene.seams, scene.gravity, scene.pins, scene.pin_path, scene.force_nodes, scene.force_path]
            return [missing if array is None or callable(array) else array for array in arrays]

        names = (
            "wind",
            "pin_stiffness",
            "seam_stiffness",
            "sliding",
            "terms",
            "published_scaling",
            "parameters",
            "self_contact",
            "contact",
            "contact_force",
            "crimp_interchange",
        )
        return (
            self.cloth.same_as(other.cloth)
            and len(self.obstacles) == len(other.obstacles)
            and all(mine.same_as(its) for mine, its in zip(self.obstacles, other.obstacles, strict=True))
            and self.contact == other.contact
            and self.functions == other.functions
            and all(getattr(self, name) == getattr(other, name) for name in names)
            and all(np.array_equal(a, b) for a, b in zip(values(self), values(other), strict=True))
        )


def _functions(gravity: Any, wind: Wind | None, forces: dict[int, Any]) -> dict[str | int, Callable]:
    """Collects what is given by functions: "gravity", "wind", and nodes of forces."""
    given: list[tuple[str | int, Any]] = [
        ("gravity", gravity),
        ("wind", None if wind is None else wind.velocity),
        *forces.items(),
    ]
    return {name: value for name, value in given if callable(value)}


def _checked_forces(forces: Any) -> dict[int, Any]:
    """Gives {node: 3 numbers, or steps × 3, or a function of time}."""
    if forces is None:
        return {}
    if not isinstance(forces, Mapping):
        raise InputError(f"forces = {forces!r}, must be a dictionary, {{node: 3 numbers, or steps × 3}}")
    result = {}
    for node, value in forces.items():
        name = f"forces[{node!r}]"
        if callable(value):
            result[node] = of_time(name, value)
            continue
        try:
            steps = np.ndim(value) == 2
        except ValueError as error:  # ragged
            raise InputError(f"{name} must be an array of numbers, got {value!r}") from error
        result[node] = finite_array(name, value, (None, 3) if steps else (3,))
        result[node].setflags(write=False)
    return result


def _force_path(forces: dict[int, Any]) -> np.ndarray:
    """Makes the path [steps + 1, nodes with a force, 3]; the last row is what stays. What is a function is 0 there."""
    rows = [np.zeros(3) if callable(value) else value for value in forces.values()]
    steps = max((len(value) for value in rows if value.ndim == 2), default=0)
    path = np.zeros((steps + 1, len(forces), 3))
    for k, value in enumerate(rows):
        path[: len(value) if value.ndim == 2 else steps + 1, k] = value
    return path
