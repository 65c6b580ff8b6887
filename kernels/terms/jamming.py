"""Collision of parallel yarns: neighbouring crossings of a yarn keep a distance in (u, v) (paper 3.3).

    V = ½ k_c L ReLU(d − Δs)²,   d = 4R between crossings flipped against each other, else 2R

and never pass each other, nor the end of a yarn, which the penalty alone does not see to: below d̂ = 0.2 R stands the
barrier of Li et al. (Incremental Potential Contact, 2020),

    V = −(kₛ + k_c L)/d̂ · (Δs − d̂)² ln(Δs/d̂)

convex, 0 with its first and second derivative from d̂ on, and without bound as Δs → 0. A segment that has collapsed to
a point loses ½ kₛ of energy for every metre of yarn that leaves it: the barrier holds that at 0.65 d̂.

In a general cloth L is the distance of the two crossings at rest, and d half the widths of the yarns that cross there,
together, and the thickness of this one where they are flipped against each other, all times 1 + c of its crimp, which
Δs is longer by; the R of d̂ is half the mean width of the two.

Parameters: ``parallel_stiffness`` k_c [N/m]; ``stretch`` Y of each yarn [Pa], for kₛ = Y π R²; ``spacing`` L [m];
``radius`` R [m].

The matrix is the exact second derivative.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import ends, index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant
from . import stretch as stretching

BARRIER = 0.2
"""d̂, in radii: a tenth of the spacing, where yarns touch at rest."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def barrier(rest: scalar, reach: scalar, stiffness: scalar) -> vec3:
        """Compute (V, −V', V'') of the barrier; stiffness [N]."""
        x = rest / reach
        if x >= scalar(1.0):
            return vec3()
        left = scalar(1.0) - x
        log = -wp.log(x)
        return (
            vec3(
                reach * left * left * log,
                left * (scalar(2.0) * log + left / x),
                (scalar(2.0) * log + left * (scalar(4.0) + left / x) / x) / reach,
            )
            * stiffness
        )

    return SimpleNamespace(barrier=barrier)


def define(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar
    BlockMatrix = structs(variant).BlockMatrix
    barrier, of_each = functions(variant).barrier, variant.general
    f = general.functions(variant)
    own, longer, half_width_at = f.own, f.longer, f.half_width
    stretch_stiffness = stretching.functions(variant).stiffness

    @variant.kernel("terms")
    def parallel_term(
        # topology
        segments: wp.array(dtype=wp.vec4i),
        flipped: wp.array(dtype=int),
        # parameters
        parallel_stiffness: wp.array(dtype=scalar),
        stretch: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        # state in
        euler: wp.array(dtype=scalar),
        # forces out
        euler_force: wp.array(dtype=scalar),
        # matrix out
        matrix: int,
        blocks: BlockMatrix,
    ):
        a, b, sa, sb, yarn, direction = ends(segments, index(wp.tid()))
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        # half the mean width of the yarns that cross there
        across = half_width
        if wp.static(of_each):
            half_thickness = longer(radius, yarn) * radius[2 * yarn + 1]
            across = half_width_at(spacing, a, 1 - direction) + half_width_at(spacing, b, 1 - direction)
            across *= scalar(0.5) * longer(radius, yarn)
        distance = scalar(2.0) * across
        if flipped[a] != flipped[b]:
            distance = scalar(2.0) * (across + half_thickness)
        rest = euler[sb] - euler[sa]
        overlap = distance - rest
        if overlap > scalar(0.0):
            k = parallel_stiffness[0] * spacing[own(sa)]
            reach = across * scalar(wp.static(BARRIER))
            if wp.static(of_each):
                half_thickness = radius[2 * yarn + 1]
            guard = barrier(rest, reach, k + stretch_stiffness(stretch[yarn], half_width, half_thickness))
            f = k * overlap + guard[1]
            wp.atomic_add(euler_force, sa, -f)
            wp.atomic_add(euler_force, sb, f)
            if matrix != 0:
                ss = blocks.coefficients[0][2] * (k + guard[2])
                wp.atomic_add(blocks.diagonal_ss, sa, ss)
                wp.atomic_add(blocks.diagonal_ss, sb, ss)
                wp.atomic_add(blocks.upper_ss, 4 * a + direction, -ss)

    return parallel_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar = variant.scalar
    barrier, of_each = functions(variant).barrier, variant.general
    own = general.functions(variant).own

    @wp.func
    def half_width_across(radius: wp.array(dtype=scalar), node_yarns: wp.array(dtype=int), node: int, direction: int):
        """Look up half the width of the yarn that crosses one of this direction at a node, 0 where none does."""
        yarn = node_yarns[2 * node + 1 - direction]
        if yarn >= 0:
            return radius[2 * yarn]
        return scalar(0.0)

    stretch_stiffness = stretching.functions(variant).stiffness

    @variant.kernel("energy")
    def parallel_energy(
        segments: wp.array(dtype=wp.vec4i),
        flipped: wp.array(dtype=int),
        parallel_stiffness: wp.array(dtype=scalar),
        stretch: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        node_yarns: wp.array(dtype=int),
        lengthening: wp.array(dtype=scalar),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        a, b, sa, sb, yarn, direction = ends(segments, index(wp.tid()))
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        # half the mean width of the yarns that cross there
        across = half_width
        if wp.static(of_each):
            half_thickness = lengthening[yarn] * radius[2 * yarn + 1]
            across = half_width_across(radius, node_yarns, a, direction)
            across += half_width_across(radius, node_yarns, b, direction)
            across *= scalar(0.5) * lengthening[yarn]
        distance = scalar(2.0) * across
        if flipped[a] != flipped[b]:
            distance = scalar(2.0) * (across + half_thickness)
        rest = euler[sb] - euler[sa]
        overlap = wp.max(distance - rest, scalar(0.0))
        k = parallel_stiffness[0] * spacing[own(sa)]
        reach = across * scalar(wp.static(BARRIER))
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
        guard = barrier(rest, reach, k + stretch_stiffness(stretch[yarn], half_width, half_thickness))
        wp.atomic_add(energy, 0, scalar(0.5) * k * overlap * overlap + guard[0])

    return parallel_energy


TERM = Term(
    name="parallel",
    elements="segments",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("parallel_stiffness", "N/m", least=0.0),),
    stencil=2,
    sliding_only=True,
)
