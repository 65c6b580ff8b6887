"""Cloths and scenes as arrays by name, for recordings."""

from __future__ import annotations

import dataclasses
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..description.cloth import CLOTH_NUMBERS, Cloth
from ..description.cloths import Cloths
from ..description.obstacles import Box, Capsule, Contact, Cylinder, Obstacle, Plane, Sphere, TriangleMesh
from ..description.scene import Scene, Wind
from ..description.weave import Weave
from ..description.yarn import SIZES, Yarn
from ..errors import WarpYarnWarning, choice, integer

SHAPES = {cls.shape: cls for cls in (Box, Capsule, Cylinder, Plane, Sphere, TriangleMesh)}


def packed_cloths(cloth: Cloth | Cloths) -> dict[str, Any]:
    """Packs a cloth into arrays; of several each with its number before their names."""
    if isinstance(cloth, Cloths):
        parts = [packed_cloths(each) for each in cloth.cloths]
        return {"cloths": len(parts)} | {
            f"cloth_{k}_{name}": parts[k][name] for k in range(len(parts)) for name in parts[k]
        }
    given = {name: cloth._arguments[name] for name in CLOTH_NUMBERS}
    if given["friction_damping"] is None:
        given["friction_damping"] = np.nan  # of its own mass, also where others are beside it
    for name in ("spacing", "crimp"):
        value = cloth._arguments[name]
        warp, weft = value if isinstance(value, tuple) else (value, None)
        given |= {name: warp} if weft is None else {name: warp, f"{name}_weft": weft}
    sizes = [[np.nan if size is None else size for size in yarn.sizes] for yarn in cloth.yarns]
    return {
        "draft": cloth.weave.draft,
        "weave": cloth.weave.name,
        "yarns": np.array([(yarn.density, yarn.stretch, yarn.bend) for yarn in cloth.yarns]),
        "sizes": np.array(sizes),
        "colors": np.array([yarn.color or (np.nan,) * 3 for yarn in cloth.yarns]),
        "warp": cloth.warp,
        "weft": cloth.weft,
        "rest": cloth.position,
        **_packed_outline(cloth),
        **given,
    }


def _packed_outline(cloth: Cloth) -> dict[str, Any]:
    """Packs what a cloth is cut to."""
    if cloth.outline is None:
        return {}
    corners = np.concatenate([np.zeros((0, 2)), *cloth.holes])
    return {"outline": cloth.outline, "holes": corners, "hole_corners": [len(hole) for hole in cloth.holes]}


def unpacked_cloths(data: Any) -> Cloth | Cloths:
    """Makes what ``packed_cloths`` made arrays of."""
    if "cloths" in data:
        count = integer("cloths", data["cloths"].item(), least=1)
        return Cloths([_unpacked_cloth(data, f"cloth_{k}_") for k in range(count)])
    return _unpacked_cloth(data, "")


def _unpacked_cloth(data: Any, of: str) -> Cloth:
    yarns = [
        Yarn(density=d, stretch=s, bend=b, color=None if np.isnan(color).any() else tuple(color.tolist()))
        for (d, s, b), color in zip(data[f"{of}yarns"].tolist(), data[f"{of}colors"], strict=True)
    ]
    if f"{of}sizes" in data:
        sizes = [dict(zip(SIZES, each, strict=True)) for each in data[f"{of}sizes"].tolist()]
        sizes = [{name: size for name, size in each.items() if not np.isnan(size)} for each in sizes]
        yarns = [dataclasses.replace(yarn, **each) for yarn, each in zip(yarns, sizes, strict=True)]

    def value(name: str) -> Any:
        array = data[f"{of}{name}"]
        return array if array.ndim else array.item()

    numbers = {name: value(name) for name in (*CLOTH_NUMBERS, "crimp") if f"{of}{name}" in data}
    for name in ("spacing", "crimp"):
        if f"{of}{name}_weft" in data:
            numbers[name] = numbers[name], value(f"{name}_weft")
    if np.isnan(numbers["friction_damping"]).any():
        numbers["friction_damping"] = None
    ends = np.cumsum(data[f"{of}hole_corners"]) if f"{of}hole_corners" in data else ()
    return Cloth(
        Weave(data[f"{of}draft"], str(data[f"{of}weave"])),
        yarns=yarns,
        warp=data[f"{of}warp"].tolist(),
        weft=data[f"{of}weft"].tolist(),
        pose=data[f"{of}rest"],
        outline=data.get(f"{of}outline"),
        holes=np.split(data[f"{of}holes"], ends[:-1]) if len(ends) else (),
        **numbers,
    )


