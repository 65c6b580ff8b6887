"""Collision of parallel yarns: neighbouring crossings of a yarn keep a distance in (u, v) (paper 3.3).

    V = ½ k_c L ReLU(d − Δs)²,   d = 4R between crossings flipped against each other, else 2R

Parameters: ``parallel_stiffness`` k_c [N/m]; ``spacing`` L [m]; ``radius`` R [m].
"""

import warp as wp

from .variant import Term, Variant


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3

    @variant.kernel("terms")
    def parallel_term(
        # topology
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        flipped: wp.array(dtype=int),
        # parameters
        parallel_stiffness: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        # state in
        euler: wp.array(dtype=scalar),
        # forces out
        euler_force: wp.array(dtype=scalar),
        # matrix out
        matrix: int,
        weights: wp.array(dtype=vec3),
        diagonal_ss: wp.array(dtype=scalar),
        upper_ss: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        a = segment_nodes[e][0]
        b = segment_nodes[e][1]
        direction = yarn_direction[segment_yarn[e]]
        sa = 2 * a + direction
        sb = 2 * b + direction
        distance = scalar(2.0) * radius[0]
        if flipped[a] != flipped[b]:
            distance = scalar(4.0) * radius[0]
        overlap = distance - (euler[sb] - euler[sa])
        if overlap > scalar(0.0):
            k = parallel_stiffness[0] * spacing[0]
            wp.atomic_add(euler_force, sa, -k * overlap)
            wp.atomic_add(euler_force, sb, k * overlap)
            if matrix != 0:
                ss = weights[0][2] * k
                wp.atomic_add(diagonal_ss, sa, ss)
                wp.atomic_add(diagonal_ss, sb, ss)
                wp.atomic_add(upper_ss, 4 * a + direction, -ss)

    return parallel_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar

    @variant.kernel("energy")
    def parallel_energy(
        segment_nodes: wp.array(dtype=wp.vec2i),
        segment_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        flipped: wp.array(dtype=int),
        parallel_stiffness: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        a = segment_nodes[e][0]
        b = segment_nodes[e][1]
        direction = yarn_direction[segment_yarn[e]]
        distance = scalar(2.0) * radius[0]
        if flipped[a] != flipped[b]:
            distance = scalar(4.0) * radius[0]
        overlap = wp.max(distance - (euler[2 * b + direction] - euler[2 * a + direction]), scalar(0.0))
        wp.atomic_add(energy, 0, scalar(0.5) * parallel_stiffness[0] * spacing[0] * overlap * overlap)

    return parallel_energy


TERM = Term(name="parallel", elements="segments", define=define, energy=define_energy, stencil=2, sliding_only=True)
