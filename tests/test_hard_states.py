"""States in which methods fail, each from ten random starts in a row, with the default settings of the simulator."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
import torch

import warp_yarn as wy
import warp_yarn.torch as wt
from warp_yarn import paper

SETTINGS = {"integrator": "sdirk2"}
"""None: the defaults of the simulator."""
RUNS = 10
STEPS = 10
JITTER = 1e-3
"""Of every position, in spacings."""


@dataclasses.dataclass
class Hard:
    """A scene and the state that it starts from.

    Args:
        place: changes the positions [rows, columns, 3], after the jitter.
        slide: changes (u, v) [rows, columns, 2] and the rates (u̇, v̇), after a jitter of the crossings' (u, v).
        driven: whether something puts energy in (wind, pins that move).
        options: of the Simulator.
    """

    scene: wy.Scene
    place: Callable[[np.ndarray], None] = lambda x: None
    slide: Callable[[np.ndarray, np.ndarray], None] = lambda s, rate: None
    driven: bool = False
    speed: float = 0.0
    """Of the nodes, each in a random direction [m/s]."""
    jitter: float = JITTER
    anchor: np.ndarray | None = None
    options: dict[str, object] = dataclasses.field(default_factory=dict)

    def start(self, seed: int) -> wy.State:
        cloth, rng = self.scene.cloth, np.random.default_rng(seed)
        shape = cloth.weave.flipped.shape
        length = cloth.spacing
        inside = (cloth.topology.is_crossing != 0)[:, None]
        x = (cloth.position + rng.uniform(-1.0, 1.0, (cloth.nodes, 3)) * self.jitter * length).reshape(*shape, 3)
        s = (cloth.euler + rng.uniform(-1.0, 1.0, (cloth.nodes, 2)) * self.jitter * length * inside).reshape(*shape, 2)
        rate = np.zeros_like(s)
        self.place(x)
        self.slide(s, rate)
        velocity = rng.normal(0.0, 1.0, (cloth.nodes, 3)) * self.speed
        s = s.reshape(-1, 2)
        return wy.State(x.reshape(-1, 3), s, velocity, rate.reshape(-1, 2), self.anchor)


def fabric(rows: int = 5, columns: int = 5, weave: str = "plain", **options: object) -> wy.Cloth:
    yarns = options.pop("yarns", [paper.YARNS[1], paper.YARNS[2]])
    return wy.Cloth(wy.WEAVES[weave](rows=rows, columns=columns), yarns=yarns, **options)


def hung(**options: object) -> wy.Scene:
    return wy.Scene(cloth := fabric(**options), pins=cloth.corners("top"))


# -- the states ------------------------------------------------------------------------------------------------------


def squeezed() -> Hard:
    """Δs of 0.01 R, between crossings and from a crossing to the end of its yarn."""
    scene = hung()
    near = 0.01 * scene.cloth.radius

    def slide(s: np.ndarray, rate: np.ndarray) -> None:
        s[2, 2, 0] = s[2, 1, 0] + near
        s[3, 3, 1] = s[4, 3, 1] - near

    return Hard(scene, slide=slide)


def swapped() -> Hard:
    """Two crossings of a yarn that hardly resists sliding fly at each other, and stand on the wrong sides."""
    scene = hung(friction_damping=1e-3, friction=0.0)

    def place(x: np.ndarray) -> None:
        x[2, [1, 2]] = x[2, [2, 1]]

    def slide(s: np.ndarray, rate: np.ndarray) -> None:
        rate[2, 1, 0], rate[2, 2, 0] = 2.0, -2.0

    return Hard(scene, place=place, slide=slide)


def collapsed() -> Hard:
    """Segments of no length."""

    def place(x: np.ndarray) -> None:
        x[2, 2] = x[2, 1]
        x[3, 3] = x[4, 3]

    return Hard(hung(), place=place)


def straight() -> Hard:
    """Every yarn perfectly straight, and not quite at its length."""

    def place(x: np.ndarray) -> None:
        x *= 0.98

    return Hard(hung(), place=place, jitter=0.0, speed=1e-3)


def folded() -> Hard:
    """Warp yarns that turn back onto themselves."""

    def place(x: np.ndarray) -> None:
        x[:, 3] = x[:, 1]
        x[:, 4] = x[:, 0]

    return Hard(hung(), place=place)


def shut() -> Hard:
    """A weft neighbour in the direction of a warp neighbour: corners of 0 and of π."""

    def place(x: np.ndarray) -> None:
        x[1, 2] = x[2, 2] + 0.7 * (x[2, 3] - x[2, 2])

    return Hard(hung(), place=place)


def sheared() -> Hard:
    """All cells sheared flat, to a line."""

    def place(x: np.ndarray) -> None:
        x[..., 0] += x[0, 1, 0] * np.arange(5)[:, None]
        x[..., 2] = x[0, 0, 2]

    return Hard(hung(), place=place)


def inside_out() -> Hard:
    """Two rows have changed places."""

    def place(x: np.ndarray) -> None:
        x[[2, 3]] = x[[3, 2]]

    return Hard(hung(), place=place)


def strip() -> Hard:
    """One row of crossings."""
    return Hard(hung(rows=3, columns=6), speed=0.1)


def no_pins() -> Hard:
    return Hard(wy.Scene(fabric(weave="twill")), speed=0.5)


def all_pinned() -> Hard:
    cloth = fabric()
    return Hard(wy.Scene(cloth, pins=range(cloth.nodes)))


def all_held() -> Hard:
    """By exact pins."""
    cloth = fabric()
    return Hard(wy.Scene(cloth, pins=range(cloth.nodes), pin_stiffness=None))


def _jump(stiffness: float | None) -> Hard:
    cloth = fabric()
    pins = cloth.corners("top")
    far = cloth.position[pins] + [0.5 * 4 * cloth.spacing, 0.0, 0.0]
    return Hard(wy.Scene(cloth, pins=pins, pin_path=[far], pin_stiffness=stiffness), driven=True)


def jump() -> Hard:
    """Pins that jump by half the cloth in one step."""
    return _jump(1e4)


def held_jump() -> Hard:
    """The same with exact pins."""
    return _jump(None)


def storm() -> Hard:
    """A wind of 50 m/s, at once."""
    cloth = fabric()
    return Hard(wy.Scene(cloth, pins=cloth.corners("top"), wind=wy.Wind(velocity=(0.0, 50.0, 0.0))), driven=True)


def slipping() -> Hard:
    """A taut saddle, its friction's limit what pushes a crossing along, and every spring strained to it."""

    def place(x: np.ndarray) -> None:
        x[:, [0, -1], 1] += 3e-4
        x[[0, -1], :, 1] -= 3e-4
        x *= 1.1

    def slide(s: np.ndarray, rate: np.ndarray) -> None:
        s[2, 2] += 5e-5

    def at(friction: float) -> Hard:
        cloth = fabric(friction=friction)
        border = np.flatnonzero(cloth.topology.is_crossing == 0)
        pose = cloth.position.reshape(5, 5, 3).copy()
        place(pose)
        cloth = fabric(friction=friction, pose=pose.reshape(-1, 3))
        return Hard(wy.Scene(cloth, pins=border), slide=slide)

    first = at(0.5)
    sim, state = simulator(first), first.start(0)
    load = sim.contact(state)[1]
    push = sum(s for name, (_, s) in sim.forces(state).items() if name != "friction")
    node = first.scene.cloth.node(2, 2)
    hard = at(float(np.abs(push[node, 0]) / load[node]))
    cloth = hard.scene.cloth
    hard.anchor = state.euler - (cloth.friction * load / cloth.friction_stiffness)[:, None]
    return hard


