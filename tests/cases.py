"""Small cloths, scenes and states, and how a kernel is compared with the oracle on them."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import zlib
from collections.abc import Iterable

import numpy as np
import pytest
from reference import Oracle, Tensor, tensor

import warp_yarn as wy

YARNS = (
    wy.Yarn(density=2.0e-3, stretch=5.0e5, bend=1.4e-4),
    wy.Yarn(density=2.5e-3, stretch=1.7e5, bend=1.1e-4),
    wy.Yarn(density=2.4e-3, stretch=1.2e5, bend=0.9e-4),
)
GRAVITY = (0.4, -0.7, -9.8)
WIND = wy.Wind(velocity=(1.0, 5.0, -0.5))

GENERAL = {
    "yarns": (
        dataclasses.replace(YARNS[0], width=8.6e-4, thickness=3.4e-4),
        dataclasses.replace(YARNS[1], radius=2.7e-4),
        YARNS[2],
    ),
    "radius": 3.2e-4,
    "spacing": ([0.9e-3, 0.82e-3, 1.26e-3, 0.75e-3], [1.1e-3, 0.72e-3, 0.97e-3, 1.4e-3, 1.03e-3]),
    "crimp": ([0.02, 0.0, 0.05, 0.01, 0.03], 0.04),
    "shear": [[700.0, 400.0, 900.0], [500.0, 1200.0, 300.0], [800.0, 600.0, 1000.0]],
    "friction": np.linspace(0.3, 0.6, 30),
    "friction_stiffness": [[1000.0, 800.0, 1200.0], [900.0, 1100.0, 700.0], [600.0, 1300.0, 500.0]],
    "friction_damping": np.linspace(0.08, 0.12, 30),
    "pose": "flat",
}
"""Of a cloth with a number of its own wherever it may have one."""
CLOTHS = ("plain", "twill", "satin", "general")
STATES = ("rest", "random", "stretched", "slack", "folded")
BENT = ("random", "slack", "folded")
"""States in which no yarn is straight."""


@functools.cache
def cloth(name: str) -> wy.Cloth:
    """One of the weaves, each with its own size, materials, spacing, radius and pose.

    Twice the radius differs from the spacing: parallel yarns that only just touch at rest would stand at the kink.
    """
    options = {
        "plain": dict(yarns=YARNS[:2], radius=4.8e-4, pose="flat"),
        "twill": dict(yarns=YARNS[1:], radius=4.5e-4, shear=200.0),
        "satin": dict(yarns=YARNS[::2], spacing=1.1e-3, shear=700.0, friction=0.3, parallel_stiffness=2.0),
        "general": dict(GENERAL),
    }[name]
    rows, columns = {"plain": (5, 5), "twill": (6, 6), "satin": (4, 7), "general": (5, 6)}[name]
    weave = wy.WEAVES["plain" if name == "general" else name](rows=rows, columns=columns)
    # A damping whose force is of the size of friction's spring; the paper's would hide it.
    return wy.Cloth(weave, **{"friction_damping": 0.1, **options})


@functools.cache
def scene(name: str, terms: tuple[str, ...] | None, sliding: bool = True, published_scaling: bool = False) -> wy.Scene:
    """With all that terms may need; terms=None: all of them."""
    c = cloth(name)
    forces = {3: (1.0e-4, -2.0e-4, 3.0e-4), 9: (-5.0e-5, 0.0, 1.0e-4)}
    return wy.Scene(
        c,
        gravity=GRAVITY,
        wind=WIND,
        pins=c.corners("top"),
        forces=forces,
        terms=terms,
        sliding=sliding,
        published_scaling=published_scaling,
        # a stencil wider than the others': in scenes that name the term alone
        seams=[[0, c.nodes - 1], [7, 3], [3, 11]] if terms and "seams" in terms else (),
        seam_stiffness=2e3,
    )


@functools.cache
def simulator(
    name: str, terms: tuple[str, ...] | None, sliding: bool = True, published_scaling: bool = False
) -> wy.Simulator:
    return wy.Simulator(scene(name, terms, sliding, published_scaling), integrator="linear")


@functools.cache
def oracle(name: str, terms: tuple[str, ...] | None, sliding: bool = True, published_scaling: bool = False) -> Oracle:
    return Oracle(scene(name, terms, sliding, published_scaling))


# -- states ----------------------------------------------------------------------------------------------------------


def _lines(rng: np.random.Generator, at_rest: np.ndarray, name: str) -> np.ndarray:
    """Where the straight lines of crossings stand."""
    count = len(at_rest) - 1
    steps = {"stretched": rng.uniform(1.1, 1.5, count), "slack": np.full(count, 0.7)}
    if name not in steps:
        return at_rest
    return np.concatenate([[0.0], np.cumsum(steps[name] * np.diff(at_rest))])


def make_state(c: wy.Cloth, name: str, sliding: bool = True) -> wy.State:
    """A state of a cloth.

    rest        as woven: every yarn straight, nothing moves
    random      every node 0.15 L from rest, crossings 0.08 L along both yarns
    stretched   every yarn straight, by 10 to 50 %, unevenly
    slack       every segment of 0.7 of its length, on a grid 0.04 L rough
    folded      the yarn of row 1 turns back at column 2, to more than 170 degrees
    flat        the yarn of row 1 turns back exactly onto itself, in a cloth otherwise at rest
    collapsed   random, with two neighbours of a node within 0.05 L of it
    squeezed    random, with neighbouring crossings, and a crossing and the end of its yarn, within 0.1 R along the yarn
    """
    rng = np.random.default_rng(zlib.crc32(f"{c.weave.name} {name}".encode()))
    rows, columns, length = c.weave.rows, c.weave.columns, c.shortest_spacing
    rest = c.position.reshape(rows, columns, 3)
    u, v = c.rest_grid.reshape(rows, columns, 2)[0, :, 0], c.rest_grid.reshape(rows, columns, 2)[:, 0, 1]
    along, across = (rest[0, 1] - rest[0, 0]) / u[1], (rest[1, 0] - rest[0, 0]) / v[1]
    x = rest[0, 0] + _lines(rng, u, name)[None, :, None] * along + _lines(rng, v, name)[:, None, None] * across
    jitter = {"slack": 0.04, "folded": 0.04, "rest": 0.0, "stretched": 0.0, "flat": 0.0}.get(name, 0.15)
    x = x + rng.uniform(-jitter, jitter, x.shape) * length
    if name in ("folded", "flat"):
        turned = x[1, 3:] - x[1, 2]
        x[1, 3:] -= 2.0 * (turned @ along)[:, None] * along
        if name == "folded":
            x[1, 3:] += 0.06 * length * np.cross(along, across)
    if name == "collapsed":
        x[1, 2] = x[1, 1] + np.array([0.03, -0.02, 0.01]) * length
        x[2, 1] = x[1, 1] + np.array([0.01, 0.04, 0.02]) * length
    inside = (c.topology.is_crossing != 0)[:, None] * float(sliding)
    moving = name not in ("rest", "flat")
    euler = c.euler + rng.uniform(-0.08, 0.08, (c.nodes, 2)) * length * inside * moving
    if name == "squeezed":
        half = c.halves[:, 0].min()
        euler[c.node(1, 2), 0] = euler[c.node(1, 1), 0] + 0.1 * half
        euler[c.node(2, -2), 0] = euler[c.node(2, -1), 0] - 0.02 * half
        euler[c.node(1, 1), 1] = 0.05 * half
    velocity = rng.normal(0.0, 0.5, (c.nodes, 3)) * moving
    euler_velocity = rng.normal(0.0, 0.2, (c.nodes, 2)) * inside * moving
    anchor = euler + rng.uniform(-5e-5, 5e-5, (c.nodes, 2)) * inside * moving
    return wy.State(x.reshape(-1, 3), euler, velocity, euler_velocity, anchor)


# -- a cloth in a state ----------------------------------------------------------------------------------------------


def joined(x: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Of every node's position and then every node's (u, v), in one vector."""
    return np.concatenate([np.ravel(x), np.ravel(s)])


