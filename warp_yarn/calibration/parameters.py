"""What can be learned of a scene: names of parameters, their ranges, and scenes with other values of them.

Only NumPy: whoever names a parameter, a script's options say, needs no torch. Which data they are learned from is the
matter of ``problem``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..description.cloth import CLOTH_NUMBERS
from ..description.scene import Scene
from ..errors import InputError, real

OF_YARNS = ("density", "stretch", "bend")
OF_CLOTHS = tuple(name for name in CLOTH_NUMBERS if name not in ("spacing", "radius"))
OF_WINDS = {"wind_velocity": "velocity", "wind_density": "density", "wind_drag": "drag"}
"""Parameters of a wind, and its attributes."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What is to be learned, in its own unit.

    Args:
        name: "density[k]", "stretch[k]", "bend[k]" of material k; a number of the cloth, such as "shear" or "friction",
            with the place in the flattened array where the cloth has more than one ("shear[1]" of warp yarns of
            material 0 and weft yarns of material 1; "friction[7]" of node 7);
            "wind_velocity[k]", "wind_density", "wind_drag", "gravity[k]", "pin_stiffness" or "seam_stiffness", where
            the scene has them; a parameter of a registered term of the scene, with an index where it is a vector or the
            yarns'.
        low, high: the range, its ends included; low below high.
        start: where learning begins, in the range.
    """

    name: str
    low: float
    high: float
    start: float

    def __post_init__(self) -> None:
        for end in ("low", "high", "start"):
            real(f"{self.name}: {end}", getattr(self, end))
        if not self.low < self.high:
            raise InputError(f"{self.name}: low = {self.low:g}, must be below high = {self.high:g}")
        if not self.low <= self.start <= self.high:
            raise InputError(f"{self.name}: start = {self.start:g}, must be from {self.low:g} to {self.high:g}")


PAPER = (
    Parameter("density[0]", 1e-3, 3e-3, 2.25e-3),
    Parameter("density[1]", 1e-3, 3e-3, 2.45e-3),
    Parameter("stretch[0]", 0.0, 8e5, 3.35e5),
    Parameter("stretch[1]", 0.0, 3e5, 1.45e5),
    Parameter("bend[0]", 5e-5, 1.8e-4, 1.25e-4),
    Parameter("bend[1]", 5e-5, 1.8e-4, 1.0e-4),
    Parameter("shear", 0.0, 1200.0, 600.0),
    Parameter("friction", 0.0, 1.0, 0.7),
)
"""What the paper learns, with ranges and starts."""


def split(name: str) -> tuple[str, int | None]:
    """Splits ``bend[1]`` into ("bend", 1), and ``shear`` into ("shear", None)."""
    match = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", name)
    if match is None:
        raise InputError(f"parameter {name!r}, must be a name, or a name and an index such as 'bend[0]'")
    return match[1], None if match[2] is None else int(match[2])


def learnable(scene: Scene) -> dict[str, int | None]:
    """Lists what can be learned of a scene: the name, and how many numbers it has; None: one, which takes no index."""
    result: dict[str, int | None] = dict.fromkeys(OF_YARNS, len(scene.cloth.yarns))
    for name in OF_CLOTHS:
        value = getattr(scene.cloth, name)
        result[name] = value.size if np.ndim(value) else None
    if scene.wind is not None:
        result |= {"wind_density": None, "wind_drag": None}
        if np.shape(scene.wind.velocity) == (3,):
            result["wind_velocity"] = 3
    if scene.gravity is not None and np.shape(scene.gravity) == (3,):
        result["gravity"] = 3
    if len(scene.pins) and scene.pin_stiffness is not None:
        result["pin_stiffness"] = None
    if len(scene.seams):
        result["seam_stiffness"] = None
    for name, parameter in scene.registered.items():
        result[name] = len(scene.cloth.yarns) if parameter.of == "yarn" else 3 if parameter.size == 3 else None
    return result


def value_of(scene: Scene, name: str) -> float:
    """Looks up the scene's own value of a parameter, named as in ``Parameter``."""
    base, k = split(name)
    counts = learnable(scene)
    if base not in counts:
        raise InputError(f"parameter {name!r}, must be one that this scene has: {', '.join(counts)}")
    count = counts[base]
    if count is None and k is not None:
        raise InputError(f"parameter {name!r}: {base} is one number, it takes no index")
    if count is not None and (k is None or k >= count):
        raise InputError(f"parameter {name!r}, must have an index from 0 to {count - 1}, such as '{base}[0]'")
    if base in OF_YARNS and k is not None:
        return float(getattr(scene.cloth.yarns[k], base))
    if base in OF_CLOTHS:
        return float(np.ravel(getattr(scene.cloth, base))[k or 0])
    if base in scene.registered:
        return float(scene.registered_value(base)[() if k is None else k])
    value = getattr(scene.wind, OF_WINDS[base]) if base in OF_WINDS else getattr(scene, base)
    return float(value if k is None else value[k])


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """Copies a scene with other values of these parameters, named as in ``Parameter``.

    Raises:
        InputError: a name that the scene does not have, or a value that it does not allow.
    """
    for name in values:
        value_of(scene, name)
    parts: dict[tuple[str, int | None], Any] = {split(name): float(value) for name, value in values.items()}
    old = scene.cloth
    changes: dict[str, Any] = {}
    yarns = [
        dataclasses.replace(yarn, **{base: value for (base, j), value in parts.items() if base in OF_YARNS and j == k})
        for k, yarn in enumerate(old.yarns)
    ]
    numbers = {name: parts.get((name, None), getattr(old, name)) for name in OF_CLOTHS}
    for (name, k), value in parts.items():
        if name in OF_CLOTHS and k is not None:
            numbers[name] = np.array(numbers[name])
            numbers[name].flat[k] = value
    changes["cloth"] = old.replace(yarns=yarns, pose=old.position, **numbers)
    if scene.wind is not None:
        velocity: Any = scene.wind.velocity
        if np.shape(velocity) == (3,):
            velocity = tuple(parts.get(("wind_velocity", k), value) for k, value in enumerate(velocity))
        rest = {OF_WINDS[name]: parts[name, None] for name in ("wind_density", "wind_drag") if (name, None) in parts}
        changes["wind"] = dataclasses.replace(scene.wind, velocity=velocity, **rest)
    if scene.gravity is not None and np.shape(scene.gravity) == (3,):
        changes["gravity"] = np.array([parts.get(("gravity", k), value) for k, value in enumerate(scene.gravity)])
    for name in ("pin_stiffness", "seam_stiffness"):
        if (name, None) in parts:
            changes[name] = parts[name, None]
    changes["parameters"] = scene.parameters
    for (name, k), value in parts.items():
        if name in scene.registered:
            changed = np.array(changes["parameters"].get(name, scene.registered_value(name)))
            changed = np.broadcast_to(changed, scene.registered_value(name).shape).copy()
            changed[() if k is None else k] = value
            changes["parameters"][name] = changed.item() if k is None else changed
    return scene.replace(**changes)


def checked(scene: Scene, parameters: Sequence[Parameter]) -> None:
    """Raises an InputError where a parameter is none of the scene's, is there twice, or its range is not allowed."""
    names = [p.name for p in parameters]
    if not names:
        raise InputError("parameters is empty, must name at least one")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"parameters names {name!r} twice")
    for end in ("low", "high"):
        with_values(scene, {p.name: getattr(p, end) for p in parameters})


def as_inputs(scene: Scene, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Gathers values by names without indices, ``bend`` for ``bend[1]``; numbers that are not named are the scene's."""
    counts = learnable(scene)
    arrays: dict[str, np.ndarray] = {}
    for name, value in zip(names, values, strict=True):
        base, k = split(name)
        if base not in arrays:
            count = counts[base]
            own: Any = (
                value_of(scene, base) if count is None else [value_of(scene, f"{base}[{j}]") for j in range(count)]
            )
            shape = np.shape(getattr(scene.cloth, base)) if base in OF_CLOTHS else np.shape(own)
            arrays[base] = np.reshape(own, shape)
        arrays[base].reshape(-1)[k or 0] = value
    return arrays
