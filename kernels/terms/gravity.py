"""Gravity on a yarn segment.

    V = −ρ Δs g·(x_a + x_b)/2

Parameters: ``density`` ρ of each yarn [kg/m]; ``gravity`` g [m/s²].

V is bilinear in (x, s), so its second derivative has no positive semi-definite part worth keeping: the matrix has
nothing of it.
"""

import warp as wp

from ..core.indexing import ends, index
from ..core.variant import Term, TermParameter, Variant


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding

    @variant.kernel("terms")
    def gravity_term(
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        gravity: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
    ):
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
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
        segments: wp.array(dtype=wp.vec4i),
        density: wp.array(dtype=scalar),
        gravity: wp.array(dtype=vec3),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
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
