"""What yarns look like: curves over and under each other to the very edge, free ends beyond it, and tubes around them.

At a crossing a warp yarn passes at x − b n and a weft yarn at x + b n, b half the height of its own section and n the
contact normal from warp to weft; at the edge n is that of the two yarns that meet there. A yarn that ends where it
crosses another one goes on a little, as a cut yarn does. A free end lies on the last yarn that it crosses, and goes
straight from there.

A *place* is a node, the tip of a free end, or the turn of a selvedge; strands are rows of places.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..description.cloth import Cloth
from ..description.cloths import Cloths
from .free_ends import clear, rested, trims
from .geometry import PALETTE, contact_normals, unit

FREE_END = 0.4
"""How far a free end sticks out of the yarn that it crosses last, in spacings."""
LEAST_HEIGHT = 0.15
"""Of a section that is squeezed between others, over its height elsewhere."""

Piece = dict[str, np.ndarray]
"""Of one strand, what ``Strands`` has of all, by name."""

CATMULL_ROM = 0.5 * np.array(
    [[0.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [2.0, -5.0, 4.0, -1.0], [-1.0, 3.0, -3.0, 1.0]]
)
"""Weights of four consecutive points by powers of t; the curve runs from the second (t = 0) to the third (t = 1)."""


@dataclasses.dataclass(frozen=True)
class Strands:
    """All yarns of one material, point after point."""

    material: int
    """Index into the cloth's yarns."""
    color: tuple[float, float, float]
    """Red, green, blue from 0 to 1, sRGB."""
    yarn: np.ndarray
    """[strands]: index of the yarn, warp yarns first; of several that selvedges join, the first."""
    half: np.ndarray
    """[strands, 2]: half the width and half the height of the section [m]."""
    crimp: np.ndarray
    """[strands]: how much longer than the distance that it covers at rest the yarn is, over that distance."""
    counts: np.ndarray
    """[strands]: points of each."""
    places: np.ndarray
    """[points]: where they are."""
    height: np.ndarray
    """[points]: over the cloth's middle, along its normal [m]."""
    arc: np.ndarray
    """[points]: length of yarn from its node at u = 0 or v = 0, at rest [m]."""
    arc_of: np.ndarray
    """[points, 2]: node and direction whose u or v goes into ``arc``; and ``arc_sign`` [points] by which factor."""
    arc_sign: np.ndarray
    across: np.ndarray
    """[points, 3]: half the width, half the height, and the height over the middle, of the yarn that is crossed [m]; 0
    where there is none."""

    @property
    def repeated(self) -> np.ndarray:
        """For each control point its index in points: those of a yarn in order, the first and the last twice."""
        yarns = np.split(np.arange(self.counts.sum()), self.counts.cumsum()[:-1])
        return np.concatenate([np.pad(yarn, 1, mode="edge") for yarn in yarns])

    def points(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Finds where the yarns pass [points, 3] (m), of places as ``Weaving.look`` gives them."""
        return places.take(self.places, axis=0) + self.height[:, None] * normals.take(self.places, axis=0)

    def slid(self, rest: np.ndarray, euler: np.ndarray) -> np.ndarray:
        """Computes ``arc`` where yarns have slid from (u, v) at rest to others, [nodes, 2] each (m)."""
        moved = (euler - rest).ravel().take(2 * self.arc_of[:, 0] + self.arc_of[:, 1])
        return self.arc + self.arc_sign * moved


class Weaving:
    """How the yarns of a cloth run, whatever its shape.

    Args:
        cloth: of the yarns.
        selvedge: weft yarns turn at the edge and go on as the next one of their material.

    Attributes:
        strands: the yarns of every material that the cloth uses.
    """

    def __init__(self, cloth: Cloth | Cloths, *, selvedge: bool = False):
        self.cloth, topology = cloth, cloth.topology
        nodes, direction = topology.nodes, topology.yarn_direction
        along = direction[topology.segment_yarn]
        self._before, self._after = np.tile(np.arange(nodes), (2, 2, 1))
        self._yarn = np.full((2, nodes), -1)
        for d in (0, 1):
            a, b = topology.segment_nodes[along == d].T
            self._before[d, b], self._after[d, a] = a, b
            self._yarn[d, a] = self._yarn[d, b] = topology.segment_yarn[along == d]
        self.crossed = np.logical_and(*(self._yarn >= 0))
        self._side = np.where(_flipped(cloth), -1.0, 1.0)
        self._trim = trims(cloth)
        self._half = cloth.halves
        self._tips: list[tuple[int, int, float]] = []
        self._turns: list[tuple[int, int]] = []
        self.strands = self._strands(selvedge)
        self._ends, self._befores = (np.array([tip[k] for tip in self._tips], dtype=int) for k in (0, 1))
        self._reach = np.array([tip[2] for tip in self._tips])[:, None]
        self._edge = np.flatnonzero(self.crossed & (topology.is_crossing == 0))
        # of a node on one yarn only the normal is that of the next one
        self._alone = np.flatnonzero(~self.crossed)
        near = np.concatenate([self._after[:, self._alone], self._before[:, self._alone]])
        self._like = near[(near != self._alone).argmax(axis=0), np.arange(len(self._alone))]

    def look(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Finds all places of one frame [places, 3] (m), of positions [nodes, 3], and the cloth's normals there
        [places, 3], along u × v."""
        return self.looks(position[None])[0]

    def looks(self, positions: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Finds what ``look`` does, of several frames [frames, nodes, 3]."""
        normals = contact_normals(self.cloth, positions) * self._side[:, None]
        return [self._look(position, normal) for position, normal in zip(positions, normals, strict=True)]

    def _look(self, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        edge = self._edge
        tangents = [position[self._after[d, edge]] - position[self._before[d, edge]] for d in (0, 1)]
        normal[edge] = unit(np.cross(*tangents))
        normal[self._alone] = normal[self._like]
        if not self._tips:
            return position, normal
        ends = self._ends
        tips = position[ends] + self._reach * unit(position[ends] - position[self._befores])
        places, normals = [position, tips], [normal, normal[ends]]
        if self._turns:
            a, b = (np.array([turn[k] for turn in self._turns]) for k in (0, 1))
            apart = 0.5 * np.linalg.norm(tips[a] - tips[b], axis=1, keepdims=True)
            out = unit(tips[a] - position[ends[a]] + tips[b] - position[ends[b]])
            places.append(0.5 * (tips[a] + tips[b]) + apart * out)
            normals.append(unit(normal[ends[a]] + normal[ends[b]]))
        return np.concatenate(places), np.concatenate(normals)

    # -- what runs where ---------------------------------------------------------------------------------------------

    def _strands(self, selvedge: bool) -> list[Strands]:
        topology = self.cloth.topology
        order = np.argsort(topology.segment_yarn, kind="stable")
        segments, yarns = topology.segment_nodes[order], topology.segment_yarn[order]
        breaks = (np.diff(yarns, prepend=-1) != 0) | (segments[:, 0] != np.roll(segments[:, 1], 1))
        starts = np.flatnonzero(breaks)
        runs = [np.append(run[:, 0], run[-1, 1]) for run in np.split(segments, starts[1:])]
        pieces: dict[int, list[Piece]] = {}
        for yarn, nodes in zip(yarns[starts].tolist(), runs, strict=True):
            pieces.setdefault(int(self.cloth.material[yarn]), []).append(self._piece(yarn, nodes))
        several, result = len(pieces) > 1, []
        for k in sorted(pieces):
            lift = ((-1.0) ** k) if several else 0.0
            strands = self._turned(pieces[k], lift) if selvedge else pieces[k]
            color = self.cloth.yarns[k].color or PALETTE[k % len(PALETTE)]
            names = ("places", "height", "arc", "arc_of", "arc_sign", "across")
            joined = {name: np.concatenate([each[name] for each in strands]) for name in names}
            yarn = np.array([each["yarn"] for each in strands])
            counts = np.array([len(each["places"]) for each in strands])
            result.append(Strands(k, color, yarn, self._half[yarn], self.cloth.yarn_crimp[yarn], counts, **joined))
        return result

    def _piece(self, yarn: int, nodes: np.ndarray) -> Piece:
        """Describes one yarn, with the free ends that it has where another one crosses its last node."""
        d = int(self.cloth.topology.yarn_direction[yarn])
        crossed, other = self.crossed[nodes], self._yarn[1 - d, nodes]
        side = (2 * d - 1) * self._side[nodes] * crossed
        piece = {
            "places": nodes.copy(),
            "height": side * self._half[yarn, 1],
            "arc": self.cloth.euler[nodes, d],
            "arc_of": np.stack([nodes, np.full_like(nodes, d)], axis=1),
            "arc_sign": np.ones(len(nodes)),
            "across": np.where(crossed[:, None], np.c_[self._half[other], -side * self._half[other, 1]], 0.0),
        }
        for end, beside in ((0, 1), (-1, -2)):
            if self.cloth.topology.is_end[nodes[end]]:
                last, before = int(nodes[end]), int(nodes[beside])
                reach = abs(self.cloth.rest_grid[last, d] - self.cloth.rest_grid[before, d]) - self._trim[last]
                piece["height"][end] = clear(reach, 0.0, self._half[yarn, 1], piece["across"][beside])
                if self._trim[last] > 0.0:
                    piece["places"][end] = self.cloth.topology.nodes + len(self._tips)
                    piece["arc"][end] -= (1 if end else -1) * self._trim[last] * (1.0 + self.cloth.yarn_crimp[yarn])
                    self._tips.append((last, before, -self._trim[last]))
        for end in (0, -1):
            if crossed[end]:
                last, before = nodes[end], nodes[1 if end == 0 else -2]
                gap = abs(self.cloth.rest_grid[last, d] - self.cloth.rest_grid[before, d])
                reach = float(self._half[other[end], 0] + FREE_END * gap)
                tip = {name: value[[end]] for name, value in piece.items()}
                tip["places"] = np.array([self.cloth.topology.nodes + len(self._tips)])
                tip["height"] = np.array([clear(reach, 0.0, self._half[yarn, 1], tip["across"][0])])
                tip["across"] = np.zeros((1, 3))
                length = reach * (1.0 + self.cloth.yarn_crimp[yarn])
                tip["arc"] = tip["arc"] + (length if end else -length)
                self._tips.append((int(last), int(before), reach))
                parts = (piece, tip) if end else (tip, piece)
                piece = {name: np.concatenate([part[name] for part in parts]) for name in piece}
        return {"yarn": np.array(yarn), **piece}

    def _turned(self, pieces: list[Piece], lift: float) -> list[Piece]:
        """Joins the weft yarns of one material to one, by turns at one side of the cloth and the other."""
        topology = self.cloth.topology

        def turns(piece: Piece) -> bool:
            """Tells whether it is a weft yarn with a free end at either side."""
            tips = piece["places"][[0, -1]] - topology.nodes
            return bool(topology.yarn_direction[piece["yarn"]]) and all(k >= 0 and self._tips[k][2] > 0.0 for k in tips)

        weft = [turns(piece) for piece in pieces]
        joined: Piece = {}
        for piece in (p for p, is_weft in zip(pieces, weft, strict=True) if is_weft):
            if not joined:
                joined = piece
                continue
            back = joined["arc_sign"][-1] > 0.0
            following = {name: value[::-1] if back and name != "yarn" else value for name, value in piece.items()}
            first, second = (int(p["places"][end]) - topology.nodes for p, end in ((joined, -1), (following, 0)))
            ends = [self._tips[k][0] for k in (first, second)]
            # half of a half circle from tip to tip
            quarter = 0.25 * np.pi * float(np.abs(np.diff(self.cloth.rest_grid[ends, 0]))[0])
            turn = {name: value[-1:] for name, value in joined.items() if name != "yarn"}
            turn["places"] = np.array([topology.nodes + len(self._tips) + len(self._turns)])
            turn["height"] = np.full(1, lift * self._half[piece["yarn"], 1])
            turn["arc"] = joined["arc"][-1:] + quarter
            sign = -1.0 if back else 1.0
            following["arc"] = turn["arc"] + quarter + sign * (following["arc"] - following["arc"][0])
            following["arc_sign"] = sign * following["arc_sign"]
            self._turns.append((first, second))
            joined = {
                name: value if name == "yarn" else np.concatenate([value, turn[name], following[name]])
                for name, value in joined.items()
            }
        return [p for p, is_weft in zip(pieces, weft, strict=True) if not is_weft] + ([joined] if joined else [])


@dataclasses.dataclass(frozen=True)
class Tubes:
    """Tubes around strands: rings along each yarn, and a flat cap at each end.

    Sections are ellipses, as wide and high as the yarn; between two crossings they are squeezed into the room that the
    yarns that are crossed there leave, so that tubes do not run through each other.
    """

    strands: Strands
    counts: np.ndarray
    """[strands]: rings of each."""
    places: np.ndarray
    """[rings, 4]: of the points before, at or before, after, and after that."""
    weights: np.ndarray
    """[rings, 4]: of these, for the cloth's middle; ``slopes``, for its derivative."""
    slopes: np.ndarray
    share: np.ndarray
    """[rings]: how far a ring is from the second to the third."""
    height: np.ndarray
    """[rings]: over the cloth's middle [m]; ``rise``, its derivative along ``share``."""
    rise: np.ndarray
    half: np.ndarray
    """[rings, 2]: half the width and the height of sections [m]."""
    points: np.ndarray
    """[rings, 2]: the points at or before, and after, among the strands'."""

    @classmethod
    def around(cls, strands: Strands, *, samples: int) -> Tubes:
        """Makes tubes with `samples` rings a segment, and one at the last end."""
        counts = (strands.counts - 1) * samples + 1
        first = np.repeat(strands.counts.cumsum() - strands.counts, counts)
        last = np.repeat(strands.counts.cumsum() - 1, counts)
        along = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts)
        segment = np.minimum(first + along // samples, last - 1)
        share = (along - (segment - first) * samples) / samples
        one = np.ones_like(share)
        weights = np.stack([one, share, share**2, share**3], axis=1) @ CATMULL_ROM
        slopes = np.stack([0 * one, one, 2 * share, 3 * share**2], axis=1) @ CATMULL_ROM
        near = np.clip(segment[:, None] + np.arange(-1, 3), first[:, None], last[:, None])
        smooth, steep = _smooth(share), 6.0 * share * (1.0 - share)
        low, high = strands.height[segment], strands.height[segment + 1]
        height, rise = low + smooth * (high - low), steep * (high - low)
        half = np.repeat(strands.half, counts, axis=0)
        gap = np.abs(strands.arc[segment + 1] - strands.arc[segment]) / (1.0 + np.repeat(strands.crimp, counts))
        before, after = strands.across[segment], strands.across[segment + 1]
        full = half[:, 1].copy()
        half[:, 1] = squeezed(share, gap, height, full, before, after)
        for way, crossed, end, at_end in (
            (-1.0, after, low, (segment == first) & (before[:, 0] == 0.0)),
            (1.0, before, high, (segment + 1 == last) & (after[:, 0] == 0.0)),
        ):
            ends = at_end & (crossed[:, 0] > 0.0)
            along = share[ends] if way > 0.0 else 1.0 - share[ends]
            height[ends], slope = rested(along * gap[ends], gap[ends], end[ends], full[ends], crossed[ends])
            rise[ends], half[ends, 1] = way * gap[ends] * slope, full[ends]
        places, points = strands.places[near], np.stack([segment, segment + 1], axis=1)
        return cls(strands, counts, places, weights, slopes, share, height, rise, half, points)

    def between(self, values: np.ndarray) -> np.ndarray:
        """Interpolates values at the strands' points [points] to the rings [rings]."""
        return (1.0 - self.share) * values[self.points[:, 0]] + self.share * values[self.points[:, 1]]

    def rings(self, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Finds the middle of every ring [rings, 3] (m), and unit vectors along its width and its height
        [rings, 2, 3], of places as ``Weaving.look`` gives them."""
        share = self.share[:, None]
        normal = unit((1.0 - share) * normals[self.places[:, 1]] + share * normals[self.places[:, 2]])
        centre, tangent = self.height[:, None] * normal, self.rise[:, None] * normal
        for k in range(4):
            points = places[self.places[:, k]]
            centre += self.weights[:, k, None] * points
            tangent += self.slopes[:, k, None] * points
        across = np.cross(normal, tangent)
        lost = (across**2).sum(axis=1) <= 1e-12 * (tangent**2).sum(axis=1)
        if lost.any():
            # along the normal, or without one: any way across will do
            axis = np.eye(3)[np.abs(tangent[lost]).argmin(axis=1)]
            across[lost] = np.cross(axis, tangent[lost])
        across = unit(across)
        return centre, np.stack([across, np.cross(unit(tangent), across)], axis=1)

    def vertices(self, places: np.ndarray, normals: np.ndarray, sides: int) -> np.ndarray:
        """Finds the vertices [rings · sides, 3] (m), ring after ring."""
        centre, across = self.rings(places, normals)
        angle = 2.0 * np.pi * np.arange(sides) / sides
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return (centre[:, None] + (circle * self.half[:, None]) @ across).reshape(-1, 3)

    def faces(self, sides: int) -> tuple[np.ndarray, np.ndarray]:
        """Lists the number of corners of each face, and the vertices at them, counter-clockwise seen from outside."""
        side = np.arange(sides)
        end = self.counts.cumsum()
        ring = np.delete(np.arange(end[-1]), end - 1)[:, None] * sides
        this, following = ring + side, ring + np.roll(side, -1)
        quads = np.stack([this, following, following + sides, this + sides], axis=2)
        caps = np.stack([(end - self.counts)[:, None] * sides + side[::-1], (end - 1)[:, None] * sides + side])
        corners = np.repeat([4, sides], [quads.shape[0] * sides, 2 * len(end)])
        return corners, np.concatenate([quads.ravel(), caps.ravel()])

    @property
    def capped(self) -> tuple[np.ndarray, np.ndarray]:
        """The rings, and once more those of the caps, all at the beginnings and all at the ends [capped rings]; and
        which way these look along the yarn: -1, 1, and 0 for the others."""
        end = self.counts.cumsum()
        ends = np.stack([end - self.counts, end - 1])
        way = np.repeat([-1.0, 1.0], len(end))
        return np.append(np.arange(end[-1]), ends), np.append(np.zeros(end[-1]), way)

    def triangles(self, sides: int) -> np.ndarray:
        """Lists the faces of the capped rings as triangles [triangles, 3], int32."""
        total, tubes = self.counts.sum(), len(self.counts)
        _, vertices = self.faces(sides)
        quads = vertices[: 4 * (total - tubes) * sides].reshape(-1, 4)
        k = np.arange(1, sides - 1)
        fan = np.stack([0 * k, k, k + 1], axis=1)
        first = (total + np.arange(2 * tubes))[:, None, None] * sides
        caps = np.concatenate([first[:tubes] + fan[:, ::-1], first[tubes:] + fan]).reshape(-1, 3)
        return np.concatenate([quads[:, :3], quads[:, [0, 2, 3]], caps]).astype(np.int32)


def squeezed(
    share: np.ndarray, gap: np.ndarray, height: np.ndarray, half: np.ndarray, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Computes half the height of sections that leave room for the yarns crossed before and after them [rings] (m).

    Args:
        share: how far each is from the one to the other [rings].
        gap: how far these are apart [rings] (m).
        height: of its middle over the cloth's [rings] (m).
        half: half its height where there is room [rings] (m).
        before, after: of the yarns that are crossed, as ``Strands.across`` [rings, 3] (m).
    """
    keys = np.column_stack([share, gap, height, half, before, after])
    # the same few over and over; rounding makes no new ones
    scale = max(float(gap.max(initial=0.0)), np.finfo(float).tiny)
    _, index, inverse = np.unique(np.round(keys / scale, 6), axis=0, return_index=True, return_inverse=True)
    share, gap, height, half, before, after = (value[index] for value in (share, gap, height, half, before, after))
    angle = np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False)
    room = half.copy()
    for crossed, way in ((before, share * gap), (after, (share - 1.0) * gap)):
        x = crossed[:, :1] * np.cos(angle) - way[:, None]
        z = crossed[:, 2:] + crossed[:, 1:2] * np.sin(angle) - height[:, None]
        distance = np.sqrt((x**2 + z**2).min(axis=1))
        room = np.where(crossed[:, 0] > 0.0, np.minimum(room, distance), room)
    return np.maximum(room, LEAST_HEIGHT * half)[inverse.ravel()]


def _smooth(share: np.ndarray) -> np.ndarray:
    """Goes from 0 to 1, level at both."""
    return share**2 * (3.0 - 2.0 * share)


def _flipped(cloth: Cloth | Cloths) -> np.ndarray:
    """Tells where warp is over weft [nodes], at the edge too, where a simulation takes no account of it."""
    if isinstance(cloth, Cloths):
        return np.concatenate([_flipped(each) for each in cloth.cloths])
    row, column = cloth.topology.place.T
    return cloth.weave.draft[row, column]
