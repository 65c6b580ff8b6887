"""States in which methods fail, with the scenes that they are of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

import warp_yarn as wy
from warp_yarn.presets import paper

STEPS = 10
OVERSHOOT = 0.06
"""How far the energy may rise, relative to the start's without gravity: the second-order default is L-stable, but its
second stage goes on from an extrapolated first, which may gain from what a step does not resolve. Seen in forty starts
of each state: 0.17 within ``inside_out`` (0.08 with a Newton tolerance of 1e-8), 0.19 in one start of ``swapped``, 0.05
within ``shut`` and ``squeezed``; the others lose from step to step."""


@dataclasses.dataclass
class Hard:
    """A scene and the state that it starts from.

    Args:
        place: changes the positions [rows, columns, 3], after the jitter.
        slide: changes (u, v) [rows, columns, 2] and the rates (u̇, v̇), after a jitter of the crossings' (u, v).
        driven: whether something puts energy in (wind, pins that move).
        speed: of the nodes, each in a random direction [m/s].
        jitter: of every position and of the crossings' (u, v), in spacings.
        anchor: of friction's springs; None: they are not strained.
        options: of the Simulator.
        overshoot: how far the energy may rise.
    """

    scene: wy.Scene
    place: Callable[[np.ndarray], None] = lambda x: None
    slide: Callable[[np.ndarray, np.ndarray], None] = lambda s, rate: None
    driven: bool = False
    speed: float = 0.0
    jitter: float = 1e-3
    anchor: np.ndarray | None = None
    options: dict[str, object] = dataclasses.field(default_factory=dict)
    overshoot: float = OVERSHOOT

    def start(self, seed: int) -> wy.State:
        cloth, rng = self.scene.cloth, np.random.default_rng(seed)
        grid, n, length = cloth.weave.flipped.shape, cloth.nodes, self.jitter * cloth.spacing
        inside = (cloth.topology.is_crossing != 0)[:, None]
        x = cloth.position + length * rng.uniform(-1.0, 1.0, (n, 3))
        s = cloth.euler + length * rng.uniform(-1.0, 1.0, (n, 2)) * inside
        rate = np.zeros((n, 2))
        # views: what is changed in them is changed in x, s and rate
        self.place(x.reshape(*grid, 3))
        self.slide(s.reshape(*grid, 2), rate.reshape(*grid, 2))
        return wy.State(x, s, rng.normal(0.0, 1.0, (n, 3)) * self.speed, rate, self.anchor)


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
    """All cells sheared to 3 degrees."""

    def place(x: np.ndarray) -> None:
        x[..., 0] += 1e-3 * np.arange(5)[:, None]
        x[..., 2] *= 0.05

    return Hard(hung(), place=place)


def inside_out() -> Hard:
    """Two rows have changed places."""

    def place(x: np.ndarray) -> None:
        x[[2, 3]] = x[[3, 2]]

    return Hard(hung(), place=place, overshoot=0.2)


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
    # pins go there within the step, and bring the energy in
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
    return wy.Simulator(hard.scene, **hard.options)