@dataclasses.dataclass(frozen=True)
class Case:
    """A cloth in a state, with or without sliding."""

    cloth_name: str
    state_name: str
    sliding: bool
    published_scaling: bool = False

    def __str__(self) -> str:
        scaling = "-published" if self.published_scaling else ""
        return f"{self.cloth_name}-{self.state_name}-{'sliding' if self.sliding else 'locked'}{scaling}"

    @property
    def cloth(self) -> wy.Cloth:
        return cloth(self.cloth_name)

    @functools.cached_property
    def state(self) -> wy.State:
        return make_state(self.cloth, self.state_name, self.sliding)

    def simulator(self, *terms: str) -> wy.Simulator:
        return simulator(self.cloth_name, terms or None, self.sliding, self.published_scaling)

    def oracle(self, *terms: str) -> Oracle:
        return oracle(self.cloth_name, terms or None, self.sliding, self.published_scaling)

    @functools.cached_property
    def q(self) -> Tensor:
        return tensor(joined(self.state.position, self.state.euler))

    @functools.cached_property
    def v(self) -> Tensor:
        return tensor(joined(self.state.velocity, self.state.euler_velocity))

    @functools.cached_property
    def anchor(self) -> Tensor:
        return tensor(self.state.anchor.ravel())

    @property
    def unknowns(self) -> int:
        """As many as the system has: the positions, and with sliding (u, v) of every node."""
        return self.cloth.nodes * (5 if self.sliding else 3)

    def moved(self, direction: np.ndarray, h: float) -> wy.State:
        """The state at (q, q̇, anchor) + h · direction."""
        n, s = self.cloth.nodes, self.state
        parts = np.split(h * direction, np.cumsum([3 * n, 2 * n, 3 * n, 2 * n]))
        return wy.State(
            s.position + parts[0].reshape(n, 3),
            s.euler + parts[1].reshape(n, 2),
            s.velocity + parts[2].reshape(n, 3),
            s.euler_velocity + parts[3].reshape(n, 2),
            s.anchor + parts[4].reshape(n, 2),
        )

    def directions(self, count: int, parts: str = "xs") -> np.ndarray:
        """Random displacements of the state [count, 12 nodes] of the parts named: x, s, their rates v and w, anchor a.

        (u, v) of the border stays, as do its rates.
        """
        rng = np.random.default_rng(7)
        n = self.cloth.nodes
        slides = np.repeat(self.cloth.topology.is_crossing * float(self.sliding), 2)
        scale = {"x": np.ones(3 * n), "s": slides, "v": np.ones(3 * n), "w": slides, "a": slides}
        scale = np.concatenate([scale[part] * (part in parts) for part in "xsvwa"])
        return rng.choice([-1.0, 1.0], (count, 12 * n)) * rng.uniform(0.5, 1.0, (count, 12 * n)) * scale


def cases(
    names: tuple[str, ...] = CLOTHS, states: tuple[str, ...] = STATES, sliding: tuple[bool, ...] = (True, False)
) -> tuple[Case, ...]:
    return tuple(Case(*case) for case in itertools.product(names, states, sliding))


def quick(names: Iterable[object], *first: object) -> list[object]:
    """Parameters of a test of which those that are named here are quick, and the others, one more of a kind, slow."""
    return [name if name in first else pytest.param(name, marks=pytest.mark.slow) for name in names]
