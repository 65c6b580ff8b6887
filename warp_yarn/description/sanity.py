"""Numbers that can be used and are likely not meant, in another unit than SI or far from where the cloth is: a warning
that says which."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import WarpYarnWarning, real

if TYPE_CHECKING:
    from .cloth import Cloth
    from .scene import Scene
    from .woven import Woven

DISTANCE = (1e-5, 5e-2)
"""Of neighbouring yarns that anyone weaves or stands for others by [m]: from fine filaments to nets."""
RADIUS = (1e-6, 2e-2)
"""Of yarns [m]."""
CRIMP = 0.6
"""Of a distance: woven yarns have up to some 0.3; in % it would be 1 to 30."""
AREA_DENSITY = (2e-3, 3e1)
"""Mass of an area [kg/m²]: a veil has 4e-3, the paper's cloth 4.8, thick woven belts some 15."""
ACCELERATION = 200.0
"""Twenty times gravity [m/s²]: in cm/s² it is 980."""
SPEED = 350.0
"""Of wind [m/s], beyond sound: 10 m/s are 1000 cm/s."""
GRAVITY = 9.8
"""By which weights are told that forces are compared with [m/s²]."""
STEP = 0.2
"""Of time [s]: films have 24 frames a second; longer steps look for equilibrium."""
ROUNDED = 20.0
"""Weights of a node, by which single precision may round the pull of a yarn: at some 30 cloth is a hundredth off its
way, and at 200 a quarter."""

FAR = 3.0
"""In spacings: from how far on what is drawn together, or moved, in the first step is not near."""


def warn_of_units(cloth: Cloth) -> None:
    """Warns where a cloth has distances, sizes, crimps or a mass that no fabric has."""
    gaps = np.diff(cloth.lines[1]), np.diff(cloth.lines[0])
    every = np.concatenate(gaps)
    _check("spacing", every, DISTANCE, "m", "in metres: 1e-3 for a millimetre")
    for name, values, usual in _sizes(cloth):
        _check(name, np.array(values), usual, "m", "in metres: 5e-4 for half a millimetre")
    _check("crimp", cloth.yarn_crimp, (0.0, CRIMP), "", "a part of the distance: 0.05 for 5 %")
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material]
    long = density * (1.0 + cloth.yarn_crimp)
    is_weft = cloth.topology.yarn_direction == 1
    # yarns of both directions over an area; of distances that are wrong themselves enough has been said
    mass = float(long[~is_weft].mean() / gaps[0].mean() + long[is_weft].mean() / gaps[1].mean())
    least, most = AREA_DENSITY
    if DISTANCE[0] <= every.min() and every.max() <= DISTANCE[1] and not least <= mass <= most:
        apart = " and ".join(dict.fromkeys(f"{gap.mean():g}" for gap in gaps))
        warnings.warn(
            f"yarns of {density.min():g} to {density.max():g} kg/m, {apart} m apart, make a cloth of {1e3 * mass:.3g} "
            f"g/m², fabrics have {1e3 * least:g} to {1e3 * most:.0f} g/m²: is density in kg/m? 1 tex is 1e-6 kg/m",
            WarpYarnWarning,
            stacklevel=3,
        )


def _sizes(cloth: Cloth) -> Iterator[tuple[str, list[float], tuple[float, float]]]:
    """Gives the sizes that yarns of the cloth have, by the names that they were given by, and usual ones."""
    used = [cloth.yarns[k] for k in np.unique(cloth.material)]
    round_ones = [yarn.halves(cloth.radius)[0] for yarn in used if yarn.width is None]
    flat = [yarn for yarn in used if yarn.width is not None]
    diameter = 2.0 * RADIUS[0], 2.0 * RADIUS[1]
    if round_ones:
        yield "radius", round_ones, RADIUS
    for name in ("width", "thickness") if flat else ():
        yield name, [getattr(yarn, name) for yarn in flat], diameter


