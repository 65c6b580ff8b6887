"""Shear of warp against weft, at the four corners of every crossing, with its lock (eq. 5).

    V = ½ k L (φ − π/2)²,   φ: the angle between x_p − x and x_r − x (p a warp neighbour, r a weft neighbour)
    k = S π R² (1 + F_n) · lock(φ),   F_n held constant in the derivative by position

    lock(φ) = ½ [(1 + γᶜ) + (1 − γᶜ) tanh( φ̄⁵ (φ − φ_l) / ((φ (φ − φ_l)(φ − φ̄))² + φ̄⁴ σ²) )]
    φ̄ = π/2,  φ_l = 2 arcsin(R/L),  γ = (√2 L − 2 L sin(φ/2))/R,  c = 3,  σ = 0.6

where the corner can jam (its crossing is flipped against both neighbours), and 1 elsewhere. The force is minus the
gradient of the whole energy, dk/dφ included. Beyond the right angle γ is negative, which would turn eq. 5's stiffness
negative near φ = π, so γ is taken as 0 there: γ³ stays twice differentiable. Where a neighbour is nearly at the place
of the crossing, V is between this and the energy at φ = 0 (``vanishing.py``).

Parameters: ``shear`` S [Pa]; ``spacing`` L and ``radius`` R [m].

The matrix is the Gauss-Newton part, (V'/(φ − φ̄)) ∇φ ∇φᵀ, exact at the right angle; V'' in place of its factor where the
lock makes V'' larger, up to four times so; and of a shrinking segment the positive part of the curvature along it.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import vanishing
from .variant import Term, Variant

OF_CURVATURE = 0.8
"""The part of V'' that the matrix has at least: little enough that V'/(φ − φ̄), which it is in ordinary motion, is more
within 25 degrees of the right angle."""
FLAT = {wp.float64: 1e-12, wp.float32: 1e-5}
"""Sine of an angle that cannot be told from a fold's: what t₁ cos φ − t₂ is there, is rounding."""
LOCK_EXPONENT = 3
LOCK_SMOOTHNESS = 0.6


@functools.cache
def functions(variant: Variant) -> SimpleNamespace:
    scalar, vec3 = variant.scalar, variant.vec3

    @wp.func
    def shear_lock(
        phi: scalar, sine: scalar, cosine: scalar, threshold: scalar, spacing_by_radius: scalar, second: int
    ) -> vec3:
        """(lock, its first and, where second is not 0, its second derivative by φ) of eq. 5; sine and cosine of φ/2."""
        zero = scalar(0.0)
        one = scalar(1.0)
        two = scalar(2.0)
        half = scalar(0.5)
        exponent = scalar(LOCK_EXPONENT)
        right = scalar(wp.static(0.5 * wp.PI))
        right4 = scalar(wp.static((0.5 * wp.PI) ** 4))
        right5 = scalar(wp.static((0.5 * wp.PI) ** 5))
        gamma = wp.max((scalar(wp.static(2.0**0.5)) - two * sine) * spacing_by_radius, zero)
        gamma_rate = -cosine * spacing_by_radius
        boost = gamma * gamma * gamma
        boost_rate = exponent * gamma * gamma * gamma_rate
        a = phi - threshold
        b = phi - right
        product = phi * a * b
        product_rate = a * b + phi * b + phi * a
        by_below = one / (product * product + right4 * scalar(wp.static(LOCK_SMOOTHNESS**2)))
        below_rate = two * product * product_rate
        s = wp.tanh(right5 * a * by_below)
        z_rate = right5 * by_below * (one - a * below_rate * by_below)
        s_rate = (one - s * s) * z_rate
        lock = half * ((one + boost) + (one - boost) * s)
        rate = half * (boost_rate * (one - s) + (one - boost) * s_rate)
        rate2 = zero
        if second != 0:
            gamma_rate2 = half * sine * spacing_by_radius
            boost_rate2 = exponent * gamma * (two * gamma_rate * gamma_rate + gamma * gamma_rate2)
            below_rate2 = two * (product_rate * product_rate + product * two * (phi + a + b))
            z_rate2 = -two * below_rate - a * below_rate2 + two * a * below_rate * below_rate * by_below
            z_rate2 *= right5 * by_below * by_below
            s_rate2 = (one - s * s) * (z_rate2 - two * s * z_rate * z_rate)
            rate2 = half * (boost_rate2 * (one - s) - two * boost_rate * s_rate + (one - boost) * s_rate2)
        return vec3(lock, rate, rate2)

    @wp.func
    def shear_angle(t1: vec3, t2: vec3) -> vec3:
        """(φ, sin φ/2, cos φ/2) between two directions, exact to rounding at every angle (Kahan)."""
        sine = scalar(0.5) * wp.length(t1 - t2)
        cosine = scalar(0.5) * wp.length(t1 + t2)
        return vec3(scalar(2.0) * wp.atan2(sine, cosine), sine, cosine)

    return SimpleNamespace(lock=shear_lock, angle=shear_angle)


