"""Numbers that can be used and are likely given in another unit than SI: a warning that says which."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import WarpYarnWarning

if TYPE_CHECKING:
    from .cloth import Cloth

DISTANCE = (1e-5, 5e-2)
"""Of neighbouring yarns that anyone weaves or stands for others by [m]: from fine filaments to nets."""
RADIUS = (1e-6, 2e-2)
"""Of yarns [m]."""
AREA_DENSITY = (2e-3, 3e1)
"""Mass of an area [kg/m²]: a veil has 4e-3, the paper's cloth 4.8, thick woven belts some 15."""
ACCELERATION = 200.0
"""Twenty times gravity [m/s²]: in cm/s² it is 980."""
SPEED = 350.0
"""Of wind [m/s], beyond sound: 10 m/s are 1000 cm/s."""


def warn_of_units(cloth: Cloth) -> None:
    """Warns where a cloth has distances or a mass that no fabric has."""
    topology = cloth.topology
    direction = topology.yarn_direction[topology.segment_yarn]
    a, b = topology.segment_nodes.T
    distance = float(np.median(cloth.euler[b, direction] - cloth.euler[a, direction]))
    _check("spacing", distance, DISTANCE, "m", "in metres: 1e-3 for a millimetre")
    _check("radius", float(cloth.radius), RADIUS, "m", "in metres: 5e-4 for half a millimetre")
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material]
    # both yarns of a crossing, over its area; of distances that are wrong themselves enough has been said
    mass = float(density[cloth.material.size - len(cloth.weft) :].mean() + density[: len(cloth.warp)].mean()) / distance
    if DISTANCE[0] <= distance <= DISTANCE[1]:
        least, most = AREA_DENSITY
        if not least <= mass <= most:
            warnings.warn(
                f"yarns of {density.min():g} to {density.max():g} kg/m, {distance:g} m apart, make a cloth of "
                f"{1e3 * mass:.3g} g/m², fabrics have {1e3 * least:g} to {1e3 * most:.0f} g/m²: is density in kg/m? "
                "1 tex is 1e-6 kg/m",
                WarpYarnWarning,
                stacklevel=3,
            )


def warn_of_acceleration(gravity: Any) -> None:
    """Warns where gravity is likely in another unit."""
    if isinstance(gravity, np.ndarray) and gravity.size:
        most = float(np.linalg.norm(gravity.reshape(-1, 3), axis=1).max())
        _check("gravity", most, (0.0, ACCELERATION), "m/s²", "in m/s²: 9.8")


def warn_of_speed(velocity: Any) -> None:
    """Warns where wind is likely in another unit."""
    if not callable(velocity):
        most = float(np.linalg.norm(np.reshape(velocity, (-1, 3)), axis=1).max())
        _check("wind velocity", most, (0.0, SPEED), "m/s", "in m/s")


def _check(name: str, value: float, usual: tuple[float, float], unit: str, hint: str) -> None:
    """Warns the caller's caller's caller where a value is not what there is."""
    least, most = usual
    if not least <= value <= most:
        among = f"at most {most:g}" if least == 0.0 else f"{least:g} to {most:g}"
        text = f"{name} = {value:g} {unit}, usual is {among} {unit}: it has to be {hint}"
        warnings.warn(text, WarpYarnWarning, stacklevel=4)
