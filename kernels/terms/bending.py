"""Bending of a yarn at a crossing, between three consecutive nodes a, c, b of it.

    V = k_b θ²/Δs,   k_b = B π R²,   Δs = s_b − s_a
    θ: the angle between t₁ and −t₂, with t₁ = dir(x_b − x_c) and t₂ = dir(x_a − x_c); 0 where the yarn is straight

and between this and the k_b π²/Δs of a flat fold where a segment has shrunk to nearly a point (``mollifier.py``).

Parameters: ``bend`` B, bending modulus of each yarn [Pa m²] (the paper prints N/m); ``radius`` R and ``spacing`` L [m].
In a general cloth R² is half the width times half the thickness of the yarn, and L that of each segment.

θ² and θ/sin θ are taken from sin²θ by their series near 0: the state of rest is straight, and an acos near ±1 or a
division by sin θ gives noise there, and NaN adjoints.

The matrix is the Gauss-Newton part (2k_b/Δs)(dθ − θ dΔs/Δs)², and, across the plane of the yarn, the positive
eigenvalue of the exact second derivative, κ = (θ/2)/tan(θ/2) times the same stiffness. Written with the rotation Q that
takes −t₂ to t₁, both are smooth at θ = 0, where the plane is undefined. Left out are the terms in 1/l², which are
indefinite and vanish with θ. Of a shrinking segment it has the positive part of the curvature along it.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from ..core import general
from ..core.indexing import index
from ..core.structs import structs
from ..core.variant import Term, TermParameter, Variant
from . import mollifier

FLAT = math.pi**2
"""θ² of a flat fold."""
SERIES_BELOW = 1.0e-3
"""sin²θ under which the series are used: their first dropped term is then under 1e-16."""


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    """Make the Warp functions of one bend, shared with the contact force."""
    scalar, vec3 = variant.scalar, variant.vec3
    presence, inverse_length = mollifier.functions(variant).presence, mollifier.functions(variant).inverse_length
    vec2 = wp.types.vector(2, scalar)

    @wp.func
    def bend_angle(t1: vec3, t2: vec3) -> vec2:
        """Compute (θ², θ/sin θ)."""
        cosine = -wp.dot(t1, t2)
        cross = wp.cross(t1, t2)
        z = wp.dot(cross, cross)
        if cosine > scalar(0.0) and z < scalar(wp.static(SERIES_BELOW)):
            series = scalar(1.0) + z * (
                scalar(wp.static(1.0 / 6.0))
                + z
                * (
                    scalar(wp.static(3.0 / 40.0))
                    + z * (scalar(wp.static(15.0 / 336.0)) + z * scalar(wp.static(105.0 / 3456.0)))
                )
            )
            return vec2(z * series * series, series)
        sine = wp.length(cross)
        # of the smaller of the two, which loses no digits; an atan2 costs three times as much
        angle = scalar(wp.static(0.5 * wp.PI))
        if wp.abs(cosine) < sine:
            angle -= wp.asin(cosine)
        else:
            angle = wp.asin(sine)
            if cosine < scalar(0.0):
                angle = scalar(wp.PI) - angle
        # Folded flat: the direction of the force is undefined and q below is 0, so the floor only keeps it finite.
        return vec2(angle * angle, angle / wp.max(sine, scalar(1.0e-9)))

    @wp.func
    def bend_force(
        t1: vec3,
        t2: vec3,
        by_length: scalar,
        mine: vec3,
        other: vec3,
        k: scalar,
        square: scalar,
        angle_over_sine: scalar,
    ) -> vec3:
        """Compute the force on the end that t1 points to; k = 2k_b/Δs, mine and other (s, s', s'') of the two
        segments."""
        force = (t2 - t1 * wp.dot(t1, t2)) * (-k * other[0] * angle_over_sine * mine[0] * by_length)
        if mine[1] > scalar(0.0):
            force -= t1 * (k * other[0] * scalar(0.5) * (square - scalar(wp.static(FLAT))) * mine[1])
        return force

    @wp.func
    def bend_stiffness(modulus: scalar, half_width: scalar, half_thickness: scalar) -> scalar:
        """Compute k_b = B π R² [N m²]."""
        return modulus * scalar(wp.static(wp.PI)) * half_width * half_thickness

    @wp.func
    def bend_forces(e1: vec3, e2: vec3, k: scalar, unit1: scalar, unit2: scalar):
        """Compute the forces on the ends that e1 and e2 lead to."""
        l1 = wp.length(e1)
        l2 = wp.length(e2)
        s1 = presence(l1, unit1)
        s2 = presence(l2, unit2)
        by_l1 = inverse_length(l1, unit1)
        by_l2 = inverse_length(l2, unit2)
        t1 = e1 * by_l1
        t2 = e2 * by_l2
        angle = bend_angle(t1, t2)
        f1 = bend_force(t1, t2, by_l1, s1, s2, k, angle[0], angle[1])
        f2 = bend_force(t2, t1, by_l2, s2, s1, k, angle[0], angle[1])
        return f1, f2

    return SimpleNamespace(angle=bend_angle, force=bend_force, forces=bend_forces, stiffness=bend_stiffness)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, sliding, of_each = variant.scalar, variant.vec3, variant.sliding, variant.general
    BlockMatrix = structs(variant).BlockMatrix
    f = functions(variant)
    bend_angle, bend_force, bend_forces, bend_stiffness = f.angle, f.force, f.forces, f.stiffness
    presence, inverse_length = mollifier.functions(variant).presence, mollifier.functions(variant).inverse_length
    own = general.functions(variant).own

    @wp.func
    def in_plane_excess(z: scalar, cosine: scalar, square: scalar, kappa: scalar, angle_over_sine: scalar) -> scalar:
        """Compute (1 − κ)/sin²θ, → 1/12 at θ = 0."""
        if cosine > scalar(0.0) and z < scalar(wp.static(SERIES_BELOW)):
            series = scalar(wp.static(1.0 / 12.0)) + square * (
                scalar(wp.static(1.0 / 720.0))
                + square * (scalar(wp.static(1.0 / 30240.0)) + square * scalar(wp.static(1.0 / 1209600.0)))
            )
            return angle_over_sine * angle_over_sine * series
        return (scalar(1.0) - kappa) / wp.max(z, scalar(1.0e-12))

    @variant.kernel("terms")
    def bending_term(
        # topology
        bend_nodes: wp.array(dtype=wp.vec3i),
        bend_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        # parameters
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
        e = index(wp.tid())
        a = index(bend_nodes[e][0])
        c = index(bend_nodes[e][1])
        b = index(bend_nodes[e][2])
        yarn = index(bend_yarn[e])
        direction = index(yarn_direction[yarn])
        sa = 2 * a + direction
        sb = 2 * b + direction
        rest = euler[sb] - euler[sa]
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        unit1 = spacing[own(2 * c + direction)]
        unit2 = unit1
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
            unit2 = spacing[sa]
        k = scalar(2.0) * bend_stiffness(bend[yarn], half_width, half_thickness) / rest
        e1 = position[b] - position[c]
        e2 = position[a] - position[c]
        if add_contact_load != 0:
            # from the crimped positions, x − R n on a warp yarn and x + R n on a weft yarn
            half = scalar(0.5) - scalar(direction)
            crimp = scalar(-2.0) * half * half_thickness
            pressing_b, pressing_a = bend_forces(
                e1 + (normal[b] - normal[c]) * crimp, e2 + (normal[a] - normal[c]) * crimp, k * half, unit1, unit2
            )
            wp.atomic_add(contact_load, a, wp.dot(normal[a], pressing_a))
            wp.atomic_add(contact_load, b, wp.dot(normal[b], pressing_b))
            wp.atomic_add(contact_load, c, -wp.dot(normal[c], pressing_a + pressing_b))
        l1 = wp.length(e1)
        l2 = wp.length(e2)
        s1 = presence(l1, unit1)
        s2 = presence(l2, unit2)
        by_l1 = inverse_length(l1, unit1)
        by_l2 = inverse_length(l2, unit2)
        # by division: a straight yarn's are exact opposites
        t1 = wp.normalize(e1)
        t2 = wp.normalize(e2)
        angle = bend_angle(t1, t2)
        square = angle[0]
        angle_over_sine = angle[1]

        f_b = bend_force(t1, t2, by_l1, s1, s2, k, square, angle_over_sine)
        f_a = bend_force(t2, t1, by_l2, s2, s1, k, square, angle_over_sine)
        wp.atomic_add(force, b, f_b)
        wp.atomic_add(force, a, f_a)
        wp.atomic_add(force, c, -(f_a + f_b))
        if wp.static(sliding):
            s12 = s1[0] * s2[0]
            faded = square * s12 + scalar(wp.static(FLAT)) * (scalar(1.0) - s12)
            f_s = scalar(0.5) * k * faded / rest
            wp.atomic_add(euler_force, sb, f_s)
            wp.atomic_add(euler_force, sa, -f_s)

        if matrix != 0:
            bare = blocks.coefficients[0][2] * k
            stiffness = bare * s1[0] * s2[0]
            cosine = -wp.dot(t1, t2)
            w = wp.cross(t1, t2)
            q1 = t2 + t1 * cosine
            q2 = t1 + t2 * cosine
            kappa = scalar(0.5) * angle_over_sine * (scalar(1.0) + cosine)
            chi = in_plane_excess(wp.dot(w, w), cosine, square, kappa, angle_over_sine)
            eye = wp.identity(n=3, dtype=scalar)
            # half the square of the skew matrix, written out
            squared = (wp.outer(w, w) - eye * wp.dot(w, w)) * (scalar(0.5) * angle_over_sine)
            rotation = kappa * (eye + wp.skew(w) + wp.outer(t1, t2)) + squared
            bb = (kappa * (eye - wp.outer(t1, t1)) + chi * wp.outer(q1, q1)) * (stiffness * by_l1 * by_l1)
            aa = (kappa * (eye - wp.outer(t2, t2)) + chi * wp.outer(q2, q2)) * (stiffness * by_l2 * by_l2)
            ba = (rotation + chi * wp.outer(q1, q2)) * (stiffness * by_l1 * by_l2)
            ab = wp.transpose(ba)
            gain = scalar(0.5) * bare * (square - scalar(wp.static(FLAT)))
            if s1[2] < scalar(0.0):
                bb += wp.outer(t1, t1) * (gain * s1[2] * s2[0])
            if s2[2] < scalar(0.0):
                aa += wp.outer(t2, t2) * (gain * s2[2] * s1[0])
            wp.atomic_add(blocks.diagonal_xx, a, aa)
            wp.atomic_add(blocks.diagonal_xx, b, bb)
            wp.atomic_add(blocks.diagonal_xx, c, aa + bb + ab + ba)
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * a + direction), -(aa + ab))
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * c + direction), -(ab + bb))
            wp.atomic_add(blocks.upper_xx, index(blocks.stencil * a + 2 + direction), ab)
            if wp.static(sliding):
                # θ dθ = (θ/sin θ) q·dx / l
                xs_b = q1 * (stiffness * angle_over_sine * by_l1 / rest)
                xs_a = q2 * (stiffness * angle_over_sine * by_l2 / rest)
                xs_c = -(xs_a + xs_b)
                ss = bare * faded / (rest * rest)
                wp.atomic_add(blocks.diagonal_xs, sa, xs_a)
                wp.atomic_add(blocks.diagonal_xs, sb, -xs_b)
                wp.atomic_add(blocks.diagonal_ss, sa, ss)
                wp.atomic_add(blocks.diagonal_ss, sb, ss)
                wp.atomic_add(blocks.upper_xs, 4 * a + 2 + direction, -xs_a)
                wp.atomic_add(blocks.upper_sx, 4 * a + 2 + direction, xs_b)
                wp.atomic_add(blocks.upper_ss, 4 * a + 2 + direction, -ss)
                wp.atomic_add(blocks.upper_sx, 4 * a + direction, xs_c)
                wp.atomic_add(blocks.upper_xs, 4 * c + direction, -xs_c)

    return bending_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3, of_each = variant.scalar, variant.vec3, variant.general
    bend_angle, bend_stiffness = functions(variant).angle, functions(variant).stiffness
    presence = mollifier.functions(variant).presence
    own = general.functions(variant).own

    @variant.kernel("energy")
    def bending_energy(
        bend_nodes: wp.array(dtype=wp.vec3i),
        bend_yarn: wp.array(dtype=int),
        yarn_direction: wp.array(dtype=int),
        bend: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        euler: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        a = bend_nodes[e][0]
        c = bend_nodes[e][1]
        b = bend_nodes[e][2]
        yarn = bend_yarn[e]
        direction = yarn_direction[yarn]
        half_width = radius[own(2 * yarn)]
        half_thickness = half_width
        unit1 = spacing[own(2 * c + direction)]
        unit2 = unit1
        if wp.static(of_each):
            half_thickness = radius[2 * yarn + 1]
            unit2 = spacing[2 * a + direction]
        rest = euler[2 * b + direction] - euler[2 * a + direction]
        e1 = position[b] - position[c]
        e2 = position[a] - position[c]
        fading = presence(wp.length(e1), unit1)[0] * presence(wp.length(e2), unit2)[0]
        square = bend_angle(wp.normalize(e1), wp.normalize(e2))[0]
        faded = square * fading + scalar(wp.static(FLAT)) * (scalar(1.0) - fading)
        wp.atomic_add(energy, 0, bend_stiffness(bend[yarn], half_width, half_thickness) * faded / rest)

    return bending_energy


TERM = Term(
    name="bending",
    elements="bends",
    define=define,
    energy=define_energy,
    parameters=(TermParameter("bend", "Pa m²", least=0.0, of="yarn"),),
    stencil=4,
    presses=True,
)