def define(variant: Variant) -> wp.Kernel:
    scalar, vec3, mat33 = variant.scalar, variant.vec3, variant.mat33
    shear_lock, shear_angle = functions(variant).lock, functions(variant).angle
    presence, inverse_length = vanishing.functions(variant).presence, vanishing.functions(variant).inverse_length

    @variant.kernel("terms")
    def shear_term(
        # topology
        corner_nodes: wp.array(dtype=wp.vec3i),
        corner_jams: wp.array(dtype=int),
        corner_blocks: wp.array(dtype=wp.vec3i),
        # parameters
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        lock_angle: wp.array(dtype=scalar),
        # state in
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        # forces out
        force: wp.array(dtype=vec3),
        # matrix out
        matrix: int,
        weights: wp.array(dtype=vec3),
        diagonal_xx: wp.array(dtype=mat33),
        upper_xx: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        p = corner_nodes[e][0]
        c = corner_nodes[e][1]
        r = corner_nodes[e][2]
        e1 = position[p] - position[c]
        e2 = position[r] - position[c]
        l1 = wp.length(e1)
        l2 = wp.length(e2)
        by_l1 = inverse_length(l1, spacing[0])
        by_l2 = inverse_length(l2, spacing[0])
        t1 = e1 * by_l1
        t2 = e2 * by_l2
        angle = shear_angle(t1, t2)
        phi = angle[0]
        ratio = spacing[0] / radius[0]
        strain = phi - scalar(wp.static(0.5 * wp.PI))
        pressed = scalar(1.0) + wp.max(contact_load[c], scalar(0.0))
        k = shear[0] * scalar(wp.static(wp.PI)) * radius[0] * radius[0] * pressed * spacing[0]
        s_p = presence(l1, spacing[0])
        s_r = presence(l2, spacing[0])
        gain = scalar(0.0)
        if s_p[0] * s_r[0] < scalar(1.0):
            now = strain * strain
            shut = scalar(wp.static(0.25 * wp.PI * wp.PI))
            if corner_jams[e] != 0:
                now *= shear_lock(phi, angle[1], angle[2], lock_angle[0], ratio, 0)[0]
                shut *= shear_lock(scalar(0.0), scalar(0.0), scalar(1.0), lock_angle[0], ratio, 0)[0]
            gain = scalar(0.5) * k * (now - shut)
        curvature = k
        if corner_jams[e] != 0:
            lock = shear_lock(phi, angle[1], angle[2], lock_angle[0], ratio, matrix)
            curvature *= lock[0] + scalar(2.0) * strain * lock[1] + scalar(0.5) * strain * strain * lock[2]
            k *= lock[0] + scalar(0.5) * lock[1] * strain
        # ∇φ; where the corner is folded flat its direction is undefined, and becomes 0
        across = wp.dot(t1, t2)
        by_sine = scalar(1.0) / wp.max(scalar(2.0) * angle[1] * angle[2], scalar(wp.static(FLAT[scalar])))
        g_p = (t1 * across - t2) * (by_sine * by_l1)
        g_r = (t2 * across - t1) * (by_sine * by_l2)
        g_c = -(g_p + g_r)
        k *= s_p[0] * s_r[0]
        curvature *= s_p[0] * s_r[0]
        moment = k * strain
        f_p = g_p * moment + t1 * (gain * s_p[1] * s_r[0])
        f_r = g_r * moment + t2 * (gain * s_r[1] * s_p[0])
        wp.atomic_add(force, p, -f_p)
        wp.atomic_add(force, r, -f_r)
        wp.atomic_add(force, c, f_p + f_r)

        if matrix != 0:
            stiffness = weights[0][2] * wp.max(k, scalar(wp.static(OF_CURVATURE)) * curvature)
            wp.atomic_add(diagonal_xx, p, wp.outer(g_p, g_p) * stiffness)
            wp.atomic_add(diagonal_xx, r, wp.outer(g_r, g_r) * stiffness)
            wp.atomic_add(diagonal_xx, c, wp.outer(g_c, g_c) * stiffness)
            # a block stands in the row of its lower node
            blocks = corner_blocks[e]
            g_c *= stiffness
            if p < c:
                wp.atomic_add(upper_xx, blocks[0], wp.outer(g_p, g_c))
            else:
                wp.atomic_add(upper_xx, blocks[0], wp.outer(g_c, g_p))
            if r < c:
                wp.atomic_add(upper_xx, blocks[1], wp.outer(g_r, g_c))
            else:
                wp.atomic_add(upper_xx, blocks[1], wp.outer(g_c, g_r))
            if p < r:
                wp.atomic_add(upper_xx, blocks[2], wp.outer(g_p, g_r) * stiffness)
            else:
                wp.atomic_add(upper_xx, blocks[2], wp.outer(g_r, g_p) * stiffness)
            if s_p[2] < scalar(0.0):
                along = wp.outer(t1, t1) * (weights[0][2] * gain * s_p[2] * s_r[0])
                wp.atomic_add(diagonal_xx, p, along)
                wp.atomic_add(diagonal_xx, c, along)
                wp.atomic_add(upper_xx, blocks[0], -along)
            if s_r[2] < scalar(0.0):
                along = wp.outer(t2, t2) * (weights[0][2] * gain * s_r[2] * s_p[0])
                wp.atomic_add(diagonal_xx, r, along)
                wp.atomic_add(diagonal_xx, c, along)
                wp.atomic_add(upper_xx, blocks[1], -along)

    return shear_term


def define_energy(variant: Variant) -> wp.Kernel:
    scalar, vec3 = variant.scalar, variant.vec3
    shear_lock, shear_angle = functions(variant).lock, functions(variant).angle
    presence = vanishing.functions(variant).presence

    @variant.kernel("energy")
    def shear_energy(
        corner_nodes: wp.array(dtype=wp.vec3i),
        corner_jams: wp.array(dtype=int),
        shear: wp.array(dtype=scalar),
        radius: wp.array(dtype=scalar),
        spacing: wp.array(dtype=scalar),
        lock_angle: wp.array(dtype=scalar),
        position: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=scalar),
        energy: wp.array(dtype=scalar),
    ):
        e = wp.tid()
        c = corner_nodes[e][1]
        e1 = position[corner_nodes[e][0]] - position[c]
        e2 = position[corner_nodes[e][2]] - position[c]
        fading = presence(wp.length(e1), spacing[0])[0] * presence(wp.length(e2), spacing[0])[0]
        angle = shear_angle(wp.normalize(e1), wp.normalize(e2))
        phi = angle[0]
        ratio = spacing[0] / radius[0]
        strain = phi - scalar(wp.static(0.5 * wp.PI))
        pressed = scalar(1.0) + wp.max(contact_load[c], scalar(0.0))
        k = shear[0] * scalar(wp.static(wp.PI)) * radius[0] * radius[0] * pressed * spacing[0]
        largest = k * scalar(wp.static(0.25 * wp.PI * wp.PI))
        if corner_jams[e] != 0:
            k *= shear_lock(phi, angle[1], angle[2], lock_angle[0], ratio, 0)[0]
            largest *= shear_lock(scalar(0.0), scalar(0.0), scalar(1.0), lock_angle[0], ratio, 0)[0]
        faded = k * strain * strain * fading + largest * (scalar(1.0) - fading)
        wp.atomic_add(energy, 0, scalar(0.5) * faded)

    return shear_energy


TERM = Term(name="shear", elements="corners", define=define, energy=define_energy, stencil=6, needs_contact=True)
