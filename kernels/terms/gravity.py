"""Gravity on a yarn segment.

    V = −ρ Δs g·(x_a + x_b)/2

Parameters: ``density`` ρ of each yarn [kg/m]; ``gravity`` g [m/s²].

V is bilinear in (x, s), so its second derivative has no positive semi-definite part worth keeping: the matrix has
nothing of it.
"""

import warp as wp

from ..core.indexing import index
from ..core.variant import Term, TermParameter, Variant


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding

    @variant.kernel("terms")
    def gravity_term(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        density: wp.array(dtype=scalar),
        gravity: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        a = index(segment_nodes[e][0])
        b = index(segment_nodes[e][1])
        yarn = index(segment_yarn[e])
        direction = index(yarn_direction[yarn])
        sa = 2 * a + direction
        sb = 2 * b + direction
        half_density = scalar(0.5) * density[yarn]
        f = gravity[0] * (half_density * (euler[sb] - euler[sa]))
        wp.atomic_add(force, a, f)
        wp.atomic_add(force, b, f)
        if wp.static(sliding):
            f_s = half_density * wp.dot(gravity[0], position[a] + position[b])
            wp.atomic_add(euler_force, sa, -f_s)
            wp.atomic_add(euler_force, sb, f_s)

    return gravity_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("energy")
    def gravity_energy(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        density: wp.array(dtype=scalar),
        gravity: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = index(wp.tid())
        a = index(segment_nodes[e][0])
        b = index(segment_nodes[e][1])
        yarn = index(segment_yarn[e])
        direction = index(yarn_direction[yarn])
        rest = euler[2 * b + direction] - euler[2 * a + direction]
        height = wp.dot(gravity[0], position[a] + position[b])
        wp.atomic_add(energy, 0, scalar(-0.5) * density[yarn] * rest * height)

    return gravity_energy


TERM = Term(
    name="gravity",
    elements="segments",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("gravity", "m/s²", size=3),),
    absent=lambda scene: "gravity is None" if scene.gravity is None else "",
    energy_watched_as="height_energy",
)
