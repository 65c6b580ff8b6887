"""Eq. 3 with both forces at the crimped positions, which feel a yarn's tension: ``Scene(contact_force="crimped")``.

    F_n = ReLU( ½ n·(Fₛᵘ + F_bᵘ − Fₛᵛ − F_bᵛ) ),   crimped: x − ½h n on a warp yarn, x + ½h n on a weft yarn

h is the height of the yarn's crimp as woven (``description/crimp.py``). Fₛ is the tension that stretch gives a
segment, along the crimped segment: how much longer that is than the straight one is no strain, for the yarn was woven
with it. On a flat cloth it presses with 2 T sin θ, tan θ = h/p.

It takes the place of what stretch and bending add to ``contact_load``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.variant import Variant
from . import bending, stretch


@functools.cache
def define(variant: Variant) -> SimpleNamespace:
    """Define the kernels of both forces, which add the load of every bend."""
    scalar, vec3 = variant.scalar, variant.vec3
    stretch_stiffness = stretch.functions(variant).stiffness
    own = general.functions(variant).own
    bend_stiffness, bend_forces = bending.functions(variant).stiffness, bending.functions(variant).forces

    @wp.func
    def tension_along(d: vec3, crimped: vec3, rest: scalar, stiffness: scalar, lengthening: scalar) -> vec3:
        """Compute the force of a segment d on the node that it starts at, along the crimped one."""
        strain = wp.length(d) * lengthening / rest - scalar(1.0)
        return wp.normalize(crimped) * (stiffness * strain * lengthening)

    @variant.kernel("crimp")
    def crimped_stretch_load(
        # topology
        bend_nodes: wp.array(dtype=wp.vec3i),
        bend_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        # parameters
        stretch: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        lengthening: wp.array(dtype=scalar),
        contact_offset: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        normal: wp.array(dtype=vec3),
        # load out
        contact_load: wp.array(dtype=scalar),
    ):
        """Add the load of two segments on the crossing between: every crossing is between two of each of its yarns."""
        e = index(wp.tid())
        a = index(bend_nodes[e][0])
        c = index(bend_nodes[e][1])
        b = index(bend_nodes[e][2])
        yarn = index(bend_yarn[e])
        direction = index(yarn_direction[yarn])
        half = scalar(0.5) - scalar(direction)
        offset = scalar(-2.0) * half * contact_offset[yarn]
        e1 = position[b] - position[c]
        e2 = position[a] - position[c]
        rest1 = euler[2 * b + direction] - euler[2 * c + direction]
        rest2 = euler[2 * c + direction] - euler[2 * a + direction]
        k = stretch_stiffness(stretch[yarn], radius[own(2 * yarn)], radius[own(2 * yarn + 1)]) * half
        pressing = tension_along(e1, e1 + (normal[b] - normal[c]) * offset, rest1, k, lengthening[yarn])
        pressing += tension_along(e2, e2 + (normal[a] - normal[c]) * offset, rest2, k, lengthening[yarn])
        wp.atomic_add(contact_load, c, wp.dot(normal[c], pressing))

    @variant.kernel("crimp")
    def crimped_bending_load(
        # topology
        bend_nodes: wp.array(dtype=wp.vec3i),
        bend_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        # parameters
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        contact_offset: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        normal: wp.array(dtype=vec3),
        # load out
        contact_load: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        a = index(bend_nodes[e][0])
        c = index(bend_nodes[e][1])
        b = index(bend_nodes[e][2])
        yarn = index(bend_yarn[e])
        direction = index(yarn_direction[yarn])
        half = scalar(0.5) - scalar(direction)
        offset = scalar(-2.0) * half * contact_offset[yarn]
        e1 = position[b] - position[c] + (normal[b] - normal[c]) * offset
        e2 = position[a] - position[c] + (normal[a] - normal[c]) * offset
        rest = euler[2 * b + direction] - euler[2 * a + direction]
        k_b = bend_stiffness(bend[yarn], radius[own(2 * yarn)], radius[own(2 * yarn + 1)])
        unit1 = spacing[own(2 * c + direction)]
        unit2 = spacing[own(2 * a + direction)]
        pressing_b, pressing_a = bend_forces(e1, e2, scalar(2.0) * k_b / rest * half, unit1, unit2)
        wp.atomic_add(contact_load, a, wp.dot(normal[a], pressing_a))
        wp.atomic_add(contact_load, b, wp.dot(normal[b], pressing_b))
        wp.atomic_add(contact_load, c, -wp.dot(normal[c], pressing_a + pressing_b))

    return SimpleNamespace(crimped_stretch_load=crimped_stretch_load, crimped_bending_load=crimped_bending_load)