def warn_of_rounding(cloth: Woven) -> None:
    """Warns the caller's caller where positions in single precision make more of stiff yarns' pull than of a node's
    weight."""
    topology, material = cloth.topology, cloth.material[cloth.topology.segment_yarn]
    section = np.pi * cloth.halves[topology.segment_yarn].prod(axis=1)
    stretch = np.array([yarn.stretch for yarn in cloth.yarns])[material] * section
    # a coordinate of the cloth, counted from its middle, is rounded by half of the last place
    off = 0.5 * float(np.finfo(np.float32).eps) * 0.5 * float(np.ptp(cloth.position, axis=0).max())
    pull = float((stretch / cloth.segment_spacing).max()) * off
    weight = GRAVITY * cloth.mass / topology.nodes
    if pull > ROUNDED * weight:
        warnings.warn(
            f"precision = 'single' rounds the pull of a yarn by {pull:.2g} N, {pull / weight:.2g} times the weight of "
            f"a node, usual is at most {ROUNDED:g} times: these yarns are stiff and light, take 'double'",
            WarpYarnWarning,
            stacklevel=3,
        )


def warn_of_acceleration(gravity: Any) -> None:
    """Warns where gravity is likely in another unit."""
    if isinstance(gravity, np.ndarray) and gravity.size:
        size = np.linalg.norm(gravity.reshape(-1, 3), axis=1)
        _check("gravity", size, (0.0, ACCELERATION), "m/s²", "in m/s²: 9.8")


def warn_of_speed(velocity: Any) -> None:
    """Warns where wind is likely in another unit."""
    if not callable(velocity):
        speed = np.linalg.norm(np.reshape(velocity, (-1, 3)), axis=1)
        _check("wind velocity", speed, (0.0, SPEED), "m/s", "in m/s")


def warn_of_distances(scene: Scene) -> None:
    """Warns where seams, or the first places of pins and obstacles on their paths, are far from where they start."""
    spacing = scene.cloth.longest_spacing
    for begin, distance, where, advice in _distances(scene):
        text = f"{begin} {distance:.3g} m {where}, {distance / spacing:.3g} spacings: {advice}"
        warnings.warn(text, WarpYarnWarning, stacklevel=3)


def _distances(scene: Scene) -> Iterator[tuple[str, float, str, str]]:
    """Gives what is far, how far [m], from what, and what to do."""
    cloth, near = scene.cloth, FAR * scene.cloth.longest_spacing
    if len(scene.seams):
        apart = np.linalg.norm(np.diff(cloth.position[scene.seams], axis=1)[:, 0], axis=1)
        k = int(apart.argmax())
        if apart[k] > near:
            advice = (
                "springs without length draw them together at once; give poses that meet there, or bring them there"
            )
            yield f"seams[{k}] = {scene.seams[k].tolist()} are", apart[k], "apart at the start", f"{advice} by pin_path"
    moved = []
    if scene.pin_path is not None and len(scene.pins):
        moved.append(("pin_path", "its pins", cloth.position[scene.pins], scene.pin_path))
    for k, obstacle in enumerate(scene.obstacles):
        if obstacle.path is not None:
            moved.append((f"the path of obstacles[{k}]", "it", obstacle.position[None], obstacle.path[:, None, :3]))
    for name, what, start, path in moved:
        way = np.linalg.norm(np.diff(np.concatenate([start[None], path]), axis=0), axis=2).max(axis=1)
        # what is as fast later on is meant to be
        if way[0] > max(near, FAR * way[1:].max(initial=0.0)):
            yield (
                f"{name} begins",
                way[0],
                f"from {what}",
                "a jump in the first step; begin it where they start",
            )


def checked_step(step: Any) -> float:
    """Gives a time step [s], and warns where it is likely in milliseconds."""
    checked = real("step", step, above=0.0)
    _check("step", np.array([checked]), (0.0, STEP), "s", "in seconds: 1e-3 for a millisecond")
    return checked


def _check(name: str, values: np.ndarray, usual: tuple[float, float], unit: str, hint: str) -> None:
    """Warns the caller's caller's caller where one of some values is not what there is."""
    least, most = usual
    # differences of places are rounded
    wrong = values[(values < least * (1.0 - 1e-9)) | (values > most * (1.0 + 1e-9))]
    if len(wrong):
        among = f"at most {most:g}" if least == 0.0 else f"{least:g} to {most:g}"
        unit = f" {unit}" if unit else ""
        text = f"{name} = {wrong[0]:g}{unit}, usual is {among}{unit}: it has to be {hint}"
        warnings.warn(text, WarpYarnWarning, stacklevel=4)