def packed(scene: Scene) -> dict[str, Any]:
    """Packs a scene into arrays; what is None is left out."""
    wind = scene.wind
    values = {
        "terms": np.array(scene.terms),
        "sliding": scene.sliding,
        "published_scaling": scene.published_scaling,
        "gravity": scene.gravity,
        "pins": scene.pins,
        "pin_stiffness": scene.pin_stiffness,
        "pin_path": scene.pin_path,
        "seams": scene.seams,
        "seam_stiffness": scene.seam_stiffness,
        "wind": None if wind is None else [*np.reshape(wind.velocity, (-1, 3))[0], wind.density, wind.drag],
        "wind_path": None if wind is None or np.ndim(wind.velocity) == 1 else wind.velocity,
        "force_nodes": scene.force_nodes,
        **{f"force_{node}": force for node, force in scene.forces.items()},
        "parameters": list(scene.parameters) or None,
        **{f"parameter_{name}": values for name, values in scene.parameters.items()},
        "self_contact": scene.self_contact,
        # left out where they are what recordings of before have
        "pressing": None if scene.contact_force == "published" else scene.contact_force,
        "crimp_interchange": scene.crimp_interchange or None,
        # None is a value of its own there, not always the default
        **{f"contact_{name}": np.nan if value is None else value for name, value in scene.contact._arguments.items()},
        "obstacles": np.array([obstacle.shape for obstacle in scene.obstacles], dtype=str),
    }
    for k, obstacle in enumerate(scene.obstacles):
        values.update({f"obstacle_{k}_{name}": value for name, value in obstacle._arguments.items()})
    return {f"scene_{name}": value for name, value in values.items() if value is not None}


def unpacked(cloth: Cloth | Cloths, data: Any) -> Scene:
    """Makes the scene that ``packed`` made arrays of."""

    def value(name: str) -> Any:
        return data.get(f"scene_{name}")

    wind, stiffness, named = value("wind"), value("pin_stiffness"), value("parameters")
    velocity = None if wind is None else wind[:3] if value("wind_path") is None else value("wind_path")
    return Scene(
        cloth,
        gravity=value("gravity"),
        wind=None if wind is None else Wind(velocity=velocity, density=wind[3], drag=wind[4]),
        pins=value("pins"),
        pin_stiffness=None if stiffness is None else stiffness.item(),
        pin_path=value("pin_path"),
        forces={node: value(f"force_{node}") for node in value("force_nodes").tolist()},
        sliding=value("sliding").item(),
        terms=value("terms").tolist(),
        published_scaling=value("published_scaling").item(),
        parameters={} if named is None else {name: value(f"parameter_{name}").tolist() for name in named.tolist()},
        obstacles=_unpacked_obstacles(data),
        self_contact="scene_self_contact" in data and value("self_contact").item(),
        contact=Contact(**_arguments(data, "contact")),
        **(
            {"seams": value("seams"), "seam_stiffness": value("seam_stiffness").item()} if "scene_seams" in data else {}
        ),
        contact_force=value("pressing").item() if "scene_pressing" in data else "published",
        crimp_interchange="scene_crimp_interchange" in data,
    )


def warn_of_functions(path: str | os.PathLike, scene: Scene | None) -> None:
    """Warns the caller's caller where a recording is written without its scene, whose functions no file holds."""
    if scene is not None and scene.functions:
        given = ", ".join(map(str, scene.functions))
        text = f"{Path(path)} is written without its scene: functions ({given}) cannot be kept"
        warnings.warn(text, WarpYarnWarning, stacklevel=3)


def _unpacked_obstacles(data: Any) -> list[Obstacle]:
    """Makes the obstacles, of which recordings of before have none."""
    shapes = data["scene_obstacles"].tolist() if "scene_obstacles" in data else []
    return [
        SHAPES[choice("obstacles", shape, SHAPES)](**_arguments(data, f"obstacle_{k}"))
        for k, shape in enumerate(shapes)
    ]


def _arguments(data: Any, group: str) -> dict[str, Any]:
    """Gives what something was made of: arrays, and numbers and names as such; NaN is None."""
    start = f"scene_{group}_"
    found = {name.removeprefix(start): data[name] for name in data if name.startswith(start)}
    values = {name: array if array.ndim else array.item() for name, array in found.items()}
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values.items()}
