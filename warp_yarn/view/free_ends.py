"""Where free ends of yarns pass, which lie on the last yarn that they cross and go straight from there."""

from __future__ import annotations

import itertools
import math

import numpy as np

from ..description.cloth import Cloth
from ..description.cloths import Cloths

STEEPEST = 0.5
"""Slope of free ends."""
LEAN = STEEPEST / math.hypot(1.0, STEEPEST)
"""How far the caps of these reach beyond their middle, in half heights."""


def clear(reach: float, height: float, half: float, crossed: np.ndarray) -> float:
    """Gives the height of a free end, or, where the yarn would be in the one that it crosses last or be steeper than
    ``STEEPEST``, that of lying on it and leaving it so steep.

    Args:
        reach: how far it is from there (m).
        height: where it would be (m).
        half: half the height of its section (m).
        crossed: of that yarn, as ``Strands.across`` [3] (m).
    """
    wide, high, side = crossed[0] + half, crossed[1] + half, float(np.sign(-crossed[2]))
    if crossed[0] == 0.0:
        return height
    leaves = math.atan2(high, STEEPEST * wide)
    a, cosine, sine = reach / wide, math.cos(leaves), math.sin(leaves)
    least = math.sqrt(1.0 - a**2) if a < cosine else sine - (a - cosine) * cosine / sine
    return float(crossed[2] + side * max(side * (height - crossed[2]), high * least))


def rested(
    x: np.ndarray, reach: np.ndarray, end: np.ndarray, half: np.ndarray, crossed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Computes where a free end passes that lies on the yarn that it crosses last, and goes straight from there.

    Args:
        x: how far from the crossing [rings] (m).
        reach: how far the end is [rings] (m).
        end: its height, not less than that of lying there [rings] (m).
        half: half the height of the section [rings] (m).
        crossed: of the yarn that is crossed, as ``Strands.across`` [rings, 3] (m).

    Returns:
        Heights [rings] (m), and their slopes along x [rings].
    """
    wide, high, side = crossed[:, 0] + half, crossed[:, 1] + half, np.sign(-crossed[:, 2])
    # the yarn's middle is on an ellipse, in units of its axes, until the tangent to the end
    x, a, b = x / wide, reach / wide, side * (end - crossed[:, 2]) / high
    far = np.hypot(a, b)
    leaves = np.arctan2(b, a) + np.arccos(np.minimum(1.0 / far, 1.0))
    cosine, sine = np.cos(leaves), np.sin(leaves)
    on = x < cosine
    above = np.sqrt(np.maximum(1.0 - x**2, 1e-12))
    height = np.where(on, above, sine - (x - cosine) * cosine / sine)
    slope = np.where(on, -x / above, -cosine / sine)
    return crossed[:, 2] + side * high * height, side * high / wide * slope


def trims(cloth: Cloth | Cloths) -> np.ndarray:
    """Computes how much shorter free ends are drawn than they are cut [nodes] (m): where a warp and a weft yarn would
    meet but for the outline, the ends of both may reach into each other."""
    if isinstance(cloth, Cloths):
        return np.concatenate([trims(each) for each in cloth.cloths])
    result = np.zeros(cloth.nodes)
    lines, yarns, found = cloth.lines, cloth.node_yarns, {}
    for node in np.flatnonzero(cloth.topology.is_end).tolist():
        place = cloth.topology.place[node, ::-1].copy()
        off = cloth.rest_grid[node] - [lines[0][place[0]], lines[1][place[1]]]
        along = int(np.abs(off).argmax())
        place[along] += 1 if off[along] > 0.0 else -1
        left = abs(lines[along][place[along]] - cloth.rest_grid[node, along])
        found.setdefault(tuple(place.tolist()), ([], []))[along].append((node, left))
    for warp, weft in found.values():
        for (a, left_a), (b, left_b) in itertools.product(warp, weft):
            mine, its = cloth.halves[yarns[a, 0]], cloth.halves[yarns[b, 1]]
            into = its[0] + LEAN * mine[1] - left_a, mine[0] + LEAN * its[1] - left_b
            if min(into) > 0.0:
                # one of them is enough
                node = a if into[0] < into[1] else b
                result[node] = max(result[node], min(into))
    return result
