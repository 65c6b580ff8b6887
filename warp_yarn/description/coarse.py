"""Coarse cloths: one yarn that stands for several.

Everything of the fine cloth is shared out among the coarse yarns beside it, linearly by its distance to each, and at
the coarse crossings likewise. So sums over the cloth stay what they are: mass, tension and bending stiffness of all
yarns of a direction, shear stiffness of all crossings, springs and dampers of friction.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, integer
from .weave import Weave
from .woven import OF_CROSSINGS
from .yarn import Yarn

if TYPE_CHECKING:
    from .cloth import Cloth


def coarsened(cloth: Cloth, n: int) -> Cloth:
    """Makes a cloth of one yarn for n of another one, at n times the distance: see ``Cloth.coarsened``."""
    n = integer("n", n, least=1)
    if cloth.outline is not None:
        raise InputError("coarsened: the cloth is cut, must be whole: coarsen it first, and cut that")
    rows, columns = cloth.weave.rows, cloth.weave.columns
    for name, count in (("rows", rows), ("columns", columns)):
        if (count - 1) % n or (count - 1) // n < 2:
            raise InputError(f"n = {n}, must divide the {count - 1} distances between {count} {name} in two or more")
    if n == 1:
        return cloth
    u, v = cloth.lines
    kept = [np.arange(0, count, n) for count in (rows, columns)]
    shares = [_shares(at, at[which]) for at, which in zip((v, u), kept, strict=True)]
    yarns, material = _yarns(cloth, n, shares)
    warp, weft = np.split(material, [len(kept[0])])
    nodes = (kept[1] + columns * kept[0][:, None]).ravel()
    changes: dict[str, Any] = {
        "weave": Weave(cloth.weave.flipped[: len(warp), : len(weft)], cloth.weave.name),
        "yarns": yarns,
        "warp": warp,
        "weft": weft,
        "spacing": (np.diff(v[kept[0]]), np.diff(u[kept[1]])),
        "crimp": 0.0,
        "parallel_stiffness": cloth.parallel_stiffness / n,
        **dict.fromkeys(OF_CROSSINGS, 1.0),  # until the coarse cloth tells where its crossings are
    }
    if not isinstance(cloth._arguments["pose"], str):
        changes["pose"] = cloth.position[nodes]
    return _with_crossings(cloth, cloth.replace(**changes), n, [_inside(share) for share in shares])


def _shares(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Computes the part of each fine yarn that each coarse one has, by where they are [coarse, fine]."""
    return np.stack([np.interp(fine, coarse, part) for part in np.eye(len(coarse))])


def _inside(share: np.ndarray) -> np.ndarray:
    """Gives the border's share, where nothing crosses, to the crossings beside it [coarse - 2, fine - 2]."""
    result = share[1:-1, 1:-1].copy()
    result[0] += share[0, 1:-1]
    result[-1] += share[-1, 1:-1]
    return result


def _yarns(cloth: Cloth, n: int, shares: list[np.ndarray]) -> tuple[list[Yarn], np.ndarray]:
    """Makes the coarse yarns: their materials, and the material of each, warp yarns first."""
    density = np.array([yarn.density for yarn in cloth.yarns])[cloth.material]
    stretch = cloth.stretch_stiffness[cloth.material]
    halves, longer = cloth.halves, 1.0 + cloth.yarn_crimp
    bend = np.array([yarn.bend for yarn in cloth.yarns])[cloth.material] * np.pi * halves.prod(axis=1)
    # as uncrimped yarns that weigh, stretch and bend as these do, by the distance that they cover
    each = np.stack([density * longer, stretch * longer, bend / longer, *halves.T, np.ones(len(longer))], axis=1)
    warp, weft = np.split(each, [cloth.weave.rows])
    sums = np.concatenate([shares[0] @ warp, shares[1] @ weft])
    middle = [share.argmax(axis=1) for share in shares]
    own = np.concatenate([cloth.warp[middle[0]], cloth.weft[middle[1]]]).tolist()
    yarns: dict[tuple, Yarn] = {}
    # what differs by rounding alone is the same
    keys = [(kind, *(float(f"{value:.9e}") for value in row)) for kind, row in zip(own, sums, strict=True)]
    for key, kind, row in zip(keys, own, sums, strict=True):
        if key not in yarns:
            yarns[key] = _yarn(cloth, n, row, kind)
    # those of the edges last: yarns that name no colour have it by their place
    first = sorted(yarns, key=lambda key: (key[-1] < n * (1.0 - 1e-9), key[0]))
    number = {key: k for k, key in enumerate(first)}
    return [yarns[key] for key in first], np.array([number[key] for key in keys])


