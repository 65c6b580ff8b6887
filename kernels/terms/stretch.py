"""Stretch of a yarn segment.

    V = ½ kₛ Δs (|w| − 1)²,   kₛ = Y π R²,   w = (x_b − x_a)/Δs

Parameters: ``stretch`` Y, stretch modulus of each yarn [Pa] (the paper prints N/m); ``radius`` R [m].

In a general cloth R² is half the width times half the thickness of the yarn. A yarn of crimp c, 1 + c times as long as
the distance that it covers, stretches as that distance does, its crimp held: w is (1 + c)(x_b − x_a)/Δs here.

In (l, Δs), l = |x_b − x_a|, the energy is kₛ (l − Δs)²/(2Δs), jointly convex for Δs > 0. The matrix is its exact
positive semi-definite part: (kₛ/Δs) g gᵀ with g = (−t, |w|; t, −|w|), and the transverse stiffness kₛ(|w|−1)/l,
which is dropped where the yarn is slack (``linear/beside.py`` has it back).
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import ends, index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make the Warp functions of one segment, shared with the contact force."""
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def stretch_stiffness(modulus: scalar, half_width: scalar, half_thickness: scalar) -> scalar:
        """Compute kₛ = Y π R² [N]."""
        return modulus * scalar(wp.static(wp.PI)) * half_width * half_thickness

    @wp.func
    def stretch_force(d: vec3, rest: scalar, stiffness: scalar) -> vec3:
        """Compute the force on the segment's first node, kₛ(|w| − 1) t; the second feels the opposite."""
        return wp.normalize(d) * (stiffness * (wp.length(d) / rest - scalar(1.0)))

    return SimpleNamespace(stiffness=stretch_stiffness, force=stretch_force)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding, of_each = variant.scalar, variant.vec3, variant.sliding, variant.general
    BlockMatrix = structs(variant).BlockMatrix
    stretch_stiffness, stretch_force = functions(variant).stiffness, functions(variant).force
    own, longer = general.functions(variant).own, general.functions(variant).longer

    @variant.kernel("terms")
    def stretch_term(
        # topology
        segments: wp.array(dtype=wp.vec4i),
        # parameters
        stretch: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        normal: wp.array(dtype=vec3),
        # forces out
        force: wp.array(dtype=vec3),
        euler_force: wp.array(dtype=scalar),
        add_contact_load: int,
        contact_load: wp.array(dtype=scalar),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        a, b, sa, sb, yarn, direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        d = position[b] - position[a]
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
            d *= longer(radius, yarn)
        k = stretch_stiffness(stretch[yarn], half_width, half_thickness)

        f = stretch_force(d, rest, k)
        if wp.static(of_each):
            f *= longer(radius, yarn)
        wp.atomic_add(force, a, f)
        wp.atomic_add(force, b, -f)
        if add_contact_load != 0:
            # added for the warp, subtracted for the weft
            half = scalar(0.5) - scalar(direction)
            wp.atomic_add(contact_load, a, half * wp.dot(normal[a], f))
            wp.atomic_add(contact_load, b, -half * wp.dot(normal[b], f))
        ratio = wp.length(d) / rest
        if wp.static(sliding):
            f_s = scalar(0.5) * k * (ratio * ratio - scalar(1.0))
            wp.atomic_add(euler_force, sa, -f_s)
            wp.atomic_add(euler_force, sb, f_s)

        if matrix != 0:
            t = wp.normalize(d)
            along = blocks.coefficients[0][2] * k / rest
            across = along * wp.max(ratio - scalar(1.0), scalar(0.0)) / wp.max(ratio, scalar(1.0e-12))
            xx = wp.outer(t, t) * (along - across) + wp.identity(n=3, dtype=scalar) * across
            if wp.static(of_each):
                xx *= longer(radius, yarn) * longer(radius, yarn)
            wp.atomic_add(blocks.diagonal_xx, a, xx)
            wp.atomic_add(blocks.diagonal_xx, b, xx)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * a + direction), -xx)
            if wp.static(sliding):
                xs = t * (along * ratio)
                if wp.static(of_each):
                    xs *= longer(radius, yarn)
                ss = along * ratio * ratio
                wp.atomic_add(blocks.diagonal_xs, sa, -xs)
                wp.atomic_add(blocks.diagonal_xs, sb, -xs)
                wp.atomic_add(blocks.diagonal_ss, sa, ss)
                wp.atomic_add(blocks.diagonal_ss, sb, ss)
                wp.atomic_add(blocks.upper_xs, 4 * a + direction, xs)
                wp.atomic_add(blocks.upper_sx, 4 * a + direction, xs)
                wp.atomic_add(blocks.upper_ss, 4 * a + direction, -ss)

    return stretch_term


def define_compression(variant: Variant) -> SimpleNamespace:
    """Define what finds the transverse stiffness that the matrix leaves out (``linear/beside.py``)."""
    scalar, vec3, vec4, of_each = variant.scalar, variant.vec3, variant.vec4, variant.general
    stretch_stiffness = functions(variant).stiffness
    own, longer = general.functions(variant).own, general.functions(variant).longer

    @wp.kernel(module=variant.module("stage"), enable_backward=False)
    def find_compression(
        segments: wp.array(dtype=wp.vec4i),
        stretch: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        coefficients: wp.array(dtype=vec3),
        compression: wp.array(dtype=vec4),
        compressed: wp.array(dtype=int),
    ):
        """Find (t, g) of every segment, g = 0 of one that is not compressed, and whether any is."""
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        d = position[b] - position[a]
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        along = coefficients[0][2] / rest
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
            d *= longer(radius, yarn)
            along *= longer(radius, yarn) * longer(radius, yarn)
        along *= stretch_stiffness(stretch[yarn], half_width, half_thickness)
        ratio = wp.length(d) / rest
        g = along * wp.max(scalar(1.0) - ratio, scalar(0.0)) / wp.max(ratio, scalar(1.0e-12))
        t = wp.normalize(d)
        compression[sa] = vec4(t[0], t[1], t[2], g)
        if g > scalar(0.0):
            compressed[0] = 1

    return SimpleNamespace(find_compression=find_compression)


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3, of_each = variant.scalar, variant.vec3, variant.general
    stretch_stiffness = functions(variant).stiffness
    own, longer = general.functions(variant).own, general.functions(variant).longer

    @variant.kernel("energy")
    def stretch_energy(
        segments: wp.array(dtype=wp.vec4i),
        stretch: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        a, b, sa, sb, yarn, _direction = ends(segments, index(wp.tid()))
        rest = euler[sb] - euler[sa]
        length = wp.length(position[b] - position[a])
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
            length *= longer(radius, yarn)
        strain = length / rest - scalar(1.0)
        k = stretch_stiffness(stretch[yarn], half_width, half_thickness)
        wp.atomic_add(energy, 0, scalar(0.5) * k * rest * strain * strain)

    return stretch_energy


TERM = Term(
    name="stretch",
    elements="segments",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("stretch", "Pa", least=0.0, of="yarn"),),
    absent=lambda scene: "crimp_interchange takes its place" if scene.crimp_interchange else "",
    stencil=2,
    presses=True,
    energy_watched_as="elastic_energy",
)
