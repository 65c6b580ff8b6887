"""Crimped cloths, in states from as woven to pushed together, for tests of what crimp does."""

import dataclasses
import functools
import itertools
import zlib

import numpy as np
from cases import YARNS, Case
from reference import Oracle

import warp_yarn as wy

CRIMP = (0.05, 0.09)


@functools.cache
def cloth(name: str) -> wy.Cloth:
    """A weave whose diameters are 7 % more than goes with its crimps, so that it is not at rest as woven."""
    rows, columns = {"plain": (5, 5), "twill": (6, 6), "satin": (4, 7)}[name]
    spacing = 1e-3
    diameter = 0.5 * sum(wy.crimp_height(spacing, spacing * (1.0 + c)) for c in CRIMP)
    yarns = [YARNS[:2], YARNS[1:], YARNS[::2]][len(name) % 3]
    return wy.Cloth(
        wy.WEAVES[name](rows=rows, columns=columns),
        yarns=yarns,
        spacing=spacing,
        radius=0.5 * 1.07 * diameter,
        crimp=CRIMP,
        pose="flat",
        friction_damping=0.1,
    )


@functools.cache
def scene(name: str, terms: tuple[str, ...] | None, sliding: bool, interchange: bool = True) -> wy.Scene:
    """With crimp interchange, or with the contact force at crimped positions."""
    c = cloth(name)
    option = {"crimp_interchange": True} if interchange else {"contact_force": "crimped"}
    return wy.Scene(c, pins=c.corners("top"), terms=terms, sliding=sliding, **option)


@functools.cache
def simulator(name: str, terms: tuple[str, ...] | None, sliding: bool, interchange: bool = True) -> wy.Simulator:
    return wy.Simulator(scene(name, terms, sliding, interchange), integrator="linear")


@functools.cache
def oracle(name: str, terms: tuple[str, ...] | None, sliding: bool, interchange: bool = True) -> Oracle:
    return Oracle(scene(name, terms, sliding, interchange))


SIZES = {"rest": (1.0, 0.01), "taut": (1.25, 0.03), "knee": (1.06, 0.04), "pushed": (0.85, 0.04), "random": (1.0, 0.3)}
"""Of states: how much larger the cloth is, and how far nodes are from there in spacings."""


@dataclasses.dataclass(frozen=True)
class CrimpCase(Case):
    """A crimped cloth in a state."""

    interchange: bool = True

    @property
    def cloth(self) -> wy.Cloth:
        return cloth(self.cloth_name)

    def simulator(self, *terms: str) -> wy.Simulator:
        return simulator(self.cloth_name, terms or None, self.sliding, self.interchange)

    def oracle(self, *terms: str) -> Oracle:
        return oracle(self.cloth_name, terms or None, self.sliding, self.interchange)

    @functools.cached_property
    def state(self) -> wy.State:
        c, (size, jitter) = self.cloth, SIZES[self.state_name]
        rng = np.random.default_rng(zlib.crc32(str(self).encode()))
        x = size * c.position + rng.uniform(-jitter, jitter, (c.nodes, 3)) * c.spacing
        inside = (c.topology.is_crossing != 0)[:, None] * self.sliding
        euler = c.euler + rng.uniform(-jitter, jitter, (c.nodes, 2)) * 0.3 * c.spacing * inside
        anchor = euler + rng.uniform(-5e-5, 5e-5, (c.nodes, 2)) * inside
        velocity = rng.normal(0.0, 0.5, (c.nodes, 3))
        return wy.State(x, euler, velocity, rng.normal(0.0, 0.2, (c.nodes, 2)) * inside, anchor)


def cases(
    states: tuple[str, ...] = tuple(SIZES), sliding: tuple[bool, ...] = (True, False), interchange: bool = True
) -> tuple[CrimpCase, ...]:
    """Floats, in twill and satin, are straight: some states of these will do."""
    every = itertools.product(("plain", "twill", "satin"), states, sliding)
    some = [case for case in every if case[0] == "plain" or case[1] in ("taut", "random")]
    return tuple(CrimpCase(*case, interchange=interchange) for case in some)
