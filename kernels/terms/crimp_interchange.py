"""Crimp interchange: yarns that are crimped round each other straighten at each other's expense before they stretch.

At a crossing warp and weft have heights h₁ and h₂, from one extreme of a yarn's axis to the other. They touch, so

    h₁ + h₂ = d₁ + d₂

and h = h₁ is an unknown of the crossing. Of a segment between crossings p = |x_b − x_a| is its length in the plane of
the cloth, Δs that of its yarn, which is a thread of length ℓ that rises by h:

    ℓ = √(p² + (β h)²),   ε = ℓ/Δs − 1,   r = β h cos θ₀ − p sin θ₀,   β² = 9/8
    V = Δs ψ(ε) + ½ b r²/Δs,   ψ' = T = kₛ ε,  and kₛ ε/(1 − kₛ ε/T_b) where ε < 0,   b = 12 k_b/L₀²,   T_b = ¼ b cos²θ₀

β makes h = (4/3) p √c of a crimp c = ℓ/p − 1, as Peirce has it for yarns that are round at their bends (straight pieces
would have √2). T is the tension: a yarn that is pushed gives way beyond T_b, which it resists by bending. The second
part is what it takes to bend a yarn, held at both ends, by r across itself; it is set at the slope θ₀ and the length L₀
that it was woven with. In place of ``stretch`` a crossing has half of V of each of its four segments, at its height:

    W = min over h of ½ Σ V(p, h₁ or h₂, Δs)

In tension V is convex in (p, h, Δs), and so is W, and there is one h; pushed, while ℓ > Δs/4. A segment that ends on
the border has the height of its crossing at both ends. Straight ones, on border yarns and between crossings where a
yarn stays on one side (floats), keep their crimp: V = ½ kₛ Δs (p/(Δs cos θ₀) − 1)².

The contact force is what it takes to hold h₁ + h₂, and half of n·(F of the warp − F of the weft) as of ``stretch``.

Parameters: ``stretch`` Y [Pa]; ``bend`` B [Pa m²]; ``radius``, half the thickness of each yarn for d₁ + d₂ [m];
``lengthening`` of each yarn as woven, 1/cos θ₀, and times its ``spacing`` L₀ [m].

h comes of Newton's iteration between bounds, and of one more step whose derivative is that of the implicit function
theorem, so that reverse mode differentiates through it.

The matrix is the exact second derivative of W in the positions, without what compression takes away. Where yarns slide
warp and weft are coupled through h by four coordinates that the matrix has no place for. Every other evaluation has
the coupling within each yarn alone, which is never less than half of the exact matrix; those between have that of the
positions, with Δs held. Newton's iteration needs both: in the one a cloth that draws in is too stiff, in the other a
yarn that slides. Methods that take one matrix a step have twice the first.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.structs import ONCE, structs
from ..core.variant import Term, Variant
from . import bending, crimped_segment, stretch

ENOUGH = 2.0
"""Times the coupling within each yarn, that it is no less than the exact matrix: methods that take one matrix a step
would gain energy of less."""
HELD = 10.0
"""How much stiffer Δs are in the matrix of the positions: they are left for the other one to move."""


@functools.cache
def around(variant: Variant) -> SimpleNamespace:
    """Make the functions that look at a node and its four segments."""
    scalar, vec3 = variant.scalar, variant.vec3
    vec2, vec4 = wp.types.vector(2, scalar), variant.vec4
    Crimp, own = structs(variant).Crimp, general.functions(variant).own
    stretch_stiffness, bend_stiffness = stretch.functions(variant).stiffness, bending.functions(variant).stiffness

    @wp.func
    def yarns_of(
        crimp: Crimp,
        i: int,
        stretch: wp.array(dtype=scalar),
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
    ):
        """Compute kₛ, k_b and θ₀ of the warp and the weft yarn of a node, and d₁ + d₂ of their thicknesses."""
        k = vec2()
        k_b = vec2()
        angle = vec2()
        total = scalar(0.0)
        for direction in range(2):
            # on the border of an outline there may be one yarn alone
            yarn = wp.max(crimp.node_yarns[2 * i + direction], 0)
            half_width = radius[own(2 * yarn)]
            half_thickness = radius[own(2 * yarn + 1)]
            k[direction] = stretch_stiffness(stretch[yarn], half_width, half_thickness)
            k_b[direction] = bend_stiffness(bend[yarn], half_width, half_thickness)
            angle[direction] = wp.acos(scalar(1.0) / crimp.lengthening[yarn])
            total += scalar(2.0) * half_thickness
        return k, k_b, angle, total

    @wp.func
    def segments_of(
        crimp: Crimp,
        i: int,
        k_b: vec2,
        spacing: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
    ):
        """Compute p, Δs and b of the segments left, right, up and down of a node, and the part of each that is its own
        and crimped, 0 of others."""
        p = vec4()
        rest = vec4()
        b = vec4()
        parts = vec4()
        for side in range(4):
            p[side] = scalar(1.0)
            rest[side] = scalar(1.0)
            b[side] = scalar(1.0)
            if crimp.crimp_sides[i][side] != 0:
                at = index(crimp.crimp_around[i][side])
                s = side / 2
                yarn = wp.max(crimp.node_yarns[2 * i + s], 0)
                p[side] = wp.length(position[at] - position[i])
                rest[side] = wp.abs(euler[2 * at + s] - euler[2 * i + s])
                woven = crimp.lengthening[yarn] * spacing[own(2 * wp.min(at, i) + s)]
                b[side] = scalar(12.0) * k_b[s] / (woven * woven)
                parts[side] = wp.max(scalar(0.5) * scalar(crimp.crimp_sides[i][side]), scalar(0.0))
        return p, rest, b, parts

    return SimpleNamespace(yarns=yarns_of, segments=segments_of)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding = variant.scalar, variant.vec3, variant.sliding
    vec4, mat44 = variant.vec4, wp.types.matrix((4, 4), variant.scalar)
    BlockMatrix, Crimp = structs(variant).BlockMatrix, structs(variant).Crimp
    f, near = crimped_segment.functions(variant), around(variant)
    crimp_height, crimp_slopes, straight_slopes, crimp_curvature = f.height, f.slopes, f.straight, f.curvature
    yarns_of, segments_of = near.yarns, near.segments

    @wp.func
    def add_between_positions(
        crimp: Crimp,
        i: int,
        position: wp.array(dtype=vec3),
        blocks: BlockMatrix,
        c: mat44,
        across: vec4,
    ):
        """Add the blocks of a node's segments: c, second derivatives by their lengths; across, those across each."""
        all = wp.identity(n=3, dtype=scalar) * scalar(0.0)
        for k in range(4):
            if crimp.crimp_sides[i][k] != 0:
                at = index(crimp.crimp_around[i][k])
                direction = k / 2
                t = wp.normalize(position[at] - position[i])
                bare = (wp.identity(n=3, dtype=scalar) - wp.outer(t, t)) * across[k]
                with_node = bare
                for m in range(4):
                    if c[k, m] != scalar(0.0):
                        other = index(crimp.crimp_around[i][m])
                        block = wp.outer(t, wp.normalize(position[other] - position[i])) * c[k, m]
                        with_node += block
                        if k == m:
                            wp.atomic_add(blocks.diagonal_xx, at, block + bare)
                        elif k < m:
                            if k / 2 == m / 2:
                                wp.atomic_add(blocks.upper_xx, index(blocks.stencil * at + 2 + direction), block)
                            else:
                                slot = index(crimp.crimp_corners[i][2 * k + m - 2])
                                if m == 2:
                                    # the one above comes before the ones beside
                                    wp.atomic_add(blocks.upper_xx, slot, wp.transpose(block))
                                else:
                                    wp.atomic_add(blocks.upper_xx, slot, block)
                all += with_node
                if k % 2 == 0:
                    wp.atomic_add(blocks.upper_xx, index(blocks.stencil * at + direction), -with_node)
                else:
                    wp.atomic_add(blocks.upper_xx, index(blocks.stencil * i + direction), -wp.transpose(with_node))
        wp.atomic_add(blocks.diagonal_xx, i, all)

    @wp.func
    def add_along_yarns(
        crimp: Crimp,
        i: int,
        position: wp.array(dtype=vec3),
        blocks: BlockMatrix,
        e: mat44,
        r: mat44,
    ):
        """Add the blocks of (u, v): e, second derivatives by a segment's length and a Δs of the same yarn; r, by
        two Δs."""
        for direction in range(2):
            k = 2 * direction
            m = k + 1
            before = i
            after = i
            t0 = vec3()
            t1 = vec3()
            if crimp.crimp_sides[i][k] != 0:
                before = index(crimp.crimp_around[i][k])
                t0 = wp.normalize(position[before] - position[i])
            if crimp.crimp_sides[i][m] != 0:
                after = index(crimp.crimp_around[i][m])
                t1 = wp.normalize(position[after] - position[i])
            s = 2 * i + direction
            wp.atomic_add(blocks.diagonal_xs, s, t0 * (e[k, m] - e[k, k]) + t1 * (e[m, m] - e[m, k]))
            wp.atomic_add(blocks.diagonal_ss, s, r[k, k] - scalar(2.0) * r[k, m] + r[m, m])
            if before != i:
                wp.atomic_add(blocks.diagonal_xs, 2 * before + direction, -t0 * e[k, k])
                wp.atomic_add(blocks.diagonal_ss, 2 * before + direction, r[k, k])
                slot = 4 * before + direction
                wp.atomic_add(blocks.upper_xs, slot, t0 * (e[k, k] - e[k, m]))
                wp.atomic_add(blocks.upper_sx, slot, t0 * e[k, k] + t1 * e[m, k])
                wp.atomic_add(blocks.upper_ss, slot, r[k, m] - r[k, k])
            if after != i:
                wp.atomic_add(blocks.diagonal_xs, 2 * after + direction, t1 * e[m, m])
                wp.atomic_add(blocks.diagonal_ss, 2 * after + direction, r[m, m])
                slot = 4 * i + direction
                wp.atomic_add(blocks.upper_xs, slot, -t0 * e[k, m] - t1 * e[m, m])
                wp.atomic_add(blocks.upper_sx, slot, t1 * (e[m, k] - e[m, m]))
                wp.atomic_add(blocks.upper_ss, slot, r[k, m] - r[m, m])
            if before != i and after != i:
                slot = 4 * before + 2 + direction
                wp.atomic_add(blocks.upper_xs, slot, t0 * e[k, m])
                wp.atomic_add(blocks.upper_sx, slot, -t1 * e[m, k])
                wp.atomic_add(blocks.upper_ss, slot, -r[k, m])

    @variant.kernel("crimp")
    def crimp_interchange_term(
        # topology and shape
        crimp: Crimp,
        # parameters
        stretch: wp.array(dtype=scalar),
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
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
        i = index(wp.tid())
        k, k_b, angle, total = yarns_of(crimp, i, stretch, bend, radius)
        p, rest, b, parts = segments_of(crimp, i, k_b, spacing, position, euler)
        h = crimp_height(total, p, rest, parts, k, b, angle)
        for side in range(4):
            code = crimp.crimp_sides[i][side]
            if code != 0:
                at = index(crimp.crimp_around[i][side])
                direction = side / 2
                mine = h
                if side > 1:
                    mine = total - h
                part = scalar(0.5) * wp.abs(scalar(code))
                slopes = straight_slopes(p[side], rest[side], k[direction], angle[direction])
                if code > 0:
                    slopes = crimp_slopes(p[side], mine, rest[side], k[direction], b[side], angle[direction])
                f = wp.normalize(position[at] - position[i]) * (part * slopes[0])
                wp.atomic_add(force, i, f)
                wp.atomic_add(force, at, -f)
                if add_contact_load != 0:
                    half = scalar(0.5) - scalar(direction)
                    wp.atomic_add(contact_load, i, half * wp.dot(normal[i], f) + part * slopes[1])
                    wp.atomic_add(contact_load, at, -half * wp.dot(normal[at], f))
                if wp.static(sliding):
                    f_s = part * slopes[2]
                    if side % 2 == 0:
                        f_s = -f_s
                    wp.atomic_add(euler_force, 2 * i + direction, f_s)
                    wp.atomic_add(euler_force, 2 * at + direction, -f_s)

        if matrix != 0:
            factor = blocks.coefficients[0][2]
            c = mat44()
            e = mat44()
            r = mat44()
            across = vec4()
            by_p = vec4()
            by_rest = vec4()
            curvature = scalar(0.0)
            enough = scalar(1.0)
            if wp.static(sliding):
                if blocks.evaluations[0] == ONCE:
                    enough = scalar(ENOUGH)
            for side in range(4):
                code = crimp.crimp_sides[i][side]
                if code != 0:
                    yarn = side / 2
                    part = scalar(0.5) * wp.abs(scalar(code)) * factor
                    if code > 0:
                        part *= enough
                        mine = h
                        sign = scalar(1.0)
                        if side > 1:
                            mine = total - h
                            sign = scalar(-1.0)
                        slopes = crimp_slopes(p[side], mine, rest[side], k[yarn], b[side], angle[yarn])
                        pp, ph, hh, pr, hr, rr, _less = crimp_curvature(
                            p[side], mine, rest[side], k[yarn], b[side], angle[yarn]
                        )
                        c[side, side] = part * pp
                        e[side, side] = part * pr
                        r[side, side] = part * rr
                        by_p[side] = sign * part * ph
                        by_rest[side] = sign * part * hr
                        curvature += part * hh
                        across[side] = part * wp.max(slopes[0], scalar(0.0)) / wp.max(p[side], scalar(1.0e-12))
                    else:
                        slopes = straight_slopes(p[side], rest[side], k[yarn], angle[yarn])
                        by_cosine = scalar(1.0) / wp.cos(angle[yarn])
                        ratio = p[side] * by_cosine / rest[side]
                        along = part * k[yarn] / rest[side]
                        c[side, side] = along * by_cosine * by_cosine
                        e[side, side] = -along * by_cosine * ratio
                        r[side, side] = along * ratio * ratio
                        across[side] = part * wp.max(slopes[0], scalar(0.0)) / wp.max(p[side], scalar(1.0e-12))
            by_yarn = wp.bool(wp.static(sliding)) and blocks.evaluations[0] % 2 == 0
            if curvature > scalar(0.0):
                for row in range(4):
                    for column in range(4):
                        if row / 2 == column / 2:
                            c[row, column] -= by_p[row] * by_p[column] / curvature
                            e[row, column] -= by_p[row] * by_rest[column] / curvature
                            r[row, column] -= by_rest[row] * by_rest[column] / curvature
                        elif not by_yarn:
                            c[row, column] -= by_p[row] * by_p[column] / curvature
            if wp.static(sliding):
                if not by_yarn:
                    e = mat44()
                    r *= scalar(HELD)
            add_between_positions(crimp, i, position, blocks, c, across)
            if wp.static(sliding):
                add_along_yarns(crimp, i, position, blocks, e, r)

    return crimp_interchange_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    Crimp = structs(variant).Crimp
    f, near = crimped_segment.functions(variant), around(variant)
    crimp_height, crimp_energy = f.height, f.energy
    yarns_of, segments_of = near.yarns, near.segments

    @variant.kernel("crimp")
    def crimp_interchange_energy(
        crimp: Crimp,
        stretch: wp.array(dtype=scalar),
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        i = index(wp.tid())
        k, k_b, angle, total = yarns_of(crimp, i, stretch, bend, radius)
        p, rest, b, parts = segments_of(crimp, i, k_b, spacing, position, euler)
        h = crimp_height(total, p, rest, parts, k, b, angle)
        for side in range(4):
            code = crimp.crimp_sides[i][side]
            if code != 0:
                yarn = side / 2
                mine = h
                if side > 1:
                    mine = total - h
                v = crimp_energy(p[side], mine, rest[side], k[yarn], b[side], angle[yarn])
                if code < 0:
                    strain = p[side] / (rest[side] * wp.cos(angle[yarn])) - scalar(1.0)
                    v = scalar(0.5) * k[yarn] * rest[side] * strain * strain
                wp.atomic_add(energy, 0, scalar(0.5) * wp.abs(scalar(code)) * v)

    return crimp_interchange_energy


TERM = Term(
    name="crimp_interchange",
    elements="nodes",
    define=define,
    energy=define_energy,
    absent=lambda scene: "" if scene.crimp_interchange else "crimp_interchange is False",
    stencil=6,
    presses=True,
    energy_watched_as="elastic_energy",
)
