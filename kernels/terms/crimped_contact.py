"""Eq. 3 with both forces at the crimped positions, which feel a yarn's tension: ``Scene(contact_force="crimped")``.

    F_n = ReLU( ½ n·(Fₛᵘ + F_bᵘ − Fₛᵛ − F_bᵛ) ),   crimped: x − ½h n on a warp yarn, x + ½h n on a weft yarn

h is the height of the yarn's crimp as woven (``description/crimp.py``). Fₛ is the tension that stretch gives a
segment, along the crimped segment: how much longer that is than the straight one is no strain, for the yarn was woven
with it. On a flat cloth it presses with 2 T sin θ, tan θ = h/p.

It takes the place of what stretch and bending add to ``contact_load``.
"""

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.variant import Variant
from . import bending, stretch


def define(variant: Variant) -> wp.Kernel:
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
    def crimped_contact_load(
        # topology
        bend_nodes: wp.array(dtype=wp.vec3i),
        bend_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        # parameters
        stretch: wp.array(dtype=scalar),
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        lengthening: wp.array(dtype=scalar),
        contact_offset: wp.array(dtype=scalar),
        stretches: int,
        bends: int,
        # state in
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        normal: wp.array(dtype=vec3),
        # load out
        contact_load: wp.array(dtype=scalar),
    ):
        """Add the loads of a bend: of the stretch of its two segments on the crossing between, every crossing being
        between two of each of its yarns."""
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
        crimped1 = e1 + (normal[b] - normal[c]) * offset
        crimped2 = e2 + (normal[a] - normal[c]) * offset
        before = euler[2 * c + direction] - euler[2 * a + direction]
        after = euler[2 * b + direction] - euler[2 * c + direction]
        half_width = radius[own(2 * yarn)]
        half_thickness = radius[own(2 * yarn + 1)]
        if stretches != 0:
            k = stretch_stiffness(stretch[yarn], half_width, half_thickness) * half
            pressing = tension_along(e1, crimped1, after, k, lengthening[yarn])
            pressing += tension_along(e2, crimped2, before, k, lengthening[yarn])
            wp.atomic_add(contact_load, c, wp.dot(normal[c], pressing))
        if bends != 0:
            k_b = scalar(2.0) * bend_stiffness(bend[yarn], half_width, half_thickness) / (before + after) * half
            unit1 = spacing[own(2 * c + direction)]
            unit2 = spacing[own(2 * a + direction)]
            pressing_b, pressing_a = bend_forces(crimped1, crimped2, k_b, unit1, unit2)
            wp.atomic_add(contact_load, a, wp.dot(normal[a], pressing_a))
            wp.atomic_add(contact_load, b, wp.dot(normal[b], pressing_b))
            wp.atomic_add(contact_load, c, -wp.dot(normal[c], pressing_a + pressing_b))

    return crimped_contact_load