def _yarn(cloth: Cloth, n: int, total: np.ndarray, kind: int) -> Yarn:
    """Makes a yarn of the sums of several, n times as wide as their mean, as corners lock by, and as thick."""
    density, stretch, bend, half_width, half_thickness, count = total.tolist()
    half_width, half_thickness = n * half_width / count, half_thickness / count
    section = np.pi * half_width * half_thickness
    return dataclasses.replace(
        cloth.yarns[kind],
        density=density,
        stretch=stretch / section,
        bend=bend / section,
        radius=None,
        width=2.0 * half_width,
        thickness=2.0 * half_thickness,
    )


def _with_crossings(cloth: Cloth, coarse: Cloth, n: int, shares: list[np.ndarray]) -> Cloth:
    """Gives a coarse cloth the numbers of its crossings."""
    shape = (cloth.weave.rows, cloth.weave.columns)

    def total(values: np.ndarray) -> np.ndarray:
        """Sums up what all fine crossings have [nodes], at every coarse crossing [coarse nodes]; the border has 1."""
        result = np.ones((coarse.weave.rows, coarse.weave.columns))
        result[1:-1, 1:-1] = shares[0] @ values.reshape(shape)[1:-1, 1:-1] @ shares[1].T
        return result.ravel()

    load, coarse_load = _flat_load(cloth), _flat_load(coarse)
    shear = total(cloth.at_nodes("shear") * _corner_measure(cloth) * (1.0 + load))
    friction = total(cloth.at_nodes("friction")) / total(np.ones(cloth.nodes))
    if coarse_load.any():
        friction *= (cloth.at_nodes("friction") @ load) / (friction @ coarse_load)
    else:  # of yarns without bending, which nothing presses while they lie flat
        friction *= n**4
    changes = {
        "shear": shear / (_corner_measure(coarse) * (1.0 + coarse_load)),
        "friction": friction,
        "friction_stiffness": total(cloth.at_nodes("friction_stiffness")),
    }
    critical = cloth._arguments["friction_damping"] is None
    damping = None if critical else total(cloth.at_nodes("friction_damping"))
    return coarse.replace(friction_damping=damping, **changes)


def _corner_measure(cloth: Cloth) -> np.ndarray:
    """Computes what the shear modulus of every crossing is multiplied by: half widths and distances [nodes]."""
    topology, result = cloth.topology, np.ones(cloth.nodes)
    crossing = topology.crossing_node
    apart = np.abs(cloth.rest_grid[topology.crossing_neighbours] - cloth.rest_grid[crossing][:, None]).sum(axis=(1, 2))
    result[crossing] = cloth.node_widths[crossing].prod(axis=1) * apart
    return result


def _flat_load(cloth: Cloth) -> np.ndarray:
    """Computes F_n of every node while a cloth lies flat, as eq. 3 has it of bending [nodes] (N)."""
    topology, yarn = cloth.topology, cloth.topology.bend_yarn
    direction = topology.yarn_direction[yarn]
    side = np.where(topology.flipped, -1.0, 1.0) * topology.is_crossing
    k_b = np.array([each.bend for each in cloth.yarns])[cloth.material[yarn]] * np.pi * cloth.halves[yarn].prod(axis=1)
    # the warp passes below the weft where a crossing is not flipped
    height = side[topology.bend_nodes] * (cloth.halves[yarn, 1] * np.where(direction == 0, -1.0, 1.0))[:, None]
    along = np.take_along_axis(cloth.rest_grid[topology.bend_nodes], direction[:, None, None], axis=2)[..., 0]
    ends = np.stack([along[:, [2, 0]] - along[:, [1]], height[:, [2, 0]] - height[:, [1]]], axis=2)
    length = np.linalg.norm(ends, axis=2)
    t = ends / length[..., None]
    sine = t[:, 0, 0] * t[:, 1, 1] - t[:, 0, 1] * t[:, 1, 0]
    angle = np.arctan2(sine, -(t[:, 0] * t[:, 1]).sum(axis=1))
    # 2 k_b θ/(Δs l) on each end, across its segment
    size = 2.0 * k_b * angle / ((along[:, 2] - along[:, 0]) * (1.0 + cloth.yarn_crimp[yarn]))
    lift = np.stack([-t[:, 0, 0], t[:, 1, 0]], axis=1) * (size[:, None] / length)
    force = np.zeros((cloth.nodes, 2))
    for node, each in zip(topology.bend_nodes.T, (lift[:, 1], -lift.sum(axis=1), lift[:, 0]), strict=True):
        np.add.at(force, (node, direction), each)
    return np.maximum(0.5 * side * (force[:, 0] - force[:, 1]), 0.0)