def heavy() -> Hard:
    """Yarns of a thousand times the others' density."""
    light = paper.YARNS[1]
    return Hard(hung(yarns=[light, dataclasses.replace(light, density=1e3 * light.density)]), speed=0.1)


def far_away() -> Hard:
    """A kilometre from the origin, in single precision."""
    cloth = fabric()
    cloth = fabric(pose=cloth.position + 1000.0)
    return Hard(wy.Scene(cloth, pins=cloth.corners("top")), jitter=0.05, options={"precision": "single"})


def buckling() -> Hard:
    """Pushed together from both ends, by a third within ten steps."""
    cloth = fabric()
    ends = [cloth.node(j, i) for i in (0, 4) for j in range(5)]
    x = cloth.position[ends]
    middle = x.mean(axis=0)
    path = [x + (middle - x) * [0.33 * k / STEPS, 0.0, 0.0] for k in range(1, STEPS + 1)]
    return Hard(wy.Scene(cloth, pins=ends, pin_path=path), driven=True, jitter=0.02)


STATES = {
    f.__name__: f
    for f in (
        squeezed, swapped, collapsed, straight, folded, shut, sheared, inside_out, strip, no_pins, all_pinned, all_held,
        jump, held_jump, storm, slipping, heavy, far_away, buckling,
    )
}  # fmt: skip


def simulator(hard: Hard) -> wy.Simulator:
    return wy.Simulator(hard.scene, **SETTINGS, **hard.options)


def rests(trajectory: wy.Trajectory) -> np.ndarray:
    """Δs of every segment in every frame."""
    topology = trajectory.cloth.topology
    direction = topology.yarn_direction[topology.segment_yarn]
    a, b = topology.segment_nodes.T
    return trajectory.euler[:, b, direction] - trajectory.euler[:, a, direction]
